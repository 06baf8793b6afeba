"""Invalid settings of a training: the message names the field."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from pathlib import Path

import pytest
import torch

from ufmstar_torch.models import PointDepth, Preprocess
from ufmstar_torch.train import AugmentationConfig, DataConfig, DepthDataModule, FitSettings, Recipe, loss_of, preset
from ufmstar_torch.train.data_config import Part

INF, NAN = float("inf"), float("nan")
MAP = torch.ones(2, 3, 4)
recipe, settings = Recipe.from_dict, partial(FitSettings, out=Path("out"))
loss = partial(loss_of, PointDepth(MAP), MAP, MAP > 0)

REFUSALS: list[tuple[Callable[[], object], str]] = [
    (lambda: recipe({"epoch": 3}), r"no \['epoch'\]"),
    (lambda: recipe({"epochs": 0}), "epochs"),
    (lambda: recipe({"epochs": 2.5}), "epochs must be a whole number"),
    (lambda: recipe({"learning_rate": 0}), "learning_rate"),
    (lambda: recipe({"learning_rate": NAN}), "learning_rate"),
    (lambda: recipe({"beta2": 1.0}), "beta2"),
    (lambda: recipe({"schedule": "linear"}), "schedule"),
    (lambda: recipe({"network": {"width": 2}}), r"no \['width'\]"),
    (lambda: recipe({"network": {"method": "batch_ensemble", "members": 4}, "members": 2}), "members"),
    (lambda: recipe({"split_batch": True}), "split_batch"),
    (lambda: recipe({"clip_frames": 4, "batch_size": 6}), "clip_frames"),
    (lambda: recipe({"clip_frames": 4, "network": {"method": "depth"}}), "clip_frames"),
    (lambda: preset("resnet"), "preset"),
    (lambda: DataConfig(kind="kitti"), "kind"),
    (lambda: DataConfig(on_bad_file="ignore"), "on_bad_file"),
    (lambda: DataConfig(workers=-1), "workers"),
    (lambda: DataConfig(tours=0), "tours"),
    (lambda: DataConfig(paths=("x",)), "paths"),
    (lambda: DataConfig(kind="nyu"), "paths"),
    (lambda: DataConfig(kind="sequences"), "paths"),
    (lambda: DataConfig(validation_paths=("x",)), "validation_paths"),
    (lambda: DataConfig(part="70"), "part"),
    (lambda: DataConfig(validation_part="90%:80%"), "validation_part"),
    *[(partial(Part.parse, text), "a part must") for text in ("0:70:90", "a:b", "-5:10", "0:120%", "7:7", "1.5:3")],
    (lambda: Part.parse("3:4").frames(2), "empty"),
    (lambda: DepthDataModule(DataConfig(), Preprocess(), 2, clip_frames=4), "batch_size"),
    (lambda: AugmentationConfig(scale=(0.5, 1.5)), "scale"),
    (lambda: AugmentationConfig(scale=(1.0, INF)), "scale"),
    (lambda: AugmentationConfig(rotation=NAN), "rotation"),
    (lambda: AugmentationConfig(flip=1.5), "flip"),
    (lambda: AugmentationConfig(brightness=1.1), "brightness"),
    (lambda: AugmentationConfig(zoom="both"), "zoom"),
    (lambda: DataConfig(tour_frames=0), "tour_frames"),
    (lambda: DataConfig(tour_size=(4, 32)), "tour_size"),
    (lambda: DataConfig(tour_fov=170.0), "tour_fov"),
    (lambda: DataConfig(tour_style="castle"), "style"),
    (lambda: settings(strategy="ddp_spawn"), "strategy"),
    (lambda: settings(log_every=0), "log_every"),
    (lambda: settings(max_minutes=NAN), "max_minutes"),
    (lambda: loss_of(PointDepth(MAP), MAP, MAP), "valid"),
    (lambda: loss_of(PointDepth(MAP), MAP[:1], MAP > 0), "target"),
    (lambda: loss_of(MAP, MAP, MAP > 0), "distribution"),
    (lambda: loss(evidence_weight=-1.0), "evidence_weight"),
]


@pytest.mark.parametrize(("call", "message"), REFUSALS, ids=range(len(REFUSALS)))
def test_it_is_refused_and_named(call: Callable[[], object], message: str) -> None:
    with pytest.raises((TypeError, ValueError), match=message):
        call()

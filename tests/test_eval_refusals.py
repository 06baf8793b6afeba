"""Invalid calls and commands of the evaluation: the message names the argument."""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import partial
from pathlib import Path

import numpy as np
import pytest
import torch
from tiny_suite import row, rows_of

from ufmstar_torch import AnchorConfig, Recalibration, UfMStarConfig
from ufmstar_torch.eval.bench.measure import measure
from ufmstar_torch.eval.commands.poses import read as read_poses
from ufmstar_torch.eval.engine.load import NetworkChoice
from ufmstar_torch.eval.methods.setting import setting_from
from ufmstar_torch.eval.methods.suite import Suite, suite_named
from ufmstar_torch.eval.methods.ufm import UfM
from ufmstar_torch.eval.metrics.recalibration import fit
from ufmstar_torch.eval.sequences import open_sequence
from ufmstar_torch.eval.tour import make_tour, render, tour_path
from ufmstar_torch.eval.tour.view import intrinsics
from ufmstar_torch.frames.choose import choose

NAN, INF = math.nan, math.inf
EYE, K = torch.eye(4, dtype=torch.float64), torch.from_numpy(intrinsics(24, 32))
network, tour = NetworkChoice.parse, open_sequence


def mcd(**overrides: object) -> object:
    return row("UfM*-MCD", overrides=overrides)


def tracked(**values: object) -> object:
    return setting_from({"anchors": "corners", **values})


def poses(*words: str) -> object:
    return read_poses(["walk", "--out", "out", *words])


REFUSALS: list[tuple[Callable[[], object], str]] = [
    # rows and their settings
    (lambda: mcd(**{"segment.min_pixel": 3}), "UfM.-MCD.*segment.min_pixels"),
    (lambda: mcd(alpha=1.0), "ema_alpha"),
    (lambda: mcd(segment={}), "setting 'segment' is a group"),
    (lambda: mcd(xyz=3), "no setting is called 'xyz'"),
    (lambda: mcd(ema_alpha=1.5), "ema_alpha must lie in"),
    (lambda: mcd(eta="much"), "eta must be a number"),
    (lambda: row("Ensemble", overrides={"eta": 0.3}), r"only UfM\* has"),
    (lambda: row("UfM-Ensemble-100K", overrides={"eta": 0.3}), r"only UfM\* has"),
    (lambda: row("Aleatoric", overrides={"variances_in_h": True}), r"only UfM\* has variances_in_h"),
    (lambda: row("UfM*-DepthOnly", overrides={"variances_in_h": True}), "needs a network that predicts a variance"),
    (lambda: UfMStarConfig(variances_in_h=True, anchors=AnchorConfig()), "goes without anchors"),
    (lambda: setting_from({"anchors": "lidar"}), "anchors must be"),
    (lambda: tracked(anchor_count=-1), "anchor_count must lie in"),
    (lambda: tracked(anchor_count=True), "anchor_count must be a number"),
    (lambda: tracked(anchor_count=2.5), "anchor_count must be a whole number"),
    (lambda: tracked(posterior=1), "posterior must be True or False"),
    (lambda: tracked(track_noise=-1.0), "track_noise must lie in"),
    (lambda: setting_from({"anchors": "truth", "track_noise": 1.0}), 'goes with anchors = "corners"'),
    *[
        (partial(setting_from, values), "go with anchors")
        for values in ({"anchor_count": 5}, {"posterior": True}, {"anchors.half_life": 10.0})
    ],
    *[
        (partial(setting_from, {name: value}), f"{name} must ")
        for name in ("rotation_drift", "translation_drift")
        for value in (-1.0, INF, NAN)
    ],
    (lambda: measure([row("UfM*-DepthOnly", rotation_drift=0.1)], {"depth_only": object()}, None), "do not affect"),
    (lambda: UfM(0), "max_points must be None or at least 1"),
    # suites
    (lambda: Suite("x", "", rows_of("Ensemble") * 2), "has a row twice: Ensemble"),
    (lambda: Suite("x", "", ()), "at least one row"),
    (lambda: Suite("../x", "", rows_of("Ensemble")), "small letters"),
    (lambda: suite_named("paper-table-1", preset="papers"), "ufm_preset must be"),
    (lambda: suite_named("paper-table-1").with_bases(["depth_only"]), "there are networks of depth_only only"),
    (lambda: suite_named("paper-table-1", "depth_only"), "--base goes with figures"),
    (lambda: suite_named("ablation-no-alternating", "aleatoric"), "no rows of"),
    # networks
    *[(partial(network, text), "must be given as") for text in ("", "ensemble", "=trained:x", "ensemble=")],
    (lambda: network("ensembles=trained:x"), "base must be one of"),
    (lambda: network("ensemble=train:x"), "model must be one of"),
    (lambda: network("ensemble=trained"), "needs the file"),
    (lambda: network("depth_only=onnx:spec.json"), "needs the file"),
    (lambda: network("depth_only=onnx:net.onnx,a.json,b.json"), "one spec"),
    (lambda: network("aleatoric=ground-truth"), "goes with depth_only"),
    (lambda: network("depth_only=ground-truth:48"), "HxW"),
    # recalibration
    *[
        (partial(Recalibration, *knots), "Recalibration")
        for knots in (
            ((), ()), ((1.0, 2.0), (1.0,)), ((1.0, 1.0), (1.0, 2.0)), ((1.0, 2.0), (2.0, 1.0)),
            ((0.0, 1.0), (1.0, 2.0)), ((1.0, INF), (1.0, 2.0)), (("a",), (1.0,)),
        )
    ],
    (lambda: fit([np.zeros((514, 514))]), "pixels with ground truth"),
    # choosing images
    (lambda: choose(torch.ones(2, 2)), r"scores must be \[N\]"),
    (lambda: choose([1.0, 2.0], 3), "count must lie in 0 to the number of images 2"),
    (lambda: choose([1.0, 2.0], 1.5), "count must lie in"),
    (lambda: choose([1.0, 2.0], poses=torch.eye(4)[None]), r"poses must be \[2, 4, 4\]"),
    (lambda: choose([1.0, 2.0], poses=torch.eye(4).repeat(2, 1, 1) * NAN), "poses must be finite"),
    (lambda: choose([1.0, -2.0], poses=torch.eye(4).repeat(2, 1, 1)), "scores of at least 0"),
    # tours
    *[(partial(tour, name), "tour:SEED") for name in ("tour:", "tour:-1", "tour:a")],
    (lambda: tour("tour:1?colour=red"), "unknown option 'colour'"),
    (lambda: tour("tour:1?style=attic"), "style must be one of home, hall, mixed"),
    (lambda: tour("tour:1?frames=0"), "frames must be a number of at least 1"),
    (lambda: tour("tour:1?size=160"), "size must be HxW"),
    (lambda: tour("tour:1?size=4x4"), "size must be"),
    (lambda: tour("tour:1?fov=wide"), "fov must be"),
    (lambda: tour("tour:1?fov=170"), "fov must be"),
    (lambda: tour("tour:1?sensor=yes"), "sensor must be 0 or 1"),
    (lambda: tour("tour:1?frames=3&frames=4"), "twice"),
    (lambda: tour("tour:1", fps=30.0), "takes no fps"),
    (lambda: tour("tour:1", intrinsics=np.eye(3)), "takes no intrinsics"),
    (lambda: open_sequence("tour:1", "tum"), "takes no layout"),
    (lambda: make_tour(-1), "seed must be"),
    (lambda: make_tour(True), "seed must be"),
    (lambda: make_tour(2**32), "below 4294967296"),
    (lambda: tour("tour:1?movers=101"), "movers must be 0 to 100"),
    (lambda: make_tour(1, "attic"), "style must be one of"),
    (lambda: tour_path(make_tour(2), 0), "frames must be"),
    (lambda: tour_path(make_tour(2), 3, -1), "seed must be"),
    (lambda: render(make_tour(2), 99 * EYE, K, 24, 32), "T_world_cam must be|must stand in a room"),
    (lambda: render(make_tour(2), EYE * NAN, K, 24, 32), "T_world_cam must be"),
    (lambda: render(make_tour(2), EYE, K[:2], 24, 32), "K must be"),
    (lambda: render(make_tour(2), EYE, K, 0, 32), "height and width"),
    # poses from images
    (lambda: poses("--length", "a", "b"), "--length must be A B METRES"),
    (lambda: poses("--length", "a", "b", "-1"), "--length must be A B METRES"),
    (lambda: poses("--length", "a", "b", "1", "--trajectory", "x"), "contradict each other"),
    (lambda: poses("--intrinsics", "none.txt"), "--intrinsics: no such file: none.txt"),
    (lambda: poses("--distortion", "0.1", "0", "0", "0"), "--distortion goes with --intrinsics"),
]  # fmt: skip


@pytest.mark.parametrize(("call", "message"), REFUSALS, ids=range(len(REFUSALS)))
def test_it_is_refused_and_named(
    call: Callable[[], object], message: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    with pytest.raises(ValueError, match=message):
        call()

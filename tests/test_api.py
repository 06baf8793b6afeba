"""Pins the public API: a change here affects every user of the package."""

from __future__ import annotations

import inspect

import pytest

import ufmstar_torch
from ufmstar_torch import (
    AnchorConfig,
    MergeConfig,
    PosteriorConfig,
    UfMStar,
    UfMStarConfig,
    UncertainDepth,
)
from ufmstar_torch.runtime.checked import flat

PUBLIC = {
    "DepthPrediction",
    "GaussianMixture",
    "LiveDepth",
    "LiveResult",
    "AnchorConfig",
    "MergeConfig",
    "PosteriorConfig",
    "Recalibration",
    "SPGFConfig",
    "UfMStar",
    "UfMStarConfig",
    "UncertaintyOutput",
    "UncertainDepth",
}


def names(function) -> list[str]:
    return [n for n in inspect.signature(function).parameters if n != "self"]


def test_public_names():
    assert set(ufmstar_torch.__all__) == PUBLIC
    assert set(dir(ufmstar_torch)) >= PUBLIC
    for name in PUBLIC:
        assert getattr(ufmstar_torch, name).__name__ == name
    with pytest.raises(AttributeError, match="UfMStarr"):
        _ = ufmstar_torch.UfMStarr
    assert ufmstar_torch.__version__ == "0.1.0"


def test_signatures():
    observation = ["depth", "pose", "intrinsics", "aleatoric", "epistemic", "valid"]
    assert names(UfMStar.__init__) == ["config", "recalibration", "dtype", "device"]
    view, sampled = ["member", "informative"], ["pixels", "fraction", "seed"]
    assert names(UfMStar.forward) == [*observation, *view, "anchors", "confidence"]
    assert names(UfMStar.mean_uncertainty) == [*observation, *view, *sampled, "anchors", "confidence"]
    assert names(UfMStar.query) == ["points"]
    assert names(UfMStar.reset) == ["streams", "keep_evidence"]
    made_of = [
        "networks",
        "config",
        "mode",
        "posterior",
        "samples",
        "preprocess",
        "anchors",
        "recalibration",
        "check_poses",
        "multiview_device",
    ]
    assert names(UncertainDepth.__init__) == made_of
    images = ["image", "pose", "intrinsics", "valid", "anchors"]
    assert names(UncertainDepth.forward) == images
    assert names(UncertainDepth.mean_uncertainty) == [*images, "pixels", "fraction", "seed"]


def test_few_settings():
    """The core has at most 45 settings, those of all sections together."""
    sections = {"anchors": AnchorConfig(), "posterior": PosteriorConfig()}
    assert len(flat(UfMStarConfig(**sections, merge=MergeConfig()).to_dict())) <= 45


def test_the_papers_defaults():
    config = UfMStarConfig()
    assert (config.eta, config.eta_occlusion) == (0.5, 0.7)
    assert (config.prior_weight, config.prior_mean) == (1.0, 0.0)
    assert (config.near_radius, config.far_radius) == (0.1, 0.5)
    assert config.ema_alpha == 0.5
    assert config.variance_floor == 0.0
    assert not config.overlap_weighted

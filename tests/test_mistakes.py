"""Plausible mistakes in what a user gives: each is named or caught, and right input raises no alarm."""

from __future__ import annotations

import re

import numpy as np
import pytest
import torch

import scenes
from ufmstar_torch import AnchorConfig, SPGFConfig, UfMStar, UfMStarConfig
from ufmstar_torch.anchors import Anchors

H, W = 48, 64
K = scenes.intrinsics(H, W)
CONFIG = UfMStarConfig(segment=SPGFConfig(min_pixels=20, min_rows=1))
WALK = [scenes.look([0.1 * i, 0.02 * i, -0.04 * i], 0.05 * i) for i in range(14)]


def scaled(T, factor):
    """The pose with its position in another unit."""
    out = T.copy()
    out[:3, 3] *= factor
    return out


def said(caplog, change=lambda T: T, config=CONFIG, anchors=None, frames=WALK):
    """What the logger got from a walk before rendered boxes, two streams of which the second has right poses."""
    caplog.clear()
    ufm = UfMStar(config)
    for T in frames:
        depth = torch.tensor(scenes.render(T, K, H, W))[None].repeat(2, 1, 1)
        poses = torch.tensor(np.stack([change(T), T]))
        given = {} if config.anchors is None else {"anchors": anchors}
        out = ufm(depth, poses, torch.tensor(K), **given)
    return caplog.messages, out.statistics


@pytest.mark.parametrize("factor", [100, 1000])
def test_views_that_never_meet_are_named_once_a_stream(caplog, factor):
    messages, statistics = said(caplog, lambda T: scaled(T, factor))
    assert len(messages) == 1
    assert re.match(r"stream 0: after 8 frames \d+ of \d+ Gaussians were seen in one view alone", messages[0])
    assert "millimetres" in messages[0]
    assert int(statistics.single_view[0]) > 0.9 * int(statistics.components[0])
    assert int(statistics.single_view[1]) < 0.7 * int(statistics.components[1])


def test_right_input_is_not_warned_of(caplog):
    assert said(caplog)[0] == []
    assert said(caplog, frames=WALK[:1] * 14)[0] == [], "a camera that stands still"


def test_moving_frames_without_anchors_are_named(caplog):
    config = CONFIG.replace(anchors=AnchorConfig())
    messages, _ = said(caplog, config=config)
    assert [re.match(r"stream (\d): 0 anchors were used in 10 frames of a moving camera", m)[1] for m in messages] == [
        "0",
        "1",
    ]
    assert said(caplog, config=config, frames=WALK[:1] * 14)[0] == []
    rng, n = np.random.default_rng(0), 40
    pixel = torch.tensor(np.stack([rng.uniform(0, W - 1, (2, n)), rng.uniform(0, H - 1, (2, n))], -1))
    far = Anchors(pixel, torch.full((2, n), 2.0).double(), torch.full((2, n), 1e-2).double())
    assert said(caplog, config=config, anchors=far)[0] == []

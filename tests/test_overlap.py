"""The network's scale is uncertain in views that share little with the evidence."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from posterior_cases import MODEL, checked, moved_by, relative, turned, updated

from ufmstar_torch import PosteriorConfig
from ufmstar_torch.posterior.running import views
from ufmstar_torch.posterior.update import update


def away_from_evidence(degrees, frames, metres=0.0, config=MODEL):
    """Relative variance, mean over the image, after three frames of a wall with anchors everywhere, and ``frames``
    frames without any in which the camera turns and moves to the right, by so much each; and the share of its view
    whose scale is unconfirmed."""
    depth, packed = np.full((12, 16), 2.0), None
    pixel = np.stack([x.ravel() for x in np.mgrid[1:16:3, 1:12:3]], -1).astype(float)
    for _ in range(3):
        packed, _ = updated(depth, (pixel, np.full(len(pixel), 2.0), np.full(len(pixel), 1e-4)), packed=packed)
    for k in range(1, frames + 1):
        pose = turned(degrees * k) @ moved_by(metres * k)
        frame, _ = checked(depth, np.zeros((0, 2)), np.zeros(0), np.zeros(0), pose)
        packed, out = update(packed, frame, None, torch.zeros(1, 12, 16, dtype=torch.float64), config)
    return float(relative(out).mean()), float(views(packed[0].numpy()).frames[2])


def test_in_a_turn_away_from_the_evidence_the_scale_becomes_uncertain_and_at_rest_it_does_not():
    """The image is 44 degrees wide. The share of the view that is new, not the number of frames, decides."""
    rest, turn, slow, far = (away_from_evidence(*each) for each in ((0, 5), (4, 5), (2, 10), (4, 30)))
    assert rest[1] == pytest.approx(0, abs=1e-12)
    assert 0.3 < turn[1] < 0.5
    assert slow[1] == pytest.approx(turn[1], rel=0.05)
    assert far[1] > 0.85
    assert rest[0] + 0.02 < turn[0] < far[0]
    without = type("Certain", (PosteriorConfig,), {"places": 0.0})()
    assert away_from_evidence(4, 5, config=without)[0] == pytest.approx(rest[0], rel=1e-9)


def test_a_camera_that_approaches_sees_nothing_new_and_one_that_moves_sideways_does():
    depth = np.full((12, 16), 2.0)
    pixel, g = np.array([[8.0, 6.0]]), np.full(1, 2.0)
    ahead, back = np.eye(4), np.eye(4)
    ahead[2, 3], back[2, 3] = 0.3, -0.3
    shares = []
    for pose in (ahead, back, moved_by(0.3)):
        packed, _ = updated(depth, (pixel, g, np.full(1, 1e-4)))
        frame, _ = checked(depth, np.zeros((0, 2)), np.zeros(0), np.zeros(0), pose)
        packed, _ = update(packed, frame, None, torch.zeros(1, 12, 16, dtype=torch.float64), MODEL)
        shares.append(float(views(packed[0].numpy()).frames[2]))
    assert shares[0] == pytest.approx(0, abs=1e-12)
    assert shares[1] == pytest.approx(1 - (1.7 / 2) ** 2, rel=0.02)  # the last frame sees the same wall at 1.7 m
    assert shares[2] == pytest.approx(0.3 / 2 * 20 / 16, rel=0.1)  # shift [px] over the width


def test_anchors_everywhere_confirm_the_scale_of_a_view_and_one_anchor_does_not():
    depth, pose = np.full((12, 16), 2.0), turned(25)
    everywhere = np.stack([x.ravel() for x in np.mgrid[1:16:3, 1:12:3]], -1).astype(float)
    shares = []
    for pixel in (everywhere, everywhere[:1]):
        packed, _ = updated(depth, (everywhere, np.full(len(everywhere), 2.0), np.full(len(everywhere), 1e-4)))
        frame, anchors = checked(depth, pixel, np.full(len(pixel), 2.0), np.full(len(pixel), 1e-4), pose)
        packed, _ = update(packed, frame, anchors, torch.zeros(1, 12, 16, dtype=torch.float64), MODEL)
        shares.append(float(views(packed[0].numpy()).frames[2]))
    assert shares[0] < 0.01
    assert shares[1] > 0.1

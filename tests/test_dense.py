"""Dense anchors on rendered rooms, where every depth is known."""

from __future__ import annotations

import numpy as np
import pytest

from ufmstar_torch.anchors.dense import DenseConfig, DenseEvidence
from ufmstar_torch.eval.tour.open import open_sequence


@pytest.fixture(scope="module")
def tour():
    return list(open_sequence("tour:5?frames=14&size=120x160"))


def true_depth(frame, pixel):
    u, v = np.rint(pixel).astype(int).T
    return frame.depth[v, u]


def test_depths_of_a_rendered_room_are_right_and_as_uncertain_as_stated(tour):
    evidence, errors, surprises, counts = DenseEvidence(), [], [], []
    for frame in tour:
        found = evidence.update(frame.image, frame.T_world_cam, frame.intrinsics)
        z = true_depth(frame, found.pixel)
        errors.extend(np.abs(found.depth - z) / z)
        surprises.extend((1 / found.depth - 1 / z) * found.depth**2 / np.sqrt(found.variance))
        counts.append(len(z))
    assert counts[:2] == [0, 0], "two keyframes must agree"
    assert np.median(counts[6:]) >= 60
    assert np.median(errors) < 0.07
    assert 0.5 < 1.4826 * np.median(np.abs(surprises)) < 2


def test_a_standing_camera_has_no_anchors(tour):
    frame, evidence = tour[3], DenseEvidence()
    for _ in range(6):
        assert len(evidence.update(frame.image, frame.T_world_cam, frame.intrinsics).depth) == 0


def test_a_saved_state_continues_to_the_last_bit(tour):
    one, other = DenseEvidence(), DenseEvidence()
    for frame in tour[:7]:
        one.update(frame.image, frame.T_world_cam, frame.intrinsics)
    other.load_state(one.state())
    for frame in tour[7:]:
        a, b = (e.update(frame.image, frame.T_world_cam, frame.intrinsics) for e in (one, other))
        for name in ("pixel", "depth", "variance", "confirmed"):
            np.testing.assert_array_equal(getattr(a, name), getattr(b, name))
    with pytest.raises(ValueError, match="50 keyframes, got 20"):
        other.load_state(DenseEvidence(DenseConfig(keyframes=20)).state())

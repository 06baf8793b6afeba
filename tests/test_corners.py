"""Corners: detected away from tracked corners, and tracked to their true positions."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from ufmstar_torch.anchors.corners import find, follow


def textured(height, width, seed=0):
    """Smooth noise, full of corners."""
    noise = np.random.default_rng(seed).standard_normal((height, width)).astype(np.float32)
    return cv2.normalize(cv2.GaussianBlur(noise, (0, 0), 2.0), None, 0, 255, cv2.NORM_MINMAX).astype(np.uint8)


def apart(a, b):
    return np.linalg.norm(a[:, None] - b[None], axis=-1)


@pytest.mark.parametrize("size", [(120, 160), (360, 500)], ids=["whole", "halved"])
def test_new_corners_keep_away_from_each_other_and_from_the_followed(size):
    image, rng = textured(*size), np.random.default_rng(1)
    # Also at the image's corners, where discs extend beyond the image.
    edge = np.array([[0.0, 0.0], [size[1] - 1, size[0] - 1], [size[1] - 1, 0.0]])
    followed = np.concatenate([rng.uniform(0, np.array(size[::-1]) - 1, (20, 2)), edge])
    result = find(image, 4000, 9.0, followed)
    assert len(result) > 20
    assert apart(result, followed).min() > 9 - 2.5, "a pixel at the search's resolution, for rounding"
    assert apart(result, result)[~np.eye(len(result), dtype=bool)].min() >= 9 - 1e-9
    alone = find(image, 4000, 9.0, np.zeros((0, 2)))
    assert len(alone) > len(result)
    assert apart(alone, followed).min() < 5, "without existing corners some are found"
    np.testing.assert_array_equal(find(image, 7, 9.0, followed), result[:7])


def test_a_blank_wall_has_no_corners():
    assert find(np.full((60, 80), 128, np.uint8), 10, 5.0, np.zeros((0, 2))).shape == (0, 2)


def test_corners_move_with_the_image():
    image = textured(240, 320)
    moved = cv2.warpAffine(image, np.array([[1, 0, 5.5], [0, 1, -3.25]]), (320, 240), borderMode=cv2.BORDER_REFLECT)
    start = find(image, 100, 10.0, np.zeros((0, 2)))
    position, fine = follow(image, moved, start, 0.5)
    goal = start + np.array([5.5, -3.25])
    inside = ((goal > 12) & (goal < [307, 227])).all(1)
    assert fine[inside].mean() > 0.95
    np.testing.assert_allclose(position[fine & inside], goal[fine & inside], atol=0.15)
    assert not fine[(goal[:, 0] > 320) | (goal[:, 1] < -1)].any(), "tracks that leave the image are rejected"
    _, gone = follow(image, textured(240, 320, seed=5), start, 0.5)
    assert gone.mean() < 0.2, "with an unrelated image, backward tracking fails"


@pytest.mark.parametrize(("right", "error", "gain"), [(70.0, (3, -2), 0.2), (4.0, (150, 40), -0.2)])
def test_an_expected_position_extends_the_search_and_a_wrong_one_is_dropped(right, error, gain):
    before = textured(240, 480)
    after = cv2.warpAffine(before, np.array([[1.0, 0, right], [0, 1, 0]]), (480, 240))
    start = find(before, 60, 12.0, np.zeros((0, 2)))
    start = start[(start[:, 0] < 380) & (start[:, 0] > 20)]
    went = start + np.array([right, 0.0])
    _, without = follow(before, after, start, 0.5)
    found, fine = follow(before, after, start, 0.5, went + np.array(error))
    assert fine.mean() > 0.75
    assert fine.mean() > without.mean() + gain
    assert np.median(np.abs(found[fine] - went[fine])) < 0.1


@pytest.mark.parametrize("gain", [0.6, 0.9, 1.0, 1.4])
@pytest.mark.parametrize("right", [2, 8])
def test_corners_are_followed_into_an_image_of_another_exposure(gain, right):
    before = (textured(240, 320) * 0.6).astype(np.uint8)
    after = np.clip(np.roll(before, right, axis=1) * gain, 0, 255).astype(np.uint8)
    start = find(before, 100, 10.0, np.zeros((0, 2)))
    start = start[(start[:, 0] > 20) & (start[:, 0] < 280)]
    position, fine = follow(before, after, start, 0.5)
    assert fine.mean() > 0.9
    np.testing.assert_allclose(position[fine], start[fine] + [right, 0], atol=0.3)


def test_a_black_image_shows_no_corner():
    image = textured(120, 160)
    start = find(image, 50, 8.0, np.zeros((0, 2)))
    for black in ((image, image * 0), (image * 0, image)):
        assert not follow(*black, start, 0.5)[1].any()

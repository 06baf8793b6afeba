"""Inputs of a run's metrics and pictures: truth at the prediction's pixels, and the network's input image."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from layouts import write_scannet

from scenes import render
from ufmstar_torch.eval.run.colours import INVALID_GREY
from ufmstar_torch.eval.run.panels import FramePanel, map_columns
from ufmstar_torch.eval.run.pictures import field_of_view
from ufmstar_torch.eval.sequences import open_sequence
from ufmstar_torch.eval.sequences.ground_truth import nearest_pixels, resample_nearest, truth_at
from ufmstar_torch.models import Preprocess


@pytest.mark.parametrize("size", [(480, 640), (360, 540), (640, 480), (229, 305)])
@pytest.mark.parametrize("preprocess", [Preprocess.nyu(), Preprocess(size=(128, 128)), Preprocess(size=(120, 128))])
def test_resampling_by_rays_equals_the_preprocessing_of_depth(size, preprocess):
    labels = torch.arange(size[0] * size[1]).reshape(size)
    K = torch.tensor([[500.3, 0, 310.7], [0, 497.9, 244.1], [0, 0, 1]], dtype=torch.float64)
    K_net = preprocess.apply_intrinsics(K, *size).numpy()
    expected = preprocess.apply_depth(labels).numpy()
    actual = resample_nearest(labels.numpy(), K.numpy(), K_net, expected.shape)
    np.testing.assert_array_equal(actual, expected)


def test_every_position_belongs_to_the_pixel_around_it_or_lies_outside():
    u = np.array([0, 1.49, 1.5, -0.5, -0.51, 3.49, 3.51, np.nan, np.inf, 2])
    v = np.array([0, 0, 0, 2, 2, 1, 1, 1, 1, -1e30])
    index, inside = nearest_pixels(u, v, (3, 4))
    assert inside.tolist() == [True, True, True, True, False, True, False, False, False, False]
    assert index[inside].tolist() == [0, 1, 2, 8, 7]
    assert ((index >= 0) & (index < 12)).all(), "what lies outside has an index that can be read"


def test_outside_of_the_other_camera_there_is_nothing():
    K = np.diag([10.0, 10.0, 1.0])
    shifted = K + np.array([[0, 0, 2.0], [0, 0, 1.0], [0, 0, 0]])
    actual = resample_nearest(np.ones((2, 3)), K, shifted, (4, 6))
    expected = np.zeros((4, 6))
    expected[1:3, 2:5] = 1
    np.testing.assert_array_equal(actual, expected)


def test_scannet_depth_is_brought_to_the_colour_camera(tmp_path):
    path, of_color, _ = write_scannet(tmp_path, frames=2)
    sequence = open_sequence(path)
    frame = sequence[1]
    assert frame.depth.shape != frame.image.shape[:2]
    size, K = (
        (40, 54),
        Preprocess(size=(40, 54)).apply_intrinsics(torch.from_numpy(frame.intrinsics), *frame.image.shape[:2]),
    )
    actual = truth_at(frame, K.numpy(), size)
    expected = render(of_color.T_world_cam[1], K.numpy(), *size)
    both = actual > 0
    assert both.mean() > 0.85  # the depth camera has a slightly smaller field of view than the colour camera
    # Nearest pixels: exact except for the slope within a pixel and a few pixels at edges.
    off = np.abs(actual - expected)[both] / expected[both]
    assert np.quantile(off, 0.9) < 0.02
    assert np.median(off) < 0.006


def test_sigma_is_striped_where_nothing_was_compared():
    """A third of the uncompared pixels is grey; depth and other pixels keep their colours."""
    maps = {"depth": np.full((60, 80), 2.0), "sigma": np.full((60, 80), 0.3), "measured": np.ones((60, 80))}
    maps["measured"][:, :40] = 0.2
    panel = FramePanel("f", np.zeros((60, 80, 3), np.uint8), maps)
    depth, sigma = (column.rgb(panel) for column in map_columns([panel]))
    grey = (sigma == INVALID_GREY).all(-1)
    assert grey[:, :40].mean() == pytest.approx(1 / 3, abs=0.02)
    assert not grey[:, 40:].any()
    assert not (depth == INVALID_GREY).all(-1).any()


def test_the_shown_image_is_what_the_network_saw():
    image = np.dstack([np.mgrid[0:480, 0:640][0] // 2, np.mgrid[0:480, 0:640][1] // 3, np.zeros((480, 640))])
    K = torch.tensor([[500.0, 0, 320], [0, 500, 240], [0, 0, 1]], dtype=torch.float64)
    nyu = Preprocess.nyu()
    part = field_of_view(image.astype(np.uint8), K.numpy(), nyu.apply_intrinsics(K, 480, 640).numpy(), (224, 224))
    # 228 x 304 of 250 x 333 pixels, in image pixels.
    assert abs(part.shape[0] - 480 * 228 / 250) <= 1
    assert abs(part.shape[1] - 640 * 304 / 333) <= 1
    assert abs(int(part[0, 0, 0]) - 240 * 11 / 250) <= 1

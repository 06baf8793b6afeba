"""Preprocessing: re-projection of image, intrinsics and depth, agreement with Pillow, checks of the input."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from hypothesis import assume, example, given
from hypothesis import strategies as st
from PIL import Image
from torch import Tensor

from ufmstar_torch.gaussians.camera import unproject
from ufmstar_torch.models import Preprocess

NYU = Preprocess.nyu()
SIZES = [(480, 640), (360, 540), (968, 1296), (640, 480), (240, 320), (375, 1242), (100, 120)]
SIGMA = 4.0  # [px] radius of a blob in the network's image


def camera(height: int, width: int) -> Tensor:
    """Intrinsics [1, 3, 3] for the image size, with the principal point off the centre."""
    f = 0.9 * max(height, width)
    return torch.tensor([[[f, 0, width / 2 - 3.7], [0, 1.05 * f, height / 2 + 2.2], [0, 0, 1]]], dtype=torch.float64)


def project(point: Tensor, intrinsics: Tensor) -> Tensor:
    """[2] pixel (u, v) of a point [3] in the camera frame."""
    x = intrinsics[0] @ point
    return x[:2] / x[2]


def blob(height: int, width: int, centre: Tensor, radius: Tensor) -> Tensor:
    """[1, 3, H, W] a Gaussian blob in [0, 1] with ``centre`` (u, v) and standard deviations ``radius`` [px]."""
    u = torch.arange(width, dtype=torch.float64)
    v = torch.arange(height, dtype=torch.float64)
    gauss = torch.exp(-0.5 * ((u - centre[0]) / radius[0]) ** 2) * torch.exp(
        -0.5 * ((v[:, None] - centre[1]) / radius[1]) ** 2
    )
    return gauss.expand(1, 3, height, width)


def centroid(image: Tensor) -> Tensor:
    """[2] centre of mass (u, v) [px] of an image [1, 3, H, W]."""
    mass = image[0].sum(0)
    u = torch.arange(mass.shape[1], dtype=mass.dtype)
    v = torch.arange(mass.shape[0], dtype=mass.dtype)
    return torch.stack([(mass.sum(0) * u).sum(), (mass.sum(1) * v).sum()]) / mass.sum()


PRESETS = [
    NYU,
    Preprocess.nyu(size=(224, 320), antialias=False),
    Preprocess(size=(192, 256)),
    Preprocess(resize_height=300, crop=(224, 192)),
    Preprocess(),
]


@pytest.mark.parametrize("preprocess", PRESETS, ids=["nyu", "nyu_wide", "stretch", "crop_only", "none"])
@pytest.mark.parametrize("size", SIZES, ids=str)
def test_a_point_is_seen_where_the_new_intrinsics_project_it(preprocess: Preprocess, size: tuple[int, int]) -> None:
    """Image and intrinsics agree to .01 px (observed at most .008)."""
    K = camera(*size)
    final = preprocess.geometry(*size).final
    K_network = preprocess.apply_intrinsics(K, *size)
    where = torch.tensor([0.45 * final[1], 0.6 * final[0]], dtype=torch.float64)  # well inside
    point = torch.linalg.solve(K_network[0], torch.tensor([*where, 1.0], dtype=torch.float64)) * 2.5
    shrink = torch.stack([K[0, 0, 0] / K_network[0, 0, 0], K[0, 1, 1] / K_network[0, 1, 1]])
    image, K_returned = preprocess(blob(*size, project(point, K), SIGMA * shrink), K)
    assert image.shape == (1, 3, *final)
    torch.testing.assert_close(K_returned, K_network, rtol=0, atol=0)
    torch.testing.assert_close(centroid(image), project(point, K_returned), rtol=0, atol=0.01)


@given(height=st.integers(1, 2000), width=st.integers(1, 2000))
@example(height=480, width=640)
def test_the_crop_fits_into_every_image(height: int, width: int) -> None:
    assume(max(height, width) < 500 * min(height, width))  # a longer strip exceeds the limit of a resized image
    g = NYU.geometry(height, width)
    assert g.final == (224, 224)
    assert g.cropped == (228, 304)
    assert g.resized[0] >= 250 or abs(g.resized[1] - 304) <= 1
    assert min(g.resized[0] - 250, g.resized[1] - 304) <= 0  # no larger than necessary
    assert 0 <= g.top <= g.resized[0] - 228
    assert 0 <= g.left <= g.resized[1] - 304
    exact = max(250 / height, 304 / width)
    assert abs(g.resized[0] - exact * height) <= 1
    assert abs(g.resized[1] - exact * width) <= 1


def test_nyu_geometry_and_the_fields_formula() -> None:
    """480 x 640 -> 250 x 333, crop at (11, 14); f' exactly, c' up to the half pixel that the original formula
    ignores."""
    g = NYU.geometry(480, 640)
    assert (g.resized, g.top, g.left) == ((250, 333), 11, 14)
    fx, fy, cx, cy = 518.9, 519.5, 325.6, 253.7
    K = torch.tensor([[[fx, 0, cx], [0, fy, cy], [0, 0, 1]]], dtype=torch.float64)
    got = NYU.apply_intrinsics(K, 480, 640)[0]
    sx, sy = (333 / 640) * (224 / 304), (250 / 480) * (224 / 228)
    expected_f = torch.tensor([fx * sx, fy * sy], dtype=torch.float64)
    torch.testing.assert_close(got.diagonal()[:2], expected_f)
    simple = torch.tensor([(cx * 333 / 640 - 14) * 224 / 304, (cy * 250 / 480 - 11) * 224 / 228])
    assert (got[:2, 2] - simple).abs().max() < 0.5
    # The half-pixel rule, written out: borders at -1/2 map to borders.
    u = (((cx + 0.5) * 333 / 640 - 14) * 224 / 304) - 0.5
    v = (((cy + 0.5) * 250 / 480 - 11) * 224 / 228) - 0.5
    torch.testing.assert_close(got[:2, 2], torch.tensor([u, v], dtype=torch.float64))


@pytest.mark.parametrize("size", [(480, 640), (360, 540), (968, 1296)], ids=str)
def test_colour_is_resampled_as_pillow_does(size: tuple[int, int]) -> None:
    """Bytes differ from Pillow's by at most one level, in at most .9 % of the values. Without antialiasing the mean
    would be 13 to 24 levels on this noise."""
    generator = np.random.default_rng(0)
    array = generator.integers(0, 256, (*size, 3), dtype=np.uint8)
    g = NYU.geometry(*size)
    small = np.asarray(Image.fromarray(array).resize(g.resized[::-1], Image.Resampling.BILINEAR))
    cropped = small[g.top : g.top + g.cropped[0], g.left : g.left + g.cropped[1]]
    expected = np.asarray(Image.fromarray(cropped).resize(g.final[::-1], Image.Resampling.BILINEAR))
    got = NYU.apply_image(torch.from_numpy(array).permute(2, 0, 1)[None])[0].permute(1, 2, 0).numpy() * 255
    difference = np.abs(got - expected.astype(np.float32))
    assert difference.max() <= 1
    assert difference.mean() < 0.01


def test_depth_pixels_are_the_ones_seen() -> None:
    """A plane's preprocessed depth unprojects to the same plane with the new intrinsics."""
    size = (360, 540)
    K = camera(*size)
    n, offset = torch.tensor([0.2, -0.3, 1.0], dtype=torch.float64), 2.0
    ray = unproject(torch.ones(1, *size, dtype=torch.float64), K)
    depth = offset / (ray @ n)
    carried = NYU.apply_depth(depth)
    points = unproject(carried, NYU.apply_intrinsics(K, *size))
    # The nearest source pixel is at most half a pixel away: .5 px / f at the plane's slope.
    bound = 0.5 / float(K[0, 0, 0]) * float(depth.max()) * (0.2 + 0.3)
    error = (points @ n - offset).abs().max()
    assert 0 < error < bound
    assert set(carried.flatten().tolist()) <= set(depth.flatten().tolist())  # copied, never mixed


def test_bytes_and_floats_agree_and_are_scaled() -> None:
    image = torch.randint(0, 256, (2, 3, 300, 400), dtype=torch.uint8, generator=torch.Generator().manual_seed(0))
    unit = NYU.apply_image(image)
    assert 0 <= unit.min() <= unit.max() <= 1
    torch.testing.assert_close(NYU.apply_image(image.double() / 255).float(), unit, rtol=0, atol=2 / 255)
    mean, std = (0.485, 0.456, 0.406), (0.229, 0.224, 0.225)
    got = Preprocess.nyu(value_range=255.0, mean=mean, std=std).apply_image(image)
    for channel in range(3):
        torch.testing.assert_close(got[:, channel], (255 * unit[:, channel] - mean[channel]) / std[channel])


@pytest.mark.parametrize("size", [(480, 640), (375, 1242), (100, 120)])
@pytest.mark.parametrize("preprocess", [NYU, Preprocess(size=(224, 224)), Preprocess(crop=(64, 96)), Preprocess()])
def test_bytes_stay_bytes_whatever_their_layout(size, preprocess):
    """Observed differences to floats: at most 1.6 of 255 levels, from rounding to bytes after each resize."""
    image = torch.randint(0, 256, (2, *size, 3), generator=torch.Generator().manual_seed(1), dtype=torch.uint8)
    image = image.permute(0, 3, 1, 2)
    small = preprocess.apply_image(image)
    assert small.is_contiguous()
    torch.testing.assert_close(255 * small, (255 * small).round(), rtol=0, atol=1e-4)
    torch.testing.assert_close(small, preprocess.apply_image(image / 255), rtol=0, atol=2 / 255)
    torch.testing.assert_close(small, preprocess.apply_image(image.contiguous()), rtol=0, atol=0)
    torch.testing.assert_close(small[1:], preprocess.apply_image(image[1:]), rtol=0, atol=0)

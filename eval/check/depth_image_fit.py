"""Checks that depth maps are registered to their images: compares depth edges, also displaced, with image edges."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from scipy.ndimage import gaussian_filter

from ufmstar_torch.eval.sequences.ground_truth import resample_nearest

# A pixel is a depth edge if its inverse depth exceeds the mean of its neighbours on both sides by this share. Planes
# are linear in inverse depth, so a slanted plane has no edge.
_EDGE_JUMP = 0.05
_EDGE_REACH = 3  # [px] Kinect-type depth blurs an edge over that many pixels
_IMAGE_SIGMA = 1.5  # [px]
_POINTS_PER_FRAME = 1000
# Displacements: zoom about the image's centre (7-Scenes' depth needs 0.9), and shifts as a share of the width (19 px of
# 640 to the left and right, 2.5 cm at 0.7 m; half of it up and down).
_ZOOMS = np.arange(0.86, 1.141, 0.02)
_SHIFT, _SHIFT_STEP = 0.0375, 0.0047
# Predicted maps are blurred: they are judged only with so many edges and so much contrast. The largest quality, and the
# least zoom, of maps that show a part of the image (``pytest -m slow -s tests/test_mistakes_images.py -k middle``).
_PART, _PART_EDGES, _PART_CONTRAST, _PART_ZOOM = 0.35, 3000, 0.05, 0.06


@dataclass(frozen=True)
class DepthImageFit:
    """The agreement of depth edges with image edges, and the best displacement of the depth map."""

    quality: float  # (undisplaced - median) / (best - median) of the mean gradient ranks; NaN without edges
    # Mean gradient rank (0 to 1) at the best displacement minus the median; small if image edges are everywhere, so
    # that the fit is undetermined.
    contrast: float
    zoom: float  # best zoom about the centre
    shift_x: float  # best shift after the zoom [px]
    shift_y: float
    edges: int  # number of edge pixels


def depth_image_fit(frames: Iterable[tuple[np.ndarray, np.ndarray]]) -> DepthImageFit:
    """The fit over pairs of an image [H, W, 3] uint8 and a depth map [H, W] [m] (0 = invalid). Each depth edge scores
    the rank of the image gradient at its pixel, for each displacement; the gradient itself would be dominated by lamps.
    Observed quality: at least 0.5 on registered recordings, at most 0.2 with 7-Scenes' unregistered geometry."""
    sums: list[np.ndarray] = []
    edges, width = 0, 1
    for image, depth in frames:
        rank = _gradient_rank(image)
        v, u = _sample(depth_edges(depth))
        width = depth.shape[1]
        dx, dy = _shifts(width)
        sums.append(np.array([_scores(rank, v, u, zoom, dx, dy) for zoom in _ZOOMS]))
        edges += len(v)
    if edges == 0:
        return DepthImageFit(float("nan"), 0.0, 1.0, 0.0, 0.0, 0)
    total, count = np.sum(sums, axis=0).swapaxes(0, 1)
    mean = total / np.maximum(count, 1)
    dx, dy = _shifts(width)
    best = np.unravel_index(np.argmax(mean), mean.shape)
    unshifted = mean[np.argmin(np.abs(_ZOOMS - 1)), len(dy) // 2, len(dx) // 2]
    typical = np.median(mean)
    contrast = mean.max() - typical
    quality = (unshifted - typical) / max(contrast, 1e-12)
    return DepthImageFit(
        float(quality), float(contrast), float(_ZOOMS[best[0]]), float(dx[best[2]]), float(dy[best[1]]), edges
    )


def part_of_image(frames: Iterable[tuple[np.ndarray, np.ndarray]]) -> str:
    """A problem where predicted maps look as if they showed a part of their images, or more than these; else ""."""
    fit = depth_image_fit(frames)
    clear = fit.edges >= _PART_EDGES and fit.contrast >= _PART_CONTRAST and fit.quality < _PART
    if not clear or abs(fit.zoom - 1) < _PART_ZOOM:
        return ""
    shown = "only the middle of the image" if fit.zoom < 1 else "more than the image"
    return (
        f"edges of the depth maps do not lie on edges of the images: the maps seem to show {shown} (--map-intrinsics)"
    )


def image_at_map(image: np.ndarray, K_image: np.ndarray, K_map: np.ndarray, size: tuple[int, int]) -> np.ndarray:
    """[h, w, 1] the brightness of an image [H, W, 3] at the pixels of a map of ``size`` (h, w)."""
    H_image_map = K_image @ np.linalg.inv(K_map)
    blur = 0.5 * max(H_image_map[0, 0], H_image_map[1, 1])  # pixels of the image within one of the map
    grey = gaussian_filter(image.astype(np.float32).mean(axis=2), blur)
    return resample_nearest(grey, K_image, K_map, size)[..., None]


def depth_edges(depth: np.ndarray) -> np.ndarray:
    """[H, W] bool: pixels on the near side of a discontinuity of depth [H, W] [m] (0 = invalid)."""
    inverse = np.where(depth > 0, 1 / np.where(depth > 0, depth, 1), np.nan)
    edge = np.zeros(depth.shape, dtype=bool)
    r = _EDGE_REACH
    for along in (inverse, inverse.T):
        middle = along[r:-r]
        out = edge if along is inverse else edge.T
        out[r:-r] |= 2 * middle - along[: -2 * r] - along[2 * r :] > _EDGE_JUMP * middle  # False at NaN
    return edge


def _gradient_rank(image: np.ndarray) -> np.ndarray:
    grey = gaussian_filter(image.astype(np.float32).mean(axis=2), _IMAGE_SIGMA)
    strength = np.hypot(*np.gradient(grey))
    rank = np.empty(strength.size, dtype=np.float32)
    rank[np.argsort(strength, axis=None)] = np.linspace(0, 1, strength.size, dtype=np.float32)
    return rank.reshape(strength.shape)


def _sample(edge: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    v, u = np.nonzero(edge)
    keep = np.unique(np.linspace(0, max(len(v) - 1, 0), min(len(v), _POINTS_PER_FRAME)).astype(int))
    return v[keep], u[keep]


def _shifts(width: int) -> tuple[np.ndarray, np.ndarray]:
    """Shifts along x and y [px], both with 0 in the middle."""
    step = max(1, round(_SHIFT_STEP * width))
    steps = max(1, round(_SHIFT * width / step))
    return step * np.arange(-steps, steps + 1), step * np.arange(-(steps // 2), steps // 2 + 1)


def _scores(
    rank: np.ndarray, v: np.ndarray, u: np.ndarray, zoom: float, dx: np.ndarray, dy: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Summed rank and number of points inside the image, [len(dy), len(dx)] each."""
    height, width = rank.shape
    x = np.rint((u - (width - 1) / 2) * zoom + (width - 1) / 2).astype(int)[None, None, :] + dx[None, :, None]
    y = np.rint((v - (height - 1) / 2) * zoom + (height - 1) / 2).astype(int)[None, None, :] + dy[:, None, None]
    inside = (x >= 0) & (x < width) & (y >= 0) & (y < height)
    values = rank[np.clip(y, 0, height - 1), np.clip(x, 0, width - 1)]
    return (values * inside).sum(axis=-1), inside.sum(axis=-1)

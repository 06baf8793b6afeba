"""Anchors: sparse metric depths with variances, from landmarks, a range sensor or a tracker.

Multiview disagreement cannot detect an error that all views share. An anchor measures the prediction's error at its
pixel. ``evidence`` describes how these errors are accumulated and spread over the image.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import torch
from torch import Tensor

from ufmstar_torch.frames.arguments import require_float
from ufmstar_torch.gaussians.fixed_order import apply
from ufmstar_torch.runtime.kinds import check_kinds

_UNCHECKED = torch.empty(0)


@dataclass(frozen=True)
class Anchors:
    """Sparse depths of one frame, padded to N per stream.

    A few hundred are enough. Time and memory grow with N on the CPU. Other devices compare all pairs, so both grow with
    N^2, to gigabytes at 10 000.

    Attributes:
        pixel: [B, N, 2] position (u, v) in the depth map, first pixel's centre at (0, 0) [px].
        depth: [B, N] along the optical axis [m].
        variance: [B, N] of ``depth`` [m^2].
        valid: [B, N] bool, True = use; None = all.
        pose_error: [B] standard deviation of matches from the epipolar lines of the poses [px]; NaN = not measured,
            None = unknown.
        shared: [B] variance of the inverse-depth error that all anchors of the frame share, as from wrong poses
            [1/m^2]; None = 0.
        scale: [B] variance of the logarithm of a factor that all depths of the frame share; None = 0.
        motion: [B, M, 3] pixels (u, v) all over the depth map [px], and the log likelihood ratio of motion there, for
            depths that matching of images has measured; NaN = unknown, None = the depths hold for moving things, too.
        moving: [B] int64, number of depths that were not used because the surface moves, or because views disagree;
            None = not counted.

    The check of a frame (:func:`~ufmstar_torch.anchors.check.check_anchors`) converts them to float64, replaces values
    where they are not valid (position 0, depth 1, variance 0), and adds what the frame has at their pixels, which is
    empty before:

    Attributes:
        index: [B, N] int64 of the pixel in the flattened image.
        predicted: [B, N] the network's depth at the pixel [m]; 1 where not valid.
        network_variance: [B, N] variance that the network predicts at the pixel, A + E as far as they are used [m^2].
        rejected: [B] number of anchors that only their ratio to the prediction makes invalid.
        contradiction: [B] mean r^2 of the rejected anchors, r at most 100, where they outnumber the valid ones and
            therefore measure the prediction's error; else 0.
    """

    pixel: Tensor
    depth: Tensor
    variance: Tensor
    valid: Tensor | None = None
    pose_error: Tensor | None = None
    shared: Tensor | None = None
    scale: Tensor | None = None
    motion: Tensor | None = None
    moving: Tensor | None = None
    index: Tensor = _UNCHECKED
    predicted: Tensor = _UNCHECKED
    network_variance: Tensor = _UNCHECKED
    rejected: Tensor = _UNCHECKED
    contradiction: Tensor = _UNCHECKED

    @classmethod
    @check_kinds
    def from_points(cls, points_cam: Tensor, variance: Tensor, intrinsics: Tensor, size: tuple[int, int]) -> Anchors:
        """Convert points in the camera frame, such as landmarks of a map or returns of a range sensor, to anchors.

        A point is invalid if it lies behind the camera or outside the image, or if a value is not finite. Rows of
        different lengths may be padded with NaN. Occlusion is not tested: pass only points that the camera sees.

        Args:
            points_cam: [B, N, 3], x right, y down, z forward [m].
            variance: [B, N] of z [m^2].
            intrinsics: [B, 3, 3] or [3, 3] of the depth map [px].
            size: (H, W) of the depth map [px].

        Raises:
            TypeError: the points or the variance have no floating dtype.
            ValueError: a shape is wrong.
        """
        points = require_float("points_cam", points_cam).detach().double()
        if points.dim() != 3 or points.shape[2] != 3:
            raise ValueError(f"points_cam must be [B, N, 3], got {tuple(points.shape)}")
        b, n, _ = points.shape
        sigma2 = require_float("variance", variance, [(b, n)]).detach().double()
        K = require_float("intrinsics", intrinsics, [(3, 3), (b, 3, 3)]).detach().double().to(points.device)
        z = points[..., 2]
        usable = points.isfinite().all(-1) & (z > 0) & sigma2.isfinite() & (sigma2 >= 0)
        safe = torch.where(usable[..., None], points, torch.ones_like(points))
        pixel = apply(K.expand(b, 3, 3)[:, None], safe)[..., :2] / safe[..., 2:]
        usable = usable & inside(pixel, size)
        zero = torch.zeros_like(z)
        return cls(
            torch.where(usable[..., None], pixel, torch.zeros_like(pixel)),
            torch.where(usable, z, zero),
            torch.where(usable, sigma2, zero),
            usable,
        )

    @property
    def mask(self) -> Tensor:
        """[B, N] ``valid``, all True for None."""
        return torch.ones_like(self.depth, dtype=torch.bool) if self.valid is None else self.valid

    @check_kinds
    def moved(self, K_from: Tensor, K_to: Tensor) -> Anchors:
        """Map the anchors to the pixels of a resized or cropped image of the same camera.

        Args:
            K_from: [B, 3, 3] or [3, 3] of the present image [px].
            K_to: [B, 3, 3] or [3, 3] of the resized or cropped image [px].

        Raises:
            TypeError: ``pixel`` has no floating dtype.
            ValueError: ``pixel`` is not [B, N, 2].
        """
        pixel = require_float("anchors.pixel", self.pixel)
        if pixel.dim() != 3 or pixel.shape[2] != 2:
            raise ValueError(f"anchors.pixel must be [B, N, 2], got {tuple(pixel.shape)}")
        at, before, after = (_numbers(value, pixel.device) for value in (pixel, K_from, K_to))
        scale = after[..., (0, 1), (0, 1)] / before[..., (0, 1), (0, 1)]
        offset = after[..., :2, 2] - scale * before[..., :2, 2]
        scale, offset, motion = scale[..., None, :], offset[..., None, :], self.motion
        if motion is not None:
            placed = _numbers(motion, pixel.device) + 0
            placed[..., :2] = placed[..., :2] * scale + offset
            motion = torch.as_tensor(placed)
        return replace(self, pixel=torch.as_tensor(at * scale + offset), motion=motion)

    def to(self, device: torch.device | str) -> Anchors:
        """The anchors on a device."""
        if self.pixel.device == torch.device(device):
            return self
        moved = {name: value.to(device) for name, value in vars(self).items() if value is not None}
        return replace(self, **moved)


def _numbers(value: Tensor, device: torch.device) -> Any:
    """float64 values on a device, on the CPU as an array: small tensors take a few times longer."""
    value = value.detach().to(device, torch.float64)
    return value.numpy() if value.is_cpu else value


def require_anchors(anchors: object) -> Anchors:
    """Return ``anchors`` if it is :class:`Anchors`.

    Raises:
        TypeError: ``anchors`` is something else.
    """
    if not isinstance(anchors, Anchors):
        raise TypeError(f"anchors must be Anchors or None, got {type(anchors).__name__}")
    return anchors


def inside(pixel: Tensor, size: tuple[int, int]) -> Tensor:
    """[B, N] True where the pixel nearest to a position [B, N, 2] lies in an image of ``size`` (H, W)."""
    u, v = pixel.round().unbind(-1)
    return (u >= 0) & (u < size[1]) & (v >= 0) & (v < size[0])

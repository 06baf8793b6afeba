"""Anchors: sparse metric depths with variances, from landmarks, a range sensor or a tracker.

Multiview disagreement cannot detect an error that all views share. An anchor measures the prediction's error at its
pixel. ``evidence`` describes how these errors are accumulated and spread over the image.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from ufmstar_torch.frames.arguments import require_float, require_mask
from ufmstar_torch.frames.frame import AnchorInput, FrameInput
from ufmstar_torch.gaussians.camera import focal_and_centre
from ufmstar_torch.gaussians.fixed_order import apply

# Largest factor between an anchor and the prediction. A single anchor beyond it would dominate the mean of all others,
# and larger values overflow in the state. More than FEW such anchors, if they outnumber the valid ones, show that the
# prediction is wrong.
FARTHEST_OFF, FEW = 100.0, 3


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

    @classmethod
    def from_points(
        cls,
        points_cam: Tensor,
        variance: Tensor,
        intrinsics: Tensor,
        size: tuple[int, int],
        valid: Tensor | None = None,
    ) -> Anchors:
        """Convert points in the camera frame, such as landmarks of a map or returns of a range sensor, to anchors.

        A point is invalid if it lies behind the camera or outside the image, or if a value is not finite. Rows of
        different lengths may be padded with NaN. Occlusion is not tested: pass only points that the camera sees.

        Args:
            points_cam: [B, N, 3], x right, y down, z forward [m].
            variance: [B, N] of z [m^2].
            intrinsics: [B, 3, 3] or [3, 3] of the depth map [px].
            size: (H, W) of the depth map [px].
            valid: [B, N] bool, True = use; None = all.

        Raises:
            TypeError: the points or the variance have no floating dtype, or ``valid`` is not bool.
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
        if valid is not None:
            usable = usable & require_mask("valid", valid, [(b, n)])
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

    def moved(self, K_from: Tensor, K_to: Tensor) -> Anchors:
        """Map the anchors to the pixels of a resized or cropped image of the same camera.

        Args:
            K_from: [B, 3, 3] or [3, 3] of the present image [px].
            K_to: [B, 3, 3] or [3, 3] of the resized or cropped image [px].

        Raises:
            TypeError: ``pixel`` has no floating dtype.
            ValueError: ``pixel`` is not [B, N, 2].
        """
        pixel = require_float("anchors.pixel", self.pixel).detach().double()
        if pixel.dim() != 3 or pixel.shape[2] != 2:
            raise ValueError(f"anchors.pixel must be [B, N, 2], got {tuple(pixel.shape)}")
        (fx, fy, cx, cy), (fx_to, fy_to, cx_to, cy_to) = (
            focal_and_centre(K.detach().double().to(pixel.device)) for K in (K_from, K_to)
        )
        scale = torch.stack([fx_to / fx, fy_to / fy], -1)[..., None, :]
        offset = torch.stack([cx_to, cy_to], -1)[..., None, :] - scale * torch.stack([cx, cy], -1)[..., None, :]
        motion = self.motion
        if motion is not None:
            motion = torch.cat([motion[..., :2] * scale + offset, motion[..., 2:]], -1)
        return replace(self, pixel=pixel * scale + offset, motion=motion)

    def to(self, device: torch.device | str) -> Anchors:
        """The anchors on a device."""
        if self.pixel.device == torch.device(device):
            return self
        moved = {name: value.to(device) for name, value in vars(self).items() if value is not None}
        return replace(self, **moved)


# Pixel, depth and variance, the mask of usable anchors, and the frame -> the first columns of ``AnchorInput``: pixel,
# index, predicted, depth, variance, valid, rejected and contradiction.
Checked = tuple[Tensor, Tensor, Tensor, Tensor, Tensor, Tensor, Tensor, Tensor]
CheckAnchors = Callable[[Tensor, Tensor, Tensor, Tensor | None, FrameInput], Checked]


def check_anchor_values(
    pixel: Tensor, depth: Tensor, variance: Tensor, mask: Tensor | None, frame: FrameInput
) -> Checked:  # fmt: skip
    """Check the values of anchors: pixel [B, N, 2] [px], depth [B, N] [m], variance [B, N] [m^2], all float64, and mask
    [B, N] or None; the caller has checked shapes and dtypes."""
    # Standard deviations are compared, as the square of a large depth overflows.
    usable = (depth > 0) & (depth < torch.inf) & (variance >= 0) & (variance.sqrt() < depth) & inside(pixel, frame.size)
    if mask is not None:
        usable = usable & mask
    one, zero = torch.ones_like(depth), torch.zeros_like(depth)
    pixel = torch.where(usable[..., None], pixel, zero[..., None])
    u, v = pixel.round().long().unbind(-1)
    index = v * frame.size[1] + u
    predicted = torch.gather(frame.depth.flatten(1), 1, index).double()
    usable = usable & torch.gather(frame.valid.flatten(1), 1, index)
    near = (depth <= FARTHEST_OFF * predicted) & (predicted <= FARTHEST_OFF * depth)
    valid, far = usable & near, usable & ~near
    rejected = far.sum(1)
    square = torch.where(far, (depth / predicted - 1).clamp_max(FARTHEST_OFF).square(), zero).sum(1)
    many = (rejected > FEW) & (rejected > valid.sum(1))
    contradiction = torch.where(many, square / rejected.clamp_min(1), torch.zeros_like(square))
    predicted, depth = torch.where(valid, predicted, one), torch.where(valid, depth, one)
    return pixel, index, predicted, depth, torch.where(valid, variance, zero), valid, rejected, contradiction


def check_anchors(
    anchors: Anchors,
    frame: FrameInput,
    network_variances: Sequence[Tensor] = (),
    kernel: CheckAnchors = check_anchor_values,
) -> AnchorInput:
    """Check the anchors of one frame and convert them to float64 on the depth's device.

    An anchor is invalid if a value is impossible, if it lies outside the image or on a pixel without depth, if its
    standard deviation reaches its depth, or if its depth differs from the prediction by more than a factor of 100.

    Args:
        anchors: see :class:`Anchors`.
        frame: of the same B streams.
        network_variances: the network's variances in use, of A and E, each [B, H, W] [m^2].
        kernel: an implementation of :func:`check_anchor_values`.

    Raises:
        TypeError: ``anchors`` is no :class:`Anchors`, or a field is no tensor or has the wrong kind of dtype.
        ValueError: a field has the wrong shape or device.
    """
    b = frame.depth.shape[0]
    anchors = require_anchors(anchors)
    pixel = require_float("anchors.pixel", anchors.pixel, like=frame.depth).detach().double()
    if pixel.dim() != 3 or pixel.shape[0] != b or pixel.shape[2] != 2:
        raise ValueError(f"anchors.pixel must be [{b}, N, 2], got {tuple(pixel.shape)}")
    shape = [(b, pixel.shape[1])]
    depth = require_float("anchors.depth", anchors.depth, shape, frame.depth).detach().double()
    variance = require_float("anchors.variance", anchors.variance, shape, frame.depth).detach().double()
    mask = anchors.valid
    if mask is not None:
        mask = require_mask("anchors.valid", mask, shape, frame.depth)
    for name in ("pose_error", "shared", "scale"):
        if (value := getattr(anchors, name)) is not None:
            require_float(f"anchors.{name}", value, [(b,)], frame.depth)
    motion = anchors.motion
    if motion is not None:
        motion = require_float("anchors.motion", motion, like=frame.depth).detach().double()
        if motion.dim() != 3 or motion.shape[0] != b or motion.shape[2] != 3:
            raise ValueError(f"anchors.motion must be [{b}, M, 3], got {tuple(motion.shape)}")
    pixel, index, predicted, depth, variance, valid, rejected, contradiction = kernel(
        pixel, depth, variance, mask, frame
    )
    predicted_variance = torch.zeros_like(depth)
    if network_variances:
        predicted_variance = torch.where(valid, _variance_at(network_variances, index), predicted_variance)
    return AnchorInput(
        pixel, index, predicted, depth, variance, predicted_variance, valid, rejected, contradiction,
        pose_error=anchors.pose_error,
        shared=anchors.shared,
        scale=anchors.scale,
        motion=motion,
        moving=anchors.moving,
    )  # fmt: skip


def _variance_at(network_variances: Sequence[Tensor], index: Tensor) -> Tensor:
    """[B, N] float64 sum of the maps ``network_variances`` [B, H, W] at pixels ``index``."""
    total, *others = (torch.gather(value.detach().flatten(1), 1, index) for value in network_variances)
    for other in others:
        total = total + other
    return total.double()


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

"""Anchors: a few metric depths with a variance of their own, from landmarks, a range sensor or a tracker.

Multiview disagreement cannot see an error on which all views agree. An anchor can: where one lies, the error of the
prediction is known. ``evidence`` says what is learnt from that, and how it is spread over the image.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from ufmstar_torch.arguments import require_float, require_mask
from ufmstar_torch.fixed_order import apply, product
from ufmstar_torch.frame import FrameInput

# An anchor whose standard deviation is as large as its depth, or that is off from the prediction by a factor like this,
# measures nothing: one alone would decide the mean of all others, and larger values overflow in the state. More than
# FEW of them, and more than there are others, measure that the prediction is wrong.
FARTHEST_OFF, FEW = 100.0, 3


@dataclass(frozen=True)
class Anchors:
    """Sparse depths of one frame, padded to N per stream.

    Some hundred are enough. On the CPU time and memory grow with N; elsewhere each is compared with all others, and
    they grow with N^2, to gigabytes at 10 000.

    Attributes:
        pixel: [B, N, 2] position (u, v) in the depth map, first pixel's centre at (0, 0) [px].
        depth: [B, N] along the optical axis [m].
        variance: [B, N] of ``depth`` [m^2].
        valid: [B, N] bool, True = use; None = all.
        pose_error: [B] by how much the poses disagree with the images, a standard deviation [px], NaN = not measured;
            None = by nothing that is known.
        shared: [B] variance of inverse depths by an error that all anchors of the frame have in common, as wrong poses
            make [1/m^2]; None = 0.
        scale: [B] variance of the logarithm of a factor that all depths of the frame have in common; None = 0.
    """

    pixel: Tensor
    depth: Tensor
    variance: Tensor
    valid: Tensor | None = None
    pose_error: Tensor | None = None
    shared: Tensor | None = None
    scale: Tensor | None = None

    @classmethod
    def from_points(
        cls,
        points_cam: Tensor,
        variance: Tensor,
        intrinsics: Tensor,
        size: tuple[int, int],
        valid: Tensor | None = None,
    ) -> Anchors:
        """Points in the camera's frame, landmarks of a map or returns of a range sensor, as anchors.

        A point behind the camera, beside the image or with a value that is not finite is not valid: rows of different
        lengths may be padded with NaN. What hides a point is not known here: give those that the camera sees.

        Args:
            points_cam: [B, N, 3], x right, y down, z forward [m].
            variance: [B, N] of z [m^2].
            intrinsics: [B, 3, 3] or [3, 3] of the depth map [px].
            size: (H, W) of the depth map [px].
            valid: [B, N] bool, True = use; None = all.

        Raises:
            TypeError: points or variance are not of a floating dtype, or ``valid`` is not bool.
            ValueError: a wrong shape.
        """
        points = require_float("points_cam", points_cam).detach().double()
        if points.dim() != 3 or points.shape[2] != 3:
            raise ValueError(f"points_cam must be [B, N, 3], got {tuple(points.shape)}")
        b, n, _ = points.shape
        spread = require_float("variance", variance, [(b, n)]).detach().double()
        K = require_float("intrinsics", intrinsics, [(3, 3), (b, 3, 3)]).detach().double().to(points.device)
        z = points[..., 2]
        fine = points.isfinite().all(-1) & (z > 0) & spread.isfinite() & (spread >= 0)
        if valid is not None:
            fine = fine & require_mask("valid", valid, [(b, n)])
        safe = torch.where(fine[..., None], points, torch.ones_like(points))
        pixel = apply(K.expand(b, 3, 3)[:, None], safe)[..., :2] / safe[..., 2:]
        fine = fine & _inside(pixel, size)
        zero = torch.zeros_like(z)
        return cls(
            torch.where(fine[..., None], pixel, torch.zeros_like(pixel)),
            torch.where(fine, z, zero),
            torch.where(fine, spread, zero),
            fine,
        )

    def moved(self, K_from: Tensor, K_to: Tensor) -> Anchors:
        """The same anchors in the pixels of an image of the same camera that was resized or cropped.

        Args:
            K_from: [B, 3, 3] or [3, 3] of the image in whose pixels they are [px].
            K_to: likewise, of the other one.

        Raises:
            TypeError: ``pixel`` is not of a floating dtype.
            ValueError: ``pixel`` is not [B, N, 2].
        """
        pixel = require_float("anchors.pixel", self.pixel).detach().double()
        if pixel.dim() != 3 or pixel.shape[2] != 2:
            raise ValueError(f"anchors.pixel must be [B, N, 2], got {tuple(pixel.shape)}")
        # inv_ex does not wait for a device; of intrinsics that make no sense, what comes out is not finite.
        mapping = product(K_to.detach().double(), torch.linalg.inv_ex(K_from.detach().double().to(K_to.device)).inverse)
        mapping = mapping.to(pixel.device)
        return replace(self, pixel=apply(mapping[..., None, :2, :2], pixel) + mapping[..., None, :2, 2])

    def to(self, device: torch.device | str) -> Anchors:
        """The same on another device."""
        moved = {name: value.to(device) for name, value in vars(self).items() if value is not None}
        return replace(self, **moved)


@dataclass(frozen=True)
class AnchorInput:
    """Checked anchors, and the frame's values where they lie.

    Attributes:
        pixel: [B, N, 2] position (u, v) [px], 0 where not inside the image or impossible.
        index: [B, N] int64 of the pixel, in the flattened image.
        predicted: [B, N] the network's depth there [m]; 1 where not valid.
        depth, variance: [B, N] as given [m], [m^2]; 1 and 0 where not valid.
        own_variance: [B, N] what the network itself claims there, A + E as far as they are used [m^2].
        valid: [B, N] bool: finite, depth > 0, 0 <= variance < depth^2, off from the prediction by a factor of at most
            100, on a valid pixel, not masked.
        rejected: [B] anchors that would be valid, but are off by more; None = not counted.
        contradiction: [B] mean of their r^2, at most 100^2, where they are more than the valid ones: then they are no
            outliers, and show the error; else 0. None likewise.
        pose_error, shared, scale: [B] as in :class:`Anchors`.
    """

    pixel: Tensor
    index: Tensor
    predicted: Tensor
    depth: Tensor
    variance: Tensor
    own_variance: Tensor
    valid: Tensor
    rejected: Tensor | None = None
    contradiction: Tensor | None = None
    pose_error: Tensor | None = None
    shared: Tensor | None = None
    scale: Tensor | None = None


def check_anchors(anchors: Anchors, frame: FrameInput, network_variances: Sequence[Tensor] = ()) -> AnchorInput:
    """Anchors of one frame, ready to be used; in float64 on the depth's device.

    An anchor is not valid whose values are impossible, which lies beside the image or on a pixel without a depth, whose
    standard deviation is as large as its depth, or whose depth is off from the prediction by a factor of 100.

    Args:
        anchors: see :class:`Anchors`.
        frame: B streams, the same.
        network_variances: the network's own variances that count, A and E, each [B, H, W] [m^2].

    Raises:
        TypeError: something else than anchors; a field is no tensor or of the wrong kind of dtype.
        ValueError: a field has the wrong shape or lies on another device.
    """
    b = frame.depth.shape[0]
    anchors = require_anchors(anchors)
    pixel = require_float("anchors.pixel", anchors.pixel, like=frame.depth).detach().double()
    if pixel.dim() != 3 or pixel.shape[0] != b or pixel.shape[2] != 2:
        raise ValueError(f"anchors.pixel must be [{b}, N, 2], got {tuple(pixel.shape)}")
    shape = [(b, pixel.shape[1])]
    depth = require_float("anchors.depth", anchors.depth, shape, frame.depth).detach().double()
    variance = require_float("anchors.variance", anchors.variance, shape, frame.depth).detach().double()
    # Compared as standard deviations: the square of a large depth overflows.
    usable = (
        (depth > 0) & (depth < torch.inf) & (variance >= 0) & (variance.sqrt() < depth) & _inside(pixel, frame.size)
    )
    if anchors.valid is not None:
        usable = usable & require_mask("anchors.valid", anchors.valid, shape, frame.depth)
    for name in ("pose_error", "shared", "scale"):
        if (of_frame := getattr(anchors, name)) is not None:
            require_float(f"anchors.{name}", of_frame, [(b,)], frame.depth)
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
    return AnchorInput(
        pixel=pixel,
        index=index,
        predicted=torch.where(valid, predicted, one),
        depth=torch.where(valid, depth, one),
        variance=torch.where(valid, variance, zero),
        own_variance=torch.where(valid, _claimed(network_variances, index, zero), zero),
        valid=valid,
        rejected=rejected,
        contradiction=torch.where(many, square / rejected.clamp_min(1), torch.zeros_like(square)),
        pose_error=anchors.pose_error,
        shared=anchors.shared,
        scale=anchors.scale,
    )


def _claimed(network_variances: Sequence[Tensor], index: Tensor, none: Tensor) -> Tensor:
    """[B, N] float64 the sum of the maps ``network_variances`` [B, H, W] at pixels ``index``, ``none`` without maps."""
    if not network_variances:
        return none
    total, *others = (torch.gather(value.detach().flatten(1), 1, index) for value in network_variances)
    for other in others:
        total = total + other
    return total.double()


def require_anchors(anchors: object) -> Anchors:
    """The argument ``anchors``.

    Raises:
        TypeError: it is something else.
    """
    if not isinstance(anchors, Anchors):
        raise TypeError(f"anchors must be Anchors or None, got {type(anchors).__name__}")
    return anchors


def _inside(pixel: Tensor, size: tuple[int, int]) -> Tensor:
    """[B, N] whether the pixel [B, N, 2] nearest to a position belongs to an image of ``size`` (H, W)."""
    u, v = pixel.round().unbind(-1)
    return (u >= 0) & (u < size[1]) & (v >= 0) & (v < size[0])

"""Anchors: a few metric depths with a variance of their own, from landmarks, a range sensor or a tracker.

Multiview disagreement cannot see an error on which all views agree. An anchor can: where one lies, the error of the
prediction is known. ``evidence`` says what is learnt from that, and how it is spread over the image.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from ufmstar_torch.frame import FrameInput


@dataclass(frozen=True)
class Anchors:
    """Sparse depths of one frame, padded to N per stream.

    Attributes:
        pixel: [B, N, 2] position (u, v) in the depth map, first pixel's centre at (0, 0) [px].
        depth: [B, N] along the optical axis [m].
        variance: [B, N] of ``depth`` [m^2].
        valid: [B, N] bool, True = use; None = all.
    """

    pixel: Tensor
    depth: Tensor
    variance: Tensor
    valid: Tensor | None = None


@dataclass(frozen=True)
class AnchorInput:
    """Checked anchors, and what the frame says where they lie.

    Attributes:
        pixel: [B, N, 2] position (u, v) [px], 0 where not finite.
        index: [B, N] int64 of the pixel, in the flattened image.
        predicted: [B, N] the network's depth there [m]; 1 where not valid.
        depth, variance: [B, N] as given [m], [m^2]; 1 and 0 where not valid.
        own_variance: [B, N] what the network itself claims there, A + E as far as they are used [m^2].
        valid: [B, N] bool: finite, depth > 0, variance >= 0, on a valid pixel, not masked.
    """

    pixel: Tensor
    index: Tensor
    predicted: Tensor
    depth: Tensor
    variance: Tensor
    own_variance: Tensor
    valid: Tensor


def check_anchors(anchors: Anchors, frame: FrameInput, own_variance: Tensor | None) -> AnchorInput:
    """Anchors of one frame, ready to be used; in float64 on the depth's device.

    An anchor whose values make no sense, or that lies beside the image or on a pixel without a depth, is not valid.

    Args:
        anchors: see :class:`Anchors`.
        frame: B streams, the same.
        own_variance: [B, H, W] A + E [m^2], or None.

    Raises:
        TypeError: a field is no tensor or of the wrong kind of dtype.
        ValueError: a field has the wrong shape or lies on another device.
    """
    b, (height, width) = frame.depth.shape[0], frame.size
    pixel = _floating("anchors.pixel", anchors.pixel, frame)
    if pixel.dim() != 3 or pixel.shape[0] != b or pixel.shape[2] != 2:
        raise ValueError(f"anchors.pixel must be [{b}, N, 2], got {tuple(pixel.shape)}")
    shape = pixel.shape[:2]
    depth = _like(_floating("anchors.depth", anchors.depth, frame), "anchors.depth", shape)
    variance = _like(_floating("anchors.variance", anchors.variance, frame), "anchors.variance", shape)
    valid = (depth > 0) & (depth < torch.inf) & (variance >= 0) & (variance < torch.inf) & pixel.isfinite().all(-1)
    if anchors.valid is not None:
        if not isinstance(anchors.valid, Tensor) or anchors.valid.dtype != torch.bool:
            raise TypeError("anchors.valid must be a bool tensor (True = use) or None")
        valid = valid & _like(anchors.valid, "anchors.valid", shape)
    pixel = torch.where(valid[..., None], pixel, torch.zeros_like(pixel))
    u, v = pixel.round().long().unbind(-1)
    inside = (u >= 0) & (u < width) & (v >= 0) & (v < height)
    index = v.clamp(0, height - 1) * width + u.clamp(0, width - 1)
    predicted = torch.gather(frame.depth.flatten(1), 1, index).double()
    valid = valid & inside & torch.gather(frame.valid.flatten(1), 1, index)
    one, zero = torch.ones_like(depth), torch.zeros_like(depth)
    own = zero if own_variance is None else torch.gather(own_variance.detach().flatten(1), 1, index).double()
    return AnchorInput(
        pixel=pixel,
        index=index,
        predicted=torch.where(valid, predicted, one),
        depth=torch.where(valid, depth, one),
        variance=torch.where(valid, variance, zero),
        own_variance=torch.where(valid, own, zero),
        valid=valid,
    )


def _floating(name: str, value: object, frame: FrameInput) -> Tensor:
    if not isinstance(value, Tensor) or not value.is_floating_point():
        raise TypeError(f"{name} must be a floating-point tensor, got {getattr(value, 'dtype', type(value).__name__)}")
    if value.device != frame.depth.device:
        raise ValueError(f"{name} lies on {value.device} but the depth on {frame.depth.device}")
    return value.detach().double()


def _like(value: Tensor, name: str, shape: torch.Size) -> Tensor:
    if value.shape != shape:
        raise ValueError(f"{name} must have shape {tuple(shape)} as anchors.pixel says, got {tuple(value.shape)}")
    return value

"""Conversion of a camera image to a network's input, with the corresponding intrinsics and ground truth.

The geometry has up to three steps: resize with a constant aspect, crop the centre, resize to the final size (each axis
by its own factor). ``camera.resize_intrinsics`` and ``crop_intrinsics`` convert the intrinsics; an image's borders lie
half a pixel outside its outer pixel centres. UfM* works at the network's resolution, so predictions are not resized
back.

Colour is resampled linearly with antialiasing, as Pillow's bilinear filter does, or cubically if a network was trained
so (Depth Anything). FastDepth's published loader takes the nearest pixel instead; on the four recordings (README.md)
its depth has the same error either way. Depth is sampled at the nearest pixel, since a mean over a depth edge lies on
no surface.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, TypeGuard

import torch
import torch.nn.functional as F
from torch import Tensor

from ufmstar_torch.files.limits import require_pixels
from ufmstar_torch.frames.arguments import CameraLike, ImageLike, as_image, as_intrinsics, as_tensor
from ufmstar_torch.gaussians.camera import crop_intrinsics, resize_intrinsics
from ufmstar_torch.runtime.checked import Checked, number

# [1] Tolerance of the range [0, 1] of float images, for overshooting filters and noise; excludes a range of 0..255.
_RANGE_SLACK = 0.5


@dataclass(frozen=True)
class Geometry:
    """Sizes (height, width) [px] of the three steps for one size of image; ``top`` and ``left`` are cropped."""

    image: tuple[int, int]
    resized: tuple[int, int]
    top: int
    left: int
    cropped: tuple[int, int]
    final: tuple[int, int]


@dataclass(frozen=True)
class Preprocess(Checked):
    """The preprocessing of a network's input; immutable and callable.

    Attributes:
        resize_height: [px] height after the first step, None = no such step. If the crop does not fit into an image of
            that height, the image is resized to the smallest size that contains the crop.
        crop: (height, width) [px] of the centre crop, None = no crop.
        size: (height, width) [px] of the network's input, None = not resized.
        aspect_multiple: [px] keep the aspect: both sides are resized by the factor to ``size``, of the two, that
            changes the image less, and rounded to this multiple (a vision transformer's patch). ``size`` is then
            approximate. None = exactly ``size``.
        value_range: value of white: 1 for networks trained on [0, 1], 255 for networks trained on bytes.
        mean, std: per channel (R, G, B), in units of ``value_range``: input = (value - mean) / std.
        antialias: average over all source pixels when shrinking.
        cubic: resample with cubic instead of linear interpolation; colours are clipped where it overshoots.

    Raises:
        ValueError: a field is out of range.
    """

    resize_height: int | None = number(None, "", "px", 1)
    crop: tuple[int, int] | None = None
    size: tuple[int, int] | None = None
    aspect_multiple: int | None = number(None, "", "px", 1)
    value_range: float = number(1.0, "", "1", 0.0, open_low=True)
    mean: tuple[float, float, float] = (0.0, 0.0, 0.0)
    std: tuple[float, float, float] = (1.0, 1.0, 1.0)
    antialias: bool = True
    cubic: bool = False

    def __post_init__(self) -> None:
        if isinstance(self.resize_height, Sequence):
            raise ValueError(
                f"Preprocess.resize_height is one number, got {self.resize_height!r}; for an input of that height and "
                f"width: Preprocess(size={self.resize_height!r})"
            )
        super().__post_init__()
        for name in ("crop", "size"):
            value = getattr(self, name)
            whole = isinstance(value, tuple) and len(value) == 2 and all(_is_whole(side) for side in value)
            if value is not None and not (whole and min(value) > 0):
                raise ValueError(f"Preprocess.{name} must be (height, width) in pixels, got {value!r:.60}")
            require_pixels(f"Preprocess.{name}", value or (0, 0))
        require_pixels("Preprocess.resize_height", (self.resize_height or 0,) * 2)
        multiple = self.aspect_multiple
        if multiple is not None and (not _is_whole(multiple) or self.size is None):
            raise ValueError(f"Preprocess.aspect_multiple must be whole pixels and needs a size, got {multiple}")
        numbers = all(isinstance(v, tuple) and len(v) == 3 and all(map(_is_number, v)) for v in (self.mean, self.std))
        if not numbers or not min(self.std) > 0:
            raise ValueError(
                f"Preprocess.mean and .std must be 3 numbers, std positive, got {self.mean} and {self.std}"
            )

    @classmethod
    def nyu(cls, size: tuple[int, int] = (224, 224), **changes: Any) -> Preprocess:
        """FastDepth's preprocessing for the validation on NYU Depth V2: height 250 (480 x 640 becomes 250 x 333),
        centre crop of 228 x 304, then ``size``. Portrait images are resized to width 304 instead."""
        return replace(cls(resize_height=250, crop=(228, 304), size=size), **changes)

    def of_whole_frame(self) -> Preprocess:
        """A copy that resizes the whole frame, each axis by its own factor, without cropping."""
        return replace(self, resize_height=None, crop=None, size=self.size or self.crop, aspect_multiple=None)

    def of_nyu_crop(self) -> Preprocess:
        """A copy with the centre crop of NYU's validation (:meth:`nyu`)."""
        nyu = Preprocess.nyu()
        size = self.size or self.crop or nyu.crop
        return replace(self, resize_height=nyu.resize_height, crop=nyu.crop, size=size, aspect_multiple=None)

    def geometry(self, height: int, width: int) -> Geometry:
        """The sizes of all steps for an image of height x width [px]. Raises ValueError: the crop is larger than the
        image, without ``resize_height``."""
        if not (isinstance(height, int) and isinstance(width, int) and min(height, width) >= 1):
            raise ValueError(f"an image must have at least one pixel, got {height!r} x {width!r}")
        ch, cw = self.crop or (0, 0)
        resized = (height, width)
        if self.resize_height is not None:
            scale = max(self.resize_height / height, ch / height, cw / width)
            # Rounded down, as in Pillow-based loaders; the 1e-6 keeps 250/480*480 at 250.
            resized = (max(ch, 1, int(scale * height + 1e-6)), max(cw, 1, int(scale * width + 1e-6)))
        require_pixels("the resized image", resized)
        if ch > resized[0] or cw > resized[1]:
            raise ValueError(
                f"Preprocess.crop {self.crop} must fit into the image, which has {resized[0]} x {resized[1]} px; "
                "set resize_height to enlarge it"
            )
        cropped = self.crop or resized
        top, left = (resized[0] - cropped[0]) // 2, (resized[1] - cropped[1]) // 2
        return Geometry((height, width), resized, top, left, cropped, self._final(cropped))

    def _final(self, cropped: tuple[int, int]) -> tuple[int, int]:
        multiple = self.aspect_multiple
        if self.size is None or multiple is None:
            return self.size or cropped
        factor = min((self.size[0] / cropped[0], self.size[1] / cropped[1]), key=lambda f: abs(1 - f))
        height, width = (max(1, round(factor * side / multiple)) * multiple for side in cropped)
        return height, width

    def __call__(self, image: ImageLike, intrinsics: CameraLike) -> tuple[Tensor, Tensor]:
        """The network's input [B, 3, h, w], floating-point, of ``image`` [B, 3, H, W] RGB, uint8 or floating-point in
        [0, 1] (or of NumPy or Pillow: ``arguments.as_image``); and its intrinsics, of the shape and dtype of
        ``intrinsics`` [B, 3, 3] (or [3, 3]) of ``image`` [px]. Raises TypeError, ValueError: wrong types or shapes, an
        integer dtype other than uint8, or floats outside [0, 1]."""
        image = as_image(image)
        return self.apply_image(image), self.apply_intrinsics(as_intrinsics(intrinsics), *image.shape[-2:])

    def apply_image(self, image: ImageLike) -> Tensor:
        """The network's input without intrinsics; shapes, types and errors as in :meth:`__call__`."""
        return self.normalized(self.resampled(as_image(image)))

    def normalized(self, x: Tensor) -> Tensor:
        """The network's input of colours [B, 3, h, w] in [0, 1] at its size, on any device."""
        if self.value_range != 1.0:
            x = x * self.value_range
        if any(self.mean) or any(s != 1.0 for s in self.std):
            # Numbers as arguments of kernels: a tensor of them would have to be copied to the device.
            channels = zip(x.unbind(-3), self.mean, self.std, strict=True)
            x = torch.stack([(channel - mean) / std for channel, mean, std in channels], -3)
        return x.contiguous()

    def apply_intrinsics(self, intrinsics: Tensor, height: int, width: int) -> Tensor:
        """Intrinsics [..., 3, 3] [px] of the network's input, from those of an image of height x width."""
        intrinsics = as_tensor("intrinsics", intrinsics)
        if intrinsics.shape[-2:] != (3, 3):
            raise ValueError(f"intrinsics must be [B, 3, 3], got {tuple(intrinsics.shape)}")
        g = self.geometry(height, width)
        resized = resize_intrinsics(intrinsics, g.image, g.resized)
        return resize_intrinsics(crop_intrinsics(resized, g.top, g.left), g.cropped, g.final)

    def apply_depth(self, depth: Tensor) -> Tensor:
        """Resample a map [..., H, W] registered to the image (ground truth depth, a mask, labels) to the network's
        input [..., h, w]: every pixel copies the source pixel that contains its centre. Any dtype."""
        depth = as_tensor("depth", depth)
        if depth.dim() < 2:
            raise ValueError(f"depth must be [..., H, W], got {tuple(depth.shape)}")
        g = self.geometry(*depth.shape[-2:])
        rows = _source_index(g.final[0], g.cropped[0], g.top, g.resized[0], g.image[0])
        columns = _source_index(g.final[1], g.cropped[1], g.left, g.resized[1], g.image[1])
        return depth[..., rows.to(depth.device)[:, None], columns.to(depth.device)]

    def resampled(self, image: Tensor) -> Tensor:
        """[B, 3, h, w] in [0, 1], resized, cropped and resized. Bytes on the CPU stay bytes until the last step, and
        are rounded as by Pillow and by transformers' processors; other devices and types compute in floats."""
        _check(image)
        if image.dtype in (torch.float16, torch.bfloat16):  # not supported by torch on the CPU
            return self.resampled(image.float()).to(image.dtype)
        if image.dtype != torch.uint8:
            return self._steps(image)
        if image.is_cpu and self.antialias:  # torch has a fast path for bytes with interleaved channels
            return _unit(self._steps(image.contiguous(memory_format=torch.channels_last)))
        return self._steps(_unit(image))

    def _steps(self, x: Tensor) -> Tensor:
        g = self.geometry(*x.shape[-2:])
        x = self._resize(x, g.resized)
        x = x[..., g.top : g.top + g.cropped[0], g.left : g.left + g.cropped[1]]
        return self._resize(x, g.final)

    def _resize(self, x: Tensor, size: tuple[int, int]) -> Tensor:
        if x.shape[-2:] == size:
            return x
        mode = "bicubic" if self.cubic else "bilinear"
        resized = F.interpolate(x, size, mode=mode, align_corners=False, antialias=self.antialias)
        return resized.clamp(0, 1) if self.cubic and x.is_floating_point() else resized


def _unit(image: Tensor) -> Tensor:
    """Bytes as floats in [0, 1]."""
    return image.to(torch.get_default_dtype()) / 255


def _is_number(value: object) -> TypeGuard[int | float]:
    return isinstance(value, int | float) and not isinstance(value, bool) and abs(value) < float("inf")


def _is_whole(value: object) -> bool:
    return _is_number(value) and value == int(value)


def _check(image: Tensor) -> None:
    """Raise a ValueError unless the image is uint8 or floats in [0, 1]."""
    if image.dtype == torch.uint8:
        return
    if not torch.is_floating_point(image):
        raise ValueError(f"image must be uint8 or floating-point, got {image.dtype}")
    if image.numel():
        low, high = torch.aminmax(image.detach())
        if not (low >= -_RANGE_SLACK and high <= 1 + _RANGE_SLACK):
            raise ValueError(
                f"a floating-point image must lie in [0, 1], got [{float(low):.4g}, {float(high):.4g}]; "
                "pass bytes as uint8"
            )


def _source_index(final: int, cropped: int, cut: int, resized: int, image: int) -> Tensor:
    """[final] the source pixel that contains each final pixel's centre, along one axis."""
    centre = torch.arange(final, dtype=torch.float64) + 0.5
    source = (centre * (cropped / final) + cut) * (image / resized)
    return source.floor().to(torch.int64).clamp_(0, image - 1)

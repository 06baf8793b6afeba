"""Conversion of public arguments (images, maps, poses, intrinsics) to tensors, with checks of dtype, shape, device."""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from ufmstar_torch.runtime.kinds import require

Shapes = Sequence[tuple[int, ...]]
_RESOLUTION, _TOO_FAR = 0.01, 1e10  # [m] coarsest accepted pose coordinates, and the value that replaces coarser ones
Array: TypeAlias = Tensor | NDArray[Any]
# An image may also be Pillow's, and intrinsics four numbers.
ImageLike: TypeAlias = Any
CameraLike: TypeAlias = "Tensor | NDArray[Any] | Sequence[float]"


def as_tensor(name: str, value: object) -> Tensor:
    """Convert the argument ``name``, a tensor or a NumPy array of numbers, to a tensor. Masked entries become NaN (not
    valid) or False.

    Raises:
        TypeError: ``value`` is neither, or a masked array of whole numbers.
    """
    if isinstance(value, Tensor):
        return value
    if not isinstance(value, np.ndarray) or value.dtype.kind not in "bfiu":
        kind = f"an array of {value.dtype}" if isinstance(value, np.ndarray) else type(value).__name__
        raise TypeError(f"{name} must be a torch.Tensor or a NumPy array of numbers, got {kind}")
    if isinstance(value, np.ma.MaskedArray):
        value = _unmasked(name, value)
    native = value.astype(value.dtype.newbyteorder("="), copy=not value.flags.writeable)
    return torch.from_numpy(np.ascontiguousarray(native))


def _unmasked(name: str, value: np.ma.MaskedArray[Any, Any]) -> NDArray[Any]:
    """The values of a masked array, NaN or False where they are masked."""
    if value.dtype.kind in "iu" and np.ma.is_masked(value):
        raise TypeError(f"{name} must not be masked, since {value.dtype} has no value that is not valid: pass floats")
    return np.asarray(value.filled(np.nan if value.dtype.kind == "f" else False))


def require_whole(name: str, value: object, least: int | None = None) -> int:
    """The argument ``name`` if it is a whole number, of at least ``least``. Raises TypeError: another type; ValueError:
    a smaller number, or one beyond 64 bits."""
    if isinstance(value, bool) or not isinstance(value, int | np.integer):
        raise TypeError(f"{name} must be a whole number, got {type(value).__name__}")
    if (least is not None and value < least) or not -(2**63) <= value < 2**63:
        raise ValueError(f"{name} must be a whole number of at least {least or 0}, got {value}")
    return int(value)


def require_number(name: str, value: object) -> float:
    """The argument ``name`` as a float. Raises TypeError: no number; ValueError: beyond the range of floats."""
    if isinstance(value, bool) or not isinstance(value, int | float | np.integer | np.floating):
        raise TypeError(f"{name} must be a number, got {type(value).__name__}")
    try:
        return float(value)
    except OverflowError:
        raise ValueError(
            f"{name} must be a number within the range of floats, got one of {len(str(value))} digits"
        ) from None


def require_size(name: str, value: object) -> tuple[int, int]:
    """The argument ``name`` if it is (H, W), two positive whole numbers [px]. Raises TypeError, ValueError."""
    if not isinstance(value, tuple | list | torch.Size) or len(value) != 2:
        kind = f"{len(value)} values" if isinstance(value, tuple | list) else type(value).__name__
        raise TypeError(f"{name} must be (H, W), positive whole numbers, got {kind}")
    height, width = (require_whole(name, side) for side in value)
    if min(height, width) < 1:
        raise ValueError(f"{name} must be (H, W), positive whole numbers, got {tuple(value)}")
    return height, width


def as_device(name: str, value: Any) -> torch.device:
    """The argument ``name`` as a device, the CPU for None. Raises TypeError, ValueError: no device."""
    if value is None:
        return torch.device("cpu")
    require(name, value, torch.device | str)
    try:
        return torch.device(value)
    except RuntimeError as error:
        raise ValueError(f"{name} must be a device such as 'cpu' or 'cuda:0', got {value!r}: {error}") from error


def as_path(name: str, value: object) -> Path:
    """The argument ``name`` as a path. Raises TypeError: no text and no path."""
    return Path(require(name, value, str | os.PathLike))


def as_image(image: ImageLike) -> Tensor:
    """Convert images to [B, 3, H, W] RGB.

    Args:
        image: a tensor [B, 3, H, W] or [3, H, W], a NumPy array [B, H, W, 3] or [H, W, 3], or a Pillow image.

    Raises:
        TypeError: another type.
        ValueError: another shape.
    """
    if isinstance(image, Tensor):
        pixels = image[None] if image.dim() == 3 and image.shape[0] == 3 else image
        if pixels.dim() == 4 and pixels.shape[1] == 3 and pixels.numel():
            return pixels
        last = "; its channels come last: image.permute(0, 3, 1, 2)" if pixels.shape[-1:] == (3,) else ""
        raise ValueError(f"image must be [B, 3, H, W] RGB, got a tensor {tuple(image.shape)}{last}")
    if hasattr(image, "convert") and hasattr(image, "mode"):
        image = np.array(image.convert("RGB"))
    if not isinstance(image, np.ndarray):
        expected = "a torch.Tensor [B, 3, H, W], a NumPy array [H, W, 3] or a Pillow image"
        raise TypeError(f"image must be {expected}, got {type(image).__name__}")
    if image.ndim not in (3, 4) or image.shape[-1] != 3 or not image.size:
        raise ValueError(f"image as a NumPy array must be [B, H, W, 3] or [H, W, 3] RGB, got {image.shape}")
    pixels = as_tensor("image", image).view(-1, *image.shape[-3:]).permute(0, 3, 1, 2)
    return pixels.to(torch.get_default_dtype()) if pixels.is_floating_point() else pixels


def as_pose(pose: CameraLike) -> Tensor:
    """Convert a pose to camera-to-world [B, 4, 4] or [4, 4].

    Coordinates that the dtype does not resolve to 1 cm (float32: beyond 84 km) are set beyond the accepted range, so
    that :func:`ufmstar_torch.frames.frame.pose_fault` rejects them.

    Args:
        pose: [B, 4, 4], [4, 4], or [..., 3, 4] without the last row.

    Raises:
        TypeError: another type.
        ValueError: another shape.
    """
    T = _numbers("pose", pose)
    if T.dtype != torch.float64 and T.shape[-1:] == (4,):
        coarse = T.abs() > _RESOLUTION / torch.finfo(T.dtype).eps
        coarse[..., :3] = False
        T = torch.where(coarse, _TOO_FAR, T.double())
    if T.dim() in (2, 3) and T.shape[-2:] == (3, 4):
        return torch.cat([T, T.new_tensor([[0.0, 0.0, 0.0, 1.0]]).expand(*T.shape[:-2], 1, 4)], dim=-2)
    if T.dim() not in (2, 3) or T.shape[-2:] != (4, 4):
        swapped = "; are these the intrinsics? The pose comes before them" if _of_intrinsics(T) else ""
        expected = "camera-to-world [B, 4, 4] or [4, 4], or [..., 3, 4]"
        raise ValueError(f"pose must be {expected}, got {tuple(T.shape)}{swapped}")
    return T


def as_intrinsics(intrinsics: CameraLike) -> Tensor:
    """Convert intrinsics to [B, 3, 3] or [3, 3] [px].

    Args:
        intrinsics: [B, 3, 3], [3, 3], [..., 4, 4] with the fourth row and column of an identity, or fx, fy, cx, cy.

    Raises:
        TypeError: another type.
        ValueError: another shape, or another fourth row or column.
    """
    K = _numbers("intrinsics", intrinsics)
    if K.shape == (4,):
        (fx, fy, cx, cy), zero, one = K, K.new_zeros(()), K.new_ones(())
        return torch.stack([fx, zero, cx, zero, fy, cy, zero, zero, one]).view(3, 3)
    if K.dim() in (2, 3) and K.shape[-2:] == (4, 4):
        if bool((K[..., 3, :] != K.new_tensor([0, 0, 0, 1])).any()) or bool((K[..., :3, 3] != 0).any()):
            raise ValueError("intrinsics [4, 4] must be 0, 0, 0, 1 in the fourth row and column; is this the pose?")
        return K[..., :3, :3]
    if K.dim() not in (2, 3) or K.shape[-2:] != (3, 3):
        raise ValueError(f"intrinsics must be [B, 3, 3], [3, 3] or fx, fy, cx, cy, got {tuple(K.shape)}")
    return K


def _of_intrinsics(values: Tensor) -> bool:
    """True if the shape fits intrinsics but no pose."""
    return values.shape == (4,) or values.shape[-2:] == (3, 3)


def _numbers(name: str, value: object) -> Tensor:
    """Convert a tensor, an array or nested sequences to a floating-point tensor; integers become float64."""
    if isinstance(value, list | tuple):
        try:
            value = np.array(value, dtype=np.float64)
        except (TypeError, ValueError) as error:
            raise TypeError(f"{name} must hold numbers, got {value!r:.60}") from error
    numbers = as_tensor(name, value)
    if numbers.is_floating_point():
        return numbers
    whole = not numbers.is_complex() and numbers.dtype != torch.bool
    return require_float(name, numbers.double() if whole else numbers)


def require_float(name: str, value: object, shapes: Shapes = (), like: Tensor | None = None) -> Tensor:
    """Return the argument ``name`` if it is a tensor of a floating-point dtype.

    Args:
        shapes: allowed shapes; () = any.
        like: tensor on the required device; None = any.

    Raises:
        TypeError: no tensor, or another dtype.
        ValueError: another shape or device.
    """
    if not isinstance(value, Tensor):
        raise TypeError(f"{name} must be a torch.Tensor, got {type(value).__name__}")
    if not value.is_floating_point():
        raise TypeError(f"{name} must have a floating-point dtype, got {value.dtype}")
    return _fitting(name, value, shapes, like)


def require_mask(name: str, value: object, shapes: Shapes, like: Tensor | None = None) -> Tensor:
    """As :func:`require_float`, for torch.bool."""
    if not isinstance(value, Tensor) or value.dtype != torch.bool:
        kind = value.dtype if isinstance(value, Tensor) else type(value).__name__
        raise TypeError(f"{name} must be a torch.bool tensor (True = use), got {kind}")
    return _fitting(name, value, shapes, like)


def _fitting(name: str, value: Tensor, shapes: Shapes, like: Tensor | None) -> Tensor:
    if shapes and tuple(value.shape) not in shapes:
        expected = " or ".join(str(shape) for shape in dict.fromkeys(shapes))
        raise ValueError(f"{name} must have shape {expected}, got {tuple(value.shape)}")
    if like is not None and value.device != like.device:
        raise ValueError(f"{name} must lie on the depth's device {like.device}, got {value.device}")
    return value

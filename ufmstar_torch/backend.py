"""The one seam between the algorithm and its kernels: which implementation of each step is used."""

from __future__ import annotations

import functools
import warnings
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

from ufmstar_torch import correspond as _correspond
from ufmstar_torch import fuse as _fuse
from ufmstar_torch import gaussian as _gaussian
from ufmstar_torch import regress as _regress
from ufmstar_torch import segment as _segment


@dataclass(frozen=True)
class Backend:
    """The replaceable steps; every implementation has the torch reference's signature."""

    name: str
    spgf: Callable[..., Any]
    floor_covariance: Callable[..., Any]
    correspond: Callable[..., Any]
    fuse: Callable[..., Any]
    regress: Callable[..., Any]
    regress_image: Callable[..., Any]
    smooth: Callable[..., Any]
    distribute: Callable[..., Any]


TORCH = Backend(
    "torch",
    _segment.spgf,
    _gaussian.floor_covariance,
    _correspond.correspond,
    _fuse.fuse,
    _regress.regress,
    _regress.regress_image,
    _regress.smooth,
    _regress.distribute,
)


def select(name: str, device_type: str) -> Backend:
    """The kernels for a device.

    Args:
        name: "torch": the reference on every device; it waits for the device only where the mixture may
            have to grow. "numba": compiled CPU kernels, CPU tensors only. "auto": numba on the CPU where it can be
            imported; on an accelerator the torch reference, except that the segmentation, a long chain of
            tiny steps there, runs on the host: the depth map is copied over, which waits for the device.
        device_type: ``torch.device.type`` of the depth.

    Raises:
        ValueError: "numba" was asked for tensors of another device.
        ImportError: "numba" was asked for by name and cannot be imported.
    """
    if name == "torch":
        return TORCH
    if name == "numba":
        if device_type != "cpu":
            raise ValueError(f"backend='numba' needs CPU tensors, got device type {device_type!r}")
        return _numba_backend()
    if device_type == "meta":
        return TORCH
    compiled = _numba_or_none()
    if compiled is None or device_type == "cpu":
        return compiled or TORCH
    return replace(TORCH, name="torch, host segmentation", spgf=_on_host(compiled.spgf))


def _numba_backend() -> Backend:
    from ufmstar_torch.kernels import correspond_cpu, fuse_cpu, regress_cpu, segment_cpu

    return Backend(
        "numba",
        segment_cpu.spgf,
        fuse_cpu.floor_covariance,
        correspond_cpu.correspond,
        fuse_cpu.fuse,
        regress_cpu.regress,
        regress_cpu.regress_image,
        regress_cpu.smooth,
        regress_cpu.distribute,
    )


@functools.cache
def _numba_or_none() -> Backend | None:
    """The compiled kernels, or None with one warning where numba cannot be imported."""
    try:
        return _numba_backend()
    except ImportError as error:
        warnings.warn(f"numba cannot be imported ({error}); the slower torch reference serves", stacklevel=4)
        return None


def _on_host(spgf: Callable[..., Any]) -> Callable[..., Any]:
    """A CPU segmentation for tensors of another device."""

    def moved(depth: Any, intrinsics: Any, config: Any = None, **options: Any) -> Any:
        def to_cpu(value: Any) -> Any:
            return value.cpu() if hasattr(value, "cpu") else value

        options = {name: to_cpu(value) for name, value in options.items()}
        mixture, labels = spgf(to_cpu(depth), to_cpu(intrinsics), config, **options)
        return mixture.to(depth.device), labels.to(depth.device)

    return moved

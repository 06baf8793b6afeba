"""Which implementation of a step runs on a device."""

from __future__ import annotations

import functools
import warnings
from dataclasses import fields, replace
from typing import Any

from torch import Tensor

from ufmstar_torch.mixture import GaussianMixture
from ufmstar_torch.segment_input import SegmentInput
from ufmstar_torch.step import REFERENCE, Kernels, SegmentKernel, Step, step

_TRITON_DEVICES = ("cuda", "xpu")


def select_step(name: str, device_type: str) -> Step:
    """The step for a device; arguments and errors as :func:`select_kernels`."""
    return functools.partial(step, kernels=select_kernels(name, device_type))


def select_kernels(name: str, device_type: str) -> Kernels:
    """The kernels for a device.

    Args:
        name: "torch": the reference on every device; it waits for the device only where the mixture may
            have to grow. "numba": compiled CPU kernels, CPU tensors only. "triton": GPU kernels; CPU tensors only in
            Triton's interpreter (``TRITON_INTERPRET=1``). "auto": numba on the CPU where it can be imported; Triton on
            CUDA (and ROCm, which torch calls so) and XPU where it can be imported; else, on an accelerator, the torch
            reference, with one warning, and the segmentation on the host, which waits for the device.
        device_type: ``torch.device.type`` of the depth.

    Raises:
        ValueError: "numba" or "triton" for tensors of another device.
        ImportError: "numba" or "triton" by name where it cannot be imported.
    """
    if name == "triton":
        return _triton(device_type)
    if name == "numba":
        if device_type != "cpu":
            raise ValueError(f"backend='numba' needs CPU tensors, got device type {device_type!r}")
        return _numba()
    if name == "torch" or device_type == "meta":
        return REFERENCE
    if device_type in _TRITON_DEVICES and (kernels := _triton_or_none(device_type)) is not None:
        return kernels
    compiled = _numba_or_none()
    if compiled is None or device_type == "cpu":
        return compiled or REFERENCE
    return replace(REFERENCE, spgf=_on_host(compiled.spgf))


@functools.cache
def _numba() -> Kernels:
    from ufmstar_torch.kernels import correspond_cpu, fuse_cpu, regress_cpu, segment_cpu

    return Kernels(
        spgf=segment_cpu.segment,
        floor_covariance=fuse_cpu.floor_covariance,
        correspond=correspond_cpu.correspond,
        fuse=fuse_cpu.fuse,
        regress_image=regress_cpu.regress_image,
        smooth=regress_cpu.smooth,
        distribute=regress_cpu.distribute,
    )


@functools.cache
def _triton(device_type: str) -> Kernels:
    from ufmstar_torch.kernels.triton import correspond, distribute, fuse, launch, regress, segment

    if device_type not in _TRITON_DEVICES and not (device_type == "cpu" and launch.interpreted()):
        raise ValueError(f"backend='triton' needs tensors of a GPU, got device type {device_type!r}")
    return Kernels(
        spgf=segment.segment,
        floor_covariance=fuse.floor_covariance,
        correspond=correspond.correspond,
        fuse=fuse.fuse,
        regress_image=regress.regress_image,
        smooth=regress.smooth,
        distribute=distribute.distribute,
    )


@functools.cache
def _triton_or_none(device_type: str) -> Kernels | None:
    """The GPU kernels, or None with one warning where Triton cannot be imported."""
    try:
        return _triton(device_type)
    except ImportError as error:
        warnings.warn(f"triton cannot be imported ({error}); the slower torch reference serves", stacklevel=4)
        return None


@functools.cache
def _numba_or_none() -> Kernels | None:
    """The compiled kernels, or None with one warning where numba cannot be imported."""
    try:
        return _numba()
    except ImportError as error:
        warnings.warn(f"numba cannot be imported ({error}); the slower torch reference serves", stacklevel=4)
        return None


def _on_host(kernel: SegmentKernel) -> SegmentKernel:
    """A CPU segmentation for tensors of another device."""

    def moved(given: SegmentInput) -> tuple[GaussianMixture, Tensor]:
        tensors = {f.name: getattr(given, f.name) for f in fields(given)}
        on_host: dict[str, Any] = {n: v.cpu() if isinstance(v, Tensor) else v for n, v in tensors.items()}
        mixture, labels = kernel(SegmentInput(**on_host))
        return mixture.to(given.depth.device), labels.to(given.depth.device)

    return moved

"""Which implementation of a step runs on a device."""

from __future__ import annotations

import functools
import warnings
from dataclasses import fields, replace
from typing import Any

from torch import Tensor

from ufmstar_torch.mixture import GaussianMixture
from ufmstar_torch.posterior.update import REFERENCE as POSTERIOR_REFERENCE
from ufmstar_torch.posterior.update import PosteriorKernels
from ufmstar_torch.segment_input import SegmentInput
from ufmstar_torch.step import REFERENCE, Kernels, SegmentKernel, Step, step


def select_step(name: str, device_type: str) -> Step:
    """The step for a device; arguments and errors as :func:`select_kernels`."""
    return functools.partial(step, kernels=select_kernels(name, device_type))


def select_kernels(name: str, device_type: str) -> Kernels:
    """The kernels for a device.

    Args:
        name: "torch": the reference on every device; it waits for the device only where the mixture may
            have to grow. "numba": compiled CPU kernels, CPU tensors only. "auto": numba on the CPU where it can be
            imported; on an accelerator the torch reference, except that the segmentation, a long chain of
            tiny steps there, runs on the host: the depth map is copied over, which waits for the device.
        device_type: ``torch.device.type`` of the depth.

    Raises:
        ValueError: "numba" for tensors of another device.
        ImportError: "numba" by name where it cannot be imported.
    """
    if name == "numba":
        if device_type != "cpu":
            raise ValueError(f"backend='numba' needs CPU tensors, got device type {device_type!r}")
        return _numba()
    if name == "torch" or device_type == "meta":
        return REFERENCE
    compiled = _numba_or_none()
    if compiled is None or device_type == "cpu":
        return compiled or REFERENCE
    return replace(REFERENCE, spgf=_on_host(compiled.spgf))


def select_posterior(name: str, device_type: str) -> PosteriorKernels:
    """The posterior's kernels for a device; arguments and errors as :func:`select_kernels`. An accelerator takes the
    reference."""
    if device_type != "cpu" or select_kernels(name, device_type) is REFERENCE:
        return POSTERIOR_REFERENCE
    from ufmstar_torch.kernels import posterior_cpu

    return PosteriorKernels(solve=posterior_cpu.solve, distance=posterior_cpu.distance, read=posterior_cpu.read)


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

"""Selects the implementation of a step for a device."""

from __future__ import annotations

import functools
import warnings
from dataclasses import replace
from typing import NamedTuple

import torch
from torch import Tensor

from ufmstar_torch.anchors.check import CheckAnchors, check_anchor_values
from ufmstar_torch.config import SPGFConfig
from ufmstar_torch.frames.frame import CheckKernel, check_values
from ufmstar_torch.gaussians.mixture import GaussianMixture
from ufmstar_torch.steps.merge import REFERENCE as MERGE_REFERENCE
from ufmstar_torch.steps.merge import MergeKernels
from ufmstar_torch.steps.sample import REFERENCE as SAMPLE_REFERENCE
from ufmstar_torch.steps.sample import SampleKernels
from ufmstar_torch.steps.step import REFERENCE, Kernels, Step, step

_TRITON_DEVICES = ("cuda", "xpu")  # "cuda" is ROCm's name as well
_LEAST_CAPABILITY = (8, 0)  # of an NVIDIA GPU that triton supports


def select_step(name: str, device_type: str) -> Step:
    """The step for a device. The step of a GPU remembers a count of its last state: use one instance for each module.

    Args:
        name: one of
            "torch": the reference, on every device; synchronises only where the mixture may have to grow.
            "numba": compiled for the CPU; CPU tensors only.
            "triton": for a GPU; CPU tensors only in Triton's interpreter (``TRITON_INTERPRET=1``).
            "auto": numba on the CPU; Triton on CUDA, ROCm and XPU if it can be imported; else the torch reference with
            the segmentation, a long chain of tiny steps, on the host, which copies the depth map and synchronises.
        device_type: ``torch.device.type`` of the depth.

    Raises:
        ValueError: "numba" or "triton" for tensors of another device.
        ImportError: ``name`` is "triton", which cannot be imported.
    """
    if _compiled(name, device_type):
        from ufmstar_torch.kernels.cpu import step as step_cpu

        return step_cpu.step
    if _on_gpu(name, device_type):
        from ufmstar_torch.kernels.triton.step import DeviceStep

        return DeviceStep(_triton())
    return functools.partial(step, kernels=select_kernels(name, device_type))


class FrameKernels(NamedTuple):
    """The implementations of the functions that run before and after a step.

    Attributes:
        check: of a frame's values.
        check_anchors: of anchors' values.
        sample: means over a sample of pixels.
        merge: merging of components.
    """

    check: CheckKernel
    check_anchors: CheckAnchors
    sample: SampleKernels
    merge: MergeKernels


def select_frame(name: str, device_type: str) -> FrameKernels:
    """Select these functions for a device; arguments and errors as :func:`select_step`."""
    if _compiled(name, device_type):
        from ufmstar_torch.anchors.kernels import learn
        from ufmstar_torch.kernels.cpu import check as check_cpu
        from ufmstar_torch.kernels.cpu import merge as merge_cpu
        from ufmstar_torch.kernels.cpu import sample as sample_cpu

        return FrameKernels(
            check_cpu.check_values,
            learn.check_anchor_values,
            SampleKernels(sample_cpu.sample_pixels, sample_cpu.sample_summary),
            MergeKernels(merge_cpu.close_pairs, merge_cpu.evidence),
        )
    check = check_values
    if _on_gpu(name, device_type):
        from ufmstar_torch.kernels.triton import check as check_triton

        check = check_triton.check_values
    return FrameKernels(check, check_anchor_values, SAMPLE_REFERENCE, MERGE_REFERENCE)


def select_kernels(name: str, device_type: str) -> Kernels:
    """The kernels of the reference step; arguments as :func:`select_step`."""
    if _on_gpu(name, device_type):
        return _triton()
    if name == "torch" or device_type in ("cpu", "meta"):
        return REFERENCE
    return replace(REFERENCE, spgf=_segment_on_host)


def _compiled(name: str, device_type: str) -> bool:
    """True if the step is compiled for the CPU."""
    if name == "numba":
        if device_type != "cpu":
            raise ValueError(f"backend='numba' needs CPU tensors, got device type {device_type!r}")
        return True
    return name == "auto" and device_type == "cpu"


def _on_gpu(name: str, device_type: str) -> bool:
    """True if the kernels are Triton's."""
    if name == "triton":
        from ufmstar_torch.kernels.triton.launch import interpreted

        if device_type not in _TRITON_DEVICES and not (device_type == "cpu" and interpreted()):
            raise ValueError(f"backend='triton' needs tensors of a GPU, got device type {device_type!r}")
        return True
    return name == "auto" and device_type in _TRITON_DEVICES and _has_triton(device_type)


@functools.cache
def _triton() -> Kernels:
    from ufmstar_torch.kernels.triton import correspond, fuse, regress, segment

    return replace(
        REFERENCE, spgf=segment.segment, floor_covariance=fuse.floor_covariance, correspond=correspond.correspond,
        fuse=fuse.fuse, regress_image=regress.regress_image,
    )  # fmt: skip


@functools.cache
def _has_triton(device_type: str) -> bool:
    """True if triton can be imported and supports the device; warns once if not."""
    try:
        import triton as triton
    except ImportError as error:
        warnings.warn(f"triton cannot be imported ({error}); the slower torch reference serves", stacklevel=4)
        return False
    nvidia = device_type == "cuda" and torch.version.hip is None and torch.cuda.is_initialized()
    if nvidia and torch.cuda.get_device_capability() < _LEAST_CAPABILITY:
        warnings.warn("triton needs compute capability 8.0; the slower torch reference serves", stacklevel=4)
        return False
    return True


def _segment_on_host(
    depth: Tensor, intrinsics: Tensor, limits: SPGFConfig, features: Tensor | None
) -> tuple[GaussianMixture, Tensor]:
    """The segmentation of tensors of any device, on the CPU; synchronises."""
    from ufmstar_torch.kernels.cpu.segment import segment

    mixture, labels = segment(depth.cpu(), intrinsics.cpu(), limits, None if features is None else features.cpu())
    return mixture.to(depth.device), labels.to(depth.device)

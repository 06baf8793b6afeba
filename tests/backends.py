"""The implementations of every step under common signatures: the torch reference, numba, Triton.

Arguments and results are CPU tensors on every backend. The fixture ``backend`` of conftest.py yields each backend.
"""

from __future__ import annotations

import functools
import os
from collections.abc import Callable
from dataclasses import dataclass, fields, is_dataclass, replace
from typing import Any

import numpy as np
import pytest
import torch

from ufmstar_torch import UfMStar, UfMStarConfig
from ufmstar_torch.frames.frame import CheckKernel
from ufmstar_torch.gaussians import gaussian
from ufmstar_torch.gaussians.mixture import GaussianMixture
from ufmstar_torch.kernels.compile_cpu import kernel
from ufmstar_torch.kernels.cpu import correspond as correspond_cpu
from ufmstar_torch.kernels.cpu import fuse as fuse_cpu
from ufmstar_torch.kernels.cpu import regress as regress_cpu
from ufmstar_torch.kernels.cpu import rigid as rigid_cpu
from ufmstar_torch.kernels.cpu import segment as segment_cpu
from ufmstar_torch.kernels.cpu.regress_cull import Seen
from ufmstar_torch.kernels.select import select_frame, select_kernels
from ufmstar_torch.steps.correspond import Correspondence
from ufmstar_torch.steps.regress import Regression
from ufmstar_torch.steps.step import REFERENCE, Kernels

INTERPRETED = os.environ.get("TRITON_INTERPRET") == "1"  # must be set before triton is imported


@dataclass(frozen=True)
class Backend:
    """One implementation.

    Attributes:
        device: device of a module's tensors.
        kernels: the kernels of the steps.
        check: the check of a frame's values.
        slow: True in Triton's interpreter, where tests use few frames and examples.
    """

    name: str
    device: str
    kernels: Kernels
    check: CheckKernel
    slow: bool = False

    def spgf(self, depth, intrinsics, config, *, features=None):
        """Segment depth maps [B, H, W] (step 2)."""
        return self.kernels.spgf(depth, intrinsics, config.scaled_to(*depth.shape[1:]), features)

    def module(self, config: UfMStarConfig, dtype: torch.dtype = torch.float32) -> Callable[..., Any]:
        """UfM* on this backend, with CPU tensors as arguments and results; ``ufm`` is the wrapped module."""
        ufm = UfMStar(config.replace(backend=self.name), dtype=dtype, device=self.device)
        call = ufm if self.device == "cpu" else _on(self.device, ufm)
        wrapped: Any = functools.partial(call)
        wrapped.ufm = ufm
        return wrapped


@functools.cache
def make_backend(name: str) -> Backend:
    """Return the named backend; skip the test where this machine cannot run it."""
    if name == "torch":
        return Backend(name, "cpu", REFERENCE, select_frame(name, "cpu").check)
    if name == "numba":
        numba_kernels = replace(
            REFERENCE, spgf=segment_cpu.segment, floor_covariance=_floored, correspond=_corresponding, fuse=_fused,
            regress_image=_regressed,
        )  # fmt: skip
        return Backend(name, "cpu", numba_kernels, select_frame(name, "cpu").check)
    if not INTERPRETED and not torch.cuda.is_available():
        pytest.skip("needs TRITON_INTERPRET=1 or a CUDA device")
    device = "cpu" if INTERPRETED else "cuda"
    kernels, check = select_kernels(name, device), select_frame(name, device).check
    if device != "cpu":
        kernels = Kernels(**{f.name: _on(device, getattr(kernels, f.name)) for f in fields(kernels)})
        check = _on(device, check)
    return Backend(name, device, kernels, check, slow=INTERPRETED)


@functools.cache
def compiled(part: Callable[..., Any]) -> Callable[..., Any]:
    """Make a kernel of a part, cached on disk, so that Python can call it."""

    def call(*arguments: Any) -> Any:
        return part(*arguments)

    call.__qualname__ = part.__qualname__  # the name of the files in the cache
    return kernel(call)


def moved(value: Any, device: torch.device | str) -> Any:
    """The same value with its tensors on a device: a tensor, a tuple, or a dataclass with tensors in its fields."""
    if isinstance(value, torch.Tensor):
        return value.to(device)
    if isinstance(value, tuple):
        return tuple(moved(part, device) for part in value)
    if not is_dataclass(value) or isinstance(value, type):
        return value
    return replace(value, **{f.name: moved(getattr(value, f.name), device) for f in fields(value)})


def _on(device: str, kernel: Callable[..., Any]) -> Any:
    """Run a kernel on ``device``, with CPU tensors as arguments and result."""

    def call(*arguments: Any, **options: Any) -> Any:
        options = {name: moved(value, device) for name, value in options.items()}
        return moved(kernel(*moved(arguments, device), **options), "cpu")

    return call


def _by_field(m: GaussianMixture, stream: int):
    """All slots of a stream, one row per field (``rigid_cpu``)."""
    table = np.empty((rigid_cpu.FIELDS, rigid_cpu.padded(m.capacity)))
    moments = (v[stream].numpy() for v in (m.mean, m.covariance, m.weight))
    rigid_cpu.gather(m.capacity, *moments, table)
    return table


def _corresponding(previous, current, intrinsics, size, config):
    """The compiled lists of pairs as matrices, checked to be sorted by c, then k. The overlap of other pairs is 0."""
    match = torch.zeros(previous.streams, current.capacity, previous.capacity, dtype=torch.bool)
    overlap = torch.zeros(match.shape, dtype=torch.float64)
    thresholds = (config.eta, config.eta_occlusion, config.near_plane, gaussian.PIXEL_VARIANCE)
    for b in range(previous.streams):
        mixtures = [value for m in (previous, current) for value in (_by_field(m, b), m.capacity)]
        (c, k), beta = compiled(correspond_cpu.matches)(*mixtures, intrinsics[b].double().numpy(), *size, thresholds)
        match[b, c, k], overlap[b, c, k] = True, torch.from_numpy(beta)
        assert np.array_equal(np.stack([c, k], 1), match[b].nonzero().numpy())
    return Correspondence(match, overlap)


def _fused(previous, current, pairs, view, config, *, rounds=None):
    """The compiled fusion of a mixture, stream by stream."""
    out = GaussianMixture(*(value.clone() for value in previous.tensors().values()))
    epsilon = torch.finfo(previous.covariance.dtype).eps
    for b in range(previous.streams):
        c, k = pairs.match[b].nonzero(as_tuple=True)
        new = (v[b].numpy() for v in (current.mean, current.covariance, current.weight, current.features))
        compiled(fuse_cpu.fuse_pairs)(
            *(value[b].numpy() for value in out.tensors().values()), *new,
            c.numpy(), k.numpy(), pairs.overlap[b, c, k].numpy(), view[b].numpy(),
            (config.overlap_weighted, epsilon, config.view_baseline or 0.0, config.near_plane),
            np.empty(out.capacity), np.empty(fuse_cpu.WORK),
        )  # fmt: skip
    return out


def _floored(cov, floor):
    out, work = cov.clone(), np.empty(fuse_cpu.WORK)
    for one, least in zip(out.view(-1, 3, 3).numpy(), floor.flatten().tolist(), strict=True):
        compiled(fuse_cpu.floor_covariance)(one, least, work)
    return out


def seen(m: GaussianMixture, features: int | None = None) -> list[Seen]:
    """The occupied slots of each stream as arguments of the compiled regression; ``features``: that many zero
    features."""
    out = []
    for b in range(m.streams):
        at = m.valid[b]
        rows = torch.cat([m.mean[b], m.covariance[b].flatten(1), m.weight[b, :, None]], 1)[at].double()
        components = np.zeros((rigid_cpu.FIELDS, rigid_cpu.padded(len(rows))))
        components[:, : len(rows)] = rows.T
        feature_rows = m.features[b][at].double().numpy() if features is None else np.zeros((len(rows), features))
        out.append(Seen(components, m.disagreement[b][at].double().numpy(), feature_rows))
    return out


def _regressed(m, depth, intrinsics, valid, config, pixels=None):
    positive, K = torch.where(valid, depth, 0).numpy(), intrinsics.double().numpy()
    M, features = regress_cpu.regression(seen(m), positive, K, config, None if pixels is None else pixels.numpy())
    return Regression(torch.from_numpy(M), torch.from_numpy(np.moveaxis(features, 1, -1)))

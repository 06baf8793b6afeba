"""Versions, hardware, load and devices for the record of results."""

from __future__ import annotations

import os
import platform
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

# Distributions by their name in a report.
_PACKAGES = {"ufmstar_torch": "ufmstar-torch", "torch": "torch", "numba": "numba", "numpy": "numpy"}
_PACKAGES |= {"torchvision": "torchvision", "llvmlite": "llvmlite", "onnxruntime": "onnxruntime"}
# Environment variables that change the time of parallel loops, especially under other load.
_ENVIRONMENT = ("OMP_NUM_THREADS", "OMP_WAIT_POLICY", "MKL_NUM_THREADS", "NUMBA_NUM_THREADS", "NUMBA_THREADING_LAYER")


def versions() -> dict[str, str | None]:
    """Versions of the packages on which results depend, and of Python; None = not installed."""
    installed: dict[str, str | None] = {}
    for name, distribution in _PACKAGES.items():
        try:
            installed[name] = version(distribution)
        except PackageNotFoundError:
            installed[name] = None
    return {**installed, "python": platform.python_version()}


def hardware() -> dict[str, Any]:
    """The processor, the number of cores of this process, and the system."""
    return {
        "cpu": cpu_model(),
        "cores": available_cores(),
        "machine": platform.machine(),
        "platform": platform.platform(),
        "environment": {name: os.environ.get(name) for name in _ENVIRONMENT},
    }


def available_cores() -> int:
    """Number of processors that this process may run on, at least 1."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def share_threads() -> None:
    """Limit the threads of torch, ONNX Runtime and the kernels to one fewer than the cores, which leaves one core for
    the threads that read and write frames."""
    import torch

    torch.set_num_threads(max(1, min(torch.get_num_threads(), available_cores() - 1)))


def load_average() -> float | None:
    """Mean number of running or waiting processes over the last minute; None if the system does not report it."""
    return os.getloadavg()[0] if hasattr(os, "getloadavg") else None


def cpu_model() -> str:
    """The processor's name from /proc/cpuinfo, or else from the platform module."""
    information = Path("/proc/cpuinfo")
    if information.exists():
        for line in information.read_text().splitlines():
            name, _, value = line.partition(":")
            if name.strip() == "model name":
                return value.strip()
    return platform.processor() or platform.machine() or "unknown"


def require_device(name: str) -> str:
    """The name of a device of torch, checked by an allocation on it. Raises ValueError: the device does not exist
    here."""
    import torch

    try:
        torch.zeros((), device=name).item()  # a device without data, "meta", fails here
    except (RuntimeError, AssertionError) as error:
        raise ValueError(f"--device {name} is not available: {str(error).splitlines()[0]}") from error
    return name


def device_of(name: str, local: int) -> str:
    """The device of process number ``local``: for "cuda" the GPU of that number (modulo the GPUs), else ``name``.
    Raises ValueError: the device does not exist."""
    import torch

    if name == "cuda" and torch.cuda.is_available():
        name = f"cuda:{local % torch.cuda.device_count()}"
    return require_device(name)

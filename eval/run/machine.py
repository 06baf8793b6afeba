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
# Distributions that only a report of a problem names.
_FURTHER = ("opencv-python-headless", "transformers", "safetensors", "lightning", "pycolmap", "rosbags", "rerun-sdk")
# Environment variables that change the time of parallel loops, especially under other load.
_ENVIRONMENT = ("OMP_NUM_THREADS", "OMP_WAIT_POLICY", "MKL_NUM_THREADS", "NUMBA_NUM_THREADS", "NUMBA_THREADING_LAYER")


def versions() -> dict[str, str | None]:
    """Versions of the packages on which results depend, and of Python; None = not installed."""
    installed = {name: _installed(distribution) for name, distribution in _PACKAGES.items()}
    return {**installed, "python": platform.python_version()}


def _installed(distribution: str) -> str | None:
    try:
        return version(distribution)
    except PackageNotFoundError:
        return None


def hardware() -> dict[str, Any]:
    """The processor, the number of cores of this process, and the system."""
    return {
        "cpu": cpu_model(),
        "cores": available_cores(),
        "machine": platform.machine(),
        "platform": platform.platform(),
        "environment": {name: os.environ.get(name) for name in _ENVIRONMENT},
    }


def system() -> dict[str, str]:
    """Versions and hardware in words, for a report of a problem; no names of files or users."""
    import torch

    packages = {**versions(), **{name: _installed(name) for name in _FURTHER}}
    gpus = [torch.cuda.get_device_name(i) for i in range(torch.cuda.device_count())]
    memory = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") if hasattr(os, "sysconf") else None
    return {
        **{name: value or "not installed" for name, value in packages.items()},
        "system": platform.platform(),
        "processor": f"{cpu_model()}, {available_cores()} cores",
        "memory": "unknown" if memory is None else f"{memory / 2**30:.0f} GiB",
        "GPU": f"{', '.join(gpus)} (CUDA {torch.version.cuda})" if gpus else "none that torch can use",
        "vectors": torch.backends.cpu.get_cpu_capability(),
        **{name: value for name, value in hardware()["environment"].items() if value is not None},
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

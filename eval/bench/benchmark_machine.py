"""What a measurement was made with: versions, hardware, threads, and how busy the machine was."""

from __future__ import annotations

import os
import platform
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

_PACKAGES = {"ufmstar_torch": "ufmstar-torch", "torch": "torch", "numba": "numba", "numpy": "numpy"}
_OPTIONAL = {"torchvision": "torchvision", "llvmlite": "llvmlite"}
# Settings of the environment that change how long a parallel loop takes, above all beside other work.
_ENVIRONMENT = ("OMP_NUM_THREADS", "OMP_WAIT_POLICY", "MKL_NUM_THREADS", "NUMBA_NUM_THREADS", "NUMBA_THREADING_LAYER")


def versions() -> dict[str, str | None]:
    """Versions of this package, what it computes with, and Python; None for what is not installed."""
    found: dict[str, str | None] = {name: _version(dist) for name, dist in (_PACKAGES | _OPTIONAL).items()}
    return {**found, "python": platform.python_version()}


def hardware() -> dict[str, Any]:
    """The processor, how many of it this process may use, and the system."""
    return {
        "cpu": cpu_model(),
        "cores": available_cores(),
        "machine": platform.machine(),
        "platform": platform.platform(),
        "environment": {name: os.environ.get(name) for name in _ENVIRONMENT},
    }


def available_cores() -> int:
    """Processors that this process may run on, at least 1."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def load_average() -> float | None:
    """Processes that ran or waited to over the last minute, None where the system does not tell."""
    return os.getloadavg()[0] if hasattr(os, "getloadavg") else None


def cpu_model() -> str:
    """The processor's name as Linux gives it, elsewhere what the platform module knows."""
    information = Path("/proc/cpuinfo")
    if information.exists():
        for line in information.read_text().splitlines():
            name, _, value = line.partition(":")
            if name.strip() == "model name":
                return value.strip()
    return platform.processor() or platform.machine() or "unknown"


def _version(distribution: str) -> str | None:
    try:
        return version(distribution)
    except PackageNotFoundError:
        return None

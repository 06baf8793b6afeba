"""The progress of a command and the time of its stages, and the compilation before its first frame."""

from __future__ import annotations

import time
from collections.abc import Callable, Collection, Iterator
from contextlib import contextmanager
from dataclasses import dataclass

import torch

from ufmstar_torch.anchors.names import CORNERS, DENSE
from ufmstar_torch.config import UfMStarConfig


@dataclass(frozen=True)
class Progress:
    """The progress of a command."""

    stage: str  # "kernels" (compiled on a machine's first run), "rooms", "frames", "pictures" or "figures"
    done: int  # number of finished steps of this stage, skipped frames included
    total: int  # number of steps of this stage
    components: int | None = None  # of the first row with components; None before the first frame
    skipped: int = 0  # number of frames skipped so far


def warm_up_command(
    config: UfMStarConfig, show: Callable[[Progress], object], anchors: Collection[object] = ()
) -> None:
    """Compile UfM* and the sources of ``anchors`` that are named in it ("corners", "dense"), or load them from disk."""
    from ufmstar_torch.anchors.dense import DenseEvidence
    from ufmstar_torch.anchors.tracker import LandmarkTracker
    from ufmstar_torch.runtime.warm_up import warm_up
    from ufmstar_torch.ufmstar import UfMStar

    searching = {CORNERS: LandmarkTracker, DENSE: DenseEvidence}
    sources = [kind for name, kind in searching.items() if name in anchors]
    warm_up(UfMStar(config), (32, 32), 1, lambda done, total: show(Progress("kernels", done, total)), sources)


@contextmanager
def timed(ms: dict[str, float], stage: str, device: torch.device) -> Iterator[None]:
    """Record the time of a block, with the work that it queues on a device, as ``ms[stage]`` [ms], unless it raises."""
    synchronize(device)
    started = time.perf_counter()
    yield
    synchronize(device)
    ms[stage] = 1000 * (time.perf_counter() - started)


def synchronize(device: torch.device) -> None:
    """Wait for the work that is queued on a device."""
    if device.type == "cuda":
        torch.cuda.synchronize(device)

"""Compiles the kernels that a command needs before its first frame (``ufmstar_torch.runtime.warm_up``)."""

from __future__ import annotations

from collections.abc import Callable, Collection
from functools import partial

from ufmstar_torch.anchors.dense import DenseEvidence
from ufmstar_torch.anchors.sources import CORNERS, DENSE
from ufmstar_torch.anchors.tracker import LandmarkTracker
from ufmstar_torch.config import UfMStarConfig
from ufmstar_torch.eval.engine.progress import Progress
from ufmstar_torch.runtime.warm_up import along_wall, warm_up
from ufmstar_torch.ufmstar import UfMStar

_SEARCHING = {CORNERS: LandmarkTracker, DENSE: DenseEvidence}


def warm_up_command(
    config: UfMStarConfig, show: Callable[[Progress], object], anchors: Collection[object] = ()
) -> None:
    """Compile UfM* and the sources of ``anchors`` that are named in it ("corners", "dense"), or load them from disk."""
    also = [partial(along_wall, kind()) for name, kind in _SEARCHING.items() if name in anchors]
    warm_up(UfMStar(config), (32, 32), 1, lambda done, total: show(Progress("kernels", done, total)), also)

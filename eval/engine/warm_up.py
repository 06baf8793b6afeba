"""Compiles the kernels that a command needs before its first frame (``ufmstar_torch.warm_up``)."""

from __future__ import annotations

from collections.abc import Callable

from ufmstar_torch.config import UfMStarConfig
from ufmstar_torch.eval.engine.progress import Progress
from ufmstar_torch.ufmstar import UfMStar
from ufmstar_torch.warm_up import dense_anchors, warm_up


def warm_up_command(config: UfMStarConfig, show: Callable[[Progress], object], *, dense: bool = False) -> None:
    """Compile UfM* and, if ``dense``, the search of ``DenseEvidence``, or load them from disk."""
    also, ufm = [dense_anchors] if dense else [], UfMStar(config)
    warm_up(ufm, (32, 32), 1, lambda done, total: show(Progress("kernels", done, total)), also)

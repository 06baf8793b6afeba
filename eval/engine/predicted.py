"""What a network says of one frame, alone and put together."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from ufmstar_torch.pipeline import combine
from ufmstar_torch.prediction import DepthPrediction


@dataclass(frozen=True, eq=False)
class Predicted:
    """One prediction.

    Attributes:
        depth: [h, w] float32 [m].
        aleatoric: [h, w] float32 A [m^2], or None.
        epistemic: [h, w] float32 E [m^2], or None.
        intrinsics: [3, 3] float64 of the depth map [px], on the CPU.
        ms: that the inference took, or all of them together [ms]; None where no network ran.
    """

    depth: Tensor
    aleatoric: Tensor | None
    epistemic: Tensor | None
    intrinsics: Tensor
    ms: float | None = None

    @property
    def size(self) -> tuple[int, int]:
        """(h, w)."""
        return self.depth.shape[0], self.depth.shape[1]

    def to(self, device: torch.device) -> Predicted:
        """With its maps on a device."""
        a, e = self.aleatoric, self.epistemic
        return replace(
            self,
            depth=self.depth.to(device),
            aleatoric=None if a is None else a.to(device),
            epistemic=None if e is None else e.to(device),
        )

    def maps(self) -> dict[str, Tensor]:
        """Those of depth, aleatoric and epistemic that are there."""
        named = {"depth": self.depth, "aleatoric": self.aleatoric, "epistemic": self.epistemic}
        return {name: value for name, value in named.items() if value is not None}


def from_network(prediction: DepthPrediction, intrinsics: Tensor, ms: float | None) -> Predicted:
    """What a network returned for one image, [1, h, w], in single precision."""

    def plain(value: Tensor | None) -> Tensor | None:
        return None if value is None else value[0].detach().float()

    maps = plain(prediction.aleatoric_variance), plain(prediction.epistemic_variance)
    return Predicted(prediction.depth[0].detach().float(), *maps, intrinsics.cpu().double(), ms)


def together(predictions: Sequence[Predicted]) -> Predicted:
    """The mixture of all members' or samples' predictions (see ``pipeline.combine``); the times are added.

    Raises:
        ValueError: no prediction.
    """

    def batch(value: Tensor | None) -> Tensor | None:
        return None if value is None else value[None]

    joint = combine([DepthPrediction(p.depth[None], batch(p.aleatoric), batch(p.epistemic)) for p in predictions])
    times = [p.ms for p in predictions if p.ms is not None]
    ms = sum(times) if len(times) == len(predictions) else None
    with torch.no_grad():
        return from_network(joint, predictions[0].intrinsics, ms)

"""Where a prediction comes from: a network's member, or the sequence's own depth."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Protocol

import torch
from torch import Tensor

from ufmstar_torch.eval.engine.predicted import Predicted, from_network
from ufmstar_torch.eval.engine.run_clock import Stopwatch
from ufmstar_torch.eval.engine.run_maps import PredictedMap
from ufmstar_torch.eval.sequences.frame import Frame, FrameError, Size
from ufmstar_torch.eval.sequences.ground_truth import depth_camera
from ufmstar_torch.eval.sequences.images import image_tensor
from ufmstar_torch.models.dropout import set_sampling
from ufmstar_torch.models.network import DepthNetwork

# Sample n of frame i is seeded by i + 1,000,003 n: another seed for every pair as long as a sequence has fewer
# frames than that, and below 2^32, of which torch's generator on the CPU takes no more.
_SAMPLE_STRIDE = 1_000_003


class Predictor(Protocol):
    """Predicts a frame by one of its members or samples."""

    def one(self, frame: Frame, n: int) -> Predicted:
        """Of member or sample n.

        Raises:
            FrameError: the frame has nothing to predict from.
        """
        ...


class MemberPredictor:
    """Runs networks.

    Args:
        members: N networks that want the same input; moved to ``device``.
        device: where they run.
        sampling: "one" counts the samples of a single network with decoder dropout instead of members.
    """

    def __init__(self, members: Sequence[DepthNetwork], device: torch.device, *, sampling: bool) -> None:
        self._members = [member.to(device).eval() for member in members]
        self._device, self._sampling = device, sampling
        self._clock = Stopwatch(device)
        self._generator = torch.Generator(device)
        self._input: tuple[Frame, Tensor, Tensor] | None = None
        if sampling:
            set_sampling(self._members[0], True, self._generator)

    def one(self, frame: Frame, n: int) -> Predicted:
        """See :class:`Predictor`."""
        with torch.no_grad():
            x, K = self._prepared(frame)
            if self._sampling:
                self._generator.manual_seed(frame.index + _SAMPLE_STRIDE * n)
            with self._clock.stage("network"):
                prediction = self._members[0 if self._sampling else n](x)
            return from_network(prediction, K[0], self._clock.take()["network"])

    def _prepared(self, frame: Frame) -> tuple[Tensor, Tensor]:
        """The networks' input [1, 3, h, w] and its intrinsics [1, 3, 3]; once for all members."""
        if self._input is None or self._input[0] is not frame:
            image = image_tensor(frame).to(self._device)
            x, K = self._members[0].preprocess(image, torch.from_numpy(frame.intrinsics)[None])
            self._input = (frame, x, K)
        return self._input[1], self._input[2]


class TruthPredictor:
    """The sequence's own depth.

    Args:
        size: (h, w) to which it is brought; None = as it is.
    """

    def __init__(self, size: Size | None) -> None:
        self._size = size

    def one(self, frame: Frame, n: int) -> Predicted:
        """See :class:`Predictor`."""
        if frame.depth is None:
            raise FrameError(frame.name, "no depth map")
        found = PredictedMap(frame.depth, None, depth_camera(frame)).resized(self._size)
        return Predicted(torch.from_numpy(found.depth).float(), None, None, torch.from_numpy(found.intrinsics).double())

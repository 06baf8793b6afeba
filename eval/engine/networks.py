"""Networks as a depth source: alternating members, or samples of MC-Dropout, with timed inferences."""

from __future__ import annotations

import copy
import hashlib
from collections.abc import Iterable, Mapping
from dataclasses import replace
from typing import Any, cast
from weakref import WeakKeyDictionary

import torch
from torch import Tensor, nn

from ufmstar_torch.eval.engine.predictions import DepthSource
from ufmstar_torch.eval.engine.progress import timed
from ufmstar_torch.eval.methods.setting import CROP, OF_NETWORK, RESIZE
from ufmstar_torch.eval.sequences.frame import Frame
from ufmstar_torch.eval.sequences.images import image_tensor
from ufmstar_torch.frames.prediction import DepthPrediction, NetworksInTurn
from ufmstar_torch.models.dropout import MonteCarloDropout, set_sampling
from ufmstar_torch.models.ensemble import LazyMember
from ufmstar_torch.models.inference import BF16, runtime_of
from ufmstar_torch.models.network import DepthNetwork
from ufmstar_torch.models.preprocess import Preprocess

# Sample n of frame i has the seed i + 1,000,003 n. Seeds are unique in sequences with fewer frames than that, and stay
# below 2^32, the limit of torch's generator on the CPU.
_SAMPLE_STRIDE = 1_000_003


class NetworkSource(DepthSource):
    """Depth from networks, moved to ``device``. ``precision`` is as ``Inference.precision``; predictions are always of
    single precision.

    Sample n of frame i (decoder dropout) is seeded by i and n, so it does not depend on earlier frames, the number of
    processes.
    """

    needs_image = True

    def __init__(
        self,
        networks: NetworksInTurn,
        device: torch.device,
        identity: Mapping[str, Any],
        *,
        precision: str = "float32",
        label: str = "",
        digest: str = "",
    ) -> None:
        super().__init__(identity, label, digest)
        self._turns = networks.to(device)
        self.networks = cast("tuple[DepthNetwork, ...]", tuple(self._turns.networks))
        self.max_depth, self.passes = self._turns.max_depth, self._turns.passes
        self.states_confidence = self._turns.states_confidence
        self.stochastic = len(self.networks) == 1 and bool(stochastic(networks.networks))
        self._device, self._precision = device, precision
        self._generator = torch.Generator(device)
        self._inputs: WeakKeyDictionary[Frame, tuple[Tensor, Tensor]] = WeakKeyDictionary()
        for network in stochastic(networks.networks):
            set_sampling(network, True, self._generator)

    @property
    def runtime(self) -> Mapping[str, Any]:
        """See :class:`DepthSource`."""
        return runtime_of(self.networks[0], self._precision)

    def prepared(self, how: str) -> NetworkSource:
        """The same networks and generator with another preprocessing of images. Raises ValueError: the networks do not
        declare their input by a ``Preprocess``."""
        declared = self._turns.preprocess
        if how == OF_NETWORK:
            return self
        if not isinstance(declared, Preprocess):
            raise ValueError(f'preprocess = "{how}" needs networks that declare their input by a Preprocess')
        changed = prepared_as(declared, how)
        if changed == declared:
            return self
        other = copy.copy(self)
        other._turns = NetworksInTurn(self.networks, samples=self._turns.samples, preprocess=changed)
        other._inputs = WeakKeyDictionary()
        other.identity = {**self.identity, "preprocess": how}
        other.digest = self.digest and hashlib.sha256(f"{self.digest} {how}".encode()).hexdigest()
        return other

    def turn(self, position: int) -> int:
        """See :class:`DepthSource`."""
        return self._turns.turn(position)

    def one(self, frame: Frame, n: int) -> DepthPrediction:
        """One inference, of member (or sample) n. Raises FrameError: the frame has no image."""
        with torch.no_grad():
            x, K = self._input(frame)
            self._generator.manual_seed(frame.index + _SAMPLE_STRIDE * n)
            reduced, ms = self._precision == BF16, dict[str, float]()
            autocast = torch.autocast(self._device.type, torch.bfloat16, enabled=reduced)
            with timed(ms, "network", self._device), autocast:
                maps = self._turns.member(x, K, n)
        prediction = replace(maps, intrinsics=K.cpu().double(), ms=ms["network"])
        return prediction.to(torch.float32) if reduced else prediction

    def prepare(self, frame: Frame) -> None:
        """See ``DepthSource``; on the processor."""
        if self._device.type == "cpu" and frame.image is not None:
            self._input(frame)

    def _input(self, frame: Frame) -> tuple[Tensor, Tensor]:
        """The networks' input [1, 3, h, w] and its intrinsics [1, 3, 3], computed once per frame."""
        if frame not in self._inputs:
            image, K = image_tensor(frame).to(self._device), torch.from_numpy(frame.intrinsics)[None]
            with torch.no_grad():
                self._inputs[frame] = self._turns.prepare(image, K)
        return self._inputs[frame]


def prepared_as(declared: Preprocess, how: str) -> Preprocess:
    """The preprocessing of a network under ``Setting.preprocess``."""
    return {OF_NETWORK: declared, RESIZE: declared.of_whole_frame(), CROP: declared.of_nyu_crop()}[how]


def stochastic(networks: Iterable[nn.Module]) -> list[MonteCarloDropout]:
    """The networks that sample."""
    opened = [network.network() if isinstance(network, LazyMember) else network for network in networks]
    return [network for network in opened if isinstance(network, MonteCarloDropout)]

"""The networks of a base, taken apart: depth alone, one inference with its uncertainty, and all of them."""

from __future__ import annotations

import copy
from collections.abc import Mapping, Sequence

import torch
from torch import Tensor

from ufmstar_torch.eval.bench.memory import NetworkMemory, tensor_bytes
from ufmstar_torch.eval.engine.predictions import DepthSource
from ufmstar_torch.eval.methods.method import BASES
from ufmstar_torch.models.batch_ensemble import BatchEnsembleMember
from ufmstar_torch.models.dropout import SAMPLES, DecoderDropout, MonteCarloDropout
from ufmstar_torch.models.ensemble import Ensemble, LazyMember
from ufmstar_torch.models.heads import DepthOnlyNetwork, UncertaintyNetwork
from ufmstar_torch.models.network import Backbone, DepthNetwork
from ufmstar_torch.pipeline import combine
from ufmstar_torch.prediction import DepthPrediction, infer


class Inseparable(Exception):
    """What a network spends on depth alone cannot be told from the rest; the message says why."""


class Contender:
    """The loaded network(s) of a base, on one device and in eval mode.

    Args:
        base: a key of ``BASES``.
        members: in the order of their turns; for "mc_dropout" one network that samples by itself.
        label: the architecture as shown, "FastDepth". Bases of one label share a part of the table.
        samples: of "mc_dropout", passes per image of the multi-inference baseline.

    Attributes:
        depth: the network without anything that uncertainty adds: of the first member, a copy.
        why_whole: None, or why ``depth`` is the whole network instead.

    Raises:
        ValueError: another base, no member, or members that want different inputs.
    """

    def __init__(self, base: str, members: Sequence[DepthNetwork], label: str, samples: int = SAMPLES) -> None:
        if base not in BASES:
            raise ValueError(f"base must be one of {', '.join(BASES)}, got {base!r}")
        opened = [_opened(member) for member in members]
        if not opened:
            raise ValueError(f"{base}: members must hold at least one network")
        if any(member.preprocess != opened[0].preprocess for member in opened):
            raise ValueError(f"{base}: members must want the same input")
        self.base, self.label = base, label
        self.members = tuple(member.eval() for member in opened)
        self.passes = samples if base == "mc_dropout" else len(self.members)
        self.preprocess = self.members[0].preprocess
        self.why_whole: str | None = None
        self.depth: DepthNetwork = self.members[0]
        try:
            self.depth = depth_alone(self.members[0])
        except Inseparable as error:
            self.why_whole = str(error)

    @property
    def several(self) -> bool:
        """Whether there is a multi-inference form: several members, or samples."""
        return self.passes > 1

    def once(self, x: Tensor, turn: int, intrinsics: Tensor | None = None) -> DepthPrediction:
        """One inference with its uncertainty, by the member whose turn it is, on an input with its intrinsics."""
        return self._run(self.members[turn % len(self.members)], x, intrinsics)

    def every(self, x: Tensor, intrinsics: Tensor | None = None) -> DepthPrediction:
        """All members, or samples, on the image, one after the other, combined."""
        return combine([self.once(x, n, intrinsics) for n in range(self.passes)])

    def alone(self, x: Tensor, intrinsics: Tensor | None = None) -> DepthPrediction:
        """Depth without uncertainty."""
        return self._run(self.depth, x, intrinsics)

    def memory(self) -> NetworkMemory | None:
        """Of depth alone and of the rest, or None where the tensors are not torch's (ONNX Runtime holds them)."""
        if not tensor_bytes(self.members):
            return None
        members = [self.depth] if self.base == "depth_only" else self.members
        return NetworkMemory.of(members, self.depth)

    def _run(self, network: DepthNetwork, x: Tensor, intrinsics: Tensor | None) -> DepthPrediction:
        with torch.inference_mode():
            prediction: DepthPrediction = infer(network, x, intrinsics)
        return prediction


def contenders(networks: Mapping[str, DepthSource]) -> dict[str, Contender]:
    """The networks of an evaluation by base; ground truth is none, since nothing runs."""
    return {
        base: Contender(base, one.networks, one.label, one.passes) for base, one in networks.items() if one.networks
    }


def depth_alone(network: DepthNetwork) -> DepthNetwork:
    """A copy of a network without what uncertainty adds: heads, sampling, factors of a BatchEnsemble.

    Raises:
        Inseparable: it is of a kind whose inside is not known here.
    """
    if isinstance(network, MonteCarloDropout):
        return depth_alone(network.network)
    if isinstance(network, BatchEnsembleMember):
        return depth_alone(network.ensemble.folded(network.n))
    if isinstance(network, UncertaintyNetwork):
        return depth_alone(network.backbone)
    if not isinstance(network, Backbone):
        raise Inseparable(f"a {type(network).__name__} predicts all that it predicts in one")
    backbone = copy.deepcopy(network)
    for module in backbone.modules():
        if isinstance(module, DecoderDropout):
            module.sampling = False
    return DepthOnlyNetwork(backbone).eval()


def _opened(network: DepthNetwork) -> DepthNetwork:
    """A member as it is once it has been loaded.

    Raises:
        ValueError: several members in one, which could not be run in turn.
    """
    if isinstance(network, Ensemble):
        raise ValueError("members must be the ensemble's members one by one, not an Ensemble")
    return network.network() if isinstance(network, LazyMember) else network

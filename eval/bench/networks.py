"""The networks of a base in parts: depth alone, one inference with its uncertainty, and all of them."""

from __future__ import annotations

import copy
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import torch
from torch import Tensor, nn

from ufmstar_torch.eval.engine.networks import prepared_as
from ufmstar_torch.eval.engine.predictions import DepthSource
from ufmstar_torch.eval.methods.row import Row
from ufmstar_torch.eval.methods.setting import OF_NETWORK
from ufmstar_torch.eval.sequences.frame import Frame
from ufmstar_torch.eval.sequences.images import image_tensor
from ufmstar_torch.frames.prediction import DepthPrediction, NetworksInTurn, infer
from ufmstar_torch.models.batch_ensemble import BatchEnsembleMember
from ufmstar_torch.models.dropout import SAMPLES, DecoderDropout, MonteCarloDropout
from ufmstar_torch.models.ensemble import LazyMember
from ufmstar_torch.models.heads import UncertaintyNetwork, with_head
from ufmstar_torch.models.network import Backbone, DepthNetwork
from ufmstar_torch.models.onnx_network import OnnxNetwork

DEPTH, ONCE, EVERY = "depth", "once", "every"


class TimedNetwork:
    """The loaded network(s) of a base (a key of ``methods.method.BASES``), on one device and in eval mode.

    Args:
        base: key of ``BASES``.
        members: in the order in which they alternate; for "mc_dropout" one network, which samples.
        label: displayed name of the architecture, "FastDepth". Bases with the same label share a section of the table.
        samples: of "mc_dropout", passes per image of the multi-inference baseline.

    Attributes:
        passes: number of inferences of all members, or of all samples.
        depth: a copy of the first member without its uncertainty (``depth_alone``).
        why_whole: None, or why ``depth`` is the whole network instead.
    """

    def __init__(self, base: str, members: Sequence[DepthNetwork], label: str, samples: int = SAMPLES) -> None:
        opened = [member.network() if isinstance(member, LazyMember) else member for member in members]
        self.base, self.label, self.members = base, label, tuple(opened)
        self._turns = NetworksInTurn(opened, samples=samples if base == "mc_dropout" else None)
        self.passes, self.preprocess = self._turns.passes, opened[0].preprocess
        alone = depth_alone(opened[0])
        self.depth = alone or opened[0]
        self.why_whole = None if alone else f"a {type(opened[0]).__name__} predicts all that it predicts in one"

    def predict(self, part: str, x: Tensor, intrinsics: Tensor, *, turn: int = 0) -> DepthPrediction:
        """Predict with one ``part`` from the networks' input x [1, 3, H, W] with intrinsics [1, 3, 3] [px]: "depth"
        without uncertainty, "once" by the member of image ``turn``, or "every" member (or sample), combined."""
        with torch.inference_mode():
            if part == DEPTH:
                prediction: DepthPrediction = infer(self.depth, x, intrinsics)
                return prediction
            if part == EVERY:
                return self._turns.every(x, intrinsics)
            index = turn % (SAMPLES if self.base == "mc_dropout" else len(self.members))
            return replace(self._turns.member(x, intrinsics, turn), member=index)

    def prepare(self, frame: Frame, device: torch.device) -> tuple[Tensor, Tensor]:
        """The networks' input of a frame, and its intrinsics, on a device. Raises FrameError: it has no image."""
        K = torch.from_numpy(frame.intrinsics)[None].to(device)
        return self.preprocess(image_tensor(frame).to(device), K)

    def memory(self) -> dict[str, int] | None:
        """Bytes of the parameters of "depth" alone, of the rest as "uncertainty", and of all "buffers" (running means
        and variances, which the paper does not count); None if they are unknown (those of a wrapped function)."""
        everything, alone = parameter_bytes(*self.members), parameter_bytes(self.depth)
        if not everything:
            return None
        uncertainty = 0 if self.base == "depth_only" else everything - alone
        return {"depth": alone, "uncertainty": uncertainty, "buffers": buffer_bytes(*self.members)}


def parameter_bytes(*modules: nn.Module) -> int:
    """Bytes of the parameters of modules, and of ONNX Runtime's files. Shared tensors count once."""
    graphs = {m.path for module in modules for m in module.modules() if isinstance(m, OnnxNetwork)}
    files = sum(Path(path).stat().st_size for path in graphs)
    return _bytes(t for module in modules for t in module.parameters()) + files


def buffer_bytes(*modules: nn.Module) -> int:
    """Bytes of the buffers of modules. Shared tensors count once."""
    return _bytes(t for module in modules for t in module.buffers())


def _bytes(tensors: Iterable[Tensor]) -> int:
    return sum({(t.data_ptr(), t.nbytes): t.nbytes for t in tensors if t.numel()}.values())


def timed_networks(sources: Mapping[str, DepthSource], rows: Sequence[Row] = ()) -> dict[str, TimedNetwork]:
    """The networks of an evaluation by base; the base "ground truth" has none. Images are prepared as in the first of
    the ``rows`` of a base."""
    how = {row.method.base: row.setting.preprocess for row in reversed(rows)}
    timed = {b: TimedNetwork(b, one.networks, one.label, one.passes) for b, one in sources.items() if one.networks}
    for base, network in timed.items():
        network.preprocess = prepared_as(network.preprocess, how.get(base, OF_NETWORK))
    return timed


def depth_alone(network: DepthNetwork) -> DepthNetwork | None:
    """A copy of a network without heads, sampling or factors of a BatchEnsemble. An ONNX graph that declares only depth
    is returned unchanged. None if depth cannot be separated from uncertainty."""
    if isinstance(network, MonteCarloDropout):
        return depth_alone(network.network)
    if isinstance(network, BatchEnsembleMember):
        return depth_alone(network.ensemble.folded(network.n))
    if isinstance(network, UncertaintyNetwork):
        return depth_alone(network.backbone)
    if isinstance(network, OnnxNetwork) and len(network.fetched) == 1:
        return network
    if not isinstance(network, Backbone):
        return None
    backbone = copy.deepcopy(network)
    for module in backbone.modules():
        if isinstance(module, DecoderDropout):
            module.sampling = False
    return with_head(backbone, "depth").eval()

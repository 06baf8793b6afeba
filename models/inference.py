"""Loaded networks as they run fastest where nothing is trained: ONNX Runtime, or torch's better form of them.

Weights that come as an ONNX file run in ONNX Runtime on the processor, and on a GPU where it has its
provider. Everything else runs in torch: ``Backbone`` networks with channels last, FastDepth with its batch norms folded
(docs/results/speed.md has the times). The results equal those of the loaded network up to rounding.
"""

from __future__ import annotations

import copy
from dataclasses import dataclass
from importlib.metadata import version
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import torch
from torch import nn

from ufmstar_torch.checked import Checked, choice, number
from ufmstar_torch.models.batch_ensemble import BatchEnsembleMember
from ufmstar_torch.models.fastdepth import FastDepth
from ufmstar_torch.models.heads import UncertaintyNetwork
from ufmstar_torch.models.network import Backbone, DepthNetwork
from ufmstar_torch.models.onnx_network import OnnxNetwork, OnnxSpec, providers_for
from ufmstar_torch.models.outputs import METRIC, OutputSpec

ONNX, TORCH = "onnx", "torch"
BF16 = "bf16"


@dataclass(frozen=True)
class Inference(Checked):
    """How networks are run.

    Attributes:
        runtime: "auto" (ONNX Runtime for ONNX weights, torch for the rest), "torch" or "onnx".
        precision: "float32", or "bf16": torch's autocast to bfloat16, whose depths have 8 bits (.4 %).
        threads: CPU threads of one inference in ONNX Runtime; None = as many as torch uses. Its threads do not spin
            between two inferences, since the cores belong to the multiview step then.

    Raises:
        ValueError: a value is impossible, or ONNX Runtime is asked for bf16.
    """

    runtime: str = choice("auto", TORCH, ONNX)
    precision: str = choice("float32", BF16)
    threads: int | None = number(None, "", "1", 1)

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.runtime == ONNX and self.precision == BF16:
            raise ValueError("precision bf16 is torch's: ONNX Runtime computes in the file's own, use runtime torch")

    def options(self, model: str, device: torch.device) -> dict[str, Any]:
        """Further arguments of ``load_network`` for a model of that name."""
        if model != "onnx":
            return {}
        return {"threads": self.threads or torch.get_num_threads(), "providers": providers_for(device)}

    def ready(self, network: DepthNetwork, weights: Path, device: torch.device) -> DepthNetwork:
        """The network in the form in which it runs on ``device``; the one given stays as it is.

        Args:
            network: loaded from ``weights``, in eval mode.
            weights: its file or directory.
            device: where it will run.

        Raises:
            ValueError: the runtime or the precision is not one for these weights.
            ModuleNotFoundError: ``onnxruntime`` is asked for and not installed (extra ``models``).
        """
        if isinstance(network, OnnxNetwork):
            if self._torch_only:
                asked = f"runtime {self.runtime} in {self.precision}"
                raise ValueError(f"{weights} is a graph that only ONNX Runtime runs, not {asked}")
            return network
        if (graph := self._graph(network, weights, device)) is not None:
            return graph
        if self.runtime == ONNX:
            raise ValueError(
                "runtime onnx needs weights in an ONNX file, of the input's size and without dropout that samples, "
                f"got {weights}"
            )
        return _fast_in_torch(network)

    @property
    def _torch_only(self) -> bool:
        return self.runtime == TORCH or self.precision == BF16

    def _graph(self, network: DepthNetwork, weights: Path, device: torch.device) -> OnnxNetwork | None:
        """The file in ONNX Runtime, where that can replace the torch network of ours that was read from it."""
        if weights.suffix != ".onnx" or not isinstance(network, FastDepth) or network.dropout:
            return None
        if self.runtime != ONNX:
            if self._torch_only or find_spec("onnxruntime") is None:
                return None
            if device.type != "cpu" and len(providers_for(device)) == 1:
                return None
        graph = OnnxNetwork(weights, OnnxSpec(OutputSpec(METRIC)), **self.options("onnx", device))
        if any(own not in (None, side) for own, side in zip(graph.size, network.size, strict=True)):
            return None
        graph.preprocess = network.preprocess
        return graph


def runtime_of(network: nn.Module, precision: str) -> dict[str, Any]:
    """The runtime of a network, for the record: name, version, threads, provider (ONNX Runtime) and precision."""
    if isinstance(network, OnnxNetwork):
        own = {"provider": network.session.get_providers()[0], "threads": network.threads or None}
        return {"name": "onnxruntime", "version": version("onnxruntime"), **own, "precision": "as in the file"}
    return {"name": "torch", "version": torch.__version__, "threads": torch.get_num_threads(), "precision": precision}


def _fast_in_torch(network: DepthNetwork) -> DepthNetwork:
    """A copy with channels last and folded batch norms of a network for which it was measured; others as they are."""
    modules = list(network.modules())
    if isinstance(network, BatchEnsembleMember) or not any(isinstance(module, Backbone) for module in modules):
        return network
    if isinstance(network, FastDepth) and not network.dropout:
        return network.folded().to(memory_format=torch.channels_last)
    fast = copy.deepcopy(network)
    if isinstance(fast, UncertaintyNetwork) and isinstance(fast.backbone, FastDepth) and not fast.backbone.dropout:
        fast.backbone = fast.backbone.folded()
    return fast.to(memory_format=torch.channels_last)

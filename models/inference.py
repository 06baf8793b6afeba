"""The fastest form of loaded networks for inference.

ONNX weights run in ONNX Runtime, on the CPU or on a GPU with its provider. All others run in torch: ``Backbone``
networks in channels-last format, FastDepth with folded batch norms (docs/results/speed.md has the times). The results
equal those of the loaded network up to rounding.
"""

from __future__ import annotations

import copy
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path
from typing import Any

import torch
from torch import nn

from ufmstar_torch.models.batch_ensemble import BatchEnsembleMember
from ufmstar_torch.models.fastdepth import FastDepth
from ufmstar_torch.models.heads import UncertaintyNetwork
from ufmstar_torch.models.network import Backbone, DepthNetwork
from ufmstar_torch.models.onnx_network import OnnxNetwork, providers_for
from ufmstar_torch.runtime.checked import Checked, choice, number

ONNX, TORCH = "onnx", "torch"
BF16 = "bf16"


@dataclass(frozen=True)
class Inference(Checked):
    """Settings of inference.

    Attributes:
        runtime: "auto" (ONNX Runtime for ONNX weights, torch for the rest), "torch" or "onnx".
        precision: "float32", or "bf16": torch's autocast to bfloat16, whose depths have 8 bits (.4 %).
        threads: CPU threads of one inference in ONNX Runtime; None = torch's number. Its threads do not spin between
            two inferences, since the multiview step then needs the cores.

    Raises:
        ValueError: an invalid value, or bf16 with ONNX Runtime.
    """

    runtime: str = choice("auto", TORCH, ONNX)
    precision: str = choice("float32", BF16)
    threads: int | None = number(None, "", "1", 1)

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.runtime == ONNX and self.precision == BF16:
            raise ValueError("precision bf16 needs runtime torch: ONNX Runtime computes in the file's precision")

    def options(self, model: str, device: torch.device) -> dict[str, Any]:
        """Additional arguments of ``load_network`` for a model of that name."""
        threads = {"threads": self.threads or torch.get_num_threads()}
        if model == "onnx":
            return {**threads, "providers": providers_for(device)}
        if model == "fastdepth":
            return {**threads, "runtime": TORCH if self._torch_only else self.runtime, "device": device}
        return {}

    def ready(self, network: DepthNetwork, weights: Path, device: torch.device) -> DepthNetwork:
        """The fastest form of the network on ``device``; the argument is not changed.

        Args:
            network: loaded from ``weights``, in eval mode.
            weights: its file or directory.
            device: device of the inference.

        Raises:
            ValueError: the runtime or the precision does not support these weights.
        """
        if isinstance(network, OnnxNetwork):
            if self._torch_only:
                requested = f"runtime {self.runtime} in {self.precision}"
                raise ValueError(f"{weights} is a graph that only ONNX Runtime runs, not {requested}")
            return network
        if self.runtime == ONNX:
            raise ValueError(
                "runtime onnx needs weights in an ONNX file, of the input's size and without sampling dropout, "
                f"got {weights}"
            )
        return _fast_in_torch(network)

    @property
    def _torch_only(self) -> bool:
        return self.runtime == TORCH or self.precision == BF16


def runtime_of(network: nn.Module, precision: str) -> dict[str, Any]:
    """The runtime of a network, for the record: name, version, threads, provider (ONNX Runtime) and precision."""
    if isinstance(network, OnnxNetwork):
        details = {"provider": network.session.get_providers()[0], "threads": network.threads or None}
        return {"name": "onnxruntime", "version": version("onnxruntime"), **details, "precision": "as in the file"}
    return {"name": "torch", "version": torch.__version__, "threads": torch.get_num_threads(), "precision": precision}


def _fast_in_torch(network: DepthNetwork) -> DepthNetwork:
    """A copy with channels last and folded batch norms, for networks that are faster so; other networks unchanged."""
    modules = list(network.modules())
    if isinstance(network, BatchEnsembleMember) or not any(isinstance(module, Backbone) for module in modules):
        return network
    if isinstance(network, FastDepth) and not network.dropout:
        return network.folded().to(memory_format=torch.channels_last)
    fast = copy.deepcopy(network)
    if isinstance(fast, UncertaintyNetwork) and isinstance(fast.backbone, FastDepth) and not fast.backbone.dropout:
        fast.backbone = fast.backbone.folded()
    return fast.to(memory_format=torch.channels_last)

"""Depth networks: each is an ``nn.Module`` that takes an image and returns a ``DepthPrediction`` in metres.

The names below load their module when they are first used, not when this package is imported.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from ufmstar_torch.models.any_network import WrappedNetwork as WrappedNetwork
    from ufmstar_torch.models.any_network import wrap_network as wrap_network
    from ufmstar_torch.models.checkpoints import CheckpointError as CheckpointError
    from ufmstar_torch.models.checkpoints import load_state_dict_file as load_state_dict_file
    from ufmstar_torch.models.checkpoints import load_weights as load_weights
    from ufmstar_torch.models.checkpoints import save_checkpoint as save_checkpoint
    from ufmstar_torch.models.fastdepth import FastDepth as FastDepth
    from ufmstar_torch.models.fastdepth import FastDepthWidths as FastDepthWidths
    from ufmstar_torch.models.load import load_network as load_network
    from ufmstar_torch.models.network import DepthNetwork as DepthNetwork
    from ufmstar_torch.models.onnx_network import OnnxNetwork as OnnxNetwork
    from ufmstar_torch.models.onnx_network import OnnxSpec as OnnxSpec
    from ufmstar_torch.models.outputs import OutputSpec as OutputSpec
    from ufmstar_torch.models.preprocess import Preprocess as Preprocess

_HOME = {
    "CheckpointError": "checkpoints",
    "DepthNetwork": "network",
    "FastDepth": "fastdepth",
    "FastDepthWidths": "fastdepth",
    "OnnxNetwork": "onnx_network",
    "OnnxSpec": "onnx_network",
    "OutputSpec": "outputs",
    "Preprocess": "preprocess",
    "WrappedNetwork": "any_network",
    "load_network": "load",
    "load_state_dict_file": "checkpoints",
    "load_weights": "checkpoints",
    "save_checkpoint": "checkpoints",
    "wrap_network": "any_network",
}


def __getattr__(name: str) -> object:
    if name not in _HOME:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(f"{__name__}.{_HOME[name]}"), name)


def __dir__() -> list[str]:
    return sorted(_HOME)

"""Weights of a plain convolutional network in an ONNX file: every convolution with the batch norm that follows it.

This module reads only weights. The caller must check that graph and network compute the same (``FastDepth.from_onnx``
does, on one image).
"""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from ufmstar_torch.runtime.optional import optional

if TYPE_CHECKING:
    from onnx import ModelProto

_NORM = ("weight", "bias", "running_mean", "running_var")


@dataclass
class ConvWeights:
    """One convolution."""

    weight: Tensor  # [C_out, C_in / groups, k, k]
    bias: Tensor | None  # [C_out], or None
    # the following batch norm's weight, bias, running_mean, running_var [C_out]; empty without batch norm
    norm: dict[str, Tensor] = field(default_factory=dict)
    norm_eps: float = 0.0  # batch norm's epsilon

    def state(self) -> dict[str, Tensor]:
        """The weights as a state_dict of ``conv`` and ``norm``; only one of them has a bias."""
        state = {"conv.weight": self.weight}
        bias = torch.zeros(len(self.weight)) if self.bias is None else self.bias
        if not self.norm:
            return state | {"conv.bias": bias}
        norm = {**self.norm, "num_batches_tracked": torch.zeros((), dtype=torch.int64)}
        norm["running_mean"] = norm["running_mean"] - bias  # a bias before batch norm only shifts the mean
        return state | {f"norm.{key}": value for key, value in norm.items()}


def load_onnx_graph(path: str | Path) -> ModelProto:
    """Parse a file. Raises ModuleNotFoundError: ``onnx`` is not installed (extra ``models``); FileNotFoundError: there
    is no such file; ValueError: the file is not ONNX, or truncated."""
    onnx = optional("onnx", "reading weights from an ONNX file needs the package onnx", "'ufmstar-torch[models]'")
    from google.protobuf.message import DecodeError

    if not Path(path).is_file():
        raise FileNotFoundError(f"no ONNX file {path}")
    try:
        model: ModelProto = onnx.load(str(path))
    except DecodeError as error:
        raise ValueError(f"{path} is not a readable ONNX file ({error}): truncated or of another kind?") from error
    if not model.graph.node:
        raise ValueError(f"{path} is not a readable ONNX file (it has no nodes): truncated or of another kind?")
    return model


def read_convolutions(path: str | Path) -> list[ConvWeights]:
    """The convolutions of a graph in the order of execution, with their batch norms. Raises ModuleNotFoundError,
    FileNotFoundError: as :func:`load_onnx_graph`; ValueError: the file is damaged, a weight is not in it, or no node
    uses one."""
    graph = load_onnx_graph(path).graph
    from onnx import helper, numpy_helper

    tensors = {t.name: torch.tensor(numpy_helper.to_array(t)) for t in graph.initializer}
    names = {name: name for name in tensors}  # tensor in the graph -> initialiser
    produced: dict[str, ConvWeights] = {}
    layers: list[ConvWeights] = []
    for node in graph.node:
        if node.op_type == "Identity" and node.input[0] in names:  # two names for equal weights
            names[node.output[0]] = names[node.input[0]]
        if node.op_type not in ("Conv", "BatchNormalization"):
            continue
        if missing := [name for name in node.input[1:] if name not in names]:
            raise ValueError(f"{path}: {node.op_type} {node.output[0]!r} needs {missing} as weights in the file")
        weight_names = [names[name] for name in node.input[1:]]
        if node.op_type == "Conv":
            layer = ConvWeights(tensors[weight_names[0]], tensors[weight_names[1]] if len(weight_names) > 1 else None)
            produced[node.output[0]] = layer
            layers.append(layer)
        elif node.input[0] not in produced:
            raise ValueError(f"{path}: batch norm {node.output[0]!r} does not follow a convolution")
        else:
            layer = produced.pop(node.input[0])
            layer.norm = {key: tensors[name] for key, name in zip(_NORM, weight_names, strict=True)}
            layer.norm_eps = {a.name: helper.get_attribute_value(a) for a in node.attribute}.get("epsilon", 1e-5)
    used = {names.get(name, name) for node in graph.node for name in node.input}
    for name, value in tensors.items():
        counter = value.dim() == 0 and value.dtype == torch.int64  # batch norm's num_batches_tracked
        if name not in used and not counter:
            raise ValueError(f"{path}: initialiser {name!r} {tuple(value.shape)} is used by no layer")
    return layers

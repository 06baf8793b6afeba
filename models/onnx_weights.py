"""Reading the weights of a plain convolutional network out of an ONNX graph.

Such a graph is one chain: convolution, batch norm (or none, where it was folded into the convolution),
activation, now and then a doubling of the resolution and the addition of an earlier layer's output.
:func:`read_conv_chain` turns it into layers that can be compared with a network built in torch, and
accounts for every initialiser. A graph that is anything else is refused, never guessed at.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor

if TYPE_CHECKING:
    from onnx import GraphProto, ModelProto, NodeProto

# Pairs of (coordinate transformation, rounding) for which doubling repeats every pixel twice.
_REPEATING = {
    ("asymmetric", "floor"),
    ("asymmetric", "round_prefer_floor"),
    ("half_pixel", "round_prefer_floor"),
    ("half_pixel", "round_prefer_ceil"),
    ("pytorch_half_pixel", "round_prefer_floor"),
    ("pytorch_half_pixel", "round_prefer_ceil"),
}
_NORM_PARAMETERS = ("weight", "bias", "running_mean", "running_var")


@dataclass
class ConvLayer:
    """One convolution and what follows it up to the next one.

    Attributes:
        weight: [C_out, C_in / groups, k, k].
        bias: [C_out], or None.
        norm: batch norm's weight, bias, running_mean, running_var [C_out] and, where the file holds it,
            num_batches_tracked []; empty where the graph has no batch norm.
        norm_eps: what batch norm adds to the variance.
        activation: "relu", "relu6" or "none".
        upsampled: whether the output is doubled in size by repeating pixels.
        skip: the layer whose output (before doubling) is added after that, or None.
    """

    weight: Tensor
    bias: Tensor | None
    stride: int
    padding: int
    groups: int
    norm: dict[str, Tensor] = field(default_factory=dict)
    norm_eps: float = 0.0
    activation: str = "none"
    upsampled: bool = False
    skip: int | None = None

    def structure(self) -> dict[str, Any]:
        """Everything but the values: what two layers must share to compute the same function."""
        return {
            "weight": tuple(self.weight.shape),
            "stride": self.stride,
            "padding": self.padding,
            "groups": self.groups,
            "activation": self.activation,
            "upsampled": self.upsampled,
            "skip": self.skip,
        }

    def tensors(self) -> Iterator[Tensor]:
        """The layer's weights, each one initialiser of the file."""
        yield self.weight
        if self.bias is not None:
            yield self.bias
        yield from self.norm.values()


def load_onnx(path: str | Path) -> ModelProto:
    """The parsed file.

    Raises:
        ModuleNotFoundError: ``onnx`` is not installed (extra ``models``).
        FileNotFoundError: there is no such file.
        ValueError: the file is not ONNX, or cut off.
    """
    try:
        import onnx
        from google.protobuf.message import DecodeError
    except ModuleNotFoundError as error:
        raise ModuleNotFoundError(
            "reading weights from an ONNX file needs the package onnx: pip install 'ufmstar-torch[models]'"
        ) from error
    if not Path(path).is_file():
        raise FileNotFoundError(f"no ONNX file {path}")
    try:
        model = onnx.load(str(path))
    except DecodeError as error:
        raise ValueError(f"{path} is not a readable ONNX file ({error}): cut off or of another kind?") from error
    if not model.graph.node:
        raise ValueError(f"{path} is not a readable ONNX file (it has no nodes): cut off or of another kind?")
    return model


def read_conv_chain(path: str | Path) -> list[ConvLayer]:
    """The layers of a convolutional chain in the order of execution.

    Raises:
        ModuleNotFoundError, FileNotFoundError: as :func:`load_onnx`.
        ValueError: the file is broken, a node does not fit such a chain, or an initialiser is left over.
    """
    reader = _ChainReader(load_onnx(path).graph, str(path))
    return reader.read()


class _ChainReader:
    """Walks the nodes once; ``current`` is the tensor at the end of the chain so far."""

    def __init__(self, graph: GraphProto, path: str) -> None:
        from onnx import numpy_helper

        self.graph, self.path = graph, path
        self.constants = {t.name: torch.tensor(numpy_helper.to_array(t)) for t in graph.initializer}
        self.layers: list[ConvLayer] = []
        self.owner: dict[str, int] = {}  # initialiser -> its layer
        self.alias: dict[str, str] = {}
        self.activated: dict[str, int] = {}  # output of a layer before doubling -> the layer
        inputs = [i.name for i in graph.input if i.name not in self.constants]
        if len(inputs) != 1 or len(graph.output) != 1:
            raise ValueError(f"{path} must have one input and one output, got {inputs} and {len(graph.output)}")
        self.current = inputs[0]

    def read(self) -> list[ConvLayer]:
        steps: dict[str, Callable[[NodeProto, dict[str, Any]], None]] = {
            "Conv": self._conv,
            "BatchNormalization": self._norm,
            "Relu": self._relu,
            "Clip": self._clip,
            "Upsample": self._upsample,
            "Resize": self._upsample,
            "Add": self._add,
        }
        for node in self.graph.node:
            attributes = _attributes(node)
            if node.op_type == "Constant":
                self.constants[node.output[0]] = attributes["value"]
                continue
            if node.op_type == "Identity" and node.input[0] in self.constants:  # two names for equal weights
                self.alias[node.output[0]] = node.input[0]
                continue
            if node.op_type not in steps:
                raise self._unfit(node, f"expected one of {sorted(steps)}")
            if self.current not in node.input:
                raise self._unfit(node, f"its input should be {self.current!r}, the chain's end")
            steps[node.op_type](node, attributes)
            self.current = node.output[0]
            if not self.layers[-1].upsampled:
                self.activated[self.current] = len(self.layers) - 1
        if self.current != self.graph.output[0].name:
            raise ValueError(f"{self.path}: the chain ends in {self.current!r}, not in the graph's output")
        self._assign_leftovers()
        return self.layers

    def _unfit(self, node: NodeProto, why: str) -> ValueError:
        name = node.name or node.output[0]
        return ValueError(f"{self.path}: node {name!r} ({node.op_type}) does not fit a convolutional chain: {why}")

    def _weight(self, node: NodeProto, position: int, layer: int) -> Tensor:
        name = self.alias.get(node.input[position], node.input[position])
        if name not in self.constants:
            raise self._unfit(node, f"its input {name!r} should be a weight in the file")
        self.owner[name] = layer
        return self.constants[name]

    def _conv(self, node: NodeProto, a: dict[str, Any]) -> None:
        index = len(self.layers)
        weight = self._weight(node, 1, index)
        bias = self._weight(node, 2, index) if len(node.input) > 2 else None
        strides, pads = set(a.get("strides", (1,))), set(a.get("pads", (0,)))
        square = weight.dim() == 4 and weight.shape[-1] == weight.shape[-2]
        if len(strides) != 1 or len(pads) != 1 or set(a.get("dilations", (1,))) != {1} or not square:
            raise self._unfit(node, "expected a square kernel, equal strides and paddings, no dilation")
        if a.get("auto_pad", b"NOTSET") != b"NOTSET":
            raise self._unfit(node, "expected explicit padding")
        self.layers.append(ConvLayer(weight, bias, strides.pop(), pads.pop(), a.get("group", 1)))

    def _last(self, node: NodeProto) -> ConvLayer:
        if not self.layers:
            raise self._unfit(node, "expected a convolution first")
        return self.layers[-1]

    def _norm(self, node: NodeProto, a: dict[str, Any]) -> None:
        layer = self._last(node)
        if layer.norm or layer.activation != "none" or layer.upsampled:
            raise self._unfit(node, "expected batch norm right after a convolution")
        for position, name in enumerate(_NORM_PARAMETERS, start=1):
            layer.norm[name] = self._weight(node, position, len(self.layers) - 1)
        layer.norm_eps = a.get("epsilon", 1e-5)

    def _activate(self, node: NodeProto, kind: str) -> None:
        layer = self._last(node)
        if layer.activation != "none" or layer.upsampled:
            raise self._unfit(node, "expected one activation, before the doubling")
        layer.activation = kind

    def _relu(self, node: NodeProto, a: dict[str, Any]) -> None:
        self._activate(node, "relu")

    def _clip(self, node: NodeProto, a: dict[str, Any]) -> None:
        low, high = a.get("min", -torch.inf), a.get("max", torch.inf)
        if len(node.input) > 1 and node.input[1]:
            low = float(self._weight(node, 1, len(self.layers) - 1))
        if len(node.input) > 2 and node.input[2]:
            high = float(self._weight(node, 2, len(self.layers) - 1))
        if (low, high) != (0.0, 6.0):
            raise self._unfit(node, f"expected a clip to [0, 6] (ReLU6), got [{low}, {high}]")
        self._activate(node, "relu6")

    def _upsample(self, node: NodeProto, a: dict[str, Any]) -> None:
        layer = self._last(node)
        scales = a.get("scales")
        if scales is None:  # an input since opset 9; Resize has a region of interest before it since 11
            position = 2 if len(node.input) > 2 else 1
            scales = self._weight(node, position, len(self.layers) - 1).tolist()
        rounding = a.get("nearest_mode", b"round_prefer_floor").decode()
        transform = a.get("coordinate_transformation_mode", b"half_pixel").decode()
        repeats = node.op_type == "Upsample" or (transform, rounding) in _REPEATING
        if list(scales) != [1, 1, 2, 2] or a.get("mode", b"nearest") != b"nearest" or not repeats:
            raise self._unfit(node, f"expected every pixel repeated twice, got scales {list(scales)}")
        if layer.upsampled:
            raise self._unfit(node, "expected one doubling per layer")
        layer.upsampled = True

    def _add(self, node: NodeProto, a: dict[str, Any]) -> None:
        other = next(name for name in node.input if name != self.current)
        layer = self._last(node)
        if other not in self.activated or layer.skip is not None or not layer.upsampled:
            raise self._unfit(node, f"expected {other!r} to be an earlier layer's output, added after a doubling")
        layer.skip = self.activated[other]

    def _assign_leftovers(self) -> None:
        """What no node uses may only be batch norm's counters, which training writes beside its other
        parameters; each belongs to the layer whose initialisers precede it in the file."""
        layer: int | None = None
        for name in (t.name for t in self.graph.initializer):
            if name in self.owner:
                layer = self.owner[name]
                continue
            value = self.constants[name]
            norm = self.layers[layer].norm if layer is not None else {}
            counter = value.dim() == 0 and value.dtype == torch.int64
            if not counter or not norm or "num_batches_tracked" in norm:
                raise ValueError(f"{self.path}: initialiser {name!r} {tuple(value.shape)} is used by no layer")
            norm["num_batches_tracked"] = value


def _attributes(node: NodeProto) -> dict[str, Any]:
    from onnx import helper, numpy_helper

    values = {a.name: helper.get_attribute_value(a) for a in node.attribute}
    if node.op_type == "Constant":
        values["value"] = torch.tensor(numpy_helper.to_array(values["value"]))
    return values

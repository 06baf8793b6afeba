"""Sizes that the nodes of an ONNX graph state, checked before ONNX Runtime folds constants and allocates them."""

from __future__ import annotations

from collections.abc import Iterator
from math import prod
from typing import Any

from ufmstar_torch.files.limits import require_bytes
from ufmstar_torch.runtime.optional import optional

_SHAPES = 64  # [values] of constants that can be shapes: their content is needed, that of weights is not


def require_sizes(path: str) -> None:
    """Raise a ValueError if a tensor of the graph, with the shape that follows from constants, is larger than the
    limit. A file that cannot be read is left to ONNX Runtime, whose message names the fault."""
    optional("onnx", "checking the sizes in an ONNX file needs the package onnx", "'ufmstar-torch[models]'")
    import onnx
    from google.protobuf.message import DecodeError

    try:
        model = onnx.load(path, load_external_data=False)
        for weight in model.graph.initializer:
            if prod(weight.dims) > _SHAPES:
                weight.ClearField("raw_data")
        inferred = onnx.shape_inference.infer_shapes(model, data_prop=True)
    except (DecodeError, ValueError, onnx.shape_inference.InferenceError):
        return
    for name, size in _sizes(inferred.graph):
        require_bytes(f"{path}: the tensor {name!r} of the graph", size)


def _sizes(graph: Any) -> Iterator[tuple[str, int]]:
    """Name and bytes of the tensors of a graph and its subgraphs whose shapes are fixed."""
    from onnx import helper

    for value in (*graph.value_info, *graph.output):
        tensor = value.type.tensor_type
        sides = [side.dim_value for side in tensor.shape.dim]
        if tensor.elem_type and all(side.HasField("dim_value") for side in tensor.shape.dim):
            yield value.name, prod(sides) * helper.tensor_dtype_to_np_dtype(tensor.elem_type).itemsize
    for node in graph.node:
        for attribute in node.attribute:
            for inner in [attribute.g] if attribute.HasField("g") else attribute.graphs:
                yield from _sizes(inner)

"""Writes ONNX files node by node, independently of the code that reads them."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import onnx
import torch
from onnx import TensorProto, helper, numpy_helper

from ufmstar_torch.models.fastdepth import FastDepth, FastDepthWidths

Edit = Callable[[onnx.ModelProto], None]


def small_network(seed: int = 0) -> FastDepth:
    """A FastDepth with few channels, all counts different, and batch norms with non-initial statistics."""
    widths = FastDepthWidths((3, 6, 4, 7, 5, 8, 9, 10, 11, 6, 4, 5, 12, 13), (9, 8, 7, 6, 5))
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        network = FastDepth(widths)
        norms = [m for m in network.modules() if isinstance(m, torch.nn.BatchNorm2d)]
        for norm in norms:
            norm.momentum = 1.0  # one batch sets the statistics, so that activations do not grow
            torch.nn.init.uniform_(norm.weight, 0.7, 1.3)
            torch.nn.init.uniform_(norm.bias, 0.0, 0.5)
        with torch.no_grad():
            network(torch.rand(4, 3, 64, 64))
    for norm in norms:
        norm.momentum = 0.1
    return network.eval()


def write_fastdepth(path: Path, network: FastDepth, size: int = 64, *, opset: int = 13) -> Path:
    """Write ``network`` as a graph from its state_dict, convolution by convolution, with its batch norms if any."""
    state, weights, nodes = network.state_dict(), [], []

    def weight(key: str) -> str:
        weights.append(numpy_helper.from_array(state[key].numpy(), key))
        return key

    def unit(x: str, name: str, six: bool, **attributes: Any) -> str:
        inputs = [x, weight(f"{name}.conv.weight")]
        inputs += [weight(f"{name}.conv.bias")] if f"{name}.conv.bias" in state else []
        nodes.append(helper.make_node("Conv", inputs, [f"{name}/conv"], **attributes))
        y = f"{name}/conv"
        if f"{name}.norm.weight" in state:
            keys = [f"{name}.norm.{k}" for k in ("weight", "bias", "running_mean", "running_var")]
            nodes.append(helper.make_node("BatchNormalization", [y, *map(weight, keys)], [f"{name}/norm"]))
            y = f"{name}/norm"
        if six:
            weights.extend(numpy_helper.from_array(np.array(v, np.float32), f"{name}/{v}") for v in (0, 6))
            nodes.append(helper.make_node("Clip", [y, f"{name}/0", f"{name}/6"], [name]))
        else:
            nodes.append(helper.make_node("Relu", [y], [name]))
        return name

    def separable(x: str, name: str, six: bool, kernel: int, stride: int) -> str:
        channels = state[f"{name}.depthwise.conv.weight"].shape[0]
        pads = [kernel // 2] * 4
        x = unit(x, f"{name}.depthwise", six, group=channels, pads=pads, strides=[stride, stride])
        return unit(x, f"{name}.pointwise", six)

    x = unit("image", "encoder.0", True, pads=[1, 1, 1, 1], strides=[2, 2])
    for i in range(1, 14):
        x = separable(x, f"encoder.{i}", True, 3, 2 if i in (2, 4, 6, 12) else 1)
    for i, skip in enumerate((None, 5, 3, 1, None)):
        x = separable(x, f"decoder.{i}", False, 5, 1)
        scales = numpy_helper.from_array(np.array([1, 1, 2, 2], np.float32), f"scales{i}")
        weights.append(scales)
        nodes.append(
            helper.make_node(
                "Resize",
                [x, "", scales.name],
                [f"up{i}"],
                mode="nearest",
                coordinate_transformation_mode="asymmetric",
                nearest_mode="floor",
            )
        )
        x = f"up{i}"
        if skip is not None:
            nodes.append(helper.make_node("Add", [f"encoder.{skip}.pointwise", x], [f"sum{i}"]))
            x = f"sum{i}"
    nodes[-1].output[0] = x
    x = unit(x, "head", False)
    return save(path, nodes, weights, [("image", ["batch", 3, size, size])], [(x, None)], opset=opset)


def save(
    path: Path,
    nodes: Sequence[onnx.NodeProto],
    weights: Sequence[onnx.TensorProto],
    inputs: Sequence[tuple[str, Sequence[int | str] | None]],
    outputs: Sequence[tuple[str, Sequence[int | str] | None]],
    *,
    types: Sequence[int] = (),
    opset: int = 13,
) -> Path:
    """Write a graph. ``types``: types of the inputs, by default float."""
    kinds = [*types, *[TensorProto.FLOAT] * (len(inputs) - len(types))]
    graph = helper.make_graph(
        nodes,
        "test",
        [helper.make_tensor_value_info(n, k, s) for (n, s), k in zip(inputs, kinds, strict=True)],
        [helper.make_tensor_value_info(n, TensorProto.FLOAT, s) for n, s in outputs],
        weights,
    )
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", opset)], ir_version=8)
    onnx.save(model, str(path))
    return path


def edited(source: Path, target: Path, edit: Edit) -> Path:
    """Write a copy of a file after ``change`` has edited its graph."""
    model = onnx.load(str(source))
    edit(model)
    onnx.save(model, str(target))
    return target


def run_onnx(path: Path, image: torch.Tensor) -> torch.Tensor:
    """The first output [B, ...], image by image (graphs may have a fixed batch of 1)."""
    import onnxruntime as ort

    options = ort.SessionOptions()
    options.log_severity_level = 3
    options.intra_op_num_threads = 1
    session = ort.InferenceSession(str(path), options, providers=["CPUExecutionProvider"])
    name = session.get_inputs()[0].name
    return torch.cat([torch.from_numpy(session.run(None, {name: x[None].numpy()})[0]) for x in image])

"""The ONNX adapter: tiny graphs with known answers, layouts, units, batches, and every refusal."""

from __future__ import annotations

import copy
import pickle
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from onnx import TensorProto, helper, numpy_helper
from onnx_files import save
from torch import Tensor

from ufmstar_torch.models import OnnxNetwork, OnnxSpec, OutputSpec, Preprocess

METRIC, NAMED = OutputSpec("metric"), OutputSpec("metric", "depth")
COEFFICIENTS = (0.5, 0.25, 2.0)  # depth = .5 R + .25 G + 2 B


def depth_of(image: Tensor) -> Tensor:
    """[B, H, W] the depth that the tiny graphs compute from an RGB image [B, 3, H, W]."""
    return (image * image.new_tensor(COEFFICIENTS)[:, None, None]).sum(1)


def write(
    path: Path,
    shape: list[int | str] | None = None,
    *,
    coefficients: tuple[float, ...] = COEFFICIENTS,
    nhwc: bool = False,
    kind: int = TensorProto.FLOAT,
    spread: str | None = None,
    declared: list[int | str] | None = None,
) -> Path:
    """depth = a weighted sum of channels, as a 1x1 convolution; ``spread`` adds an output of R - 1."""
    kernel = np.array([coefficients], np.float32)[:, :, None, None]
    weights = [numpy_helper.from_array(kernel, "kernel")]
    nodes, x = [], "image"
    if kind != TensorProto.FLOAT:
        nodes.append(helper.make_node("Cast", [x], ["as_float"], to=TensorProto.FLOAT))
        x = "as_float"
    if nhwc:
        nodes.append(helper.make_node("Transpose", [x], ["nchw"], perm=[0, 3, 1, 2]))
        x = "nchw"
    nodes.append(helper.make_node("Conv", [x, "kernel"], ["depth" if not nhwc else "d"]))
    if nhwc:
        nodes.append(helper.make_node("Transpose", ["d"], ["depth"], perm=[0, 2, 3, 1]))
    outputs: list[tuple[str, list[int | str] | None]] = [("depth", None)]
    if spread:
        red = np.array([[1, 0, 0]], np.float32)[:, :, None, None]
        weights += [numpy_helper.from_array(red, "red"), numpy_helper.from_array(np.array(1, np.float32), "one")]
        nodes.append(helper.make_node("Conv", [x, "red"], ["r"]))
        nodes.append(helper.make_node("Sub", ["r", "one"], [spread]))
        outputs.append((spread, None))
    shape = shape or (["n", "h", "w", 3] if nhwc else ["n", 3, "h", "w"])
    return save(path, nodes, weights, [("image", shape)], outputs, types=[kind])


def write_with_camera(path: Path, shape: list[int | str], camera: list[int | str], names: tuple[str, str]) -> Path:
    """depth = the first channel times fx; the image is single, the intrinsics double precision."""
    fx = numpy_helper.from_array(np.array([[1, 0, 0]], np.float64), "fx")
    ones = numpy_helper.from_array(np.array([[1], [0], [0]], np.float64), "ones")
    shape_of = numpy_helper.from_array(np.array([-1, 1, 1, 1], np.int64), "shape")
    red = numpy_helper.from_array(np.array([[[[1]], [[0]], [[0]]]], np.float32), "red")
    nodes = [
        helper.make_node("MatMul", ["fx", names[1]], ["row"]),
        helper.make_node("MatMul", ["row", "ones"], ["f"]),
        helper.make_node("Cast", ["f"], ["single"], to=TensorProto.FLOAT),
        helper.make_node("Reshape", ["single", "shape"], ["focal"]),
        helper.make_node("Conv", [names[0], "red"], ["channel"]),
        helper.make_node("Mul", ["channel", "focal"], ["depth"]),
    ]
    inputs = [(names[0], shape), (names[1], camera)]
    types = [TensorProto.FLOAT, TensorProto.DOUBLE]
    return save(path, nodes, [fx, ones, shape_of, red], inputs, [("depth", None)], types=types)


@pytest.mark.parametrize("batch", ["n", 1])
def test_a_second_input_for_the_intrinsics(tmp_path: Path, image: Tensor, batch: int | str) -> None:
    """Every image has its camera, also with a graph for one image at a time, and in copies of the network."""
    path = write_with_camera(tmp_path / "n.onnx", [batch, 3, "h", "w"], [batch, 3, 3], ("image", "K"))
    spec = {"outputs": {"kind": "metric", "focal": 300.0}, "takes_intrinsics": True, "input": "image"}
    K = torch.diag_embed(torch.tensor([[300.0, 300, 1], [600, 600, 1], [200, 100, 1]], dtype=torch.float64))
    network = OnnxNetwork(path, spec)
    for twin in (network, copy.deepcopy(network)):
        assert twin.takes_intrinsics
        unit = torch.tensor([300.0, 1200, 100])[:, None, None]  # fx (fx + fy) / 2 / 300
        torch.testing.assert_close(twin(image, K).depth, image[:, 0] * unit)
    with pytest.raises(ValueError, match=r"n.onnx takes intrinsics: call network\(x, K\)"):
        network(image)


@pytest.mark.parametrize(
    ("camera", "spec", "message"),
    [
        ([1, 3, 3], {"input": "image"}, "must be the graph's only input; .* needs takes_intrinsics"),
        ([1, 3, 3], {"takes_intrinsics": True}, r"the spec's input names it, got None.*\['image', 'K'\]"),
        (
            [1, 1, 3, 3],
            {"takes_intrinsics": True, "input": "image"},
            r"'K' must be floating-point intrinsics \[B, 3, 3\]",
        ),
    ],
)
def test_refusals_of_a_second_input(tmp_path: Path, camera: list[int | str], spec: Any, message: str) -> None:
    path = write_with_camera(tmp_path / "n.onnx", [1, 3, "h", "w"], camera, ("image", "K"))
    with pytest.raises(ValueError, match=message):
        OnnxNetwork(path, {"outputs": {"kind": "metric"}, **spec})
    alone = write(tmp_path / "alone.onnx")
    with pytest.raises(ValueError, match="takes_intrinsics needs two inputs"):
        OnnxNetwork(alone, {"outputs": {"kind": "metric"}, "takes_intrinsics": True})


@pytest.fixture
def image() -> Tensor:
    return torch.rand(3, 3, 6, 8, generator=torch.Generator().manual_seed(0))


@pytest.mark.parametrize("shape", [["n", 3, "h", "w"], [1, 3, 6, 8], [3, 3, 6, 8], ["n", 3, 6, 8]], ids=str)
def test_depth_of_every_image_in_the_batch(tmp_path: Path, image: Tensor, shape: list[int | str]) -> None:
    network = OnnxNetwork(write(tmp_path / "n.onnx", shape), OnnxSpec(METRIC), threads=1)
    torch.testing.assert_close(network(image).depth, depth_of(image))
    assert network(image).aleatoric_variance is None


def test_layout_channels_and_scale(tmp_path: Path, image: Tensor) -> None:
    """NHWC, and a BGR graph with depth in millimetres."""
    path = write(tmp_path / "n.onnx", nhwc=True, coefficients=COEFFICIENTS[::-1])
    spec = OnnxSpec(OutputSpec("metric", scale=0.001), layout="NHWC", channels="bgr")
    torch.testing.assert_close(OnnxNetwork(path, spec)(image).depth, depth_of(image) / 1000)


@pytest.mark.parametrize(
    ("kind", "value_range", "tolerance"),
    [(TensorProto.FLOAT16, 1.0, 2e-3), (TensorProto.DOUBLE, 1.0, 1e-6), (TensorProto.UINT8, 255.0, 2.75 * 0.5)],
    ids=["half", "double", "bytes"],
)
def test_input_types(tmp_path: Path, image: Tensor, kind: int, value_range: float, tolerance: float) -> None:
    """The image is converted to the graph's input type; bytes are rounded, so by at most half a level."""
    spec = OnnxSpec(METRIC, Preprocess(value_range=value_range))
    network = OnnxNetwork(write(tmp_path / "n.onnx", kind=kind), spec)
    x = network.preprocess.apply_image(image)
    torch.testing.assert_close(network(x).depth, depth_of(image) * value_range, rtol=0, atol=tolerance)


def test_variances_in_square_metres(tmp_path: Path, image: Tensor) -> None:
    """Outputs are selected by name. The kinds of spreads: test_any_network.py."""
    path = write(tmp_path / "n.onnx", spread="spread")
    outputs = OutputSpec("metric", "depth", 0.5, aleatoric="spread", aleatoric_kind="log_std")
    prediction = OnnxNetwork(path, OnnxSpec(outputs))(image)
    torch.testing.assert_close(prediction.depth, depth_of(image) / 2)
    torch.testing.assert_close(prediction.aleatoric_variance, (image[:, 0] - 1).exp() ** 2 / 4)


def test_a_fixed_size_becomes_the_preprocessing(tmp_path: Path) -> None:
    """The graph's fixed size needs no declaration; a contradicting declaration is refused."""
    path = write(tmp_path / "n.onnx", ["n", 3, 6, 8])
    assert OnnxNetwork(path, OnnxSpec(METRIC)).preprocess == Preprocess(size=(6, 8))
    cropped = Preprocess(resize_height=20, crop=(12, 16))
    network = OnnxNetwork(path, OnnxSpec(METRIC, cropped))
    assert network.preprocess == Preprocess(resize_height=20, crop=(12, 16), size=(6, 8))
    x, _ = network.preprocess(torch.rand(1, 3, 48, 64), torch.eye(3)[None])
    assert network(x).depth.shape == (1, 6, 8)
    with pytest.raises(ValueError, match=r"input has a fixed size of 6 x 8 px, but .* is \(8, 8\)"):
        OnnxNetwork(path, OnnxSpec(METRIC, Preprocess(size=(8, 8))))


def test_copies_and_pickles(tmp_path: Path, image: Tensor) -> None:
    network = OnnxNetwork(write(tmp_path / "n.onnx"), OnnxSpec(METRIC), threads=1)
    for twin in (copy.deepcopy(network), pickle.loads(pickle.dumps(network))):
        assert twin.session is not network.session
        assert torch.equal(twin(image).depth, network(image).depth)
        assert twin.preprocess == network.preprocess


REFUSALS: dict[str, tuple[OnnxSpec, Tensor | None, str]] = {
    "several outputs": (OnnxSpec(METRIC), None, r"outputs are \['depth', 'spread'\]; declare which one is depth"),
    "no such output": (OnnxSpec(OutputSpec("metric", "depth", aleatoric="sigma")), None, r"it has no \['sigma'\]"),
    "no such input": (OnnxSpec(NAMED, input="x"), None, r"only input; it has \['image'\]"),
    "batch": (OnnxSpec(OutputSpec("metric", "depth")), torch.zeros(3, 3, 6, 8), "fixed batch of 2, .* got 3"),
    "size": (OnnxSpec(OutputSpec("metric", "depth")), torch.zeros(2, 3, 8, 6), "fixed size of 6 x 8, got 8 x 6"),
    "bytes": (
        OnnxSpec(OutputSpec("metric", "depth")),
        torch.zeros(2, 3, 6, 8).byte(),
        "image must be .* got torch.uint8",
    ),
}


@pytest.mark.parametrize("name", REFUSALS)
def test_names_and_images_that_do_not_fit(tmp_path: Path, name: str) -> None:
    spec, image, message = REFUSALS[name]
    path = write(tmp_path / "n.onnx", [2, 3, 6, 8], spread="spread")
    with pytest.raises(ValueError, match=message):
        OnnxNetwork(path, spec)(image)  # type: ignore[arg-type]


def pooled(tmp_path: Path) -> Path:
    """Depth at half the resolution."""
    nodes = [
        helper.make_node("ReduceMax", ["image"], ["max"], axes=[1], keepdims=1),
        helper.make_node("MaxPool", ["max"], ["depth"], kernel_shape=[2, 2], strides=[2, 2]),
    ]
    return save(tmp_path / "n.onnx", nodes, [], [("image", ["n", 3, "h", "w"])], [("depth", None)])


def test_outputs_of_another_resolution(tmp_path: Path, image: Tensor) -> None:
    """By default refused, because the input's intrinsics would not fit; optionally repeated pixel by pixel."""
    path = pooled(tmp_path)
    with pytest.raises(ValueError, match=r"output 'depth' has \(3, 4\) px, expected the input's \(6, 8\)"):
        OnnxNetwork(path, OnnxSpec(METRIC))(image)
    got = OnnxNetwork(path, OnnxSpec(OutputSpec("metric", resize=True)))(image).depth
    small = torch.nn.functional.max_pool2d(image.amax(1), 2)
    torch.testing.assert_close(got, small.repeat_interleave(2, -1).repeat_interleave(2, -2))


@pytest.mark.parametrize(
    ("operation", "inputs", "options", "message"),
    [
        ("Sub", ["channel", "one"], {}, "NaN, infinite or negative at every pixel"),
        ("Cast", ["channel"], {"to": TensorProto.BOOL}, "not .* file that ONNX Runtime can run: .*Type"),
    ],
)
def test_a_graph_with_a_defect_is_named(
    tmp_path: Path, image: Tensor, operation: str, inputs: list[str], options: dict[str, Any], message: str
) -> None:
    """Further defects: test_any_network.py."""
    red = numpy_helper.from_array(np.array([[[[1]], [[0]], [[0]]]], np.float32), "red")
    one = numpy_helper.from_array(np.array(2, np.float32), "one")
    nodes = [
        helper.make_node("Conv", ["image", "red"], ["channel"]),
        helper.make_node(operation, inputs, ["depth"], **options),
    ]
    path = save(tmp_path / "n.onnx", nodes, [red, one], [("image", ["n", 3, "h", "w"])], [("depth", None)])
    with pytest.raises(ValueError, match=rf"n.onnx.* ({message})"):
        OnnxNetwork(path, OnnxSpec(METRIC))(image[:2])


@pytest.mark.parametrize("content", [b"", b"not a graph", None])
def test_files_that_are_no_graphs(tmp_path: Path, content: bytes | None) -> None:
    path = tmp_path / "broken.onnx"
    whole = write(tmp_path / "n.onnx").read_bytes()
    path.write_bytes(whole[: len(whole) // 2] if content is None else content)
    with pytest.raises(ValueError, match=r"broken.onnx is not an ONNX file that ONNX Runtime can run"):
        OnnxNetwork(path, OnnxSpec(METRIC))
    with pytest.raises(FileNotFoundError, match=r"none.onnx"):
        OnnxNetwork(tmp_path / "none.onnx", OnnxSpec(METRIC))


def test_a_node_that_fails_at_run_time_names_the_file(tmp_path: Path) -> None:
    """A graph whose reshape works for 8 x 8 images only, although its input size is dynamic."""
    red = numpy_helper.from_array(np.array([[[[1]], [[0]], [[0]]]], np.float32), "red")
    shape = numpy_helper.from_array(np.array([1, 1, 8, 8], np.int64), "shape")
    nodes = [
        helper.make_node("Conv", ["image", "red"], ["channel"]),
        helper.make_node("Reshape", ["channel", "shape"], ["depth"]),
    ]
    path = save(tmp_path / "n.onnx", nodes, [red, shape], [("image", ["n", 3, "h", "w"])], [("depth", None)])
    network = OnnxNetwork(path, OnnxSpec(METRIC))
    assert network(torch.rand(1, 3, 8, 8)).depth.shape == (1, 8, 8)
    with pytest.raises(ValueError, match=r"(?s)n.onnx: a node fails when .*\(1, 3, 16, 16\).*preprocess.size"):
        network(torch.rand(1, 3, 16, 16))

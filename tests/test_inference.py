"""Inference in ``run`` and ``eval``: the runtime, its effect and its records; ONNX Runtime and LiteRT."""

from __future__ import annotations

import json
import pickle
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from layouts import write_tum
from litert_network import LiteRTNetwork
from onnx_files import small_network, write_fastdepth
from PIL import Image
from runs import job_of, outputs, read_summary
from shared_data import require_shared
from torch import Tensor

from ufmstar_torch.eval.engine.load import NetworkChoice
from ufmstar_torch.eval.run.folder import FolderError
from ufmstar_torch.eval.run.run import run
from ufmstar_torch.eval.sequences import open_sequence
from ufmstar_torch.eval.sequences.frame import Frame
from ufmstar_torch.models import (
    FastDepth,
    FastDepthWidths,
    MonodepthResNet,
    OnnxNetwork,
    Preprocess,
    load_network,
    save_trained,
    with_head,
)
from ufmstar_torch.models.inference import Inference
from ufmstar_torch.models.trained import NetworkSpec, build_network

CPU = torch.device("cpu")
INT8 = "weights/fastdepth_nyu_int8.tflite"
METRIC = {"outputs": {"kind": "metric"}}


@pytest.fixture(scope="module")
def weights(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_fastdepth(tmp_path_factory.mktemp("onnx") / "small.onnx", small_network(), 224)


@pytest.fixture(scope="module")
def trained(tmp_path_factory: pytest.TempPathFactory) -> Path:
    spec = NetworkSpec(widths=0.25, positive="softplus", method="aleatoric")
    torch.manual_seed(0)
    path = tmp_path_factory.mktemp("trained") / "trained.safetensors"
    save_trained(path, [build_network(spec).eval()], spec)
    return path


def frame(height: int = 60, width: int = 80) -> Frame:
    image = np.random.default_rng(0).integers(0, 256, (height, width, 3), dtype=np.uint8)
    K = np.array([[70.0, 0, 40], [0, 70, 30], [0, 0, 1]])
    return Frame(0, "a", image, None, np.eye(4), K)


def predicted(model: str, file: Path, inference: Inference) -> tuple[Tensor, dict[str, Any]]:
    source = NetworkChoice("", model, (str(file),)).load(CPU, inference=inference)
    return source.one(frame(), 0).depth[0], {**source.runtime, "identity": source.identity}


def test_onnx_weights_run_in_onnx_runtime_and_agree_with_torch(weights: Path) -> None:
    depth, about = predicted("fastdepth", weights, Inference(threads=1))
    expected, other = predicted("fastdepth", weights, Inference("torch"))
    assert (about["name"], about["threads"], about["provider"]) == ("onnxruntime", 1, "CPUExecutionProvider")
    assert (other["name"], other["version"]) == ("torch", torch.__version__)
    assert about["identity"] != other["identity"]
    assert depth.std() > 1e-3
    assert (depth - expected).abs().max() < 1e-3 * expected.max()  # 1e-4 observed


def test_without_onnx_runtime_torch_runs_and_says_so(weights: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    expected, _ = predicted("fastdepth", weights, Inference("torch"))
    monkeypatch.setitem(sys.modules, "onnxruntime", None)
    with pytest.warns(UserWarning, match=r"without onnxruntime, .*small.onnx runs in torch, more slowly"):
        depth, about = predicted("fastdepth", weights, Inference())
    assert about["name"] == "torch"
    assert torch.equal(depth, expected)
    with pytest.warns(UserWarning, match="without"), pytest.raises(ModuleNotFoundError, match="onnxruntime"):
        predicted("fastdepth", weights, Inference("onnx"))


def test_a_graph_of_another_size_runs_in_torch(tmp_path: Path) -> None:
    """FastDepth's input is 224 x 224, also for graphs exported at another size."""
    small = write_fastdepth(tmp_path / "small.onnx", small_network(), 64)
    depth, about = predicted("fastdepth", small, Inference())
    assert (about["name"], depth.shape) == ("torch", (224, 224))
    with pytest.raises(ValueError, match="runtime onnx needs weights in an ONNX file, of the input's size"):
        predicted("fastdepth", small, Inference("onnx"))


@pytest.mark.parametrize(
    "network",
    [
        small_network(),
        with_head(small_network(), "aleatoric").eval(),
        with_head(FastDepth(FastDepthWidths.scaled(0.1), dropout=0.3), "evidential").eval(),
        MonodepthResNet(18).eval(),
    ],
    ids=["folded", "head", "dropout", "resnet"],
)
def test_torch_gets_its_faster_form(network: torch.nn.Module) -> None:
    """The optimised copy uses channels last and computes the same function; the original network is unchanged."""
    before = {name: value.clone() for name, value in network.state_dict().items()}
    fast = Inference().ready(network, Path("net.pth"), CPU)
    x = torch.rand(1, 3, 64, 64, generator=torch.Generator().manual_seed(1))
    with torch.inference_mode():
        got, expected = fast(x), network(x)
    torch.testing.assert_close(got.depth, expected.depth, rtol=1e-4, atol=1e-4)
    if expected.variance is not None:
        torch.testing.assert_close(got.variance, expected.variance, rtol=1e-3, atol=1e-4)
    kernels = [p for p in fast.parameters() if p.dim() == 4 and min(p.shape[1:]) > 1]
    assert kernels
    assert all(p.is_contiguous(memory_format=torch.channels_last) for p in kernels)
    assert all(torch.equal(value, before[name]) for name, value in network.state_dict().items())
    assert all(p.is_contiguous() for p in network.parameters())


def test_bf16_is_near_single_precision(trained: Path) -> None:
    """Predictions are single precision tensors with about 8 significant bits; the digests of the two runtimes
    differ."""
    depth, about = predicted("trained", trained, Inference(precision="bf16"))
    expected, _ = predicted("trained", trained, Inference())
    assert about["precision"] == "bf16"
    assert depth.dtype == torch.float32
    assert 0 < (depth / expected - 1).abs().max() < 0.05
    choice = NetworkChoice("aleatoric", "trained", (str(trained),))
    loaded = [choice.load(CPU, inference=Inference(precision=p)) for p in ("float32", "bf16")]
    assert loaded[0].digest != loaded[1].digest


@pytest.mark.parametrize(
    ("model", "inference", "message"),
    [
        ("trained", {"runtime": "onnx"}, "runtime onnx needs weights in an ONNX file"),
        ("onnx", {"runtime": "torch"}, "a graph that only ONNX Runtime runs, not runtime torch in float32"),
        ("onnx", {"precision": "bf16"}, "a graph that only ONNX Runtime runs, not runtime auto in bf16"),
    ],
)
def test_refusals(
    tmp_path: Path, weights: Path, trained: Path, model: str, inference: dict[str, str], message: str
) -> None:
    spec = tmp_path / "spec.json"
    spec.write_text(json.dumps(METRIC))
    file = trained if model == "trained" else weights
    choice = NetworkChoice("", model, (str(file),), str(spec) if model == "onnx" else None)
    with pytest.raises(ValueError, match=message):
        choice.load(CPU, inference=Inference(**inference))


def test_a_run_that_begins_again_is_the_same_and_needs_the_same_runtime(tmp_path: Path, weights: Path) -> None:
    write_tum(tmp_path / "seq")
    sequence = open_sequence(tmp_path / "seq" / "rgbd_dataset_freiburg2_desk")

    def job(inference: Inference) -> Any:
        return job_of(sequence, NetworkChoice("", "fastdepth", (str(weights),)).load(CPU, inference=inference))

    run(job(Inference()), tmp_path / "whole")
    stops = iter([False, True])
    run(job(Inference()), tmp_path / "out", stop=lambda: next(stops))
    with pytest.raises(FolderError, match="runtime"):
        run(job(Inference("torch")), tmp_path / "out")
    run(job(Inference()), tmp_path / "out")
    assert outputs(tmp_path / "out") == outputs(tmp_path / "whole")
    about = read_summary(tmp_path / "out")["runtime"]
    assert about["name"] == "onnxruntime"
    assert about["version"] == read_summary(tmp_path / "out")["versions"]["onnxruntime"]


def test_fastdepth_runs_in_onnx_runtime_unless_asked_otherwise(weights):
    graph, network = load_network("fastdepth", weights), load_network("fastdepth", weights, runtime="torch")
    assert isinstance(graph, OnnxNetwork)
    assert isinstance(network, FastDepth)
    assert graph.preprocess == network.preprocess == Preprocess.nyu()
    assert graph.threads == torch.get_num_threads()
    assert isinstance(load_network("fastdepth", weights, dropout=0.2), FastDepth)
    assert isinstance(load_network("fastdepth", weights, size=(64, 64)), FastDepth)  # the graph's size is fixed
    with pytest.raises(ValueError, match="runtime must be 'auto', 'onnx' or 'torch', got 'tensorrt'"):
        load_network("fastdepth", weights, runtime="tensorrt")


def test_onnx_has_fastdepths_crop_unless_the_spec_has_another(weights):
    assert load_network("onnx", weights, spec=METRIC).preprocess == Preprocess.nyu()
    stretched = load_network("onnx", weights, spec={**METRIC, "preprocess": {}})
    assert stretched.preprocess == Preprocess(size=(224, 224))


def test_int8_is_close_to_the_network_that_it_was_made_of():
    pytest.importorskip("ai_edge_litert")
    spec = {**METRIC, "preprocess": Preprocess.nyu().to_dict()}
    network = LiteRTNetwork(require_shared(INT8), spec, threads=1).eval()
    expected = load_network("fastdepth", require_shared("weights/fastdepth_nyu.onnx"), threads=1)
    picture = Path(require_shared("data/rgbd_dataset_freiburg1_xyz/rgb"))
    image = torch.from_numpy(np.array(Image.open(sorted(picture.glob("*.png"))[0]))).permute(2, 0, 1)[None]
    x, _ = network.preprocess(image, torch.eye(3)[None])
    depth, reference = network(x).depth, expected(x).depth
    assert depth.shape == (1, 224, 224)
    assert float((depth - reference).abs().median()) < 0.15  # [m] two quantisation steps
    np.testing.assert_allclose(depth / 0.07169981300830841, (depth / 0.07169981300830841).round(), atol=1e-3)
    torch.testing.assert_close(network(x.expand(2, -1, -1, -1)).depth, depth.expand(2, -1, -1))
    again = pickle.loads(pickle.dumps(network))
    torch.testing.assert_close(again(x).depth, depth)
    with pytest.raises(ValueError, match=r"has \(224, 224\) px, got \(96, 96\)"):
        network(torch.zeros(1, 3, 96, 96))


def test_litert_needs_a_spec_that_fits(tmp_path):
    pytest.importorskip("ai_edge_litert")
    file = require_shared(INT8)
    network = LiteRTNetwork(file, spec={"outputs": {"kind": "metric", "scale": 2.0, "max_depth": 9}})
    assert network.preprocess == Preprocess(size=(224, 224))
    assert network.max_depth == 9
    with pytest.raises(ValueError, match="needs a spec"):
        LiteRTNetwork(file)
    with pytest.raises(ValueError, match=r"it has no \['d'\]"):
        LiteRTNetwork(file, spec={"outputs": {"kind": "metric", "depth": "d"}})
    with pytest.raises(ValueError, match=r"preprocess\.size"):
        LiteRTNetwork(file, spec={**METRIC, "preprocess": {"size": [96, 96]}})
    with pytest.raises(FileNotFoundError, match=r"no \.tflite file"):
        LiteRTNetwork(tmp_path / "n.tflite", spec=METRIC)
    for content in (b"", b"TFL3 nothing", b"PK", Path(file).read_bytes()[:-1]):
        (tmp_path / "n.tflite").write_bytes(content)
        with pytest.raises(ValueError, match=r"n\.tflite is not a file that LiteRT can run"):
            LiteRTNetwork(tmp_path / "n.tflite", spec=METRIC)
    with pytest.raises(ValueError, match=r"int8\.tflite: takes_intrinsics is not supported"):
        LiteRTNetwork(file, spec={**METRIC, "takes_intrinsics": True})

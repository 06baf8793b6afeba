"""FastDepth in ONNX Runtime and LiteRT from Python: results of ``load_network``, the crop, depths, refusals."""

from __future__ import annotations

import pickle
from pathlib import Path

import numpy as np
import pytest
import torch
from onnx_files import small_network, write_fastdepth
from shared_data import require_shared

from ufmstar_torch.models import FastDepth, OnnxNetwork, Preprocess, load_network
from ufmstar_torch.models.inference import Inference, runtime_of

INT8 = "weights/fastdepth_nyu_int8.tflite"
METRIC = {"outputs": {"kind": "metric"}}




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
    network = load_network("fastdepth", require_shared(INT8), threads=1)
    expected = load_network("fastdepth", require_shared("weights/fastdepth_nyu.onnx"), threads=1)
    picture = Path(require_shared("data/rgbd_dataset_freiburg1_xyz/rgb"))
    from PIL import Image

    image = torch.from_numpy(np.array(Image.open(sorted(picture.glob("*.png"))[0]))).permute(2, 0, 1)[None]
    x, _ = network.preprocess(image, torch.eye(3)[None])
    depth, reference = network(x).depth, expected(x).depth
    assert depth.shape == (1, 224, 224)
    assert float((depth - reference).abs().median()) < 0.15  # [m] two of its steps
    np.testing.assert_allclose(depth / 0.07169981300830841, (depth / 0.07169981300830841).round(), atol=1e-3)
    torch.testing.assert_close(network(x.expand(2, -1, -1, -1)).depth, depth.expand(2, -1, -1))
    again = pickle.loads(pickle.dumps(network))
    torch.testing.assert_close(again(x).depth, depth)
    assert runtime_of(network, "float32")["name"] == "litert"
    with pytest.raises(ValueError, match=r"has \(224, 224\) px, got \(96, 96\)"):
        network(torch.zeros(1, 3, 96, 96))


def test_litert_needs_a_spec_that_fits(tmp_path):
    pytest.importorskip("ai_edge_litert")
    file = require_shared(INT8)
    network = load_network("litert", file, spec={"outputs": {"kind": "metric", "scale": 2.0, "max_depth": 9}})
    assert network.preprocess == Preprocess(size=(224, 224))
    assert network.max_depth == 9
    with pytest.raises(ValueError, match="needs a spec"):
        load_network("litert", file)
    with pytest.raises(ValueError, match=r"it has no \['d'\]"):
        load_network("litert", file, spec={"outputs": {"kind": "metric", "depth": "d"}})
    with pytest.raises(ValueError, match=r"preprocess\.size"):
        load_network("litert", file, spec={**METRIC, "preprocess": {"size": [96, 96]}})
    with pytest.raises(FileNotFoundError, match=r"no \.tflite file"):
        load_network("litert", tmp_path / "n.tflite", spec=METRIC)
    (tmp_path / "n.tflite").write_bytes(b"TFL3 nothing")
    with pytest.raises(ValueError, match="is not a file that LiteRT can run"):
        load_network("litert", tmp_path / "n.tflite", spec=METRIC)
    with pytest.raises(ValueError, match="a graph that only LiteRT runs"):
        Inference("onnx").ready(network, Path(file), torch.device("cpu"))

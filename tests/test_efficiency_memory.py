"""Memory of networks and of the state between images, against closed forms and the paper's figures."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest
import torch
from efficiency_cases import network
from onnx_files import small_network, write_fastdepth

from ufmstar_torch.eval.bench.measure import overhead_percent
from ufmstar_torch.eval.bench.networks import (
    DEPTH,
    EVERY,
    ONCE,
    TimedNetwork,
    depth_alone,
    parameter_bytes,
    timed_networks,
)
from ufmstar_torch.eval.bench.parts import MultiviewStep
from ufmstar_torch.eval.methods.method import Method
from ufmstar_torch.eval.methods.row import Row
from ufmstar_torch.eval.report.efficiency import megabytes
from ufmstar_torch.eval.sequences.frame import Frame
from ufmstar_torch.frames.prediction import DepthPrediction
from ufmstar_torch.models.batch_ensemble import BatchEnsemble, converted_layers
from ufmstar_torch.models.dropout import MonteCarloDropout
from ufmstar_torch.models.ensemble import LazyMember
from ufmstar_torch.models.fastdepth import FastDepth
from ufmstar_torch.models.heads import with_head
from ufmstar_torch.models.onnx_network import OnnxNetwork, OnnxSpec
from ufmstar_torch.models.outputs import OutputSpec


def step_memory(name, size, K):
    """The bytes in the table for the multiview step of a row after one frame."""
    step = MultiviewStep(Row(Method.parse(name)), torch.device("cpu"))
    depth, variance, K = torch.full((1, *size), 2.0), torch.full((1, *size), 0.01), torch.tensor([K]).double()
    prediction = DepthPrediction(depth, aleatoric_variance=variance, intrinsics=K)
    frame = Frame(0, "0", None, None, np.eye(4), K[0].numpy())
    step(None, frame, prediction, first=True)
    return step.memory()


def test_100k_points_of_ufm_are_4_megabytes_and_the_smoothing_map_a_fifth():
    ufm = step_memory("UfM-Ensemble-100K", (320, 320), [[300.0, 0, 160], [0, 300, 160], [0, 0, 1]])
    assert (ufm["bytes_end"], ufm["count_end"], ufm["smoothing_bytes"]) == (4_000_000, 100_000, 0)
    star = step_memory("UfM*-Ensemble", (224, 224), [[200.0, 0, 112], [0, 200, 112], [0, 0, 1]])
    assert star["smoothing_bytes"] == 224 * 224 * 4
    assert star["bytes_end"] == 84 * star["count_end"] > 0


def test_ten_members_are_90_percent():
    members = [network(offset=0.1 * n) for n in range(10)]
    memory = TimedNetwork("ensemble", members, "Linear").memory()
    head = parameter_bytes(members[0].head)
    assert memory == {"depth": 8, "uncertainty": 9 * 8 + 10 * head, "buffers": 0}  # the backbone has two weights
    assert overhead_percent(9, 1) == pytest.approx(90)


def test_fastdepth_weighs_what_the_paper_states_and_its_buffers_are_counted_apart():
    """The paper: 15.8 MB, and 142.6 MB for nine further members."""
    memory = TimedNetwork("ensemble", [FastDepth() for _ in range(10)], "FastDepth").memory()
    assert (megabytes(memory["depth"]), megabytes(memory["uncertainty"])) == ("15.8", "142.6")
    buffers = [b for module in FastDepth().modules() for b in module.buffers(recurse=False)]
    assert memory["buffers"] == 10 * sum(b.nbytes for b in buffers) > 1e6


def fast_depth(method, dropout=0.0):
    torch.manual_seed(1)
    backbone = FastDepth(dropout=dropout, positive="softplus", size=(64, 64))
    return with_head(backbone, method).eval()


def test_a_batch_ensemble_adds_its_factors_and_the_head():
    ensemble = BatchEnsemble(fast_depth("aleatoric"), 4).eval()
    one = TimedNetwork("batch_ensemble", ensemble.all_members(), "FastDepth")
    factors = sum(factor.nbytes for factor in ensemble.factors())
    biases = sum(layer.bias.nbytes for layer in converted_layers(ensemble.network) if layer.bias is not None)
    plain = fast_depth("aleatoric")
    head = plain.head.weight.nbytes  # its bias is one of the members' biases
    memory = one.memory()
    assert memory["depth"] == parameter_bytes(plain.backbone)
    assert memory["uncertainty"] == factors + biases + head
    x, K = torch.rand(1, 3, 64, 64), torch.eye(3)[None]
    torch.testing.assert_close(one.predict(DEPTH, x, K).depth, one.predict(ONCE, x, K).depth, rtol=1e-4, atol=1e-4)


def test_mc_dropout_adds_a_head_and_depth_alone_does_not_sample():
    sampling = MonteCarloDropout(fast_depth("aleatoric", dropout=0.2))
    one = TimedNetwork("mc_dropout", [sampling], "FastDepth", samples=3)
    x, K = torch.rand(1, 3, 64, 64), torch.eye(3)[None]
    assert one.memory()["uncertainty"] == parameter_bytes(sampling.network.head)
    assert torch.equal(one.predict(DEPTH, x, K).depth, one.predict(DEPTH, x, K).depth)
    assert not torch.equal(one.predict(ONCE, x, K).depth, one.predict(ONCE, x, K).depth)
    assert one.predict(EVERY, x, K).epistemic_variance.max() > 0
    assert one.passes == 3


def test_a_graph_of_onnx_runtime_is_depth_alone_and_weighs_what_its_file_does(tmp_path):
    path = write_fastdepth(tmp_path / "net.onnx", small_network())
    network = OnnxNetwork(path, OnnxSpec(OutputSpec("metric")), threads=1)
    timed = TimedNetwork("depth_only", [network], "FastDepth")
    assert timed.depth is network
    assert timed.why_whole is None
    assert timed.memory() == {"depth": path.stat().st_size, "uncertainty": 0, "buffers": 0}


def test_depth_alone_is_the_same_depth_from_a_copy():
    whole = fast_depth("evidential")
    alone = depth_alone(whole)
    x = torch.rand(1, 3, 64, 64)
    prediction = alone(x)
    assert torch.equal(prediction.depth, whole(x).depth)
    assert prediction.aleatoric_variance is None
    assert not {p.data_ptr() for p in alone.parameters()} & {p.data_ptr() for p in whole.parameters()}
    lazy = LazyMember(lambda: whole, whole.preprocess)
    assert TimedNetwork("evidential", [lazy], "FastDepth").memory()["uncertainty"] == parameter_bytes(whole.head)


def test_a_depth_only_row_is_not_charged_for_a_head_that_it_ignores():
    assert TimedNetwork("depth_only", [network()], "Linear").memory()["uncertainty"] == 0


def test_ground_truth_has_no_network_to_time():
    bases = {
        "depth_only": SimpleNamespace(networks=(), label="ground truth", passes=1),
        "aleatoric": SimpleNamespace(networks=(network(),), label="Linear", passes=1),
    }
    networks = timed_networks(bases)
    assert list(networks) == ["aleatoric"]
    assert networks["aleatoric"].label == "Linear"

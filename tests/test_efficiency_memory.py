"""Memory of networks and of what is kept between images, against closed forms and the paper's own figures."""

from __future__ import annotations

from types import SimpleNamespace

import pytest
import torch
from efficiency_cases import network

from ufmstar_torch import UfMStar
from ufmstar_torch.eval.bench.contender import Contender, contenders, depth_alone
from ufmstar_torch.eval.bench.memory import NetworkMemory, overhead_percent, tensor_bytes
from ufmstar_torch.eval.bench.multiview import state_bytes
from ufmstar_torch.eval.methods.ufm import UfM, UfMConfig
from ufmstar_torch.eval.report.efficiency import megabytes
from ufmstar_torch.models.batch_ensemble import BatchEnsemble, converted_layers
from ufmstar_torch.models.dropout import MonteCarloDropout
from ufmstar_torch.models.ensemble import Ensemble, LazyMember
from ufmstar_torch.models.fastdepth import FastDepth
from ufmstar_torch.models.heads import with_head
from ufmstar_torch.models.preprocess import Preprocess


def test_100k_points_of_ufm_are_4_megabytes_and_the_smoothing_map_a_fifth():
    ufm, ufm_star = UfM(UfMConfig(max_points=100_000)), UfMStar()
    pose, depth = torch.eye(4, dtype=torch.float64), torch.full((1, 320, 320), 2.0)
    ufm(depth, pose, torch.tensor([[300.0, 0, 160], [0, 300, 160], [0, 0, 1]], dtype=torch.float64))
    assert state_bytes(ufm) == (4_000_000, 100_000)
    assert megabytes(state_bytes(ufm)[0]) == "4.0"
    K = torch.tensor([[200.0, 0, 112], [0, 200, 112], [0, 0, 1]], dtype=torch.float64)
    ufm_star(torch.full((1, 224, 224), 2.0), pose, K)
    assert ufm_star.smoothed.nbytes == 224 * 224 * 4
    assert f"{ufm_star.smoothed.nbytes / 1e6:.1f}" == "0.2"
    held, components = state_bytes(ufm_star)
    assert held == 64 * components > 0


@pytest.mark.parametrize(("u", "d"), [(-1, 2), (1, -2), (0, 0)])
def test_overhead_needs_amounts(u, d):
    with pytest.raises(ValueError, match="must be amounts"):
        overhead_percent(u, d)


def test_fastdepth_has_the_papers_weights():
    full = FastDepth()
    assert f"{sum(p.nbytes for p in full.parameters()) / 1e6:.1f}" == "15.8"
    # Beside its weights it holds the statistics of its batch norms.
    assert tensor_bytes(full) == sum(p.nbytes for p in full.parameters()) + sum(b.nbytes for b in full.buffers())
    assert f"{9 * 15.844:.1f}" == "142.6"


def test_resnet50_monodepth2_is_the_papers_but_for_the_classifier():
    pytest.importorskip("torchvision")
    from ufmstar_torch.models.monodepth2 import MonodepthResNet

    with torch.device("meta"):
        weights = sum(p.nbytes for p in MonodepthResNet(50).parameters())
    classifier = 4 * (2048 * 1000 + 1000)
    assert f"{(weights + classifier) / 1e6:.1f}" == "138.3"
    assert f"{weights / 1e6:.1f}" == "130.1"


def test_ten_members_are_90_percent():
    members = [network(offset=0.1 * n) for n in range(10)]
    memory = Contender("ensemble", members, "Linear").memory()
    head = tensor_bytes(members[0].head)
    assert memory == NetworkMemory(8, 9 * 8 + 10 * head)  # the backbone has two weights
    equal = NetworkMemory.of([FastDepth(norm=False) for _ in range(3)], FastDepth(norm=False))
    assert overhead_percent(equal.uncertainty, equal.depth) == pytest.approx(200 / 3)


def test_shared_tensors_count_once():
    one = network()
    assert tensor_bytes([one, one, one.backbone]) == tensor_bytes(one)
    with pytest.raises(ValueError, match="less than"):
        NetworkMemory.of([one.head], one)


def fast_depth(method, dropout=0.0):
    torch.manual_seed(1)
    backbone = FastDepth(dropout=dropout, positive="softplus", size=(64, 64))
    return with_head(backbone, method).eval()


def test_a_batch_ensemble_adds_its_factors_and_the_head():
    ensemble = BatchEnsemble(fast_depth("aleatoric"), 4).eval()
    one = Contender("batch_ensemble", ensemble.all_members(), "FastDepth")
    factors = sum(factor.nbytes for factor in ensemble.factors())
    biases = sum(layer.bias.nbytes for layer in converted_layers(ensemble.network) if layer.bias is not None)
    plain = fast_depth("aleatoric")
    head = plain.head.weight.nbytes  # its bias is among the members' biases
    memory = one.memory()
    assert memory.depth == tensor_bytes(plain.backbone)
    assert memory.uncertainty == factors + biases + head
    x = torch.rand(1, 3, 64, 64)
    torch.testing.assert_close(one.alone(x).depth, one.once(x, 0).depth, rtol=1e-4, atol=1e-4)


def test_mc_dropout_adds_a_head_and_depth_alone_does_not_sample():
    sampling = MonteCarloDropout(fast_depth("aleatoric", dropout=0.2))
    one = Contender("mc_dropout", [sampling], "FastDepth", samples=3)
    x = torch.rand(1, 3, 64, 64)
    assert one.memory().uncertainty == tensor_bytes(sampling.network.head)
    assert torch.equal(one.alone(x).depth, one.alone(x).depth)
    assert not torch.equal(one.once(x, 0).depth, one.once(x, 0).depth)
    assert one.every(x).epistemic_variance.max() > 0
    assert one.passes == 3


def test_depth_alone_is_the_same_depth_from_a_copy():
    whole = fast_depth("evidential")
    alone = depth_alone(whole)
    x = torch.rand(1, 3, 64, 64)
    prediction = alone(x)
    assert torch.equal(prediction.depth, whole(x).depth)
    assert prediction.aleatoric_variance is None
    assert not {p.data_ptr() for p in alone.parameters()} & {p.data_ptr() for p in whole.parameters()}
    lazy = LazyMember(lambda: whole, whole.preprocess)
    assert Contender("evidential", [lazy], "FastDepth").memory().uncertainty == tensor_bytes(whole.head)


def test_a_depth_only_row_is_not_charged_for_a_head_that_it_ignores():
    assert Contender("depth_only", [network()], "Linear").memory().uncertainty == 0


def test_contenders_are_checked():
    with pytest.raises(ValueError, match="base must be one of"):
        Contender("median", [network()], "x")
    with pytest.raises(ValueError, match="at least one network"):
        Contender("ensemble", [], "x")
    with pytest.raises(ValueError, match="one by one"):
        Contender("ensemble", [Ensemble([network(), network()])], "x")
    other = network()
    other.preprocess = Preprocess(size=(8, 8))
    with pytest.raises(ValueError, match="same input"):
        Contender("ensemble", [network(), other], "x")


def test_ground_truth_is_no_contender():
    bases = {
        "depth_only": SimpleNamespace(networks=(), label="ground truth", passes=1),
        "aleatoric": SimpleNamespace(networks=(network(),), label="Linear", passes=1),
    }
    found = contenders(bases)
    assert list(found) == ["aleatoric"]
    assert found["aleatoric"].label == "Linear"

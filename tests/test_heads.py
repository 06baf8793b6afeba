"""Uncertainty heads and their distributions: closed forms, extreme inputs in every precision, unchanged depth."""

from __future__ import annotations

import math

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from onnx_files import small_network
from scipy import stats
from tiny_networks import Linear, constant_head
from torch import Tensor, nn

from ufmstar_torch.models import EvidentialDepth, MonodepthResNet, with_head
from ufmstar_torch.models.heads import BETA_FLOOR, EVIDENCE_FLOOR, HEADS, LOG_VARIANCE_RANGE, soft_range
from ufmstar_torch.models.module_backbone import ModuleBackbone, ModuleSpec
from ufmstar_torch.models.preprocess import Preprocess

DTYPES = (torch.float32, torch.float16, torch.bfloat16)
LOW, HIGH = LOG_VARIANCE_RANGE


def pixel(value: float) -> Tensor:
    return torch.full((1, 1, 1), value, dtype=torch.float64)


@given(gamma=st.floats(0.1, 100), nu=st.floats(0.01, 100), alpha=st.floats(1.05, 50), beta=st.floats(1e-4, 1e3))
def test_evidential_variance_is_the_students_t(gamma: float, nu: float, alpha: float, beta: float) -> None:
    """Marginally depth is Student-t with 2 alpha degrees of freedom (Amini et al., Eq. 7), whose variance is A + E."""
    prediction = EvidentialDepth(pixel(gamma), pixel(nu), pixel(alpha), pixel(beta)).prediction()
    marginal = stats.t(df=2 * alpha, loc=gamma, scale=math.sqrt(beta * (1 + nu) / (nu * alpha)))
    assert prediction.variance is not None
    assert float(prediction.depth) == pytest.approx(marginal.mean())
    assert float(prediction.variance) == pytest.approx(marginal.var(), rel=1e-9)


@given(st.floats(-1e4, 1e4), st.floats(0, 1e3))
def test_soft_range_is_monotone_and_bounded(x: float, more: float) -> None:
    a, b = (float(soft_range(torch.tensor(v, dtype=torch.float64), LOW, HIGH)) for v in (x, x + more))
    assert LOW - 1e-9 <= a <= b + 1e-9 <= HIGH + 2e-9


@pytest.mark.parametrize("x", [-60.0, -20.0, 0.0, 20.0, 60.0])
def test_soft_range_keeps_a_gradient(x: float) -> None:
    """A clamp's gradient is 0 outside of the range; the soft range's falls as e^-distance."""
    value = torch.tensor(x, requires_grad=True)
    soft_range(value, LOW, HIGH).backward()
    assert value.grad is not None
    distance = max(0.0, abs(x) - HIGH)
    assert 0.5 * math.exp(-distance) <= float(value.grad) <= math.exp(-distance) + 1e-6


@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize("raw", [-1e4, -100.0, 0.0, 100.0, 1e4])
@pytest.mark.parametrize("method", ["aleatoric", "evidential"])
def test_extremes_stay_finite(method: str, raw: float, dtype: torch.dtype) -> None:
    """Variances are positive and finite, gradients finite, computed in single precision for networks of any
    precision."""
    network = with_head(Linear(), method).to(dtype)
    head = network.head
    constant_head(head, (raw,) * head.out_channels)
    distribution = network.distribution(torch.rand(2, 3, 4, 6, dtype=dtype))
    values = list(vars(distribution).values())
    assert all(value.dtype == torch.float32 for value in values)
    prediction = distribution.prediction()
    for variance in (prediction.aleatoric_variance, prediction.epistemic_variance):
        assert variance is None or (torch.isfinite(variance).all() and variance.min() > 0)
    assert prediction.variance is not None
    (prediction.variance.log().sum() + prediction.depth.sum()).backward()
    for name, parameter in network.named_parameters():
        assert parameter.grad is not None, name
        assert torch.isfinite(parameter.grad).all(), name


def test_evidence_against_its_closed_form() -> None:
    """softplus(ln(e^y - 1)) = y: raw outputs chosen for nu = 2, alpha = 1 + 3, beta = .5 (all + the floors)."""
    network = with_head(Linear(), "evidential")
    constant_head(network.head, tuple(math.log(math.expm1(y)) for y in (2.0, 3.0, 0.5)))
    image = torch.rand(1, 3, 4, 6)
    d, prediction = network.distribution(image), network(image)
    for value, expected in ((d.nu, 2 + EVIDENCE_FLOOR), (d.alpha, 4 + EVIDENCE_FLOOR), (d.beta, 0.5 + BETA_FLOOR)):
        torch.testing.assert_close(value, torch.full_like(value, expected))
    torch.testing.assert_close(prediction.aleatoric_variance, torch.full((1, 4, 6), 0.5 / 3), rtol=1e-4, atol=0)
    torch.testing.assert_close(prediction.epistemic_variance, torch.full((1, 4, 6), 0.5 / 6), rtol=2e-4, atol=0)


@pytest.mark.parametrize("method", list(HEADS))
def test_a_head_shares_the_features(method: str) -> None:
    """The features are computed once, and gradients of depth and head reach them."""
    backbone = small_network()
    calls = []
    backbone.decoder.register_forward_pre_hook(lambda *_: calls.append(1))
    backbone.encoder[0].register_forward_hook(lambda *_: calls.append(1))
    network = with_head(backbone, method).train()
    prediction = network(torch.rand(2, 3, 64, 64))
    assert len(calls) == 1
    (prediction.depth.sum() if prediction.variance is None else prediction.variance.sum()).backward()
    assert backbone.encoder[0].conv.weight.grad is not None
    assert float(backbone.encoder[0].conv.weight.grad.abs().sum()) > 0


@pytest.mark.parametrize(("method", "size"), [("aleatoric", 8_656), ("evidential", 25_968)])
def test_heads_at_four_scales_as_the_paper_has_them(method: str, size: int) -> None:
    """With four scales, 8.7 and 26 kB on ResNet50-Monodepth2's decoder (.01 and .03 MB in the paper); with one, .58 and
    1.7 kB."""
    backbone = MonodepthResNet(18)
    for scales, expected in ((4, size), (1, {"aleatoric": 580, "evidential": 1_740}[method])):
        parameters = with_head(backbone, method, scales).named_parameters()
        assert sum(p.nbytes for name, p in parameters if not name.startswith("backbone")) == expected


@pytest.mark.parametrize("method", ["aleatoric", "evidential"])
def test_coarse_heads_learn_and_do_not_predict(method: str) -> None:
    """Training has four predictions per image with one depth; eval mode equals the network with one head bit for
    bit."""
    network = with_head(small_network(), method, 4)
    single = with_head(network.backbone, method).eval()
    single.head.load_state_dict(network.head.state_dict())
    x = torch.rand(2, 3, 64, 64, generator=torch.Generator().manual_seed(0))
    network.train()
    network.backbone.eval()
    message = network.distribution(x)
    assert message.depth.shape == (8, 64, 64)
    assert torch.equal(message.depth[:2], message.depth[6:])
    message.prediction().variance.sum().backward()
    heads = {name: p for name, p in network.named_parameters() if not name.startswith("backbone")}
    assert len(heads) == 8
    assert all(p.grad is not None and p.grad.any() for p in heads.values())
    assert network(x).depth.shape == (2, 64, 64)
    network.eval()
    assert torch.equal(network(x).variance, single(x).variance)
    assert torch.equal(network(x).depth, single(x).depth)
    with pytest.raises(ValueError, match="scales must be from 1 to 5 of this backbone, got 6"):
        with_head(small_network(), method, 6)


def test_a_part_that_is_called_by_keyword_is_read_as_any_other() -> None:
    class Network(nn.Module):
        def __init__(self, named: bool) -> None:
            super().__init__()
            self.widen, self.last, self.named = nn.Conv2d(3, 5, 1), nn.Conv2d(5, 1, 1), named

        def forward(self, image: torch.Tensor) -> torch.Tensor:
            x = self.widen(image)
            return 1 + (self.last(input=x) if self.named else self.last(x)).square()

    image, found = torch.rand(2, 3, 7, 9, generator=torch.Generator().manual_seed(0)), []
    for named in (False, True):
        torch.manual_seed(0)
        network = Network(named)
        spec = ModuleSpec.of(network, Preprocess(size=(24, 32)))
        assert (spec.part, spec.channels) == ("last", 5)
        found.append(ModuleBackbone(network, spec).eval().features(image))
    assert torch.equal(*found)

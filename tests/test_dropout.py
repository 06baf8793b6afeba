"""MC-Dropout: closed forms for a linear decoder; only the decoder is stochastic."""

from __future__ import annotations

import copy

import torch
from onnx_files import small_network
from test_monodepth2 import seeded
from tiny_networks import Linear
from torch import Tensor, nn

from ufmstar_torch.models import Backbone, DecoderDropout, FastDepth, MonteCarloDropout, set_sampling, with_head
from ufmstar_torch.models.dropout import SAMPLES

P = 0.2


def with_dropout(p: float = P) -> FastDepth:
    """A small FastDepth with dropout and the weights of ``small_network``."""
    source = small_network()
    network = FastDepth(source.widths, dropout=p)
    network.load_state_dict(source.state_dict(), strict=True)
    return network.eval()


def test_when_it_acts() -> None:
    layer, x = DecoderDropout(P), torch.ones(1000)
    assert not torch.equal(layer.train()(x), x)
    assert layer.eval()(x) is x
    assert set_sampling(layer, True) == 1
    assert not torch.equal(layer(x), x)
    assert set_sampling(layer, False) == 1
    assert layer(x) is x
    assert DecoderDropout(0.0).train()(x) is x
    assert layer.state_dict() == {}


def closed_form(backbone: Linear, image: Tensor) -> tuple[Tensor, Tensor]:
    """Mean and variance of depth = offset + sum_c w_c x_c m_c / (1 - p), m_c ~ Bernoulli(1 - p)."""
    terms = backbone.weights.detach()[None, :, None, None] * image[:, :2]
    p = backbone.dropout.p
    return backbone.offset + terms.sum(1), terms.square().sum(1) * p / (1 - p)


def test_moments_of_a_linear_decoder() -> None:
    """The moments over many passes against their limits. Tolerances are 5 standard errors: of the mean
    sqrt(V / T), of the variance V sqrt(2.25 / T), since a sum of two Bernoullis has a kurtosis below 3.25."""
    backbone, count = Linear(dropout=P), 4000
    image = 1 + torch.rand(2, 3, 4, 6, generator=seeded(1))
    mean, variance = closed_form(backbone, image)
    network = MonteCarloDropout(with_head(backbone, "depth"), count, generator=seeded(2)).eval()
    with torch.no_grad():
        prediction = network(image)
    assert prediction.aleatoric_variance is None
    assert prediction.epistemic_variance is not None
    assert ((prediction.depth - mean).abs() <= 5 * (variance / count).sqrt()).all()
    assert ((prediction.epistemic_variance - variance).abs() <= 5 * variance * (2.25 / count) ** 0.5).all()


def test_one_batch_draws_independently() -> None:
    """Passes in one batch share no mask, nor do images. Within an image the mask is per channel, so neighbouring pixels
    do not differ."""
    backbone, count = Linear(dropout=P), 4000
    network = MonteCarloDropout(with_head(backbone, "depth"), generator=seeded(3)).eval()
    with torch.no_grad():
        depth = network(torch.ones(2 * count, 3, 4, 6)).depth.reshape(2, count, -1)
    a, b = depth[0, :, 0], depth[1, :, 0]
    assert torch.equal(depth, depth[..., :1].expand_as(depth))
    next_pass = depth[0].roll(1, 0)[:, 0]
    for other in (b, next_pass):
        correlation = torch.corrcoef(torch.stack([a, other]))[0, 1]
        assert abs(float(correlation)) < 5 / count**0.5


def test_aleatoric_variance_is_averaged_and_evidence_added() -> None:
    """combine(): A = mean A_n; E = variance between + mean E_n."""
    image = 1 + torch.rand(1, 3, 4, 6, generator=seeded(4))
    for method in ("aleatoric", "evidential"):
        network = with_head(Linear(dropout=P), method)
        passes = MonteCarloDropout(network, generator=seeded(5)).eval()
        with torch.no_grad():
            single = [passes(image) for _ in range(SAMPLES)]
            together = MonteCarloDropout(network, SAMPLES, generator=seeded(5)).eval()(image)
        depth = torch.stack([p.depth for p in single])
        aleatoric = torch.stack([p.aleatoric_variance for p in single if p.aleatoric_variance is not None])
        between = depth.var(0, correction=0)
        epistemic = torch.stack(
            [torch.zeros_like(p.depth) if p.epistemic_variance is None else p.epistemic_variance for p in single]
        )
        assert float(between.max()) > 0
        torch.testing.assert_close(together.depth, depth.mean(0))
        torch.testing.assert_close(together.aleatoric_variance, aleatoric.mean(0))
        torch.testing.assert_close(together.epistemic_variance, between + epistemic.mean(0))


def backbones() -> list[Backbone]:
    from ufmstar_torch.models.monodepth2 import MonodepthResNet

    return [with_dropout(), MonodepthResNet(18, dropout=P).eval()]


def test_the_encoder_does_not_sample() -> None:
    """In two passes the encoder's output is equal bit for bit, the depth differs, and no statistic changes."""
    for backbone in backbones():
        seen: list[Tensor] = []
        last = [m for m in backbone.encoder.modules() if isinstance(m, nn.BatchNorm2d)][-1]
        last.register_forward_hook(lambda *args, seen=seen: seen.append(args[2].clone()))
        before = copy.deepcopy(backbone.state_dict())
        network = MonteCarloDropout(with_head(backbone, "aleatoric")).eval()
        image = torch.rand(1, 3, 64, 64, generator=seeded(6))
        with torch.no_grad():
            depth = [network(image).depth for _ in range(2)]
        assert len(seen) == 2
        assert torch.equal(*seen)
        assert float((depth[0] - depth[1]).abs().max()) > 1e-4
        after = backbone.state_dict()
        assert all(torch.equal(before[key], after[key]) for key in before)
        assert not any(isinstance(m, DecoderDropout) for m in backbone.encoder.modules())
        assert set_sampling(backbone, False) == 5
        with torch.no_grad():
            assert torch.equal(network(image).depth, network(image).depth)

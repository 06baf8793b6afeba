"""A network's confidence in an arbitrary unit: oracle, invariance to the unit, when it is ignored, and its state."""

from __future__ import annotations

import copy
import json
from types import SimpleNamespace

import numpy as np
import oracle_confidence as oracle
import pytest
import torch
from modules import same
from torch import nn

from ufmstar_torch import (
    AnchorConfig,
    DepthPrediction,
    Recalibration,
    UfMStar,
    UfMStarConfig,
    UncertainDepth,
    cli,
)
from ufmstar_torch.anchors import Anchors
from ufmstar_torch.eval.engine.estimators import make_estimator
from ufmstar_torch.eval.engine.evaluate import evaluate_sequence
from ufmstar_torch.eval.engine.networks import NetworkSource
from ufmstar_torch.eval.engine.predictions import PredictionCache
from ufmstar_torch.eval.methods.method import Method
from ufmstar_torch.eval.methods.row import Row
from ufmstar_torch.eval.methods.setting import Setting
from ufmstar_torch.eval.metrics.recalibration import figures_of_samples, fit_confidence
from ufmstar_torch.eval.tour import tour_sequence
from ufmstar_torch.frames.prediction import NetworksInTurn
from ufmstar_torch.models import Ensemble, OutputSpec, Preprocess, wrap_network
from ufmstar_torch.models.onnx_network import OnnxNetwork

PLAIN = UfMStarConfig(anchors=AnchorConfig())
CONFIG = PLAIN.replace(confidence=True)
SIZE = H, W = 24, 32
CPU = torch.device("cpu")
K = torch.tensor([[30.0, 0, 16], [0, 30, 12], [0, 0, 1]], dtype=torch.float64)


def frames(count, seed=0, n=150, dtype=torch.float64):
    """Depth, the standard deviation of its relative error (the source of the confidence), and anchors."""
    rng = np.random.default_rng(seed)
    for i in range(count):
        depth = 2 + 0.5 * np.sin(np.linspace(0, 3, W) + 0.1 * i)[None] * np.ones((H, 1))
        sigma = np.exp(rng.uniform(np.log(0.01), np.log(0.6), SIZE))
        at = rng.choice(H * W, n, replace=False)
        pixel = np.stack([at % W, at // W], -1).astype(float)
        g = np.abs(depth.flat[at] * (1 + sigma.flat[at] * rng.standard_normal(n)))
        anchors = Anchors(*(torch.from_numpy(x)[None] for x in (pixel, g, np.full(n, 1e-4))))
        T = torch.eye(4, dtype=torch.float64)
        T[0, 3] = 0.05 * i
        yield torch.from_numpy(depth)[None].to(dtype), torch.from_numpy(sigma)[None], anchors, T[None], at


def variances(config, unit, count=12, **how):
    ufm, maps = UfMStar(config, dtype=torch.float64), []
    for depth, sigma, anchors, T, _ in frames(count, **how):
        c = None if unit is None else unit(sigma)
        maps.append(ufm(depth, T, K, anchors=anchors, **({} if c is None else {"confidence": c})))
    return maps, ufm


def test_values_against_the_oracle():
    """From the first frame until the confidence is used. The input V is the plain module's."""
    state, plain = oracle.start(), variances(PLAIN, None, count=14)[0]
    maps, _ = variances(CONFIG, lambda sigma: 1 / (1 + sigma), count=14)
    for out, before, (depth, sigma, anchors, _, at) in zip(maps, plain, frames(14), strict=True):
        c = (1 / (1 + sigma[0])).float().double().numpy()
        predicted = depth[0].numpy().flat[at]
        values = (at, predicted, anchors.depth[0].numpy(), anchors.variance[0].numpy())
        state, expected = oracle.update(state, c, before.variance[0].numpy(), *values)
        np.testing.assert_allclose(out.variance[0], expected, rtol=1e-9)
        np.testing.assert_allclose(float(out.statistics.confidence), oracle.gain(state), rtol=1e-6)
    assert not same(out.variance, before.variance)
    worse = (out.variance / before.variance)[sigma > 0.3].mean()
    better = (out.variance / before.variance)[sigma < 0.03].mean()
    assert worse > 5 * better


def test_the_unit_does_not_count():
    """Monotonic transforms of the confidence give the same V; a decreasing one gives nearly the same."""
    (expected, _), *others = (
        variances(CONFIG, unit)
        for unit in (torch.log, lambda s: s, lambda s: 40 * s - 3, lambda s: s**3, lambda s: s.log().exp().sqrt())
    )
    for maps, _ in others:
        torch.testing.assert_close(maps[-1].variance, expected[-1].variance)
    inverted = variances(CONFIG, lambda s: -torch.log(s))[0][-1].variance
    assert (inverted / expected[-1].variance).log().abs().mean() < 0.1


@pytest.mark.parametrize("kind", ["random", "constant", "absent", "NaN"])
def test_what_says_nothing_is_ignored(kind):
    """V equals plain UfM*'s bit for bit."""
    generator = torch.Generator().manual_seed(1)
    units = {
        "random": lambda s: torch.rand(s.shape, generator=generator, dtype=s.dtype),
        "constant": torch.ones_like,
        "absent": None,
        "NaN": lambda s: torch.full_like(s, torch.nan),
    }
    maps, _ = variances(CONFIG, units[kind], count=20)
    plain, _ = variances(PLAIN, None, count=20)
    assert same(maps[-1].variance, plain[-1].variance)
    assert kind == "absent" or not bool(maps[-1].statistics.confidence > 0)


def test_what_the_confidence_meant_is_forgotten():
    """A confidence that changes its sign after 20 frames is soon ignored, and later used with the new sign."""
    ufm, used = UfMStar(CONFIG), []
    for i, (depth, sigma, anchors, T, _) in enumerate(frames(60, dtype=torch.float32)):
        out = ufm(depth, T, K, anchors=anchors, confidence=sigma.float() if i < 20 else -sigma.float())
        used.append(bool(out.statistics.confidence > 0))
    assert (used[19], used[-1]) == (True, True)
    assert not all(used[20:40])


def test_state_is_saved_restored_and_loaded_as_a_whole():
    inputs = list(frames(12, dtype=torch.float32))
    ufm, other = UfMStar(CONFIG), UfMStar(CONFIG)
    for depth, sigma, anchors, T, _ in inputs[:-1]:
        ufm(depth, T, K, anchors=anchors, confidence=sigma.float())
    other.load_state_dict(ufm.state_dict())
    depth, sigma, anchors, T, _ = inputs[-1]
    sample = ufm.mean_uncertainty(depth, T, K, confidence=sigma.float(), fraction=1.0)
    ufm.load_state_dict(other.state_dict())
    assert sample.mean > 0
    last = [one(depth, T, K, anchors=anchors, confidence=sigma.float()).variance for one in (ufm, other)]
    assert torch.equal(*last)
    for spoil in (lambda c: c.fill_(-1.0), lambda c: c[:, -4:].fill_(torch.nan)):
        wrong = {name: value.clone() for name, value in ufm.state_dict().items()}
        spoil(wrong["confidence"])
        before = {name: value.clone() for name, value in other.state_dict().items()}
        with pytest.raises(RuntimeError, match="confidence"):
            other.load_state_dict(wrong)
        assert all(same(value, before[name]) for name, value in other.state_dict().items())


def test_streams_of_a_batch_are_independent_and_anchors_may_be_padded():
    both, alone = UfMStar(CONFIG, dtype=torch.float64), UfMStar(CONFIG, dtype=torch.float64)
    for (d, s, a, T, _), (d2, s2, a2, T2, _) in zip(frames(10), frames(10, seed=1, n=60), strict=True):
        pad = [torch.cat([getattr(a2, name), getattr(a, name)[:, 60:]], 1) for name in ("pixel", "depth", "variance")]
        padded = Anchors(*pad, valid=torch.arange(150)[None] < 60)
        whole = [torch.cat([getattr(a, name), getattr(padded, name)]) for name in ("pixel", "depth", "variance")]
        valid = torch.stack([torch.ones(150, dtype=torch.bool), torch.arange(150) < 60])
        stacked = [torch.cat(pair) for pair in ((d, d2), (T, T2), (s, s2))]
        out = both(*stacked[:2], K.expand(2, 3, 3), anchors=Anchors(*whole, valid=valid), confidence=stacked[2])
        expected = alone(d2, T2, K, anchors=a2, confidence=s2)
    torch.testing.assert_close(out.variance[1:], expected.variance)


def test_offline_from_truth(tmp_path):
    """The factor is fitted to samples in any unit, applied with or without anchors, and saved as JSON."""
    rng = np.random.default_rng(0)
    sigma, V = np.exp(rng.uniform(-3, 1, (2, 4000))), np.exp(rng.uniform(-2, 2, (2, 4000)))
    e = (sigma * rng.standard_normal(sigma.shape)) ** 2 * V
    samples = [np.stack([1 / (1 + s**2), v, error], -1) for s, v, error in zip(sigma, V, e, strict=True)]
    fitted = fit_confidence(samples)
    assert (fitted.covariate, len(fitted.variance)) == ("confidence", 16)
    s = torch.linspace(0.06, 2.0, 30, dtype=torch.float64)
    assert float((fitted.factor(1 / (1 + s**2)) / s**2).log().abs().mean()) < 0.2
    before, after = (figures_of_samples(samples[0], one) for one in (None, fitted))
    assert after["nll"] < before["nll"] - 0.3
    assert after["coverage_error"] < 0.1 < before["coverage_error"]
    fitted.save(tmp_path / "map.json")
    loaded = Recalibration.from_json(tmp_path / "map.json")
    depth, c = torch.full((1, *SIZE), 2.0), torch.rand(1, *SIZE, generator=torch.Generator().manual_seed(0))
    c[0, 0, 0] = torch.nan
    mapped, plain = UncertainDepth(None, recalibration=loaded), UncertainDepth(None)
    outs = [m.update(DepthPrediction(depth, confidence=c), torch.eye(4), K).variance for m in (mapped, plain)]
    torch.testing.assert_close(outs[0], outs[1] * fitted.factor(c).float())
    assert float(outs[0][0, 0, 0]) == float(outs[1][0, 0, 0])
    with pytest.raises(ValueError, match="maps the confidence, but the network predicts none"):
        mapped.update(DepthPrediction(depth), torch.eye(4), K)
    constant = fit_confidence([np.stack([np.ones(90), V[0, :90], 4 * V[0, :90]], -1)])
    torch.testing.assert_close(constant.factor(torch.tensor([0.0, 1.0, 7.0])), torch.full((3,), 4.0).double())


class Stated(nn.Module):
    """Depth, and an uncertainty in arbitrary units."""

    def forward(self, x):
        return {"depth": 1 + x.mean(1), "conf": x[:, 0]}


def test_a_network_states_it():
    """One declaration passes through wrappers and ensembles to UfM*, which learns the factor from anchors."""
    network = wrap_network(Stated(), "depth", confidence="conf", preprocess=Preprocess(size=SIZE))
    assert network.states_confidence
    assert Ensemble([network, network]).states_confidence
    assert not wrap_network(Stated(), "depth").states_confidence
    outputs = OutputSpec("metric", "depth", confidence="conf")
    assert OnnxNetwork.states_confidence.fget(SimpleNamespace(outputs=outputs))
    image = torch.rand(1, 3, *SIZE, generator=torch.Generator().manual_seed(0))
    assert torch.equal(network(image).confidence, image[:, 0])
    torch.testing.assert_close(Ensemble([network, network])(image).confidence, image[:, 0])
    assert UncertainDepth(network, posterior=False).ufm.config.confidence is False
    model = UncertainDepth(
        [network, copy.deepcopy(network)], UfMStarConfig(anchors=AnchorConfig()), preprocess=network.preprocess
    )
    assert model.ufm.config.confidence
    anchors = next(frames(1, dtype=torch.float32))[2]
    out = model(image, torch.eye(4), K, anchors=anchors)
    assert torch.equal(out.prediction.confidence, image[:, 0])
    assert bool(model.ufm.confidence.any())


def test_the_engine_passes_it(tmp_path):
    """From cached predictions into the rows, and into samples for ``ufmstar recalibrate``."""
    network = wrap_network(Stated(), "depth", confidence="conf", preprocess=Preprocess(size=SIZE))
    source = NetworkSource(NetworksInTurn(network, preprocess=network.preprocess), CPU, {}, digest="a" * 64)
    method, sequence = Method.parse("UfM*-DepthOnly"), tour_sequence(seed=3, frames=3, size=(48, 64))
    rows = [Row(method), Row(method, Setting(anchors="truth"))]
    assert make_estimator(rows[1], CPU, source).ufm.config.confidence
    for _ in range(2):
        for result in evaluate_sequence(sequence, rows, {"depth_only": source}, cache=PredictionCache(tmp_path)):
            samples = result.sums["confidence"]["samples"]
            assert samples.shape == (3 * 384, 3)
            assert bool(((samples[:, 0] >= 0) & (samples[:, 0] <= 1)).all())
    assert fit_confidence([samples.numpy()]).covariate == "confidence"


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:`torch.jit:FutureWarning", "ignore:`torch.jit:DeprecationWarning")
def test_the_commands_pass_it(tmp_path, capsys):
    """``ufmstar run`` counts the frames that use the confidence; ``eval`` and ``recalibrate`` fit its map to the
    truth."""
    spec = {"outputs": {"kind": "metric", "depth": 0, "confidence": 1}, "preprocess": {"size": [48, 64]}}
    (tmp_path / "spec.json").write_text(json.dumps(spec))
    both = torch.jit.trace(Tuple(), torch.rand(1, 3, 48, 64))
    torch.jit.save(both, str(tmp_path / "n.ts"))
    tour, words = "tour:3?frames=4&size=96x128", ["--trust-code", "--spec", str(tmp_path / "spec.json")]
    run = ["run", tour, "--model", "torchscript", "--weights", str(tmp_path / "n.ts"), "--anchors", "corners", *words]
    assert cli.main([*run, "--no-video", "--no-sheet", "--out", str(tmp_path / "run")]) == 0
    summary = json.loads((tmp_path / "run" / "summary.json").read_text())
    assert summary["anchors"]["frames_with_confidence"] == 0
    assert "confidence: used in 0 frames" in capsys.readouterr().out
    suite = tmp_path / "s.toml"
    suite.write_text('title = "s"\n[[rows]]\nmethods = ["UfM*-DepthOnly"]\n')
    network = ["--network", f"depth_only=torchscript:{tmp_path / 'n.ts'}", *words]
    assert cli.main(["eval", "--suite", str(suite), "--root", f"a={tour}", *network, "--out", str(tmp_path / "e")]) == 0
    file = tmp_path / "m.json"
    fit = ["recalibrate", str(tmp_path / "e"), "--row", "UfM*-DepthOnly", "--to", str(file)]
    assert cli.main([*fit, "--covariate", "confidence"]) == 0
    assert Recalibration.from_json(file).covariate == "confidence"


class Tuple(nn.Module):
    """Returns the values of :class:`Stated` without names."""

    def forward(self, x):
        return 1 + x.mean(1), x[:, 0]

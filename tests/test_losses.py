"""Losses: closed forms (SciPy), masks, sums over processes, extreme inputs."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from scipy import stats
from torch import Tensor

from ufmstar_torch.models import EvidentialDepth, GaussianDepth, PointDepth
from ufmstar_torch.models.heads import BETA_FLOOR, EVIDENCE_FLOOR, LOG_VARIANCE_RANGE
from ufmstar_torch.train import loss_of, loss_sums
from ufmstar_torch.train.losses import EVIDENCE_WEIGHT, depth_l1, evidential_loss, evidential_nll, gaussian_nll

SHAPE = (2, 5, 7)
KINDS = ("point", "gaussian", "evidential")


def uniform(low: float, high: float, seed: int, shape: tuple[int, ...] = SHAPE, dtype=torch.float64) -> Tensor:
    generator = torch.Generator().manual_seed(seed)
    return torch.rand(shape, generator=generator, dtype=dtype) * (high - low) + low


def parameters(kind: str, dtype=torch.float64) -> dict[str, Tensor]:
    """Leaves that ask for gradients."""
    made = {"depth": uniform(0.5, 8, 1)}
    if kind == "gaussian":
        made["log_variance"] = uniform(-6, 3, 2)
    if kind == "evidential":
        made |= {"nu": uniform(0.01, 5, 3), "alpha": uniform(1.01, 20, 4), "beta": uniform(0.01, 3, 5)}
    return {name: value.to(dtype).requires_grad_() for name, value in made.items()}


def distribution(kind: str, values: dict[str, Tensor]):
    return {"point": PointDepth, "gaussian": GaussianDepth, "evidential": EvidentialDepth}[kind](**values)


def per_pixel(kind: str, values: dict[str, Tensor], target: Tensor) -> Tensor:
    function = {"point": depth_l1, "gaussian": gaussian_nll, "evidential": evidential_loss}[kind]
    return function(**values, target=target)


def test_gaussian_is_scipys():
    depth, s, target = uniform(0.5, 8, 1), uniform(-6, 6, 2), uniform(0.5, 8, 3)
    expected = -stats.norm.logpdf(target.numpy(), depth.numpy(), np.exp(s.numpy() / 2))
    np.testing.assert_allclose(gaussian_nll(depth, s, target).numpy(), expected, rtol=1e-12)


@given(nu=st.floats(1e-4, 1e4), alpha=st.floats(1.0001, 1e5), beta=st.floats(1e-6, 1e4), error=st.floats(-100, 100))
def test_evidential_is_scipys_student_t(nu, alpha, beta, error):
    """Double precision agrees to 1e-7 over the whole range of evidence (the series for large alpha has an error of
    5e-8)."""
    tensors = [torch.tensor(x, dtype=torch.float64) for x in (3.0, nu, alpha, beta, 3.0 + error)]
    scale = math.sqrt(beta * (1 + nu) / (nu * alpha))
    expected = -stats.t.logpdf(tensors[4].item(), 2 * alpha, 3.0, scale)
    assert evidential_nll(*tensors).item() == pytest.approx(expected, rel=1e-7, abs=1e-6)


@pytest.mark.parametrize("kind", KINDS)
def test_the_gradient_is_the_derivative(kind):
    values, target = parameters(kind), uniform(0.5, 8, 9)
    assert torch.autograd.gradcheck(
        lambda *p: per_pixel(kind, dict(zip(values, p, strict=True)), target), [*values.values()]
    )


@pytest.mark.parametrize("kind", KINDS)
def test_the_mean_is_over_the_valid_pixels(kind):
    """3 of 70 pixels are valid here."""
    values, target = parameters(kind), uniform(0.5, 8, 9)
    valid = torch.zeros(SHAPE, dtype=torch.bool)
    valid[0, 1, 2] = valid[1, 4, 6] = valid[1, 0, 0] = True
    expected = per_pixel(kind, values, target)[valid].mean()
    torch.testing.assert_close(loss_of(distribution(kind, values), target, valid), expected)
    total, count = loss_sums(distribution(kind, values), target, valid)
    assert count.item() == 3
    torch.testing.assert_close(total, 3 * expected)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("bad", [0.0, -1.0, math.nan, math.inf, -math.inf])
@pytest.mark.parametrize("kind", KINDS)
def test_nothing_invalid_reaches_value_or_gradient(kind, bad, dtype):
    """Invalid targets and predictions: NaN times 0 is NaN, so the mask is applied before the loss."""
    values, target = parameters(kind, dtype), uniform(0.5, 8, 9, dtype=dtype)
    valid = uniform(0, 1, 10) < 0.6
    clean = loss_of(distribution(kind, values), target, valid)
    gradients = torch.autograd.grad(clean, list(values.values()))
    broken = {name: torch.where(valid, value, bad).detach().requires_grad_() for name, value in values.items()}
    for given_values, given_target in ((values, torch.where(valid, target, bad)), (broken, target)):
        poisoned = loss_of(distribution(kind, given_values), given_target, valid)
        assert torch.equal(clean, poisoned)
        for gradient, clean_one in zip(
            torch.autograd.grad(poisoned, list(given_values.values())), gradients, strict=True
        ):
            assert torch.equal(gradient, clean_one)
            assert (gradient[~valid] == 0).all()
            assert (gradient[valid] != 0).any()
    nothing = loss_of(distribution(kind, values), target, torch.zeros_like(valid))
    assert nothing.item() == 0
    assert not any(gradient.any() for gradient in torch.autograd.grad(nothing, list(values.values())))


EXTREMES = {
    "gaussian": [[s] for s in (*LOG_VARIANCE_RANGE, -1e4, 1e4, -88.0, 88.0)],
    "evidential": [
        [nu, alpha, beta]
        for nu in (EVIDENCE_FLOOR, 1e-20, 1e6)
        for alpha in (1 + EVIDENCE_FLOOR, 1 + 1e-6, 1e6)
        for beta in (BETA_FLOOR, 1e-20, 1e8)
    ],
}


@pytest.mark.parametrize("precision", ["float32", "bfloat16", "autocast"])
@pytest.mark.parametrize("error", [0.0, 1e-20, 1e-6, 1.0, 1e4, -1e4])
@pytest.mark.parametrize("kind", ["gaussian", "evidential"])
def test_extreme_inputs_have_finite_values_and_gradients(kind, error, precision):
    dtype = torch.bfloat16 if precision == "bfloat16" else torch.float32
    names = ["log_variance"] if kind == "gaussian" else ["nu", "alpha", "beta"]
    for extreme in EXTREMES[kind]:
        values = {"depth": torch.full((1, 1, 1), 2e4 if error < 0 else 1.0)}
        values |= {name: torch.full((1, 1, 1), x) for name, x in zip(names, extreme, strict=True)}
        values = {name: x.to(dtype).requires_grad_() for name, x in values.items()}
        target = values["depth"].detach().float() + error
        with torch.autocast("cpu", torch.bfloat16, enabled=precision == "autocast"):
            loss = loss_of(distribution(kind, values), target, torch.ones(1, 1, 1, dtype=torch.bool))
        assert loss.dtype == torch.float32
        assert loss.isfinite(), (extreme, loss)
        for name, gradient in zip(values, torch.autograd.grad(loss, list(values.values())), strict=True):
            assert gradient.isfinite().all(), (extreme, name, gradient)


def test_beyond_its_limits_the_log_variance_is_still_pulled_back():
    """A clamp would give such a pixel no gradient."""
    s = torch.tensor([-1e4, 1e4], requires_grad=True)
    gradient = torch.autograd.grad(gaussian_nll(torch.zeros(2), s, torch.ones(2)).sum(), s)[0]
    assert gradient[0] < -1
    assert gradient[1] > 0.4


@pytest.mark.parametrize("kind", KINDS)
def test_half_precision_outputs_lose_nothing_in_the_loss(kind):
    """bfloat16 parameters give the same loss as the same values in single precision, also under autocast."""
    values = {name: x.detach().to(torch.bfloat16) for name, x in parameters(kind).items()}
    target, valid = uniform(0.5, 8, 9, dtype=torch.float32), uniform(0, 1, 10) < 0.6
    with torch.autocast("cpu", torch.bfloat16):
        got = loss_of(distribution(kind, values), target, valid)
    wide = {name: x.float() for name, x in values.items()}
    assert torch.equal(got, loss_of(distribution(kind, wide), target, valid))


def test_the_weights_reach_the_loss():
    values, target = parameters("evidential"), uniform(0.5, 8, 9)
    valid = torch.ones(SHAPE, dtype=torch.bool)
    d = distribution("evidential", values)
    nll = evidential_nll(*values.values(), target).mean()
    torch.testing.assert_close(loss_of(d, target, valid, evidence_weight=0.0), nll)
    evidence = ((target - values["depth"]).abs() * (2 * values["nu"] + values["alpha"])).mean()
    torch.testing.assert_close(loss_of(d, target, valid), nll + EVIDENCE_WEIGHT * evidence)

"""A state stays consistent: it is unchanged if a frame raises or a saved state is refused, also if warnings are
errors."""

from __future__ import annotations

import copy
import warnings

import numpy as np
import pytest
import torch
from modules import DEPTHS, POSES, H, K, W, same
from torch import nn
from walks import SPGF

from ufmstar_torch import DepthPrediction, UfMStarConfig, UncertainDepth
from ufmstar_torch.posterior.recalibrate import Recalibration

KINDS = {
    "plain": {"posterior": False},
    "anchored": {"posterior": False, "anchors": "corners"},
    "dense": {"posterior": False, "anchors": "dense"},
    "posterior": {},
}
# A texture that moves with the camera, for the landmark tracker.
_TEXTURE = np.random.default_rng(0).integers(0, 255, (H + 8, W + 8, 3), dtype=np.uint8)


class Warner(Recalibration):
    """Warns after the step if ``loud``."""

    loud = False

    def mapped(self, variance, confidence):
        if self.loud:
            warnings.warn("after the step", RuntimeWarning, stacklevel=2)
        return variance


class Network(nn.Module):
    """Depth of a rendered scene; the image's first pixel is the frame's number."""

    def __init__(self):
        super().__init__()
        self.factor = nn.Parameter(torch.ones(1))

    def forward(self, image):
        number = int(image[0, 0, 0, 0])
        return DepthPrediction(torch.tensor(DEPTHS[number], dtype=torch.float32)[None] * self.factor)


def frame(i):
    image = np.ascontiguousarray(_TEXTURE[i : i + H, i : i + W])
    image[0, 0] = i
    return image, POSES[i], K


def model_of(kind, frames=0):
    model = UncertainDepth(Network(), UfMStarConfig(segment=SPGF), recalibration=Warner((1.0,), (1.0,)), **KINDS[kind])
    for i in range(frames):
        model(*frame(i))
    return model


def snapshot(model):
    return {name: value.clone() for name, value in model.stream_state().items()} | {"next": torch.tensor(model._next)}


def unchanged(model, before):
    after = snapshot(model)
    return after.keys() == before.keys() and all(same(after[n].double(), v.double()) for n, v in before.items())


@pytest.mark.parametrize("kind", KINDS)
def test_a_frame_that_raises_leaves_everything_as_it_was(kind):
    model, twin = model_of(kind, 3), model_of(kind, 3)
    before = snapshot(model)
    image, pose, intrinsics = frame(3)
    broken = pose.copy()
    broken[0, 3] = np.nan
    warner = model.ufm.recalibration
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        with pytest.raises(ValueError, match="stream 0: pose holds NaN"):
            model(image, broken, intrinsics)
        assert unchanged(model, before)
        warner.loud = True
        with pytest.raises(RuntimeWarning, match="after the step"):
            model(image, pose, intrinsics)
        assert unchanged(model, before)
        with pytest.raises(RuntimeWarning, match="after the step"):
            model.mean_uncertainty(image, pose, intrinsics)
        assert unchanged(model, before)
        warner.loud = False
        assert same(model(image, pose, intrinsics).variance, twin(image, pose, intrinsics).variance)


def at_end(change):
    """Replace the last number of a tensor."""

    def damaged(value):
        value = value.clone()
        value.view(-1)[-1] = change
        return value

    return damaged


DAMAGED = {
    "a posterior of 1e300": ("posterior", "ufm.posterior", at_end(1e300), "posterior"),
    "a posterior of -1e10": ("posterior", "ufm.posterior", at_end(-1e10), "posterior holds impossible values"),
    "a posterior that is NaN": ("posterior", "ufm.posterior", at_end(torch.nan), "posterior holds NaN"),
    "evidence of 1e300": ("anchored", "ufm.overall_evidence", at_end(1e30), "overall_evidence holds"),
    "a Gaussian of NaN": ("anchored", "ufm.mean", at_end(torch.nan), "mean holds NaN"),
    "a count below 0": ("plain", "image_index", at_end(-1), "image_index must be a whole number"),
    "a count in floats": ("plain", "image_index", torch.Tensor.double, "image_index must be a whole number"),
    "corners at NaN": ("anchored", "landmarks.0.pixel", at_end(torch.nan), r"state\['pixel'\] must be finite"),
    "corners at 1e300": ("anchored", "landmarks.0.pixel", at_end(1e300), r"state\['pixel'\] must be finite"),
    "an image in floats": ("anchored", "landmarks.0.gray", torch.Tensor.double, r"state\['gray'\] must have shape"),
    "a key frame in floats": (
        "dense",
        "landmarks.0.images",
        torch.Tensor.double,
        r"state\['images'\] must have shape",
    ),
    "depths of infinity": ("dense", "landmarks.0.landmark_sigma", at_end(torch.inf), "landmark_sigma.* must be finite"),
}


@pytest.mark.parametrize(("kind", "name", "damage", "message"), DAMAGED.values(), ids=DAMAGED)
def test_a_damaged_state_is_refused_as_a_whole(kind, name, damage, message):
    model, saved = model_of(kind, 1), model_of(kind, 4).stream_state()
    before = snapshot(model)
    with pytest.raises(ValueError, match=message):
        model.load_stream_state(saved | {name: damage(saved[name])})
    assert unchanged(model, before)
    model.load_stream_state(saved)
    assert model._next == 4


def test_a_warning_about_the_config_that_is_an_error_changes_nothing():
    model = model_of("plain", 1)
    other = UncertainDepth(Network(), UfMStarConfig(segment=SPGF, eta=0.4), posterior=False)
    other(*frame(0)), other(*frame(1))
    before = snapshot(model)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        with pytest.raises(UserWarning, match=r"eta was 0\.4, is 0\.5"):
            model.ufm.load_state_dict(other.ufm.state_dict())
        assert unchanged(model, before)
        with pytest.raises(UserWarning, match=r"eta was 0\.4, is 0\.5"):
            model.load_stream_state(other.stream_state())
        assert unchanged(model, before)
    with pytest.warns(UserWarning, match="eta was"):
        model.load_stream_state(copy.deepcopy(other.stream_state()))
    assert model._next == 2


EXTREME = (0.0, -1.0, 3.0, np.nan, np.inf, -np.inf, 1e-45, 1e-300, 1e30, 1e308, -1e308, 2.0**62)


def mutated(rng, state):
    """A copy of a state with one tensor missing, renamed, of another kind, shape or dtype, or with extreme values."""
    state = {name: value.clone() for name, value in state.items()}
    name = str(rng.choice(list(state)))
    value, kind = state.pop(name), rng.integers(8)
    if kind == 1:
        state[f"{name}x"] = value
    elif kind == 2:
        state[name] = [None, 5, [1.0], "x", {}, value.numpy(), value.to("meta")][rng.integers(7)]
    elif kind == 3:
        state[name] = value.to([torch.float16, torch.float64, torch.int8, torch.bool, torch.complex64][rng.integers(5)])
    elif kind == 4:
        state[name] = [value[None], value.flatten()[:0], value.flatten().repeat(2)][rng.integers(3)]
    elif kind > 4 and value.numel():
        flat = value.flatten()
        at = torch.tensor(rng.integers(0, len(flat), [1, 1, len(flat)][kind - 5]))
        with np.errstate(invalid="ignore"):
            flat[at] = torch.tensor(rng.choice(EXTREME), dtype=torch.float64).to(value.dtype)
        state[name] = flat.view(value.shape)
    return state


def load_mutated(kind, seeds):
    """Load mutated states: each is refused by name and changes nothing, or three frames run and can be saved. The
    number of states refused."""
    model, refused = model_of(kind, 4), 0
    saved = model.stream_state()
    before = snapshot(model)
    for seed in seeds:
        refusal = ""
        try:
            model.load_stream_state(mutated(np.random.default_rng(seed), saved))
        except (TypeError, ValueError) as error:
            refusal = str(error)
        if refusal:
            refused += 1
            assert unchanged(model, before), seed
            continue
        for i in range(4, 7):
            out = model(*frame(i))
            assert not out.depth[out.valid].isnan().any(), seed
            assert not out.std[out.valid].isnan().any(), seed
        model.load_stream_state(model.stream_state())
        model.load_stream_state(saved)
    return refused


@pytest.mark.parametrize("kind", KINDS)
def test_a_few_mutated_states(kind):
    assert load_mutated(kind, range(12)) > 3


@pytest.mark.slow
@pytest.mark.parametrize("kind", KINDS)
def test_many_mutated_states(kind):
    assert load_mutated(kind, range(100, 220)) > 40

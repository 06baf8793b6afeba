"""Ensemble members that are loaded on demand and stored off the device (their mixture: test_pipeline.py)."""

from __future__ import annotations

import copy
import pickle
import threading
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
import torch
from torch import nn

from ufmstar_torch import DepthPrediction, UfMStar, UfMStarConfig, UncertainDepth
from ufmstar_torch.models import CheckpointError, DepthNetwork, LazyMember, Preprocess

INPUT = Preprocess(size=(8, 10))
POSE, K = torch.eye(4), torch.tensor([[8.0, 0, 4.5], [0, 8, 3.5], [0, 0, 1]])


class Gain(DepthNetwork):
    """Depth and variance proportional to brightness; records the device of its weights at each call."""

    def __init__(self, gain):
        super().__init__()
        self.preprocess = INPUT
        self.gain = nn.Parameter(torch.tensor(float(gain)))
        self.register_buffer("offset", torch.tensor(1.0))
        self.register_buffer("spread", torch.tensor(0.01), persistent=False)
        self.seen = []

    def forward(self, image):
        self.seen.append((self.gain.device.type, self.offset.device.type, self.training))
        depth = self.gain * (self.offset + image.mean(1))
        return DepthPrediction(depth, self.spread * depth)


class Loader:
    """Counts its calls; can be copied and pickled."""

    def __init__(self, gain):
        self.gain, self.calls = gain, 0

    def __call__(self):
        self.calls += 1
        return Gain(self.gain)


def lazy(*gains, **options):
    loaders = [Loader(gain) for gain in gains]
    members = [LazyMember(loader, INPUT, name=f"member {n}", **options) for n, loader in enumerate(loaders)]
    return members, [lambda loader=loader: loader.calls for loader in loaders]


def image(batch=2):
    return torch.rand(batch, 3, 8, 10, generator=torch.Generator().manual_seed(0))


@pytest.mark.parametrize("options", [{}, {"offload": True}])
def test_images_follow_members_that_are_not_loaded_to_their_device(options):
    model = UncertainDepth(lazy(1.0, **options)[0], posterior=False).to("meta")
    picture = np.zeros((8, 10, 3), np.uint8)  # not a tensor, whose device is the caller's choice
    with pytest.raises(ValueError, match="device 'meta' needs max_components <= initial_capacity"):  # of UfM*'s state
        model(picture, POSE, K)


def test_a_step_on_device_meta_has_maps_without_values():
    """Each of torch's operations takes a millisecond there: two rows suffice."""
    config = UfMStarConfig(max_components=8, initial_capacity=8, on_bad_frame="skip")
    out = UfMStar(config, device="meta")(torch.ones(1, 2, 3, device="meta"), POSE, K)
    assert out.depth.is_meta
    assert out.variance.shape == (1, 2, 3)


def test_only_the_members_in_turn_are_loaded_each_once():
    members, calls = lazy(1.0, 1.1, 1.2)
    pipeline = UncertainDepth(members)
    assert [call() for call in calls] == [0, 0, 0]
    expected = [Gain(gain)(image(1)).depth for gain in (1.0, 1.1, 1.2)]
    loaded = []
    for turn in range(5):
        result = pipeline(image(1), POSE, K)
        assert torch.equal(result.depth, expected[turn % 3])
        loaded.append([call() for call in calls])
    assert loaded == [[1, 0, 0], [1, 1, 0], [1, 1, 1], [1, 1, 1], [1, 1, 1]]
    assert all(member.loaded for member in members)


@pytest.mark.parametrize("first", ["move", "load"])
def test_a_member_goes_where_it_is_sent_before_and_after_loading(first):
    (member,), _ = lazy(1.0)
    if first == "load":
        member(image())
    member.to("meta", torch.float64)
    network = member.network()
    assert (network.gain.device.type, network.offset.device.type, network.gain.dtype) == ("meta", "meta", torch.float64)
    assert member(image().double().to("meta")).depth.device.type == "meta"


def test_an_offloaded_member_keeps_nothing_on_the_device():
    members, calls = lazy(1.0, 1.1, offload=True)
    networks = nn.ModuleList(members).to("meta")
    for turn in range(3):
        out = networks[turn % 2](image().to("meta"))
        assert out.depth.device.type == "meta"
        # Each member is on the device during its turn only, and returns to the host as the same tensors.
        assert networks[turn % 2].network().seen[-1][:2] == ("meta", "meta")
        held = [m.network() for m in members if m.loaded]
        tensors = [t for n in held for t in (*n.parameters(), *n.buffers())]
        assert {t.device.type for t in tensors} == {"cpu"}
        assert len(tensors) == 3 * len(held)
    assert [call() for call in calls] == [1, 1]
    assert sum(p.numel() for p in networks.parameters() if p.device.type == "meta") == 0
    assert torch.equal(members[1].network()(image()).depth, Gain(1.1)(image()).depth)


@pytest.mark.parametrize("copied", [copy.deepcopy, lambda m: pickle.loads(pickle.dumps(m))])
def test_a_copy_loads_anew(copied):
    (member,), _ = lazy(1.2)
    member(image())
    other = copied(member)
    assert not other.loaded
    assert torch.equal(other(image()).depth, member(image()).depth)
    assert other.network() is not member.network()
    assert other.loaded


def test_threads_load_a_member_once():
    barrier, started = threading.Barrier(4), []

    def slow():
        started.append(1)
        threading.Event().wait(0.05)
        return Gain(1.0)

    member = LazyMember(slow, INPUT)
    with ThreadPoolExecutor(4) as pool:
        depths = list(pool.map(lambda _: (barrier.wait(), member(image()).depth)[1], range(4)))
    assert len(started) == 1
    assert len(depths) == 4


@pytest.mark.parametrize("error", [FileNotFoundError("no file x"), RuntimeError("damaged"), CheckpointError("cut off")])
def test_a_member_that_cannot_be_loaded_is_named(error):
    def load():
        if fail:
            raise error
        return Gain(2.0)

    fail = [1]
    members = [LazyMember(Loader(1.0), INPUT), LazyMember(load, INPUT, name="weights/b.safetensors, member 1")]
    pipeline = UncertainDepth(members)
    pipeline(image(1), POSE, K)
    with pytest.raises(CheckpointError, match=rf"weights/b.safetensors, member 1 cannot be loaded: {error}"):
        pipeline(image(1), POSE, K)
    fail.clear()  # the member index has not advanced, and the next call loads the member
    assert pipeline(image(1), POSE, K).member == 1

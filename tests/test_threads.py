"""One thread at a time: a second caller of a module, copies, and torch.compile."""

from __future__ import annotations

import copy
import pickle
import threading

import numpy as np
import pytest
import torch
from torch import Tensor, nn

from ufmstar_torch import DepthPrediction, UfMStar, UncertainDepth

K = torch.tensor([[40.0, 0, 15.5], [0, 40, 11.5], [0, 0, 1]])
POSE = torch.eye(4)
IMAGE = torch.zeros(1, 3, 24, 32)


class Waiting(nn.Module):
    """A network that waits inside its second call."""

    def __init__(self) -> None:
        super().__init__()
        self.inside, self.go_on, self.calls = threading.Event(), threading.Event(), 0

    def forward(self, x: Tensor) -> DepthPrediction:
        self.calls += 1
        if self.calls > 1:
            self.inside.set()
            assert self.go_on.wait(60)
        return DepthPrediction(2 + torch.zeros(len(x), 24, 32))


CALLS = {
    "forward": lambda model: model(IMAGE, POSE, K),
    "update": lambda model: model.update(DepthPrediction(torch.full((1, 24, 32), 2.0)), POSE, K),
    "mean_uncertainty": lambda model: model.mean_uncertainty(IMAGE, POSE, K),
    "reset": lambda model: model.reset(),
    "load_stream_state": lambda model: model.load_stream_state({}),
    "stream_state": lambda model: model.stream_state(),
    "_apply": lambda model: model.double(),
    "_predicted": lambda model: next(model.stream([(IMAGE, POSE, K)])),
}


def test_a_second_thread_is_refused_by_name_and_changes_nothing():
    network = Waiting()
    model = UncertainDepth(network, check_poses=0)
    model(IMAGE, POSE, K)
    thread = threading.Thread(target=lambda: model(IMAGE, POSE, K), name="camera")
    thread.start()
    assert network.inside.wait(60)
    for method, call in CALLS.items():
        expected = (
            f"UncertainDepth.{method} was called by thread 'MainThread' while thread 'camera' is in UncertainDepth"
        )
        with pytest.raises(RuntimeError, match=expected):
            call(model)
    network.go_on.set()
    thread.join()
    assert model.image_index == 2
    assert model(IMAGE, POSE, K).statistics.fault.tolist() == [0], "the module goes on"
    assert model.ufm.frames.tolist() == [3]


def test_a_second_thread_is_refused_while_a_stream_waits_for_its_network(monkeypatch):
    network, fused = Waiting(), threading.Event()
    model = UncertainDepth(network, posterior=False, check_poses=0)
    original = UncertainDepth._fused

    def announced(self, *args, **kwargs):
        try:
            return original(self, *args, **kwargs)
        finally:
            fused.set()

    monkeypatch.setattr(UncertainDepth, "_fused", announced)
    results = []
    thread = threading.Thread(target=lambda: results.extend(model.stream([(IMAGE, POSE, K)] * 2)), name="camera")
    thread.start()
    try:
        assert fused.wait(60)
        assert network.inside.wait(60)
        with pytest.raises(RuntimeError, match="thread 'camera' is in UncertainDepth"):
            model.reset()
    finally:
        network.go_on.set()
        thread.join()
    assert len(results) == model.image_index == 2


def test_every_frame_of_many_threads_is_counted_or_refused():
    ufm, refused = UfMStar(), []
    start = threading.Barrier(3)

    def work() -> None:
        start.wait()
        for n in range(40):
            depth = torch.full((1, 24, 32), 2.0 + 0.01 * n)
            try:
                ufm(depth, POSE, K)
            except RuntimeError as error:
                refused.append(str(error))

    threads = [threading.Thread(target=work) for _ in range(3)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert int(ufm.frames) + len(refused) == 120
    assert all("UfMStar.forward was called by thread" in text for text in refused)
    UfMStar().load_state_dict(ufm.state_dict())


def test_other_methods_of_the_core_module_refuse_it_too():
    ufm = UfMStar()
    ufm(torch.full((1, 24, 32), 2.0), POSE, K)
    points = torch.zeros(1, 1, 3)
    ufm._caller.enter("UfMStar.forward")
    failures = []

    def others() -> None:
        for call in (
            lambda: ufm.query(points),
            lambda: ufm.mixture,
            ufm.reset,
            ufm.state_dict,
            lambda: copy.deepcopy(ufm),
        ):
            with pytest.raises(RuntimeError, match="takes one thread at a time"):
                call()
        failures.append(None)

    thread = threading.Thread(target=others)
    thread.start()
    thread.join()
    ufm._caller.leave()
    assert failures == [None]


def test_an_error_inside_lets_the_next_thread_in_and_copies_are_free():
    ufm = UfMStar()
    with pytest.raises(TypeError):
        ufm("depth", POSE, K)
    ufm._caller.enter("here")
    for copied in (copy.deepcopy(ufm), pickle.loads(pickle.dumps(ufm))):
        thread = threading.Thread(target=lambda module=copied: module(torch.full((1, 24, 32), 2.0), POSE, K))
        thread.start()
        thread.join()
        assert copied.frames.tolist() == [1]
    ufm._caller.leave()


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore")
def test_torch_compile_runs_the_modules_as_they_are():
    """torch.compile compiles the network and runs UfM* uncompiled, also if a compiled function calls it."""
    compiled = []

    def backend(graph, _):
        compiled.append(graph)
        return graph.forward

    class Net(nn.Module):
        def forward(self, x: Tensor) -> Tensor:
            return 2 + x.mean(1, keepdim=True)

    depths = [2 + 0.3 * torch.rand(1, 24, 32, generator=torch.Generator().manual_seed(n)) for n in range(3)]
    plain, module, inner = UfMStar(), UfMStar(), UfMStar()
    torch._dynamo.reset()
    optimised = torch.compile(module, backend=backend)
    function = torch.compile(lambda depth: inner(depth, POSE, K).variance, backend=backend)
    for depth in depths:
        expected = plain(depth, POSE, K).variance
        torch.testing.assert_close(optimised(depth, POSE, K).variance, expected, equal_nan=True, rtol=0, atol=0)
        torch.testing.assert_close(function(depth), expected, equal_nan=True, rtol=0, atol=0)
    assert not compiled
    image = np.full((24, 32, 3), 90, np.uint8)
    model = UncertainDepth(torch.compile(Net(), backend=backend), check_poses=0)
    assert torch.compile(model, backend=backend)(image, POSE, K).depth.shape == (1, 24, 32)
    model(image, POSE, K)
    assert len(compiled) == 1, "the network alone"

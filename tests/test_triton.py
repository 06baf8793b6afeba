"""Properties of the GPU kernels beyond the steps (fixture ``backend``): growth, bits of matches.

With ``TRITON_INTERPRET=1`` in Triton's interpreter, on CPU tensors; ``pytest -m gpu`` runs them on a GPU.
"""

from __future__ import annotations

import copy
from unittest.mock import Mock

import pytest
import torch
from backends import INTERPRETED, make_backend, moved
from random_gaussians import mixture
from walks import SPGF, walks

import scenes
from ufmstar_torch import UfMStar, UfMStarConfig
from ufmstar_torch.steps.correspond import correspond

DEVICE = "cpu" if INTERPRETED else "cuda"
SIZE = (22, 30)

pytestmark = [
    pytest.mark.interpreter,
    pytest.mark.gpu,
    pytest.mark.skipif(
        not INTERPRETED and not torch.cuda.is_available(), reason="needs TRITON_INTERPRET=1 or a CUDA device"
    ),
    pytest.mark.filterwarnings("ignore::RuntimeWarning:triton"),
]


def close(actual, expected, rtol, atol):
    torch.testing.assert_close(actual.cpu(), expected.cpu(), rtol=rtol, atol=atol, equal_nan=True)


def test_bits_of_matches():
    from ufmstar_torch.kernels.triton.correspond import candidates, match_bits

    size, config = (37, 52), UfMStarConfig(eta=0.3, eta_occlusion=0.4)
    K = torch.tensor(scenes.intrinsics(*size)).expand(2, 3, 3)
    previous, current = mixture(2, 70, 0), mixture(2, 40, 50)
    expected = correspond(previous, current, K, size, config)
    assert (expected.overlap >= 0.3).sum() > expected.match.sum() > 50, "some must be hidden"
    still = torch.eye(3).double().repeat(2, 1, 1), torch.zeros(2, 3).double()
    listed = candidates(*moved((previous, still, current, K.contiguous(), size, config), DEVICE))
    pairs = torch.zeros(2, dtype=torch.int64, device=DEVICE)
    bits, matched = match_bits(*listed, config, pairs)
    assert torch.equal(matched.cpu(), expected.match.any(2))
    assert pairs.tolist() == expected.match.sum((1, 2)).tolist()
    set_bits = sum(int(w).bit_count() for b in range(2) for w in bits[b, : int(listed[0].count[b]), :2].flatten())
    assert set_bits == expected.match.sum()


def test_growth_ahead():
    """The mixture has slots for all that a frame can add before the frame: every output equals the CPU's. A saved state
    continues, whose components the step has not counted."""
    config = UfMStarConfig(segment=SPGF, unmeasured="paper", initial_capacity=2)
    modules = [make_backend(name).module(config) for name in ("triton", "numba")]
    for i, (depth, pose, K, _) in enumerate(walks(1, 4, SIZE)):
        pixels = torch.full_like(depth, torch.nan) if i == 1 else depth
        if i == 3:
            modules[0].ufm.load_state_dict(copy.deepcopy(modules[0].ufm.state_dict()))
        a, e = (module(pixels, pose, K, (pixels / 100).nan_to_num()) for module in modules)
        close(a.variance, e.variance, 1e-8, 1e-10)
        close(a.measured, e.measured, 1e-8, 1e-10)
        for name in e.statistics.counts:
            torch.testing.assert_close(getattr(a.statistics, name), getattr(e.statistics, name))
    n = int(modules[1].ufm.mixture.components)
    assert n > 2, "the mixture must have grown"
    for name, value in modules[1].ufm.mixture.tensors().items():
        close(getattr(modules[0].ufm.mixture, name)[:, :n], value[:, :n], 1e-5, 1e-7)


@pytest.mark.skipif(not INTERPRETED, reason="on a GPU tests/test_gpu.py records a graph")
@pytest.mark.parametrize("paper", [False, True])
def test_capture_keeps_the_state_in_place(monkeypatch, paper):
    """The bookkeeping of a capture, with a function instead of the graph; and the launches of a step, also of the
    paper's settings."""
    from triton.runtime.jit import KernelInterface

    from ufmstar_torch.runtime.capture import Captured

    monkeypatch.setattr("ufmstar_torch.runtime.capture._WARM_UP", 1)
    launched, launch = [], KernelInterface.__getitem__
    monkeypatch.setattr(
        KernelInterface, "__getitem__", lambda kernel, grid: launched.append(kernel.fn.__name__) or launch(kernel, grid)
    )

    config = (UfMStarConfig.paper() if paper else UfMStarConfig(merge=None)).replace(
        segment=SPGF, backend="triton", on_bad_frame="skip", initial_capacity=16, max_components=16
    )
    inputs = [frame[:3] for frame in walks(1, 2, SIZE)]
    ufm, plain = UfMStar(config), UfMStar(config)
    captured = Captured(ufm, *inputs[0], record=lambda run: run)
    memory = ufm.mean
    for i, frame in enumerate(inputs):
        if i == 1:
            ufm.reset()
            plain.reset()
        launched.clear()
        out = captured(*frame)
        assert len(launched) == 2 + 11, launched  # the check, the step
        assert len(set(launched)) == len(launched)
        expected = plain(*frame)
        close(out.variance, expected.variance, 0, 0)
        assert ufm.mean is memory
    assert torch.equal(ufm.frames, plain.frames)
    with pytest.raises(ValueError, match="depth must be as at the capture"):
        captured(inputs[0][0][:, :5], *inputs[0][1:])
    with pytest.raises(ValueError, match=r"a capture needs on_bad_frame='skip'.*a growing mixture"):
        Captured(UfMStar(UfMStarConfig(backend="triton")), *inputs[0])


def test_what_the_limit_leaves_without_a_slot_counts_as_dropped():
    """In the frame that the components are of, as on the CPU."""
    dropped = {}
    for backend, device in (("numba", "cpu"), ("triton", DEVICE)):
        ufm = UfMStar(UfMStarConfig(segment=SPGF, backend=backend, initial_capacity=2, max_components=3))
        outputs = [ufm(*(v.to(device) for v in frame[:3])) for frame in walks(1, 2)]
        dropped[backend] = [int(out.statistics.dropped) for out in outputs]
        assert int(ufm.mixture.components) == 3
    assert dropped["triton"] == dropped["numba"]
    assert dropped["numba"][0] > 0


def test_copies_and_saved_states_continue_also_after_a_step_that_failed(monkeypatch):
    config = UfMStarConfig(segment=SPGF, backend="triton", initial_capacity=2, merge=None)
    first, second = (moved(frame[:3], DEVICE) for frame in walks(1, 2, SIZE))
    ufm = UfMStar(config)
    new = int(ufm(*first).statistics.new)
    assert new > 2, "the mixture must have grown"
    with monkeypatch.context() as broken:
        broken.setattr("ufmstar_torch.kernels.triton.step.fuse_bits", Mock(side_effect=RuntimeError("out of memory")))
        with pytest.raises(RuntimeError, match="out of memory"):
            ufm(*second)
    twin = copy.deepcopy(ufm)
    assert int((twin.mean[0, :, 2] != 0).sum()) == new
    assert int((ufm.state_dict()["weight"] > 0).sum()) == new
    restored = UfMStar(config, device=DEVICE)
    restored.load_state_dict(ufm.state_dict())
    expected, *outputs = [module(*second) for module in (ufm, twin, restored)]
    for out in outputs:
        close(out.variance, expected.variance, 0, 0)
        assert torch.equal(out.statistics.components, expected.statistics.components)
    ufm.reset()
    assert ufm.state.mixture.streams == 0

"""The GPU kernels in Triton's interpreter, on CPU tensors, against the torch reference and the compiled CPU kernels.

``TRITON_INTERPRET=1`` must be set before triton is imported, so these tests run in processes of their own:
``TRITON_INTERPRET=1 pytest -m interpreter tests/test_triton.py``. On a GPU the same tests run as they are
(``pytest -m gpu``), on its tensors.
"""

from __future__ import annotations

import copy
import os
from dataclasses import fields, replace
from unittest.mock import Mock

import numpy as np
import pytest
import torch
from random_gaussians import covariances, mixture, random_pairs
from segment_scenes import REFERENCES, numba_spgf, reference
from walks import HEIGHT, SPGF, WIDTH, oracle_run, walks

import scenes
from ufmstar_torch import AnchorConfig, SPGFConfig, UfMStar, UfMStarConfig, gaussian
from ufmstar_torch.correspond import correspond
from ufmstar_torch.fuse import fuse
from ufmstar_torch.kernels.select import select_kernels
from ufmstar_torch.regress import distribute, regress_image, smooth
from ufmstar_torch.segment import segment
from ufmstar_torch.segment_input import SegmentInput

INTERPRETED = os.environ.get("TRITON_INTERPRET") == "1"
DEVICE = "cpu" if INTERPRETED else "cuda"

pytestmark = [
    pytest.mark.interpreter,
    pytest.mark.gpu,
    pytest.mark.skipif(
        not INTERPRETED and not torch.cuda.is_available(), reason="needs TRITON_INTERPRET=1 or a CUDA device"
    ),
    pytest.mark.filterwarnings("ignore::RuntimeWarning:triton"),  # numpy on inf and NaN, as a GPU computes silently
]

SIZE = (37, 52)
K = torch.tensor(scenes.intrinsics(*SIZE)).expand(2, 3, 3)


@pytest.fixture(scope="module")
def kernels():
    return select_kernels("triton", DEVICE)


def moved(value):
    """Tensors, and dataclasses and tuples of them, to the device under test."""
    if isinstance(value, torch.Tensor):
        return value.to(DEVICE)
    if isinstance(value, tuple):
        return tuple(map(moved, value))
    if hasattr(value, "__dataclass_fields__"):
        return replace(value, **{f.name: moved(getattr(value, f.name)) for f in fields(value)})
    return value


def close(actual, expected, rtol, atol):
    torch.testing.assert_close(actual.cpu(), expected, rtol=rtol, atol=atol, equal_nan=True)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("subset", [False, True])
def test_regress(kernels, dtype, subset):
    m = mixture(2, 40, 3, features=2)
    depth = torch.tensor(scenes.render(scenes.tour(8)[1], K[0].numpy(), *SIZE)).expand(2, *SIZE).clone()
    depth[0, :20, :20] = torch.nan
    valid = depth > 0
    given = (m, torch.where(valid, depth, 0).to(dtype), K, valid, UfMStarConfig(prior_mean=0.2))
    pixels = (
        torch.randint(0, depth[0].numel(), (2, 300), generator=torch.Generator().manual_seed(0)) if subset else None
    )
    actual, expected = kernels.regress_image(*moved(given), moved(pixels)), regress_image(*given, pixels)
    tolerance = 1e-12 if dtype == torch.float64 else 2e-5
    close(actual.disagreement, expected.disagreement, tolerance, tolerance)
    close(actual.features, expected.features, tolerance, tolerance)


def test_regress_without_components_or_pixels(kernels):
    m = mixture(2, 8, 0, empty=8, features=1)
    depth = torch.ones(2, *SIZE)
    out = kernels.regress_image(*moved((m, depth, K, depth > 0, UfMStarConfig(prior_mean=0.25))))
    assert (out.disagreement == 0.25).all()
    assert (out.features == 0).all()
    out = kernels.regress_image(*moved((mixture(2, 8, 0), depth, K, depth < 0, UfMStarConfig())))
    assert out.disagreement.isnan().all()


def test_correspond(kernels):
    from ufmstar_torch.kernels.triton.correspond import candidates, match_bits

    previous, current = mixture(2, 70, 0), mixture(2, 40, 50)
    config = UfMStarConfig(eta=0.3, eta_occlusion=0.4)
    expected = correspond(previous, current, K, SIZE, config)
    assert (expected.overlap >= 0.3).sum() > expected.match.sum() > 50, "some must be hidden"
    actual = kernels.correspond(*moved((previous, current, K, SIZE, config)))
    close(actual.overlap, expected.overlap, 1e-11, 1e-100)
    assert torch.equal(actual.match.cpu(), expected.match)
    still = moved((torch.eye(3).double().repeat(2, 1, 1), torch.zeros(2, 3).double()))
    listed = candidates(*moved((previous, still, current, K.contiguous(), SIZE, config)))
    pairs = torch.zeros(2, dtype=torch.int64, device=DEVICE)
    bits, matched = match_bits(*listed, config, pairs)
    assert torch.equal(matched.cpu(), expected.match.any(2))
    assert pairs.tolist() == expected.match.sum((1, 2)).tolist()
    set_bits = sum(int(w).bit_count() for b in range(2) for w in bits[b, : int(listed[0].count[b]), :2].flatten())
    assert set_bits == expected.match.sum()


@pytest.mark.parametrize("weighted", [False, True])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_fuse(kernels, weighted, dtype):
    previous, current = mixture(2, 37, 5, features=2).to(dtype), mixture(2, 34, 60, features=2)
    pairs = random_pairs(2, previous, current, 5)
    pairs = replace(pairs, match=pairs.match & (torch.rand(pairs.match.shape) < 0.15))
    if weighted:
        pairs = replace(pairs, distance=torch.rand(pairs.overlap.shape, dtype=torch.float64))
    config = UfMStarConfig(overlap_weighted=weighted)
    expected = fuse(previous, current, pairs, config)
    assert (expected.count > 2).any()
    actual = kernels.fuse(*moved((previous, current, pairs, config)))
    tolerance = 1e-10 if dtype == torch.float64 else 1e-5
    for name, value in expected.tensors().items():
        close(getattr(actual, name), value, tolerance, tolerance / 100)


def test_floor_covariance(kernels):
    cov = covariances(60, 4, decades=6).view(3, 20, 3, 3)
    floor = torch.linspace(1e-8, 1e-2, 20, dtype=torch.float64).expand(3, 20)
    close(kernels.floor_covariance(*moved((cov, floor))), gaussian.floor_covariance(cov, floor), 0, 1e-15)


def test_smooth_and_distribute(kernels):
    generator = torch.Generator().manual_seed(0)
    before, now = torch.rand(2, 2, 5, 7, generator=generator).unbind(0)
    before[0, :2], now[0, 1:3] = torch.nan, torch.nan
    for a, e in zip(kernels.smooth(moved(before), moved(now), 0.3), smooth(before, now, 0.3), strict=True):
        close(a, e, 1e-6, 0)
    m, config = mixture(2, 40, 3), UfMStarConfig()
    points = m.mean[:, :35] + 0.1 * torch.randn(2, 35, 3, generator=generator, dtype=torch.float64)
    values = torch.rand(2, 35, 3, generator=generator, dtype=torch.float64)
    close(kernels.distribute(*moved((m, points, values, config))), distribute(m, points, values, config), 1e-10, 1e-13)


def assert_segments_equal(kernels, given, *, before_pruning=False):
    """Labels to the last bit, moments to rounding."""
    actual, labels = kernels.spgf(moved(given), before_pruning=before_pruning)
    expected, expected_labels = segment(given, before_pruning=before_pruning)
    assert torch.equal(labels.cpu(), expected_labels)
    for name, value in expected.tensors().items():
        found = getattr(actual, name).cpu()
        close(found[:, : expected.capacity], value, 1e-6 if given.dtype == torch.float32 else 1e-12, 1e-14)
        assert not found[:, expected.capacity :].any()


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("options", [False, True])
def test_segment(kernels, dtype, options):
    depths, _, intrinsics = scenes.sequence(3, HEIGHT, WIDTH, 0.04)
    depth = torch.tensor(np.stack([depths[0], depths[2], np.full_like(depths[0], np.nan)]))[:, :24].to(dtype)
    generator = torch.Generator().manual_seed(1)
    extra = (
        torch.rand(depth.shape, generator=generator),
        torch.rand(depth.shape, generator=generator) > 0.05,
        torch.rand(3, 2, *depth.shape[1:], generator=generator),
    )
    config = replace(SPGF, max_open=3) if options else SPGF
    camera = torch.tensor(intrinsics).expand(3, 3, 3)
    given = SegmentInput.checked(depth, camera, config, *(extra if options else ()))
    assert_segments_equal(kernels, given, before_pruning=options)


@pytest.mark.parametrize("prune", ["either", "none"])
def test_segment_pruning_and_scaling(kernels, prune):
    depths, _, intrinsics = scenes.sequence(1, 32, 48, 0.05)
    config = SPGFConfig(prune=prune, min_pixels=1000, min_rows=20)
    given = SegmentInput.checked(torch.tensor(depths[0])[None], torch.tensor(intrinsics)[None], config)
    assert_segments_equal(kernels, given)


@pytest.mark.parametrize("name", REFERENCES)
def test_labels_of_the_reference_frames(kernels, name):
    """On a GPU whole frames against the authors' labels; in the interpreter a crop of each against the CPU's."""
    r = reference(name)
    if not INTERPRETED:
        labels = kernels.spgf(moved(SegmentInput.checked(r.depth, r.intrinsics, r.config)), before_pruning=True)[1]
        assert all(np.array_equal(labels[b].cpu().numpy(), e["labels"]) for b, e in enumerate(r.frames))
        return
    depth = r.depth[:, 100:120, 80:144].contiguous()
    camera = r.intrinsics - torch.tensor([[0.0, 0, 80], [0, 0, 100], [0, 0, 0]])
    given = SegmentInput.checked(depth, camera, r.config)
    labels = kernels.spgf(given, before_pruning=True)[1]
    assert torch.equal(labels, numba_spgf(depth, camera, r.config, before_pruning=True)[1])
    assert labels.max() > 2


@pytest.mark.slow
def test_labels_of_a_whole_reference_frame(kernels):
    r = reference(REFERENCES[0])
    labels = kernels.spgf(moved(SegmentInput.checked(r.depth[:1], r.intrinsics[:1], r.config)), before_pruning=True)[1]
    assert np.array_equal(labels[0].cpu().numpy(), r.frames[0]["labels"])


HOSTILE = {
    "fine": (1, 1), "nan": (lambda T: T[0, 1].fill_(torch.nan), 1), "infinite": (lambda T: T[1, 3].fill_(torch.inf), 1),
    "last row": (lambda T: T[3, 0].fill_(0.5), 1), "sheared": (lambda T: T[0, 0].mul_(1.1), 1),
    "almost": (lambda T: T[:3, :3].mul_(1.002), 1), "reflected": (lambda T: T[:3, 0].neg_(), 1),
    "far": (lambda T: T[2, 3].fill_(2e9), 1), "K nan": (1, lambda K: K[0, 2].fill_(torch.nan)),
    "K skew": (1, lambda K: K[0, 1].fill_(0.1)), "K negative": (1, lambda K: K[0, 0].neg_()),
    "K homogeneous": (1, lambda K: K[2, 2].fill_(2.0)), "K long": (1, lambda K: K[1, 1].fill_(1e8)),
    "K outside": (1, lambda K: K[0, 2].fill_(60.0)),
}  # fmt: skip


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_check(dtype):
    """A stream for every fault, and every kind of pixel."""
    from ufmstar_torch.frame import FrameMaps, check_values
    from ufmstar_torch.kernels.select import select_check

    b = len(HOSTILE)
    pose = torch.tensor(scenes.look((1.0, 2.0, 3.0), 0.4, 0.2)).repeat(b, 1, 1)
    camera = torch.tensor(scenes.intrinsics(*SIZE)).repeat(b, 1, 1)
    for (spoil_pose, spoil_camera), T, C in zip(HOSTILE.values(), pose, camera, strict=True):
        _ = spoil_pose(T) if callable(spoil_pose) else spoil_camera(C) if callable(spoil_camera) else None
    generator = torch.Generator().manual_seed(0)
    values = torch.tensor([torch.nan, torch.inf, -1.0, 0.0, 1e-7, 1e-6, 1.0, 5.0, 19.9, 20.0, 20.1, 2e6, 1e13])

    def draw(*shape):
        return values[torch.randint(len(values), shape, generator=generator)].to(dtype)

    maps = FrameMaps(
        draw(b, *SIZE),
        draw(b, *SIZE),
        draw(b, *SIZE),
        draw(b, 2, *SIZE),
        torch.rand(b, *SIZE, generator=generator) > 0.1,
    )
    options = {"rotation_tolerance": 0.01, "max_depth": 20.0}
    for given in (maps, FrameMaps(maps.depth, None, None, None, None)):
        expected = check_values(given, pose, camera, **options)
        actual = select_check("triton", DEVICE)(*moved((given, pose, camera)), **options)
        assert sorted(set(expected.fault.tolist())) == list(range(10))
        for f in fields(expected):
            x, y = getattr(actual, f.name), getattr(expected, f.name)
            if f.name != "known_fault" and y is not None:
                close(x, y, 1e-14, 1e-14)
    if DEVICE != "cpu":
        known = select_check("triton", DEVICE)(moved(maps), pose, camera, **options).known_fault
        assert torch.equal(known, expected.fault)


def steps(config, streams, frames, device):
    """Outputs and module over a walk; the first stream's second frame has no depth."""
    # In float32 the CPU leaves out anchors' shares that the GPU counts, below the bound for that dtype.
    ufm = UfMStar(config, dtype=torch.float64 if config.anchors is not None else torch.float32)
    out = []
    for i, (depth, pose, intrinsics, anchors) in enumerate(walks(streams, frames)):
        if i == 1:
            depth = torch.cat([torch.full_like(depth[:1], torch.nan), depth[1:]])
        options = {"anchors": anchors} if config.anchors is not None else {}
        options |= {"features": (depth / 10).nan_to_num()[:, None]} if config.features else {}
        given = [depth, pose, intrinsics, (depth / 100).nan_to_num()]
        moved_options = {name: moved(value) for name, value in options.items()} if device != "cpu" else options
        out.append(ufm(*(v.to(device) for v in given), **moved_options))
    return out, ufm


@pytest.mark.parametrize(
    ("streams", "settings"),
    [
        (1, {"initial_capacity": 2}),
        (4, {"unmeasured": "relative", "prior_mean": 0.2}),
        (1, {"unmeasured": "nan", "ema_alpha": 1.0, "max_components": 4}),
        (4, {"initial_capacity": 2, "features": 1, "anchors": AnchorConfig()}),
        (1, {"disagreement": "overlap", "overlap_weighted": True, "unmeasured": "relative"}),
    ],
)
def test_whole_step(streams, settings):
    """Growth, a limit, an empty frame, anchors: every output as the CPU's, and nothing lost that came too late."""
    config = UfMStarConfig(segment=SPGF, backend="numba", **settings)
    frames = 4 if streams == 1 else 2
    expected, cpu = steps(config, streams, frames, "cpu")
    actual, ufm = steps(config.replace(backend="triton"), streams, frames, DEVICE)
    overflowed = 0
    for a, e in zip(actual, expected, strict=True):
        assert torch.equal(a.labels.cpu(), e.labels)
        late = (a.statistics.components.cpu() < e.statistics.components).any()  # some wait for slots: not in this map
        overflowed += int(late)
        for name in () if late else ("variance", "measured", "features", "bias"):
            x, y = getattr(a, name), getattr(e, name)
            assert (x is None) == (y is None)
            if x is not None:
                close(x, y, 1e-8, 1e-10)
        given = {f.name for f in fields(e.statistics) if getattr(e.statistics, f.name) is not None}
        for name in given - ({"components", "unmeasured"} if late else set()):
            torch.testing.assert_close(getattr(a.statistics, name).cpu(), getattr(e.statistics, name))
    assert (overflowed > 0) == (settings.get("initial_capacity") == 2 and config.anchors is None)
    n = int(cpu.mixture.components.max())
    assert n > 2, "the mixture must have grown"
    for name, value in cpu.mixture.tensors().items():
        close(getattr(ufm.mixture, name)[:, :n], value[:, :n], 1e-5, 1e-7)


def test_a_walk_agrees_with_the_oracle(kernels):
    """All kernels over the oracle's sequence; in the interpreter the CPU's segmentation, whose labels are the same."""
    from functools import partial

    from ufmstar_torch.frame import check_frame
    from ufmstar_torch.state import UfMStarState
    from ufmstar_torch.step import step

    depths, poses, intrinsics, aleatoric, maps, _, expected, sizes = oracle_run()
    config = UfMStarConfig(segment=SPGF, features=2, initial_capacity=8)
    if INTERPRETED:
        kernels = replace(kernels, spgf=select_kernels("numba", "cpu").spgf)
    run = partial(step, kernels=kernels)
    state = UfMStarState.initial(1, config, torch.float64, DEVICE)
    for i, (depth, T, a) in enumerate(zip(depths, poses, aleatoric, strict=True)):
        given = (depth, T, intrinsics, a, np.stack([a, np.nan_to_num(depth)]))
        d, T_world_cam, camera, own, features = (torch.tensor(x)[None].to(DEVICE) for x in given)
        frame = check_frame(
            d, T_world_cam, camera, own, None, None, features, feature_count=2, rotation_tolerance=0.01, max_depth=20.0
        )
        state, out = run(state, frame, config)
        assert out.statistics.components.item() == sizes[i]
        np.testing.assert_allclose(out.disagreement[0].cpu().numpy(), maps[i][1], rtol=0, atol=1e-10)
    for k, g in enumerate(expected):
        np.testing.assert_allclose(state.mean[0, k].cpu().numpy(), g["mean"], atol=1e-10)
        assert state.disagreement[0, k].item() == pytest.approx(g["m"], abs=1e-10)


@pytest.mark.skipif(not INTERPRETED, reason="on a GPU tests/test_gpu.py records a graph")
def test_capture_keeps_the_state_in_place(monkeypatch):
    """The bookkeeping of a capture, with a function in the place of the graph; and the launches of a step."""
    from triton.runtime.jit import KernelInterface

    from ufmstar_torch.capture import Captured

    monkeypatch.setattr("ufmstar_torch.capture._WARM_UP", 1)
    launched, launch = [], KernelInterface.__getitem__
    monkeypatch.setattr(
        KernelInterface, "__getitem__", lambda kernel, grid: launched.append(kernel.fn.__name__) or launch(kernel, grid)
    )

    config = UfMStarConfig(segment=SPGF, backend="triton", on_bad_frame="skip", initial_capacity=16, max_components=16)
    given = [frame[:3] for frame in walks(1, 2)]
    ufm, plain = UfMStar(config), UfMStar(config)
    captured = Captured(ufm, *given[0], record=lambda run: run)
    memory = ufm.mean
    for i, frame in enumerate(given):
        if i == 1:
            ufm.reset()
            plain.reset()
        launched.clear()
        out = captured(*frame)
        assert len(launched) == len(set(launched)) == 2 + 10, launched  # the check, the step
        expected = plain(*frame)
        close(out.variance, expected.variance, 0, 0)
        assert ufm.mean is memory
    assert torch.equal(ufm.frames, plain.frames)
    with pytest.raises(ValueError, match="depth must be as at the capture"):
        captured(given[0][0][:, :5], *given[0][1:])
    with pytest.raises(ValueError, match=r"a capture needs on_bad_frame='skip'.*a mixture that grows"):
        Captured(UfMStar(UfMStarConfig(backend="triton")), *given[0])


def test_what_the_limit_leaves_without_a_slot_counts_as_dropped():
    """The CPU counts it in its own frame; here it may have waited for the next one."""
    dropped = {}
    for backend, device in (("numba", "cpu"), ("triton", DEVICE)):
        ufm = UfMStar(UfMStarConfig(segment=SPGF, backend=backend, initial_capacity=2, max_components=3))
        outputs = [ufm(*(v.to(device) for v in frame[:3])) for frame in walks(1, 2)]
        dropped[backend] = [int(out.statistics.dropped) for out in outputs]
        assert int(ufm.mixture.components) == 3
    assert dropped["triton"][0] == 0 < dropped["numba"][0], "the first frame was to wait"
    assert sum(dropped["triton"]) == sum(dropped["numba"])


def test_what_waits_for_a_slot_is_in_whatever_is_saved_or_copied(monkeypatch):
    config = UfMStarConfig(segment=SPGF, backend="triton", initial_capacity=2)
    first, second = (tuple(moved(v) for v in frame[:3]) for frame in walks(1, 2))
    ufm = UfMStar(config)
    new = int(ufm(*first).statistics.new)
    assert new > 2 == ufm.mean.shape[1], "some must wait"
    with monkeypatch.context() as broken:
        broken.setattr("ufmstar_torch.kernels.step_device.fuse_bits", Mock(side_effect=RuntimeError("out of memory")))
        with pytest.raises(RuntimeError, match="out of memory"):
            ufm(*second)
    twin = copy.deepcopy(ufm)
    assert int((twin.mean[0, :, 2] != 0).sum()) == new
    assert int(ufm.state_dict()["count"].sum()) == new
    restored = UfMStar(config, device=DEVICE)
    restored.load_state_dict(ufm.state_dict())
    outputs = [module(*second) for module in (ufm, restored)]
    close(outputs[1].variance, outputs[0].variance.cpu(), 0, 0)
    assert torch.equal(outputs[0].statistics.components, outputs[1].statistics.components)
    ufm.reset()
    assert ufm.state.mixture.streams == 0

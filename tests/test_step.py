"""The whole step of every backend: against the oracle, against the reference, alone and together to the last bit."""

from __future__ import annotations

import functools
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from walks import HEIGHT, SPGF, WIDTH, oracle_settings

import oracle
import scenes
from ufmstar_torch import AnchorConfig, SPGFConfig, UfMStar, UfMStarConfig
from ufmstar_torch.anchors import Anchors
from ufmstar_torch.frames.frame import check_values
from ufmstar_torch.kernels.cpu import calls

pytestmark = pytest.mark.numerics

SIZE = (48, 64)
K = torch.tensor(scenes.intrinsics(*SIZE))
SMALL = SPGFConfig(min_pixels=100, min_rows=8)
ON_CPU = pytest.mark.parametrize("backend", ["torch", "numba"], indirect=True)

# Settings of UfM*, and the oracle's names for them.
VARIANTS = {
    "default": (UfMStarConfig(segment=SPGF, unmeasured="paper", initial_capacity=8), {}),
    "weighted": (UfMStarConfig(segment=SPGF, unmeasured="paper", overlap_weighted=True), {"overlap_weighted": True}),
    "nan": (UfMStarConfig(segment=SPGF, unmeasured="nan"), {"unmeasured": "nan"}),
    "paper": (UfMStarConfig.paper(), {"neighbourhood": (2.0, 0.1, 0.5), "baseline": None}),
    "members": (UfMStarConfig(segment=SPGF, view_baseline=0.02), {
        "baseline": 0.02, "unmeasured": "relative", "unmeasured_relative": 0.2,
    }),
}  # fmt: skip


def views_of(variant: str, i: int):
    """Arguments of frame ``i`` about its view: three networks of which one predicts twice, and a covered lens."""
    return {"member": (0, 1, 1, 2)[i % 4], "informative": i != 2} if variant == "members" else {}


@functools.cache
def oracle_walk(variant: str, count: int):
    """Depths, poses, K and A of a rendered walk; the oracle's maps and matches per frame, and its mixture."""
    config, words = VARIANTS[variant]
    depths, poses, camera = scenes.sequence(count, HEIGHT, WIDTH, 0.04)
    rng = np.random.default_rng(1)
    aleatoric = [0.01 + 0.02 * rng.random(d.shape) for d in depths]
    judge = oracle.Oracle(oracle_settings(config.segment.scaled_to(HEIGHT, WIDTH)), **words)
    maps, matches = [], []
    for i, (depth, T, a) in enumerate(zip(depths, poses, aleatoric, strict=True)):
        V, M = judge.step(depth, T, camera, aleatoric=a, **views_of(variant, i))
        maps.append(SimpleNamespace(V=V, M=M, share=judge.share(), weights=[g["weight"] for g in judge.mixture]))
        matches.append(judge.matches)
    return depths, poses, camera, aleatoric, maps, matches, judge.mixture


def assert_varied(maps, matches, mixture):
    """Assert that the rendered sequence contains the cases to test."""
    sizes = [len(frame.weights) for frame in maps]
    per_c = [len(ks) for frame in matches for ks in frame]
    per_k = [sum(k in ks for ks in frame) for frame in matches for k in range(100)]
    assert max(per_c) > 1, "one current component must match many"
    assert max(per_k) > 1, "many must match one"
    assert min(per_c) == 0
    assert sizes[-1] > sizes[0] + 5, "new places must be seen"
    assert max(g["views"] for g in mixture) > 2, "places must be revisited"


@pytest.mark.parametrize("variant", VARIANTS)
def test_a_walk_agrees_with_the_oracle(backend, variant):
    if backend.slow and variant != "members":  # in which two views are compared
        pytest.skip("the reference is compared with in every variant")
    count = 20 if variant == "default" else 4
    depths, poses, camera, aleatoric, maps, matches, expected = oracle_walk(variant, count)
    config = VARIANTS[variant][0]
    if backend.name == "triton":  # components without a slot appear in the next frame's map (test_triton.py)
        config = config.replace(initial_capacity=256)
    ufm = backend.module(config, torch.float64)

    def batch(x):
        return torch.tensor(np.asarray(x))[None]

    for i, (depth, T, a) in enumerate(zip(depths, poses, aleatoric, strict=True)):
        view = {name: batch(value) if name == "informative" else value for name, value in views_of(variant, i).items()}
        out = ufm(batch(depth), batch(T), batch(camera), aleatoric=batch(a), **view)
        assert out.statistics.components.tolist() == [len(maps[i].weights)]
        assert out.statistics.pairs.tolist() == [sum(map(len, matches[i]))]
        assert out.statistics.unmeasured.tolist() == [int((maps[i].share < 0.5).sum())]
        np.testing.assert_allclose(out.disagreement[0].numpy(), maps[i].M, rtol=1e-8, atol=1e-10)
        np.testing.assert_allclose(out.variance[0].numpy(), maps[i].V, rtol=1e-8, atol=1e-10)
        np.testing.assert_allclose(out.measured[0].numpy(), maps[i].share, rtol=1e-7, atol=1e-9)
    assert len(expected) > 1
    assert max(g["m"] for g in expected) > 0
    if count == 20:
        assert_varied(maps, matches, expected)
    found = ufm.ufm.mixture.to("cpu")
    for k, g in enumerate(expected):
        for name, key in (
            ("mean", "mean"),
            ("covariance", "cov"),
            ("disagreement", "m"),
            *((n, n) for n in ("compared", "views", "reference")),
        ):
            np.testing.assert_allclose(getattr(found, name)[0, k].numpy(), g[key], rtol=1e-9, atol=1e-10)
        assert found.weight[0, k].item() == pytest.approx(g["weight"], rel=1e-12)  # whole numbers, but where weighted


CONFIGS = {
    "default": UfMStarConfig(segment=SMALL),
    "paper": UfMStarConfig.paper().replace(segment=replace(SMALL, slope_focal="camera")),
    "weighted": UfMStarConfig(segment=SMALL, overlap_weighted=True, unmeasured="relative"),
    "full": UfMStarConfig(segment=SMALL, variances_in_h=True, max_components=12, initial_capacity=3, unmeasured="nan"),
    "anchored": UfMStarConfig(segment=SMALL, anchors=AnchorConfig(), unmeasured="nan", prior_mean=0.2),
}


def frames(count: int, config: UfMStarConfig, dtype: torch.dtype, streams: int = 1, size: tuple[int, int] = SIZE):
    """Arguments of ``UfMStar.forward``: streams that start at different frames of one tour, with holes and faults."""
    depths, poses, camera = scenes.sequence(max(12, count + streams), *size, 0.05)
    generator = torch.Generator().manual_seed(0)
    for i in range(count):
        depth = torch.stack([torch.tensor(depths[i + s]) for s in range(streams)]).to(dtype)
        pose = torch.stack([torch.tensor(poses[i + s]) for s in range(streams)]).double()
        depth[:, 5, 7], depth[:, 9], depth[:, 10, :30] = torch.nan, 30.0, 1e-9
        if i == 1:
            pose[-1, 0, 0] += 0.5
        more: dict = {}
        if config.variances_in_h:
            more["aleatoric"] = 0.01 * torch.rand(depth.shape, generator=generator, dtype=dtype)
            more["aleatoric"][:, 3, 3], more["epistemic"] = -1.0, torch.full_like(depth, 0.1)
            more["valid"] = torch.rand(depth.shape, generator=generator) > 0.1
        if config.anchors is not None:
            at = torch.randint(0, size[0], (streams, 20, 2), generator=generator)
            present = torch.stack([depth[s, at[s, :, 1], at[s, :, 0]] for s in range(streams)]).double()
            more["anchors"] = Anchors(at.double(), 1.1 * present, 1e-4 * present.square())
        yield (depth, pose, torch.tensor(camera)), more


def tensors(out) -> dict[str, torch.Tensor]:
    """Return the tensors of a frame's output by name."""
    result = {f"statistics.{name}": value for name, value in out.statistics.counts.items()}
    return {name: value for name, value in (result | vars(out) | out.maps).items() if isinstance(value, torch.Tensor)}


def assert_same(one, other, rows=slice(None)) -> None:
    """Assert equality bit for bit."""
    a, b = tensors(one), tensors(other)
    for name, value in a.items():
        assert torch.equal(value.double().nan_to_num(-1), b[name][rows].double().nan_to_num(-1)), name


@pytest.mark.parametrize("name", CONFIGS)
@pytest.mark.parametrize(("dtype", "tolerance"), [(torch.float64, 1e-10), (torch.float32, 3e-5)])
def test_agrees_with_the_reference(compiled_backend, name, dtype, tolerance):
    slow, config = compiled_backend.slow, CONFIGS[name].replace(on_bad_frame="skip")
    if slow and (dtype == torch.float64) != (name in ("full", "anchored")):
        pytest.skip("in one precision")
    if compiled_backend.name == "triton":  # as above
        config = config.replace(initial_capacity=config.max_components or 64)
    fast, reference = compiled_backend.module(config, dtype), UfMStar(config.replace(backend="torch"), dtype=dtype)
    few = {"count": 2, "size": (21, 24)} if slow else {"count": 3, "size": (21, 24)}
    for arguments, more in frames(config=config, dtype=dtype, streams=2, **few):
        a, b = tensors(fast(*arguments, **more)), tensors(reference(*arguments, **more))
        assert a.keys() == b.keys()
        for key, value in b.items():
            found = a[key].cpu()
            if value.is_floating_point():
                scale = value.nan_to_num(0).abs().max().item() if value.numel() else 0.0
                torch.testing.assert_close(found, value, rtol=tolerance, atol=tolerance * scale, equal_nan=True)
            else:
                assert torch.equal(found, value), key
    assert int(fast.ufm.skipped.sum()) == 1
    assert int(fast.ufm.mixture.components.max()) > 3
    for key, value in reference.state.tensors().items():
        found = getattr(fast.ufm, key).cpu()
        assert found.dtype == value.dtype
        if key in reference.mixture.tensors() or key in reference.state.by_component:
            slots = min(found.shape[1], value.shape[1])  # on a GPU the mixture grows one frame ahead
            assert not found[:, slots:].any()
            found, value = found[:, :slots], value[:, :slots]
        torch.testing.assert_close(found, value, rtol=10 * tolerance, atol=10 * tolerance, equal_nan=True)


@ON_CPU
@pytest.mark.parametrize("name", CONFIGS)
def test_a_stream_gives_the_same_bits_alone_and_on_any_number_of_threads(backend, name, monkeypatch):
    monkeypatch.setattr(calls, "_SHARE", 4 * 64)  # pixels; up to three parts of a stream
    config = CONFIGS[name].replace(on_bad_frame="skip", backend=backend.name)
    counts = (1, 2, 3) if backend.name == "numba" else (1,)  # torch's sums are not deterministic
    # The reference processes an image row by row, so the images have few rows.
    few = {"count": 4} if backend.name == "numba" else {"count": 2, "size": (21, 24)}
    together, alone = [UfMStar(config) for _ in counts], [UfMStar(config) for _ in range(3)]
    before = torch.get_num_threads()
    try:
        for arguments, more in frames(config=config, dtype=torch.float32, streams=3, **few):
            outs = []
            for threads, ufm in zip(counts, together, strict=True):
                torch.set_num_threads(threads)
                outs.append(ufm(*arguments, **more))
                assert torch.get_num_threads() == threads
            for other in outs[1:]:
                assert_same(outs[0], other)
            for s, ufm in enumerate(alone):
                one = {key: value[s : s + 1] for key, value in more.items() if key != "anchors"}
                if "anchors" in more:
                    fields = {key: v[s : s + 1] for key, v in vars(more["anchors"]).items() if v is not None}
                    one["anchors"] = Anchors(**fields)
                depth, pose, camera = arguments
                assert_same(ufm(depth[s : s + 1], pose[s : s + 1], camera, **one), outs[0], slice(s, s + 1))
    finally:
        torch.set_num_threads(before)
    for s, ufm in enumerate(alone):
        n = int(ufm.mixture.components)
        for key, value in ufm.mixture.tensors().items():
            assert torch.equal(getattr(together[0].mixture, key)[s, :n], value[0, :n]), key


@ON_CPU
def test_the_state_before_is_not_modified(backend):
    config = CONFIGS["full"].replace(backend=backend.name)
    ufm = UfMStar(config)
    inputs = list(frames(3, config, torch.float32))[::2]  # the frame between is at fault
    ufm(*inputs[0][0], **inputs[0][1])
    before = ufm.state
    copies = {name: value.clone() for name, value in before.tensors().items()}
    ufm(*inputs[1][0], **inputs[1][1])
    for name, value in before.tensors().items():
        assert torch.equal(value.nan_to_num(-1), copies[name].nan_to_num(-1)), name


def hostile_cameras():
    """Poses and intrinsics with each fault, with several, and with none."""
    eye, camera = torch.eye(4, dtype=torch.float64), K.double()

    def changed(value: torch.Tensor, i: int, j: int, entry: float) -> torch.Tensor:
        value = value.clone()
        value[i, j] = entry
        return value

    entries = [(0, 0, torch.nan), (1, 3, torch.inf), (3, 0, 0.5), (0, 0, 1.004), (0, 0, 1.2), (2, 2, -1.0)]
    entries += [(2, 3, 1e10), (1, 3, -1e9), (0, 1, 1e-3)]
    poses = [eye, *(changed(eye, *entry) for entry in entries)]
    entries = [(0, 0, torch.nan), (0, 0, -30.0), (0, 1, 0.1), (2, 2, 2.0), (0, 0, 1e8), (1, 1, 1e-3), (0, 2, 80.0)]
    entries += [(1, 2, -0.5), (1, 2, -0.6), (0, 2, 16.5)]
    cameras = [changed(changed(camera, 0, 2, 8.0), 1, 2, 4.0)]
    cameras += [changed(cameras[0], *entry) for entry in entries]
    return torch.stack([p for p in poses for _ in cameras]), torch.stack([c for _ in poses for c in cameras])


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_the_check_agrees_with_the_reference(compiled_backend, dtype):
    poses, cameras = hostile_cameras()
    if compiled_backend.slow:
        poses, cameras = poses[::3], cameras[::3]
    b, generator = len(poses), torch.Generator().manual_seed(1)

    def hostile(*shape: int) -> torch.Tensor:
        special = [torch.nan, torch.inf, -torch.inf, 0.0, -1.0, 1e-7, 1e-6, 1e6, 2e6, 1e12, 1.1e12, 3e38]
        special += [20.3, 20.300001]
        values = torch.rand(shape, generator=generator, dtype=torch.float64) * 30
        pick = torch.randint(0, 3 * len(special), shape, generator=generator)
        return torch.where(pick < len(special), torch.tensor(special).double()[pick % len(special)], values).to(dtype)

    size = (9, 17)
    depth, a, e = hostile(b, *size), hostile(b, *size), hostile(b, *size)
    mask = torch.rand(b, *size, generator=generator) > 0.2
    for optional in ((a, e, mask), (None,) * 3, (None, e, mask)):
        arguments = (depth, poses, cameras, *optional)
        slow = check_values(*arguments, rotation_tolerance=0.01, max_depth=20.3)
        fast = compiled_backend.check(*arguments, rotation_tolerance=0.01, max_depth=20.3)
        for name, value in vars(slow).items():
            found = getattr(fast, name)
            if value is None:
                assert found is None
            elif found is not None or name != "host_fault":  # GPUs: only with cameras on the host
                assert found.dtype == value.dtype, name
                torch.testing.assert_close(found, value, rtol=1e-14, atol=1e-14, equal_nan=True)
        assert set(range(10)) == set(slow.fault.tolist())
        assert slow.beyond.sum() > 0
        assert slow.out_of_range.sum() > 0


def test_warming_up_compiles_all_that_a_frame_needs_and_touches_no_state():
    """Everything is compiled in this process already; the test checks that no compilation follows the warm-up."""
    from numba.core import event

    config = CONFIGS["anchored"].replace(initial_capacity=2)
    ufm = UfMStar(config, dtype=torch.float64)
    before = {name: value.clone() for name, value in ufm.state.tensors().items()}
    ufm.warm_up(SIZE, streams=2)
    for name, value in ufm.state.tensors().items():
        assert torch.equal(value, before[name]), name
    with event.install_recorder("numba:compile") as compiled:
        for arguments, more in frames(3, config.replace(on_bad_frame="skip"), torch.float32, streams=2):
            ufm.config = config.replace(on_bad_frame="skip")
            ufm(*arguments, **more)
            ufm.mean_uncertainty(*arguments, **more)
    assert not compiled.buffer


def test_warming_up_with_the_reference():
    shown = []
    ufm = UfMStar(CONFIGS["default"].replace(backend="torch"))
    ufm.warm_up((8, 8), progress=lambda done, total: shown.append((done, total)))
    assert shown == [(done, len(shown) - 1) for done in range(len(shown))]
    assert len(shown) > 10
    assert ufm.observer is None

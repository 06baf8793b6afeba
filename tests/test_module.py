"""UfMStar as an nn.Module: state, devices, dtypes, bad input, subsets, queries."""

from __future__ import annotations

import copy
import json

import numpy as np
import pytest
import safetensors.torch
import torch
from modules import CONFIG, POSES, H, W, frame, same, snapshot, unchanged
from torch._subclasses.fake_tensor import FakeTensorMode
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_leaves
from walks import SPGF

from ufmstar_torch import AnchorConfig, MergeConfig, SPGFConfig, UfMStar, UfMStarConfig
from ufmstar_torch.gaussians.camera import unproject
from ufmstar_torch.gaussians.mixture import GaussianMixture
from ufmstar_torch.steps.fuse import make_room

pytestmark = pytest.mark.numerics


@pytest.mark.parametrize("cut", [1, 4])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64], ids=["depth32", "depth64"])
@pytest.mark.parametrize("state_dtype", [torch.float32, torch.float64], ids=["state32", "state64"])
def test_saved_state_continues_bit_for_bit(tmp_path, cut, dtype, state_dtype):
    whole = UfMStar(CONFIG.replace(initial_capacity=4), dtype=state_dtype)
    expected = [whole(*frame(i, dtype)).variance for i in range(8)]
    assert {e.dtype for e in expected} == {dtype}
    first = UfMStar(CONFIG.replace(initial_capacity=4), dtype=state_dtype)
    for i in range(cut):
        first(*frame(i, dtype))
    second = UfMStar(CONFIG.replace(initial_capacity=4), dtype=state_dtype)
    if cut == 1:
        safetensors.torch.save_file(first.state_dict(), tmp_path / "state.safetensors")
        second.load_state_dict(safetensors.torch.load_file(tmp_path / "state.safetensors"))
    else:
        torch.save(first.state_dict(), tmp_path / "state.pt")
        second.load_state_dict(torch.load(tmp_path / "state.pt", weights_only=True))
    for i in range(cut, 8):
        assert same(second(*frame(i, dtype)).variance, expected[i])
    assert unchanged(second, whole.state_dict())


def put(index, value):
    """Return an edit of a tensor that writes a value (a number, or a function of the old values) at an index."""

    def edit(tensor):
        tensor[index] = value(tensor[index]) if callable(value) else value
        return tensor

    return edit


SPOILT = {
    "shape": ("mean", lambda v: v[:, :-1]),
    "streams": ("T_world_first", lambda v: v.repeat(2, 1, 1)),
    "NaN": ("mean", put((0, 0), torch.nan)),
    "infinite": ("disagreement", put((0, 0), torch.inf)),
    "negative": ("weight", put((0, 0), -1.0)),
    "hole": ("weight", put((0, 0), 0.0)),
    "not positive definite": ("covariance", put((0, 0), lambda v: -v)),
    "not symmetric": ("covariance", put((0, 0, 0, 1), 9.0)),
    "not rigid": ("T_world_first", put(0, lambda v: 2 * v)),
    "features": ("features", lambda v: v.new_zeros(*v.shape[:2], 3)),
    "integers": ("mean", lambda v: v.long()),
    "no tensor": ("frames", lambda _: 3),
    "config: no bytes": ("_extra_state", lambda _: {"eta": 0.5}),
    "config: no JSON": ("_extra_state", lambda v: v[:-1]),
    "config: no object": ("_extra_state", lambda _: torch.tensor(list(b"[1]"), dtype=torch.uint8)),
}


@pytest.mark.parametrize("name", SPOILT)
def test_a_bad_state_is_refused_before_anything_is_replaced(name):
    whole = UfMStar(CONFIG)
    for i in range(2):
        whole(*frame(i))
    key, edit = SPOILT[name]
    ufm = UfMStar(CONFIG)
    ufm(*frame(3))
    before = snapshot(ufm)
    with pytest.raises(RuntimeError, match=f"UfMStar keeps its state: .*{key.strip('_')}"):
        ufm.load_state_dict(whole.state_dict() | {key: edit(whole.state_dict()[key].clone())})
    assert unchanged(ufm, before)
    ufm.load_state_dict(whole.state_dict())
    assert same(ufm(*frame(2)).variance, whole(*frame(2)).variance)


def test_a_state_of_too_many_components_or_other_keys_is_refused_whole():
    whole, few = UfMStar(CONFIG), UfMStar(CONFIG.replace(max_components=2))
    whole(*frame(0))
    few(*frame(1))
    before = snapshot(few)
    state = whole.state_dict()
    for changed, match in (
        (state, "256 slots exceed max_components = 2"),
        (state | {"other": torch.zeros(1)}, "Unexpected key"),
        ({key: value for key, value in state.items() if key != "views"}, "Missing key"),
    ):
        with pytest.raises(RuntimeError, match=match):
            few.load_state_dict(changed)
        assert unchanged(few, before)


def test_deepcopy_is_independent():
    ufm = UfMStar(CONFIG)
    ufm(*frame(0))
    twin = copy.deepcopy(ufm)
    before = snapshot(ufm)
    expected = twin(*frame(1)).variance
    assert unchanged(ufm, before)
    assert same(ufm(*frame(1)).variance, expected)


def test_a_frame_does_not_mutate_what_it_is_given():
    depth, pose, intrinsics = frame(0)
    copies = [x.clone() for x in (depth, pose, intrinsics)]
    ufm = UfMStar(CONFIG)
    ufm(depth, pose, intrinsics)
    for value, original in zip((depth, pose, intrinsics), copies, strict=True):
        assert same(value.double(), original.double())


@pytest.mark.parametrize("cast", [torch.float64, torch.float32, torch.float16, torch.bfloat16])
def test_casts_keep_the_state_usable(cast):
    ufm = UfMStar(CONFIG)
    ufm(*frame(0))
    pose = ufm.T_world_first.clone()
    ufm.to(cast)
    assert ufm.mean.dtype == (torch.float64 if cast == torch.float64 else torch.float32)
    assert ufm.T_world_first.dtype == torch.float64
    assert torch.equal(ufm.T_world_first, pose)
    assert ufm(*frame(1)).variance.isfinite().any()


@pytest.mark.parametrize("dtype", [torch.float16, torch.bfloat16])
def test_half_precision_depth_is_computed_safely(dtype):
    half, full = UfMStar(CONFIG), UfMStar(CONFIG)
    for i in range(3):
        depth, pose, intrinsics = frame(i)
        a = half(depth.to(dtype), pose, intrinsics)
        b = full(depth.to(dtype).float(), pose, intrinsics)
        assert a.variance.dtype == torch.float32
        assert same(a.variance, b.variance)


def test_autocast_changes_nothing():
    plain, cast = UfMStar(CONFIG.replace(backend="torch")), UfMStar(CONFIG.replace(backend="torch"))
    for i in range(2):
        expected = plain(*frame(i)).variance
        with torch.autocast("cpu", dtype=torch.bfloat16):
            assert same(cast(*frame(i)).variance, expected)


@pytest.mark.parametrize("backend", ["torch", "numba"])
def test_inference_mode_then_normal_mode(backend):
    config = CONFIG.replace(backend=backend, initial_capacity=2)  # grows inside inference mode
    ufm, plain = UfMStar(config), UfMStar(config)
    with torch.inference_mode():
        inside = ufm(*frame(0)).variance.clone()
    assert same(inside, plain(*frame(0)).variance)
    assert not ufm.mean.is_inference()
    assert same(ufm(*frame(1)).variance, plain(*frame(1)).variance)
    ufm.mean += 0.0  # an inference tensor would refuse
    with torch.inference_mode():
        ufm.reset([0])
    assert not any(value.is_inference() for value in ufm.buffers())
    ufm.load_state_dict(plain.state_dict())


def test_gradients_reach_the_networks_own_variance_only():
    ufm = UfMStar(CONFIG)
    depth, pose, intrinsics = frame(0, torch.float64)
    depth = depth.nan_to_num(1.0).requires_grad_()
    a = torch.full_like(depth, 0.1).detach().requires_grad_()
    out = ufm(depth, pose, intrinsics, aleatoric=a)
    out.variance.sum().backward()
    assert depth.grad is None
    torch.testing.assert_close(a.grad, torch.ones_like(a))


def test_maps_with_and_without_a_channel_give_the_same():
    flat, channel = UfMStar(CONFIG), UfMStar(CONFIG)
    for i in range(2):
        depth, pose, intrinsics = frame(i)
        a = torch.full_like(depth, 0.01)
        valid = torch.ones_like(depth, dtype=torch.bool)
        x = flat(depth, pose, intrinsics, a, a, valid)
        y = channel(depth[:, None], pose, intrinsics, a[:, None], a[:, None], valid[:, None])
        assert y.variance.shape == y.std.shape == y.valid.shape == (1, 1, H, W)
        assert same(x.variance, y.variance[:, 0])
    shared = UfMStar(CONFIG)
    for i in range(2):
        depth, pose, intrinsics = frame(i)
        z = shared(depth, pose[0], intrinsics[0], a, a)
    assert same(z.variance, x.variance)


@pytest.mark.parametrize("streams", [[1], torch.tensor([False, True, False])])
def test_reset_of_one_stream_and_of_all(streams):
    def three(i):
        depth, pose, intrinsics = frame(i)
        return depth.expand(3, H, W), pose.expand(3, 4, 4), intrinsics.expand(3, 3, 3)

    ufm, fresh = UfMStar(CONFIG), UfMStar(CONFIG)
    for i in range(2):
        ufm(*three(i))
    ufm.reset(streams)
    out, alone = ufm(*three(2)), fresh(*frame(2))
    assert same(out.variance[1], alone.variance[0])
    assert ufm.frames.tolist() == [3, 1, 3]
    assert (out.disagreement[0][out.valid[0]] > 0).any()
    ufm.reset()
    assert ufm.mean.shape[0] == 0
    assert same(ufm(*frame(0)).variance, UfMStar(CONFIG)(*frame(0)).variance)


def test_growth_by_doubling_keeps_everything():
    small, large = UfMStar(CONFIG.replace(initial_capacity=1)), UfMStar(CONFIG.replace(initial_capacity=512))
    for i in range(8):
        assert same(small(*frame(i)).variance, large(*frame(i)).variance)
    assert large.mean.shape[1] == 512
    k = int(small.mixture.components.max())
    assert small.mean.shape[1] == 2 ** int(np.ceil(np.log2(k)))


def test_max_components_drops_the_farthest_in_both_tiers():
    """The mixture equals the one without a limit minus the components farthest from the camera; the drops are
    counted."""
    limit = 14
    limited = CONFIG.replace(initial_capacity=2, max_components=limit)
    tiers = [UfMStar(limited.replace(backend=backend), dtype=torch.float64) for backend in ("torch", "numba")]
    free, dropped, before, earlier = UfMStar(CONFIG, dtype=torch.float64), 0, 0, []
    for i in range(8):
        one, other = (ufm(*frame(i, torch.float64)) for ufm in tiers)
        assert int(one.statistics.dropped) == int(other.statistics.dropped)
        torch.testing.assert_close(one.variance, other.variance, rtol=1e-8, atol=1e-10, equal_nan=True)
        for a, b in zip(*(ufm.mixture.tensors().values() for ufm in tiers), strict=True):
            torch.testing.assert_close(a, b, rtol=1e-9, atol=1e-12)
        s = one.statistics
        dropped += int(s.dropped)
        assert int(s.components) == before + int(s.segments - s.matched) - int(s.dropped) <= limit
        before = int(s.components)
        if not dropped:
            free(*frame(i, torch.float64))
            earlier = free.mixture.mean[0, :before]
        elif free is not None:
            free(*frame(i, torch.float64))
            k = int(free.mixture.components)
            where = torch.linalg.inv(free.T_world_first[0]) @ torch.tensor(POSES[i])
            far = (free.mixture.mean[0, : len(earlier)] - where[:3, 3]).square().sum(-1)
            gone = far.sort(descending=True).indices[: k - limit]
            retained = [n for n in range(k) if n not in gone.tolist()][:limit]
            torch.testing.assert_close(tiers[0].mixture.mean[0], free.mixture.mean[0, retained], rtol=1e-9, atol=1e-12)
            free = None
    assert dropped > 0
    assert free is None
    assert tiers[0].mean.shape[1] == tiers[1].mean.shape[1] == limit


def test_the_oldest_of_equally_far_components_is_dropped_and_sums_follow():
    mean = torch.tensor([[[0.0, 0, 1], [0, 0, 2], [0, 2, 0], [0, 0, 0.5], [0, 0, 9]]])
    empty = GaussianMixture.empty(1, 5, dtype=torch.float32, device="cpu")
    mixture = empty.replace(mean=mean, weight=torch.tensor([[1.0, 2, 3, 4, 0]]))
    sums = {"evidence": torch.arange(4.0)[None, :, None]}
    for old, coming, retained, dropped in ((4, 1, [0, 2, 3], 1), (4, 3, [3], 3), (2, 1, [0, 2, 3], 1), (2, 3, [2], 2)):
        room = make_room(mixture, sums, torch.tensor([old]), torch.tensor([coming]), torch.zeros(1, 3), 4)
        assert (room.mixture.weight[0] - 1)[: len(retained)].tolist() == retained
        assert room.sums["evidence"][0, :, 0].tolist() == retained + [0] * (5 - len(retained))
        assert int(room.dropped) == dropped


def test_mean_uncertainty():
    dense, sampled, all_of_it = UfMStar(CONFIG.replace(ema_alpha=1.0)), UfMStar(CONFIG), UfMStar(CONFIG)
    for i in range(8):
        depth, pose, intrinsics = frame(i, torch.float64)
        a = torch.full_like(depth, 0.01)
        out = dense(depth, pose, intrinsics, a)
        truth = out.variance[out.valid].mean().item()
        exact = all_of_it.mean_uncertainty(depth, pose, intrinsics, a, fraction=1.0)
        assert exact.mean.item() == pytest.approx(truth, rel=1e-5)
        assert exact.pixels.item() == out.valid.sum().item()
        assert exact.standard_error.item() < 1e-12, "every pixel is sampled"
        estimate = sampled.mean_uncertainty(depth, pose, intrinsics, a, pixels=200, seed=i)
        assert estimate.pixels.item() == 200
        assert abs(estimate.mean.item() - truth) <= 3 * estimate.standard_error.item() + 1e-12
    assert unchanged(sampled, all_of_it.state_dict())  # the state does not depend on the query's pixels
    state = copy.deepcopy(sampled.state_dict())
    means = []
    for seed in (3, 3, 4):
        sampled.load_state_dict(state)
        means.append(sampled.mean_uncertainty(depth, pose, intrinsics, a, pixels=200, seed=seed).mean)
    assert torch.equal(means[0], means[1])
    assert not torch.equal(means[0], means[2])


def test_query_is_the_dense_map_at_its_own_points():
    ufm = UfMStar(CONFIG.replace(ema_alpha=1.0), dtype=torch.float64)
    for i in range(4):
        out = ufm(*frame(i, torch.float64))
    depth, pose, intrinsics = frame(3, torch.float64)
    points = unproject(depth, intrinsics).flatten(1, 2) @ pose[:, :3, :3].mT + pose[:, None, :3, 3]
    before = snapshot(ufm)
    result = ufm.query(points)
    torch.testing.assert_close(
        result.disagreement.view(1, H, W), out.disagreement, rtol=1e-6, atol=1e-9, equal_nan=True
    )
    assert unchanged(ufm, before)


class Transfers(TorchDispatchMode):
    """Records synchronising transfers between devices, on fake tensors: no accelerator is needed.

    Reading a fake tensor's value raises: with a fixed capacity, the step reads no value."""

    def __init__(self):
        super().__init__()
        self.waits = []

    def __torch_dispatch__(self, func, types, args=(), kwargs=None):
        out = func(*args, **(kwargs or {}))
        tensors = [x for x in tree_leaves((args, kwargs or {}, out)) if isinstance(x, torch.Tensor)]
        crosses = len({x.device.type for x in tensors}) > 1
        queued = (kwargs or {}).get("non_blocking") or (len(args) > 2 and args[-1] is True)
        if "_local_scalar_dense" in func.name() or ("copy" in func.name() and crosses and not queued):
            self.waits.append(func.name())
        return out


@pytest.mark.parametrize("location", ["all on the device", "pose and intrinsics on the host"])
def test_nothing_waits_for_the_accelerator(location):
    config = UfMStarConfig(segment=SPGF, backend="torch", initial_capacity=2, max_components=2, on_bad_frame="skip")
    with FakeTensorMode(allow_non_fake_inputs=True):
        ufm = UfMStar(config, device="cuda")
        device = "cuda" if location == "all on the device" else "cpu"
        depth = torch.empty(1, 1, 6, device="cuda")  # each row takes fake tensors seconds
        pose, intrinsics = torch.empty(1, 4, 4, device=device), torch.empty(1, 3, 3, device=device)
        with Transfers() as transfers:
            out = ufm(depth, pose, intrinsics, aleatoric=torch.empty_like(depth))
            if device == "cuda":  # after the check of a frame both cases are the same
                ufm.mean_uncertainty(depth, pose, intrinsics, pixels=5)
                ufm.query(torch.empty(1, 3, 3, device="cuda"))
    assert transfers.waits == []
    assert out.variance.shape == (1, 1, 6)
    assert out.variance.device.type == "cuda"


def test_config_round_trips_through_json():
    config = UfMStarConfig(eta=0.4, max_components=99, segment=SPGFConfig(min_rows=3))
    extended = config.with_values({"anchors.half_life": 10.0, "merge.loss": 0.5, "segment.sparse": 2, "eta": 0.3})
    assert (extended.anchors, extended.merge) == (AnchorConfig(half_life=10.0), MergeConfig(loss=0.5))
    assert (extended.segment, extended.eta) == (SPGFConfig(min_rows=3, sparse=2), 0.3)
    for each in (config, extended):
        assert UfMStarConfig.from_dict(json.loads(json.dumps(each.to_dict()))) == each

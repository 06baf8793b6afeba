"""Merging: against the oracle, closed forms, conserved sums, and unaffected components."""

from __future__ import annotations

import math

import numpy as np
import oracle_merge
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from random_gaussians import as_lists, covariances, mixture

import scenes
from ufmstar_torch import AnchorConfig, MergeConfig, UfMStar, UfMStarConfig
from ufmstar_torch.gaussians.mixture import GaussianMixture
from ufmstar_torch.kernels.select import select_frame
from ufmstar_torch.steps.merge import merge, merged
from ufmstar_torch.steps.regress import regress

pytestmark = pytest.mark.numerics


def merging(share: float, **settings: float) -> MergeConfig:
    """Settings with another ``share``, which is a constant."""
    return type("Merging", (MergeConfig,), {"share": share})(**settings)


CONFIG = UfMStarConfig(merge=merging(0.2, loss=1.0), anchors=AnchorConfig())
ALL = torch.tensor([True, True])


def crowd(seed: int, capacity: int = 14) -> tuple[GaussianMixture, torch.Tensor]:
    """Two streams of overlapping components with features, and their sums over anchors."""
    m = mixture(2, capacity, seed, features=2)
    generator = torch.Generator().manual_seed(seed)
    shape = covariances(2 * capacity, seed, decades=1.0, largest=0.3).view(2, capacity, 3, 3)
    m = m.replace(
        mean=0.3 * m.mean,
        covariance=shape * m.valid[..., None, None],
        weight=m.weight ** torch.tensor([[1.0], [1.4]]),
        views=m.views * (torch.rand(m.views.shape, generator=generator) < 0.7),
    )
    return m, torch.rand(2, capacity, 3, generator=generator, dtype=torch.float64) * m.valid[..., None]


def as_dicts(m: GaussianMixture, sums: torch.Tensor, stream: int) -> list[dict]:
    return [g | {"sums": sums[stream, k].numpy()} for k, g in enumerate(as_lists(m, stream))]


def one(mean: list[list[float]], spread: list[float], weight: list[float], m: list[float], evidence: list[float]):
    """One stream of round components with the variances ``spread``; m has the weight pi where there is evidence."""
    cov = torch.tensor(spread, dtype=torch.float64)[:, None, None] * torch.eye(3, dtype=torch.float64)
    fields = {"mean": mean, "weight": weight, "disagreement": m, "views": evidence}
    values = {name: torch.tensor([value], dtype=torch.float64) for name, value in fields.items()}
    compared = values["weight"] * (values["views"] > 0)
    empty = GaussianMixture.empty(1, len(m), dtype=torch.float64, device="cpu")
    return empty.replace(**values, covariance=cov[None], compared=compared)


def merge_one(m: GaussianMixture, share: float = 0.05) -> GaussianMixture:
    config = UfMStarConfig(merge=merging(share, loss=1.0))
    return merge(m, m.mean.new_zeros(*m.weight.shape, 0), torch.tensor([True]), config)[0]


@given(seed=st.integers(0, 10**6), apart=st.sampled_from([1.0, 4.0]))
@settings(max_examples=20)
def test_agrees_with_the_oracle(seed, apart):
    before, sums = crowd(seed)
    before = before.replace(mean=apart * before.mean)
    after, merged_sums = merge(before, sums, ALL, CONFIG)
    for b in range(2):
        components = as_dicts(before, sums, b)
        expected = oracle_merge.merge(components, CONFIG.merge.loss, CONFIG.merge.share, CONFIG.prior_weight)
        ours = as_dicts(after, merged_sums, b)
        assert len(ours) == len(expected)
        for mine, theirs in zip(ours, expected, strict=True):
            for name in ("mean", "cov", "weight", "m", "compared", "views", "reference", "features", "sums"):
                np.testing.assert_allclose(mine[name], theirs[name], rtol=1e-9, atol=1e-11)


@given(st.integers(0, 10**6))
@settings(max_examples=10)
def test_sums_over_the_mixture_stay(seed):
    """Both rules conserve the sums of pi, pi h, W, W m and of the anchors' evidence. Joining also conserves the
    moments."""
    before, sums = crowd(seed)
    after, merged_sums = merge(before, sums, ALL, CONFIG)
    assert int(after.components.sum()) < int(before.components.sum())
    joined, _ = merge(before, sums, ALL, CONFIG.replace(merge=merging(0.0, loss=1.0)))

    def zeroth(m: GaussianMixture) -> torch.Tensor:
        w, compared = m.weight[..., None], m.compared[..., None]
        means = w * torch.cat([torch.ones_like(w), m.features], -1)
        return torch.cat([means, compared, compared * m.disagreement[..., None]], -1).sum(1)

    def moments(m: GaussianMixture) -> torch.Tensor:
        second = m.covariance + m.mean[..., :, None] * m.mean[..., None, :]
        return (m.weight[..., None] * torch.cat([m.mean, second.flatten(2)], -1)).sum(1)

    torch.testing.assert_close(zeroth(after), zeroth(before), rtol=1e-12, atol=1e-9)
    torch.testing.assert_close(moments(joined), moments(before), rtol=1e-11, atol=1e-9)
    torch.testing.assert_close(merged_sums.sum(1), sums.sum(1), rtol=1e-12, atol=1e-12)


@pytest.mark.parametrize("step", [-1e-3, 1e-3])
def test_the_limit_is_the_divergence_of_the_lighter_from_the_heavier(step):
    """A vanishing weight at distance d of an equal shape: l -> d^2 / (2 sigma^2), 1 nat at sqrt(2) sigma."""
    d = (math.sqrt(2) + step) * 0.1
    two = one([[0.0, 0.0, 2.0], [d, 0.0, 2.0]], [0.01, 0.01], [1e9, 1.0], [0.5, 0.5], [2.0, 2.0])
    assert int(merge_one(two, share=0.0).components) == (1 if step < 0 else 2)


def test_what_was_seen_from_one_view_stays_unmeasured():
    """The join of two single-view components is unmeasured. A measured component does not join a heavier single-view
    component, which would then count as measured."""
    means = [[0.0, 0.0, 2.0], [0.01, 0.0, 2.0]]
    firsts = merge_one(one(means, [0.01, 0.01], [50.0, 40.0], [0.0, 0.0], [0.0, 0.0]))
    assert firsts.components.tolist() == [1]
    assert firsts.views[0, 0] == 0
    assert int(merge_one(one(means, [0.01, 0.01], [50.0, 40.0], [0.0, 0.2], [0.0, 1.0])).components) == 2
    assert int(merge_one(one(means, [0.01, 0.01], [40.0, 50.0], [0.0, 0.2], [0.0, 1.0])).components) == 1


def test_a_superseded_component_is_dissolved_and_a_lonely_one_is_not():
    """A thin fragment inside a wide component is dissolved when the wide one has been observed often. Away from other
    components it stays, at any weight."""
    for weight, distance, left in ((2e4, 0.0, 2), (1e9, 0.0, 1), (1e9, 9.0, 2)):
        two = one([[0.0, 0.0, 2.0], [distance, 0.0, 2.0]], [0.25, 0.001], [weight, 100.0], [0.1, 0.0], [8.0, 0.0])
        after = merge_one(two)
        assert int(after.components) == left, (weight, distance)
        if left == 1:
            assert torch.equal(after.mean[0, 0], two.mean[0, 0])
            assert after.weight[0, 0] == weight + 100.0
            assert after.views[0, 0] == 8


@given(st.integers(0, 10**6))
@settings(max_examples=8)
def test_the_map_stays_within_the_stated_bound_where_components_are_dissolved(seed):
    """At a dissolved component's points, a feature in [0, 1] changes by little more than the component's share. Joining
    is off."""
    before, _ = crowd(seed)
    config = UfMStarConfig(merge=merging(0.05, loss=1e-9))
    after, _ = merge(before, before.mean.new_zeros(*before.weight.shape, 0), ALL, config)
    for b in range(2):
        gone = [k for k in range(12) if not (after.mean[b] == before.mean[b, k]).all(1).any()]
        points = before.mean[:, gone]
        old, new = (regress(m, points, config).features[b] for m in (before, after))
        assert ((old - new).abs() <= 0.05 * (len(gone) + 1)).all()


def test_nothing_else_is_touched():
    """Streams that are not due, components without partners, and the caller's tensors are unchanged bit for bit."""
    before, sums = crowd(5)
    before = before.to(torch.float32)
    copy = {name: value.clone() for name, value in before.tensors().items()}
    lonely = before.replace(mean=before.mean + torch.tensor([1e3, 0, 0]) * (torch.arange(14) == 2)[:, None])
    after, merged_sums = merge(lonely, sums, torch.tensor([True, False]), CONFIG)
    assert int(after.components[0]) < 12
    for name, value in lonely.tensors().items():
        assert torch.equal(getattr(after, name)[1], value[1]), name
        assert torch.equal(getattr(before, name), copy[name]), name
    k = int((after.mean[0, :, 0] > 500).nonzero()[0, 0])
    assert torch.equal(after.covariance[0, k], lonely.covariance[0, 2])
    assert torch.equal(merged_sums[1], sums[1])
    occupied = after.weight > 0
    assert not (occupied[:, 1:] & ~occupied[:, :-1]).any()


def test_a_thin_plate_stays_positive_definite_in_float32():
    """Two tilted plates side by side, at float32's covariance floor: their joint covariance stays positive definite."""
    tilt = torch.linalg.matrix_exp(torch.tensor([[0.0, -0.5, 0.3], [0.5, 0.0, -0.8], [-0.3, 0.8, 0.0]]).double())
    plate = (tilt * torch.tensor([1.0, 1.0, 2e-6]).double()) @ tilt.T
    two = one([[0.0, 0.0, 2.0], [0.9, 0.9, 2.0]], [1.0, 1.0], [50.0, 50.0], [0.1, 0.1], [2, 2])
    two = two.replace(covariance=plate.expand(1, 2, 3, 3), mean=two.mean @ tilt.T).to(torch.float32)
    after = merge_one(two)
    assert int(after.components) == 1
    assert torch.linalg.eigvalsh(after.covariance.double())[0, 0, 0] > 0


def walk(config: UfMStarConfig, first: int = 0, last: int = 24, state: dict | None = None) -> UfMStar:
    """Frames ``first`` to ``last`` of one walk, from a saved state."""
    depths, poses, K = scenes.sequence(24, 48, 64)
    ufm = UfMStar(config)
    if state is not None:
        ufm.load_state_dict(state)
    for i in range(first, last):
        ufm(torch.tensor(depths[i])[None], torch.tensor(poses[i]), torch.tensor(K))
    return ufm


def test_a_walk_merges_when_due_and_goes_on_from_a_saved_state():
    config = UfMStarConfig(merge=MergeConfig(every=8))
    plain, merging = walk(UfMStarConfig()), walk(config)
    assert int(merging.mixture.components) < int(plain.mixture.components)
    again = walk(config, 12, 24, walk(config, 0, 12).state_dict())
    for name, value in merging.state_dict().items():
        assert torch.equal(again.state_dict()[name], value), name


def test_a_skipped_frame_merges_nothing():
    state = walk(UfMStarConfig(), 0, 4).state
    config = UfMStarConfig(merge=MergeConfig(every=4))
    assert merged(state, torch.tensor([1]), config) is state  # a fault
    assert merged(state, torch.tensor([0]), config) is not state


@pytest.mark.parametrize("capacity", [1, 14, 150])
@pytest.mark.parametrize("seed", range(3))
def test_the_compiled_parts_merge_as_the_reference(seed, capacity):
    m, sums = crowd(seed, capacity)
    expected = merge(m, sums, ALL, CONFIG)
    found = merge(m, sums, ALL, CONFIG, select_frame("numba", "cpu").merge)
    if capacity > 1:
        assert bool((expected[0].components < m.components).all()), "the test must merge something"
    assert torch.equal(found[0].components, expected[0].components)
    for name, value in (expected[0].tensors() | {"sums": expected[1]}).items():
        other = (found[0].tensors() | {"sums": found[1]})[name]
        torch.testing.assert_close(other, value, rtol=1e-10, atol=1e-12, msg=name)


def test_pairs_beyond_the_first_room_are_found():
    m, sums = crowd(0, 120)
    together = m.replace(mean=1e-3 * m.mean)
    expected, found = (
        merge(together, sums, ALL, CONFIG, kernels)[0] for kernels in (None, select_frame("numba", "cpu").merge)
    )
    assert torch.equal(found.components, expected.components)
    torch.testing.assert_close(found.mean, expected.mean, rtol=1e-10, atol=1e-12)


def test_components_far_from_the_camera_are_left_as_they_are():
    m, sums = crowd(3, 60)
    n = int(m.components.min())
    m, sums = GaussianMixture(**{name: v[:, :n] for name, v in m.tensors().items()}), sums[:, :n]
    both = GaussianMixture(**{name: torch.cat([v, v], 1) for name, v in m.tensors().items()})
    far, twice = both.mean.clone(), torch.cat([sums, sums], 1)
    far[:, :n, 0] += 1000.0  # another room, whose slots come first
    both, near = both.replace(mean=far), torch.arange(2 * n).expand(2, -1) >= n
    found, found_sums = merge(both, twice, ALL, CONFIG, near=near)
    expected, _ = merge(m, sums, ALL, CONFIG)
    for b in range(2):
        k = int(expected.components[b])
        assert int(found.components[b]) == n + k < 2 * n
        for name, value in found.tensors().items():
            assert torch.equal(value[b, :n], both.tensors()[name][b, :n]), name
            assert torch.equal(value[b, n : n + k], expected.tensors()[name][b, :k]), name
        torch.testing.assert_close(found_sums[b, : n + k].sum(0), twice[b].sum(0))


def test_a_module_leaves_another_room_as_it_is():
    config = UfMStarConfig(merge=MergeConfig(every=6, loss=10.0), view_baseline=None, eta=0.01)
    depth, K = torch.full((1, 48, 64), 2.0), torch.tensor([[40.0, 0, 31.5], [0, 40.0, 23.5], [0, 0, 1]])
    ufm, pose = UfMStar(config), torch.eye(4, dtype=torch.float64)
    rooms = []
    for i in range(6):
        pose[0, 3] = 0.5 * i + (100.0 if i > 2 else 0.0)
        ufm(depth, pose[None].clone(), K)
        rooms.append(ufm.mixture)
    before, after = (m.mean[0, : int(m.components[0])] for m in (rooms[2], rooms[5]))
    assert len(before) > 1, "the first room has something to merge"
    assert torch.equal(after[after[:, 0] < 50], before)
    assert int((after[:, 0] > 50).sum()) == 1, "the second room was merged"


def test_merging_is_on_by_default_on_the_cpu_alone():
    default, paper = UfMStarConfig(), UfMStarConfig.paper()
    assert [default.merges_on(kind) for kind in ("cpu", "cuda", "meta")] == [True, False, False]
    assert UfMStarConfig(merge=MergeConfig(accelerators=True)).merges_on("cuda")
    assert not paper.merges_on("cpu")
    assert paper.merge is None

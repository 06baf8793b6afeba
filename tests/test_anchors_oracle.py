"""Both tiers of the anchored variance against loops in NumPy."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from backends import seen as seen_of
from oracle_anchors import AnchoredOracle
from walks import HEIGHT, SPGF, WIDTH, oracle_settings

import scenes
from ufmstar_torch import AnchorConfig, UfMStar, UfMStarConfig
from ufmstar_torch.anchors.anchors import Anchors
from ufmstar_torch.anchors.check import check_anchors
from ufmstar_torch.anchors.evidence import Evidence, inliers
from ufmstar_torch.anchors.kernels import learn as anchors_cpu
from ufmstar_torch.anchors.learn import Learnt, learn
from ufmstar_torch.frames.frame import check_frame
from ufmstar_torch.kernels.cpu.regress import regression, views_of
from ufmstar_torch.steps.regress import distribute

pytestmark = pytest.mark.numerics

ANCHORED = UfMStarConfig(
    segment=SPGF, unmeasured="paper", regression="exact", anchors=AnchorConfig(shrinkage=3.0, half_life=4.0)
)


def draw_anchors(truth, rng, count):
    """(u, v, depth, variance) at subpixel positions near pixels with depth; a third are far off."""
    result = []
    while len(result) < count:
        v, u = int(rng.integers(0, HEIGHT)), int(rng.integers(0, WIDTH))
        g = truth[v, u] * (rng.uniform(0.3, 3) if rng.random() < 0.3 else rng.normal(1, 0.02))
        if np.isfinite(g) and g > 0:
            result.append(
                (u + rng.uniform(-0.4, 0.4), v + rng.uniform(-0.4, 0.4), g, (rng.uniform(0.01, 0.3) * g) ** 2)
            )
    return result


def as_anchors(rows):
    u, v, depth, variance = (torch.tensor(column, dtype=torch.float64)[None] for column in zip(*rows, strict=True))
    return Anchors(torch.stack([u, v], dim=-1), depth, variance)


@pytest.fixture(scope="module")
def expected():
    """Inputs and the oracle's results for five frames of a network that is 30 % too near. The third has no anchors."""
    depths, poses, K = scenes.sequence(5, HEIGHT, WIDTH, 0.04)
    rng = np.random.default_rng(5)
    judge = AnchoredOracle(oracle_settings(SPGF), kappa=3.0, half_life=4.0)
    frames = []
    for i, (truth, T) in enumerate(zip(depths, poses, strict=True)):
        # On the left the network's variance exceeds its error: B adds nothing there.
        variance = np.where(np.arange(WIDTH) < WIDTH / 3, 4.0, 0.01)
        depth, aleatoric = truth / 1.3, variance * (0.5 + rng.random(truth.shape))
        anchors = [] if i == 2 else draw_anchors(truth, rng, 3 if i == 0 else 40)
        frames.append((depth, T, aleatoric, anchors, judge.step_anchored(depth, T, K, anchors, aleatoric)))
    return K, frames, judge


@pytest.mark.parametrize("backend", ["torch", "numba"])
def test_a_sequence_agrees_with_the_oracle(expected, backend):
    K, frames, judge = expected
    ours = UfMStar(ANCHORED.replace(backend=backend), dtype=torch.float64)
    rejected = 0
    for depth, T, aleatoric, anchors, (V, B, bias) in frames:
        output = ours(
            torch.tensor(depth)[None],
            torch.tensor(T),
            torch.tensor(K),
            torch.tensor(aleatoric)[None],
            anchors=as_anchors(anchors) if anchors else None,
        )
        for name, value in (("variance", V), ("anchored", B), ("bias", bias)):
            mine = getattr(output, name)[0].numpy()
            np.testing.assert_allclose(mine, value, rtol=1e-7, atol=1e-10, err_msg=name)
        rejected += int(output.statistics.anchors[0] - output.statistics.anchors_used[0])
    assert rejected > 10, "outliers must be put to the test"
    np.testing.assert_allclose(ours.overall_evidence[0].numpy(), judge.total, rtol=1e-9)
    assert 0 < float((output.anchored[output.valid] > 0).double().mean()) < 1, "B is cut off at 0 in some places"


def drawn(seed: int, b: int, n: int) -> tuple[torch.Tensor, ...]:
    """Pixels, predicted and measured depths, variances [b, n]: clusters, equal positions, wrong tracks."""
    generator = torch.Generator().manual_seed(seed)

    def uniform(*shape: int) -> torch.Tensor:
        return torch.rand(b, *shape, generator=generator, dtype=torch.float64)

    pixel = (uniform(n, 2) * (200 if seed % 2 else 12)).round()
    predicted = 1 + 4 * uniform(n)
    depth = predicted * (1.1 + 0.02 * uniform(n)) * torch.where(uniform(n) < 0.3, 1 + uniform(n), 1.0)
    variance = 1e-4 * depth.square() * (uniform(n) < 0.5)
    return pixel, predicted, depth, variance, uniform(n)


@pytest.mark.parametrize("seed", range(12))
def test_the_compiled_support_is_the_references_own(seed):
    """From 0 to hundreds of anchors, some invalid."""
    n = (1, 2, 3, 4, 5, 9, 12, 40, 100, 300, 301, 1500)[seed]
    pixel, predicted, depth, variance, chance = drawn(seed, 2, n)
    valid = chance < (0.9 if seed % 3 else 0.5)
    anchors = Anchors(pixel, depth, variance, valid, index=pixel[..., 0].long(), predicted=predicted)
    expected = inliers(anchors)
    assert torch.equal(anchors_cpu.inliers(anchors), expected)
    if n >= 40:
        assert 0 < expected.sum() < valid.sum()


@pytest.mark.parametrize("where", ["line", "point", "two points"])
def test_neighbours_of_anchors_that_lie_together(where):
    """The grid's cells have no area, or all but two cells are empty."""
    pixel, predicted, depth, variance, _ = drawn(1, 1, 60)
    pixel[..., 1] = 7.0
    if where != "line":
        pixel[..., 0] = 3.0
    if where == "two points":
        pixel[:, ::3] = 190.0
    anchors = Anchors(pixel, depth, variance, depth > 0, index=pixel[..., 0].long(), predicted=predicted)
    assert torch.equal(anchors_cpu.inliers(anchors), inliers(anchors))


def test_what_is_checked_of_strange_anchors():
    """Extreme positions, depths and variances, on a map with a hole: against the rules written out, anchor by
    anchor."""
    size, n = (40, 60), 400
    pixel, _, depth, variance, chance = drawn(3, 2, n)
    generator = torch.Generator().manual_seed(0)
    pixel = pixel / 3 - 2 + torch.rand(pixel.shape, generator=generator).double()
    strange = torch.tensor([torch.nan, torch.inf, -torch.inf, 0.0, -1.0, 1e-300, 1e300, 1e30])
    for i, value in enumerate(strange):
        pixel[:, i, 0] = pixel[:, 10 + i, 1] = value
        depth[:, 20 + i] = variance[:, 30 + i] = value
    pixel[0, 50], pixel[0, 51] = torch.tensor([59.5, 0.0]), torch.tensor([-0.5, 39.5])
    maps = 1 + 4 * torch.rand(3, 2, *size, generator=generator)
    maps[0, 0, 10:20, 10:20] = 0
    cameras = torch.eye(4).expand(2, 4, 4), torch.tensor([[60.0, 0, 30], [0, 60, 20], [0, 0, 1]])
    frame = check_frame(maps[0], *cameras, None, None, None, rotation_tolerance=1e-3)
    for variance_maps, mask in (((), None), ((maps[1],), chance < 0.7), ((maps[1], maps[2]), None)):
        found, far = check_anchors(Anchors(pixel, depth, variance, mask), frame, variance_maps), [0, 0]
        for b, i in np.ndindex(2, n):
            (u, v), g, s2 = np.rint(pixel[b, i].numpy()), float(depth[b, i]), float(variance[b, i])
            fine = 0 <= u < size[1] and 0 <= v < size[0] and 0 < g < np.inf and 0 <= s2 < g * g
            d = float(frame.depth[b, int(v), int(u)]) if fine else 0.0
            fine = fine and d > 0 and (mask is None or bool(mask[b, i]))
            near = fine and 0.01 <= g / d <= 100
            far[b] += fine and not near
            assert bool(found.valid[b, i]) == near
            if near:
                claimed = sum(float(one[b, int(v), int(u)]) for one in variance_maps)
                mine = [float(x[b, i]) for x in (found.predicted, found.depth, found.variance, found.network_variance)]
                np.testing.assert_allclose(mine, [d, g, s2, claimed], rtol=5e-7)
                assert int(found.index[b, i]) == v * size[1] + u
        assert 100 < found.valid.sum() < 2 * n
        assert found.rejected.tolist() == far
        assert 0 <= int(found.index.min()) <= int(found.index.max()) < size[0] * size[1]


@pytest.mark.parametrize("sparse", [False, True])
def test_what_was_learnt_may_be_small_and_is_moved_by_the_streams(sparse):
    """Sums of tiny features stay tiny. The stream's means are added to the first two features only."""
    depths, poses, K = scenes.sequence(1, HEIGHT, WIDTH, 0.04)
    walked = UfMStar(ANCHORED.replace(backend="numba"))
    walked(torch.tensor(depths[0])[None], torch.tensor(poses[0]), torch.tensor(K))
    seen = seen_of(walked.mixture, features=3)
    seen[0].features[:] = 1e-32, 0.5, 1.0
    pixels = np.arange(0, HEIGHT * WIDTH, 7)[None] if sparse else None
    depth = torch.tensor(depths[0], dtype=torch.float32)[None].nan_to_num(0, posinf=0).clamp_min(0)
    arguments = seen, depth.numpy(), K[None], ANCHORED, pixels, None
    plain, moved = (
        torch.from_numpy(np.moveaxis(regression(*arguments, shift)[1], 1, -1))
        for shift in (None, np.array([[0.25, -0.125]]))
    )
    offset = torch.tensor([0.25, -0.125, 0.0])
    torch.testing.assert_close(moved, plain + offset, rtol=5e-7, atol=5e-8, equal_nan=True)
    fine = plain[~plain[..., 0].isnan()]
    assert len(fine) > 100
    assert 0 <= float(fine[:, 0].min()) <= float(fine[:, 0].max()) < 1e-30
    torch.testing.assert_close(fine[:, 1], 0.5 * fine[:, 2], rtol=1e-6, atol=1e-30)


@pytest.mark.parametrize(("dtype", "tolerance"), [(torch.float64, 1e-11), (torch.float32, 2e-6)])
@pytest.mark.parametrize("n", [0, 1, 40, 1200])
def test_the_compiled_lesson_is_the_references_own(n, dtype, tolerance):
    """Many anchors of two streams, on surfaces with and without a component, over three frames."""
    depths, poses, K = scenes.sequence(3, HEIGHT, WIDTH, 0.04)
    config = ANCHORED.replace(backend="numba")
    walked, generator = UfMStar(config, dtype=dtype), torch.Generator().manual_seed(n)
    for depth, T in zip(depths, poses, strict=True):
        walked(torch.tensor(depth).expand(2, -1, -1), torch.tensor(T), torch.tensor(K))
    mixture = walked.mixture.to(torch.float64)
    seen = torch.tensor(depth, dtype=dtype).expand(2, -1, -1)
    frame = check_frame(seen, torch.eye(4), torch.tensor(K), None, None, None, rotation_tolerance=1e-3)
    start = Evidence(torch.zeros(2, mixture.capacity, 3, dtype=dtype), torch.zeros(2, 3, dtype=dtype))
    a = b = Learnt(start, *[torch.empty(0)] * 3)
    for _ in range(3):
        pixel = torch.rand(2, n, 2, generator=generator) * torch.tensor([WIDTH, HEIGHT]) - 0.5
        relative = 1.2 + 0.1 * torch.randn(2, n, generator=generator)
        u, v = pixel.round().long().clamp_min(0).unbind(-1)
        g = seen[0, v.clamp_max(HEIGHT - 1), u.clamp_max(WIDTH - 1)] * relative
        anchors = check_anchors(Anchors(pixel, g, (0.02 * g).square()), frame, (0.01 * seen,))
        anchored = replace(frame, anchors=anchors)
        a = learn(a.tensors(), mixture, anchored, config, distribute)
        components = seen_of(mixture, features=3)
        views = views_of(components, frame.depth.numpy(), frame.intrinsics.numpy(), config, dtype)
        b = anchors_cpu.learn_in_view(b.tensors(), mixture.capacity, components, views, anchored, config)
        slow, fast = a.evidence, b.evidence
        assert torch.equal(a.used, b.used)
        for name in ("beyond", "stream"):
            torch.testing.assert_close(getattr(b, name), getattr(a, name), rtol=tolerance, atol=tolerance)
        for name in ("component", "overall"):
            torch.testing.assert_close(getattr(fast, name), getattr(slow, name), rtol=tolerance, atol=10 * tolerance)
    assert n == 0 or slow.component.abs().max() > 0

"""SPGF: the oracle against the authors' partitions, every backend against both, properties, and input."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from backends import make_backend
from hypothesis import given
from hypothesis import strategies as st
from segment_scenes import REFERENCES, camera, clutter, reference, run_oracle

from ufmstar_torch.config import SPGFConfig
from ufmstar_torch.gaussians.mixture import GaussianMixture
from ufmstar_torch.steps import segment, segment_fusion

pytestmark = pytest.mark.numerics

# Where Cholesky failed, upstream added 1e-5 (a float32) to the diagonal.
JITTER = float(np.float32(1e-5)) * np.eye(3)
# The number of these Gaussians in each file: Gaussians without thickness (see below).
JITTERED = {"spgf_224_tum": 45, "spgf_224_tartanair_indoor": 64, "spgf_vga_tum": 49}
SMALL = SPGFConfig(sparse=2, min_pixels=10, min_rows=3, scale_with_image=False)

configs = st.builds(
    SPGFConfig,
    adaptive_thresh_scale=st.floats(0.3, 4.0),
    noise_floor=st.floats(0.01, 0.1),
    noise_thresh=st.floats(0.11, 0.5),
    line_thresh=st.floats(0.11, 0.5),
    occlusion_gap=st.integers(1, 12),
    n_check=st.integers(1, 20),
    max_open=st.integers(1, 4),
    angle_cosine=st.floats(0.0, 0.99),
    sparse=st.integers(0, 5),
    min_gaussian_length=st.floats(0.1, 2.0),
    frame_max_scale=st.floats(1.0, 6.0),
    max_depth=st.floats(3.0, 20.0),
    min_pixels=st.integers(1, 60),
    min_rows=st.integers(1, 10),
    prune=st.sampled_from(["both", "either", "none"]),
    scale_with_image=st.booleans(),
)


def unpruned(config: SPGFConfig) -> SPGFConfig:
    """The same thresholds, with every Gaussian kept."""
    return replace(config, prune="none")


def moments(pieces):
    """Means, covariances and pixel counts of the oracle's Gaussians."""
    return (
        np.array([p.mu for p in pieces]).reshape(-1, 3),
        np.array([p.covariance for p in pieces]).reshape(-1, 3, 3),
        np.array([p.N for p in pieces], dtype=float),
    )


def occupied(mixture: GaussianMixture, stream: int = 0):
    n = int(mixture.components[stream])
    assert not mixture.weight[stream, n:].any(), "occupied slots come first"
    return tuple(value[stream, :n].numpy() for value in (mixture.mean, mixture.covariance, mixture.weight))


def assert_moments(actual, expected, tolerance=1e-9):
    for a, e in zip(actual, expected, strict=True):
        np.testing.assert_allclose(a, e, rtol=tolerance, atol=tolerance)


@pytest.mark.parametrize("name", REFERENCES[:2])
def test_oracle_is_what_the_authors_program_computed(name):
    r = reference(name)
    expected = r.frames[0]
    pieces, labels = run_oracle(r.depth[0], r.intrinsics[0], r.config)
    assert np.array_equal(labels, expected["labels"])
    assert [p.n for p in pieces] == expected["n_segments"].tolist()
    np.testing.assert_allclose([p.W for p in pieces], expected["ray_weight"], rtol=1e-6)  # a float32 upstream
    mean, covariance, count = moments(pieces)
    np.testing.assert_allclose(mean, expected["mean"], rtol=1e-14, atol=1e-15)
    assert np.array_equal(count, expected["n_pixels"])
    off = np.abs(covariance - expected["cov"]).max((1, 2)) > 1e-15
    np.testing.assert_allclose((covariance + JITTER)[off], expected["cov"][off], atol=1e-12)


@pytest.mark.parametrize("name", REFERENCES)
def test_reference_partitions(name, backend):
    """All 17 frames: identical labels and order, moments to 1e-9, also with upstream's 1e-5 I. Backends that are slow
    run crops of three frames, compared with the compiled kernel."""
    r = reference(name)
    if backend.slow or backend.name == "torch":
        depth = r.depth[:3, 100:120, 80:144].contiguous()
        K = r.intrinsics[:3] - torch.tensor([[0.0, 0, 80], [0, 0, 100], [0, 0, 0]])
        labels, expected = (b.spgf(depth, K, unpruned(r.config))[1] for b in (backend, make_backend("numba")))
        assert torch.equal(labels, expected)
        assert labels.max() > 1
        return
    mixture, labels = backend.spgf(r.depth, r.intrinsics, unpruned(r.config))
    jittered = 0
    for b, expected in enumerate(r.frames):
        assert np.array_equal(labels[b].numpy(), expected["labels"])
        mean, covariance, weight = occupied(mixture, b)
        assert np.array_equal(weight, expected["n_pixels"])
        np.testing.assert_allclose(mean, expected["mean"], atol=1e-9)
        added = np.abs(covariance + JITTER - expected["cov"]).max((1, 2)) < 1e-9
        jittered += added.sum()
        np.testing.assert_allclose(covariance[~added], expected["cov"][~added], atol=1e-9)
        # The cause: covariances that are singular up to rounding, so Cholesky's last pivot may vanish.
        eigenvalues = np.linalg.eigvalsh(covariance[added])
        assert (eigenvalues[:, 0] < 1e-12 * eigenvalues[:, 2]).all()
    assert jittered == JITTERED[name]


@given(st.integers(0, 10**6), configs, st.integers(1, 24), st.integers(1, 30))
def test_agrees_with_the_oracle(backend, seed, config, height, width):
    depth, K = clutter(seed, height, width)
    pieces, expected = run_oracle(depth[0], K[0], config)
    scaled = config.scaled_to(height, width)
    large = np.array([scaled.min_pixels <= p.N for p in pieces], dtype=bool)
    tall = np.array([p.n >= scaled.min_rows for p in pieces], dtype=bool)
    keep = {"both": large | tall, "either": large & tall, "none": large | True}[config.prune]
    slot = np.append(np.where(keep, keep.cumsum() - 1, -1), -1)
    mixture, labels = backend.spgf(depth, K, unpruned(config))
    assert np.array_equal(labels[0].numpy(), expected)
    assert_moments(occupied(mixture), moments(pieces))
    pruned, labels = backend.spgf(depth, K, config)
    assert np.array_equal(labels[0].numpy(), slot[expected])
    assert_moments(occupied(pruned), tuple(value[keep] for value in moments(pieces)))


def test_rows_of_few_and_of_many_segments_in_one_batch(backend):
    """A GPU joins rows of few segments with one warp, and others with more."""
    height, width, config = 4, 80, SPGFConfig(sparse=1, min_pixels=1, min_rows=1, scale_with_image=False)
    stairs = (1 + 0.4 * (torch.arange(width) // 2)).to(torch.float64).expand(height, width)
    depth = torch.stack([stairs, torch.full_like(stairs, 2.0)])
    K = camera(60.0, 60.0, 40.0, 2.0).expand(2, 3, 3)
    mixture, labels = backend.spgf(depth, K, config)
    for b, count in ((0, 40), (1, 5)):
        pieces, expected = run_oracle(depth[b], K[b], config)
        assert len(pieces) == count
        assert np.array_equal(labels[b].numpy(), expected)
        assert_moments(occupied(mixture, b), moments(pieces))


def test_streams_are_independent(backend):
    """Several scenes with different cameras at once equal single runs: depth bins and thresholds are per stream."""
    seeds, size = ((3, 5), (10, 14)) if backend.slow else ((3, 4, 5), (20, 26))
    scenes = [clutter(seed, *size) for seed in seeds]
    depth, K = (torch.cat(parts) for parts in zip(*scenes, strict=True))
    config = SPGFConfig(sparse=2, min_pixels=20, min_rows=4)
    features = torch.rand(len(seeds), 2, *size, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    together, labels = backend.spgf(depth, K, config, features=features)
    assert (labels.amax((1, 2)) >= 0).all()
    for b in range(len(seeds)):
        stream = slice(b, b + 1)
        single, single_labels = backend.spgf(depth[stream], K[stream], config, features=features[stream])
        assert torch.equal(labels[stream], single_labels)
        for name, value in single.tensors().items():
            torch.testing.assert_close(
                together.tensors()[name][stream, : single.capacity], value, rtol=1e-13, atol=1e-14
            )


def test_pruning_at_the_boundary(backend):
    """A plate of 4 rows x 15 px: exactly min_pixels and min_rows are enough, one more is not."""
    depth, K = torch.zeros(1, 6, 20, dtype=torch.float64), camera(40.0, 40.0, 10.0, 3.0)
    depth[:, 1:5, 3:18] = 1.0

    def segments(pixels, rows, prune):
        config = SPGFConfig(min_pixels=pixels, min_rows=rows, prune=prune, scale_with_image=False)
        mixture, labels = backend.spgf(depth, K, config)
        assert bool((labels >= 0).any()) == bool(mixture.components[0])
        return int(mixture.components[0])

    for prune, expected in (("either", [1, 0, 0, 0]), ("both", [1, 1, 1, 0]), ("none", [1, 1, 1, 1])):
        actual = [segments(*limits, prune) for limits in ((60, 4), (61, 4), (60, 5), (61, 5))]
        assert actual == expected, prune


def test_features_are_means(backend):
    depth, K = clutter(11, 24, 30)
    config = SPGFConfig(sparse=2, min_pixels=10, min_rows=3, scale_with_image=False)
    generator = torch.Generator().manual_seed(1)
    features = torch.randn(1, 3, 24, 30, dtype=torch.float64, generator=generator)
    _, labels = backend.spgf(depth, K, config)
    spoiled = torch.where(labels[:, None] < 0, torch.nan, features)
    mixture, same = backend.spgf(depth, K, config, features=spoiled)
    assert torch.equal(labels, same)
    assert mixture.components[0] > 3
    for k in range(int(mixture.components[0])):
        mask = labels[0] == k
        torch.testing.assert_close(mixture.features[0, k], features[0][:, mask].mean(1), rtol=1e-12, atol=1e-12)


@pytest.mark.parametrize(
    ("slope_focal", "scale_with_image", "size", "focal", "expected"),
    [
        ("reference", True, (480, 640), 100.0, 2.4 / 525),
        ("reference", False, (480, 640), 100.0, 2.4 / 100),
        # With the camera's focal length: an image of half the size has half of it, and the same threshold in metres.
        ("camera", True, (480, 640), 320.0, 2.4 / 320),
        ("camera", True, (240, 320), 160.0, 2.4 / 320),
        # A crop of a 640 x 480 image's centre, enlarged to the image's width: f and the resolution are larger.
        ("camera", True, (240, 640), 320.0, 2.4 / 320),
        ("camera", False, (240, 320), 160.0, 2.4 / 160),
    ],
)
def test_slope_keeps_metric_thresholds(slope_focal, scale_with_image, size, focal, expected):
    config = replace(SPGFConfig.preset("tum"), slope_focal=slope_focal, scale_with_image=scale_with_image)
    assert config.scaled_to(*size).slope(focal) == pytest.approx(expected)


def test_static_bounds_change_nothing(monkeypatch):
    """The loops and tables of an accelerator, run on the CPU."""
    depth, K = (torch.cat(parts) for parts in zip(clutter(8, 14, 22), clutter(9, 14, 22), strict=True))
    config = SPGFConfig(sparse=2, min_pixels=12, min_rows=3, scale_with_image=False)
    limits = config, unpruned(config)
    expected = [segment.segment(depth, K, one) for one in limits]
    monkeypatch.setattr(segment_fusion, "reads_are_free", lambda device: False)
    monkeypatch.setattr(segment, "reads_are_free", lambda device: False)
    for one, (mixture, labels) in zip(limits, expected, strict=True):
        static, static_labels = segment.segment(depth, K, one)
        assert torch.equal(labels, static_labels)
        for name, value in mixture.padded(static.capacity).tensors().items():
            torch.testing.assert_close(static.tensors()[name], value, rtol=1e-13, atol=1e-15, msg=name)
        assert static.capacity == (14 * 7 if one.prune == "none" else 14 * 22 // 9)


@pytest.mark.parametrize("prune", ["both", "either", "none"])
def test_no_value_is_read_on_other_devices(prune):
    """On the meta device tensors have no values, and reading one raises."""
    b, height, width = 2, 6, 9
    depth = torch.empty(b, height, width, device="meta")
    config = SPGFConfig(sparse=2, min_pixels=7, min_rows=2, prune=prune, scale_with_image=False)
    features = torch.empty(b, 4, height, width, device="meta")
    mixture, labels = segment.segment(depth, torch.empty(b, 3, 3, device="meta"), config, features)
    assert labels.shape == depth.shape
    assert mixture.capacity == {"both": 54 // 6, "either": 54 // 7, "none": 18}[prune]
    assert mixture.features.shape == (b, mixture.capacity, 4)


def test_presets_are_upstreams():
    """../shared/spec's table, column by column."""
    tum, inside, outside = (SPGFConfig.preset(n) for n in ("tum", "tartanair_indoor", "tartanair_outdoor"))
    columns = {
        "adaptive_thresh_scale": (2.4, 0.70, 0.70),
        "noise_floor": (0.08, 0.05, 0.25),
        "noise_thresh": (0.2, 0.2, 0.5),
        "line_thresh": (0.3, 0.3, 0.3),
        "occlusion_gap": (10, 10, 10),
        "n_check": (16, 16, 16),
        "max_open": (2, 2, 2),
        "angle_cosine": (0.5, 0.5, 0.5),
        "sparse": (5, 2, 5),
        "min_rows": (16, 8, 8),
        "min_pixels": (200, 200, 200),
        "min_gaussian_length": (0.5, 0.5, 0.6),
        "frame_max_scale": (4.0, 4.0, 4.0),
        "max_depth": (20.0, 20.0, 20.0),
        "prune": ("both", "both", "both"),
        "reference_focal": (525.0, 320.0, 320.0),
        "reference_height": (480, 480, 480),
        "reference_width": (640, 640, 640),
    }
    for name, values in columns.items():
        assert tuple(getattr(c, name) for c in (tum, inside, outside)) == values, name


def test_nothing_to_segment(backend):
    for depth in (torch.zeros(1, 1, 1), torch.full((2, 7, 9), torch.nan), torch.full((1, 8, 3), 1e6)):
        K = camera(5.0, 5.0, 3.0, 2.0).expand(len(depth), 3, 3)
        mixture, labels = backend.spgf(depth, K, SPGFConfig(), features=torch.ones(len(depth), 2, *depth.shape[1:]))
        assert bool((labels == -1).all())
        assert not any(value.any() for value in mixture.tensors().values())
        assert mixture.features.shape[::2] == (len(depth), 2)


def test_single_pixels_have_no_covariance(backend):
    config = replace(SMALL, sparse=0, prune="none")
    depth, K = torch.full((1, 1, 1), 2.0), camera(5.0, 5.0, 3.0, 2.0)
    mixture, labels = backend.spgf(depth, K, config)
    assert labels.tolist() == [[[0]]]
    assert mixture.weight.tolist() == [[1.0]]
    torch.testing.assert_close(mixture.mean[0, 0], torch.tensor([-1.2, -0.8, 2.0]))
    assert not mixture.covariance.any()


def test_dtypes(backend):
    depth, K = clutter(21, *((10, 14) if backend.slow else (20, 24)))
    for dtype in (torch.float64, torch.float32):
        converted = depth.to(dtype)
        mixture, labels = backend.spgf(converted, K, SMALL, features=converted[:, None].nan_to_num(0, 0, 0))
        assert labels.max() >= 0
        assert {value.dtype for value in mixture.tensors().values()} == {dtype}
        assert labels.dtype == torch.int64
        exact, same = backend.spgf(converted.double(), K, SMALL)
        assert torch.equal(labels, same)
        torch.testing.assert_close(mixture.covariance, exact.covariance.to(dtype))
        assert torch.equal(mixture.weight, exact.weight.to(dtype))
        for value in (mixture.disagreement, mixture.compared, mixture.views, mixture.reference):
            assert not value.any()


def test_arguments_are_left_alone_and_may_be_views(backend):
    depth, K = clutter(22, *((10, 14) if backend.slow else (20, 24)))
    wide = torch.stack([depth, depth + 1], -1)
    view, features = wide[..., 0], depth[:, None].clone()
    mixture, labels = backend.spgf(view, K.expand(1, 3, 3), SMALL, features=features)
    expected, same = backend.spgf(depth, K, SMALL, features=features)
    assert torch.equal(labels, same)
    torch.testing.assert_close(mixture.mean, expected.mean, rtol=1e-14, atol=1e-15)  # the strides may select the loops
    for value in (view, features[:, 0]):
        assert torch.equal(value.nan_to_num(), depth.nan_to_num())
    with torch.inference_mode():
        assert torch.equal(backend.spgf(depth, K, SMALL)[1], labels)

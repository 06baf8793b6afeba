"""SPGF's interface: what it refuses, what it tolerates, and what it leaves alone."""

from __future__ import annotations

import re
import threading
from dataclasses import replace

import pytest
import torch
from segment_scenes import TIERS, camera, clutter

from ufmstar_torch.config import SPGFConfig, UfMStarConfig

SMALL = SPGFConfig(sparse=2, min_pixels=10, min_rows=3, scale_with_image=False)


@pytest.fixture(params=TIERS)
def spgf(request):
    return TIERS[request.param]


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
    with pytest.raises(ValueError, match=r"tum, tartanair_indoor, tartanair_outdoor, got 'kitti'"):
        SPGFConfig.preset("kitti")


D, K1 = torch.ones(2, 5, 6), camera(5.0, 5.0, 3.0, 2.0).expand(2, 3, 3)
BAD = {
    "depth is no tensor": ((D.numpy(), K1), {}, TypeError, "depth must be a torch.Tensor"),
    "integer depth": ((D.long(), K1), {}, TypeError, "depth must have a floating-point dtype"),
    "depth of two dimensions": ((D[0], K1), {}, ValueError, "depth must be [B, H, W]"),
    "no stream": ((D[:0], K1[:0]), {}, ValueError, "depth must be [B, H, W] with no empty dimension"),
    "one camera for two streams": ((D, K1[:1]), {}, ValueError, "intrinsics must have shape (2, 3, 3)"),
    "a 4x4 camera": ((D, torch.ones(2, 4, 4)), {}, ValueError, "intrinsics must have shape (2, 3, 3)"),
    "an integer camera": ((D, K1.int()), {}, TypeError, "intrinsics must have a floating-point dtype"),
    "NaN in the camera": ((D, K1 * torch.nan), {}, ValueError, "intrinsics must be finite with fx, fy > 0"),
    "negative focal length": ((D, -K1), {}, ValueError, "intrinsics must be finite with fx, fy > 0"),
    "camera elsewhere": ((D, K1.to("meta")), {}, ValueError, "intrinsics must lie on the depth's device cpu"),
    "variance of another size": ((D, K1), {"variance": D[:, :4]}, ValueError, "variance must have shape (2, 5, 6)"),
    "integer variance": ((D, K1), {"variance": D.int()}, TypeError, "variance must have a floating-point"),
    "float mask": ((D, K1), {"valid": D}, TypeError, "valid must be a torch.bool tensor"),
    "mask of another size": ((D, K1), {"valid": D[:1] > 0}, ValueError, "valid must have shape (2, 5, 6)"),
    "mask elsewhere": ((D, K1), {"valid": (D > 0).to("meta")}, ValueError, "valid must lie on the depth's device"),
    "features without channels": ((D, K1), {"features": D}, ValueError, "features must have shape (2, -1, 5, 6)"),
    "a dict for a config": ((D, K1, {}), {}, TypeError, "config must be an SPGFConfig"),
    "bins of a micrometre": (
        (D, K1, SPGFConfig(min_gaussian_length=1e-6)), {}, ValueError, "config.min_gaussian_length = 1e-06 m"
    ),
}  # fmt: skip


@pytest.mark.parametrize("case", BAD)
def test_bad_input(spgf, case):
    arguments, options, error, message = BAD[case]
    with pytest.raises(error, match=re.escape(message)):
        spgf(*arguments, **options)


def test_torch_needs_a_float_to_compute_in():
    with pytest.raises(ValueError, match=r"compute_dtype must be torch.float32 or torch.float64, got torch.float16"):
        TIERS["torch"](D, K1, compute_dtype=torch.float16)


def test_nothing_to_segment(spgf):
    for depth in (torch.zeros(1, 1, 1), torch.full((2, 7, 9), torch.nan), torch.full((1, 8, 3), 1e6)):
        K = camera(5.0, 5.0, 3.0, 2.0).expand(len(depth), 3, 3)
        mixture, labels = spgf(depth, K, features=torch.ones(len(depth), 2, *depth.shape[1:]))
        assert bool((labels == -1).all())
        assert mixture.capacity == 1
        assert not any(value.any() for value in mixture.tensors().values())
        assert mixture.features.shape == (len(depth), 1, 2)


def test_single_pixels_have_no_covariance(spgf):
    config = replace(SMALL, sparse=0, prune="none")
    for depth, K in ((torch.full((1, 1, 1), 2.0), camera(5.0, 5.0, 3.0, 2.0)),):
        mixture, labels = spgf(depth, K, config, variance=torch.ones_like(depth))
        assert labels.tolist() == [[[0]]]
        assert mixture.weight.tolist() == [[1.0]]
        assert mixture.count.tolist() == [[1]]
        torch.testing.assert_close(mixture.mean[0, 0], torch.tensor([-1.2, -0.8, 2.0]))
        assert not mixture.covariance.any()


def test_dtypes(spgf):
    depth, K = clutter(21, 20, 24)
    for dtype, expected in (
        (torch.float64, torch.float64),
        (torch.float32, torch.float32),
        (torch.float16, torch.float32),
        (torch.bfloat16, torch.float32),
    ):
        given = depth.to(dtype)
        mixture, labels = spgf(given, K.float(), SMALL, features=given[:, None].nan_to_num(0, 0, 0))
        assert {v.dtype for n, v in mixture.tensors().items() if n != "count"} == {expected}
        assert (labels.dtype, mixture.count.dtype) == (torch.int64, torch.int64)
        exact, same = spgf(given.double(), K.float(), SMALL)
        assert torch.equal(labels, same)
        torch.testing.assert_close(mixture.covariance, exact.covariance.to(expected))
        assert torch.equal(mixture.weight, exact.weight.to(expected))
        assert torch.equal(mixture.count, (mixture.weight > 0).long())
        assert not mixture.disagreement.any()


def test_arguments_are_left_alone_and_may_be_views(spgf):
    depth, K = clutter(22, 20, 24)
    wide = torch.stack([depth, depth + 1], -1).requires_grad_()
    view = wide[..., 0]
    options = {"valid": (depth > 0.5), "variance": torch.full_like(depth, 0.01), "features": depth[:, None].clone()}
    before = {name: value.clone() for name, value in options.items()}
    mixture, labels = spgf(view, K.expand(1, 3, 3), UfMStarConfig(segment=SMALL), **options)
    expected, same = spgf(depth, K, SMALL, **options)
    assert torch.equal(labels, same)
    torch.testing.assert_close(mixture.mean, expected.mean, rtol=1e-14, atol=1e-15)  # strides may choose the loops
    assert not mixture.mean.requires_grad
    assert torch.equal(view.detach().nan_to_num(), depth.nan_to_num())
    for name, value in options.items():
        assert torch.equal(value.nan_to_num(), before[name].nan_to_num()), name
    with torch.inference_mode():
        assert torch.equal(spgf(depth, K, SMALL, **options)[1], labels)


def test_a_masked_pixel_is_as_good_as_none(spgf):
    depth, K = clutter(23, 20, 24)
    mask = torch.rand(depth.shape, generator=torch.Generator().manual_seed(3)) < 0.8
    masked, labels = spgf(depth, K, SMALL, valid=mask)
    absent, same = spgf(torch.where(mask, depth, torch.nan), K, SMALL)
    assert torch.equal(labels, same)
    assert torch.equal(masked.covariance, absent.covariance)


def test_numba_from_many_threads():
    scenes = [clutter(seed, 60, 80) for seed in range(4)]
    expected = [TIERS["numba"](*scene, SMALL)[1] for scene in scenes]
    wrong = []

    def work(i):
        for _ in range(20):
            if not torch.equal(TIERS["numba"](*scenes[i], SMALL)[1], expected[i]):
                wrong.append(i)

    threads = [threading.Thread(target=work, args=(i,)) for i in range(4)]
    for t in threads:
        t.start()
    for t in threads:
        t.join()
    assert not wrong

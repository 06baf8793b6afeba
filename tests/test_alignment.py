"""Alignment of relative depth: recovered scale and shift, robustness to outliers, refusal of undetermined fits."""

from __future__ import annotations

import json
import math

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from torch import nn

from ufmstar_torch import UfMStar, UncertainDepth
from ufmstar_torch.models import AlignedNetwork, Alignment, fit_affine_depth, fit_inverse_depth, wrap_network

SIZE = (24, 32)
FITS = {"inverse": fit_inverse_depth, "affine": fit_affine_depth}


def random_depth(batch=2, size=SIZE, seed=0, low=0.5, high=8.0):
    generator = torch.Generator().manual_seed(seed)
    return low + (high - low) * torch.rand(batch, *size, generator=generator, dtype=torch.float64)


def relative(depth, kind, scale, shift):
    """Relative depth whose alignment is (scale, shift)."""
    value = depth if kind == "affine" else 1 / depth
    scale, shift = (torch.as_tensor(v, dtype=torch.float64).reshape(-1, 1, 1) for v in (scale, shift))
    return (value - shift) / scale


def sparse(size, share, seed=1):
    return torch.rand(*size, generator=torch.Generator().manual_seed(seed)) < share


@pytest.mark.parametrize("robust", [True, False])
@pytest.mark.parametrize("kind", ["inverse", "affine"])
def test_exact_measurements_give_back_each_image_s_scale_and_shift(kind, robust):
    depth = random_depth(3)
    scale, shift = [0.02, 0.5, 3.0], [-0.3, 0.0, 0.4]
    prediction = relative(depth, kind, scale, shift)
    fit = FITS[kind](prediction, depth, sparse(depth.shape, 0.05), shift=None, robust=robust)
    assert fit.alignment.scale.tolist() == pytest.approx(scale, rel=1e-10)
    assert fit.alignment.shift.tolist() == pytest.approx(shift, abs=1e-10)
    torch.testing.assert_close(fit.alignment.depth(prediction), depth, rtol=1e-9, atol=0)
    assert (fit.inliers == fit.points).all()
    assert (fit.points == sparse(depth.shape, 0.05).sum((1, 2))).all()
    assert (fit.residual < 1e-10).all()


@given(
    kind=st.sampled_from(["inverse", "affine"]),
    scale=st.floats(1e-3, 1e3),
    shift=st.floats(-1, 1),
    share=st.floats(0, 0.3),
    seed=st.integers(0, 10_000),
)
def test_up_to_thirty_percent_of_outliers_change_nothing(kind, scale, shift, share, seed):
    depth = random_depth(1, seed=seed)
    prediction = relative(depth, kind, scale, shift)
    wrong = sparse(depth.shape, share, seed + 1)
    measured = torch.where(wrong, random_depth(1, seed=seed + 2, low=0.1, high=30.0), depth)
    fit = FITS[kind](prediction, measured, shift=None)
    assert float(fit.alignment.scale) == pytest.approx(scale, rel=1e-6)
    assert float(fit.alignment.shift) == pytest.approx(shift, abs=1e-6)
    assert int(fit.inliers) >= int((~wrong).sum())


@pytest.mark.parametrize("kind", ["inverse", "affine"])
def test_plain_least_squares_is_numpy_s_weighted(kind):
    depth, prediction = random_depth(2), random_depth(2, seed=5)
    prediction = prediction + depth if kind == "affine" else prediction + 5 / depth
    weights = random_depth(2, seed=7)
    fit = FITS[kind](prediction, depth, weights=weights, shift=None, robust=False)
    for image in range(2):
        x, y = prediction[image].flatten().numpy(), depth[image].flatten().numpy()
        y = y if kind == "affine" else 1 / y
        root = np.sqrt(weights[image].flatten().numpy())
        design = np.stack([x, np.ones_like(x)], 1) * root[:, None]
        a, b = np.linalg.lstsq(design, y * root, rcond=None)[0]
        assert float(fit.alignment.scale[image]) == pytest.approx(a, rel=1e-10)
        assert float(fit.alignment.shift[image]) == pytest.approx(b, rel=1e-10)
        assert float(fit.residual[image]) == pytest.approx(np.sqrt(np.mean((y - a * x - b) ** 2)), rel=1e-10)


def test_noise_averages_out_nearly_as_well_as_in_least_squares():
    """Over 200 fits, the robust slope's spread is within 15 % of the optimum's."""
    generator = torch.Generator().manual_seed(2)
    inverse = 0.1 + torch.rand(200, 10, 30, generator=generator, dtype=torch.float64)
    noise = 0.01 * torch.randn(200, 10, 30, generator=generator, dtype=torch.float64)
    depth = 1 / (0.2 * inverse + 0.3 + noise)
    robust = fit_inverse_depth(inverse, depth).alignment.scale
    plain = fit_inverse_depth(inverse, depth, robust=False).alignment.scale
    assert abs(float(robust.mean()) - 0.2) < 5 * float(robust.std()) / math.sqrt(200)
    assert float(robust.std()) < 1.15 * float(plain.std())


def test_a_batch_gives_what_each_image_gives():
    depth = random_depth(3)
    prediction = relative(depth, "inverse", [0.1, 0.2, 0.3], [0.1, 0.0, -0.02])
    noisy = depth * (1 + 0.05 * (random_depth(3, seed=9) - 4))
    valid = torch.stack([sparse(SIZE, share) for share in (0.05, 0.3, 1.0)])
    together = fit_inverse_depth(prediction, noisy, valid)
    for image in range(3):
        one = fit_inverse_depth(*(value[image : image + 1] for value in (prediction, noisy, valid)))
        torch.testing.assert_close(together.alignment.scale[image : image + 1], one.alignment.scale, rtol=1e-12, atol=0)
        assert together.inliers[image] == one.inliers[0]


def test_pooled_images_get_one_alignment():
    depth = random_depth(3)
    prediction = relative(depth, "inverse", 0.1, 0.05) + 0.01 * random_depth(3, seed=8)
    pooled = fit_inverse_depth(prediction, depth, pooled=True, robust=False, max_depth=9.0)
    assert pooled.alignment.scale.shape == pooled.points.shape == ()
    assert pooled.alignment.max_depth == 9.0
    joined = fit_inverse_depth(prediction.flatten(0, 1)[None], depth.flatten(0, 1)[None], robust=False)
    torch.testing.assert_close(pooled.alignment.scale, joined.alignment.scale[0], rtol=1e-12, atol=0)
    torch.testing.assert_close(pooled.alignment.shift, joined.alignment.shift[0], rtol=1e-12, atol=0)


def test_unusable_measurements_are_left_out():
    depth = random_depth(1)
    prediction = relative(depth, "inverse", 0.1, 0.05)
    for column, value in enumerate((0.0, -1.0, math.nan, math.inf)):
        depth[0, 0, column] = value
    prediction[0, 1, :2] = torch.tensor([math.nan, math.inf], dtype=torch.float64)
    before = depth.clone(), prediction.clone()
    fit = fit_inverse_depth(prediction, depth)
    assert int(fit.points) == depth.numel() - 6
    assert float(fit.alignment.scale) == pytest.approx(0.1, rel=1e-10)
    assert torch.allclose(depth, before[0], equal_nan=True)
    assert torch.allclose(prediction, before[1], equal_nan=True)


def test_what_is_undetermined_is_refused_and_the_image_named():
    depth = random_depth(2)
    prediction = relative(depth, "inverse", 0.1, 0.05)
    few = torch.ones(2, *SIZE, dtype=torch.bool)
    few[1] = sparse(SIZE, 1.0) & (torch.arange(SIZE[0] * SIZE[1]).view(SIZE) < 9)
    with pytest.raises(ValueError, match="image 1 needs at least 10 measurements with a prediction, has 9"):
        fit_inverse_depth(prediction, depth, few)
    assert int(fit_inverse_depth(prediction, depth, few, min_points=9).points[1]) == 9
    flat = prediction.clone()
    flat[1] = 3.0
    for robust in (True, False):
        with pytest.raises(ValueError, match="image 1 has predictions that hardly differ"):
            fit_inverse_depth(flat, depth, robust=robust)
    assert fit_inverse_depth(flat, torch.full_like(depth, 2.0), shift=0.0).alignment.scale[1] == pytest.approx(1 / 6)
    with pytest.raises(ValueError, match="image 0 does not grow with nearness, as kind 'inverse'"):
        fit_inverse_depth(depth, depth)
    with pytest.raises(ValueError, match="image 0 does not grow with distance, as kind 'affine'"):
        fit_affine_depth(1 / depth, depth, shift=None)


def test_pixels_without_positive_depth_are_invalid_and_can_be_counted():
    alignment = Alignment("inverse", 0.5, -0.5, max_depth=10.0)
    prediction = torch.tensor([[[0.0, 1.0, 1.1, 1.4, 3.0, math.nan, math.inf]]])
    torch.testing.assert_close(alignment.depth(prediction), torch.tensor([[[0, 0, 0, 5.0, 1.0, 0, 0]]]))
    assert (~alignment.valid(prediction)).sum((1, 2)).tolist() == [5]
    unlimited = Alignment("inverse", 0.5, -0.5).depth(prediction)
    assert float(unlimited[0, 0, 2]) == pytest.approx(20.0, rel=1e-5)
    affine = Alignment("affine", 2.0, -1.0).depth(torch.tensor([[[0.2, 0.5, 1.0, math.inf]]]))
    assert affine.tolist() == [[[0, 0, 1.0, 0]]]


def test_invalid_pixels_are_no_prediction_for_ufm_and_give_finite_gradients():
    prediction = random_depth(1).float()
    prediction[0, :5] = 0.0
    alignment = Alignment("inverse", 0.3, -0.1)
    leaf = prediction.clone().requires_grad_()
    depth = alignment.depth(leaf)
    depth.sum().backward()
    assert leaf.grad.isfinite().all()
    pose, K = torch.eye(4, dtype=torch.float64), torch.tensor([[30.0, 0, 16], [0, 30, 12], [0, 0, 1]]).double()
    out = UfMStar()(depth.detach(), pose[None], K[None])
    assert out.variance[0, :5].isnan().all()
    assert out.variance[0, 5:].isfinite().all()


def test_alignments_go_through_json_exactly_and_check_their_values():
    for alignment in (
        Alignment("inverse", 0.1, 1 / 3, max_depth=20.0),
        Alignment("affine", torch.tensor([0.1, 1 / 7]), torch.tensor([0.0, 0.0])),
    ):
        again = Alignment.from_dict(json.loads(json.dumps(alignment.to_dict())))
        assert torch.equal(again.scale, alignment.scale)
        assert torch.equal(again.shift, alignment.shift)
        assert (again.kind, again.max_depth) == (alignment.kind, alignment.max_depth)
    with pytest.raises(ValueError, match="has no \\['offset'\\]"):
        Alignment.from_dict({"kind": "inverse", "scale": 1, "shift": 0, "offset": 1})
    with pytest.raises(ValueError, match="needs \\['shift'\\]"):
        Alignment.from_dict({"kind": "inverse", "scale": 1})


class Nearness(torch.nn.Module):
    """A relative "network" in half precision: inverse depth from brightness (depth / 10 m)."""

    def forward(self, image):
        return (0.4 / (10 * image.mean(1, keepdim=True))).half() - 0.1


def test_half_precision_outputs_are_aligned_in_single():
    image = random_depth().float()[:, None].expand(-1, 3, -1, -1) / 10
    depth = AlignedNetwork(Nearness(), Alignment("inverse", 2.5, 0.25))(image).depth
    assert depth.dtype == torch.float32
    torch.testing.assert_close(depth.double(), random_depth(), rtol=0.02, atol=0)


def test_a_disparity_between_a_least_and_a_largest_depth_is_one_line():
    """Monodepth's sigmoid s in (0, 1) is 1/d = 1/max + (1/min - 1/max) s. The refusal's message states this
    equation."""
    disparity = nn.Sequential(nn.Conv2d(3, 1, 1), nn.Sigmoid())
    image = torch.rand(2, 3, 4, 6, generator=torch.Generator().manual_seed(0))
    model = AlignedNetwork(disparity, Alignment("inverse", 1 / 0.1 - 1 / 100, 1 / 100))
    with torch.no_grad():
        expected = 1 / (1 / 100 + (1 / 0.1 - 1 / 100) * disparity(image)[:, 0])
        torch.testing.assert_close(model(image).depth, expected)
    K = torch.tensor([[5.0, 0, 2.5], [0, 5.0, 1.5], [0, 0, 1]])
    assert bool((UncertainDepth(model)(image[:1], torch.eye(4), K).depth > 0).all())
    with pytest.raises(ValueError, match=r"AlignedNetwork\(network, Alignment\('inverse', scale, shift\)\)"):
        wrap_network(disparity, inverse=True)

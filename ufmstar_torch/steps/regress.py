"""Step 5, uncertainty regression: Gaussian mixture regression of the disagreement at any 3D point.

Section "Uncertainty Regression". H is constant within a component, so the conditional mean is the average of m_k with
weights w_k(x). A weak prior (pi_0, mu_0) dominates where all components have a low density.

Not in the paper: pixels where M was not measured (``config.unmeasured``). A surface seen from one view has m = 0
because nothing was compared. Far from all components, M is the prior's mean. In the paper both count as certain. The
share of a pixel's M that rests on surfaces seen from different places,

    s(x) = sum of w_k(x) (1 - exp(-n_k))  with the number of views n_k (``fuse``),

is regressed as an additional feature. It is 0 for an image that shows nothing (``FrameInput.informative``). A pixel
counts as measured where s is at least one half.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from ufmstar_torch.config import UfMStarConfig
from ufmstar_torch.gaussians.camera import invert_rigid, unproject, unproject_at
from ufmstar_torch.gaussians.fixed_order import apply, total
from ufmstar_torch.gaussians.gaussian import cholesky3, inverse_lower3
from ufmstar_torch.gaussians.mixture import GaussianMixture
from ufmstar_torch.gaussians.state import UfMStarState
from ufmstar_torch.runtime.stateful import undisturbed
from ufmstar_torch.steps.fuse import measured_share

# Most points x components evaluated at a time: bounds the temporary memory to some 100 MB in float32. On CUDA it may
# be a quarter of the free memory, if that is more. A pair takes _NUMBERS numbers: offset, distance, density,
# temporaries.
_CHUNK = 2**22
_NUMBERS = 16
HALF = 0.5  # the least share s of a measured pixel


@dataclass(frozen=True)
class Regression:
    """E[H | X = x] at P points.

    Attributes:
        disagreement: [B, P] m_hat(x) [m^2].
        features: [B, P, F] the further entries of H; the prior's are 0.
    """

    disagreement: Tensor
    features: Tensor


def regress(mixture: GaussianMixture, points: Tensor, config: UfMStarConfig) -> Regression:
    """Gaussian mixture regression, the exact sum over all components or the paper's neighbourhood.

    m_hat(x) = (sum_k pi_k N(x; mu_k, Sigma_k) m_k + pi_0 mu_0) / (sum_k pi_k N(x; mu_k, Sigma_k) + pi_0).
    With ``config.regression == "neighbourhood"`` the sum is over the components near x: those whose axis-aligned box of
    ``neighbourhood_sigmas`` standard deviations comes within ``near_radius`` of x on every axis, or, if there are none,
    within ``far_radius``. Without any, the result is the prior.

    Args:
        mixture: [B, K], covariances positive definite.
        points: [B, P, 3] [m], in the mixture's frame; points that are not finite give NaN.
        config: prior_weight, prior_mean, regression and its radii.

    Returns:
        The conditional mean at every point, in the dtype of ``points``; exactly the prior far from
        every component.
    """
    dtype = points.dtype
    whitening, log_peak = _densities(mixture, dtype)
    pairs = _pairs_at_a_time(points.device, points.element_size())
    per_chunk = max(1, pairs // max(1, mixture.streams * mixture.capacity))
    parts = [_chunk(mixture, whitening, log_peak, x, config) for x in points.split(per_chunk, dim=1)]
    if not parts:
        parts = [_chunk(mixture, whitening, log_peak, points, config)]
    return Regression(torch.cat([p.disagreement for p in parts], 1), torch.cat([p.features for p in parts], 1))


def _pairs_at_a_time(device: torch.device, size: int) -> int:
    """Most pairs of a point and a component in memory at a time, for numbers of ``size`` bytes."""
    if device.type != "cuda" or not torch.cuda.is_initialized():  # fake tensors need no device
        return _CHUNK
    free = torch.cuda.mem_get_info(device)[0]
    free += torch.cuda.memory_reserved(device) - torch.cuda.memory_allocated(device)  # torch's cache
    return max(_CHUNK, free // (4 * _NUMBERS * size))


def regress_image(
    mixture_cam: GaussianMixture, depth: Tensor, intrinsics: Tensor, valid: Tensor, config: UfMStarConfig,
    pixels: Tensor | None = None,
) -> Regression:  # fmt: skip
    """:func:`regress` at every pixel of a depth map, [B, H, W] and [B, H, W, F], or at some, [B, n] and [B, n, F].

    Args:
        mixture_cam: [B, K] in the camera frame.
        depth: [B, H, W] [m].
        intrinsics: [B, 3, 3] [px].
        valid: [B, H, W] bool; NaN elsewhere.
        config: as :func:`regress`.
        pixels: [B, n] indices into the flattened image; None = every pixel.
    """
    if pixels is not None:
        points = unproject_at(at_pixels(depth, pixels), pixels, depth.shape[2], intrinsics)
        result = regress(mixture_cam, points, config)
        return _where(at_pixels(valid, pixels), result.disagreement, result.features)
    result = regress(mixture_cam, unproject(depth, intrinsics).flatten(1, 2), config)
    return _where(valid, result.disagreement.view(valid.shape), result.features.view(*valid.shape, -1))


def _where(valid: Tensor, disagreement: Tensor, features: Tensor) -> Regression:
    """The regression with NaN where not valid."""
    return Regression(torch.where(valid, disagreement, torch.nan), torch.where(valid[..., None], features, torch.nan))


def shares(mixture: GaussianMixture, points: Tensor, config: UfMStarConfig) -> Tensor:
    """Share of each component in the density at a point, w_k(x) = pi_k N_k(x) / (sum_k pi_k N_k(x) + pi_0).

    Args:
        mixture, points, config: as :func:`regress`; few points, because all pairs are in memory at once.

    Returns:
        [B, P, K] in [0, 1]; the prior's share is 1 minus their sum.
    """
    density = _density(mixture, *_densities(mixture, torch.float64), points.double(), config)
    evidence = total(density, -1)[..., None] + config.prior_weight
    return (density / evidence).to(points.dtype)


def distribute(mixture: GaussianMixture, points: Tensor, values: Tensor, config: UfMStarConfig) -> Tensor:
    """Sums of values at points by component, sum_n w_k(x_n) y_n, with the :func:`shares` w_k.

    Args:
        mixture, points, config: as :func:`shares`.
        values: [B, P, C], float64.

    Returns:
        [B, K, C] float64; 0 for empty slots.
    """
    share = shares(mixture, points.double(), config)
    return torch.stack([total(share * y[..., None], 1) for y in values.unbind(-1)], -1)


def _densities(mixture: GaussianMixture, dtype: torch.dtype) -> tuple[Tensor, Tensor]:
    """Inverse Cholesky factors [B, K, 3, 3] and log(pi_k N(mu_k; mu_k, Sigma_k)) [B, K], -inf for empty slots."""
    valid = mixture.valid
    eye = torch.eye(3, dtype=torch.float64, device=valid.device)
    L_inv = inverse_lower3(cholesky3(torch.where(valid[..., None, None], mixture.covariance.double(), eye)))
    log_det = torch.diagonal(L_inv, dim1=-2, dim2=-1).log().sum(-1)
    weight = torch.where(valid, mixture.weight.double(), torch.ones_like(log_det))
    log_peak = weight.log() - 1.5 * math.log(2 * math.pi) + log_det
    return L_inv.to(dtype), torch.where(valid, log_peak, torch.full_like(log_peak, -math.inf)).to(dtype)


def _density(
    mixture: GaussianMixture, whitening: Tensor, log_peak: Tensor, points: Tensor, config: UfMStarConfig
) -> Tensor:
    """[B, P, K] pi_k N(x; mu_k, Sigma_k), 0 outside the neighbourhood."""
    dtype = points.dtype
    offset = points[:, :, None] - mixture.mean.to(dtype)[:, None]  # [B, P, K, 3]
    dx, dy, dz = offset.unbind(-1)
    squared = torch.zeros_like(dx)
    for row in range(3):
        L = whitening[:, None, :, row]
        squared = squared + (L[..., 0] * dx + L[..., 1] * dy + L[..., 2] * dz) ** 2
    density = torch.exp(log_peak[:, None] - 0.5 * squared)
    if config.regression == "neighbourhood":
        density = density * _near(mixture, offset, config)
    return density


def _chunk(
    mixture: GaussianMixture, whitening: Tensor, log_peak: Tensor, points: Tensor, config: UfMStarConfig
) -> Regression:
    dtype = points.dtype
    density = _density(mixture, whitening, log_peak, points, config)
    evidence = total(density, -1) + config.prior_weight
    weighted = total(density * mixture.disagreement.to(dtype)[:, None], -1)
    disagreement = (weighted + config.prior_weight * config.prior_mean) / evidence
    each = [total(density * feature[:, None], -1) / evidence for feature in mixture.features.to(dtype).unbind(-1)]
    features = torch.stack(each, dim=-1) if each else density.new_zeros(*evidence.shape, 0)
    return Regression(disagreement, features)


def _near(mixture: GaussianMixture, offset: Tensor, config: UfMStarConfig) -> Tensor:
    """[B, P, K] True where component k is in the neighbourhood of the point."""
    sigma = torch.diagonal(mixture.covariance, dim1=-2, dim2=-1).sqrt().to(offset.dtype)
    gap = (offset.abs() - config.neighbourhood_sigmas * sigma[:, None]).amax(-1)
    gap = torch.where(mixture.valid[:, None], gap, torch.full_like(gap, math.inf))
    near = gap <= config.near_radius
    return torch.where(near.any(-1, keepdim=True), near, gap <= config.far_radius)


def smooth(previous: Tensor, current: Tensor, alpha: float) -> tuple[Tensor, Tensor]:
    """Exponential moving average of the dense map, M_i <- (1-alpha) M_(i-1) + alpha M_i.

    NaN marks a pixel without a value. If only one of the two maps has a value, the memory stores that value.

    Args:
        previous: [B, H, W] or [B, n] [m^2], the memory; all NaN at the first frame.
        current: like ``previous``, in any dtype.
        alpha: in (0, 1].

    Returns:
        The new memory in the dtype of ``previous``, and the map to output: NaN where ``current`` is NaN, in its dtype.
    """
    new = current.to(previous.dtype)
    mixed = (1 - alpha) * previous + alpha * new
    memory = torch.where(new.isnan(), previous, torch.where(previous.isnan(), new, mixed))
    return memory, torch.where(new.isnan(), torch.nan, memory).to(current.dtype)


def memory_for(memory: Tensor, size: tuple[int, int]) -> Tensor:
    """The memory of a moving average [B, h, w] for a frame of ``size``; all NaN after a change of the size."""
    return memory if memory.shape[1:] == size else memory.new_full((memory.shape[0], *size), torch.nan)


def at_pixels(values: Tensor, pixels: Tensor | None) -> Tensor:
    """The values of a map [B, H, W] at pixels [B, n], indices into the flattened image; None = all pixels."""
    return values if pixels is None else torch.gather(values.flatten(1), 1, pixels)


def with_measured_share(mixture: GaussianMixture) -> GaussianMixture:
    """The mixture [B, K] with an additional feature, the share 1 - exp(-n) to which a component is measured."""
    share = measured_share(mixture.views).to(mixture.features.dtype)
    return mixture.replace(features=torch.cat([mixture.features, share[..., None]], dim=-1))


def set_unmeasured(
    result: Regression, depth: Tensor | None, config: UfMStarConfig, informative: Tensor | None = None
) -> tuple[Regression, Tensor]:
    """Separate the share s from the regressed features, and set M where it was not measured.

    Args:
        result: of the mixture of :func:`with_measured_share`.
        depth: of the same pixels [m]; None = points without a depth, for which "relative" acts as "nan".
        config: of UfM*.
        informative: [B] False for the streams whose image shows nothing; None = all True.

    Returns:
        The regression without the share, and s, NaN where not valid.
    """
    measured = result.features[..., -1]
    if informative is not None:
        measured = measured * informative.view(-1, *[1] * (measured.dim() - 1)).to(measured.dtype)
    disagreement = result.disagreement
    if config.unmeasured == "nan" or (config.unmeasured == "relative" and depth is None):
        disagreement = torch.where(measured < HALF, torch.nan, disagreement)
    elif config.unmeasured == "relative" and depth is not None:
        share = (1 - measured).clamp_min(0)
        disagreement = disagreement.add(share * depth * depth, alpha=config.unmeasured_relative**2)
    return replace(result, disagreement=disagreement, features=result.features[..., :-1]), measured


def query(state: UfMStarState, points: Tensor, config: UfMStarConfig) -> Regression:
    """See :meth:`ufmstar_torch.UfMStar.query`, of a state of B streams."""
    streams = len(state.weight)
    if streams == 0:
        raise ValueError("query needs a mixture: call the module on a frame first")
    if points.dim() != 3 or points.shape[0] != streams or points.shape[2] != 3:
        raise ValueError(f"points must be [{streams}, N, 3], got {tuple(points.shape)}")
    with undisturbed(points):
        T = invert_rigid(state.T_world_first)
        local = apply(T[:, None, :3, :3], points.detach().double()) + T[:, None, :3, 3]
        dtype = torch.float64 if points.dtype == torch.float64 else torch.float32
        result = regress(with_measured_share(state.mixture), local.to(dtype), config)
        return set_unmeasured(result, None, config)[0]

"""The posterior's memory of a stream: sums with a half-life, the mean slopes, and the last frame's coefficients.

Frames with anchors update these ratios:

- amplitude: scale of the variance of the network's error
- roughness: variance of y between neighbouring pixels
- noise: factor by which the anchors' stated variances are too small
- unseen: increase of the error's variance with the distance from evidence
- wrong: probability that the local correction does not hold
- inlier: factor by which the variance is too small where the correction holds
- between: squared scale of e, by which surfaces differ (``motion``)
- centre: c, the constant about which most surfaces lie (``motion``); the only ratio that may be negative
- calibration: mean z^2 of held-out anchors

Each ratio is the quotient of two sums that fade towards a prior, so that few anchors change it little.
"""

from __future__ import annotations

import functools
import math
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from ufmstar_torch.posterior.config import PosteriorConfig

Floats = NDArray[np.float64]
FEATURES = 4  # 1, log d - m_0, u and v from -1 to 1
SLOPES = FEATURES - 1
_MATRIX = FEATURES * FEATURES
# Limits of stored values, beyond what any run reaches: of m_0, the log of the largest accepted depth
# (``frame.DEPTH_RANGE``); of all values, which count anchors and frames or are squares of logs.
LARGEST_LOG, LARGEST = 14.0, 1e9


class Ratios(NamedTuple):
    """The ratios by name; for each, a number or what belongs to it."""

    amplitude: Any
    roughness: Any
    noise: Any
    unseen: Any
    wrong: Any
    inlier: Any
    between: Any
    centre: Any
    calibration: Any


RATIOS = len(Ratios._fields)
AMPLITUDE, ROUGHNESS, NOISE, UNSEEN, WRONG, INLIER, BETWEEN, CENTRE, CALIBRATION = range(RATIOS)


@functools.lru_cache(maxsize=4)  # a posterior has the same config in every frame
def priors(config: PosteriorConfig) -> Floats:
    """[4, R] value and weight [anchors] of each ratio's prior, and the limits of the ratio. The calibration has no
    prior."""
    weight = config.prior_weight
    columns = Ratios(
        amplitude=(1.0, weight, 0.1, 100.0),
        roughness=(config.roughness**2, weight, 0.01**2, 0.2**2),
        noise=(1.0, weight, 0.25, 16.0),
        unseen=(config.unseen, weight, 0.0, 16.0),
        wrong=(config.wrong, weight, config.wrong / 10, 10 * config.wrong),
        inlier=(1.0, weight, 0.05, 4.0),
        between=(config.between**2, weight, 0.03**2, 1.0),
        centre=(0.0, 0.0, -LARGEST_LOG, LARGEST_LOG),
        calibration=(0.0, 0.0, 0.0, 1e6),
    )
    return np.ascontiguousarray(np.array(columns).T)


SIZE = 2 + 2 * RATIOS + SLOPES + FEATURES + _MATRIX


def restarted(packed: Tensor, config: PosteriorConfig) -> Tensor:
    """Memory [B, SIZE] with the initial coefficients and slopes: wrong poses can have corrupted them. The ratios depend
    on network and scene and remain. Zeros before the first anchor."""
    P = torch.diag(packed.new_tensor(config.prior_variance)).flatten()
    start = torch.cat([packed.new_zeros(SLOPES + FEATURES), P]) * (packed[:, :1] > 0)
    return torch.cat([packed[:, : -start.shape[1]], start], 1)


def require(packed: Tensor) -> None:
    """Raise a ValueError if no anchors can have led to the memory [B, SIZE]."""
    frames, mean, _, _, covariance = packed.split([1, 1, 2 * RATIOS, SLOPES + FEATURES, _MATRIX], 1)
    matrix = covariance.reshape(-1, FEATURES, FEATURES)
    signed = 2 + CENTRE
    sums = torch.cat([packed[:, 2:signed], packed[:, signed + 1 : 2 + 2 * RATIOS]], 1)
    scale = matrix.abs().amax((1, 2)).clamp(1e-300, 1e300)
    low = torch.linalg.eigvalsh(matrix / scale[:, None, None])[:, 0]
    faults = {
        f"values beyond {LARGEST:g}": packed.abs() > LARGEST,
        "negative sums": torch.cat([frames, sums], 1) < 0,
        "a mean log depth out of range": mean.abs() > LARGEST_LOG,
        "a covariance with negative eigenvalues": low < -1e-6,
    }
    if names := [name for name, bad in faults.items() if bool(bad.any())]:
        raise ValueError(f"posterior holds impossible values: {', '.join(names)}")


class Running(NamedTuple):
    """The posterior's memory of one stream.

    Attributes:
        frames: number of frames with anchors.
        mean: m_0 of the last frame.
        above, below: [R] numerators and denominators of the ratios.
        slopes: [3] mean of the slopes in the coefficients over the frames with anchors, with the half-life and with
            ``slope_weight`` frames of 0.
        coefficients: [4] of the features in the last frame.
        covariance: [4, 4] of the coefficients.
        ratios: within their limits; the prior's value where the denominator is 0.
    """

    frames: float
    mean: float
    above: Floats
    below: Floats
    slopes: Floats
    coefficients: Floats
    covariance: Floats
    ratios: Ratios

    @classmethod
    def of(cls, packed: Floats, config: PosteriorConfig) -> Running:
        """Unpack [SIZE]; zeros are the start."""
        value, weight, least, largest = priors(config)
        (above, below), rest = packed[2 : 2 + 2 * RATIOS].reshape(2, RATIOS), packed[2 + 2 * RATIOS :]
        slopes, b = rest[:SLOPES], rest[SLOPES : SLOPES + FEATURES]
        covariance = rest[SLOPES + FEATURES :].reshape(FEATURES, FEATURES)
        if packed[0] == 0:
            above, below, covariance = value * weight, weight, np.diag(config.prior_variance)
        values = np.where(below > 0, above / np.maximum(below, 1e-12), value).clip(least, largest)
        frames, mean = packed[:2].tolist()
        return cls(frames, mean, above, below, slopes, b, covariance, Ratios(*values.tolist()))

    def after(self, name: str, above: float, below: float, config: PosteriorConfig) -> float:
        """A ratio after a frame with its numerator and denominator."""
        k = Ratios._fields.index(name)
        value, weight, least, largest = priors(config)[:, k].tolist()
        fade = 0.5 ** (1 / config.half_life)
        n = fade * float(self.below[k]) + (1 - fade) * weight + below
        total = fade * float(self.above[k]) + (1 - fade) * weight * value + above
        return min(max(total / n, least), largest)

    def added(self, sums: Floats, config: PosteriorConfig) -> tuple[Floats, Floats]:
        """Numerators and denominators [R] after a frame with the ``sums`` [2, R]."""
        value, weight, least, largest = priors(config)
        fade, (above, below) = 0.5 ** (1 / config.half_life), sums
        n = fade * self.below + (1 - fade) * weight + below
        total = fade * self.above + (1 - fade) * weight * value + above
        return np.minimum(np.maximum(total, least * n), largest * n), n

    def learnt(
        self, sums: Floats, mean: float, coefficients: Floats, covariance: Floats, config: PosteriorConfig
    ) -> Floats:
        """Pack into [SIZE] after a frame with anchors: with the ``sums`` [2, R] for the ratios, m_0 = ``mean``, and the
        coefficients and their covariance."""
        rate = math.log(2) / config.half_life
        weight = math.expm1(-rate * (self.frames + 1)) / math.expm1(-rate)  # of the frames with anchors, 1 of the last
        slopes = self.slopes + (coefficients[1:] - self.slopes) / (weight + config.slope_weight)
        first = [self.frames + 1, mean]
        return np.concatenate([first, *self.added(sums, config), slopes, coefficients, covariance.ravel()])

    def drifted(self, mean: float, config: PosteriorConfig) -> Floats:
        """Pack into [SIZE] after a frame without anchors whose m_0 is ``mean``. The mean slopes revert, too."""
        b, covariance = self.expected(mean, config)
        slopes = (1 - config.reversion) * self.slopes
        return np.concatenate([[self.frames, mean], self.above, self.below, slopes, b, covariance.ravel()])

    def expected(self, mean: float, config: PosteriorConfig) -> tuple[Floats, Floats]:
        """Predict coefficients [4] and covariance [4, 4] for a frame whose m_0 is ``mean``.

        The constant follows a random walk from the last frame, which stops adding variance at the prior's. The slopes
        revert to the variance before the first anchor, that in log d to 0: what anchors showed of one surface is no
        evidence of the network's shape on another. Those in u and v revert to their mean over the stream.
        """
        if not self.frames:
            return self.coefficients, self.covariance
        T, (constant, *slopes) = np.eye(FEATURES), config.prior_variance
        T[0, 1] = mean - self.mean
        T[1:] *= 1 - config.reversion
        transformed = T @ self.covariance @ T.T
        grown = config.drift**2 * min(max(1 - transformed[0, 0] / constant, 0), 1)
        added = (1 - (1 - config.reversion) ** 2) * np.array(slopes)
        mean_slopes = config.reversion * self.slopes * [0, 1, 1]
        return T @ self.coefficients + [0, *mean_slopes], transformed + np.diag([grown, *added])

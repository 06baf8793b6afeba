"""Fits of a :class:`Recalibration` to the joint counts of variance and squared error, and their figures.

``SpearmanCorrelation`` counts the pixels of a sequence by variance and squared error, 512 bins each; a map of the
variance is fitted to these counts. Every sequence has the same weight, whatever its number of pixels.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from itertools import pairwise

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.special import ndtri

from ufmstar_torch.eval.metrics.base import HIGH, LOW
from ufmstar_torch.posterior.recalibrate import CONFIDENCE, Recalibration

Array = NDArray[np.float64]
# Levels at which the quantiles of |z| are compared with a standard normal variable's. The outer tenth is excluded:
# gross errors of the depth would dominate the variance of all other pixels.
LEVELS = np.arange(0.1, 0.91, 0.1)
NORMAL = ndtri(0.5 + LEVELS / 2)  # quantiles of |z| at these levels
GROUPS, CONFIDENCE_GROUPS = 32, 16
LARGEST = 25.0  # limit of squared error over variance, as for anchors (``anchors.confidence.MOST``)


def centres(bins: int) -> Array:
    """[bins + 2] values of the bins [m^2]: their geometric centres; 0 below the range, ``HIGH`` above it."""
    inner = LOW * (HIGH / LOW) ** ((np.arange(bins) + 0.5) / bins)
    return np.concatenate([[0.0], inner, [HIGH]])


def fit(joints: Sequence[Array], groups: int = GROUPS) -> Recalibration:
    """Fit a map of the variance to sequences.

    The pixels are divided by V into ``groups`` groups of equal size. Each group's V' is the scale at which its errors'
    quantiles at ``LEVELS`` agree best, in the logarithm, with those of a normal distribution. An isotonic regression of
    log V' (Barlow and Brunk 1972) over the groups makes the map monotone.

    Args:
        joints: of each sequence, [V, e] pixels by variance and squared error (``SpearmanCorrelation.joint``).
        groups: largest number of groups; there are fewer if many pixels have the same variance.

    Raises:
        ValueError: a sequence without pixels.
    """
    joint = _weighted(joints)
    value = centres(joint.shape[0] - 2)
    from scipy.optimize import isotonic_regression

    mass, knots, scales = [], [], []
    for weight in _groups(joint.sum(1), groups):
        errors = weight @ joint
        share = weight * joint.sum(1)
        mass.append(share.sum())
        knots.append(float(np.exp((share @ np.log(np.maximum(value, LOW))) / share.sum())))
        scales.append(_scale(errors, value))
    fitted = isotonic_regression(np.log(scales), weights=np.array(mass)).x
    rising = [0, *(i for i in range(1, len(knots)) if knots[i] > knots[i - 1] * 1.0001)]
    return Recalibration(tuple(knots[i] for i in rising), tuple(float(np.exp(fitted[i])) for i in rising))


def fit_confidence(samples: Sequence[Array], groups: int = CONFIDENCE_GROUPS) -> Recalibration:
    """Fit the factor of the variance to sequences, as a monotone function of the confidence.

    Every sequence has the same weight. The pixels are divided by confidence into groups of equal size. Each group's
    factor is the mean of the squared error over the variance, clipped to ``LARGEST``. An isotonic regression of its
    logarithm, rising or falling, whichever fits better, makes the function monotone.

    Args:
        samples: of each sequence, [n, 3] confidence, variance [m^2] and squared error [m^2].
        groups: largest number of groups; there are fewer if many pixels have the same confidence.

    Raises:
        ValueError: a sequence without pixels.
    """
    from scipy.optimize import isotonic_regression

    if not samples or any(not len(sample) for sample in samples):
        raise ValueError("a recalibration needs pixels with ground truth of every sequence")
    weight = np.concatenate([np.full(len(sample), 1 / len(sample)) for sample in samples])
    c, variance, error = np.concatenate(samples).T
    ratio = np.minimum(error / variance, LARGEST)
    _, level = np.unique(c, return_inverse=True)  # pixels of one confidence stay together
    cumulative = np.cumsum(np.bincount(level, weight)) / weight.sum()
    group = np.minimum((cumulative * groups - 1e-9).astype(int), groups - 1)[level]
    mass = np.bincount(group, weight, minlength=groups)
    full = np.flatnonzero(mass)
    knots = [float(np.median(c[group == k])) for k in full]
    scales = np.log(np.maximum(np.bincount(group, weight * ratio, minlength=groups)[full] / mass[full], 1 / LARGEST))
    fits = [isotonic_regression(scales, weights=mass[full], increasing=rising).x for rising in (True, False)]
    best = min(fits, key=lambda fitted: float((mass[full] * (scales - fitted) ** 2).sum()))
    return Recalibration(tuple(knots), tuple(float(x) for x in np.exp(best)), CONFIDENCE)


def figures_of_samples(samples: Array, recalibration: Recalibration | None) -> dict[str, float]:
    """As :func:`figures`, from samples as for :func:`fit_confidence`."""
    c, variance, error = samples.T
    if recalibration is not None:
        variance = variance * recalibration.factor(torch.from_numpy(np.ascontiguousarray(c))).numpy()
    return _figures(variance, error, np.full(len(c), 1 / len(c)))


def figures(joint: Array, recalibration: Recalibration | None) -> dict[str, float]:
    """The figures of N(d, V) on a sequence from its counts, with a recalibration or without one (None).

    Returns:
        "coverage_error": mean over nine central intervals of |share of errors inside - the interval's level|;
        "nll" [nats], the mean over the pixels with V > 0 (within .03 nats of the exact one, because of the bins);
        "zero_share": the share of pixels with V = 0.

    Raises:
        ValueError: the sequence has no pixels.
    """
    joint = _weighted([joint])
    value = centres(joint.shape[0] - 2)
    variance = value if recalibration is None else recalibration(torch.from_numpy(value)).numpy()
    return _figures(variance[:, None], value[None], joint)


def _figures(variance: Array, error: Array, weight: Array) -> dict[str, float]:
    """The figures of squared errors [m^2] with variances [m^2]; ``weight`` is the share of the pixels with both."""
    with np.errstate(divide="ignore", invalid="ignore"):
        ratio = np.where(error == 0, 0.0, error / variance)
        nll = 0.5 * (ratio + np.log(2 * math.pi * variance))
    inside = [weight[ratio <= z**2].sum() for z in NORMAL]
    positive = np.broadcast_to(variance > 0, weight.shape)
    share = weight[positive].sum()
    return {
        "coverage_error": float(np.abs(np.array(inside) - LEVELS).mean()),
        "nll": float((weight[positive] * nll[positive]).sum() / share) if share else math.nan,
        "zero_share": float(1 - share),
    }


def _weighted(joints: Sequence[Array]) -> Array:
    """Mean of the sequences' normalised counts; its sum is 1."""
    if not joints or any(joint.sum() == 0 for joint in joints):
        raise ValueError("a recalibration needs pixels with ground truth of every sequence")
    total: Array = np.sum([joint / joint.sum() for joint in joints], axis=0) / len(joints)
    return total


def _groups(mass: Array, count: int) -> list[Array]:
    """Weights [V] in [0, 1] of the bins in each of ``count`` groups of equal mass, in order; a bin may be divided."""
    cumulative = np.concatenate([[0.0], np.cumsum(mass)])
    edges = np.linspace(0, cumulative[-1], count + 1)
    weights = []
    for low, high in pairwise(edges):
        part = np.clip(np.minimum(cumulative[1:], high) - np.maximum(cumulative[:-1], low), 0, None)
        weights.append(np.divide(part, mass, out=np.zeros_like(mass), where=mass > 0))
    return weights


def _scale(mass: Array, value: Array) -> float:
    """The variance of the normal distribution whose |z| quantiles agree best with those of squared errors.

    Args:
        mass: [N] of the bins of the squared error.
        value: [N] of the bins, ascending; 0 counts as the smallest positive one.
    """
    index = np.searchsorted(np.cumsum(mass), LEVELS * mass.sum())
    quantiles = np.maximum(value[np.minimum(index, len(value) - 1)], value[value > 0].min())
    return float(np.exp(np.mean(np.log(quantiles) - 2 * np.log(NORMAL))))

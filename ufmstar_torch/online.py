"""Online training: whether to train on an image, from what is known of it before it has a label.

The paper's application (section "Introduction"; DecTrain, Fu et al.): a robot labels and trains where that pays. The
gain of an update is predicted from statistics of the image by linear regression, which learns from the updates that
were made; nothing is trained beforehand.
"""

from __future__ import annotations

import math
from dataclasses import fields

import torch
from torch import Tensor

from ufmstar_torch.output import MeanUncertainty, SampleStatistics

_TINY = 1e-6  # [m^2]; below it a variance is nothing beside any depth error


def image_statistics(result: MeanUncertainty, motion: Tensor) -> Tensor:
    """The statistics of an image from which :class:`TrainDecision` decides.

    Args:
        result: of the image, B = 1.
        motion: [4, 4] the camera's pose relative to the image trained on last, or to the image before [m].

    Returns:
        [F] float64: the logarithms of mean, standard deviation, median and maximum of V, M, A, E, B and depth (as far
        as network and config have them), the share of M that was measured, the camera's translation relative to the
        mean depth and its rotation [rad], and the share of pixels with a landmark.

    Raises:
        ValueError: several streams.
    """
    if len(result.mean) != 1:
        raise ValueError(f"result must be of one image, got {len(result.mean)} streams")
    parts = [getattr(result, f.name) for f in fields(result)]
    values = [v for part in parts if isinstance(part, SampleStatistics) for v in _logarithms(part)]
    T, depth = motion.double(), float(result.depth.mean)
    angle = math.acos(min(1.0, max(-1.0, (float(T[0, 0] + T[1, 1] + T[2, 2]) - 1) / 2)))
    used = result.statistics.anchors_used
    landmarks = 0.0 if used is None else float(used) / max(1, int(result.statistics.valid_pixels))
    more = [float(result.measured), float(T[:3, 3].norm()) / max(depth, _TINY), angle, landmarks]
    return torch.tensor([*values, *more], dtype=torch.float64).nan_to_num(0.0, 0.0, 0.0)


def _logarithms(part: SampleStatistics) -> list[float]:
    values = (part.mean, part.variance.clamp_min(0).sqrt(), part.median, part.maximum)
    return [math.nan if value.isnan() else math.log(max(float(value), _TINY)) for value in values]


class TrainDecision:
    """Trains on an image where the expected gain of the update exceeds its cost.

    Ridge regression of the gain on the image's statistics, both standardised by their running mean and deviation; old
    updates fade, as the network changes by them. What the regression does not know counts in favour of training: the
    prediction's standard error is added.

    Args:
        cost: of an update (a label and a training step), in the unit of the gain.
        first: so many images are trained on in any case.
        half_life: updates after which an update counts half.

    Attributes:
        updates: number of gains that were learnt.

    Example::

        decision = TrainDecision(cost=0.02)  # [nats]
        for image, pose, K in video:
            statistics = image_statistics(model.mean_uncertainty(image, pose, K), motion)
            if decision(statistics):
                before, after = train(network, image, label())  # loss at this image before and after the update
                decision.learn(statistics, before - after)
    """

    def __init__(self, cost: float, *, first: int = 8, half_life: float = 64.0) -> None:
        if not math.isfinite(cost) or first < 2 or not half_life > 0:
            raise ValueError(f"cost must be finite, first at least 2, half_life positive: {cost}, {first}, {half_life}")
        self.cost, self.first, self.updates, self._keep = cost, first, 0, 0.5 ** (1 / half_life)
        self._sums = torch.zeros(0, 0, dtype=torch.float64)  # of z z^T with z = (1, statistics, gain), fading

    def __call__(self, statistics: Tensor) -> bool:
        """True if an image with these statistics [F] is worth training on."""
        if self.updates < self.first:
            return True
        gain, error = self.expected(statistics)
        return gain + error > self.cost

    def learn(self, statistics: Tensor, gain: float) -> None:
        """Take in the gain of an update on an image: by how much the loss fell.

        Raises:
            ValueError: another number of statistics than before, or a value that is not finite.
        """
        z = torch.cat([torch.ones(1), self._checked(statistics), torch.tensor([gain], dtype=torch.float64)])
        if not bool((squares := z.outer(z)).isfinite().all()):
            raise ValueError(f"gain and statistics must be finite, and so their squares, got {z[1:].tolist()}")
        self._sums = self._keep * (self._sums if len(self._sums) else torch.zeros_like(squares)) + squares
        self.updates += 1

    def expected(self, statistics: Tensor) -> tuple[float, float]:
        """The expected gain of an update on an image with these statistics [F], and its standard error.

        Raises:
            ValueError: as :meth:`learn`, or nothing was learnt yet.
        """
        if not self.updates:
            raise ValueError("an expected gain needs learn() before")
        statistics = self._checked(statistics)
        n, mean = self._sums[0, 0], self._sums[0, 1:] / self._sums[0, 0]
        covariance = self._sums[1:, 1:] / n - mean.outer(mean)
        scale = covariance.diagonal().clamp_min(_TINY**2).sqrt()
        correlation = covariance / scale.outer(scale)
        precision = n * correlation[:-1, :-1] + torch.eye(len(scale) - 1, dtype=torch.float64)
        x = ((statistics - mean[:-1]) / scale[:-1]).clamp(-3, 3)
        weights = torch.linalg.solve(precision, n * correlation[:-1, -1])
        unexplained = (1 - weights @ correlation[:-1, -1]).clamp(0, 1)
        spread = (unexplained * (1 / n + x @ torch.linalg.solve(precision, x))).sqrt()
        return float(mean[-1] + scale[-1] * (x @ weights)), float(scale[-1] * spread)

    def _checked(self, statistics: Tensor) -> Tensor:
        """[F] float64. Raises ValueError: not as many as before, or not finite."""
        values, size = statistics.detach().flatten().double(), len(self._sums) - 2
        if not bool(values.isfinite().all()) or size not in (-2, len(values)):
            expected = size if size > 0 else "some"
            raise ValueError(f"statistics must be {expected} finite values as before, got {values.tolist()}")
        return values

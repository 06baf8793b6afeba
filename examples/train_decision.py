"""Online training: decides before an image is labelled whether to train on it.

The paper's application (section "Introduction"; DecTrain, Fu et al.): a robot labels and trains where the gain exceeds
the cost. A linear regression predicts the gain of an update from statistics of the image. It learns online from the
gains of past updates.
"""

from __future__ import annotations

import math
from dataclasses import fields

import torch
from torch import Tensor

from ufmstar_torch.frames.output import MeanUncertainty, SampleStatistics

_TINY = 1e-6  # [m^2]; a smaller variance is negligible


def image_statistics(result: MeanUncertainty, motion: Tensor) -> Tensor:
    """The statistics of an image from which :class:`TrainDecision` decides.

    Args:
        result: of the image, B = 1.
        motion: [4, 4] the camera's pose relative to the last image trained on, or to the previous image [m].

    Returns:
        [F] float64: the logarithms of mean, standard deviation, median and maximum of V, M, A, E, B and depth (those
        that network and config have), the share of pixels with a measured M, the camera's translation relative to the
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
    """Decides to train on an image where the expected gain of the update exceeds its cost.

    Ridge regression of the gain on the image's statistics, both standardised by their running mean and deviation, with
    exponential forgetting, as the network changes. The standard error of the prediction is added to it, which favours
    exploration.

    Args:
        cost: of an update (a label and a training step), in the unit of the gain.
        first: number of images to train on before the regression decides.
        half_life: updates after which an update counts half.

    Attributes:
        updates: number of observed gains.

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
        self.cost, self.first, self.updates, self._decay = cost, first, 0, 0.5 ** (1 / half_life)
        self._sums = torch.zeros(0, 0, dtype=torch.float64)  # decaying sum of z z^T with z = (1, statistics, gain)

    def __call__(self, statistics: Tensor) -> bool:
        """True if training on an image with these statistics [F] is expected to pay."""
        if self.updates < self.first:
            return True
        gain, error = self.expected(statistics)
        return gain + error > self.cost

    def learn(self, statistics: Tensor, gain: float) -> None:
        """Learn from the gain of an update on an image, the decrease of the loss.

        Raises:
            ValueError: another number of statistics than before, or a value that is not finite.
        """
        z = torch.cat([torch.ones(1), self._checked(statistics), torch.tensor([gain], dtype=torch.float64)])
        if not bool((squares := z.outer(z)).isfinite().all()):
            raise ValueError(f"gain and statistics must be finite, also their squares, got {z[1:].tolist()}")
        self._sums = self._decay * (self._sums if len(self._sums) else torch.zeros_like(squares)) + squares
        self.updates += 1

    def expected(self, statistics: Tensor) -> tuple[float, float]:
        """The expected gain of an update on an image with these statistics [F], and its standard error.

        Raises:
            ValueError: as :meth:`learn`, or :meth:`learn` was never called.
        """
        if not self.updates:
            raise ValueError("expected needs at least one gain: call learn() first")
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
        """The statistics as [F] float64. Raises ValueError: another F than before, or values that are not finite."""
        values, size = statistics.detach().flatten().double(), len(self._sums) - 2
        if not bool(values.isfinite().all()) or size not in (-2, len(values)):
            expected = f"{size} finite values as before" if size > 0 else "finite values"
            raise ValueError(f"statistics must be {expected}, got {values.tolist()}")
        return values

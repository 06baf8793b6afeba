"""The outputs of a step and of UfM* for one image."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from ufmstar_torch.frames.arguments import as_tensor, require_number
from ufmstar_torch.frames.prediction import DepthPrediction
from ufmstar_torch.posterior.distribution import LEAST_VARIANCE, DepthDistribution

_WITHOUT_EVIDENCE = (
    "an interval needs evidence: UfMStarConfig(anchors=AnchorConfig(), posterior=PosteriorConfig()) and images or "
    "anchors, or a Recalibration; without one, nothing shows how large the errors are"
)
_NO_ANCHORS_YET = (
    "an interval needs evidence, and too few anchors were held out so far: quantiles is NaN. Move the camera, or use a "
    "Recalibration until then"
)


# The counts that every frame has, per stream [B], in the order of files.
EVERY_FRAME: dict[str, str] = {
    "components": "K, occupied components after the frame.",
    "segments": "C, Gaussians segmented from the frame.",
    "matched": "segments that match at least one earlier component.",
    "pairs": "matched pairs (c, k); fused where the view changed (``steps.fuse``).",
    "new": "segments appended to the mixture.",
    "dropped": (
        "components that were dropped because ``max_components`` was reached, the farthest first; and segments nearer "
        "than the near plane, which are not appended."
    ),
    "valid_pixels": "pixels used.",
    "beyond": "pixels not used because their depth is beyond ``config.segment.max_depth``.",
    "out_of_range": (
        "other pixels with a finite positive depth that are not used, because depth, A or E lie outside the "
        "ranges of ``UfMStar.forward``."
    ),
    "unmeasured": (
        "pixels used (with a subset, pixels regressed) where less than half of M rests on surfaces seen from different "
        "places; ``config.unmeasured`` decides their M."
    ),
    "single_view": (
        "components seen by only one frame. If it stays close to ``components``, hardly anything is compared between "
        "views; the logger ``ufmstar_torch`` then lists likely causes."
    ),
    "fault": "index into ``ufmstar_torch.frames.frame.FRAME_FAULTS``; not 0 = the frame was skipped.",
    "rotation_deviation": "max |R^T R - I| of the pose, removed by projection onto SO(3).",
}
# Every count of a frame; the further ones need anchors.
COUNTS: dict[str, str] = EVERY_FRAME | {
    "anchors": "usable anchors (0, for example, while the camera stands still). None without ``config.anchors``.",
    "anchors_used": (
        "usable anchors without gross outliers. If 0, the frame adds no evidence: B follows from earlier frames, and "
        "is 0 at the start."
    ),
    "anchors_rejected": (
        "anchors that differ from the prediction by more than a factor of 100. If they are the majority, they count as "
        "an error of the prediction and widen the variance."
    ),
    "anchors_moving": "depths from images that were not used because the surface moves, or because views disagree.",
    "pose_error": (
        "disagreement of poses and images: standard deviation of tracked corners from their epipolar lines [px] of the "
        "searched image; NaN = not measured, None = no source of anchors measures it. Without anchors it is not "
        "measured, because the search costs as much as the step; a run measures some pairs of frames instead "
        "(``image_fit`` of its summary)."
    ),
    "calibration": (
        "running mean of z^2 of held-out anchors: 1 = the posterior variance matches the errors, more = it is too "
        "small. NaN before any anchor; None without ``config.posterior``."
    ),
    "unseen": (
        "likewise, variance of log g/d at held-out anchors on surfaces far from all other anchors; large where the "
        "evidence covers little of the image."
    ),
    "confidence": (
        "gain of the network's confidence in log likelihood of held-out anchors, less its standard error [nat]. The "
        "confidence is ignored where it is at most 0; -inf = too few frames. None without ``config.confidence``."
    ),
}


@dataclass(frozen=True, repr=False)
class FrameStatistics:
    """Counts of one frame, per stream [B]: an attribute for each name in ``COUNTS``; None if it is not counted.

    Attributes:
        counts: by name.
    """

    counts: Mapping[str, Tensor]

    def __getattr__(self, name: str) -> Any:
        """A count by its name, or None."""
        if name in COUNTS:
            return self.counts.get(name)
        raise AttributeError(f"{type(self).__name__} has no attribute {name!r}")

    def __dir__(self) -> list[str]:
        return [*super().__dir__(), *self.counts]

    def __repr__(self) -> str:
        """The counts that are not 0, in one line."""
        counts = {name: self.counts[name] for name in COUNTS if name in self.counts and name != "rotation_deviation"}
        return (
            f"FrameStatistics({', '.join(f'{name}={_short(value)}' for name, value in counts.items() if _any(value))})"
        )


class MapKind(NamedTuple):
    """A map of the output: the paper's symbol, the unit, and its meaning."""

    symbol: str
    unit: str
    meaning: str


# Every map of an output, in the order of files and pictures. [B, H, W], NaN where not valid.
MAPS: dict[str, MapKind] = {
    "depth": MapKind("", "m", "the best depth that is known: the posterior's, or else the network's"),
    "variance": MapKind("", "m^2", "the variance of that depth"),
    "network_depth": MapKind("d", "m", "the network's depth"),
    "ufm_variance": MapKind("V", "m^2", "the variance of UfM* for the network's depth: M + A + E + B"),
    "disagreement": MapKind("M", "m^2", "the multiview disagreement"),
    "aleatoric": MapKind("A", "m^2", "the network's aleatoric variance; with variances_in_h averaged over views"),
    "epistemic": MapKind("E", "m^2", "the network's epistemic variance; with variances_in_h likewise"),
    "anchored": MapKind("B", "m^2", "the mean square error at anchors in excess of M + A + E"),
    "bias": MapKind("r", "1", "the relative error g/d - 1 that anchors let expect"),
    "measured": MapKind("s", "1", "the share of M that rests on surfaces seen from different places"),
    "posterior_outlier": MapKind("p", "1", "the probability of another surface than that of the anchors, or of motion"),
    "posterior_inlier_variance": MapKind("V_1", "m^2", "the variance otherwise, limited to a quantile of the image's"),
    "confidence": MapKind("c", "1", "the network's confidence, in its own unit"),
}


@dataclass(frozen=True, repr=False)
class UncertaintyOutput:
    """The depth of one frame with its variance, of UfM* or of any other method.

    Maps have the shape of the argument ``depth``. A further map is an attribute by its name in ``MAPS``, for example
    ``out.disagreement``; it is None if the method does not compute it.

    Attributes:
        depth: the best that is known [m]: the posterior's, NaN where not valid, or else the network's. Before the first
            anchor of a stream, the posterior's equals the network's.
        variance: of ``depth`` [m^2]: the posterior's, or else V of UfM*: M, plus A and E if passed, plus B with
            ``config.anchors``; at least ``config.variance_floor``. NaN where not valid. The posterior's is that of a
            mixture: ``posterior_inlier_variance`` with the probability 1 - ``posterior_outlier``.
        valid: True where the pixel was used.
        maps: the further maps by name.
        statistics: per-stream counts of this frame.
        quantiles: [B, 3] half-widths of the central intervals of 50, 90 and 99 %, in standard deviations of a normal
            distribution (``posterior.conformal``). NaN in a stream without evidence; None without a posterior or a
            ``Recalibration``.
        prediction: the network's output, for "full" the predictive mean with mean A and E over the members; None for a
            module without networks.
        member: index of the network that was run; None if all were, or none.
        corrected: of a result that :attr:`ufm` returned, the one with the posterior; else None.
    """

    depth: Tensor
    variance: Tensor
    valid: Tensor
    maps: Mapping[str, Tensor]
    statistics: FrameStatistics
    quantiles: Tensor | None = None
    prediction: DepthPrediction | None = None
    member: int | None = None
    corrected: UncertaintyOutput | None = None

    def __getattr__(self, name: str) -> Any:
        """A map by its name, or None."""
        if name in MAPS:
            return self.maps.get(name)
        raise AttributeError(f"{type(self).__name__} has no attribute {name!r}")

    def __dir__(self) -> list[str]:
        return [*super().__dir__(), *self.maps]

    def __repr__(self) -> str:
        """Shape, median standard deviation and counts in one line."""
        std = "" if self.variance.device.type == "meta" else f", median std {float(self.std.nanmedian()):.3g} m"
        return f"UncertaintyOutput({' x '.join(map(str, self.variance.shape))}{std}, {self.statistics!r})"

    @property
    def std(self) -> Tensor:
        """sqrt(variance) [m]."""
        return self.variance.sqrt()

    @property
    def ufm(self) -> UncertaintyOutput:
        """The network's depth with the variance V of UfM*. The maps, intervals and probabilities stay those of this
        output: they are about the corrected depth."""
        return replace(self, depth=self.network_depth, variance=self.ufm_variance, corrected=self)

    def posterior(self) -> tuple[Tensor, Tensor]:
        """The posterior's depth [m] and variance [m^2].

        Raises:
            ValueError: without ``config.posterior``.
        """
        best = self if self.corrected is None else self.corrected
        if best.posterior_outlier is None:
            raise ValueError("posterior needs UfMStarConfig(anchors=AnchorConfig(), posterior=PosteriorConfig())")
        return best.depth, best.variance

    @property
    def intrinsics(self) -> Tensor:
        """[B, 3, 3] of the depth map [px].

        Raises:
            ValueError: a module without networks, whose caller has them.
        """
        if self.prediction is None:
            raise ValueError("intrinsics are those that were passed with the depth")
        return self.prediction.K

    def interval(self, level: float) -> tuple[Tensor, Tensor]:
        """Central interval that holds the true depth with probability ``level``: lower and upper end [m], in the shape
        of ``depth``; NaN where not valid, and in a stream without evidence.

        The interval is that of the posterior's mixture, widened or narrowed so that it holds the held-out anchors
        (``posterior.conformal``). With a ``Recalibration`` and without a posterior, it is that of N(depth, variance).

        Raises:
            ValueError: ``level`` is not within (0, 1); or no stream has evidence: neither a posterior with held-out
                anchors, nor a ``Recalibration``.
        """
        if not 0 < require_number("level", level) < 1:
            raise ValueError(f"level must lie within (0, 1), got {level!r}")
        lower, upper = self.distribution().interval(level)
        return lower.to(self.depth.dtype), upper.to(self.depth.dtype)

    def probability_nearer(self, than: float | Tensor) -> Tensor:
        """Probability that the depth is below ``than`` [m], in the shape of ``depth``; from the distribution of
        :meth:`interval`.

        Args:
            than: a depth, or a map that broadcasts with ``depth``.

        Raises:
            ValueError: as :meth:`interval`, without its ``level``.
        """
        return self.distribution().below(self._bound("than", than)).to(self.depth.dtype)

    def probability_between(self, near: float | Tensor, far: float | Tensor) -> Tensor:
        """Probability that the depth lies between ``near`` and ``far`` [m]; otherwise as :meth:`probability_nearer`.

        Raises:
            ValueError: as :meth:`probability_nearer`; or ``near`` is beyond ``far``.
        """
        near, far = self._bound("near", near), self._bound("far", far)
        if bool((near > far).any()):
            raise ValueError("near must be at most far, got a larger one")
        return self.probability_nearer(far) - self.probability_nearer(near)

    def _bound(self, name: str, value: float | Tensor) -> Tensor:
        """The argument ``name``, depths [m] that broadcast with ``depth``, in float64 and that shape."""
        number = as_tensor(name, value) if isinstance(value, Tensor | np.ndarray) else require_number(name, value)
        try:
            return torch.as_tensor(number, dtype=torch.float64, device=self.depth.device).expand(self.depth.shape)
        except RuntimeError as error:
            raise ValueError(f"{name} must broadcast with depth {tuple(self.depth.shape)}: {error}") from error

    @property
    def has_intervals(self) -> bool:
        """True if :meth:`interval` and the probabilities have evidence in at least one stream."""
        return self.quantiles is not None and bool(self.quantiles.isfinite().any())

    def distribution(self) -> DepthDistribution:
        """The distribution of the depth at every pixel, of which the intervals and probabilities are.

        Raises:
            ValueError: no stream has evidence, as :meth:`interval`.
        """
        if self.quantiles is None or not self.has_intervals:
            raise ValueError(_WITHOUT_EVIDENCE if self.quantiles is None else _NO_ANCHORS_YET)
        best = self if self.corrected is None else self.corrected  # p and V1 are about the corrected depth
        d, V, V1, p = best.depth, best.variance, best.posterior_inlier_variance, best.posterior_outlier
        if p is None:
            weight, mean, variance = torch.ones_like(d)[None], d[None], V[None]
        else:
            p = torch.where(p.isnan() & V.isfinite(), 0.0, p)  # before any anchor
            elsewhere = torch.maximum((V - (1 - p) * V1) / p.clamp_min(1e-12), V1)
            weight, mean, variance = torch.stack([1 - p, p]), torch.stack([d, d]), torch.stack([V1, elsewhere])
        weight = torch.where(variance.isfinite(), weight, torch.nan)
        return DepthDistribution(weight, mean, variance.clamp_min(LEAST_VARIANCE), self.quantiles)


@dataclass(frozen=True)
class SampleStatistics:
    """Statistics of a map over the pixels of an image with a value, per stream [B]; NaN if there are none.

    Attributes:
        mean, median, maximum: in the unit of the map; for an even number of pixels, the lower of the two middle values.
        variance: between the pixels, in the unit squared; NaN with fewer than two.
        pixels: number of pixels with a value.
    """

    mean: Tensor
    variance: Tensor
    median: Tensor
    maximum: Tensor
    pixels: Tensor


@dataclass(frozen=True, repr=False)
class MeanUncertainty:
    """Averages of V and of its parts over a sample of an image's pixels, per stream [B].

    Attributes:
        total: V [m^2]; with ``config.unmeasured="nan"`` only over measured pixels.
        disagreement: M [m^2], likewise.
        aleatoric, epistemic: A and E [m^2], or None if V does not include them.
        anchored: B [m^2]; None unless ``config.anchors``.
        depth: the predicted depth [m].
        standard_error: of the mean of V as an estimate of the mean over all valid pixels [m^2]; NaN with fewer than two
            pixels.
        measured: share in [0, 1] of the sampled pixels whose M rests on surfaces seen from different places; about 0
            in a first view, where ``config.unmeasured`` decides the mean. NaN without a valid pixel.
        statistics: per-stream counts of this frame; ``unmeasured`` counts the other sampled pixels.
    """

    total: SampleStatistics
    disagreement: SampleStatistics
    aleatoric: SampleStatistics | None
    epistemic: SampleStatistics | None
    anchored: SampleStatistics | None
    depth: SampleStatistics
    standard_error: Tensor
    measured: Tensor
    statistics: FrameStatistics

    @property
    def mean(self) -> Tensor:
        """[B] mean of V [m^2]."""
        return self.total.mean

    @property
    def pixels(self) -> Tensor:
        """[B] number of pixels over which V is averaged."""
        return self.total.pixels

    def __repr__(self) -> str:
        """Means and counts in one line."""
        counts = f"pixels={_short(self.pixels)}, measured={_short(self.measured)}"
        return f"MeanUncertainty(mean={_short(self.mean)} m^2, {counts}, {self.statistics!r})"


def _any(value: Tensor) -> bool:
    return value.device.type == "meta" or bool(value.any())


def _short(value: Tensor) -> str:
    """The values of at most four streams."""
    if value.device.type == "meta":
        return "?"
    texts = [f"{x:.4g}" if value.is_floating_point() else str(x) for x in value[:4].tolist()]
    return texts[0] if len(value) == 1 else f"[{', '.join(texts)}{', ...' if len(value) > 4 else ''}]"

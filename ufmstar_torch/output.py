"""The outputs of a step and of UfM* for one image."""

from __future__ import annotations

from dataclasses import dataclass, fields

from torch import Tensor

from ufmstar_torch.mixture import GaussianMixture


@dataclass(frozen=True, repr=False)
class FrameStatistics:
    """Counts of one frame, per stream [B].

    Attributes:
        components: K, occupied components after the frame.
        segments: C, Gaussians segmented from the frame.
        matched: segments fused with at least one earlier component.
        pairs: fused (c, k) pairs.
        new: segments appended to the mixture.
        dropped: components that were dropped because ``max_components`` was reached, the farthest first; and segments
            nearer than the near plane, which are not remembered.
        valid_pixels: pixels used.
        beyond: pixels not used because their depth is beyond ``config.segment.max_depth``.
        out_of_range: further pixels with a finite positive depth that are not used: depth, A, E or features outside the
            ranges that ``UfMStar.forward`` states.
        unmeasured: of the pixels used (with a subset, of those regressed), where M rests by less than half on surfaces
            seen from two views or more; what they get is ``config.unmeasured``.
        single_view: components that one frame alone has seen. Close to all of ``components`` after some frames: hardly
            anything is compared between views, and the logger ``ufmstar_torch`` has named likely causes.
        fault: index into ``ufmstar_torch.frame.FRAME_FAULTS``; not 0 = the frame was skipped.
        rotation_deviation: max |R^T R - I| of the pose, removed by projection onto SO(3).
        anchors: with ``config.anchors``, given and usable; 0 for a standing camera, say. None without.
        anchors_used: of those, no gross outliers. 0 = nothing new was learnt: M + A + E is plain UfM*'s and B what had
            been learnt before, which at the start is nothing.
        anchors_rejected: those that are off from the prediction by more than a factor of 100. Where they are the most,
            they show an error, by which the variance is widened.
        pose_error: by how much poses and images disagree: standard deviation of tracked corners from their epipolar
            lines [px] of the image that was searched; NaN = not measured, None = no source of anchors measures it.
            Without anchors no image is searched, which would cost as much as the step: a run measures some pairs of
            frames instead (``image_fit`` of its summary).
        calibration: with ``config.posterior``, mean z^2 of held-out anchors lately: 1 = the posterior is off by as much
            as it states, more = it is too certain. NaN before any; None without.
        unseen: likewise, variance of log g/d that held-out anchors show for surfaces far from all anchors: large where
            evidence covers little of what the camera sees.
        confidence: with ``config.confidence``, by how much the network's confidence makes held-out anchors likelier,
            less the standard error [nat]; at most 0 = it is ignored, -inf = not judged yet. None without.
    """

    components: Tensor
    segments: Tensor
    matched: Tensor
    pairs: Tensor
    new: Tensor
    dropped: Tensor
    valid_pixels: Tensor
    beyond: Tensor
    out_of_range: Tensor
    unmeasured: Tensor
    fault: Tensor
    rotation_deviation: Tensor
    single_view: Tensor
    anchors: Tensor | None = None
    anchors_used: Tensor | None = None
    anchors_rejected: Tensor | None = None
    pose_error: Tensor | None = None
    calibration: Tensor | None = None
    unseen: Tensor | None = None
    confidence: Tensor | None = None

    def __repr__(self) -> str:
        """The counts of every stream that are not 0, in a line."""
        names = (f.name for f in fields(self) if f.name != "rotation_deviation")
        counts = {name: getattr(self, name) for name in names if getattr(self, name) is not None}
        shown = [f"{name}={_short(value)}" for name, value in counts.items() if _any(value)]
        return f"FrameStatistics({', '.join(shown)})"


@dataclass(frozen=True)
class StepOutput:
    """The regressed disagreement and what led to it.

    Attributes:
        disagreement: M [B, H, W] [m^2] after the moving average, NaN where not valid; [B, n] on a subset.
        features: regressed features [B, H, W, F] or [B, n, F].
        measured: [B, H, W] or [B, n] share in [0, 1] of M that rests on surfaces seen from two views or more.
        current_cam: C_i in the camera frame.
        statistics: of this frame.
    """

    disagreement: Tensor
    features: Tensor
    measured: Tensor
    current_cam: GaussianMixture
    statistics: FrameStatistics


@dataclass(frozen=True, repr=False)
class UfMStarOutput:
    """The prediction of one frame with its variance. Maps have the layout in which ``depth`` was given.

    Attributes:
        depth: the depth as given [m].
        variance: V, the total variance of the depth [m^2]: M, plus A and E where given (and not switched
            off in the config) and B with ``config.anchors``, at least ``config.variance_floor``. NaN where not valid.
        disagreement: M, the multiview disagreement [m^2]. NaN where not valid.
        aleatoric, epistemic: A and E as given [m^2], or None; with ``config.aleatoric_in_h`` A of the mixture.
        anchored: B, the mean square error that anchors found beyond M + A + E [m^2] (``evidence``); None unless
            ``config.anchors``.
        bias: the relative error r = g/d - 1 that anchors lead to expect; None unless ``config.anchors``.
        posterior_depth, posterior_variance: what :meth:`posterior` returns; None unless ``config.posterior``.
        posterior_outlier: probability p that the pixel lies on another surface than the anchors that corrected it. NaN
            before any anchor; None likewise.
        posterior_inlier_variance: V_1 [m^2], the variance if it does not. ``posterior_variance`` V contains both: where
            it does, the variance is (V - (1 - p) V_1)/p.
        features: regressed further entries of H, [B, H, W, F], in the caller's units.
        measured: share in [0, 1] of M that rests on surfaces seen from two views or more; below one half the pixel
            counts as not measured (``config.unmeasured``). NaN where not valid.
        valid: True where the pixel was used.
        current_cam: C_i, the segments of this frame in the camera frame, float64.
        statistics: per-stream counts of this frame.
    """

    depth: Tensor
    variance: Tensor
    disagreement: Tensor
    aleatoric: Tensor | None
    epistemic: Tensor | None
    features: Tensor
    measured: Tensor
    valid: Tensor
    current_cam: GaussianMixture
    statistics: FrameStatistics
    anchored: Tensor | None = None
    bias: Tensor | None = None
    posterior_depth: Tensor | None = None
    posterior_variance: Tensor | None = None
    posterior_outlier: Tensor | None = None
    posterior_inlier_variance: Tensor | None = None

    def __repr__(self) -> str:
        """Shape, median standard deviation and counts in a line."""
        std = "" if self.variance.device.type == "meta" else f", median std {float(self.std.nanmedian()):.3g} m"
        return f"UfMStarOutput({' x '.join(map(str, self.variance.shape))}{std}, {self.statistics!r})"

    @property
    def std(self) -> Tensor:
        """sqrt(variance) [m]."""
        return self.variance.sqrt()

    def posterior(self) -> tuple[Tensor, Tensor]:
        """p(depth | network, UfM*, anchors): depth [m] and its variance [m^2], NaN where not valid
        (``ufmstar_torch.posterior``).

        Before the first anchor these are ``depth`` and ``variance``, to the bit.

        Raises:
            ValueError: without ``config.posterior``.
        """
        if self.posterior_depth is None or self.posterior_variance is None:
            raise ValueError("posterior needs UfMStarConfig(anchors=AnchorConfig(), posterior=PosteriorConfig())")
        return self.posterior_depth, self.posterior_variance


@dataclass(frozen=True)
class SampleStatistics:
    """Statistics of a map over the pixels of an image that have a value, per stream [B]; NaN without any.

    Attributes:
        mean, median, maximum: in the unit of the map; of an even number of pixels, the lower of the two middle ones.
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
    """Averages over a sample of an image's pixels, per stream [B]: of V, and of each of its parts.

    Attributes:
        total: V [m^2], with ``config.unmeasured="nan"`` over the pixels that are measured.
        disagreement: M [m^2], likewise.
        aleatoric, epistemic: A and E [m^2] as far as V counts them, or None.
        anchored: B [m^2]; None unless ``config.anchors``.
        depth: the predicted depth [m].
        standard_error: of the mean of V as an estimate of that over all valid pixels [m^2]; NaN with fewer than two
            pixels.
        measured: share in [0, 1] of the sampled pixels whose M rests on surfaces seen from two views or more; about 0
            in a first view, whose mean is that of ``config.unmeasured``. NaN without a valid pixel.
        statistics: per-stream counts of this frame; ``unmeasured`` are the other sampled pixels.
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
        """Means, errors and counts in a line."""
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

"""What a step and what UfM* returns for one image."""

from __future__ import annotations

from dataclasses import dataclass

from torch import Tensor

from ufmstar_torch.mixture import GaussianMixture


@dataclass(frozen=True)
class FrameStatistics:
    """What happened to one frame, per stream [B].

    Attributes:
        components: K, occupied components after the frame.
        segments: C, Gaussians segmented from the frame.
        matched: segments fused with at least one earlier component.
        pairs: fused (c, k) pairs.
        new: segments appended to the mixture.
        dropped: segments not remembered: ``max_components`` was reached, or nearer than the near plane.
        valid_pixels: pixels used.
        fault: index into ``ufmstar_torch.frame.FRAME_FAULTS``; not 0 = the frame was skipped.
        rotation_deviation: max |R^T R - I| of the pose, removed by projection onto SO(3).
        anchors: given and usable; 0 for a standing camera, say.
        anchors_used: of those, no gross outliers. 0 = nothing new was learnt: M + A + E is plain UfM*'s and B what had
            been learnt before, which at the start is nothing.
    """

    components: Tensor
    segments: Tensor
    matched: Tensor
    pairs: Tensor
    new: Tensor
    dropped: Tensor
    valid_pixels: Tensor
    fault: Tensor
    rotation_deviation: Tensor
    anchors: Tensor
    anchors_used: Tensor


@dataclass(frozen=True)
class StepOutput:
    """The regressed disagreement and what led to it.

    Attributes:
        disagreement: M [B, H, W] [m^2] after the moving average, NaN where not valid; [B, n] on a subset.
        features: regressed features [B, H, W, F] or [B, n, F].
        residual: [B, H, W, 2] or [B, n, 2] from anchors, the mean relative error r and mean square excess e expected at
            each pixel (``anchors.evidence``); None unless ``config.anchored``.
        labels: [B, H, W] int64 the segment of every pixel, -1 = none.
        current_cam: C_i in the camera frame.
        statistics: of this frame.
    """

    disagreement: Tensor
    features: Tensor
    residual: Tensor | None
    labels: Tensor
    current_cam: GaussianMixture
    statistics: FrameStatistics


@dataclass(frozen=True)
class UfMStarOutput:
    """The prediction of one frame with its variance. Maps have the layout in which ``depth`` was given.

    Attributes:
        depth: the depth as given [m].
        variance: V, the total variance of the depth [m^2]: M, plus A and E where given (and not switched
            off in the config) and B with ``config.anchored``, at least ``config.variance_floor``. NaN where not valid.
        disagreement: M, the multiview disagreement [m^2]. NaN where not valid.
        aleatoric, epistemic: A and E as given [m^2], or None.
        anchored: B, the mean square error that anchors found beyond M + A + E [m^2] (``evidence``); None unless
            ``config.anchored``.
        bias: the relative error r = g/d - 1 that anchors lead to expect; None unless ``config.anchored``.
        features: regressed further entries of H, [B, H, W, F], in the caller's units.
        valid: True where the pixel was used.
        labels: [B, H, W] the pixel's segment in ``current_cam``, -1 = none.
        current_cam: C_i, the segments of this frame in the camera frame, float64.
        statistics: per-stream counts of this frame.
    """

    depth: Tensor
    variance: Tensor
    disagreement: Tensor
    aleatoric: Tensor | None
    epistemic: Tensor | None
    anchored: Tensor | None
    bias: Tensor | None
    features: Tensor
    valid: Tensor
    labels: Tensor
    current_cam: GaussianMixture
    statistics: FrameStatistics

    @property
    def std(self) -> Tensor:
        """sqrt(variance) [m]."""
        return self.variance.sqrt()

    def corrected(self) -> tuple[Tensor, Tensor]:
        """Depth without the bias that anchors found, d (1 + r) [m], and the variance that remains [m^2].

        From E[(x - r)^2] = E[x^2] - r^2: the bias's square leaves B, of which no less than 0 remains.

        Raises:
            ValueError: without ``config.anchored`` nothing is known of a bias.
        """
        if self.anchored is None or self.bias is None:
            raise ValueError("corrected needs anchors: UfMStarConfig(anchored=True)")
        remaining = (self.anchored - (self.depth * self.bias).square()).clamp_min(0)
        return self.depth * (1 + self.bias), self.variance - self.anchored + remaining


@dataclass(frozen=True)
class MeanUncertainty:
    """An image average of the total variance from a sample of pixels, per stream [B].

    Attributes:
        mean: average of V over the sampled pixels [m^2]; NaN without a valid pixel.
        standard_error: of that average as an estimate of the mean over all valid pixels [m^2];
            NaN with fewer than two pixels.
        pixels: number of pixels averaged.
        statistics: per-stream counts of this frame.
    """

    mean: Tensor
    standard_error: Tensor
    pixels: Tensor
    statistics: FrameStatistics

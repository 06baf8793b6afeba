"""V = M + A + E + B of a frame, and the corrections that follow it, in their order.

M is the step's (section "Uncertainty Regression"); A and E are the network's, as far as the config adds them. What is
not in the paper: B (``anchors.learn``), the factor of the network's confidence (``anchors.confidence``), the user's map
of V (``posterior.recalibrate``), the posterior (``posterior.update``) and merging (``steps.merge``).
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

from torch import Tensor

from ufmstar_torch.anchors.confidence import after_frame as learn_confidence
from ufmstar_torch.anchors.learn import anchored_term
from ufmstar_torch.config import UfMStarConfig
from ufmstar_torch.frames.frame import FrameInput
from ufmstar_torch.frames.output import StepOutput
from ufmstar_torch.gaussians.state import UfMStarState
from ufmstar_torch.posterior.conformal import normal_where_missing
from ufmstar_torch.posterior.correct import correct
from ufmstar_torch.posterior.recalibrate import Recalibration
from ufmstar_torch.steps import merge
from ufmstar_torch.steps.regress import at_pixels

# A map of V: a recalibration, or a function from V [...] to V' [...] [m^2].
VarianceMap = Recalibration | Callable[[Tensor], Tensor]


def require_map(mapped: VarianceMap | None, config: UfMStarConfig) -> VarianceMap | None:
    """Return a map of V that fits the config, or None.

    Raises:
        TypeError: it is no function.
        ValueError: a recalibration was fitted with other settings.
    """
    if mapped is not None and not callable(mapped):
        raise TypeError(f"recalibration must be a function or None, got {type(mapped).__name__}")
    if isinstance(mapped, Recalibration):
        mapped.require(config)
    return mapped


class NetworkVariances(NamedTuple):
    """A and E at some pixels, of equal shape [m^2]; None = not predicted, or not added."""

    aleatoric: Tensor | None
    epistemic: Tensor | None


def network_variances(frame: FrameInput, config: UfMStarConfig) -> NetworkVariances:
    """A and E of a frame [B, H, W]."""
    return NetworkVariances(
        frame.aleatoric if config.add_aleatoric else None, frame.epistemic if config.add_epistemic else None
    )


def network_variances_at(
    frame: FrameInput, features: Tensor, config: UfMStarConfig, pixels: Tensor | None
) -> NetworkVariances:
    """A and E [B, H, W], or [B, n] at ``pixels``, whose regressed features are [..., F].

    With ``config.variances_in_h`` the last three features are the mixture's A, E and weight share s; each of A and E is
    then its mean over the mixture plus (1 - s) times the pixel's own.
    """
    values = [None if value is None else at_pixels(value, pixels) for value in network_variances(frame, config)]
    if config.variances_in_h:
        *means, explained = features[..., -3:].unbind(-1)
        pairs = zip(values, means, strict=True)
        values = [None if value is None else mean + (1 - explained) * value for value, mean in pairs]
    return NetworkVariances(*values)


def total_variance(
    disagreement: Tensor, frame: FrameInput, out: StepOutput, config: UfMStarConfig, mapped: VarianceMap | None,
    pixels: Tensor | None, factor: Tensor | None = None,
) -> Tensor:  # fmt: skip
    """V of M, or of M + B, [m^2]: plus A and E, at least the floor, times ``factor``, mapped; NaN stays NaN. Gradients
    flow to A and E. The arguments are those of :func:`corrected`."""
    variance = disagreement
    for value in network_variances_at(frame, out.features, config, pixels):
        if value is not None:
            variance = variance + value
    variance = variance.clamp_min(config.variance_floor) if config.variance_floor else variance
    if factor is not None:
        variance = variance * factor.to(variance.dtype)
    if isinstance(mapped, Recalibration):
        c = None if frame.confidence is None else at_pixels(frame.confidence, pixels)
        return mapped.mapped(variance, c)
    return variance if mapped is None else mapped(variance)


class Corrections(NamedTuple):
    """The corrections of a frame.

    Attributes:
        state: after the frame.
        disagreement: M + B at the pixels [m^2].
        factor: h(c) at the pixels (``anchors.confidence``); None = 1.
        maps: the maps of anchors and posterior by name (``output.MAPS``).
        quantiles: [B, 3] of intervals, or None.
        counts: further statistics by name.
    """

    state: UfMStarState
    disagreement: Tensor
    factor: Tensor | None
    maps: dict[str, Tensor]
    quantiles: Tensor | None
    counts: dict[str, Tensor]


def corrected(
    state: UfMStarState, frame: FrameInput, out: StepOutput, config: UfMStarConfig, mapped: VarianceMap | None,
    pixels: Tensor | None, merging: merge.MergeKernels | None = None,
) -> Corrections:  # fmt: skip
    """The corrections after a step.

    Args:
        state, out: of the step.
        frame: of B streams.
        config: of UfM*.
        mapped: map of V, applied last, or None.
        pixels: [B, n] indices into the flattened image, or None = every pixel, which the posterior needs.
        merging: implementation of each part of merging; None = the reference.
    """
    M, factor, quantiles = out.disagreement, None, None
    maps, counts = dict[str, Tensor](), dict[str, Tensor]()
    M_and_B = M
    if out.residual is not None:
        maps["bias"], excess = out.residual.unbind(-1)
        contradiction = None if frame.anchors is None else frame.anchors.contradiction
        maps["anchored"], M_and_B = anchored_term(at_pixels(frame.depth, pixels), excess, M, contradiction)
    if config.confidence is not None and frame.confidence is not None:
        V = total_variance(M_and_B, frame, out, config, mapped, pixels) if pixels is None else None
        before = state.by_stream["confidence"]
        after, factor, counts["confidence"] = learn_confidence(before, frame, V, config.confidence)
        factor, state = at_pixels(factor, pixels), state.with_tensors({"confidence": after})
    if config.posterior is not None and pixels is None:
        claimed = total_variance(M, frame, out, config, mapped, pixels, factor).detach()
        learnt, posterior, of_posterior = correct(state.by_stream, frame, claimed, config)
        quantiles, state = posterior.pop("quantiles"), state.with_tensors(learnt)
        maps, counts = maps | posterior, counts | of_posterior
    if config.merges_on(frame.depth.device.type):
        state, merged = merge.after_frame(state, frame, config, merging)
        counts |= merged
    if isinstance(mapped, Recalibration):
        quantiles = normal_where_missing(quantiles, M)
    return Corrections(state, M_and_B, factor, maps, quantiles, counts)

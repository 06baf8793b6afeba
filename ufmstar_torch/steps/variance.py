"""V = M + A + E + B of a frame, and the corrections that follow it, in their order.

M is the step's (section "Uncertainty Regression"); A and E are the network's. What is not in the paper: B
(``anchors.learn``), the factor of the network's confidence (``anchors.confidence``), the user's map of V
(``posterior.recalibrate``), the posterior (``posterior.update``) and merging (``steps.merge``).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace

from torch import Tensor

from ufmstar_torch.anchors.confidence import after_frame as learn_confidence
from ufmstar_torch.config import UfMStarConfig
from ufmstar_torch.frames.frame import FrameInput
from ufmstar_torch.frames.output import FrameStatistics, UncertaintyOutput
from ufmstar_torch.gaussians.state import UfMStarState
from ufmstar_torch.posterior.distribution import normal_where_missing
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


def network_maps(
    frame: FrameInput, features: Tensor, config: UfMStarConfig, pixels: Tensor | None
) -> dict[str, Tensor]:
    """A and E by name, as far as they are predicted: [B, H, W], or [B, n] at ``pixels``, whose regressed
    features are [..., F].

    With ``config.variances_in_h`` the last three features are the mixture's A, E and weight share s; each of A and E is
    then its mean over the mixture plus (1 - s) times the pixel's own.
    """
    if frame.aleatoric is None and frame.epistemic is None:
        return {}
    pairs = ("aleatoric", frame.aleatoric), ("epistemic", frame.epistemic)
    maps = {name: at_pixels(value, pixels) for name, value in pairs if value is not None}
    if config.variances_in_h:
        *means, explained = features[..., -3:].unbind(-1)
        averaged = dict(zip(("aleatoric", "epistemic"), means, strict=True))
        maps = {name: averaged[name] + (1 - explained) * value for name, value in maps.items()}
    return maps


def total_variance(
    disagreement: Tensor, network: Mapping[str, Tensor], frame: FrameInput, config: UfMStarConfig,
    mapped: VarianceMap | None, pixels: Tensor | None, factor: Tensor | None = None,
) -> Tensor:  # fmt: skip
    """V of M, or of M + B, [m^2]: plus A and E of ``network``, at least the floor, times ``factor``, mapped; NaN stays
    NaN. Gradients flow to A and E. The other arguments are those of :func:`corrected`."""
    variance = disagreement
    for value in network.values():
        variance = variance + value
    variance = variance.clamp_min(config.variance_floor) if config.variance_floor else variance
    if factor is not None:
        variance = variance * factor.to(variance.dtype)
    if isinstance(mapped, Recalibration):
        c = None if frame.confidence is None else at_pixels(frame.confidence, pixels)
        return mapped.mapped(variance, c)
    return variance if mapped is None else mapped(variance)


def corrected(
    state: UfMStarState, frame: FrameInput, out: UncertaintyOutput, config: UfMStarConfig, mapped: VarianceMap | None,
    pixels: Tensor | None, merging: merge.MergeKernels | None = None,
) -> tuple[UfMStarState, UncertaintyOutput, Tensor | None]:  # fmt: skip
    """The corrections after a step, but for V itself, whose gradients are the caller's.

    Args:
        state, out: of the step.
        frame: of B streams.
        config: of UfM*.
        mapped: map of V, applied last, or None.
        pixels: [B, n] indices into the flattened image, or None = every pixel, which the posterior needs.
        merging: implementation of each part of merging; None = the reference.

    Returns:
        The state after the frame; the output, whose ``maps`` have the posterior's "depth" and "variance", too; and h(c)
        at the pixels (``anchors.confidence``), None = 1.
    """
    M, factor, quantiles = out.maps["disagreement"], None, None
    maps: dict[str, Tensor] = {}
    counts: dict[str, Tensor] = {}
    if config.confidence and frame.confidence is not None:
        V = None
        if pixels is None:
            network = network_maps(frame, out.maps["features"], config, pixels)
            V = total_variance(out.variance, network, frame, config, mapped, pixels)
        before = state.by_stream["confidence"]
        after, factor, counts["confidence"] = learn_confidence(before, frame, V)
        factor, state = at_pixels(factor, pixels), state.with_tensors({"confidence": after})
    if config.posterior is not None and pixels is None:
        network = network_maps(frame, out.maps["features"], config, pixels)
        claimed = total_variance(M, network, frame, config, mapped, pixels, factor).detach()
        from ufmstar_torch.posterior.update import update  # kernels compile when they are first needed

        memory = state.by_stream["posterior"]
        learnt, found = update(memory, frame, frame.anchors, claimed, config.posterior, config.variance_floor)
        quantiles, state = found.quantiles, state.with_tensors({"posterior": learnt})
        maps |= {"depth": found.depth, "variance": found.variance, "posterior_outlier": found.outlier}
        maps["posterior_inlier_variance"] = found.inlier
        counts |= {"calibration": found.calibration, "unseen": found.unseen}
    if config.merges_on(frame.depth.device.type):
        state, merged = merge.after_frame(state, frame, config, merging)
        counts |= merged
    if isinstance(mapped, Recalibration):
        quantiles = normal_where_missing(quantiles, M)
    if counts or quantiles is not None:
        statistics = FrameStatistics({**out.statistics.counts, **counts})
        out = replace(out, maps={**out.maps, **maps}, quantiles=quantiles, statistics=statistics)
    return state, out, factor

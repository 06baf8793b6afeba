"""The interface of extensions of UfM*: additional state tensors, and methods called during a frame.

An :class:`Extension` belongs to a module. For each frame it creates a :class:`FrameExtension`, whose methods are called
in this order: ``before_regression`` adds columns that are regressed with H's weights, ``after_regression`` receives
them at every pixel, ``after_frame`` may change the state, and ``disagreement`` may change M. An extension may also map
V. The defaults change nothing. ``extensions.py`` creates the extensions of a config.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, ClassVar

import torch
from torch import Tensor

from ufmstar_torch.config import UfMStarConfig
from ufmstar_torch.frames.frame import FrameInput
from ufmstar_torch.frames.output import StepOutput
from ufmstar_torch.gaussians.mixture import GaussianMixture
from ufmstar_torch.gaussians.state import UfMStarState
from ufmstar_torch.steps.regress import Regression

Tensors = Mapping[str, Tensor]
# (mixture in the camera frame, points [B, N, 3], values [B, N, C], config) -> sums by component [B, K, C]
Distribute = Callable[[GaussianMixture, Tensor, Tensor, UfMStarConfig], Tensor]
# M -> V, before extensions change M
Total = Callable[[Tensor], Tensor]
# Map [B, H, W] -> its values at the pixels that are regressed, [B, H, W] or [B, n]
Chosen = Callable[[Tensor], Tensor]


@dataclass(frozen=True)
class Columns:
    """Columns that are regressed in addition to H, C numbers per component.

    Attributes:
        values: [B, K, C], 0 for the prior.
        shift: [B, C], added to the regressed values at every pixel.
        tensors: the extension's changed state tensors, after the frame.
    """

    values: Tensor
    shift: Tensor
    tensors: dict[str, Tensor]


class FrameExtension:
    """An extension during one frame.

    Attributes:
        columns: C, the number of columns it regresses.
        changes_mixture: whether ``after_frame`` may change the mixture; the step then completes it before the call.
    """

    columns: int = 0
    changes_mixture: bool = False

    def before_regression(self, tensors: Tensors, mixture_cam: GaussianMixture, distribute: Distribute) -> Columns:
        """The columns of M_i [B, K] in the camera frame; called only if ``columns`` is not 0.

        Args:
            tensors: of the state before the frame.
            mixture_cam: after the fusion.
            distribute: sums values at points by component (:func:`ufmstar_torch.steps.regress.distribute`).
        """
        raise NotImplementedError(f"{type(self).__name__} states columns, but does not compute them")

    def in_view(self, tensors: Tensors, capacity: int, seen: Any, views: Any) -> Columns | None:
        """A faster :meth:`before_regression` for the compiled step, None if there is none. It writes the columns into
        ``seen`` and ``views`` (``kernels.cpu.regress``), which hold the first slots."""
        return None

    def after_regression(self, values: Tensor) -> None:
        """Receive the columns [B, H, W, C] or [B, n, C] at the pixels."""

    def after_frame(self, state: UfMStarState, out: StepOutput, total: Total) -> tuple[UfMStarState, StepOutput]:
        """Change the state and the output after a step; ``total`` maps M to V at the pixels of the output."""
        return state, out

    def disagreement(self, disagreement: Tensor, depth: Tensor) -> Tensor:
        """M with the extension's change [m^2], at pixels of this depth [m]."""
        return disagreement

    def map_variance(self, variance: Tensor, chosen: Chosen) -> Tensor:
        """Map V [m^2] of this frame, after all other terms; ``chosen`` gathers the same pixels from a map."""
        return variance

    def outputs(self) -> dict[str, Tensor]:
        """Further maps for :class:`~ufmstar_torch.frames.output.UfMStarOutput`, by name."""
        return {}


class Extension:
    """An extension of UfM*.

    Attributes:
        argument: name of its keyword argument of ``UfMStar.forward``, "" = none.
        always_float64: names of the tensors that stay float64.
    """

    argument: ClassVar[str] = ""
    always_float64: ClassVar[tuple[str, ...]] = ()

    def require(self, config: UfMStarConfig) -> None:
        """Raise a ValueError unless the extension fits the config."""

    def require_state(self, state: Tensors) -> None:
        """Raise a ValueError unless a run could have produced its tensors. The caller has checked their shapes and that
        they are finite."""

    def by_component(
        self, streams: int, slots: int, dtype: torch.dtype, device: torch.device | str
    ) -> dict[str, Tensor]:
        """Its tensors [B, K, C] in the empty state: sums over the observations of each component, row k for slot k."""
        return {}

    def by_stream(self, streams: int, dtype: torch.dtype, device: torch.device | str) -> dict[str, Tensor]:
        """Its tensors [B, C] in the empty state that describe a stream as a whole."""
        return {}

    def of_frame(
        self,
        frame: FrameInput,
        network_variances: Sequence[Tensor],
        argument: Any,
        before: Sequence[FrameExtension],
        *,
        dense: bool,
    ) -> FrameExtension:
        """The extension during a frame.

        Args:
            frame: checked.
            network_variances: the network's variances that are added to M, A and E [B, H, W] [m^2].
            argument: value of its keyword argument (attribute ``argument``), or None.
            before: the preceding extensions during the same frame.
            dense: whether the whole map is regressed.

        Raises:
            TypeError, ValueError: ``argument`` is invalid.
        """
        return FrameExtension()

    def map_variance(self, variance: Tensor) -> Tensor:
        """Map V [m^2], after all other terms."""
        return variance


@dataclass(frozen=True)
class FrameExtensions:
    """All extensions during one frame, in order."""

    each: Sequence[FrameExtension] = ()
    _shifts: list[Tensor] = field(default_factory=list)

    @property
    def columns(self) -> int:
        """Total number of columns."""
        return sum(one.columns for one in self.each)

    @property
    def changes_mixture(self) -> bool:
        """True if any extension may change the mixture after the frame."""
        return any(one.changes_mixture for one in self.each)

    def before_regression(
        self, tensors: Tensors, mixture_cam: GaussianMixture, distribute: Distribute
    ) -> tuple[dict[str, Tensor], GaussianMixture]:
        """The changed tensors, and the mixture with the columns appended to its features."""
        after, features = dict[str, Tensor](), [mixture_cam.features]
        for one in self.each:
            if one.columns:
                columns = one.before_regression(tensors, mixture_cam, distribute)
                after |= columns.tensors
                features.append(columns.values.to(mixture_cam.features.dtype))
                self._shifts.append(columns.shift)
        return after, mixture_cam.replace(features=torch.cat(features, -1)) if self._shifts else mixture_cam

    def in_view(
        self, tensors: Tensors, capacity: int, seen: Any, views: Any
    ) -> tuple[dict[str, Tensor], Tensor] | None:
        """As :meth:`FrameExtension.in_view`, if exactly one extension has columns: the changed tensors, and the shift
        [B, C], which the regression then adds. None: use :meth:`before_regression`."""
        with_columns = [one for one in self.each if one.columns]
        if len(with_columns) != 1:
            return None
        columns = with_columns[0].in_view(tensors, capacity, seen, views)
        return None if columns is None else (columns.tensors, columns.shift)

    def after_regression(self, result: Regression) -> Regression:
        """Pass each extension its columns, the last features. Adds the shifts unless the regression has added them."""
        if not self.columns:
            return result
        first = result.features.shape[-1] - self.columns
        values = result.features[..., first:]
        if self._shifts:
            shift = torch.cat(self._shifts, -1).to(values.dtype)
            values = values + shift.view(-1, *[1] * (values.dim() - 2), self.columns)
        for one, part in zip(self.each, values.split([one.columns for one in self.each], -1), strict=True):
            if one.columns:
                one.after_regression(part)
        return replace(result, features=result.features[..., :first])

    def after_frame(self, state: UfMStarState, out: StepOutput, total: Total) -> tuple[UfMStarState, StepOutput]:
        """See :meth:`FrameExtension.after_frame`."""
        for one in self.each:
            state, out = one.after_frame(state, out, total)
        return state, out

    def disagreement(self, disagreement: Tensor, depth: Tensor) -> Tensor:
        """See :meth:`FrameExtension.disagreement`."""
        for one in self.each:
            disagreement = one.disagreement(disagreement, depth)
        return disagreement

    def map_variance(self, variance: Tensor, chosen: Chosen) -> Tensor:
        """See :meth:`FrameExtension.map_variance`."""
        for one in self.each:
            variance = one.map_variance(variance, chosen)
        return variance

    def outputs(self) -> dict[str, Tensor]:
        """See :meth:`FrameExtension.outputs`."""
        return {name: value for one in self.each for name, value in one.outputs().items()}


NONE = FrameExtensions()


class Extensions:
    """The extensions of a module, in order."""

    def __init__(self, each: Sequence[Extension], config: UfMStarConfig) -> None:
        for one in each:
            one.require(config)
        self.each = tuple(each)

    def require_state(self, state: Tensors) -> None:
        """See :meth:`Extension.require_state`."""
        for one in self.each:
            one.require_state(state)

    @property
    def always_float64(self) -> tuple[str, ...]:
        """Names of the tensors that stay float64."""
        return tuple(name for one in self.each for name in one.always_float64)

    def initial(
        self, streams: int, config: UfMStarConfig, dtype: torch.dtype, device: torch.device | str
    ) -> UfMStarState:
        """The empty state of ``streams`` independent streams."""
        state = UfMStarState.initial(streams, config, dtype, device)
        slots = state.weight.shape[1]
        return replace(
            state,
            by_component={
                n: v for one in self.each for n, v in one.by_component(streams, slots, dtype, device).items()
            },
            by_stream={n: v for one in self.each for n, v in one.by_stream(streams, dtype, device).items()},
        )

    def of_frame(
        self, frame: FrameInput, network_variances: Sequence[Tensor], inputs: Mapping[str, Any], *, dense: bool
    ) -> FrameExtensions:
        """All extensions during a frame.

        Raises:
            TypeError: an unknown argument, or as :meth:`Extension.of_frame`.
            ValueError: an argument of an extension that is off, or as :meth:`Extension.of_frame`.
        """
        arguments = {one.argument for one in self.each}
        for name in sorted(inputs.keys() - arguments):
            if name not in UfMStarConfig.__dataclass_fields__:
                raise TypeError(f"UfM* takes no argument {name!r}")
            if inputs[name] is not None:
                raise ValueError(f"{name} must be None where UfMStarConfig.{name} is None, which switches it off")
        each: list[FrameExtension] = []
        for one in self.each:
            each.append(one.of_frame(frame, network_variances, inputs.get(one.argument), each, dense=dense))
        return FrameExtensions(each) if each else NONE

    def map_variance(self, variance: Tensor) -> Tensor:
        """Map V [m^2], after all other terms."""
        for one in self.each:
            variance = one.map_variance(variance)
        return variance

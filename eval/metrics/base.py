"""The base of all metrics: states are float64 or int64 sums, which the state_dict saves and which can be merged."""

from __future__ import annotations

import math
from abc import abstractmethod
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from functools import cached_property
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np
import torch
from torch import Tensor, nn

COUNT, SUM = torch.int64, torch.float64  # kinds of states
TOLERANCE = 0.25  # [1] of delta1, in both definitions
# Bins of equal width in the logarithm of a variance or squared error [m^2], and their range: (0.1 mm)^2 to (100 m)^2.
# One bin below has all smaller values and 0, one bin above all larger ones. Relative errors use the same bins.
BINS = 4096
LOW, HIGH = 1e-8, 1e4


class Selection:
    """Some of the pixels, and what several metrics compute from them, once. On the CPU only the selected values are
    computed. On other devices, where their number is unknown without waiting, they are all pixels, with 1 where
    ``mask`` is False. Iterating yields d, v and g.

    Args:
        pixels: all of them.
        mask: [P] True = selected.
    """

    def __init__(self, pixels: Pixels, mask: Tensor) -> None:
        self._pixels, self._selected = pixels, dict[str, Tensor]()
        self.mask: Tensor | None = None
        self._index: Tensor | None = None
        if not _compacts(mask.device):
            self.mask = mask
        elif not bool(mask.all()):
            self._index = torch.from_numpy(np.flatnonzero(mask.numpy()))  # torch's takes six times as long

    def map(self, name: str) -> Tensor:
        """The values of one of the maps of :class:`Pixels`, flat and float64, selected when they are first read."""
        if name not in self._selected:
            values: Tensor = getattr(self._pixels, name)
            if self._index is not None and len(values):
                values = values.index_select(0, self._index)
            elif self.mask is not None and len(values):
                values = values.masked_fill(~self.mask, 1.0)
            self._selected[name] = values.double()
        return self._selected[name]

    def __iter__(self) -> Iterator[Tensor]:
        return map(self.map, ("depth", "variance", "target"))

    def where(self, condition: Tensor) -> Selection:
        """The selected pixels with a condition on their values."""
        if self.mask is not None:
            return Selection(self._pixels, condition & self.mask)
        if bool(condition.all()):
            return self
        every = torch.zeros_like(self._pixels.use) if self._index is not None else condition
        if self._index is not None:
            every[self._index] = condition
        return Selection(self._pixels, every)

    def number(self, condition: Tensor | None = None) -> Tensor:
        """[] int64 number of the selected pixels, or of those with a condition [P]."""
        if condition is None:
            return torch.tensor(len(self.map("depth"))) if self.mask is None else self.mask.sum()
        return (condition if self.mask is None else condition & self.mask).count_nonzero()

    def total(self, value: Tensor) -> Tensor:
        """[] sum of a value [P] over the selected pixels."""
        return (value if self.mask is None else value.masked_fill(~self.mask, 0.0)).sum()

    def histogram(self, index: Tensor, bins: int, value: Tensor | None = None) -> Tensor:
        """[bins] by an index [P] in [0, bins): number of the selected pixels, or sum of their ``value`` [P]."""
        if self.mask is None:
            return torch.bincount(index, value, bins)
        values = self.mask.long() if value is None else value.masked_fill(~self.mask, 0.0)
        return torch.zeros(bins, dtype=values.dtype, device=values.device).scatter_add_(0, index, values)

    def parted(self, index: Tensor, bins: int, condition: Tensor) -> tuple[Tensor, Tensor]:
        """[bins] numbers of all selected pixels, and of those with a condition [P], by an index [P] in [0, bins)."""
        counts = self.histogram(2 * index + condition, 2 * bins).reshape(bins, 2)
        return counts.sum(1), counts[:, 1]

    @cached_property
    def error(self) -> Tensor:
        """|d - g| [m]."""
        return (self.map("depth") - self.map("target")).abs()

    @cached_property
    def squared(self) -> Tensor:
        """|d - g|^2 [m^2]."""
        return self.error.square()

    @cached_property
    def relative(self) -> Tensor:
        """|d - g| / g."""
        return self.error / self.map("target")

    @cached_property
    def sigma(self) -> Tensor:
        """Root of v [m]."""
        return self.map("variance").sqrt()

    @cached_property
    def variance_bins(self) -> Tensor:
        """``log_bin`` of v."""
        return log_bin(self.map("log_variance"))

    @cached_property
    def squared_bins(self) -> Tensor:
        """``log_bin`` of |d - g|^2."""
        return log_bin(self.squared.log())

    @cached_property
    def within(self) -> Tensor:
        """True where |d - g| <= ``TOLERANCE`` g."""
        return self.error <= TOLERANCE * self.map("target")

    @cached_property
    def certain(self) -> Selection:
        """Those with v > 0."""
        return self.where(self.map("variance") > 0)


def _compacts(device: torch.device) -> bool:
    """True on the CPU, where selecting pixels needs no wait for a device."""
    return device.type == "cpu"


@dataclass(frozen=True, eq=False)
class Pixels:
    """The pixels of one or more frames, flat, in the maps' types and on their device. Ground truth is valid if positive
    and finite, a depth if finite, a variance if finite and not negative."""

    depth: Tensor  # [P] d [m]
    variance: Tensor  # [P] v [m^2]; [0] without one
    target: Tensor  # [P] g [m]
    use: Tensor  # [P] bool, True = use
    inlier: Tensor  # [P] variance of a mixture's inliers [m^2]; [0] without a mixture
    outlier: Tensor  # [P] probability of an outlier; [0] without a mixture
    level: Tensor  # [P] of the smallest central interval with the ground truth in it, NaN = none; [0] without intervals

    @cached_property
    def with_truth(self) -> Tensor:
        """[P] True where there is ground truth."""
        return self.use & (self.target > 0) & (self.target < torch.inf)

    @cached_property
    def predicted(self) -> Tensor:
        """[P] True where there are depth and variance."""
        return self.use & (self.depth.abs() < torch.inf) & (self.variance >= 0) & (self.variance < torch.inf)

    @cached_property
    def log_variance(self) -> Tensor:
        """[P] ln v in float64; -inf for 0."""
        return self.variance.double().log()

    @cached_property
    def depths(self) -> Selection:
        """The pixels where d and g are valid."""
        return Selection(self, self.with_truth & (self.depth.abs() < torch.inf))

    @cached_property
    def judged(self) -> Selection:
        """The pixels where d, v and g are valid."""
        v = self.depths.map("variance")
        return self.depths.where((v >= 0) & (v < torch.inf))


class SumMetric(nn.Module):
    """A metric whose states are sums of fixed size, over the pixels with ground truth and a valid prediction.

    ``compute()`` returns the figures of all updates as float64 tensors by name: scalars and curves [B]. States reduce
    by addition (``merge_state``). Counts are int64 and exact; float64 sums depend on the order of the updates in the
    last bits only. ``update`` computes on the maps' device, without a transfer if the metric is on it too
    (``.to(device)``). MPS has no float64: keep the maps on the CPU there.

    Attributes:
        OF_VARIANCE: the name, in messages, of a metric that needs a variance; "" if it needs depth alone.
        NEEDS: the part of ``Pixels`` without which ``SequenceMetrics`` leaves the metric out; "" = it needs none.
        STATES: name, ``COUNT`` or ``SUM``, and sizes of the dimensions of each state; initially zeros.
        CONSTANTS: tensors by name, as edges of bins, that move to the metric's device and are not saved.
        settings: of the instance; sums with other settings cannot be merged.
    """

    OF_VARIANCE: ClassVar[str] = ""
    NEEDS: ClassVar[str] = ""
    STATES: tuple[tuple[Any, ...], ...] = ()
    CONSTANTS: Mapping[str, Tensor] = MappingProxyType({})
    settings: Mapping[str, Any] = MappingProxyType({})

    if TYPE_CHECKING:

        def __getattr__(self, name: str) -> Tensor:
            """The type of the states, which are not in ``__dict__``."""

    def __init__(self, **kwargs: Any) -> None:
        super().__init__(**kwargs)
        for name, kind, *shape in self.STATES:
            self._hold(name, torch.zeros(shape, dtype=kind))
        for name, value in self.CONSTANTS.items():
            self.register_buffer(name, value.clone(), persistent=False)

    def _hold(self, name: str, zeros: Tensor) -> None:
        """Add a state."""
        self.register_buffer(name, zeros)

    def update(self, depth: Tensor, variance: Tensor | None, target: Tensor, valid: Tensor | None = None) -> None:
        """Add frames: maps of one shape [...] in m and m^2, ``valid`` True = use. Raises ValueError: shapes or types
        disagree, or a needed variance is missing."""
        self.add(flat_pixels(depth, variance, target, valid))

    def add(self, pixels: Pixels) -> None:
        """Add pixels. Raises ValueError: a needed variance is missing."""
        if self.OF_VARIANCE and len(pixels.variance) != len(pixels.depth):
            judged = f"{self.OF_VARIANCE} judges the predicted distribution N(depth, variance)"
            raise ValueError(f"variance must be given: {judged}")
        self._add(self.sums(pixels))

    def _add(self, sums: Mapping[str, Tensor]) -> None:
        """Add to the states, in place, since Spearman's takes 2 MB; those made in inference mode are replaced."""
        for name, added in sums.items():
            state = getattr(self, name)
            added = added.to(state.device, state.dtype)
            setattr(self, name, state + added if state.is_inference() else state.add_(added))

    @abstractmethod
    def sums(self, pixels: Pixels) -> Mapping[str, Tensor]:
        """The pixels' contribution to each state, by name; not the states themselves. On a GPU it must not wait for a
        value, so it selects pixels by ``Selection``."""

    @abstractmethod
    def compute(self) -> Mapping[str, Tensor]:
        """The figures by name."""

    def reset(self) -> None:
        """Forget all frames."""
        for name, *_ in self.STATES:
            setattr(self, name, torch.zeros_like(getattr(self, name)))

    def merge_state(self, incoming_state: SumMetric) -> None:
        """Add another metric's sums to this one's. Raises ValueError: the other metric has other settings."""
        if incoming_state.settings != self.settings:
            raise ValueError(
                f"incoming_state must come from a metric with the settings {self.settings}, "
                f"got {incoming_state.settings}"
            )
        self._add({name: getattr(incoming_state, name) for name, *_ in self.STATES})


def flat_pixels(
    depth: Tensor, variance: Tensor | None, target: Tensor, valid: Tensor | None = None,
    mixture: tuple[Tensor, Tensor] | None = None, level: Tensor | None = None,
) -> Pixels:  # fmt: skip
    """All pixels of maps of one shape [...].

    Args:
        depth: predicted depth d [m]; not finite = no prediction.
        variance: predicted variance v [m^2], or None; not finite or < 0 = no prediction.
        target: ground truth [m]; NaN, infinite or <= 0 means there is none.
        valid: bool, True = use; None = everywhere.
        mixture: variance of the inliers [m^2] and probability of an outlier; None = no mixture.
        level: of the smallest central interval with the ground truth in it; None = no intervals.

    Raises:
        TypeError: an argument is no dense tensor.
        ValueError: an argument has another shape or device than ``depth``, or the wrong dtype.
    """
    inlier, outlier = mixture or (None, None)
    maps = {"depth": depth, "variance": variance, "target": target, "valid": valid}
    for name, value in (maps | {"inlier": inlier, "outlier": outlier, "level": level}).items():
        if value is None and name not in ("depth", "target"):
            continue
        if not isinstance(value, Tensor) or value.layout != torch.strided:
            raise TypeError(f"{name} must be a dense torch.Tensor, got {type(value).__name__}")
        if value.device != depth.device:
            raise ValueError(f"{name} must lie on the depth's device {depth.device}, got {value.device}")
        if value.shape != depth.shape:
            raise ValueError(f"{name} must have the depth's shape {tuple(depth.shape)}, got {tuple(value.shape)}")
        if name == "valid" and value.dtype != torch.bool:
            raise ValueError(f"valid must be a bool mask (True = use), got {value.dtype}")
        if name != "valid" and not torch.is_floating_point(value):
            raise ValueError(f"{name} must be floating point, got {value.dtype}")

    def flat(value: Tensor | None) -> Tensor:
        return depth.new_zeros(0) if value is None else value.detach().flatten()

    use = depth.new_ones(depth.numel(), dtype=torch.bool) if valid is None else valid.flatten()
    return Pixels(flat(depth), flat(variance), flat(target), use, flat(inlier), flat(outlier), flat(level))


def log_bin(log: Tensor) -> Tensor:
    """Bins in [0, BINS + 1] of values with the logarithm ``log``: 0 below ``LOW``, BINS + 1 from ``HIGH`` on."""
    return ((log - math.log(LOW)) * (BINS / math.log(HIGH / LOW)) + 1).clamp(0, BINS + 1).long()


def share(part: Tensor, whole: Tensor) -> Tensor:
    """part / whole in float64, NaN where whole is 0."""
    return part.double() / whole.double()

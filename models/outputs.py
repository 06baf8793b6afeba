"""The meaning of a network's raw outputs: which one is depth, in which unit, and which are variances.

UfM* compares 3D points of different views, so depth must be metric. Declaring inverse depth, disparity or depth up to
scale (and shift) raises.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal, Self, get_args

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

from ufmstar_torch.frames.arguments import as_tensor
from ufmstar_torch.frames.prediction import DepthPrediction
from ufmstar_torch.models.preprocess import Preprocess
from ufmstar_torch.runtime.checked import Checked, choice, number, section

METRIC = "metric"
Spread = Literal["variance", "std", "log_variance", "log_std", "relative_std"]
SPREADS = get_args(Spread)
PlainSpec = Mapping[str, Any] | str | Path  # the values of a spec, or a JSON file of them
NOT_METRIC = ("inverse", "disparity", "relative", "affine")


@dataclass(frozen=True)
class OutputSpec(Checked):
    """The meaning of a network's outputs.

    Attributes:
        kind: of the depth output. Only "metric" (along the optical axis) is allowed; it has no default, so that it must
            be declared.
        depth: name of the depth output (or its position, for a network that returns a tuple); None for a network with
            only one output.
        scale: [m] length of one unit of the depth output, .001 for millimetres.
        focal: [px] focal length for which the depth output holds; None = every camera. Depth, and spreads in its units,
            are multiplied by f / ``focal``, with f = (fx + fy) / 2 of the network's input (300 for Depth Anything 3's
            metric networks, 1000 for Metric3D), which requires the intrinsics.
        aleatoric, epistemic: names of the outputs with the learned data and model variance, if any.
        aleatoric_kind, epistemic_kind: "variance", "std", "log_variance" or "log_std" (natural logarithms), in the
            units of the depth output; or "relative_std", a standard deviation over the depth (to first order that of
            the logarithm of depth). "confidence" is not allowed, since it is not a spread: use ``confidence``.
        confidence: name of an output of any unit that ranks the pixels, a confidence or an uncertainty; its relation to
            the variance is learnt from anchors (``ufmstar_torch.anchors.confidence``).
        max_depth: [m] largest depth that the network can predict: ``UncertainDepth`` and the commands ignore pixels
            beyond it; None = unknown.
        resize: resize outputs of another resolution to that of the input, by nearest-neighbour sampling; otherwise such
            outputs raise.

    Raises:
        ValueError: a field is out of range, or the depth is not metric.
    """

    kind: str
    depth: str | int | None = None
    scale: float = number(1.0, "", "m", 0.0, open_low=True, open_high=True)
    aleatoric: str | int | None = None
    aleatoric_kind: str = choice(*SPREADS)
    epistemic: str | int | None = None
    epistemic_kind: str = choice(*SPREADS)
    confidence: str | int | None = None
    resize: bool = False
    focal: float | None = number(None, "f", "px", 0.0, open_low=True, open_high=True)
    max_depth: float | None = number(None, "d_max", "m", 0.0, open_low=True, open_high=True)

    def __post_init__(self) -> None:
        if self.kind in NOT_METRIC:
            raise ValueError(
                f"the depth output is declared {self.kind!r}, but UfM* needs metric depth: it compares 3D points of "
                "several views, and without a common scale in metres their disagreement means nothing. In Python, "
                "AlignedNetwork(network, Alignment('inverse', scale, shift)) makes it metric: 1/d = scale x + shift"
            )
        if self.kind != METRIC:
            raise ValueError(f"OutputSpec.kind must be {METRIC!r} (refused: {NOT_METRIC}), got {self.kind!r}")
        if "confidence" in (self.aleatoric_kind, self.epistemic_kind):
            raise ValueError(
                f"a confidence is no spread of depth: it ranks pixels only, declare it as confidence=NAME; spreads are "
                f"{SPREADS}"
            )
        super().__post_init__()

    def names(self) -> list[str | int]:
        """The declared names."""
        return [name for name in (self.depth, self.aleatoric, self.epistemic, self.confidence) if name is not None]

    def prediction(
        self, result: Any, image: Tensor, intrinsics: Tensor | None = None, *, require_depth: bool = False
    ) -> DepthPrediction:
        """The declared outputs in metres.

        Args:
            result: of the network: a tensor or array [B, 1, H, W], [B, H, W, 1] or [B, H, W]; several in a mapping,
                a tuple or an object.
            image: [B, 3, H, W] the network's input, whose size the prediction must have.
            intrinsics: [B, 3, 3] of that input [px], for ``focal``.
            require_depth: raise if no pixel has a depth; on the CPU only, since the test would synchronise with an
                accelerator.

        Raises:
            ValueError: a declared output is missing or has another shape, ``focal`` without intrinsics, or see
                ``require_depth``.
        """
        outputs = _named(result)
        if self.depth is None and len(outputs) != 1:
            raise ValueError(f"the network returns {list(outputs)}; declare which one is depth")
        depth_name = next(iter(outputs)) if self.depth is None else self.depth
        size = (len(image), image.shape[-2], image.shape[-1])
        depth = self._map(outputs, depth_name, size)
        tested = require_depth and depth.device.type == "cpu" and depth.numel()
        if tested and not ((depth >= 0) & (depth < torch.inf)).any():
            raise ValueError(f"output {depth_name!r} is NaN, infinite or negative at every pixel, expected depth")
        unit = self._unit(intrinsics, depth)
        depth = depth * unit
        aleatoric = self._variance(outputs, self.aleatoric, self.aleatoric_kind, depth, unit)
        epistemic = self._variance(outputs, self.epistemic, self.epistemic_kind, depth, unit)
        confidence = None if self.confidence is None else self._map(outputs, self.confidence, size)
        return DepthPrediction(depth, aleatoric, epistemic, confidence)

    def _unit(self, intrinsics: Tensor | None, depth: Tensor) -> float | Tensor:
        """[m] length of one unit of the depth output: a number, or [B, 1, 1] if it depends on the camera."""
        if self.focal is None:
            return self.scale
        if intrinsics is None:
            raise ValueError(
                f"OutputSpec.focal={self.focal:g} needs the intrinsics of the network's input: call network(x, K)"
            )
        K = intrinsics.to(depth.device, torch.promote_types(depth.dtype, torch.float32))
        return self.scale / self.focal * (K[..., 0, 0, None, None] + K[..., 1, 1, None, None]) / 2

    def _variance(
        self,
        outputs: Mapping[str | int, Tensor],
        name: str | int | None,
        kind: str,
        depth: Tensor,
        unit: float | Tensor,
    ) -> Tensor | None:
        """[B, H, W] [m^2], or None if not declared; ``depth`` [B, H, W] [m], ``unit`` as :meth:`_unit`."""
        if name is None:
            return None
        spread = self._map(outputs, name, tuple(depth.shape))
        if kind == "relative_std":
            return (spread * depth).square()
        spread = spread.exp() if kind.startswith("log_") else spread
        return (spread.square() if kind.endswith("std") else spread) * unit**2

    def _map(self, outputs: Mapping[str | int, Tensor], name: str | int, size: tuple[int, ...]) -> Tensor:
        """One output as [B, H, W] = ``size``, in its own units."""
        if name not in outputs:
            raise ValueError(f"the network has no output {name!r}; it has {list(outputs)}")
        value = as_map(outputs[name], f"output {name!r}")
        if len(value) != size[0]:
            raise ValueError(f"output {name!r} holds {len(value)} maps for {size[0]} images")
        if value.shape == size:
            return value
        if not self.resize:
            raise ValueError(
                f"output {name!r} has {tuple(value.shape[1:])} px, expected the input's {size[1:]}, since it is used "
                "with the input's intrinsics; set resize=True to resize it"
            )
        return F.interpolate(value[:, None], size[1:], mode="nearest-exact")[:, 0]


def _named(result: Any) -> dict[str | int, Tensor]:
    """The tensors (or NumPy arrays) in a network's result, by name or position."""
    if isinstance(result, Tensor | np.ndarray):
        return {"depth": as_tensor("the network's output", result)}
    if isinstance(result, (tuple, list)):
        result = dict(enumerate(result))
    elif not isinstance(result, Mapping):
        if not hasattr(result, "__dict__"):
            raise ValueError(f"a network must return tensors or a DepthPrediction, got {type(result).__name__}")
        result = vars(result)
    arrays = {name: value for name, value in result.items() if isinstance(value, Tensor | np.ndarray)}
    return {name: as_tensor(f"the network's output {name!r}", value) for name, value in arrays.items()}


def as_map(value: Any, name: str) -> Tensor:
    """Convert a tensor [B, 1, H, W], [B, H, W, 1] or [B, H, W] of numbers to floating-point [B, H, W]; half precision
    is preserved. Raises ValueError: another type or shape; the message contains ``name``."""
    if not isinstance(value, Tensor) or value.is_complex() or value.dtype == torch.bool:
        kind = value.dtype if isinstance(value, Tensor) else type(value).__name__
        raise ValueError(f"{name} must be a tensor of numbers, got {kind}")
    shape = tuple(value.shape)
    if value.dim() == 4 and 1 in (shape[1], shape[3]):
        value = value[:, 0] if shape[1] == 1 else value[..., 0]
    if value.dim() != 3:
        raise ValueError(f"{name} must be [B, 1, H, W], [B, H, W, 1] or [B, H, W], got {shape}")
    return value if value.is_floating_point() else value.to(torch.get_default_dtype())


@dataclass(frozen=True)
class ProgramSpec(Checked):
    """Declarations that the file of a saved program does not contain, in JSON for instance::

        {"preprocess": {"resize_height": 250, "crop": [228, 304], "size": [224, 224]},
         "outputs": {"kind": "metric", "scale": 1.0}}

    Attributes:
        outputs: depth output and its unit; and the variances, if any.
        preprocess: preprocessing of the input; None: the image in [0, 1], not resized.
        takes_intrinsics: the program has a second input, the intrinsics [B, 3, 3] [px] of the first.

    Raises:
        ValueError: a field is out of range.
    """

    outputs: OutputSpec = field(metadata={"section": OutputSpec, "optional": False})
    preprocess: Preprocess | None = section(Preprocess, optional=True, on=False)
    takes_intrinsics: bool = False

    @classmethod
    def required(cls, spec: Self | PlainSpec | None) -> Self:
        """As :meth:`read`; raises an explanation if ``spec`` is None."""
        if spec is None:
            raise ValueError(
                "this network needs a spec, which declares the meaning of its output; for metric depth in metres "
                '{"outputs": {"kind": "metric"}}'
            )
        return cls.read(spec)

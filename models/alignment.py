"""Scale and shift that make relative depth metric, fitted to sparse measurements.

Relative networks (MiDaS, Depth Anything without "Metric") predict inverse depth up to a scale and a shift,
1/d = scale x + shift; others predict depth up to both, d = scale x + shift, or up to scale (shift = 0). This module
fits the two numbers to measured depth.

UfM* compares views, so all views need the same alignment: fit it once, on the first frames (``pooled=True``). With an
alignment per frame, its errors would count as disagreement, and the network's frame-to-frame error of scale would be
removed.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import torch
from torch import Tensor, nn

from ufmstar_torch.frames.arguments import require_float, require_mask, require_number, require_whole
from ufmstar_torch.frames.prediction import DepthPrediction, infer
from ufmstar_torch.models.network import DepthNetwork
from ufmstar_torch.models.outputs import as_map
from ufmstar_torch.models.preprocess import Preprocess
from ufmstar_torch.runtime.checked import Checked, number
from ufmstar_torch.runtime.kinds import check_kinds, require

KINDS = ("inverse", "affine")
# Reweighted fits: with a third of outliers on one side, each fit reduces the error to .85, and 25 to less than .02.
_REWEIGHTED = 25
# Most fits to the inliers; their set converges after a few.
_TRIMMED = 15
# Huber's constant in standard deviations (95 % efficiency under normal errors), and the usual cut of an inlier.
_HUBER, _CUT = 1.345, 3.0
# Standard deviation of a normal residual per median of its magnitude.
_MAD_TO_STD = 1.4826
# [1] Smallest standard deviation of the residuals, over the median value: the float64 rounding of exact data gives no
# outliers.
_ROUNDING = 1e-9
# Smallest variance of x over its mean square: a relative spread of 1e-5, at which the resolution of float32 predictions
# (1e-7) still determines a slope to 1 %.
_RANK = 1e-10


@dataclass(frozen=True, eq=False)
class Alignment(Checked):
    """Scale and shift that make a relative prediction x metric: 1/d or d is scale x + shift.

    Attributes:
        kind: "inverse" (1/d, units 1/m) or "affine" (d, units m).
        scale: [] for all images, or [B] for each image of a batch; > 0. May be a number.
        shift: as ``scale``.
        max_depth: [m] farther pixels are invalid; None = no limit. Where the inverse depth is nearly 0 (sky), a small
            error of the shift moves a pixel by kilometres.

    Raises:
        ValueError: another kind, values that are not finite, a scale that is not positive, different shapes.
    """

    kind: str = field(metadata={"choices": KINDS})
    scale: Tensor
    shift: Tensor
    max_depth: float | None = number(None, "d_max", "m", 0.0, open_low=True)

    def __post_init__(self) -> None:
        super().__post_init__()
        for name in ("scale", "shift"):
            try:
                value = torch.as_tensor(getattr(self, name), dtype=torch.float64)
            except (TypeError, ValueError, RuntimeError, OverflowError) as error:
                raise TypeError(f"Alignment.{name} must be a number or [B], got {getattr(self, name)!r:.60}") from error
            object.__setattr__(self, name, value)
            if not value.isfinite().all():
                raise ValueError(f"Alignment.{name} must be finite, got {value.tolist()}")
        if self.scale.dim() > 1 or self.scale.shape != self.shift.shape:
            shapes = f"{tuple(self.scale.shape)} and {tuple(self.shift.shape)}"
            raise ValueError(f"Alignment.scale and .shift must both be numbers or both [B], got {shapes}")
        if not (self.scale > 0).all():
            raise ValueError(f"Alignment.scale must be positive, got {self.scale.tolist()}")

    def to_dict(self) -> dict[str, Any]:
        """Plain values, without rounding."""
        return {**super().to_dict(), "scale": self.scale.tolist(), "shift": self.shift.tolist()}

    def depth(self, prediction: Tensor) -> Tensor:
        """Depth [B, H, W] [m]; 0 (no prediction, for UfM*) where it is not :meth:`valid`.

        Args:
            prediction: [B, H, W] floating-point, the network's output.

        Raises:
            ValueError: another shape, or another number of images than alignments.
        """
        require_maps("prediction", prediction)
        scale, shift = self.scale, self.shift  # tensors [] work with every device
        if scale.dim():
            if len(scale) != len(prediction):
                raise ValueError(f"prediction must have the alignment's {len(scale)} images, got {len(prediction)}")
            scale, shift = (v.to(prediction.device, prediction.dtype)[:, None, None] for v in (scale, shift))
        value = scale * prediction + shift
        depth = value if self.kind == "affine" else 1 / torch.where(value > 0, value, 1)
        possible = (value > 0) & (depth < torch.inf)
        if self.max_depth is not None:
            possible = possible & (depth <= self.max_depth)
        return torch.where(possible, depth, 0)

    def valid(self, prediction: Tensor) -> Tensor:
        """[B, H, W] True where the aligned depth is finite, positive and at most ``max_depth``. Errors: :meth:`depth`.

        ``(~alignment.valid(x)).sum((1, 2))`` counts the lost pixels of an image; many indicate a wrong shift.
        """
        return self.depth(prediction) > 0


@dataclass(frozen=True, eq=False)
class AlignmentFit:
    """An alignment and its statistics; [] instead of [B] for pooled images."""

    alignment: Alignment  # the result
    points: Tensor  # [B] usable measurements
    inliers: Tensor  # [B] measurements in the final fit
    residual: Tensor  # [B] root mean square over the inliers of the difference in inverse depth [1/m] or depth [m]


class AlignedNetwork(DepthNetwork):
    """Metric depth from a network that predicts it up to scale (and shift).

    Args:
        network: image [B, 3, H, W] -> relative depth [B, H, W] or [B, 1, H, W].
        alignment: the same for every frame (see the module).
        preprocess: the network's preprocessing; None: images in [0, 1], not resized.
    """

    @check_kinds
    def __init__(self, network: nn.Module, alignment: Alignment, preprocess: Preprocess | None = None) -> None:
        super().__init__()
        self.network = network
        self.alignment = alignment
        self.preprocess = preprocess or Preprocess()

    @property
    def wrapped(self) -> tuple[nn.Module]:
        """The relative network."""
        return (self.network,)

    @property
    def max_depth(self) -> float | None:
        """[m] The alignment's largest depth; farther pixels have no prediction."""
        return self.alignment.max_depth

    def forward(self, image: Tensor, intrinsics: Tensor | None = None) -> DepthPrediction:
        """Depth [B, H, W] [m] of ``image`` [B, 3, H, W] with ``intrinsics`` [B, 3, 3] [px]; 0 (no prediction) where the
        aligned depth is not valid. Raises ValueError: the network returns another shape."""
        relative = as_map(infer(self.network, image, intrinsics), "the network's relative depth")
        if relative.shape[-2:] != image.shape[-2:]:
            raise ValueError(f"network must return {tuple(image.shape[-2:])} px, got {tuple(relative.shape)}")
        if relative.dtype in (torch.float16, torch.bfloat16):
            relative = relative.float()  # half precision does not resolve scales of 1e-3 and less
        return DepthPrediction(self.alignment.depth(relative))


@check_kinds
def fit_inverse_depth(
    prediction: Tensor, depth: Tensor, valid: Tensor | None = None, *, shift: float | None = None, **options: Any
) -> AlignmentFit:
    """Scale and shift with 1/depth = scale prediction + shift, by least squares in inverse depth.

    Args:
        prediction: [B, H, W] inverse depth up to scale and shift.
        depth: [B, H, W] measured depth [m] at the same pixels (LiDAR, SLAM points, a depth sensor); pixels without a
            finite positive value are not used.
        valid: [B, H, W] bool, True = use; None = all measurements.
        shift: [1/m] fixed value (0: the prediction is inverse depth up to scale); None = fitted.
        options: weights [B, H, W], inverse variances of 1/depth (or depth) up to a factor, 0 = do not use; equal
            weights (default) suit stereo and structured light in inverse depth; for a constant error in depth, use
            depth**4.
            pooled: one alignment for all images, as UfM* needs it, instead of one for each (default).
            robust: reject outliers, up to about a third of the points (default); False: plain least squares.
            min_points: least usable measurements (per image, or in total if pooled); default 10.
            max_depth: [m] of the resulting alignment; default: no limit.

    Raises:
        ValueError: wrong shapes or types, too few measurements, nearly constant predictions, or a negative fitted
            scale, as for a network that predicts depth; the message names the image.
    """
    return _fit("inverse", prediction, depth, valid, shift, **options)


@check_kinds
def fit_affine_depth(
    prediction: Tensor, depth: Tensor, valid: Tensor | None = None, *, shift: float | None = 0.0, **options: Any
) -> AlignmentFit:
    """Scale (and shift) with depth = scale prediction + shift [m], by least squares in depth.

    As :func:`fit_inverse_depth`, for networks whose output grows with distance. ``shift`` is in metres and 0 by default
    (None = fitted), since most such networks lack only the scale.
    """
    return _fit("affine", prediction, depth, valid, shift, **options)


def _fit(
    kind: str,
    prediction: Tensor,
    depth: Tensor,
    valid: Tensor | None,
    shift: float | None,
    *,
    weights: Tensor | None = None,
    pooled: bool = False,
    robust: bool = True,
    min_points: int = 10,
    max_depth: float | None = None,
) -> AlignmentFit:
    for name, value in (("prediction", prediction), ("depth", depth)):
        require_float(name, value)
    if valid is not None:
        require_mask("valid", valid, [tuple(depth.shape)])
    shift = None if shift is None else require_number("shift", shift)
    pooled, robust = bool(require("pooled", pooled, bool)), bool(require("robust", robust, bool))
    unknowns = 2 if shift is None else 1
    if require_whole("min_points", min_points) < unknowns:
        raise ValueError(f"min_points must be at least {unknowns}, got {min_points}")
    x, measured, use, weight = _points(prediction, depth, valid, weights, pooled)
    count = use.sum(1)
    require_each(count >= min_points, count, f"needs at least {min_points} measurements with a prediction, has")
    y = measured if kind == "affine" else 1 / measured
    inlier = _inliers(x, y, use, weight, shift) if robust else use
    scale, offset, determined = _line(x, y, weight * inlier, shift)
    flat = "has predictions that hardly differ, which determine no alignment; measurements:"
    require_each(determined, count, flat)
    grows = "distance" if kind == "affine" else "nearness"
    require_each(scale > 0, scale, f"does not grow with {grows}, as kind {kind!r} declares; the fitted scale is")
    residual = y - scale[:, None] * x - offset[:, None]
    rms = ((residual.square() * inlier).sum(1) / inlier.sum(1)).sqrt()
    scale, offset, points, inliers, rms = (v[0] if pooled else v for v in (scale, offset, count, inlier.sum(1), rms))
    return AlignmentFit(Alignment(kind, scale, offset, max_depth), points, inliers, rms)


def _inliers(x: Tensor, y: Tensor, use: Tensor, weight: Tensor, shift: float | None) -> Tensor:
    """[B, P] True for points within three standard deviations of a robust line.

    Iterates least squares with Huber's weight min(1, 1.345 s / |r|) of the residuals r [B, P], whose standard deviation
    s is estimated from their median; then least squares over the inliers, which is exact for exact data.
    """
    root, inlier, weights = weight.sqrt(), use, weight * use
    floor = _ROUNDING * _median(y.abs() * root, use)
    for step in range(_REWEIGHTED + _TRIMMED):
        scale, offset, determined = _line(x, y, weights, shift)
        residual = (y - scale[:, None] * x - offset[:, None]).abs() * root
        deviation = torch.maximum(_MAD_TO_STD * _median(residual, use), floor)[:, None]
        if step < _REWEIGHTED:
            weights = weight * use * (_HUBER * deviation / residual.clamp_min(torch.finfo(x.dtype).tiny)).clamp_max(1)
            continue
        # All points stay inliers if no line is determined; the final fit raises for the image.
        previous, inlier = inlier, use & ((residual <= _CUT * deviation) | ~determined[:, None])
        weights = weight * inlier
        if torch.equal(inlier, previous):
            break
    return inlier


def _line(x: Tensor, y: Tensor, weight: Tensor, shift: float | None) -> tuple[Tensor, Tensor, Tensor]:
    """Scale and shift [B] of the weighted least-squares line through points [B, P], and whether they are determined
    (if not, the scale is 0)."""
    w, wx, wy = weight.sum(1), (weight * x).sum(1), (weight * y).sum(1)
    wxx, wxy = (weight * x * x).sum(1), (weight * x * y).sum(1)
    if shift is None:
        spread, common = w * wxx - wx * wx, w * wxy - wx * wy
        determined = spread > _RANK * w * wxx
    else:
        spread, common = wxx, wxy - shift * wx
        determined = spread > 0
    scale = torch.where(determined, common, 0) / torch.where(determined, spread, 1)
    offset = (wy - scale * wx) / w if shift is None else torch.full_like(w, shift)
    return scale, offset, determined


def _median(value: Tensor, use: Tensor) -> Tensor:
    """[B] the lower median of the points in use."""
    return torch.where(use, value, torch.nan).nanmedian(-1).values


def _points(
    prediction: Tensor, depth: Tensor, valid: Tensor | None, weights: Tensor | None, pooled: bool
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """x, depth, use and weight, float64 [B, P] ([1, P] if pooled); x and depth are 1 where not used."""
    require_maps("prediction", prediction)
    require_maps("depth", depth)
    if valid is not None and valid.dtype != torch.bool:
        raise ValueError(f"valid must be bool, got {valid.dtype}")
    for name, value in (("depth", depth), ("valid", valid), ("weights", weights)):
        if value is not None and value.shape != prediction.shape:
            raise ValueError(f"{name} must be {tuple(prediction.shape)} as prediction, got {tuple(value.shape)}")
    shape = (1, -1) if pooled else (len(prediction), -1)
    x, measured = prediction.detach().double().reshape(shape), depth.detach().double().reshape(shape)
    use = x.isfinite() & (measured > 0) & (measured < torch.inf)
    if valid is not None:
        use = use & valid.reshape(shape)
    weight = torch.ones_like(x) if weights is None else weights.detach().double().reshape(shape)
    if not ((weight >= 0) & (weight < torch.inf)).all():
        raise ValueError("weights must be finite and not negative")
    use = use & (weight > 0)
    return torch.where(use, x, 1), torch.where(use, measured, 1), use, weight


def require_maps(name: str, value: Tensor) -> None:
    """Raises TypeError, ValueError: ``value`` is no floating-point tensor [B, H, W]."""
    require(name, value, Tensor)
    if value.dim() != 3 or not value.is_floating_point() or not value.numel():
        raise ValueError(f"{name} must be floating-point [B, H, W], got {value.dtype} {tuple(value.shape)}")


def require_each(fine: Tensor, value: Tensor, sentence: str) -> None:
    """Raise a ValueError "image b SENTENCE value[b]" for the first image b that is not ``fine`` ([B], or [] for pooled
    images)."""
    if not fine.all():
        image = int((~fine).reshape(-1).nonzero()[0])
        raise ValueError(f"image {image} {sentence} {value.reshape(-1)[image].item():.6g}")

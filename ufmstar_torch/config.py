"""Settings of UfM*: frozen, checked (``checked``), each with its symbol, unit, default and range."""

from __future__ import annotations

import functools
import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from types import MappingProxyType
from typing import Any, ClassVar

from ufmstar_torch.files.limits import require_bytes
from ufmstar_torch.posterior.config import PosteriorConfig as PosteriorConfig
from ufmstar_torch.runtime.checked import Checked, choice, number, section
from ufmstar_torch.runtime.kinds import check_kinds

_SLOT = 84  # [bytes] of a component's state without features
# Implementations of SPGF iterate over the depth bins; more than this indicate a mistake in the units.
_MOST_BINS = 10_000

# [m] Largest depth of a network that states none; SPGF's own.
UNSTATED_RANGE = 20.0
# The paper's settings where the defaults differ from them (``UfMStarConfig.paper`` has the reasons), by dotted name.
PAPER: Mapping[str, Any] = MappingProxyType({
    "segment.min_pixels": 2000, "segment.min_rows": 32, "segment.prune": "either", "segment.slope_focal": "camera",
    "segment.max_depth": 1000.0, "view_baseline": None, "regression": "neighbourhood", "unmeasured": "paper",
    "merge": None,
})  # fmt: skip


@dataclass(frozen=True)
class SPGFConfig(Checked):
    """Single Pass Gaussian Fitting (section "3D Gaussian segmentation"; Li et al., ICRA 2022).

    Upstream's constants (:meth:`preset` has all of its configurations), stated as the paper applies them:
    to images of 224 x 224 with the focal length of its NYU preprocessing, about 200 px.

    Lengths are metres. Thresholds in pixels, and ``adaptive_thresh_scale``, which multiplies 1/f, are stated for an
    image of ``reference_height`` x ``reference_width``; with ``scale_with_image`` they follow the image they are
    applied to (see :meth:`scaled_to`).

    Attributes:
        adaptive_thresh_scale: quadratic growth of the thresholds with depth, t = a z^2 / f
        noise_floor: smallest threshold, and largest distance of a fused segment from a Gaussian's plane
        noise_thresh: largest threshold of the distance in depth within a row
        line_thresh: largest threshold of the distance from a segment's line
        occlusion_gap: gap in a row that ends a segment
        n_check: a segment of up to so many pixels is continued near its last point, a longer one near its line
        max_open: segments of a row that are open at the same time
        angle_cosine: smallest cosine of the angle between two segments that are fused
        sparse: segments of at most so many pixels are dropped
        min_gaussian_length: length of the first depth bin, the longest that a near segment may be
        frame_max_scale: largest length of a segment, in multiples of min_gaussian_length
        max_depth: largest depth that the network can predict; pixels beyond it are counted and not valid. null: what
            the network states (``UncertainDepth`` and the commands take it from there), 20 m where it states nothing
        min_pixels: pixels below which a Gaussian is too small
        min_rows: segments below which a Gaussian is too small
        prune: drop a Gaussian if it is too small in both respects, in either of them, or none
        scale_with_image: whether the thresholds follow the image's size
        slope_focal: whose f the thresholds t = a z^2 / f have: the camera's own, from which only the resize from the
            reference size is taken out (camera), or reference_focal whatever the camera (reference)
        reference_focal: focal length for which the thresholds are stated, of slope_focal = reference
        reference_height: image height for which the thresholds are stated
        reference_width: image width for which the thresholds are stated
    """

    adaptive_thresh_scale: float = number(2.4, "a", "px/m", 0.0, open_low=True)
    noise_floor: float = number(0.08, "noise_floor", "m", 0.0, open_low=True)
    noise_thresh: float = number(0.2, "noise_thresh", "m", 0.0, open_low=True)
    line_thresh: float = number(0.3, "line_t", "m", 0.0, open_low=True)
    occlusion_gap: int = number(10, "occ_x", "px", 1)
    n_check: int = number(16, "n_check", "px", 1)
    max_open: int = number(2, "max_open", "segments", 1, 8)
    angle_cosine: float = number(0.5, "angle", "1", 0.0, 1.0)
    sparse: int = number(5, "sparse", "px", 0)
    min_gaussian_length: float = number(0.5, "L0", "m", 0.0, open_low=True)
    frame_max_scale: float = number(4.0, "frame_max_scale", "1", 1.0)
    max_depth: float | None = number(None, "max_depth", "m", 0.0, open_low=True)

    min_pixels: int = number(200, "min_pixels", "px", 1)
    min_rows: int = number(16, "min_rows", "segments", 1)
    prune: str = choice("both", "either", "none")

    scale_with_image: bool = True
    slope_focal: str = choice("reference", "camera")
    reference_focal: float = number(200.0, "f_ref", "px", 0.0, open_low=True)
    reference_height: int = number(224, "H_ref", "px", 1)
    reference_width: int = number(224, "W_ref", "px", 1)

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.noise_thresh < self.noise_floor or self.line_thresh < self.noise_floor:
            raise ValueError(
                "SPGFConfig.noise_thresh and .line_thresh are upper clamps and must not lie below "
                f".noise_floor = {self.noise_floor}, got {self.noise_thresh} and {self.line_thresh}"
            )
        if self.depth_limit > _MOST_BINS * self.min_gaussian_length:
            raise ValueError(
                f"SPGFConfig.min_gaussian_length = {self.min_gaussian_length} m would cut SPGFConfig.max_depth = "
                f"{self.depth_limit} m into more than {_MOST_BINS} bins; are both in metres?"
            )

    @classmethod
    def preset(cls, name: str) -> SPGFConfig:
        """Upstream's own values: "tum", "tartanair_indoor" or "tartanair_outdoor", all for images of 640x480.

        Raises:
            ValueError: another name.
        """
        if not isinstance(name, str):
            raise ValueError(f"name must be that of a preset, got {name!r:.60}")
        tartanair = {"adaptive_thresh_scale": 0.70, "min_rows": 8, "reference_focal": 320.0}
        outdoor = {"noise_floor": 0.25, "noise_thresh": 0.5, "min_gaussian_length": 0.6}
        presets: dict[str, dict[str, Any]] = {
            "tum": {},
            "tartanair_indoor": {**tartanair, "noise_floor": 0.05, "sparse": 2},
            "tartanair_outdoor": {**tartanair, **outdoor},
        }
        if name not in presets:
            raise ValueError(f"SPGFConfig.preset must be one of {', '.join(presets)}, got {name!r}")
        camera = {"max_depth": 20.0, "reference_focal": 525.0, "reference_height": 480, "reference_width": 640}
        return cls(**{**camera, **presets[name]})

    @property
    def depth_limit(self) -> float:
        """[m] ``max_depth``, or SPGF's 20 m where it is None."""
        return UNSTATED_RANGE if self.max_depth is None else self.max_depth

    def scaled_to(self, height: int, width: int) -> SPGFConfig:
        """The same thresholds for an image of height x width: counts of pixels along a row follow the
        width, rows the height, areas the area. Off (``scale_with_image=False``): returned as it is.

        ``adaptive_thresh_scale`` multiplies 1/f. With ``slope_focal == "camera"`` it follows the resize, by the larger
        of the two factors, since f is the smaller focal length: a camera with square pixels keeps its thresholds in
        metres when its image is resized.
        """
        return _scaled(self, height, width) if self.scale_with_image else self

    @property
    def depth_bins(self) -> int:
        """Number of depth bins that reaches ``depth_limit`` for every camera, since no bin is shorter than L0."""
        return math.ceil(self.depth_limit / self.min_gaussian_length) + 2

    def segments_per_row(self, width: int) -> int:
        """Most segments in a row of ``width`` pixels, each of which has more than ``sparse`` of them; at least 1."""
        return max(1, width // (self.sparse + 1))

    @property
    def fixed_slope(self) -> bool:
        """Whether :meth:`slope` is the same for every camera."""
        return self.scale_with_image and self.slope_focal == "reference"

    def slope(self, focal: Any) -> Any:
        """a/f [1/m], the factor of z^2 in t = a z^2 / f, of a config for this image (:meth:`scaled_to`).

        Args:
            focal: min(fx, fy) of the image [px], a number or a tensor; with :attr:`fixed_slope` the quotient is a/f_ref
                whatever it is.
        """
        scale = focal / self.reference_focal if self.fixed_slope else 1.0
        return self.adaptive_thresh_scale * scale / focal


@functools.lru_cache(maxsize=16)  # constructing a config repeats its checks in every frame
@check_kinds
def _scaled(config: SPGFConfig, height: int, width: int) -> SPGFConfig:
    across, down = width / config.reference_width, height / config.reference_height
    resized = max(across, down) if config.slope_focal == "camera" else 1.0
    return replace(
        config,
        adaptive_thresh_scale=config.adaptive_thresh_scale * resized,
        occlusion_gap=max(1, round(config.occlusion_gap * across)),
        n_check=max(1, round(config.n_check * across)),
        sparse=round(config.sparse * across),
        min_pixels=max(1, round(config.min_pixels * across * down)),
        min_rows=max(1, round(config.min_rows * down)),
        reference_height=height,
        reference_width=width,
    )


@dataclass(frozen=True)
class AnchorConfig(Checked):
    """Anchors, sparse measured depths (``ufmstar_torch.anchors``).

    Attributes:
        half_life: age after which an anchor's evidence counts half
        shrinkage: anchors with which a Gaussian's own mean counts half
    """

    half_life: float = number(30.0, "ln 2/ln(1/gamma)", "frames", 0.0, open_low=True)
    shrinkage: float = number(2.0, "kappa", "anchors", 0.0, open_low=True)


@dataclass(frozen=True)
class MergeConfig(Checked):
    """Merging of components that overlap (``ufmstar_torch.steps.merge``).

    Attributes:
        loss: loss per pixel up to which two Gaussians are joined
        every: frames of a stream from one merging to the next
        accelerators: merge on accelerators, too, where every frame then waits for the device
    """

    loss: float = number(1.0, "l_max", "nat", 0.0, 10.0, open_low=True)
    every: int = number(50, "n", "frames", 1)
    accelerators: bool = False
    # s_min [1]: share in its own points below which a Gaussian is dissolved in the others
    share: ClassVar[float] = 0.05


@dataclass(frozen=True)
class UfMStarConfig(Checked):
    """All settings of UfM*. The defaults are the paper's except for those listed in :meth:`paper`. What is not in
    the paper has a section each, None = off.

    Attributes:
        segment: thresholds of the segmentation
        eta: overlap from which on two Gaussians correspond
        eta_occlusion: overlap with a nearer Gaussian from which on a Gaussian counts as hidden
        near_plane: Gaussians nearer to the camera are not in view
        overlap_weighted: weight a fusion by the overlap of its Gaussians
        view_baseline: baseline over distance at which a comparison with an earlier view counts for 63 %: two views from
            one position of the camera show nothing; null = every comparison counts fully, as in the paper
        prior_weight: weight of the prior in the regression
        prior_mean: disagreement where no Gaussian is near
        unmeasured: M where no two views were compared: a share of the depth squared (relative), as the paper (0 of what
            was seen once, prior_mean where no Gaussian is near), or NaN (nan)
        unmeasured_relative: relative: standard deviation as a share of the depth
        regression: exact sum over the Gaussians in view, or the paper's neighbourhood
        ema_alpha: weight of the new disagreement map in the running average
        variance_floor: smallest variance of a pixel
        variances_in_h: average the network's variances, aleatoric and epistemic, over views in the Gaussians (the
            paper's H), and add these averages instead of the pixel's own
        initial_capacity: slots for Gaussians at the start; the number grows as needed
        max_components: largest number of Gaussians, beyond which the farthest are dropped, then the oldest; null = no
            limit
        on_bad_frame: refuse a frame with a fault, or skip and count it
        backend: implementation of the kernels
        anchors: use anchors, sparse measured depths (not in the paper)
        confidence: with anchors, learn what the network's confidence means (not in the paper)
        posterior: with anchors, also a corrected depth and its variance (not in the paper)
        merge: join Gaussians that overlap (not in the paper)
    """

    segment: SPGFConfig = section(SPGFConfig)

    # Correspondence (section "Multiview Gaussian Correspondence")
    eta: float = number(0.5, "eta", "1", 0.0, 1.0, open_low=True)
    eta_occlusion: float = number(0.7, "eta_occl", "1", 0.0, 1.0, open_low=True)
    near_plane: float = number(0.05, "z_near", "m", 0.0, open_low=True)

    # Fusion (section "Multiview Fusion")
    overlap_weighted: bool = False
    # Two views from one position are one view (``steps.fuse``).
    view_baseline: float | None = number(0.07, "b_0", "1", 0.0, open_low=True, optional=True)

    # Regression (section "Uncertainty Regression")
    prior_weight: float = number(1.0, "pi_0", "px/m^3", 0.0, open_low=True)
    prior_mean: float = number(0.0, "mu_0", "m^2", 0.0)
    unmeasured: str = choice("relative", "paper", "nan")
    unmeasured_relative: float = number(0.2, "rho", "1", 0.0, open_low=True)
    regression: str = choice("exact", "neighbourhood")
    ema_alpha: float = number(0.5, "alpha", "1", 0.0, 1.0, open_low=True)
    variance_floor: float = number(0.0, "v_min", "m^2", 0.0)

    # State
    variances_in_h: bool = False
    initial_capacity: int = number(256, "K_0", "components", 1)
    max_components: int | None = number(None, "K_max", "components", 1)

    # Input checks and speed
    on_bad_frame: str = choice("raise", "skip")
    backend: str = choice("auto", "torch", "numba", "triton")

    # Not in the paper
    anchors: AnchorConfig | None = section(AnchorConfig, optional=True, on=False)
    confidence: bool = False
    posterior: PosteriorConfig | None = section(PosteriorConfig, optional=True, on=False)
    merge: MergeConfig | None = section(MergeConfig, optional=True)

    # Constants: the paper's neighbourhood, and a bound far above the rounding of poses in text files.
    # r [m]: neighbourhood: Gaussians whose extent comes this near to a pixel's point are summed
    near_radius: ClassVar[float] = 0.1
    # R [m]: neighbourhood: the same where none comes within near_radius
    far_radius: ClassVar[float] = 0.5
    # s [1]: neighbourhood: extent of a Gaussian in standard deviations
    neighbourhood_sigmas: ClassVar[float] = 2.0
    # |R^T R - I|_max [1]: largest deviation of a pose's rotation from an orthogonal matrix
    rotation_tolerance: ClassVar[float] = 0.01

    def __post_init__(self) -> None:
        super().__post_init__()
        for name in ("posterior", "confidence"):
            if getattr(self, name) and self.anchors is None:
                raise ValueError(f"UfMStarConfig.{name} needs anchors: set anchors=AnchorConfig() as well")
        if self.variances_in_h and self.anchors is not None:
            raise ValueError("UfMStarConfig.variances_in_h goes without anchors (posterior=False; --plain)")
        require_bytes("UfMStarConfig.initial_capacity", self.initial_capacity * (_SLOT + 4 * self.entries))

    @classmethod
    def paper(cls) -> UfMStarConfig:
        """The paper's own settings, for its images of 224 x 224; thresholds in pixels follow other sizes.

        ``PAPER`` lists all that differs from the defaults:

        - ``segment.min_pixels``, ``.min_rows``, ``.prune``: the paper drops a Gaussian below 2,000 pixels or below 32
          rows; the default one that is below 200 pixels and below 16 rows. On four sequences that is 4 to 6 Gaussians
          over 55 to 85 % of the usable pixels here, 12 to 24 over 92 to 99 % by default, and ECE_delta of FastDepth's
          depth alone is .562 here and .382 by default (docs/results/accuracy.md).
        - ``segment.max_depth``: 1 km here, farther than any depth in the paper's data sets; by default the largest
          depth that the network states, or SPGF's 20 m.
        - ``segment.slope_focal``: SPGF's thresholds have the camera's own focal length here, by default the
          reference's, which made no difference on tours.
        - ``view_baseline``: every comparison counts here, and the first view counts as agreement; by default a
          comparison counts as far as the view changed (``steps.fuse``).
        - ``regression``: over the Gaussians within .1 m here, or .5 m where there are none; by default over all, the
          sum that this approximates to save time, which was calibrated better.
        - ``unmeasured``: a surface that no two views compared reads as 0 here, as a share of its depth by default.
        - ``merge``: Gaussians are only added here; by default those that overlap are joined every 50 frames, which
          changes ECE_delta by at most .002 (docs/results/speed.md).
        """
        return cls().with_values(PAPER)

    @property
    def entries(self) -> int:
        """Number of entries of H after m: with ``variances_in_h`` A, E and 1."""
        return 3 * self.variances_in_h

    def merges_on(self, device_type: str) -> bool:
        """True if components are merged on a ``torch.device.type``."""
        return self.merge is not None and (device_type == "cpu" or self.merge.accelerators)

    def within(self, max_depth: float | None, states_confidence: bool = False) -> UfMStarConfig:
        """The settings for a network that states its largest depth [m], for ``segment.max_depth`` where that is None,
        or a confidence, for ``confidence`` where there are anchors."""
        changes: dict[str, Any] = {}
        if max_depth is not None and self.segment.max_depth is None:
            changes["segment"] = replace(self.segment, max_depth=max_depth)
        if states_confidence and self.anchors is not None:
            changes["confidence"] = True
        return self.replace(**changes) if changes else self

    def replace(self, **changes: Any) -> UfMStarConfig:
        """A copy with some fields changed, checked again."""
        return replace(self, **changes)

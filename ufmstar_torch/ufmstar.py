"""UfM* as a module: the only stateful class of the core."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Any, Self, cast

import torch
from torch import Tensor

from ufmstar_torch import unmeasured
from ufmstar_torch.anchors.hook import AnchorInput, Anchors, check_anchors
from ufmstar_torch.arguments import require_float
from ufmstar_torch.camera import invert_rigid
from ufmstar_torch.config import AnchorConfig, UfMStarConfig
from ufmstar_torch.fixed_order import apply
from ufmstar_torch.frame import FrameInput, check_frame, raise_faults
from ufmstar_torch.kernels.select import (
    LateStep,
    select_anchor_check,
    select_anchored_term,
    select_check,
    select_merge,
    select_posterior,
    select_step,
)
from ufmstar_torch.merge import merged
from ufmstar_torch.mixture import GaussianMixture
from ufmstar_torch.output import MeanUncertainty as MeanUncertainty
from ufmstar_torch.output import StepOutput
from ufmstar_torch.output import UfMStarOutput as UfMStarOutput
from ufmstar_torch.posterior.update import Posterior
from ufmstar_torch.recalibrate import Recalibration
from ufmstar_torch.regress import Regression, regress, sample_mean, sample_pixels
from ufmstar_torch.state import UfMStarState
from ufmstar_torch.stateful import StatefulModule, full_precision, outliving
from ufmstar_torch.step import Step, StepObserver
from ufmstar_torch.warm_up import warm_up

if TYPE_CHECKING:
    from ufmstar_torch.capture import Captured


class UfMStar(StatefulModule):
    """Uncertainty from Motion*: feed it one predicted depth map per image, read a variance per pixel.

    The state (the mixture of every stream) lives in buffers: ``.to()``, ``deepcopy`` and ``state_dict``
    carry it, and a run continued from a saved state equals an uninterrupted one to the last bit. The
    state is float32 or float64 (``.half()`` leaves it alone); poses and the fusion are float64 throughout,
    also under autocast. A frame that raises leaves the state as it was. Nothing is learned: gradients flow to
    ``aleatoric`` and ``epistemic`` through ``variance``, and to nothing else.

    Args:
        config: see :class:`UfMStarConfig`; None = the paper's.
        recalibration: maps V, after everything else; its parts M, A, E and B stay as they are. None = V as it is.
        dtype: of the state, torch.float32 or torch.float64.
        device: of the state until ``.to()``; it follows the first frame otherwise.

    Attributes:
        observer: follows the stages of every step (``ufmstar_torch.step.StepObserver``), to time them; None = nobody.

    Example::

        ufm = UfMStar()
        for image, T_world_cam in video:
            out = ufm(network(image), T_world_cam, K)   # depth [B, H, W]
            trust = out.std                              # [m]
    """

    STATE = UfMStarState.names()
    ALWAYS_FLOAT64 = ("T_world_first", "posterior")
    CONFIG = UfMStarConfig
    config: UfMStarConfig
    observer: StepObserver | None = None
    recalibration: Recalibration | None
    _warned: bool = False
    _kept_step: tuple[tuple[str, str], Step] | None = None

    def __init__(
        self,
        config: UfMStarConfig | None = None,
        *,
        recalibration: Recalibration | None = None,
        dtype: torch.dtype = torch.float32,
        device: torch.device | str | None = None,
    ) -> None:
        super().__init__()
        if config is not None and not isinstance(config, UfMStarConfig):
            raise TypeError(f"config must be a UfMStarConfig or None, got {type(config).__name__}")
        if dtype not in (torch.float32, torch.float64):
            raise ValueError(f"dtype must be torch.float32 or torch.float64, got {dtype}")
        self.config = config if config is not None else UfMStarConfig()
        if recalibration is not None:
            recalibration.require(self.config)
        self.recalibration = recalibration
        for name, value in UfMStarState.initial(0, self.config, dtype, device or "cpu").tensors().items():
            self.register_buffer(name, value)

    # ---- the algorithm ----

    def forward(
        self,
        depth: Tensor,
        pose: Tensor,
        intrinsics: Tensor,
        aleatoric: Tensor | None = None,
        epistemic: Tensor | None = None,
        valid: Tensor | None = None,
        *,
        features: Tensor | None = None,
        anchors: Anchors | None = None,
    ) -> UfMStarOutput:
        """Process one predicted depth map per stream and return its variance.

        Args:
            depth: [B, H, W] or [B, 1, H, W] metric depth along the optical axis [m], any floating dtype.
                Accepted is [1e-6 m, 1e6 m], and at most ``config.segment.max_depth``: state the network's largest depth
                there. Pixels beyond (``statistics.beyond``) or otherwise outside (``out_of_range``) are not valid, nor
                are those that are NaN, infinite, zero or negative.
            pose: [B, 4, 4] or [4, 4] camera-to-world (T_world_cam) [m]. Rotations off by at most
                ``config.rotation_tolerance`` are projected onto SO(3) and reported.
                Coordinates of up to 1e9 m are accepted.
            intrinsics: [B, 3, 3] or [3, 3] in pixels of this depth map (not of the image: ``resize_intrinsics``), first
                pixel's centre at (0, 0); a focal length of 0.01 to 1e7 px, and the principal point on the map.
            aleatoric: like ``depth``, the network's own variance A [m^2]; pixels where it does not lie in [0, 1e12] are
                left out and counted.
            epistemic: likewise E [m^2].
            valid: like ``depth``, bool, True = use.
            features: [B, F, H, W] with F = ``config.features``, averaged per component and regressed; of at most 1e12.
            anchors: sparse depths of this frame, with ``config.anchors``; None = none.

        Returns:
            The variance and its parts.

        Raises:
            TypeError: wrong kind of argument or dtype.
            ValueError: wrong shape or device; another number of streams than before (:meth:`reset` first);
                a pose that is not rigid or bad intrinsics (``config.on_bad_frame == "skip"``: counted instead);
                anchors without ``config.anchors``.
        """
        frame = self._checked(depth, pose, intrinsics, aleatoric, epistemic, valid, features)
        out, variance, anchored, posterior = self._observe(frame, anchors)

        def shaped(value: Tensor) -> Tensor:
            return value if value.shape == depth.shape else value.reshape(depth.shape)

        return UfMStarOutput(
            depth=depth,
            variance=shaped(variance),
            disagreement=shaped(out.disagreement),
            aleatoric=aleatoric,
            epistemic=epistemic,
            anchored=None if anchored is None else shaped(anchored),
            bias=None if out.residual is None else shaped(out.residual[..., 0]),
            posterior_depth=None if posterior is None else shaped(posterior.depth),
            posterior_variance=None if posterior is None else shaped(posterior.variance),
            features=out.features,
            measured=shaped(out.measured),
            valid=shaped(frame.valid),
            read_labels=out.read_labels,
            current_cam=out.current_cam,
            statistics=out.statistics,
        )

    def mean_uncertainty(
        self,
        depth: Tensor,
        pose: Tensor,
        intrinsics: Tensor,
        aleatoric: Tensor | None = None,
        epistemic: Tensor | None = None,
        valid: Tensor | None = None,
        *,
        features: Tensor | None = None,
        anchors: Anchors | None = None,
        pixels: int | None = None,
        fraction: float | None = None,
        seed: int = 0,
        average: bool = False,
    ) -> MeanUncertainty:
        """Like :meth:`forward`, but regress only a seeded sample of pixels: an average per image for
        active learning (section "Compute- and memory efficiency"); only the regression gets cheaper with fewer pixels.
        The posterior needs whole maps: here it learns nothing.

        Without ``average`` it estimates the mean of this frame's V alone; the map of :meth:`forward` is averaged over
        frames, and its mean differs (by 13 % in the median on recorded video).

        Args:
            pixels: size of the sample per image; or
            fraction: the same as a share of all pixels, in (0, 1]. Neither: 1000 pixels.
            seed: of the sample, which nothing else decides but the image's size and its valid pixels: equal streams,
                and frames with one seed, take the same pixels.
            average: apply the exponential moving average at the sampled pixels.

        The first views of a place have nothing to be compared with: their mean is low for want of evidence
        (``MeanUncertainty.measured`` near 0). With ``config.unmeasured="nan"`` only measured pixels are averaged, and
        an image without any gets NaN.

        Raises:
            ValueError: both ``pixels`` and ``fraction``, or one out of range; and as :meth:`forward`.
        """
        frame = self._checked(depth, pose, intrinsics, aleatoric, epistemic, valid, features)
        index, used = sample_pixels(frame.valid, _sample_size(frame, pixels, fraction), seed)
        out, variance, _, _ = self._observe(frame, anchors, index, average=average)
        sample = sample_mean(variance, out.measured >= unmeasured.HALF, used, out.statistics.valid_pixels)
        return MeanUncertainty(sample.mean, sample.error, sample.count, sample.measured, out.statistics)

    def warm_up(
        self,
        size: tuple[int, int],
        *,
        streams: int = 1,
        anchored: bool | None = None,
        progress: Callable[[int, int], object] | None = None,
    ) -> None:
        """Compile, or load from disk, all that the first frames of this size would otherwise wait for.

        The state stays as it is: a module of its own takes two frames of a wall. On a machine's very first call that is
        some twenty seconds on the CPU, later below a second.

        Args:
            size: (H, W) of the depth maps [px].
            streams: B.
            anchored: with the corners' triangulation (``LandmarkTracker``); None = as ``config.anchors``.
            progress: is called with the stages that are done and all of them, to show that something happens.

        Raises:
            ValueError: a size or number of streams that is not positive.
        """
        anchored = self.config.anchors is not None if anchored is None else anchored
        config = self.config
        if anchored != (config.anchors is not None):
            config = config.replace(anchors=AnchorConfig() if anchored else None)
        twin = UfMStar(config, dtype=self.mean.dtype, device=self.mean.device)
        warm_up(twin, size, streams, progress)

    def query(self, points: Tensor, frame: str = "world") -> Regression:
        """The disagreement at any 3D point, from the present mixture, without touching the state.

        With ``config.regression == "neighbourhood"`` the boxes are cut along the axes of the first camera, where
        :meth:`forward` cuts them along those of the present one.

        Args:
            points: [B, N, 3] [m].
            frame: "world" (the poses' frame) or "first" (each stream's first camera).

        Returns:
            disagreement [B, N] [m^2] and features [B, N, F]; far from everything measured what ``config.unmeasured``
            states, where "relative" reads as "paper", since a point has no depth.

        Raises:
            ValueError: wrong shape or frame, or no frame has been taken in yet.
        """
        if frame not in ("world", "first"):
            raise ValueError(f"frame must be 'world' or 'first', got {frame!r}")
        streams = self.mean.shape[0]
        if streams == 0:
            raise ValueError("query needs a mixture: call the module on a frame first")
        if points.dim() != 3 or points.shape[0] != streams or points.shape[2] != 3:
            raise ValueError(f"points must be [{streams}, N, 3], got {tuple(points.shape)}")
        with torch.no_grad(), full_precision(points.device):
            local = points.detach()
            if frame == "world":
                T = invert_rigid(self.T_world_first)
                local = apply(T[:, None, :3, :3], local.double()) + T[:, None, :3, 3]
            dtype = torch.float64 if points.dtype == torch.float64 else torch.float32
            mixture = unmeasured.before_regression(self.mixture)
            result = regress(mixture, local.to(dtype), self.config)
            return unmeasured.after_regression(result, None, self.config)[0]

    def capture(
        self,
        depth: Tensor,
        pose: Tensor,
        intrinsics: Tensor,
        aleatoric: Tensor | None = None,
        epistemic: Tensor | None = None,
        valid: Tensor | None = None,
    ) -> Captured:
        """This module for frames of one shape as a CUDA graph: a function of frames that takes one launch for each.

        Args:
            depth, pose, intrinsics, aleatoric, epistemic, valid: as :meth:`forward`; only their shapes matter.

        Raises:
            ValueError: tensors that are not on CUDA; a config other than with ``on_bad_frame="skip"``, a mixture that
                cannot grow (``max_components`` at most ``initial_capacity``), and the paper's step.
        """
        from ufmstar_torch.capture import Captured

        if depth.device.type != "cuda":
            raise ValueError(f"capture needs CUDA tensors, got depth on {depth.device}")
        return Captured(self, depth, pose, intrinsics, aleatoric, epistemic, valid)

    # ---- the state ----

    @property
    def mixture(self) -> GaussianMixture:
        """M_i, [B, K], in the frame of each stream's first camera (``T_world_first`` takes it to the world)."""
        return self.state.mixture

    @property
    def state(self) -> UfMStarState:
        """The state as a step (``ufmstar_torch.step``) takes it."""
        self._settle()
        return self._stored()

    def reset(self, streams: Sequence[int] | Tensor | None = None, *, keep_evidence: bool = False) -> None:
        """Forget everything, or only some streams.

        Args:
            streams: indices, or a bool mask [B]; None = all, after which another batch size may follow.
            keep_evidence: keep the sums over anchors of a stream as a whole, the recent error of this network: a robot
                that starts in the same place again has an estimate at its first frames. The sums of single components
                go with the components. The batch size stays.

        Raises:
            IndexError: an index is out of range.
            ValueError: a mask of the wrong length; ``keep_evidence`` without ``config.anchors``.
        """
        if keep_evidence and self.config.anchors is None:
            raise ValueError("keep_evidence needs UfMStarConfig(anchors=AnchorConfig()): nothing is learnt without")
        with outliving(), torch.no_grad():  # buffers must outlive the caller's inference mode
            self._reset(streams, keep_evidence)

    def _reset(self, streams: Sequence[int] | Tensor | None, keep_evidence: bool) -> None:
        old, b = self.state, self.mean.shape[0]
        if streams is None:
            new = UfMStarState.initial(b if keep_evidence else 0, self.config, old.mean.dtype, old.mean.device)
        else:
            new = old.restarted(self._chosen(streams, b))
        kept = {"overall_evidence": old.overall_evidence, "posterior": old.posterior} if keep_evidence else {}
        self._store(new.tensors() | kept)

    def _require_state(self, state: Mapping[str, Tensor]) -> None:
        UfMStarState(**state).require(self.config)

    def _anchors(self, anchors: Anchors | None, frame: FrameInput) -> AnchorInput | None:
        """Checked, with what the network itself claims where they lie.

        Raises:
            ValueError: anchors without ``config.anchors``; and as :func:`check_anchors`.
        """
        if anchors is None:
            return None
        if self.config.anchors is None:
            raise ValueError("anchors need UfMStarConfig(anchors=AnchorConfig())")
        kernel = select_anchor_check(self.config.backend, frame.depth.device.type)
        return check_anchors(anchors, frame, self._own(frame), kernel)

    def _checked(self, depth: Tensor, pose: Tensor, intrinsics: Tensor, *optional: Tensor | None) -> FrameInput:
        aleatoric, epistemic, valid, features = optional
        require_float("depth", depth)
        return check_frame(
            depth, pose, intrinsics, aleatoric, epistemic, valid, features,
            feature_count=self.config.features, rotation_tolerance=self.config.rotation_tolerance,
            max_depth=self.config.segment.depth_limit, kernel=select_check(self.config.backend, depth.device.type),
        )  # fmt: skip

    def _observe(
        self, frame: FrameInput, anchors: Anchors | None, pixels: Tensor | None = None, *, average: bool = True
    ) -> tuple[StepOutput, Tensor, Tensor | None, Posterior | None]:
        """Process a frame: run the step and keep its state.

        Args:
            frame: checked.
            anchors: as given.
            pixels: [B, n] indices into the flattened image to read the variance at; None = every pixel.
            average: apply the moving average.

        Returns:
            The step's output; V and B (None unless ``config.anchors``) [m^2], at every pixel [B, H, W] or [B, n]; the
            posterior (None unless ``config.posterior``, and at some pixels).
        """
        checked_anchors = self._anchors(anchors, frame)
        # Normal tensors also under the caller's inference_mode: the state must outlive it.
        with outliving(), torch.no_grad(), full_precision(frame.depth.device):
            state = self._state_for(frame)
            if self.config.on_bad_frame == "raise":
                known = frame.fault if frame.known_fault is None else frame.known_fault
                if known.device.type == "meta":
                    raise ValueError("depth lies on device meta, without values: set on_bad_frame='skip'")
                raise_faults(known.tolist())
            if self.observer is not None:
                self.observer.stage("check")
            step = self._step(frame.depth.device.type)
            state, out = step(
                state, frame, self.config, pixels=pixels, smooth=average, anchors=checked_anchors,
                observer=self.observer,
            )  # fmt: skip
            if self.config.merge is not None and isinstance(step, LateStep):
                state = step.settled(state, self.config)
            state, out, posterior = self._with_posterior(state, out, frame, checked_anchors, dense=pixels is None)
            if self.config.merge is not None:
                kernels = select_merge(self.config.backend, frame.depth.device.type)
                state = merged(state, frame.fault == 0, self.config, kernels)
                out = replace(out, statistics=replace(out.statistics, components=state.mixture.components))
            self._store(state.tensors())
            self._warn_without_segments(frame, out)

        def chosen(value: Tensor) -> Tensor:
            return value if pixels is None else torch.gather(value.flatten(1), 1, pixels)

        # V = M + A + E (+ B), at least the floor (section "Uncertainty Regression"); NaN stays NaN.
        variance, anchored = out.disagreement, None
        if out.residual is not None:
            term = select_anchored_term(self.config.backend, frame.depth.device.type)
            anchored, variance = term(chosen(frame.depth), out.residual[..., 1], out.disagreement)
        for own in self._own(frame):
            variance = variance + chosen(own)
        if self.config.variance_floor:
            variance = variance.clamp_min(self.config.variance_floor)
        if self.recalibration is not None:
            variance = self.recalibration(variance)
        return out, variance, anchored, posterior

    def _with_posterior(
        self, state: UfMStarState, out: StepOutput, frame: FrameInput, anchors: AnchorInput | None, *, dense: bool
    ) -> tuple[UfMStarState, StepOutput, Posterior | None]:
        """State and output with what the posterior learns and returns; as they are without ``config.posterior``."""
        if self.config.posterior is None or not dense:
            return state, out, None
        claimed = out.disagreement
        for own in self._own(frame):
            claimed = claimed + own.detach()
        claimed = claimed.clamp_min(self.config.variance_floor)
        if self.recalibration is not None:
            claimed = self.recalibration(claimed)
        update = select_posterior(self.config.backend, frame.depth.device.type)
        learnt, posterior = update(state.posterior, frame, anchors, claimed, self.config.posterior)
        posterior = replace(posterior, variance=posterior.variance.clamp_min(self.config.variance_floor))
        statistics = replace(out.statistics, calibration=posterior.calibration, unseen=posterior.unseen)
        return replace(state, posterior=learnt), replace(out, statistics=statistics), posterior

    def _warn_without_segments(self, frame: FrameInput, out: StepOutput) -> None:
        """Warn once where a stream had depth but no segment; on the CPU only, elsewhere the look would wait."""
        if self._warned or frame.depth.device.type != "cpu":
            return
        if all(out.statistics.segments.tolist()):
            return
        given = out.statistics.valid_pixels + frame.beyond + frame.out_of_range
        empty = (given > 0) & (out.statistics.segments == 0)
        if not bool(empty.any()):
            return
        self._warned = True
        b = int(empty.nonzero()[0])
        warnings.warn(
            f"stream {b}: a frame has no segment, so nothing is compared between views: of {int(given[b])} pixels "
            f"{int(frame.beyond[b])} lie beyond segment.max_depth = {self.config.segment.depth_limit} m and "
            f"{int(frame.out_of_range[b])} outside the accepted ranges. Is the depth in metres, smooth, and the "
            "intrinsics the depth map's? (said once)",
            stacklevel=5,
        )

    def _own(self, frame: FrameInput) -> list[Tensor]:
        """The network's own variances A and E as far as they count [m^2]."""
        both = [(frame.aleatoric, self.config.add_aleatoric), (frame.epistemic, self.config.add_epistemic)]
        return [value for value, counts in both if value is not None and counts]

    def _stored(self) -> UfMStarState:
        buffers = cast("dict[str, Tensor]", self._buffers)  # none is None; without the detour by ``__getattr__``
        return UfMStarState(**{name: buffers[name] for name in self.STATE})

    def _step(self, device_type: str) -> Step:
        """The step for a device, the same one as long as the state goes on."""
        key = (self.config.backend, device_type)
        if self._kept_step is None or self._kept_step[0] != key:
            self._settle()
            self._kept_step = key, select_step(*key)
        return self._kept_step[1]

    def _settle(self) -> None:
        """Let the state have what a step keeps for the next frame, before the state goes elsewhere."""
        if self._kept_step is not None and isinstance(self._kept_step[1], LateStep):
            with outliving(), torch.no_grad():
                self._store(self._kept_step[1].settled(self._stored(), self.config).tensors())

    def _apply(self, fn: Callable[[Tensor], Tensor], recurse: bool = True) -> Self:
        self._settle()
        return super()._apply(fn, recurse)

    def _save_to_state_dict(self, destination: dict[str, Any], prefix: str, keep_vars: bool) -> None:
        self._settle()
        super()._save_to_state_dict(destination, prefix, keep_vars)

    def _load_from_state_dict(self, state_dict: dict[str, Any], prefix: str, *given: Any) -> None:
        """A state that was saved before there was a posterior has learnt nothing for it."""
        self._settle()
        weight = state_dict.get(prefix + "weight")
        if isinstance(weight, Tensor) and weight.dim() == 2:
            state_dict.setdefault(prefix + "posterior", self.posterior.new_zeros(len(weight), self.posterior.shape[1]))
        super()._load_from_state_dict(state_dict, prefix, *given)

    def __getstate__(self) -> dict[str, Any]:
        """A copy starts with a step of its own."""
        self._settle()
        return self.__dict__ | {"_kept_step": None}

    def _state_for(self, frame: FrameInput) -> UfMStarState:
        state = self._stored()
        streams, device, mean = len(frame.depth), frame.depth.device, state.mean
        if len(mean) == 0:
            return UfMStarState.initial(streams, self.config, mean.dtype, device)
        if len(mean) != streams:
            raise ValueError(f"depth has {streams} streams but the state holds {len(mean)}: call reset() first")
        if mean.device != device:
            raise ValueError(f"depth lies on {device} but the state on {mean.device}: move one with .to()")
        return state

    def extra_repr(self) -> str:
        """Streams and components."""
        return f"streams={self.mean.shape[0]}, capacity={self.mean.shape[1]}, backend={self.config.backend!r}"


def _sample_size(frame: FrameInput, pixels: int | None, fraction: float | None) -> int:
    total = frame.depth.shape[-1] * frame.depth.shape[-2]
    if pixels is not None and fraction is not None:
        raise ValueError("give pixels or fraction, not both")
    if fraction is not None:
        if not 0 < fraction <= 1:
            raise ValueError(f"fraction must lie in (0, 1], got {fraction}")
        return max(1, round(fraction * total))
    if pixels is None:
        return min(1000, total)
    if isinstance(pixels, bool) or not isinstance(pixels, int) or not 1 <= pixels <= total:
        raise ValueError(f"pixels must be a whole number from 1 to H*W = {total}, got {pixels!r}")
    return pixels

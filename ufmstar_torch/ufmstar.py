"""UfM* as a module: the state of all streams, and the step and the corrections that change it."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Any, cast

import torch
from torch import Tensor

from ufmstar_torch.anchors.anchors import Anchors
from ufmstar_torch.anchors.check import AnchorDoubts, check_anchors
from ufmstar_torch.config import UfMStarConfig
from ufmstar_torch.frames.arguments import Array, CameraLike, as_device, as_tensor
from ufmstar_torch.frames.frame import FrameInput, as_confidence, check_frame, raise_faults
from ufmstar_torch.frames.output import MeanUncertainty, UncertaintyOutput
from ufmstar_torch.frames.warnings import StreamWarnings
from ufmstar_torch.gaussians.mixture import GaussianMixture
from ufmstar_torch.gaussians.state import ALWAYS_FLOAT64, NAMES, UfMStarState
from ufmstar_torch.kernels.select import FrameKernels, select_frame, select_step
from ufmstar_torch.posterior.recalibrate import CONFIDENCE, Recalibration
from ufmstar_torch.runtime.kinds import require
from ufmstar_torch.runtime.stateful import StatefulModule, one_caller, undisturbed
from ufmstar_torch.runtime.warm_up import warm_up
from ufmstar_torch.steps import variance
from ufmstar_torch.steps.regress import Regression, query
from ufmstar_torch.steps.sample import mean_uncertainty, sample_size
from ufmstar_torch.steps.step import Step, StepObserver


@one_caller("forward", "mean_uncertainty", "query", "reset", "state", "__getstate__")
class UfMStar(StatefulModule):
    """Uncertainty from Motion*: computes a variance per pixel from one predicted depth map per image.

    The state (the mixture of every stream) consists of buffers: ``.to()``, ``deepcopy`` and ``state_dict`` include it,
    and a run continued from a saved state equals an uninterrupted one to the last bit. The state is float32 or float64,
    also after ``.half()``; poses and the fusion are float64, also under autocast. A frame that raises does not change
    the state. A second thread that calls the module while another one is inside gets a RuntimeError. There are no
    learnable parameters: gradients flow from ``variance`` to ``aleatoric`` and ``epistemic`` only.

    Args:
        config: None = ``UfMStarConfig()``, which differs from the paper's settings as listed in
            :meth:`UfMStarConfig.paper`.
        recalibration: a map of V, applied last: a :class:`~ufmstar_torch.posterior.recalibrate.Recalibration`, or a
            function from V [...] to V' [...] [m^2]; None = no map.
        dtype: of the state, torch.float32 or torch.float64.
        device: of the state until ``.to()``; None = that of the first frame.

    Attribute ``observer``: receives the stages of every step, to time them (``step.StepObserver``), or None.

    Example: ``ufm = UfMStar()``; for every image, ``out = ufm(depth, T_world_cam, K)``; ``out.std`` [m].
    """

    STATE = NAMES
    ALWAYS_FLOAT64 = ALWAYS_FLOAT64
    config: UfMStarConfig
    observer: StepObserver | None = None
    _cached_step: tuple[tuple[str, str], Step, FrameKernels] | None = None

    def __init__(
        self,
        config: UfMStarConfig | None = None,
        *,
        recalibration: variance.VarianceMap | None = None,
        dtype: torch.dtype = torch.float32,
        device: torch.device | str | None = None,
    ) -> None:
        super().__init__()
        require("config", config, UfMStarConfig | None)
        if not isinstance(dtype, torch.dtype) or dtype not in (torch.float32, torch.float64):
            raise ValueError(f"dtype must be torch.float32 or torch.float64, got {dtype}")
        self.config = config if config is not None else UfMStarConfig()
        self.recalibration = variance.require_map(recalibration, self.config)
        self._warnings, self._doubts = StreamWarnings(), AnchorDoubts()
        self._empty = UfMStarState.initial(0, self.config, dtype, as_device("device", device))
        self.STATE = tuple(self._empty.tensors())
        for name, value in self._empty.tensors().items():
            self.register_buffer(name, value)

    def forward(
        self,
        depth: Array,
        pose: CameraLike,
        intrinsics: CameraLike,
        aleatoric: Array | None = None,
        epistemic: Array | None = None,
        valid: Array | None = None,
        *,
        member: int | Tensor = 0,
        informative: Tensor | None = None,
        anchors: Anchors | None = None,
        confidence: Array | None = None,
    ) -> UncertaintyOutput:
        """Process one predicted depth map per stream and return its variance.

        Args:
            depth: [B, H, W] or [B, 1, H, W] metric depth along the optical axis [m], any floating dtype; all arguments
                are tensors or NumPy arrays. The accepted range is [1e-6 m, 1e6 m], and at most
                ``config.segment.max_depth``: set it to the network's largest depth. Pixels beyond it
                (``statistics.beyond``) or otherwise outside (``out_of_range``), NaN, infinity and masked are not valid.
            pose: [B, 4, 4] or [4, 4] camera-to-world (T_world_cam) [m], or without its last row; coordinates up to
                1e9 m. Rotations within ``config.rotation_tolerance`` are projected onto SO(3).
            intrinsics: [B, 3, 3] or [3, 3], or fx, fy, cx, cy, of this depth map [px] (``resize_intrinsics``), first
                pixel's centre at (0, 0); a focal length of 0.01 to 1e7 px, and the principal point on the map.
            aleatoric: like ``depth``, the network's variance A [m^2]; pixels outside [0, 1e12] are not valid.
            epistemic: likewise E [m^2].
            valid: like ``depth``, bool, True = use.
            member: index of the network, or random sample, that predicted, an integer or [B]; see ``steps.fuse``.
            informative: [B] bool, False where the image shows nothing, so that the depth is neither fused nor measured.
            anchors: sparse depths of this frame, with ``config.anchors``; None = none.
            confidence: like ``depth``, the network's confidence, with ``config.confidence`` or a recalibration of it.

        Raises:
            TypeError: wrong kind of argument or dtype.
            ValueError: wrong shape or device; another number of streams than before (call :meth:`reset` first); a pose
                that is not rigid or invalid intrinsics (with ``on_bad_frame="skip"``: counted instead); anchors or a
                confidence that the config does not use.
        """
        depth = as_tensor("depth", depth)
        a = None if aleatoric is None else as_tensor("aleatoric", aleatoric)
        e = None if epistemic is None else as_tensor("epistemic", epistemic)
        frame = self._checked(
            depth, pose, intrinsics, a, e, valid, member=member, informative=informative, anchors=anchors,
            confidence=confidence,
        )  # fmt: skip
        return self._observe(frame, network={"network_depth": depth, "aleatoric": a, "epistemic": e})

    if TYPE_CHECKING:
        __call__ = forward

    def mean_uncertainty(
        self,
        depth: Array,
        pose: CameraLike,
        intrinsics: CameraLike,
        aleatoric: Array | None = None,
        epistemic: Array | None = None,
        valid: Array | None = None,
        *,
        member: int | Tensor = 0,
        informative: Tensor | None = None,
        pixels: int | None = None,
        fraction: float | None = None,
        seed: int = 0,
        anchors: Anchors | None = None,
        confidence: Array | None = None,
    ) -> MeanUncertainty:
        """Averages of V, M, A, E and B per image for active learning (section "Compute- and memory efficiency"). Like
        :meth:`forward`, but regresses only a sample of pixels. For a first view (``measured`` near 0),
        ``config.unmeasured`` determines the mean. The posterior and the moving average need whole maps and do nothing.

        Args:
            pixels: size of the sample per image; None, without ``fraction``: 1000.
            fraction: size of the sample as a share of all pixels, in (0, 1]; excludes ``pixels``.
            seed: of the sample, which otherwise depends only on the image's size and its valid pixels.

        Raises:
            ValueError: both ``pixels`` and ``fraction``, or one out of range; and as :meth:`forward`.
        """
        depth = as_tensor("depth", depth)
        frame = self._checked(
            depth, pose, intrinsics, aleatoric, epistemic, valid, member=member, informative=informative,
            anchors=anchors, confidence=confidence,
        )  # fmt: skip
        kernels = self._kernels(depth)[1].sample
        index, used = kernels.pixels(frame.valid, *sample_size(frame.size, pixels, fraction, seed))
        out = self._observe(frame, index)
        return mean_uncertainty(out, used, kernels.summary)

    def warm_up(
        self, size: tuple[int, int], *, streams: int = 1, progress: Callable[[int, int], object] | None = None
    ) -> None:
        """Compile all kernels, or load them from disk, by running two synthetic frames in a separate module.

        Args:
            size: (H, W) of the depth maps [px], positive.
            streams: B.
            progress: called with the number of completed stages and of all stages.
        """
        twin = UfMStar(self.config, dtype=self.mean.dtype, device=self.mean.device)
        warm_up(twin, size, streams, progress)

    def query(self, points: Array) -> Regression:
        """The disagreement at any 3D point, from the current mixture; the state does not change.

        Args:
            points: [B, N, 3] in the world [m].

        Returns:
            disagreement [B, N] [m^2], and with ``config.variances_in_h`` features [B, N, 3]: A, E and 1. Where M was
            not measured, the disagreement is NaN, or the paper's value with ``config.unmeasured = "paper"``;
            "relative" gives NaN, since a point has no depth.

        Raises:
            ValueError: wrong shape, or there was no frame yet.
        """
        return query(self.state, as_tensor("points", points), self.config)

    @property
    def mixture(self) -> GaussianMixture:
        """M_i, [B, K], in the frame of each stream's first camera (``T_world_first`` is its pose)."""
        return self.state.mixture

    @property
    def state(self) -> UfMStarState:
        """The state, as an argument of ``ufmstar_torch.steps.step``."""
        return self._stored()

    def reset(self, streams: Sequence[int] | Tensor | None = None, *, keep_evidence: bool = False) -> None:
        """Reset all streams, or some of them.

        Args:
            streams: indices, or a bool mask [B]; None = all, after which the batch size may change.
            keep_evidence: keep the statistics of the B streams from anchors, to start again in the same place.

        Raises:
            IndexError: an index is out of range.
            ValueError: a mask of the wrong length; ``keep_evidence`` without ``config.anchors``.
        """
        if require("keep_evidence", keep_evidence, bool) and not self._empty.by_stream:
            raise ValueError("keep_evidence needs UfMStarConfig(anchors=AnchorConfig()), got one without anchors")
        with undisturbed(self.mean):
            old, b = self.state, self.mean.shape[0]
            if streams is None:
                self._warnings.reset()
                new = UfMStarState.initial(b if keep_evidence else 0, self.config, old.mean.dtype, old.mean.device)
            else:
                self._warnings.reset((chosen := self._chosen(streams, b)).nonzero().flatten().tolist())
                new = old.restarted(chosen)
            self._store(new.tensors() | (dict(old.by_stream) if keep_evidence else {}))

    @property
    def uses_confidence(self) -> bool:
        """True if V depends on the network's confidence."""
        mapped = isinstance(self.recalibration, Recalibration) and self.recalibration.covariate == CONFIDENCE
        return self.config.confidence or mapped

    def _require_state(self, state: Mapping[str, Tensor]) -> None:
        self._empty.with_tensors(state).require(self.config, self._empty)

    def _checked(
        self, depth: Tensor, T: CameraLike, K: CameraLike, *maps: Array | None, anchors: Anchors | None,
        confidence: Array | None, **view: Any,
    ) -> FrameInput:  # fmt: skip
        used = {"anchors": self.config.anchors is not None, "confidence": self.uses_confidence}
        for name, value in (("anchors", anchors), ("confidence", confidence)):
            if value is not None and not used[name]:
                raise ValueError(f"{name} must be None where UfMStarConfig.{name} is off")
        frame = check_frame(
            depth, T, K, *maps, **view, variances_in_h=self.config.variances_in_h,
            rotation_tolerance=self.config.rotation_tolerance, max_depth=self.config.segment.depth_limit,
            kernel=self._kernels(depth)[1].check,
        )  # fmt: skip
        if confidence is not None:
            frame = replace(frame, confidence=as_confidence(confidence, frame))
        if anchors is None:
            return frame
        variances = [v for v in (frame.aleatoric, frame.epistemic) if v is not None]
        checked = check_anchors(anchors, frame, variances, self._kernels(depth)[1].check_anchors)
        self._doubts.judge(anchors, checked, frame.size)
        return replace(frame, anchors=checked)

    def _observe(
        self, frame: FrameInput, pixels: Tensor | None = None, *,
        network: Mapping[str, Tensor | None] | None = None,
    ) -> UncertaintyOutput:  # fmt: skip
        """Run the step and the corrections by anchors, and store the new state. The maps are [B, n] at ``pixels``,
        indices into the flattened image; without these, ``network`` has the caller's maps, whose shape they get."""
        with undisturbed(frame.depth):
            state = self._stored().for_frame(frame, self.config)
            if self.config.on_bad_frame == "raise":
                raise_faults(frame)
            if self.observer is not None:
                self.observer.stage("check")
            step, kernels = self._kernels(frame.depth)
            state, out = step(state, frame, self.config, pixels=pixels, observer=self.observer)
            merging = kernels.merge
            state, out, factor = variance.corrected(state, frame, out, self.config, self.recalibration, pixels, merging)
        # With gradients to A and E.
        added = variance.network_maps(frame, out.maps["features"], self.config, pixels)
        V = variance.total_variance(out.variance, added, frame, self.config, self.recalibration, pixels, factor)
        maps = {"depth": out.depth, "variance": V, "ufm_variance": V, "valid": out.valid, **added, **out.maps}
        del maps["features"]
        if network is not None:
            maps = self._shaped(maps, network, frame.confidence)
        depth, V, valid = maps.pop("depth"), maps.pop("variance"), maps.pop("valid")
        out = UncertaintyOutput(depth, V, valid, maps, out.statistics, out.quantiles)
        self._store(state.tensors())  # last, so that an earlier error changes nothing
        self._warnings.after_frame(frame, out.statistics, state.frames, self.config)
        return out

    def _shaped(
        self, maps: dict[str, Tensor], network: Mapping[str, Tensor | None], confidence: Tensor | None
    ) -> dict[str, Tensor]:
        """The maps [B, H, W] in the shape of the caller's depth, which may be [B, 1, H, W], with those of the network
        as the caller passed them."""
        depth = network["network_depth"]
        assert depth is not None
        if self.config.posterior is None:
            maps["depth"] = depth
        passed = {"network_depth": depth} if self.config.variances_in_h else network
        maps |= {name: value for name, value in {**passed, "confidence": confidence}.items() if value is not None}
        return {name: value.reshape(depth.shape) for name, value in maps.items()} if depth.dim() == 4 else maps

    def _stored(self) -> UfMStarState:
        return self._empty.with_tensors(cast("dict[str, Tensor]", self._buffers))  # all are of the state, none is None

    def _kernels(self, like: Tensor) -> tuple[Step, FrameKernels]:
        """The step and the check for a tensor's device. The step is cached, since a GPU's counts components."""
        key = (self.config.backend, "cpu" if like.is_cpu else like.device.type)
        if self._cached_step is None or self._cached_step[0] != key:
            self._cached_step = key, select_step(*key), select_frame(*key)
        return self._cached_step[1:]

    def __getstate__(self) -> dict[str, Any]:
        """A copy creates its own step."""
        return self.__dict__ | {"_cached_step": None}

    def extra_repr(self) -> str:
        return f"streams={self.mean.shape[0]}, capacity={self.mean.shape[1]}, backend={self.config.backend!r}"

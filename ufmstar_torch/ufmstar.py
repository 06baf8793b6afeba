"""UfM* as a module: the only stateful class of the core."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from typing import TYPE_CHECKING, Any, cast

import torch
from torch import Tensor

from ufmstar_torch.config import UfMStarConfig
from ufmstar_torch.frames.arguments import Array, CameraLike, as_device, as_tensor, require_flag
from ufmstar_torch.frames.extension import Extension
from ufmstar_torch.frames.extensions import extensions_of
from ufmstar_torch.frames.frame import CheckKernel, FrameInput, check_frame, raise_faults
from ufmstar_torch.frames.network_variance import NetworkVariance
from ufmstar_torch.frames.output import MeanUncertainty, StepOutput, UfMStarOutput
from ufmstar_torch.frames.warnings import StreamWarnings
from ufmstar_torch.gaussians.camera import invert_rigid
from ufmstar_torch.gaussians.fixed_order import apply
from ufmstar_torch.gaussians.mixture import GaussianMixture
from ufmstar_torch.gaussians.state import NAMES, UfMStarState
from ufmstar_torch.kernels.select import LateStep, select_check, select_step
from ufmstar_torch.runtime.one_caller import one_caller
from ufmstar_torch.runtime.stateful import StatefulModule, full_precision, outliving
from ufmstar_torch.runtime.warm_up import warm_up
from ufmstar_torch.steps import unmeasured
from ufmstar_torch.steps.regress import Regression, regress
from ufmstar_torch.steps.sample import mean_uncertainty, sample_pixels, sample_size
from ufmstar_torch.steps.step import Step
from ufmstar_torch.steps.step_parts import StepObserver


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
        extensions: extensions in addition to those of the config's sections, for example a
            :class:`~ufmstar_torch.posterior.recalibrate.Recalibration` of V.
        dtype: of the state, torch.float32 or torch.float64.
        device: of the state until ``.to()``; None = that of the first frame.

    Attribute ``observer``: receives the stages of every step, to time them (``step_parts.StepObserver``), or None.

    Example: ``ufm = UfMStar()``; for every image, ``out = ufm(depth, T_world_cam, K)``; ``out.std`` [m].
    """

    STATE = NAMES
    config: UfMStarConfig
    observer: StepObserver | None = None
    _cached_step: tuple[tuple[str, str], Step, CheckKernel] | None = None

    def __init__(
        self,
        config: UfMStarConfig | None = None,
        *,
        extensions: Sequence[Extension] = (),
        dtype: torch.dtype = torch.float32,
        device: torch.device | str | None = None,
    ) -> None:
        super().__init__()
        if config is not None and not isinstance(config, UfMStarConfig):
            raise TypeError(f"config must be a UfMStarConfig or None, got {type(config).__name__}")
        if not isinstance(dtype, torch.dtype) or dtype not in (torch.float32, torch.float64):
            raise ValueError(f"dtype must be torch.float32 or torch.float64, got {dtype}")
        self.config = config if config is not None else UfMStarConfig()
        self._extensions, self._warnings = extensions_of(self.config, extensions), StreamWarnings()
        self._empty = self._extensions.initial(0, self.config, dtype, as_device("device", device))
        self.STATE = tuple(self._empty.tensors())
        self.ALWAYS_FLOAT64 = (*UfMStar.ALWAYS_FLOAT64, *self._extensions.always_float64)
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
        features: Array | None = None,
        member: int | Tensor = 0,
        informative: Tensor | None = None,
        **inputs: Any,
    ) -> UfMStarOutput:
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
            features: [B, F, H, W] with F = ``config.features``, averaged per component and regressed; of at most 1e12.
            member: index of the network, or random sample, that predicted, an integer or [B]; see ``views``.
            informative: [B] bool, False where the image shows nothing, so that the depth is neither fused nor measured.
            **inputs: inputs of extensions, by the name of the extension's section in the config; None = no input.

        Raises:
            TypeError: wrong kind of argument or dtype.
            ValueError: wrong shape or device; another number of streams than before (call :meth:`reset` first); a pose
                that is not rigid or invalid intrinsics (with ``on_bad_frame="skip"``: counted instead); input of an
                extension that is off.
        """
        depth = as_tensor("depth", depth)
        a, e = (None if v is None else as_tensor(n, v) for n, v in (("aleatoric", aleatoric), ("epistemic", epistemic)))
        frame = self._checked(depth, pose, intrinsics, a, e, valid, features, member=member, informative=informative)
        out, maps = self._observe(frame, inputs)
        originals: dict[str, Any] = {} if self.config.variances_in_h else {"aleatoric": a, "epistemic": e}

        def shaped(value: Tensor) -> Tensor:  # no map: [B, n]
            return value if value.shape == depth.shape or value.dim() == 2 else value.reshape(depth.shape)

        maps = {name: None if value is None else shaped(value) for name, value in maps.items()}
        return UfMStarOutput(
            depth=depth,
            **maps | originals,
            features=out.features[..., : self.config.features],
            measured=shaped(out.measured),
            valid=shaped(frame.valid),
            current_cam=out.current_cam,
            statistics=out.statistics,
        )

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
        features: Array | None = None,
        member: int | Tensor = 0,
        informative: Tensor | None = None,
        pixels: int | None = None,
        fraction: float | None = None,
        seed: int = 0,
        average: bool = False,
        **inputs: Any,
    ) -> MeanUncertainty:
        """Averages of V, M, A, E and B per image for active learning (section "Compute- and memory efficiency"). Like
        :meth:`forward`, but regresses only a sample of pixels. For a first view (``measured`` near 0),
        ``config.unmeasured`` determines the mean. Extensions that need whole maps do nothing.

        Args:
            pixels: size of the sample per image; None, without ``fraction``: 1000.
            fraction: size of the sample as a share of all pixels, in (0, 1]; excludes ``pixels``.
            seed: of the sample, which otherwise depends only on the image's size and its valid pixels.
            average: apply the moving average, as :meth:`forward` does; else the mean is over this frame's V only.

        Raises:
            ValueError: both ``pixels`` and ``fraction``, or one out of range; and as :meth:`forward`.
        """
        depth = as_tensor("depth", depth)
        optional, view = (aleatoric, epistemic, valid, features), {"member": member, "informative": informative}
        frame = self._checked(depth, pose, intrinsics, *optional, **view)
        index, used = sample_pixels(frame.valid, sample_size(frame.size, pixels, fraction), seed)
        out, maps = self._observe(frame, inputs, index, average=require_flag("average", average))
        return mean_uncertainty(out, maps | {"depth": torch.gather(frame.depth.flatten(1), 1, index)}, used)

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

    def query(self, points: Array, frame: str = "world") -> Regression:
        """The disagreement at any 3D point, from the current mixture; the state does not change.

        Args:
            points: [B, N, 3] [m].
            frame: "world" (the poses' frame) or "first" (each stream's first camera).

        Returns:
            disagreement [B, N] [m^2] and features [B, N, F]. Where M was not measured, the disagreement is NaN, or the
            paper's value with ``config.unmeasured = "paper"``; "relative" gives NaN, since a point has no depth.

        Raises:
            ValueError: wrong shape or frame, or there was no frame yet.
        """
        if not isinstance(frame, str) or frame not in ("world", "first"):
            raise ValueError(f"frame must be 'world' or 'first', got {frame!r}")
        points, streams = as_tensor("points", points), self.mean.shape[0]
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
            result = regress(unmeasured.before_regression(self.mixture), local.to(dtype), self.config)
            result = unmeasured.after_regression(result, None, self.config)[0]
            return replace(result, features=result.features[..., : self.config.features])

    @property
    def mixture(self) -> GaussianMixture:
        """M_i, [B, K], in the frame of each stream's first camera (``T_world_first`` is its pose)."""
        return self.state.mixture

    @property
    def state(self) -> UfMStarState:
        """The state, as an argument of ``ufmstar_torch.steps.step``."""
        self._settle()
        return self._stored()

    def reset(self, streams: Sequence[int] | Tensor | None = None, *, keep_evidence: bool = False) -> None:
        """Reset all streams, or some of them.

        Args:
            streams: indices, or a bool mask [B]; None = all, after which the batch size may change.
            keep_evidence: keep the extensions' statistics per stream, to start again in the same place with B streams.

        Raises:
            IndexError: an index is out of range.
            ValueError: a mask of the wrong length; ``keep_evidence`` without an extension that has statistics.
        """
        if require_flag("keep_evidence", keep_evidence) and not self._empty.by_stream:
            raise ValueError("keep_evidence needs UfMStarConfig with an extension that learns, got one without")
        with outliving(), torch.no_grad():  # buffers must outlive the caller's inference mode
            old, b = self.state, self.mean.shape[0]
            if streams is None:
                self._warnings.reset()
                new = self._extensions.initial(b if keep_evidence else 0, self.config, old.mean.dtype, old.mean.device)
            else:
                self._warnings.reset((chosen := self._chosen(streams, b)).nonzero().flatten().tolist())
                new = old.restarted(chosen)
            self._store(new.tensors() | (dict(old.by_stream) if keep_evidence else {}))

    def takes(self, name: str) -> bool:
        """True if an extension has an input of this name."""
        return any(one.argument == name for one in self._extensions.each)

    def _require_state(self, state: Mapping[str, Tensor]) -> None:
        self._empty.with_tensors(state).require(self.config, self._empty)
        if state["weight"].device.type != "meta":
            self._extensions.require_state(state)

    def _checked(self, depth: Tensor, T: CameraLike, K: CameraLike, *maps: Array | None, **view: Any) -> FrameInput:
        return check_frame(
            depth, T, K, *maps, **view, feature_count=self.config.features, variances_in_h=self.config.variances_in_h,
            rotation_tolerance=self.config.rotation_tolerance, max_depth=self.config.segment.depth_limit,
            kernel=self._kernels(depth.device.type)[1],
        )  # fmt: skip

    def _observe(
        self, frame: FrameInput, inputs: Mapping[str, Any], pixels: Tensor | None = None, *, average: bool = True
    ) -> tuple[StepOutput, dict[str, Any]]:
        """Run the step and store the new state. Returns the output, and by name V, M, A and E [m^2] (None = not part of
        V) and the maps of extensions, at every pixel [B, H, W], or at ``pixels`` [B, n] of the flattened image.
        ``inputs``: inputs of extensions."""
        of_network = NetworkVariance.of(frame, self.config)

        def chosen(value: Tensor) -> Tensor:
            return value if pixels is None else torch.gather(value.flatten(1), 1, pixels)

        def total(disagreement: Tensor, features: Tensor) -> Tensor:
            variance = of_network.at(chosen, features, self.config).total(disagreement, self.config.variance_floor)
            return extensions.map_variance(self._extensions.map_variance(variance), chosen)

        extensions = self._extensions.of_frame(frame, of_network.maps(), inputs, dense=pixels is None)
        # Outside the caller's inference mode, since the state must outlive it.
        with outliving(), torch.no_grad(), full_precision(frame.depth.device):
            state = self._state_for(frame)
            if self.config.on_bad_frame == "raise":
                raise_faults(frame)
            if self.observer is not None:
                self.observer.stage("check")
            step, _ = self._kernels(frame.depth.device.type)
            state, out = step(
                state, frame, self.config, pixels=pixels, smooth=average, extensions=extensions, observer=self.observer
            )
            state, out = extensions.after_frame(state, out, partial(total, features=out.features))
            disagreement = extensions.disagreement(out.disagreement, chosen(frame.depth))
        maps = {"disagreement": out.disagreement, **vars(of_network.at(chosen, out.features, self.config))}
        maps |= {**extensions.outputs(), "variance": total(disagreement, out.features)}
        self._store(state.tensors())  # last, so that an earlier error changes nothing
        self._warnings.after_frame(frame, out.statistics, state.frames, self.config)
        return out, maps

    def _stored(self) -> UfMStarState:
        buffers = cast("dict[str, Tensor]", self._buffers)  # no buffer is None; avoids ``__getattr__``
        return self._empty.with_tensors(buffers)

    def _kernels(self, device_type: str) -> tuple[Step, CheckKernel]:
        """The step and the check for a device. The step is cached, since it may hold pending components."""
        key = (self.config.backend, device_type)
        if self._cached_step is None or self._cached_step[0] != key:
            self._settle()
            self._cached_step = key, select_step(*key), select_check(*key)
        return self._cached_step[1:]

    def _settle(self) -> None:
        """Write the step's pending components into the state before it is saved, copied or moved."""
        if self._cached_step is not None and isinstance(self._cached_step[1], LateStep):
            with outliving(), torch.no_grad():
                self._store(self._cached_step[1].settled(self._stored(), self.config).tensors())

    def __getstate__(self) -> dict[str, Any]:
        """A copy creates its own step."""
        self._settle()
        return self.__dict__ | {"_cached_step": None}

    def _state_for(self, frame: FrameInput) -> UfMStarState:
        state = self._stored()
        streams, device, mean = len(frame.depth), frame.depth.device, state.mean
        if len(mean) == 0:
            return self._extensions.initial(streams, self.config, mean.dtype, device)
        if len(mean) != streams:
            raise ValueError(f"depth has {streams} streams but the state holds {len(mean)}: call reset() first")
        if mean.device != device:
            raise ValueError(f"depth lies on {device} but the state on {mean.device}: move one with .to()")
        return state

    def extra_repr(self) -> str:
        return f"streams={self.mean.shape[0]}, capacity={self.mean.shape[1]}, backend={self.config.backend!r}"

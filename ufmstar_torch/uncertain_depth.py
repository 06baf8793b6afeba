"""The whole pipeline: networks and their alternation (step 1), anchors, UfM* and the posterior."""

from __future__ import annotations

from collections.abc import Callable, Generator, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor, wait
from contextlib import contextmanager
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, Literal, Self

import numpy as np
import torch
from torch import Tensor, nn

from ufmstar_torch.anchors.anchors import Anchors, require_anchors
from ufmstar_torch.anchors.streams import StreamLandmarks
from ufmstar_torch.config import UfMStarConfig
from ufmstar_torch.frames.arguments import (
    Array,
    CameraLike,
    ImageLike,
    as_device,
    as_image,
    as_intrinsics,
    as_pose,
    require_size,
    require_whole,
)
from ufmstar_torch.frames.image_check import warn_of_range
from ufmstar_torch.frames.image_evidence import ImageEvidence, Source, with_evidence
from ufmstar_torch.frames.output import FrameStatistics, MeanUncertainty, UncertaintyOutput
from ufmstar_torch.frames.prediction import (
    SAMPLES,
    DepthPrediction,
    NetworksInTurn,
    Preprocess,
    in_unit_range,
    modules_of,
    shared_preprocess,
)
from ufmstar_torch.posterior.recalibrate import Recalibration
from ufmstar_torch.runtime.kinds import require
from ufmstar_torch.runtime.stateful import OneCaller, one_caller
from ufmstar_torch.runtime.warm_up import warm_up
from ufmstar_torch.ufmstar import UfMStar

# Keys of a stream's state, or prefixes of keys: of UfM*, of the anchors' source, and the number of processed images.
_UFM, _LANDMARKS, _INDEX = "ufm.", "landmarks.", "image_index"


@dataclass(frozen=True)
class _Predicted:
    """A prediction that is being copied to UfM*'s device.

    Attributes:
        image, pose, intrinsics: the image and its camera, as tensors.
        prediction, member: as in :class:`UncertaintyOutput`.
        ready: recorded after the copies; None = no copy to wait for.
    """

    image: Tensor
    pose: Tensor
    intrinsics: Tensor
    prediction: DepthPrediction
    member: int | None
    ready: torch.cuda.Event | None

    def copied(self) -> _Predicted:
        """A copy that shares no memory with the caller's image, pose and intrinsics, which the next frame may reuse."""
        copies = {name: getattr(self, name).clone() for name in ("image", "pose", "intrinsics")}
        return replace(self, **copies, prediction=replace(self.prediction, intrinsics=self.prediction.K.clone()))


@one_caller(
    "forward",
    "update",
    "mean_uncertainty",
    "_predicted",
    "_fused",
    "_fused_beside",
    "reset",
    "stream_state",
    "load_stream_state",
    "_apply",
)
class UncertainDepth(NetworksInTurn):
    """Depth and variance from any pretrained network(s), for images with pose and intrinsics.

    Args:
        networks: one network or a sequence of them (an ensemble's members; BatchEnsemble members as separate
            callables); None: pass predictions to :meth:`update`. A network whose attribute ``stochastic`` is True
            predicts another random sample for every image. Each network maps an image [B, 3, H, W] to a
            :class:`DepthPrediction`; one with an attribute ``takes_intrinsics = True`` is called as ``network(x, K)``
            with K [B, 3, 3] [px] of ``x``. ``ufmstar_torch.UncertainDepth`` also accepts everything that
            ``ufmstar_torch.models.wrap_network`` accepts without further declarations: metric depth is assumed.
        config: of UfM*; if ``segment.max_depth`` is None, it is set to the networks' (:attr:`max_depth`).
        mode: "alternate" runs member n = i mod N (counted from 0) on image i; with one network this is the
            single-model mode, and with a stochastic network the sampling-based mode. "full" runs every member (or
            ``samples`` passes of a stochastic network) per image and takes the predictive mean, the mean aleatoric
            variance, and the variance between the members as epistemic variance.
        posterior: correct the depth and its variance with anchors. Sets the sections ``anchors`` and ``posterior`` of
            ``config`` and, unless a source is passed, ``anchors="dense"``. Without OpenCV, and without networks, whose
            images are searched, a warning states what is missed, and UfM* runs alone. False: UfM* alone; with
            ``anchors``, B is added to its variance.
        samples: number of stochastic passes per image in mode "full" with one network (MC-Dropout; the network must
            sample in eval mode). None: the network is deterministic.
        preprocess: maps image and intrinsics to the networks' input. "own": the networks' attribute ``preprocess``;
            for networks without one, bytes become floats in [0, 1]. None = no preprocessing.
        anchors: source of the anchors of every image: "corners" (tracked in the image), "dense" (searched in earlier
            images), a file of landmarks, each for every stream; or a
            :class:`~ufmstar_torch.anchors.landmarks.LandmarkSource`; or a list with one source for each stream. Saved
            and reset with the state. An image of another size or camera restarts it. None: "dense" for the posterior,
            on images of bytes, or floats in [0, 1]; anchors that are passed with an image replace its search.
        recalibration: a map of V, applied last (``Recalibration.from_json(FILE)``); None = no map.
        check_poses: number of first images, of the first stream, that are compared with their poses and intrinsics by
            tracked corners, 2 ms each. A warning states if another convention or delay of the poses, or K of another
            image size, fits much better. 0 = none.
        multiview_device: device of UfM* and of the results; None = the networks' device. "cpu", the paper's split, is
            faster for one camera with the networks on a GPU. :meth:`stream` runs both devices at the same time.

    The constructor puts the networks into eval mode; they run without gradients. A stochastic network must sample in
    eval mode, as decoder dropout at test time does. A second thread that calls the module while another one is inside
    gets a RuntimeError.

    Raises:
        TypeError: an argument is no network.
        ValueError: no network, networks with different ``preprocess`` attributes, an unknown mode, or ``samples`` that
            fit neither mode nor networks.

    Example::

        model = UncertainDepth(network)
        for image, pose, intrinsics in video:  # [H, W, 3] uint8, [4, 4], [3, 3]
            out = model(image, pose, intrinsics)
            out.depth, out.std  # corrected [m]; the network's depth is out.network_depth, M is out.disagreement
    """

    def __init__(
        self,
        networks: Callable[..., Any] | Sequence[Callable[..., Any]] | None,
        config: UfMStarConfig | None = None,
        *,
        mode: Literal["alternate", "full"] = "alternate",
        posterior: bool = True,
        samples: int | None = None,
        preprocess: Preprocess | Literal["own"] | None = "own",
        anchors: Source | None = None,
        recalibration: Recalibration | None = None,
        check_poses: int = 40,
        multiview_device: torch.device | str | None = None,
    ) -> None:
        members, preprocess = ([], None) if networks is None else self.accepted(networks, preprocess)
        _require_passes(members, mode, samples)
        super().__init__(members or None, samples=samples, preprocess=preprocess)
        self._caller, self.mode = OneCaller(), mode
        require("config", config, UfMStarConfig | None)
        require("recalibration", recalibration, Recalibration | None)
        posterior = bool(require("posterior", posterior, bool))
        config, source = with_evidence(config or UfMStarConfig(), networks, posterior, anchors)
        self.ufm = UfMStar(config.within(self.max_depth, self.states_confidence), recalibration=recalibration)
        self._evidence = ImageEvidence(
            source, by_default=anchors is None, check_poses=require_whole("check_poses", check_poses, 0),
            rotation_tolerance=self.ufm.config.rotation_tolerance,
        )  # fmt: skip
        self.multiview_device = None if multiview_device is None else as_device("multiview_device", multiview_device)
        self._next = 0  # number of processed images

    def accepted(
        self, networks: object, preprocess: Preprocess | Literal["own"] | None
    ) -> tuple[list[nn.Module], Preprocess | None]:
        """Convert the networks to modules, and resolve their preprocessing; a subclass may accept more types.

        Raises:
            TypeError, ValueError: see the class.
        """
        members = modules_of(networks)
        if isinstance(preprocess, str) and preprocess == "own":
            return members, shared_preprocess(members)
        return members, preprocess

    def forward(
        self,
        image: ImageLike,
        pose: CameraLike,
        intrinsics: CameraLike,
        valid: Array | None = None,
        *,
        anchors: Anchors | None = None,
    ) -> UncertaintyOutput:
        """Predict depth and its variance for the next image of every stream.

        Args:
            image: [B, 3, H, W] or [3, H, W] as the preprocessing (or the network) expects it, a NumPy array
                [B, H, W, 3] or [H, W, 3], or a Pillow image.
            pose: [B, 4, 4] or [4, 4] camera-to-world [m], or without the last row; a tensor or a NumPy array.
            intrinsics: [B, 3, 3] or [3, 3] of ``image`` [px], or fx, fy, cx, cy; likewise.
            valid: [B, h, w] bool at the depth map's size, True = use.
            anchors: sparse depths of this frame, [B, N] padded and masked, at pixels of ``image`` before the
                preprocessing. None = of the constructor's source.

        Raises:
            ValueError, TypeError: as :meth:`UfMStar.forward`; alternation and landmarks then do not advance.
        """
        return self._fused(self._predicted(image, pose, intrinsics), valid, anchors)

    if TYPE_CHECKING:
        __call__ = forward

    def _predicted(
        self,
        image: ImageLike,
        pose: CameraLike,
        intrinsics: CameraLike,
        *,
        ahead: bool = False,
    ) -> _Predicted:
        """The prediction for the next image, or, with ``ahead``, for the one after that."""
        return self._predict(image, pose, intrinsics, number=self._next + ahead)

    def _predict(
        self,
        image: ImageLike,
        pose: CameraLike,
        intrinsics: CameraLike,
        *,
        number: int,
    ) -> _Predicted:
        """The prediction for the image of an index."""
        if not self.networks:
            raise ValueError("UncertainDepth(None) has no networks: pass predictions to update")
        picture, T, K_image = as_image(image), as_pose(pose), as_intrinsics(intrinsics)
        if number == 0:
            warn_of_range(picture)
        if not isinstance(image, Tensor):  # a tensor's device is the caller's choice
            picture = picture.to(self.device or picture.device)
        member = None if self.mode == "full" else self.turn(number)
        with torch.no_grad():
            x, K = self.prepare(picture, K_image.expand(len(picture), 3, 3))
            prediction = self.every(x, K) if member is None else self.member(x, K, member)
        index = 0 if member is None else number % SAMPLES if self.stochastic else member
        prediction = replace(prediction, member=index)
        tensors = {name: value for name, value in vars(prediction).items() if isinstance(value, Tensor)}
        there, ready = _copied(tensors, self.multiview_device)
        return _Predicted(picture, T, K_image, replace(prediction, **there), member, ready)

    def _fused(
        self, predicted: _Predicted, valid: Array | None = None, anchors: Anchors | None = None
    ) -> UncertaintyOutput:
        with self._anchored(predicted, anchors) as (found, p):
            out = self.update(p, predicted.pose, p.K, valid, anchors=found)
        self._undo(out.statistics)
        return replace(out, member=predicted.member)

    @contextmanager
    def _anchored(
        self, predicted: _Predicted, anchors: Anchors | None, *, search: bool = True
    ) -> Iterator[tuple[Anchors | None, DepthPrediction]]:
        """The image's anchors at pixels of the depth map, and the prediction with whether the image shows something.
        Waits for the prediction's copies. Errors as :meth:`ImageEvidence.next_image`."""
        if predicted.ready is not None:
            predicted.ready.synchronize()
        p, K, skip = predicted.prediction, predicted.intrinsics, self.ufm.config.on_bad_frame == "skip"
        with self._evidence.next_image(
            predicted.image, predicted.pose, K, anchors, p.depth.device, search=search, skip=skip
        ) as (found, informative):
            if found is not None and self.preprocess not in (None, in_unit_range):
                found = require_anchors(found).moved(K, p.K)
            yield found, replace(p, informative=informative)

    def _undo(self, statistics: FrameStatistics) -> None:
        """Undo the updates by the image for streams that skipped it."""
        # Reading the faults synchronises with an accelerator.
        can_skip = self.ufm.config.on_bad_frame == "skip" and not statistics.fault.is_meta
        self._evidence.undo(statistics.fault.nonzero().flatten().tolist() if can_skip else [])

    def update(
        self,
        prediction: DepthPrediction,
        pose: CameraLike,
        intrinsics: CameraLike,
        valid: Array | None = None,
        *,
        anchors: Anchors | None = None,
    ) -> UncertaintyOutput:
        """Process an existing prediction, for example a cached one, as :meth:`forward` does after its networks.

        Args:
            prediction: [B, h, w].
            pose: as in :meth:`forward`.
            intrinsics: as in :meth:`forward`, of the depth map [px].
            valid: as in :meth:`forward`.
            anchors: [B, N] at pixels of the depth map, with ``config.anchors``; None = no anchors, even with a source.

        Raises:
            ValueError, TypeError: as :meth:`UfMStar.forward`; the image is then not counted.
        """
        require("prediction", prediction, DepthPrediction)
        maps = prediction.arguments(confidence=self.ufm.uses_confidence)
        out = self.ufm(pose=pose, intrinsics=intrinsics, valid=valid, anchors=anchors, **maps)
        self._next += 1
        if prediction.intrinsics is None:
            K = as_intrinsics(intrinsics)
            prediction = replace(prediction, intrinsics=K.expand(len(prediction.depth), 3, 3))
        return replace(out, prediction=prediction)

    def stream(
        self, frames: Iterable[tuple[ImageLike, CameraLike, CameraLike]]
    ) -> Generator[UncertaintyOutput, None, None]:
        """The predictions of a video, in order, with the networks one image ahead of UfM*.

        Both run at the same time: networks on a GPU with ``multiview_device="cpu"``, those on the CPU in a thread of
        their own, except under autocast. Each result is yielded after the next frame has been read,
        which may reuse the arrays of the one before.

        Args:
            frames: image, pose and intrinsics of each frame, as in :meth:`forward`.

        Raises:
            ValueError, TypeError: as :meth:`forward`.
        """
        waiting: _Predicted | None = None
        if isinstance(frames, Tensor | np.ndarray):
            raise TypeError(f"frames must be an iterable of (image, pose, intrinsics), got {type(frames).__name__}")
        with ThreadPoolExecutor(1, thread_name_prefix="network") as pool:
            for frame in require("frames", frames, Iterable):
                if not isinstance(frame, tuple | list) or len(frame) != 3:
                    raise TypeError(f"frames must yield (image, pose, intrinsics), got {type(frame).__name__}")
                if waiting is None or not self._networks_on_cpu():
                    try:
                        ahead = self._predicted(*frame, ahead=waiting is not None)
                    except Exception:  # of any kind, raised again once the caller has the result of the image before
                        if waiting is not None:
                            yield self._fused(waiting)
                        raise
                    before, waiting = waiting, ahead.copied()
                    if before is not None:
                        yield self._fused(before)
                    continue
                out, predicting = self._fused_beside(waiting, pool, frame)
                yield out
                waiting = predicting.result().copied()
        if waiting is not None:
            yield self._fused(waiting)

    def _fused_beside(
        self, predicted: _Predicted, pool: ThreadPoolExecutor, frame: Iterable[Any]
    ) -> tuple[UncertaintyOutput, Future[_Predicted]]:
        """The result of an image, and the prediction for the next one, which the networks compute in the pool's thread;
        they are idle when this returns."""
        predicting = pool.submit(self._predict, *frame, number=self._next + 1)
        try:
            return self._fused(predicted), predicting
        finally:
            wait([predicting])

    def _networks_on_cpu(self) -> bool:
        """True if :meth:`stream` runs the networks in a thread of their own. An accelerator needs no thread to work
        beside the CPU, and autocast is valid in the caller's thread alone."""
        device = self.device
        return (device is None or device.type == "cpu") and not torch.is_autocast_enabled("cpu")

    def mean_uncertainty(
        self,
        image: ImageLike,
        pose: CameraLike,
        intrinsics: CameraLike,
        valid: Array | None = None,
        *,
        anchors: Anchors | None = None,
        pixels: int | None = None,
        fraction: float | None = None,
        seed: int = 0,
    ) -> MeanUncertainty:
        """Like :meth:`forward`, but computes the average of V per image, for active learning. The default source of
        anchors does not search the image: V has B only from a source that the constructor was passed, or from earlier
        calls of :meth:`forward`.

        Args:
            image, pose, intrinsics, valid, anchors: as in :meth:`forward`.
            pixels, fraction, seed: as in :meth:`UfMStar.mean_uncertainty`.

        Raises:
            ValueError, TypeError: as :meth:`UfMStar.mean_uncertainty`; alternation and landmarks then do not advance.
        """
        predicted = self._predicted(image, pose, intrinsics)
        with self._anchored(predicted, anchors, search=not self._evidence.by_default) as (found, p):
            maps = p.arguments(confidence=self.ufm.uses_confidence)
            mean = self.ufm.mean_uncertainty(
                pose=predicted.pose, intrinsics=p.K, valid=valid, anchors=found,
                pixels=pixels, fraction=fraction, seed=seed, **maps,
            )  # fmt: skip
        self._undo(mean.statistics)
        self._next += 1
        return mean

    def warm_up(
        self,
        size: tuple[int, int] = (480, 640),
        *,
        streams: int = 1,
        progress: Callable[[int, int], object] | None = None,
    ) -> None:
        """Run every network twice on noise, and compile all kernels or load them from disk. State, evidence and the
        number of images do not change; a network with a state of its own sees the noise. Without this, the first images
        wait for the compiler and for the libraries of a GPU. Where there are two cores, a second process compiles the
        kernels of the search for anchors.

        Args:
            size: (H, W) of the images [px]; without networks, of the depth maps.
            streams: B.
            progress: as in :meth:`UfMStar.warm_up`.

        Raises:
            ValueError: as :meth:`UfMStar.warm_up`.
        """
        size, streams = require_size("size", size), require_whole("streams", streams, 1)
        searching = () if self.landmarks is None else self.landmarks.searching
        if self.networks:
            size = self.run_on_noise(size, streams)
        ufm = UfMStar(self.ufm.config, dtype=self.ufm.mean.dtype, device=self.ufm.mean.device)
        warm_up(ufm, size, streams, progress, searching)

    def _apply(self, fn: Callable[[Tensor], Tensor], recurse: bool = True) -> Self:
        """Move the networks; UfM* stays on ``multiview_device`` unless that is None."""
        super()._apply(fn, recurse)
        if self.multiview_device is not None:
            self.ufm.to(self.multiview_device)
        return self

    @property
    def image_index(self) -> int:
        """The number of processed images, i of the next one."""
        return self._next

    @property
    def landmarks(self) -> StreamLandmarks | None:
        """The sources of anchors of all streams; None without a source."""
        return self._evidence.landmarks

    def reset(self, streams: Sequence[int] | Tensor | None = None, *, keep_evidence: bool = False) -> None:
        """Reset UfM* (:meth:`UfMStar.reset`) and the landmarks; resetting all streams also restarts the alternation."""
        self.ufm.reset(streams, keep_evidence=keep_evidence)
        b = self.ufm.mean.shape[0]
        chosen = None if streams is None else self.ufm._chosen(streams, b).nonzero().flatten().tolist()
        self._evidence.reset(chosen)
        if chosen is None:
            self._next = 0

    def stream_state(self) -> dict[str, Tensor]:
        """Everything of a video on which the next results depend, but the networks' weights: the state of UfM*, the
        anchors' memory, and the number of processed images. The last image is no part of it: the next one cannot be
        recognised as the same. For :meth:`load_stream_state`; ``torch.save`` stores it."""
        state = {f"{_UFM}{name}": value.clone() for name, value in self.ufm.state_dict().items()}
        if self.landmarks is not None:
            state |= {f"{_LANDMARKS}{name}": value for name, value in self.landmarks.state().items()}
        return state | {_INDEX: torch.tensor(self._next)}

    def load_stream_state(self, state: Mapping[str, Tensor]) -> None:
        """Continue from a :meth:`stream_state`, bit for bit. All or nothing: if it raises, the module is unchanged.

        Raises:
            ValueError: the state is incomplete, of other sources of anchors, or invalid.
        """
        before = self.stream_state()
        try:
            self._load(require("state", state, Mapping))
        except BaseException:
            self._load(before)
            raise
        self._evidence.images.reset()

    def _load(self, state: Mapping[str, Tensor]) -> None:
        parts: dict[str, dict[str, Tensor]] = {_UFM: {}, _LANDMARKS: {}, "": {}}
        for key, value in state.items():
            prefix = next(prefix for prefix in parts if str(key).startswith(prefix))
            parts[prefix][str(key).removeprefix(prefix)] = value
        counts, ufm, landmarks = parts[""], parts[_UFM], parts[_LANDMARKS]
        for expected, present in ((self.ufm.state_dict().keys(), ufm.keys()), ({_INDEX}, counts.keys())):
            if wrong := sorted(expected ^ present):
                raise ValueError(f"the state must hold {', '.join(sorted(expected))}; missing or unknown: {wrong}")
        index = counts[_INDEX]
        if not isinstance(index, Tensor) or index.dtype != torch.int64 or index.dim() or bool(index < 0):
            raise ValueError(f"{_INDEX} must be a whole number of at least 0, got {index}")
        self.ufm.accepted(ufm)
        if self.landmarks is not None:
            self.landmarks.load_state(landmarks)
        elif landmarks:
            raise ValueError(f"state holds landmarks, for which the module has no source: {', '.join(landmarks)}")
        self.ufm.load_state_dict(ufm)
        self._next = int(index)


def _copied(values: dict[str, Tensor], device: torch.device | None) -> tuple[dict[str, Any], torch.cuda.Event | None]:
    """Copy the values to ``device`` (None: no copy). Copies from CUDA to the CPU are asynchronous, into pinned memory,
    and return an event to wait for."""
    if device is None:
        return values, None
    source = values["depth"].device
    if source.type != "cuda" or device.type != "cpu":
        return {name: value.to(device, non_blocking=True) for name, value in values.items()}, None
    copies = {name: torch.empty(value.shape, dtype=value.dtype, pin_memory=True) for name, value in values.items()}
    for name, value in values.items():
        copies[name].copy_(value.detach(), non_blocking=True)
    ready = torch.cuda.Event()
    ready.record(torch.cuda.current_stream(source))
    return copies, ready


def _require_passes(members: Sequence[nn.Module], mode: object, samples: object) -> None:
    """Raise a TypeError or ValueError unless the networks, their mode and ``samples`` fit."""
    single = len(members) == 1
    if not isinstance(mode, str) or mode not in ("alternate", "full"):
        raise ValueError(f"mode must be 'alternate' or 'full', got {mode!r}")
    if samples is not None and (require_whole("samples", samples) < 2 or not single or mode != "full"):
        raise ValueError("samples must be at least 2 and goes with one network in mode 'full'")
    if mode == "full" and single and samples is None:
        raise ValueError("mode 'full' needs several networks, or samples for a stochastic one")
    if len({id(member) for member in members}) < len(members):
        raise ValueError("networks must differ, got one of them twice: for passes of a stochastic one set samples")

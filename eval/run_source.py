"""Where a run's depth comes from: networks, a folder of maps that another program predicted, or the
sequence's own depth. Each source carries UfM* and its state."""

from __future__ import annotations

import hashlib
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from ufmstar_torch.camera import resize_intrinsics
from ufmstar_torch.config import UfMStarConfig
from ufmstar_torch.eval.ground_truth import depth_camera, resample_nearest, scaled_to_map
from ufmstar_torch.eval.run_clock import Stopwatch
from ufmstar_torch.eval.sequences.depth_folder import DepthFolder, DepthMaps
from ufmstar_torch.eval.sequences.frame import Frame, FrameError, Sequence, Size
from ufmstar_torch.eval.sequences.intrinsics import IntrinsicsLike, read_intrinsics
from ufmstar_torch.models.dropout import SAMPLES, MonteCarloDropout, set_sampling
from ufmstar_torch.models.ensemble import LazyMember
from ufmstar_torch.models.load import DIRECTORIES, load_network
from ufmstar_torch.models.network import DepthNetwork
from ufmstar_torch.models.trained import load_trained
from ufmstar_torch.pipeline import UncertainDepth, UncertainPrediction
from ufmstar_torch.prediction import DepthPrediction
from ufmstar_torch.ufmstar import UfMStar


class Source(ABC):
    """Depth with UfM*'s variance, frame by frame, in the order of a sequence.

    Attributes:
        identity: plain values that tell this source from another one: a run cannot go on with another.
        is_truth: whether the prediction is the sequence's own depth, so that it has no error to show.
        clock: the stages "network" and "ufm" of the frames.
    """

    is_truth = False

    def __init__(self, module: nn.Module, ufm: UfMStar, device: torch.device, identity: Mapping[str, Any]) -> None:
        self._module = module.to(device)
        self.ufm = ufm
        self.device = device
        self.identity = dict(identity)
        self.clock = Stopwatch(device)
        self.clock.watch(ufm, "ufm")

    @abstractmethod
    def predict(self, frame: Frame) -> UncertainPrediction:
        """Depth [1, h, w] and its variance; UfM* has taken the frame in.

        Raises:
            FrameError: the frame has nothing to predict from; nothing has changed then.
        """

    def state(self) -> dict[str, Tensor]:
        """Everything that the next prediction depends on, without the networks' weights."""
        return {k: v for k, v in self._module.state_dict().items() if not k.startswith("networks.")}

    def load_state(self, state: Mapping[str, Tensor]) -> None:
        """Go on where ``state`` was taken.

        Raises:
            ValueError: the state belongs to another kind of source.
        """
        result = self._module.load_state_dict(dict(state), strict=False)
        missing = [name for name in result.missing_keys if not name.startswith("networks.")]
        if missing or result.unexpected_keys:
            raise ValueError(f"the saved state lacks {missing} and has {result.unexpected_keys} too many")


class NetworkSource(Source):
    """Depth from networks.

    Args:
        pipeline: networks, alternation and UfM*. Decoder dropout gets a generator of this source.
        device: where they run.
        identity: see :class:`Source`.
    """

    def __init__(self, pipeline: UncertainDepth, device: torch.device, identity: Mapping[str, Any]) -> None:
        super().__init__(pipeline, pipeline.ufm, device, identity)
        self._pipeline = pipeline
        for network in pipeline.networks:
            self.clock.watch(network, "network")
        self._dropout = torch.Generator(device)
        for network in stochastic(pipeline.networks):
            set_sampling(network, True, self._dropout)

    def predict(self, frame: Frame) -> UncertainPrediction:
        """See :meth:`Source.predict`."""
        if frame.image is None:
            raise FrameError(frame.name, "no image")
        image = torch.from_numpy(frame.image).permute(2, 0, 1)[None].to(self.device)
        self._dropout.manual_seed(frame.index)  # of the frame alone: a resumed run draws the same
        # Pose and intrinsics stay on the host, where UfM* checks them without waiting for a device.
        pose, K = torch.from_numpy(frame.T_world_cam)[None], torch.from_numpy(frame.intrinsics)[None]
        return self._pipeline(image, pose, K)


@dataclass(frozen=True, eq=False)
class PredictedMap:
    """A depth map from elsewhere.

    Attributes:
        depth: [H, W] float32 [m], 0 = no prediction.
        variance: [H, W] float32 [m^2], or None.
        intrinsics: [3, 3] float64 of the map [px].
    """

    depth: np.ndarray
    variance: np.ndarray | None
    intrinsics: np.ndarray

    def resized(self, size: Size | None) -> PredictedMap:
        """At another size (h, w), by taking the nearest pixel."""
        old = (self.depth.shape[0], self.depth.shape[1])
        if size is None or size == old:
            return self
        K = resize_intrinsics(torch.from_numpy(self.intrinsics), old, size).numpy()
        variance = None if self.variance is None else resample_nearest(self.variance, self.intrinsics, K, size)
        return PredictedMap(resample_nearest(self.depth, self.intrinsics, K, size), variance, K)


class MapSource(Source):
    """Depth that is already there.

    Args:
        read: the map of a frame.
        config: of UfM*.
        size: (h, w) to which the maps are brought; None = as they are.
        device, identity: see :class:`Source`.
        is_truth: the maps are the sequence's own depth.
    """

    def __init__(
        self,
        read: Callable[[Frame], PredictedMap],
        config: UfMStarConfig,
        device: torch.device,
        identity: Mapping[str, Any],
        *,
        size: Size | None = None,
        is_truth: bool = False,
    ) -> None:
        ufm = UfMStar(config)
        super().__init__(ufm, ufm, device, identity)
        self._read, self._size, self.is_truth = read, size, is_truth

    def predict(self, frame: Frame) -> UncertainPrediction:
        """See :meth:`Source.predict`."""
        found = self._read(frame).resized(self._size)
        depth = torch.from_numpy(found.depth)[None].to(self.device)
        variance = None if found.variance is None else torch.from_numpy(found.variance)[None].to(self.device)
        pose, K = torch.from_numpy(frame.T_world_cam)[None], torch.from_numpy(found.intrinsics)[None]
        with torch.no_grad():
            ufm = self.ufm(depth, pose, K, variance)
        return UncertainPrediction(DepthPrediction(depth, variance), ufm, K, None)


def network_source(
    model: str,
    weights: Iterable[str | Path],
    config: UfMStarConfig,
    *,
    spec: str | Path | None = None,
    mode: str = "alternate",
    samples: int | None = None,
    offload: bool = False,
    threads: int | None = None,
    device: str = "cpu",
) -> NetworkSource:
    """One network, or the members of an ensemble, from files.

    Args:
        model: a name that ``load_network`` knows.
        weights: one file for each member (a directory for networks of ``transformers``); those of "trained" may hold
            several.
        config: of UfM*.
        spec: declares what an ONNX file or saved program does not say.
        mode: "alternate" (one member per image in turn) or "full" (all of them on every image, or ``samples``
            passes of a network that samples).
        samples: None: as many as the paper's baseline.
        offload: of "trained": weights stay in host memory and come to the device for their turn only.
        threads: CPU threads of ONNX Runtime; None = its own choice.
        device: "cpu", "cuda", ...

    Raises:
        FileNotFoundError: a file is missing.
        ValueError: unknown model, files that do not fit it, members that want different inputs, mode "full"
            of one network that does not sample, ``samples`` for any other.
    """
    files = [Path(file) for file in weights]
    members = load_members(model, files, spec=spec, offload=offload, threads=threads)
    samples = _passes(members, mode, samples)
    pipeline = UncertainDepth(members, config, mode=mode, samples=samples, preprocess=members[0].preprocess)
    identity = {
        "model": model,
        "weights": [{"name": file.name, "sha256": sha256(file)} for file in files],
        "mode": mode,
        "samples": samples,
        "spec": None if spec is None else sha256(Path(spec)),
    }
    return NetworkSource(pipeline, torch.device(device), identity)


def load_members(
    model: str,
    files: Iterable[str | Path],
    *,
    spec: str | Path | None = None,
    offload: bool = False,
    threads: int | None = None,
) -> list[DepthNetwork]:
    """The networks in the files, in their order, in eval mode and on the CPU. They want the same input.

    Args:
        model, spec, offload, threads: as :func:`network_source` has them.
        files: of weights.

    Raises:
        FileNotFoundError, ValueError: as :func:`network_source`.
    """
    paths = [Path(file) for file in files]
    for folder in paths if model in DIRECTORIES else []:
        if not folder.is_dir():
            fetch = "`hf download NAME --local-dir DIR` fetches a checkpoint from the hub"
            raise FileNotFoundError(f"no such directory: {folder}; {fetch}")
    for file in [*(paths if model not in DIRECTORIES else []), *([Path(spec)] if spec is not None else [])]:
        if not file.is_file():
            raise FileNotFoundError(f"no such file: {file}")
    options: dict[str, Any] = {} if spec is None else {"spec": spec}
    if model == "onnx" and threads is not None:
        options["threads"] = threads
    members = _loaded(model, paths, options, offload)
    require_same_input(members)
    return members


def require_same_input(members: Iterable[DepthNetwork]) -> None:
    """Raises ValueError unless the members of an ensemble want the same input."""
    wanted = [member.preprocess for member in members]
    if any(other != wanted[0] for other in wanted[1:]):
        raise ValueError(f"weights: the members of an ensemble must want the same input, got {wanted}")


def _loaded(model: str, files: list[Path], options: Mapping[str, Any], offload: bool) -> list[DepthNetwork]:
    """The networks in the files.

    Raises:
        ValueError: as :func:`network_source`.
    """
    if model == "trained" and not options:
        return load_trained(files, offload=offload)
    try:
        return [load_network(model, file, **options) for file in files]
    except TypeError as error:
        raise ValueError(f"model {model!r} does not take {sorted(options)}: {error}") from error


def _passes(members: list[DepthNetwork], mode: str, samples: int | None) -> int | None:
    """Passes per image of a network that samples, None of others.

    Raises:
        ValueError: mode or samples ask for what the members cannot do.
    """
    alone = len(members) == 1 and mode == "full"
    if alone and not stochastic(members):
        raise ValueError("mode 'full' needs several members, or one with dropout that samples; there is one without")
    if samples is not None and not alone:
        raise ValueError(f"samples goes with mode 'full' and one network that samples, there are {len(members)}")
    return (samples or SAMPLES) if alone else None


def stochastic(networks: Iterable[nn.Module]) -> list[MonteCarloDropout]:
    """Those of the networks that sample."""
    found = [network.network() if isinstance(network, LazyMember) else network for network in networks]
    return [network for network in found if isinstance(network, MonteCarloDropout)]


def folder_source(
    sequence: Sequence,
    folder: str | Path,
    config: UfMStarConfig,
    *,
    variance: str | Path | None = None,
    scale: float | None = None,
    intrinsics: IntrinsicsLike | None = None,
    size: Size | None = None,
    device: str = "cpu",
) -> MapSource:
    """Maps that another program predicted for the frames of a sequence (see :class:`DepthFolder`).

    Without ``intrinsics``, the maps must show the whole image; theirs are then the image's, scaled by the
    sizes' ratio.

    Args:
        sequence: the frames.
        folder, scale, variance: as :class:`DepthFolder` takes them.
        config: of UfM*.
        intrinsics: of the maps [px], where the network saw a part of the image.
        size, device: see :class:`MapSource`.

    Raises:
        NotADirectoryError: no such folder.
        ValueError: no maps, maps that fit no frame, or (the first one) of another aspect ratio than the images.
    """
    maps = DepthFolder(folder, scale, variance).for_frames(sequence.names, sequence.names_on_disk)
    K_given = None if intrinsics is None else read_intrinsics(intrinsics)

    def read(frame: Frame) -> PredictedMap:
        depth, spread = maps[frame.index]
        if K_given is not None:
            return PredictedMap(depth, spread, K_given)
        try:
            K = scaled_to_map(frame.intrinsics, sequence.image_size, (depth.shape[0], depth.shape[1]))
        except ValueError as error:
            raise FrameError(maps.depth_files[frame.index], _cropped(sequence, depth)) from error
        return PredictedMap(depth, spread, K)

    _check_first(sequence, maps, K_given is not None)
    files = (*maps.depth_files, *maps.variance_files)
    listing = "\n".join(f"{file.name} {file.stat().st_size}" for file in files)
    identity = {
        "maps": {"count": len(maps.depth_files), "names_and_sizes": hashlib.sha256(listing.encode()).hexdigest()},
        "with_variance": variance is not None,
        "scale": scale,
        "intrinsics": K_given,
        "size": size,
    }
    return MapSource(read, config, torch.device(device), identity, size=size)


def _check_first(sequence: Sequence, maps: DepthMaps, any_shape: bool) -> None:
    """Raises ValueError at once where the first map has another shape than the images, as then all have."""
    try:
        depth, _ = maps[0]
        if not any_shape:
            scaled_to_map(sequence.intrinsics, sequence.image_size, (depth.shape[0], depth.shape[1]))
    except FrameError:  # counted when its turn comes
        return
    except ValueError as error:
        raise ValueError(f"{maps.depth_files[0]}: {_cropped(sequence, depth)}") from error


def _cropped(sequence: Sequence, depth: np.ndarray) -> str:
    height, width = sequence.image_size or (0, 0)
    return (
        f"the map is {depth.shape[1]}x{depth.shape[0]}, the images are {width}x{height}: it does not show the whole "
        "image, so its own intrinsics must be given"
    )


def own_depth_source(config: UfMStarConfig, *, size: Size | None = None, device: str = "cpu") -> MapSource:
    """The sequence's own depth as the prediction: what UfM* says of perfect depth, the method's floor."""

    def read(frame: Frame) -> PredictedMap:
        if frame.depth is None:
            raise FrameError(frame.name, "no depth map")
        return PredictedMap(frame.depth, None, depth_camera(frame))

    identity = {"maps": "the sequence's own depth", "size": size}
    return MapSource(read, config, torch.device(device), identity, size=size, is_truth=True)


def sha256(file: Path) -> str:
    """Hex digest of a file's content; of a directory's files and their names, but for hidden ones (a download's)."""
    if file.is_dir():
        names = sorted(path.relative_to(file) for path in file.rglob("*") if path.is_file())
        shown = [name for name in names if not any(part.startswith(".") for part in name.parts)]
        listing = "\n".join(f"{name.as_posix()} {sha256(file / name)}" for name in shown)
        return hashlib.sha256(listing.encode()).hexdigest()
    with file.open("rb") as opened:
        return hashlib.file_digest(opened, "sha256").hexdigest()

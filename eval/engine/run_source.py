"""Where a run's depth comes from: networks, or maps that are already there (``run_maps``). Each source carries UfM* and
its state."""

from __future__ import annotations

import hashlib
from abc import ABC, abstractmethod
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn

from ufmstar_torch.anchors.given import Anchors
from ufmstar_torch.config import UfMStarConfig
from ufmstar_torch.eval.engine.run_anchors import RunAnchors, of_tracker
from ufmstar_torch.eval.engine.run_clock import Stopwatch
from ufmstar_torch.eval.sequences.frame import Frame
from ufmstar_torch.eval.sequences.images import image_tensor
from ufmstar_torch.models.dropout import SAMPLES, MonteCarloDropout, set_sampling
from ufmstar_torch.models.ensemble import LazyMember
from ufmstar_torch.models.load import DIRECTORIES, load_network
from ufmstar_torch.models.network import DepthNetwork
from ufmstar_torch.models.trained import load_trained
from ufmstar_torch.pipeline import UncertainDepth, UncertainPrediction
from ufmstar_torch.ufmstar import UfMStar


class Source(ABC):
    """Depth with UfM*'s variance, frame by frame, in the order of a sequence.

    Attributes:
        identity: plain values that tell this source from another one: a run cannot go on with another.
        is_truth: whether the prediction is the sequence's own depth, so that it has no error to show.
        clock: the stages "network", "ufm" and "anchors" of the frames.
        anchors: the tracker, with ``config.anchored``; else None.
    """

    is_truth = False

    def __init__(self, module: nn.Module, ufm: UfMStar, device: torch.device, identity: Mapping[str, Any]) -> None:
        self._module = module.to(device)
        self.ufm = ufm
        self.device = device
        self.anchors = RunAnchors() if ufm.config.anchored else None
        self.identity = dict(identity) | ({} if self.anchors is None else self.anchors.identity)
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
        own = {k: v for k, v in self._module.state_dict().items() if not k.startswith("networks.")}
        return own if self.anchors is None else {**own, **self.anchors.state()}

    def load_state(self, state: Mapping[str, Tensor]) -> None:
        """Go on where ``state`` was taken.

        Raises:
            ValueError: the state belongs to another kind of source.
        """
        tracker, rest = of_tracker(state)
        if self.anchors is not None:
            self.anchors.load_state(tracker)
        result = self._module.load_state_dict(rest, strict=False)
        missing = [name for name in result.missing_keys if not name.startswith("networks.")]
        if missing or result.unexpected_keys:
            raise ValueError(f"the saved state lacks {missing} and has {result.unexpected_keys} too many")

    def reset(self) -> None:
        """Go back to the start."""
        self.ufm.reset()
        if self.anchors is not None:
            self.anchors.reset()

    def anchors_of(self, frame: Frame) -> Anchors | None:
        """Those of the next frame, in its image's pixels; None without ``config.anchored`` or without an image."""
        if self.anchors is None:
            return None
        with self.clock.stage("anchors"):
            found = self.anchors.of(frame)
        return None if found is None else found.to(self.device)


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
        image = image_tensor(frame).to(self.device)
        self._dropout.manual_seed(frame.index)  # of the frame alone: a resumed run draws the same
        # Pose and intrinsics stay on the host, where UfM* checks them without waiting for a device.
        pose, K = torch.from_numpy(frame.T_world_cam)[None], torch.from_numpy(frame.intrinsics)[None]
        return self._pipeline(image, pose, K, anchors=self.anchors_of(frame))


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


def sha256(file: Path) -> str:
    """Hex digest of a file's content; of a directory's files and their names, but for hidden ones (a download's)."""
    if file.is_dir():
        names = sorted(path.relative_to(file) for path in file.rglob("*") if path.is_file())
        shown = [name for name in names if not any(part.startswith(".") for part in name.parts)]
        listing = "\n".join(f"{name.as_posix()} {sha256(file / name)}" for name in shown)
        return hashlib.sha256(listing.encode()).hexdigest()
    with file.open("rb") as opened:
        return hashlib.file_digest(opened, "sha256").hexdigest()

"""A job of ``ufmstar run``: from its options, and its identity: the values on which the results depend."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cached_property
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np
import torch

from ufmstar_torch.anchors.landmarks import DENSE, LandmarkSource
from ufmstar_torch.anchors.tracker import LandmarkTracker
from ufmstar_torch.config import UfMStarConfig
from ufmstar_torch.eval.check.image_fit import FollowedCorners, ImageFit, image_fit, track_corners
from ufmstar_torch.eval.engine.anchors import AnchorSource, Tracks, landmarks_of
from ufmstar_torch.eval.engine.estimators import Gaussians
from ufmstar_torch.eval.engine.judge import UFM, RunMetrics
from ufmstar_torch.eval.engine.load import network_source
from ufmstar_torch.eval.engine.maps import folder_source, own_depth
from ufmstar_torch.eval.engine.predictions import DepthSource
from ufmstar_torch.eval.engine.rows import RowRunner
from ufmstar_torch.eval.methods.setting import CORNERS, Setting
from ufmstar_torch.eval.run.run_folder import Checkpoint
from ufmstar_torch.eval.run.scale import NetworkScale, network_scale, require_metric
from ufmstar_torch.eval.sequences.frame import FrameError, FrameSequence, parse_size, parse_slice
from ufmstar_torch.eval.sequences.intrinsics import parse_intrinsics
from ufmstar_torch.eval.sequences.open import scale_poses
from ufmstar_torch.eval.sequences.plugins import load_plugins
from ufmstar_torch.models.inference import Inference
from ufmstar_torch.recalibrate import Recalibration, beside
from ufmstar_torch.ufmstar import UfMStar

_OWN_DEPTH = ("self", "ground-truth")


@dataclass(frozen=True, eq=False)
class RunJob:
    """A run: its sequence, network and settings."""

    sequence: FrameSequence  # the posed frames
    indices: range  # which of them, in order
    source: DepthSource  # of the depth
    config: UfMStarConfig  # of UfM*
    device: torch.device  # of UfM*
    settings: Mapping[str, Any]  # everything the user chose, as plain values, for the summary
    recalibration: Recalibration | None = None  # of the variance
    every: bool = False  # all members predict on every image, instead of one in turn
    video: bool = True  # whether to make preview.mp4
    sheet: bool = True  # whether to make contact_sheet.png
    # makes the source of the anchors, in its initial state; for ``config.anchors``.
    landmarks: Callable[[], LandmarkSource] = LandmarkTracker
    scale: NetworkScale | None = None  # of the poses, where it is the network's own; anchors then show shape alone

    @cached_property
    def corners(self) -> list[FollowedCorners]:
        """Corners tracked over some of the frames."""
        return track_corners(self.sequence, self.indices)

    @cached_property
    def image_fit(self) -> ImageFit | None:
        """The fit of poses and intrinsics to the images; None where no corner could be followed."""
        return image_fit(self.sequence, self.corners)

    def metrics(self, checkpoint: Checkpoint) -> RunMetrics:
        """The metrics, those of plug-ins included, with the sums of a checkpoint."""
        return RunMetrics(UFM, checkpoint.metrics, load_plugins(self.settings.get("plugin", ())).metrics)

    def row(self, checkpoint: Checkpoint) -> RowRunner:
        """UfM* on the source, in the state of a checkpoint."""
        estimator = Gaussians(self.config, self.device, recalibration=self.recalibration)
        anchors = None
        if self.config.anchors is not None:
            anchors = AnchorSource(Setting(anchors=CORNERS), Tracks(self.landmarks()))
        how: dict[str, Any] = {"every": self.every, "anchors": anchors, "device": self.device}
        row = RowRunner(UFM, self.source, estimator, skips_faults=True, **how)
        if checkpoint.state:
            row.load_state(checkpoint.state)
        return row

    def ufm(self, checkpoint: Checkpoint) -> UfMStar:
        """UfM* in the state of a checkpoint; the running one may be some frames ahead."""
        estimator = self.row(checkpoint).estimator
        assert isinstance(estimator, Gaussians)
        return estimator.ufm

    @property
    def source_identity(self) -> dict[str, Any]:
        """Plain values on which depth and anchors depend."""
        return {**self.source.identity, **(self.landmarks().identity if self.config.anchors is not None else {})}

    def identity(self) -> dict[str, Any]:
        """Plain values on which the results depend. A run is only continued with the same ones."""
        sequence, digest = self.sequence, hashlib.sha256()
        for index in self.indices:
            entry = sequence.entries[index]
            digest.update(entry.name.encode() + entry.T_world_cam.tobytes())
            if entry.intrinsics is not None:
                digest.update(entry.intrinsics.tobytes())
        return {
            "sequence": {
                "name": sequence.name,
                "layout": sequence.layout,
                "frames": len(self.indices),
                "names_and_poses": digest.hexdigest(),
                "intrinsics": sequence.intrinsics,
                "depth_intrinsics": sequence.depth_intrinsics,
                "first_frame": self._first_frame(),
            },
            "ufm": self.config.to_dict(),
            "source": self.source_identity,
            "device": self.device.type,
            **({"recalibration": self.recalibration.to_dict()} if self.recalibration else {}),
        }

    def _first_frame(self) -> str | None:
        """A digest of the first frame's pixels, which other data under the same names would not have."""
        try:
            frame = self.sequence[self.indices[0]]
        except FrameError:
            return None
        maps = [array for array in (frame.image, frame.depth) if array is not None]
        return hashlib.sha256(b"".join(np.ascontiguousarray(array).tobytes() for array in maps)).hexdigest()


def make_job(
    options: Mapping[str, Any], config: UfMStarConfig, sequence: FrameSequence, networks: DepthSource | None = None
) -> RunJob:
    """Load networks or maps (or take ``networks`` of an earlier job with the same options), and make the job of the
    options of ``ufmstar run``, as plain values by name; they are kept in the summary.

    Raises:
        ValueError: options that contradict each other, files that do not fit, no frame selected.
        FileNotFoundError, NotADirectoryError: no such file or folder.
        ModuleNotFoundError: an optional package is missing.
    """
    if not sequence.posed:
        raise ValueError(f"{sequence.name!r} holds single images without poses, which UfM* needs to compare views")
    indices = range(len(sequence))[parse_slice(options["frames"])]
    if not indices:
        raise ValueError(f"--frames {options['frames']} selects none of the {len(sequence)} frames")
    scale = None
    if options["scale_from"] is None:
        require_metric(sequence)
    known = networks is not None and networks.needs_image
    source = networks if networks is not None and known else _source(options, sequence, indices)
    if options["scale_from"] is not None:
        scale = network_scale(sequence, source, indices)
        sequence = scale_poses(sequence, scale.metres)
    landmarks = _landmarks(options["anchors"] or DENSE, sequence) if config.anchors else LandmarkTracker
    return RunJob(
        sequence=sequence,
        indices=indices,
        source=source,
        config=config.within(source.max_depth, source.states_confidence),
        recalibration=recalibration_of(options, config, source),
        device=torch.device(options["device"]),
        settings=options,
        every=options["model"] is not None and options["mode"] == "full",
        video=not options["no_video"],
        sheet=not options["no_sheet"],
        landmarks=landmarks,
        scale=scale,
    )


def recalibration_of(options: Mapping[str, Any], config: UfMStarConfig, source: DepthSource) -> Recalibration | None:
    """The recalibration of ``--recalibration``, or of the file beside the weights; None: there is neither. Raises
    FileNotFoundError: the named file does not exist; ValueError: it is no recalibration, or was fitted under other
    settings or to another network."""
    name, weights = options["recalibration"], options["weights"]
    if name == "none" or (name is None and not (weights and beside(weights[0]).is_file())):
        return None
    file = beside(weights[0]) if name is None else Path(name)
    try:
        recalibration = Recalibration.from_json(file)
        recalibration.require(config, ", ".join(one["name"] for one in source.identity.get("files", ())))
    except ValueError as error:
        raise ValueError(f"{file}: {error}; --recalibration none runs without it") from error
    return recalibration


def _landmarks(value: str | bool, sequence: FrameSequence) -> Callable[[], LandmarkSource]:
    """Makes the source of anchors in its initial state. Raises ValueError, ModuleNotFoundError: images to track in, or
    OpenCV, are missing; others as ``landmarks_of``."""
    source = landmarks_of(value, sequence.folder, sequence.pose_scale)
    if source.needs_image and all(entry.load_image is None for entry in sequence.entries):
        raise ValueError(f"--anchors tracks corners of images, of which the sequence {sequence.name!r} has none")
    if source.needs_image and find_spec("cv2") is None:
        raise ModuleNotFoundError("--anchors needs OpenCV: pip install 'ufmstar-torch[eval]'")
    # A map of landmarks keeps no state and is read once.
    return (lambda: landmarks_of(value, sequence.folder)) if source.needs_image else (lambda: source)


def _source(options: Mapping[str, Any], sequence: FrameSequence, indices: range) -> DepthSource:
    size = parse_size(options["size"])
    if options["model"] is not None:
        return network_source(
            options["model"],
            options["weights"],
            spec=options["spec"],
            mode=options["mode"],
            samples=options["samples"],
            offload=options["offload"],
            inference=Inference(options["runtime"], options["precision"], options["threads"]),
            device=options["device"],
        )
    if options["depth"] in _OWN_DEPTH:
        if len(sequence.without_depth) == len(sequence):
            raise ValueError(f"--depth {options['depth']}: the sequence {sequence.name!r} has no depth maps")
        return own_depth(size)
    return folder_source(
        sequence,
        options["depth"],
        variance=options["variance"],
        scale=options["depth_scale"],
        intrinsics=parse_intrinsics(options["map_intrinsics"], "--map-intrinsics"),
        size=size,
        indices=indices,
    )

"""``make_job``: the job of ``ufmstar run`` from its options."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import torch

from ufmstar_torch.anchors.landmarks import DENSE, LandmarkSource
from ufmstar_torch.anchors.tracker import LandmarkTracker
from ufmstar_torch.config import UfMStarConfig
from ufmstar_torch.eval.engine.anchors import landmarks_of
from ufmstar_torch.eval.engine.load import network_source
from ufmstar_torch.eval.engine.maps import folder_source, own_depth
from ufmstar_torch.eval.engine.predictions import DepthSource
from ufmstar_torch.eval.run.job import RunJob
from ufmstar_torch.eval.run.scale import network_scale, require_metric
from ufmstar_torch.eval.sequences.frame import FrameSequence, parse_size, parse_slice
from ufmstar_torch.eval.sequences.intrinsics import parse_intrinsics
from ufmstar_torch.eval.sequences.open import scale_poses
from ufmstar_torch.models.inference import Inference
from ufmstar_torch.recalibrate import Recalibration, beside

_OWN_DEPTH = ("self", "ground-truth")


def make_job(
    options: Mapping[str, Any], config: UfMStarConfig, sequence: FrameSequence, networks: DepthSource | None = None
) -> RunJob:
    """Load networks or maps, and make the job.

    Args:
        options: of ``ufmstar run`` by name, as plain values; kept in the summary.
        config: of UfM*.
        sequence: the frames.
        networks: those of an earlier job with the same options; None = they are loaded.

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
    """The map that is named or lies beside the weights; None = none.

    Raises:
        FileNotFoundError: the named file does not exist.
        ValueError: it is no recalibration, or was fitted under other settings or to another network.
    """
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
    """Makes the source of anchors in its initial state.

    Raises:
        FileNotFoundError: no such file.
        ValueError: an unknown source, or the sequence has no images to track in.
        ModuleNotFoundError: OpenCV is not installed.
    """
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

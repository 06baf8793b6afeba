"""From the options of ``ufmstar run`` to a job: opens the sequence and the depth source."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import torch

from ufmstar_torch.anchors.landmarks import DENSE, LandmarkSource
from ufmstar_torch.anchors.tracker import LandmarkTracker
from ufmstar_torch.eval.commands.run import RunJob
from ufmstar_torch.eval.commands.run_command import OWN_DEPTH, RunOptions
from ufmstar_torch.eval.engine.anchors import landmarks_of
from ufmstar_torch.eval.engine.load import network_source
from ufmstar_torch.eval.engine.maps import folder_source, own_depth
from ufmstar_torch.eval.engine.predictions import DepthSource
from ufmstar_torch.eval.results.machine import require_device
from ufmstar_torch.eval.sequences import FrameSequence
from ufmstar_torch.eval.sequences.frame import parse_size, parse_slice
from ufmstar_torch.eval.sequences.intrinsics import parse_intrinsics
from ufmstar_torch.eval.tour.open import open_sequence
from ufmstar_torch.models.inference import Inference
from ufmstar_torch.recalibrate import beside, named, read_recalibration


def job_from(chosen: RunOptions) -> RunJob:
    """The job that the options describe.

    Raises:
        ValueError: options that do not go together, files that do not fit, no frame selected.
        FileNotFoundError, NotADirectoryError: something that was named does not exist.
        ModuleNotFoundError: an optional package is missing.
    """
    options, config = chosen.settings(), chosen.config
    device = require_device(options["device"])
    sequence = _sequence(chosen)
    landmarks = _landmarks(chosen.uncertainty.anchors or DENSE, sequence) if config.anchored else LandmarkTracker
    indices = range(len(sequence))[parse_slice(options["frames"])]
    if not indices:
        raise ValueError(f"--frames {options['frames']} selects none of the {len(sequence)} frames")
    source = _source(options, sequence, indices, device)
    return RunJob(
        sequence=sequence,
        indices=indices,
        source=source,
        config=config.within(source.max_depth),
        recalibration=_recalibration(chosen, source),
        device=torch.device(device),
        settings=options,
        every=options["model"] is not None and options["mode"] == "full",
        video=not options["no_video"],
        sheet=not options["no_sheet"],
        landmarks=landmarks,
    )


def _recalibration(chosen: RunOptions, source: DepthSource) -> str:
    """FILE@DIGEST of the map that is named or lies beside the weights; "" = none.

    Raises:
        FileNotFoundError: the named file does not exist.
        ValueError: it is no recalibration, or was fitted under other settings or to another network.
    """
    name, weights = chosen.uncertainty.recalibration, chosen.network.weights
    if name == "none" or (name is None and not (weights and beside(weights[0]).is_file())):
        return ""
    file = beside(weights[0]) if name is None else Path(name)
    try:
        files = source.identity.get("weights", ())
        read_recalibration(str(file)).require(chosen.config, [one["sha256"] for one in files])
    except ValueError as error:
        raise ValueError(f"{file}: {error}; --recalibration none runs without it") from error
    return named(file)


def _sequence(chosen: RunOptions) -> FrameSequence:
    sequence = open_sequence(chosen.sequence, **chosen.opening.given())
    if not sequence.posed:
        raise ValueError(f"{sequence.name!r} holds single images without poses, which UfM* needs to compare views")
    return sequence


def _landmarks(value: str | bool, sequence: FrameSequence) -> Callable[[], LandmarkSource]:
    """Makes the source of anchors in its initial state.

    Raises:
        FileNotFoundError: no such file.
        ValueError: an unknown source, or the sequence has no images to track in.
        ModuleNotFoundError: OpenCV is not installed.
    """
    source = landmarks_of(value, sequence.folder)
    if source.needs_image and all(entry.load_image is None for entry in sequence.entries):
        raise ValueError(f"--anchors tracks corners of images, of which the sequence {sequence.name!r} has none")
    if source.needs_image and find_spec("cv2") is None:
        raise ModuleNotFoundError("--anchors needs OpenCV: pip install 'ufmstar-torch[eval]'")
    # A map of landmarks remembers no image, and is read once.
    return (lambda: landmarks_of(value, sequence.folder)) if source.needs_image else (lambda: source)


def _source(options: Mapping[str, Any], sequence: FrameSequence, indices: range, device: str) -> DepthSource:
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
            device=device,
        )
    if options["depth"] in OWN_DEPTH:
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

"""From the options of ``ufmstar run`` to a job: opens the sequence and the depth source."""

from __future__ import annotations

from collections.abc import Mapping
from importlib.util import find_spec
from typing import Any

import torch

from ufmstar_torch.eval.commands.run import RunJob
from ufmstar_torch.eval.commands.run_command import OWN_DEPTH, RunOptions
from ufmstar_torch.eval.engine.load import network_source
from ufmstar_torch.eval.engine.maps import folder_source, own_depth
from ufmstar_torch.eval.engine.predictions import DepthSource
from ufmstar_torch.eval.results.machine import require_device
from ufmstar_torch.eval.sequences import FrameSequence
from ufmstar_torch.eval.sequences.frame import parse_size, parse_slice
from ufmstar_torch.eval.sequences.intrinsics import parse_intrinsics
from ufmstar_torch.eval.tour.open import open_sequence
from ufmstar_torch.models.inference import Inference


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
    if config.anchored:
        _require_images(sequence)
    indices = range(len(sequence))[parse_slice(options["frames"])]
    if not indices:
        raise ValueError(f"--frames {options['frames']} selects none of the {len(sequence)} frames")
    return RunJob(
        sequence=sequence,
        indices=indices,
        source=_source(options, sequence, device),
        config=config,
        device=torch.device(device),
        settings=options,
        every=options["model"] is not None and options["mode"] == "full",
        video=not options["no_video"],
        sheet=not options["no_sheet"],
    )


def _sequence(chosen: RunOptions) -> FrameSequence:
    sequence = open_sequence(chosen.sequence, **chosen.opening.given())
    if not sequence.posed:
        raise ValueError(f"{sequence.name!r} holds single images without poses, which UfM* needs to compare views")
    return sequence


def _require_images(sequence: FrameSequence) -> None:
    """What tracking needs.

    Raises:
        ValueError: the sequence has no images.
        ModuleNotFoundError: OpenCV is not installed.
    """
    if all(entry.load_image is None for entry in sequence.entries):
        raise ValueError(f"--anchors tracks corners of images, of which the sequence {sequence.name!r} has none")
    if find_spec("cv2") is None:
        raise ModuleNotFoundError("--anchors needs OpenCV: pip install 'ufmstar-torch[eval]'")


def _source(options: Mapping[str, Any], sequence: FrameSequence, device: str) -> DepthSource:
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
    )

"""From the options of ``ufmstar run`` to a job: opens the sequence and the depth source."""

from __future__ import annotations

from collections.abc import Mapping
from importlib.util import find_spec
from typing import Any

import torch

from ufmstar_torch.config import UfMStarConfig
from ufmstar_torch.eval.commands.run import RunJob
from ufmstar_torch.eval.commands.run_options import OWN_DEPTH, check_options, parse_intrinsics, parse_size, parse_slice
from ufmstar_torch.eval.engine.load import network_source
from ufmstar_torch.eval.engine.maps import folder_source, own_depth
from ufmstar_torch.eval.engine.predictions import DepthSource
from ufmstar_torch.eval.results.machine import require_device
from ufmstar_torch.eval.sequences import FrameSequence, open_sequence

# How a run is carried out; the rest of the options says what is run.
_CONDUCT = ("resume", "overwrite", "debug", "config")


def job_from(options: Mapping[str, Any]) -> RunJob:
    """The job that the options (``parse_run``) describe.

    Raises:
        ValueError: options that do not go together, files that do not fit, no frame selected.
        FileNotFoundError, NotADirectoryError: something that was named does not exist.
        ModuleNotFoundError: an optional package is missing.
    """
    check_options(options)
    config = UfMStarConfig.from_dict(options["ufm"])
    device = require_device(options["device"])
    chosen = parse_slice(options["frames"])
    sequence = _sequence(options)
    if config.anchored:
        _require_images(sequence)
    indices = range(len(sequence))[chosen]
    if not indices:
        raise ValueError(f"--frames {options['frames']} selects none of the {len(sequence)} frames")
    return RunJob(
        sequence=sequence,
        indices=indices,
        source=_source(options, sequence, device),
        config=config,
        device=torch.device(device),
        settings={name: value for name, value in options.items() if name not in _CONDUCT},
        every=options["model"] is not None and options["mode"] == "full",
        video=not options["no_video"],
        sheet=not options["no_sheet"],
    )


def _sequence(options: Mapping[str, Any]) -> FrameSequence:
    sequence = open_sequence(
        options["sequence"],
        options["layout"],
        intrinsics=parse_intrinsics(options["intrinsics"], "--intrinsics"),
        depth_intrinsics=parse_intrinsics(options["depth_intrinsics"], "--depth-intrinsics"),
        trajectory=options["trajectory"],
        images=options["images"],
        depth=options["truth"],
        depth_scale=options["truth_scale"],
        max_pose_gap=options["max_pose_gap"],
        fps=options["fps"],
        time_offset=options["time_offset"],
    )
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
            threads=options["threads"],
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

"""From the options of ``ufmstar run`` to a job: opens the sequence and the depth source."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from ufmstar_torch.config import UfMStarConfig
from ufmstar_torch.eval.commands.run import Job
from ufmstar_torch.eval.commands.run_command import OWN_DEPTH, RunOptions
from ufmstar_torch.eval.engine.run_anchors import require_images
from ufmstar_torch.eval.engine.run_maps import folder_source, own_depth_source
from ufmstar_torch.eval.engine.run_source import Source, network_source
from ufmstar_torch.eval.results.machine import require_device
from ufmstar_torch.eval.sequences import FrameSequence
from ufmstar_torch.eval.sequences.frame import parse_size, parse_slice
from ufmstar_torch.eval.sequences.intrinsics import parse_intrinsics
from ufmstar_torch.eval.tour.open import open_sequence


def job_from(chosen: RunOptions) -> Job:
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
        require_images(sequence)
    indices = range(len(sequence))[parse_slice(options["frames"])]
    if not indices:
        raise ValueError(f"--frames {options['frames']} selects none of the {len(sequence)} frames")
    return Job(
        sequence=sequence,
        indices=indices,
        source=_source(options, config, sequence, device),
        settings=options,
        video=not options["no_video"],
        sheet=not options["no_sheet"],
    )


def _sequence(chosen: RunOptions) -> FrameSequence:
    sequence = open_sequence(chosen.sequence, **chosen.opening.given())
    if not sequence.posed:
        raise ValueError(f"{sequence.name!r} holds single images without poses, which UfM* needs to compare views")
    return sequence


def _source(options: Mapping[str, Any], config: UfMStarConfig, sequence: FrameSequence, device: str) -> Source:
    size = parse_size(options["size"])
    if options["model"] is not None:
        return network_source(
            options["model"],
            options["weights"],
            config,
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
        return own_depth_source(config, size=size, device=device)
    return folder_source(
        sequence,
        options["depth"],
        config,
        variance=options["variance"],
        scale=options["depth_scale"],
        intrinsics=parse_intrinsics(options["map_intrinsics"], "--map-intrinsics"),
        size=size,
        device=device,
    )

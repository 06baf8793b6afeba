"""Sequences by path or name: recordings on disk, and rendered tours as ``tour:SEED``."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from ufmstar_torch.eval.sequences import layout as on_disk
from ufmstar_torch.eval.sequences.conventions import OURS, convert_poses
from ufmstar_torch.eval.sequences.frame import FrameSequence
from ufmstar_torch.eval.tour.name import PREFIX, open_tour


def open_sequence(path: str | Path, layout: str = "auto", *, poses: str = OURS, **options: Any) -> FrameSequence:
    """Opens a recording, or renders a tour; the frames are decoded, or rendered, when they are indexed.

    Args:
        path: of a recording; or ``tour:SEED``, rooms rendered from a seed, with the options of
            :func:`~ufmstar_torch.eval.tour.name.open_tour` in the name.
        layout: see :func:`ufmstar_torch.eval.sequences.open_sequence`, as ``poses`` and ``options``; a tour has none.
        poses: how the poses are written.
        options: further options of a recording.

    Raises:
        FileNotFoundError: ``path`` does not exist.
        ValueError: see :func:`ufmstar_torch.eval.sequences.open_sequence`; or a layout or option for a tour.
    """
    if not str(path).startswith(PREFIX):
        return on_disk.open_sequence(path, layout, poses=poses, **options)
    if layout != "auto":
        raise ValueError(f"layout must be auto for {path!r}, got {layout!r}")
    if options:
        raise ValueError(f"{path!r} takes no {', '.join(options)}: a tour's options stand in its name")
    return convert_poses(open_tour(str(path)), poses)

"""``open_sequence``: recordings on disk in any layout, and rendered tours, ``tour:SEED?style=mixed&frames=150``."""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from importlib import import_module
from pathlib import Path
from typing import Any

from ufmstar_torch.eval.sequences.assemble import undistort
from ufmstar_torch.eval.sequences.frame import Entry, FrameSequence
from ufmstar_torch.eval.sequences.images import within
from ufmstar_torch.eval.sequences.layout import GENERIC, READERS, layout_of, readers
from ufmstar_torch.eval.sequences.lens import Lens, parse_distortion
from ufmstar_torch.eval.sequences.options import Options
from ufmstar_torch.eval.sequences.poses import in_metres
from ufmstar_torch.frames.arguments import as_path
from ufmstar_torch.gaussians.conventions import CONVENTIONS, OURS
from ufmstar_torch.runtime.kinds import check_kinds

# By option, the layouts that use it; other options are used by all.
_USED_BY = {
    "images": ("colmap", "generic"),
    "truth": ("kitti360", "colmap", "generic"),
    "depth_intrinsics": ("7scenes", "scannet", "sens", "kitti360", "generic"),
    "T_color_depth": ("7scenes",),
    "distortion": ("tum", "7scenes", "scannet", "sens", "tartanair", "kitti360", "generic"),
    "topics": ("bag",),
    "model_index": ("colmap",),
    "drive": ("kitti360",),
    "scans": ("kitti360",),
}


@check_kinds
def open_sequence(path: str | Path, layout: str = "auto", **options: Any) -> FrameSequence:
    """Open a sequence of posed images. Only headers and text files are read before it is indexed.

    Args:
        path: the sequence's folder, a video file, or ``tour:SEED`` with the options of a rendered tour in its name.
        layout: ``auto``, a name of ``READERS`` (docs/data.md), or one of a plug-in.
        **options: by the names of :class:`~ufmstar_torch.eval.sequences.options.Options`, which explains them;
            intrinsics may also be a matrix [3, 3] [px].

    Returns:
        The frames with a usable pose; ``skipped`` has the others.

    Raises:
        FileNotFoundError: ``path`` does not exist.
        TypeError: an unknown option.
        ValueError: unknown or ambiguous layout (the message lists the expected files), an option that is out of range
            or not used by the layout, malformed files (named by file and line), or no usable frame.
    """
    chosen = Options(layout=layout, **options)
    if str(path).startswith("tour:"):
        if refused := [name for name in chosen.changed() if name not in ("poses", "plugin")]:
            raise ValueError(f"{path!r} takes no {', '.join(refused)}: a tour's options stand in its name")
        # Imported here, because that package imports this one.
        return convert_poses(import_module("ufmstar_torch.eval.tour.sequence").open_tour(str(path)), chosen.poses)
    path = as_path("path", path)
    if not path.exists():
        raise FileNotFoundError(f"path: no such file or folder: {path}")
    explicit = chosen.images is not None or chosen.trajectory is not None
    layout = layout_of(layout, path, explicit, chosen.plugin)
    _require_used(chosen, layout)
    sequence = readers(chosen.plugin)[layout].read(path, chosen)
    if chosen.distortion is not None and layout not in READERS:
        coefficients, fisheye = parse_distortion(chosen.distortion)

        def lens_of(entry: Entry) -> Lens:
            size = entry.image_size or sequence.image_size
            if size is None:
                raise ValueError(f"distortion: the reader {layout!r} does not state the images' size")
            return Lens.of(sequence.intrinsics_of(entry), size, coefficients, fisheye)

        sequence = undistort(sequence, lens_of, several=True)
    sequence = convert_poses(replace(sequence, folder=path if path.is_dir() else path.parent), chosen.poses)
    if chosen.max_truth is not None:
        sequence = sequence.changed(partial(_within, most=chosen.max_truth))
    return sequence if chosen.pose_scale is None else scale_poses(sequence, chosen.pose_scale)


def _require_used(options: Options, layout: str) -> None:
    """Raises ValueError: an option is set that the layout does not use."""
    unused = [name for name, layouts in _USED_BY.items() if layout in READERS and layout not in layouts]
    unused += ["trajectory", "fps"] if layout == "nyu" else []
    unused += ["fps"] if layout == "tum" or (layout != "generic" and options.trajectory is None) else []
    for name in unused:
        if name in options.changed():
            users = _USED_BY.get(name, ("generic",))
            other = f"its files hold that; use layout={GENERIC!r} to combine images, depth and a trajectory freely"
            other = other if GENERIC in users else f"{name} is an option of {' and '.join(users)}"
            raise ValueError(f"layout {layout!r} takes no {name}: {other}")


def scale_poses(sequence: FrameSequence, metres: float) -> FrameSequence:
    """The sequence with positions in metres; ``metres`` is the length of the poses' unit."""
    scaled = sequence.changed(lambda entry: replace(entry, T_world_cam=in_metres(entry.T_world_cam, metres)))
    return replace(scaled, metric=True, pose_scale=metres * sequence.pose_scale)


def convert_poses(sequence: FrameSequence, convention: str) -> FrameSequence:
    """The sequence with its poses converted from ``convention`` to camera-to-world with our axes. Raises ValueError: a
    sequence without poses."""
    if convention == OURS:
        return sequence
    if not sequence.posed:
        raise ValueError(f"sequence {sequence.name!r} has no poses to convert from {convention}")
    convert = CONVENTIONS[convention].convert
    return sequence.changed(lambda entry: replace(entry, T_world_cam=convert(entry.T_world_cam)))


def _within(entry: Entry, most: float) -> Entry:
    return replace(entry, load_depth=entry.load_depth and partial(within, entry.load_depth, most))

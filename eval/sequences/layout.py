"""``open_sequence`` detects a dataset's layout from the files on disk and opens it; ``find_sequences`` lists all below
a folder."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from types import ModuleType
from typing import Any, NamedTuple

from ufmstar_torch.eval.sequences import generic, kitti360, nyu, scannet, sens, seven_scenes, tartanair, tum
from ufmstar_torch.eval.sequences.frame import FrameSequence
from ufmstar_torch.eval.sequences.options import Options
from ufmstar_torch.eval.sequences.poses import CONVENTIONS, OURS

# Each module has ``detect(path)``, ``read(path, options)`` and LOOKED_FOR, the files that it detects.
_READERS: dict[str, ModuleType] = {
    "tum": tum,
    "7scenes": seven_scenes,
    "scannet": scannet,
    "sens": sens,
    "tartanair": tartanair,
    "kitti360": kitti360,
    "nyu": nyu,
    "generic": generic,
}
LAYOUTS = ("auto", *_READERS)
# Options that a layout has no use for, beside those of KITTI-360 alone.
_REFUSED = {
    "tum": "images depth depth_intrinsics fps T_color_depth",
    "7scenes": "images depth",
    "scannet": "images depth T_color_depth",
    "sens": "images depth T_color_depth",
    "tartanair": "images depth depth_intrinsics T_color_depth",
    "kitti360": "images T_color_depth",
    "nyu": "trajectory images depth depth_intrinsics fps T_color_depth",
    "generic": "T_color_depth",
}

# Folders within one another have one name: ROOT/chess/seq-01 is "chess__seq-01".
_BETWEEN = "__"


def open_sequence(path: str | Path, layout: str = "auto", *, poses: str = OURS, **options: Any) -> FrameSequence:
    """Opens a sequence of posed images; nothing but headers and text files is read before it is indexed.

    Args:
        path: the sequence's folder, or a video file (``ufmstar_torch.eval.tour.open`` also takes rendered tours).
        layout: ``auto``, ``tum``, ``7scenes``, ``scannet``, ``sens``, ``tartanair``, ``kitti360``, ``nyu`` or
            ``generic``.
        poses: how they are written: ``camera-to-world`` (x right, y down, z forward), ``world-to-camera``, ``ned``
            (camera-to-world, x forward, y right, z down) or ``opengl`` (x right, y up, z backward); what is
            customary for a layout (TartanAir's NED) is known.
        **options: by the names of :class:`~ufmstar_torch.eval.sequences.options.Options`, which explains them.

    Returns:
        The frames with a usable pose; ``skipped`` has the others.

    Raises:
        FileNotFoundError: ``path`` does not exist.
        TypeError: an unknown option.
        ValueError: unknown or ambiguous layout (with what was looked for), an option out of range or of no
            use for the layout, malformed files (named by file and line), or no usable frame.
    """
    path = Path(path)
    if not path.exists():
        raise FileNotFoundError(f"path: no such file or folder: {path}")
    chosen = Options(**options)
    if poses not in CONVENTIONS:
        raise ValueError(f"poses must be one of {', '.join(CONVENTIONS)}, got {poses!r}")
    layout = _chosen(layout, path, explicit=chosen.images is not None or chosen.trajectory is not None)
    chosen.reject(layout, *_REFUSED[layout].split(), *(("drive", "scans") if layout != "kitti360" else ()))
    if chosen.trajectory is None and layout != "generic":
        chosen.reject(layout, "fps")
    sequence = _READERS[layout].read(path, chosen)
    return convert_poses(replace(sequence, folder=path if path.is_dir() else path.parent), poses)


def convert_poses(sequence: FrameSequence, convention: str) -> FrameSequence:
    """The sequence with its poses, which were written so, as camera-to-world ones with our axes. Raises ValueError: an
    unknown convention, or a sequence without poses."""
    if convention not in CONVENTIONS:
        raise ValueError(f"poses must be one of {', '.join(CONVENTIONS)}, got {convention!r}")
    if convention == OURS:
        return sequence
    if not sequence.posed:
        raise ValueError(f"sequence {sequence.name!r} has no poses to convert from {convention}")
    convert = CONVENTIONS[convention].convert
    return replace(sequence, entries=tuple(replace(e, T_world_cam=convert(e.T_world_cam)) for e in sequence.entries))


def _chosen(layout: str, path: Path, explicit: bool) -> str:
    """The layout by name, or detected for "auto"."""
    if layout == "auto":
        layout = detect_layout(path, explicit=explicit)
    if layout not in _READERS:
        raise ValueError(f"layout must be one of {', '.join(LAYOUTS)}, got {layout!r}")
    if layout != "generic" and not _READERS[layout].detect(path):
        raise ValueError(f"{path} has not the layout {layout!r}: looked for {_READERS[layout].LOOKED_FOR}")
    return layout


def detect_layout(path: Path, explicit: bool = False) -> str:
    """The one layout whose files lie in ``path``; ``generic`` only where no other fits.

    Args:
        path: existing folder or video file.
        explicit: the user names the images or the trajectory, so that generic always fits.

    Raises:
        ValueError: none or several fit.
    """
    fitting = layouts_of(path)
    if not fitting and explicit:
        return "generic"
    if len(fitting) == 1:
        return fitting[0]
    if fitting:
        raise ValueError(f"{path} fits the layouts {', '.join(fitting)}: pass layout")
    expected = "\n".join(f"  {name}: {reader.LOOKED_FOR}" for name, reader in _READERS.items())
    inside = sorted(p.name for p in path.iterdir())[:8] if path.is_dir() else [path.name]
    raise ValueError(f"{path} has no known layout. Looked for\n{expected}\nand found {inside}")


def layouts_of(path: Path) -> list[str]:
    """The layouts whose files lie in ``path``, all of them; ``generic`` only where no other fits."""
    fitting = [name for name, reader in _READERS.items() if name != "generic" and reader.detect(path)]
    return fitting or (["generic"] if generic.detect(path) else [])


def parts_of(path: Path, layout: str) -> list[Path]:
    """The single sequences of a path that has this layout: itself, or folders in it that hold one each."""
    holding = {"tartanair": tartanair.trajectory_folders, "kitti360": kitti360.drives, "nyu": nyu.parts}
    return holding[layout](path) if layout in holding else [path]


class Found(NamedTuple):
    """A sequence on disk, not opened yet: its place below the root, "/" as "__" (unique), and the arguments of
    ``open_sequence``."""

    name: str
    path: Path
    layout: str


def find_sequences(root: str | Path, max_depth: int = 4, layout: str = "auto") -> list[Found]:
    """All sequences at or below ``root``, sorted by name.

    A folder that is a sequence is not looked into, so that its own folders of images are none. Each folder on disk
    counts once, whatever links lead to it (a folder before a link to it), so that links in a circle end too. Hidden
    folders and those that may not be read are left out.

    Args:
        root: folder, or the file of one sequence.
        max_depth: levels of folders below ``root`` that are looked at, at least 0.
        layout: the only layout to look for; "auto": any.

    Returns:
        The sequences; empty where there is none.

    Raises:
        FileNotFoundError: no such root.
        ValueError: ``max_depth`` is negative, an unknown layout, or a folder that fits several layouts.
    """
    root = Path(root)
    if not root.exists():
        raise FileNotFoundError(f"root: no such file or folder: {root}")
    if max_depth < 0:
        raise ValueError(f"max_depth must be at least 0, got {max_depth}")
    if layout not in LAYOUTS:
        raise ValueError(f"layout must be one of {', '.join(LAYOUTS)}, got {layout!r}")
    found: list[Found] = []
    seen: set[Path] = set()
    waiting = [(root, max_depth)]
    while waiting:
        path, depth = waiting.pop()
        if path.resolve() in seen:
            continue
        seen.add(path.resolve())
        fitting = [name for name in layouts_of(path) if layout in ("auto", name)]
        if len(fitting) > 1:
            raise ValueError(f"{path} fits the layouts {', '.join(fitting)}: pass layout")
        if fitting:
            for part in parts_of(path, fitting[0]):
                if part == path or part.resolve() not in seen:
                    seen.add(part.resolve())
                    found.append(Found(_name(part, root), part, fitting[0]))
        elif depth > 0:
            waiting += [(folder, depth - 1) for folder in reversed(_folders(path))]
    return sorted(found, key=lambda sequence: sequence.name)


def _folders(path: Path) -> list[Path]:
    """The folders in a folder, links last; none where it may not be read."""
    try:
        folders = [p for p in path.iterdir() if not p.name.startswith(".") and p.is_dir()] if path.is_dir() else []
    except PermissionError:  # "lost+found" at the top of a disk
        return []
    return sorted(folders, key=lambda p: (p.is_symlink(), p.name))


def _name(path: Path, root: Path) -> str:
    if path == root:
        return path.resolve().stem if path.is_file() else path.resolve().name
    return _BETWEEN.join(path.relative_to(root).parts)

"""The layouts of recordings on disk: ``layout_of`` a path, and ``find_sequences`` below a folder."""

from __future__ import annotations

from collections.abc import Sequence
from fnmatch import fnmatch
from importlib import import_module
from pathlib import Path
from typing import Any, NamedTuple

from ufmstar_torch.eval.sequences.plugins import load_plugins
from ufmstar_torch.runtime.kinds import check_kinds

# Each module has ``detect(path)``, ``read(path, options)`` and LOOKED_FOR, the files that it detects; if a path may
# contain several sequences, also ``parts(path)``.
_MODULES = (
    *("tum", "seven_scenes", "scannet", "sens", "tartanair", "kitti360", "nyu", "colmap", "transforms", "euroc"),
    *("bag", "stray", "arkitscenes", "generic"),
)
GENERIC = "generic"
_NERFSTUDIO = "convert it with nerfstudio, `ns-process-data {} --data DIR --output-dir OUT`, and open OUT"
# Files of exports that no reader opens, and what makes them readable.
_CONVERTED = (
    ("keyframes/*cameras", f"it is a raw export of Polycam; {_NERFSTUDIO.format('polycam')}"),
    ("*.zst*", "decompress it with `zstd -d`"),
    ("*.r3d", "it is a file of Record3D; export it there as a folder with EXR and JPG"),
    ("rgbd/*.depth", "its depth has Apple's compression; export it from Record3D with EXR and JPG"),
    ("EXR_RGBD", f"it is an export of Record3D; {_NERFSTUDIO.format('record3d')}"),
    ("oxts", "a raw drive of KITTI has no poses of its cameras; take the odometry benchmark or KITTI-360"),
    ("image_?/000000.png", "for KITTI's odometry, pass --trajectory poses/NN.txt (of image_0) and --images image_0"),
    ("results/frame000000.jpg", "for Replica, move results/depth* to depth/, and pass --images results, --intrinsics "
     "600 600 599.5 339.5 and --truth-scale 0.000152597"),
    ("pose_intrinsic_imu.json", "it is an iPhone's part of ScanNet++; its COLMAP model can be opened"),
    ("camera_params_*.json", "for Isaac Sim, write a transforms.json with transform_matrix = inverse of the transposed "
     "cameraViewTransform, which has OpenGL axes"),
)  # fmt: skip
_DEEPEST = 4  # levels of folders that are searched
READERS: dict[str, Any] = {
    "7scenes" if name == "seven_scenes" else name: import_module(f"ufmstar_torch.eval.sequences.{name}")
    for name in _MODULES
}


def readers(plugin: Sequence[str] = ()) -> dict[str, Any]:
    """The readers by layout, with those of installed packages and of the files ``plugin``. Raises FileNotFoundError,
    ValueError: a plug-in cannot be used, or has the name of a layout."""
    plugged_in = load_plugins(plugin).readers
    if duplicates := [name for name in plugged_in if name in (*READERS, "auto")]:
        raise ValueError(f"plug-ins: there is a reader {duplicates[0]!r} already: give yours another name")
    return {**READERS, **plugged_in}


def require_layout(layout: str, plugin: Sequence[str] = ()) -> None:
    """Raises ValueError: no reader has this name."""
    if layout not in (names := ("auto", *readers(plugin))):
        raise ValueError(f"layout must be one of {', '.join(names)}, got {layout!r}")


def layout_of(layout: str, path: Path, explicit: bool = False, plugin: Sequence[str] = ()) -> str:
    """The named layout, or for "auto" the one that fits ``path``; ``generic`` if none fits and ``explicit`` is True
    (the user names the images or the trajectory). Raises ValueError: unknown layout, or none or several fit."""
    require_layout(layout, plugin)
    by_name = readers(plugin)
    if layout != "auto":
        if layout != GENERIC and not by_name[layout].detect(path):
            raise ValueError(f"{path} has not the layout {layout!r}: looked for {by_name[layout].LOOKED_FOR}")
        return layout
    fitting = layouts_of(path, plugin) or [GENERIC] * explicit
    if len(fitting) > 1:
        raise ValueError(f"{path} fits the layouts {', '.join(fitting)}: pass layout")
    if not fitting:
        raise ValueError(f"{path} has no known layout: {_remedy(path, list(by_name))}")
    return fitting[0]


def _remedy(path: Path, names: Sequence[str]) -> str:
    """The error message for a path without any of the layouts ``names``: it says how to open it."""
    if remedy := next((remedy for pattern, remedy in _CONVERTED if _holds(path, pattern)), None):
        return remedy
    if below := find_sequences(path):
        listed = ", ".join(f"{found.path.relative_to(path)} ({found.layout})" for found in below[:3])
        return f"open one of the {len(below)} recordings below it, such as {listed}"
    inside = ", ".join(sorted(p.name for p in path.iterdir())[:8]) if path.is_dir() else ""
    published = f"or the files of {', '.join(name for name in names if name != GENERIC)} (docs/data.md)"
    return f"expected {READERS[GENERIC].LOOKED_FOR}; {published}; found {inside or 'none of them'}"


def _holds(path: Path, pattern: str) -> bool:
    return any(path.glob(pattern)) if path.is_dir() else fnmatch(path.name.lower(), pattern)


def layouts_of(path: Path, plugin: Sequence[str] = ()) -> list[str]:
    """All layouts that fit ``path``; ``generic`` only if no other fits."""
    fitting = [name for name, reader in readers(plugin).items() if name != GENERIC and reader.detect(path)]
    return fitting or ([GENERIC] if READERS[GENERIC].detect(path) else [])


def parts_of(path: Path, layout: str) -> list[Path]:
    """The single sequences of a path with this layout: the path, or folders in it with one sequence each."""
    reader: Any = READERS.get(layout)
    return list(reader.parts(path)) if hasattr(reader, "parts") else [path]


class Found(NamedTuple):
    """A sequence on disk that is not open: its path below the root with "__" for "/" (unique), and the arguments of
    ``open_sequence``."""

    name: str
    path: Path
    layout: str


@check_kinds
def find_sequences(root: str | Path, layout: str = "auto", plugin: Sequence[str] = ()) -> list[Found]:
    """All sequences at most four folders below ``root``, sorted by name.

    A folder that is a sequence is not searched. Each folder on disk counts once, before its links. Hidden and
    unreadable folders are ignored.

    Args:
        root: a folder, or the file of a sequence.
        layout: the only layout to search for; "auto" = any.
        plugin: files with the user's readers.

    Raises:
        FileNotFoundError: no such root.
        ValueError: an unknown layout, or a folder that fits several layouts.
    """
    root = Path(root)
    if not root.exists():
        raise FileNotFoundError(f"root: no such file or folder: {root}")
    require_layout(layout, plugin)
    found: list[Found] = []
    seen: set[Path] = set()
    waiting = [(root, _DEEPEST)]
    while waiting:
        path, depth = waiting.pop()
        if path.resolve() in seen:
            continue
        seen.add(path.resolve())
        fitting = [name for name in layouts_of(path, plugin) if layout in ("auto", name)]
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
    """The folders in a folder, links last; [] if it may not be read."""
    try:
        folders = [p for p in path.iterdir() if not p.name.startswith(".") and p.is_dir()] if path.is_dir() else []
    except PermissionError:  # "lost+found" at the top of a disk
        return []
    return sorted(folders, key=lambda p: (p.is_symlink(), p.name))


def _name(path: Path, root: Path) -> str:
    if path == root:
        return path.resolve().stem if path.is_file() else path.resolve().name
    return "__".join(path.relative_to(root).parts)

"""A small recording of every layout."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from pathlib import Path

import layouts
import layouts_bag
import layouts_calibrated
import layouts_more


def _scan(root):
    layouts_more.write_sens(root / "scan" / "scene.sens")
    return root / "scan"


def _drive(root):
    layouts_more.write_kitti360(root)
    return root


_WRITERS = {
    "tum": layouts.write_tum, "7scenes": layouts.write_seven_scenes, "scannet": layouts.write_scannet,
    "tartanair": layouts.write_tartanair, "generic": layouts.write_generic, "sens": _scan,
    "colmap": layouts_calibrated.write_colmap, "transforms": layouts_calibrated.write_transforms,
    "euroc": layouts_calibrated.write_euroc, "stray": layouts_calibrated.write_stray,
    "arkitscenes": layouts_calibrated.write_arkitscenes, "bag": layouts_bag.write_bag,
    "nyu": layouts_more.write_nyu, "kitti360": _drive,
}  # fmt: skip
# Other forms of these.
_FORMS = {
    "colmap text": partial(layouts_calibrated.write_colmap, text=True),
    "bag db3": partial(layouts_bag.write_bag, kind="db3"), "bag ros1": partial(layouts_bag.write_bag, kind="ros1"),
}  # fmt: skip


def _path(write, root: Path) -> Path:
    written = write(root)
    return written[0] if isinstance(written, tuple) else written


# By name: write the recording into a folder, and return its path.
LAYOUTS: dict[str, Callable[[Path], Path]] = {name: partial(_path, write) for name, write in _WRITERS.items()}
FORMS: dict[str, Callable[[Path], Path]] = {name: partial(_path, write) for name, write in _FORMS.items()}

"""Images with depth maps and no poses, which training does not need: a folder of each, and intrinsics."""

from __future__ import annotations

from functools import partial
from pathlib import Path

import numpy as np

from ufmstar_torch.eval.sequences.frame import Entry, FrameSequence, Skipped, make_sequence
from ufmstar_torch.eval.sequences.generic import DEPTHS, IMAGES, INTRINSICS
from ufmstar_torch.eval.sequences.images import (
    DEPTH_SUFFIXES,
    IMAGE_SUFFIXES,
    common_size,
    depth_loader,
    first_image_size,
    list_files,
    read_color,
)
from ufmstar_torch.eval.sequences.intrinsics import IntrinsicsLike, read_intrinsics
from ufmstar_torch.eval.sequences.pairing import pair_by_name
from ufmstar_torch.eval.sequences.poses import associate

# [s] Largest difference of the timestamps in the names of an image and its depth map, as in ``open_sequence``.
_MAX_TIME_DIFFERENCE = 0.02
# [m] Unit of the depth maps of a TUM RGB-D recording, here one without its trajectory.
_TUM_SCALE = 1 / 5000


def is_unposed(path: Path) -> bool:
    """Whether a folder holds images and depth maps where :func:`open_unposed` looks for them."""
    return path.is_dir() and all(any((path / name).is_dir() for name in names) for names in (IMAGES, DEPTHS))


def open_unposed(
    path: str | Path, intrinsics: IntrinsicsLike | None = None, depth_scale: float | None = None
) -> FrameSequence:
    """Opens a folder with one of ``images image rgb color frames`` and one of ``depth depths``.

    A depth map belongs to the image with the same name or the same numbers in it, or else, where names are
    timestamps, to the nearest within 20 ms. Images without a depth map are skipped.

    Args:
        path: the folder.
        intrinsics: [px], else those of ``K.txt``, ``intrinsics.txt``, ``intrinsic.txt`` or ``camera.txt``.
        depth_scale: metres per unit of the depth files, see ``read_depth``; None: 1/5000 beside TUM's ``depth.txt``.

    Returns:
        A sequence whose poses are all the identity, and mean nothing.

    Raises:
        ValueError: images, depth maps or intrinsics are not found, or none of the maps fits an image.
    """
    path = Path(path)
    folders = [next((path / name for name in names if (path / name).is_dir()), None) for names in (IMAGES, DEPTHS)]
    if folders[0] is None or folders[1] is None:
        raise ValueError(f"{path} must hold one of {', '.join(IMAGES)} and one of {', '.join(DEPTHS)}")
    images, maps = list_files(folders[0], IMAGE_SUFFIXES), list_files(folders[1], DEPTH_SUFFIXES)
    if depth_scale is None and (path / "depth.txt").is_file():
        depth_scale = _TUM_SCALE
    pairs = _paired([file.stem for file in images], maps)
    if not pairs:
        raise ValueError(f"{folders[1]}: none of {len(maps)} depth maps is named like one of {len(images)} images")
    frames: list[Entry | Skipped] = [
        Entry(file.stem, np.eye(4), partial(read_color, file), depth_loader(pairs[file.stem], depth_scale))
        if file.stem in pairs
        else Skipped(file.stem, "no depth map")
        for file in images
    ]
    return make_sequence(
        path.resolve().name,
        "unposed",
        frames,
        _intrinsics(path) if intrinsics is None else read_intrinsics(intrinsics),
        image_size=first_image_size(images),
        depth_size=common_size(frame.load_depth for frame in frames if isinstance(frame, Entry)),
        posed=False,
    )


def _paired(names: list[str], maps: list[Path]) -> dict[str, Path]:
    if pairs := pair_by_name(names, maps):
        return pairs
    try:
        times = [np.array([float(text) for text in texts]) for texts in (names, [file.stem for file in maps])]
    except ValueError:  # not timestamps
        return {}
    return {names[i]: maps[j] for i, j in associate(times[0], times[1], _MAX_TIME_DIFFERENCE).items()}


def _intrinsics(path: Path) -> np.ndarray:
    found = [path / name for name in INTRINSICS if (path / name).is_file()]
    if len(found) != 1:
        raise ValueError(f"{path}: pass intrinsics, exactly one of {', '.join(INTRINSICS)} must be there")
    return read_intrinsics(found[0])

"""Conversion of NYU Depth V2's labelled file, from the dataset's website, to FastDepth's layout, which
``eval.sequences.nyu`` reads. FastDepth's archive is no longer available (docs/training.md).
"""

from __future__ import annotations

import io
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from ufmstar_torch.files.write import write_atomic
from ufmstar_torch.runtime.kinds import check_kinds

if TYPE_CHECKING:
    import h5py

# Without a split, every fourth scene in alphabetical order belongs to the validation part.
_VALIDATION_EVERY = 4


@check_kinds
def convert_labelled(
    mat: str | Path, out: str | Path, splits: str | Path | None = None, *, raw: bool = False
) -> dict[str, int]:
    """Convert ``nyu_depth_v2_labeled.mat`` (MATLAB 7.3, which is HDF5) to FastDepth's layout.

    Files are written atomically; existing files are not replaced; an interrupted conversion continues.

    Args:
        mat: the labelled dataset: ``images`` [N, 3, W, H], ``depths`` and ``rawDepths`` [N, W, H] [m]
            (MATLAB stores columns first), ``scenes``.
        out: folder of ``train/<scene>/NNNNN.h5`` and ``val/...``, NNNNN the number in ``mat`` from 1.
        splits: the website's ``splits.mat`` (``trainNdxs``, ``testNdxs``), whose 654 test frames become "val". None:
            every fourth scene becomes "val".
        raw: use the sensor's depth with its holes instead of the filled depth.

    Returns:
        The number of frames of each part.

    Raises:
        ValueError: ``mat`` lacks these arrays, or ``splits`` does not cover its frames.
        OSError: a file cannot be read or written.
    """
    import h5py

    key = "rawDepths" if raw else "depths"
    with h5py.File(mat, "r") as file:
        if missing := sorted({"images", key, "scenes"} - set(file)):
            raise ValueError(f"{mat} has no {', '.join(missing)}: expected nyu_depth_v2_labeled.mat")
        images, depths = file["images"], file[key]
        scenes = [_matlab_string(file[reference]) for reference in np.asarray(file["scenes"]).ravel()]
        if images.ndim != 4 or images.shape[1] != 3 or depths.shape != (images.shape[0], *images.shape[2:]):
            raise ValueError(f"{mat}: images {images.shape} and {key} {depths.shape} must be [N, 3, W, H], [N, W, H]")
        if len(scenes) != len(images):
            raise ValueError(f"{mat} has {len(scenes)} scenes for {len(images)} images")
        validation = _validation(scenes, splits)
        for i, scene in enumerate(scenes):
            path = Path(out) / ("val" if i in validation else "train") / scene / f"{i + 1:05d}.h5"
            if not path.exists():
                _write(path, images[i].transpose(0, 2, 1), depths[i].T)
    return {"train": len(scenes) - len(validation), "val": len(validation)}


def _matlab_string(characters: h5py.Dataset) -> str:
    """A string of MATLAB 7.3, a column of UTF-16 code units."""
    return "".join(chr(code) for code in np.asarray(characters).ravel())


def _validation(scenes: list[str], splits: str | Path | None) -> set[int]:
    """Frame numbers (0-based) of the validation part."""
    if splits is None:
        held_back = set(sorted(set(scenes))[_VALIDATION_EVERY - 1 :: _VALIDATION_EVERY])
        return {i for i, scene in enumerate(scenes) if scene in held_back}
    from scipy.io import loadmat

    content = loadmat(splits)
    if missing := sorted({"trainNdxs", "testNdxs"} - set(content)):
        raise ValueError(f"{splits} has no {', '.join(missing)}: expected the dataset's splits.mat")
    train, test = ({int(n) - 1 for n in content[name].ravel()} for name in ("trainNdxs", "testNdxs"))
    if train & test or train | test != set(range(len(scenes))):
        raise ValueError(f"{splits}: trainNdxs and testNdxs must divide the frames 1 to {len(scenes)} between them")
    return test


def _write(path: Path, rgb: np.ndarray, depth: np.ndarray) -> None:
    import h5py

    buffer = io.BytesIO()
    with h5py.File(buffer, "w") as file:
        file.create_dataset("rgb", data=np.ascontiguousarray(rgb, np.uint8), compression="gzip")
        file.create_dataset("depth", data=np.ascontiguousarray(depth, np.float32), compression="gzip")
    path.parent.mkdir(parents=True, exist_ok=True)
    write_atomic(path, lambda target: target.write(buffer.getbuffer()))

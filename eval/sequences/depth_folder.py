"""Depth maps that another program predicted, with optional variance maps, one file per frame."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ufmstar_torch.eval.sequences.attach import pair_by_name
from ufmstar_torch.eval.sequences.frame import FrameError
from ufmstar_torch.eval.sequences.images import SCALE_KEY, read_depth, read_map, require_scale
from ufmstar_torch.eval.sequences.options import check_scale
from ufmstar_torch.eval.sequences.paths import DEPTH_SUFFIXES, list_files
from ufmstar_torch.runtime.kinds import check_kinds

_VARIANCE_SUFFIXES = (".npy", ".npz", ".exr", ".tif", ".tiff")


@dataclass(frozen=True)
class DepthMaps:
    """Predicted depth of a sequence's frames, decoded lazily: ``maps[i]`` belongs to frame i. Scale [m per unit] and
    key are those of :func:`depth_maps`."""

    depth_files: tuple[Path, ...]
    variance_files: tuple[Path, ...] = ()
    scale: float | None = None
    key: str = "depth"

    def __getitem__(self, index: int) -> tuple[np.ndarray, np.ndarray | None]:
        """Depth [H, W] float32 [m] (0 = invalid) and variance [H, W] float32 [m^2], or None without variance files.
        Where the variance is negative or not finite, both are 0. Raises FrameError: a file cannot be decoded, or the
        two differ in size."""
        depth = read_depth(self.depth_files[index], self.scale, self.key)
        if not self.variance_files:
            return depth, None
        path = self.variance_files[index]
        variance = read_map(path, key="variance")[0].astype(np.float32)
        if variance.shape != depth.shape:
            raise FrameError(path, f"the variance is {list(variance.shape)}, its depth {list(depth.shape)}")
        usable = np.isfinite(variance) & (variance >= 0)
        return np.where(usable, depth, np.float32(0)), np.where(usable, variance, np.float32(0))


@check_kinds
def depth_maps(
    path: str | Path,
    names: Sequence[str],
    *,
    scale: float | None = None,
    variance: str | Path | None = None,
    key: str = "depth",
    names_on_disk: Sequence[str] = (),
    selected: Sequence[str] | None = None,
) -> DepthMaps:
    """The maps of a sequence's frames in a folder of one format: 16-bit PNG or TIFF, float TIFF, EXR, npy or npz. They
    are paired by stem, or by the numbers in the names, or else in sorted order if the number of maps is that of
    ``names_on_disk``, ``names`` or ``selected``.

    Args:
        path: the folder.
        names: of the sequence's frames.
        scale: metres per unit. None = by the text ``depth_scale`` of a PNG; other formats are in metres.
        variance: folder of variance maps [m^2] as npy, npz, EXR or float TIFF. It may be ``path`` if npz files have the
            keys ``depth`` and ``variance``.
        key: name of the depth in npz files with several arrays.
        names_on_disk: of the frames, skipped ones included.
        selected: the frames, in order, whose maps are returned; None = ``names``.

    Raises:
        NotADirectoryError: a folder does not exist.
        ValueError: no map, maps of several formats, integers of unknown scale, a scale that the first map contradicts,
            or some frames have no map (they are listed).
    """
    check_scale("scale", scale)
    files = _maps(Path(path), DEPTH_SUFFIXES, "depth")
    variances = [] if variance is None else _maps(Path(variance), _VARIANCE_SUFFIXES, "variance")
    _require_scale(files, scale, key)
    chosen = names if selected is None else selected
    orders = (names_on_disk or names, names, chosen)
    return DepthMaps(_paired(files, chosen, orders), _paired(variances, chosen, orders), scale, key)


def _require_scale(files: Sequence[Path], scale: float | None, key: str) -> None:
    """Raises ValueError: the unit of the first map that can be read is unknown, or contradicts the scale."""
    for file in files:
        try:
            values, stated = read_map(file, key=key)
        except FrameError:  # counted when its turn comes
            continue
        if scale is None and stated is None and np.issubdtype(values.dtype, np.integer):
            raise ValueError(f"scale: {file} holds integers and no text {SCALE_KEY!r}: pass metres per unit")
        try:
            require_scale(file, scale, stated)
        except FrameError as error:
            raise ValueError(f"scale: {error}") from error
        break


def _maps(folder: Path, suffixes: tuple[str, ...], what: str) -> list[Path]:
    if not folder.is_dir():
        raise NotADirectoryError(f"{what}: no such folder: {folder}")
    files = list_files(folder, suffixes)
    result = sorted({file.suffix.lower() for file in files})
    if len(result) != 1:
        content = f"several formats, {', '.join(result)}" if result else f"no map ({', '.join(suffixes)})"
        raise ValueError(f"{what}: the folder {folder} holds {content}")
    return files


def _paired(files: list[Path], names: Sequence[str], orders: Sequence[Sequence[str]]) -> tuple[Path, ...]:
    if not files:
        return ()
    pairs = pair_by_name(names, files)
    missing = [name for name in names if name not in pairs]
    if missing:
        order = next((order for order in orders if len(order) == len(files)), None)
        if order is None:
            shown = ", ".join(missing[:10]) + (", ..." if len(missing) > 10 else "")
            folder, first = files[0].parent, files[0].name
            files_text = f"its {len(files)} files are named {first}, ..., and there are not as many as frames"
            raise ValueError(f"{folder}: no map for {len(missing)} of {len(names)} frames ({shown}); {files_text}")
        pairs = dict(zip(order, files, strict=True))
    return tuple(pairs[name] for name in names)

"""ScanNet's ``.sens`` container, version 4: JPEG images, zlib-compressed depth and poses in one file, read in place.

Little-endian: ``u32`` version; ``u64`` length of the sensor's name, and the name; four 4x4 ``f32`` matrices, rows first
(colour's intrinsics and extrinsics, depth's); ``i32`` compressions of colour and depth; ``u32`` width and height of
colour, then of depth; ``f32`` units per metre; ``u64`` number of frames. Each frame is its 4x4 ``f32`` camera-to-world
pose, ``u64`` timestamps [us] and sizes [bytes] of colour and depth, and their bytes. What follows (IMU) is not read.
Opening reads the frames' headers alone. https://github.com/ScanNet/ScanNet/tree/master/SensReader
"""

from __future__ import annotations

import io
import struct
import zlib
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import BinaryIO, NamedTuple

import numpy as np

from ufmstar_torch.eval.sequences import scannet
from ufmstar_torch.eval.sequences.attach import attach_given
from ufmstar_torch.eval.sequences.frame import Entry, FrameError, FrameSequence, Loader, Size, Skipped, make_sequence
from ufmstar_torch.eval.sequences.images import decode_color
from ufmstar_torch.eval.sequences.intrinsics import camera_matrix
from ufmstar_torch.eval.sequences.options import Options

LOOKED_FOR = "a .sens file, or a folder that holds one (and no SensReader export)"
_SUFFIX = ".sens"
_VERSION = 4
_COLOR = {0: "raw", 1: "png", 2: "jpeg"}
_DEPTH = {0: "raw_ushort", 1: "zlib_ushort", 2: "occi_ushort"}
_FRAME = struct.Struct("<16f4Q")
_BYTES_PER_DEPTH = 2
_MAX_NAME = 10_000  # [bytes] a longer sensor name is no name: the file is something else
_MAX_FRAMES = 10_000_000  # 92 hours at 30 Hz: more is a broken header
_MICROSECOND = 1e-6
_BEYOND = "beyond the end of the truncated file"


class SensHeader(NamedTuple):
    """The header before the frames; sizes are (H, W), matrices [3, 3]."""

    K_color: np.ndarray
    K_depth: np.ndarray
    color_size: Size
    depth_size: Size
    units_per_metre: float
    frames: int


@dataclass(frozen=True)
class _Block:
    """Bytes of the file."""

    path: Path
    offset: int
    size: int

    def read(self) -> bytes:
        try:
            with self.path.open("rb") as file:
                file.seek(self.offset)
                data = file.read(self.size)
        except OSError as error:
            raise FrameError(self.path, f"cannot be read: {error}") from error
        if len(data) < self.size:
            raise FrameError(self.path, f"ends within the {self.size} bytes at {self.offset}")
        return data


def detect(path: Path) -> bool:
    """Whether the path is such a file, or a folder that holds exactly one and is no export."""
    if path.is_dir():
        return len(_files(path)) == 1 and not scannet.detect(path)
    return path.suffix.lower() == _SUFFIX and path.is_file()


def read(path: Path, options: Options) -> FrameSequence:
    """Opens a ``.sens`` file; depth comes as it is, with ``depth_intrinsics``, as from a SensReader export.

    Frames are called by their number. In a truncated file, those before the break are used and the others skipped.

    Raises:
        ValueError: not version 4; compressions other than jpeg or png and zlib_ushort; a broken header; no usable
            frame.
    """
    file = _files(path)[0] if path.is_dir() else path
    with file.open("rb") as opened:
        header = _read_header(opened, file)
        located = _index(opened, file, header.frames)
    scale = options.depth_scale or 1 / header.units_per_metre
    frames = [_frame(i, one, header.depth_size, scale) for i, one in enumerate(located)]
    times = [np.nan if isinstance(f, Skipped) or f.timestamp is None else f.timestamp for f in frames]
    frames = attach_given(frames, file.parent, options, np.array(times) if np.isfinite(times).all() else None)
    beyond = [Skipped(str(i), _BEYOND) for i in range(len(frames), header.frames)]
    return make_sequence(
        file.resolve().stem,
        "sens",
        [*frames, *beyond],
        camera_matrix(options.intrinsics, header.K_color, header.color_size, None),
        image_size=header.color_size,
        depth_intrinsics=camera_matrix(options.depth_intrinsics, header.K_depth, header.depth_size, None),
        depth_size=header.depth_size,
    )


def _read_header(file: BinaryIO, path: Path) -> SensHeader:
    """The header of a file that is opened at its beginning; the frames follow. Raises ValueError: it is cut off, of
    another version, holds impossible values, or compressions that are not read here."""
    version = _unpack(file, path, "<I")[0]
    if version != _VERSION:
        raise ValueError(f"{path}: expected version {_VERSION} of the .sens format, got {version}")
    length = _unpack(file, path, "<Q")[0]
    if length > _MAX_NAME:
        raise ValueError(f"{path}: no .sens file, its sensor's name would have {length} bytes")
    _take(file, path, length)
    matrices = np.array(_unpack(file, path, "<64f"), dtype=np.float64).reshape(4, 4, 4)
    color, depth, color_w, color_h, depth_w, depth_h, units, frames = _unpack(file, path, "<2i4IfQ")
    if min(color_w, color_h, depth_w, depth_h) == 0 or not 1 <= units < np.inf or frames > _MAX_FRAMES:
        raise ValueError(
            f"{path}: broken header: {frames} frames, images of {color_w}x{color_h}, depth of {depth_w}x{depth_h}, "
            f"{units:g} units per metre"
        )
    kinds = _COLOR.get(color, "unknown"), _DEPTH.get(depth, "unknown")
    if kinds[0] not in ("jpeg", "png") or kinds[1] != "zlib_ushort":
        raise ValueError(
            f"{path}: colour is {kinds[0]} and depth {kinds[1]}; of a .sens file, jpeg or png with zlib_ushort can be "
            "read: export it with ScanNet's SensReader"
        )
    sizes = (color_h, color_w), (depth_h, depth_w)
    return SensHeader(matrices[0, :3, :3], matrices[2, :3, :3], *sizes, float(units), int(frames))


def _files(folder: Path) -> list[Path]:
    return sorted(p for p in folder.glob(f"*{_SUFFIX}") if p.is_file() and not p.name.startswith("."))


_Located = tuple[np.ndarray, float | None, _Block, _Block]


def _index(file: BinaryIO, path: Path, count: int) -> list[_Located]:
    """Pose, time [s], and where colour and depth lie, of the frames that are there completely."""
    here = file.tell()
    end = file.seek(0, io.SEEK_END)
    result: list[_Located] = []
    while len(result) < count and here + _FRAME.size <= end:
        file.seek(here)
        values = _FRAME.unpack(file.read(_FRAME.size))
        color_time, _, color_bytes, depth_bytes = values[16:]
        color = _Block(path, here + _FRAME.size, color_bytes)
        depth = _Block(path, color.offset + color_bytes, depth_bytes)
        here = depth.offset + depth_bytes
        if here > end:
            break
        T = np.array(values[:16], dtype=np.float64).reshape(4, 4)
        result.append((T, color_time * _MICROSECOND if color_time else None, color, depth))
    return result


def _frame(number: int, located: _Located, depth_size: Size, scale: float) -> Entry | Skipped:
    T, time, color, depth = located
    if color.size == 0:
        return Skipped(str(number), "no image in the file")
    load_depth: Loader | None = partial(_read_depth, depth, depth_size, scale) if depth.size else None
    return Entry(str(number), _rigid(T), partial(_read_color, color), load_depth, time)


def _rigid(T: np.ndarray) -> np.ndarray:
    """The pose, all NaN if an entry is not finite or it is all 0, as frames that were not tracked are written."""
    usable = np.isfinite(T).all() and np.abs(T[3] - [0, 0, 0, 1]).max() < 1e-6
    return T if usable else np.full((4, 4), np.nan)


def _read_color(block: _Block) -> np.ndarray:
    return decode_color(io.BytesIO(block.read()), block.path)


def _read_depth(block: _Block, size: Size, scale: float) -> np.ndarray:
    """[H, W] float32 [m], 0 = invalid."""
    try:
        data = zlib.decompress(block.read())
    except zlib.error as error:
        raise FrameError(block.path, f"the depth map at byte {block.offset} cannot be decoded: {error}") from error
    if len(data) != _BYTES_PER_DEPTH * size[0] * size[1]:
        raise FrameError(
            block.path,
            f"the depth map at byte {block.offset} has {len(data)} bytes, expected {size[1]}x{size[0]} of "
            f"{_BYTES_PER_DEPTH}",
        )
    return (np.frombuffer(data, "<u2").reshape(size) * scale).astype(np.float32)


def _unpack(file: BinaryIO, path: Path, form: str) -> tuple:
    return struct.unpack(form, _take(file, path, struct.calcsize(form)))


def _take(file: BinaryIO, path: Path, count: int) -> bytes:
    data = file.read(count)
    if len(data) < count:
        raise ValueError(f"{path}: the .sens file ends within its header")
    return data

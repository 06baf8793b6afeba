"""ScanNet's ``.sens`` container, version 4: JPEG images, zlib-compressed depth and poses in one file, read in place.

Little-endian: ``u32`` version; ``u64`` length of the sensor's name, and the name; four 4x4 ``f32`` matrices, rows first
(colour's intrinsics and extrinsics, depth's); ``i32`` compressions of colour and depth; ``u32`` width and height of
colour, then of depth; ``f32`` units per metre; ``u64`` number of frames. Each frame is its 4x4 ``f32`` camera-to-world
pose, ``u64`` timestamps [us] and sizes [bytes] of colour and depth, and their bytes. What follows (IMU) is not read.
Opening reads the frames' headers alone. https://github.com/ScanNet/ScanNet/tree/master/SensReader
"""

from __future__ import annotations

import os
import zlib
from functools import partial
from pathlib import Path
from typing import BinaryIO

import numpy as np

from ufmstar_torch.eval.sequences import scannet
from ufmstar_torch.eval.sequences.assemble import assemble
from ufmstar_torch.eval.sequences.attach import UNKNOWN
from ufmstar_torch.eval.sequences.frame import Entry, FrameError, FrameSequence, Size, Skipped
from ufmstar_torch.eval.sequences.images import read_color
from ufmstar_torch.eval.sequences.lens import Lens
from ufmstar_torch.eval.sequences.options import Options
from ufmstar_torch.files.limits import MOST_PIXELS

LOOKED_FOR = "a .sens file, or a folder that holds one (and no SensReader export)"
_SUFFIX = ".sens"
_VERSION = 4
_COLOR = {0: "raw", 1: "png", 2: "jpeg"}
_DEPTH = {0: "raw_ushort", 1: "zlib_ushort", 2: "occi_ushort"}
_MATRIX = ("<f4", (4, 4))
# The header after the sensor's name; sizes are width, height.
_HEADER = np.dtype(
    [
        *[(f"{name}_{camera}", *_MATRIX) for camera in ("color", "depth") for name in ("K", "T")],
        *[("color", "<i4"), ("depth", "<i4"), ("color_size", "<u4", 2), ("depth_size", "<u4", 2)],
        *[("units_per_metre", "<f4"), ("frames", "<u8")],
    ]
)
_FRAME = np.dtype([("T_world_cam", *_MATRIX), ("times", "<u8", 2), ("bytes", "<u8", 2)])
_BYTES_PER_DEPTH = 2
_MAX_NAME = 10_000  # [bytes] largest sensor name; a file with a longer one is no .sens file
_FEW_FRAMES = 10_000  # accepted in a file of any size, which may be truncated
_MICROSECOND = 1e-6


def detect(path: Path) -> bool:
    """True if the path is a .sens file, or a folder with exactly one that is no export."""
    if path.is_dir():
        return len(_files(path)) == 1 and not scannet.detect(path)
    return path.suffix.lower() == _SUFFIX and path.is_file()


def read(path: Path, options: Options) -> FrameSequence:
    """Open a ``.sens`` file. Depth maps keep their camera, ``depth_intrinsics``. Frames are named by their number. In a
    truncated file, complete frames are used and the others skipped. Raises ValueError: another version or compression,
    a broken header, or no usable frame."""
    file = _files(path)[0] if path.is_dir() else path
    with file.open("rb") as opened:
        header = _read_header(opened, file)
        # Every frame of the header becomes an entry, even if it is missing; limit their number by the file's size.
        if header["frames"] > max(_FEW_FRAMES, (size := file.stat().st_size) // _FRAME.itemsize):
            raise ValueError(f"{file}: broken header: {header['frames']} frames cannot be in a file of {size:,} bytes")
        color_size, depth_size = (tuple(header[key].tolist()[::-1]) for key in ("color_size", "depth_size"))
        scale = options.truth_scale or 1 / float(header["units_per_metre"])
        frames = _frames(opened, file, int(header["frames"]), depth_size, scale)
    for number in range(len(frames), int(header["frames"])):
        frames.append(Skipped(str(number), "beyond the end of the truncated file"))
    K_color, K_depth = (header[key][:3, :3].astype(np.float64) for key in ("K_color", "K_depth"))
    lens = Lens.of(K_color, color_size) if options.intrinsics is None else None
    cameras = {"size": color_size, "K_depth": K_depth, "depth_size": depth_size}
    return assemble("sens", path, frames, lens, options, name=file.resolve().stem, **cameras)


def _read_header(file: BinaryIO, path: Path) -> np.void:
    """Read the header, a record of ``_HEADER``, from the beginning of a file. Raises ValueError: it is truncated, of
    another version, or has impossible values or unsupported compressions."""
    version = int.from_bytes(_take(file, path, 4), "little")
    if version != _VERSION:
        raise ValueError(f"{path}: expected version {_VERSION} of the .sens format, got {version}")
    length = int.from_bytes(_take(file, path, 8), "little")
    if length > _MAX_NAME:
        raise ValueError(f"{path}: no .sens file, its sensor's name would have {length} bytes")
    _take(file, path, length)
    header = np.frombuffer(_take(file, path, _HEADER.itemsize), _HEADER)[0]
    (color_w, color_h), (depth_w, depth_h) = header["color_size"], header["depth_size"]
    frames, units = header["frames"], header["units_per_metre"]
    sizes_fit = 0 < int(depth_w) * int(depth_h) <= MOST_PIXELS and min(color_w, color_h) > 0
    if not (sizes_fit and 1 <= units < np.inf):
        found = f"images of {color_w}x{color_h}, depth of {depth_w}x{depth_h}, {units:g} units per metre"
        raise ValueError(f"{path}: broken header: {frames} frames, {found}")
    kinds = _COLOR.get(int(header["color"]), "unknown"), _DEPTH.get(int(header["depth"]), "unknown")
    if kinds[0] not in ("jpeg", "png") or kinds[1] != "zlib_ushort":
        supported = "jpeg or png with zlib_ushort can be read: export it with ScanNet's SensReader"
        raise ValueError(f"{path}: colour is {kinds[0]} and depth {kinds[1]}; of a .sens file, {supported}")
    return header


def _take(file: BinaryIO, path: Path, count: int) -> bytes:
    data = file.read(count)
    if len(data) < count:
        raise ValueError(f"{path}: the .sens file ends within its header")
    return data


def _files(folder: Path) -> list[Path]:
    return sorted(p for p in folder.glob(f"*{_SUFFIX}") if p.is_file() and not p.name.startswith("."))


def _frames(file: BinaryIO, path: Path, count: int, depth_size: Size, scale: float) -> list[Entry | Skipped]:
    """The complete ones of the first ``count`` frames, from a file positioned at the first frame."""
    offset, frames = file.tell(), list[Entry | Skipped]()
    end = file.seek(0, os.SEEK_END)
    while len(frames) < count and offset + _FRAME.itemsize <= end:
        file.seek(offset)
        frame, name = np.frombuffer(file.read(_FRAME.itemsize), _FRAME)[0], str(len(frames))
        color_bytes, depth_bytes = frame["bytes"].tolist()
        color_at = offset + _FRAME.itemsize
        depth_at = color_at + color_bytes
        offset = depth_at + depth_bytes
        if offset > end:
            break
        if color_bytes == 0:
            frames.append(Skipped(name, "no image in the file"))
            continue
        time = float(frame["times"][0]) * _MICROSECOND or None
        load_depth = partial(_read_depth, path, depth_at, depth_bytes, depth_size, scale) if depth_bytes else None
        load_color = partial(_read_color, path, color_at, color_bytes)
        T = frame["T_world_cam"].astype(np.float64)
        if not np.abs(T[3] - [0, 0, 0, 1]).max() < 1e-6:  # -inf or 0: no pose
            T = UNKNOWN
        frames.append(Entry(name, T, load_color, load_depth, time))
    return frames


def _read_color(path: Path, offset: int, size: int) -> np.ndarray:
    return read_color(path, _bytes(path, offset, size))


def _read_depth(path: Path, offset: int, size: int, shape: Size, scale: float) -> np.ndarray:
    """[H, W] float32 [m], 0 = invalid."""
    try:
        stream, most = zlib.decompressobj(), _BYTES_PER_DEPTH * shape[0] * shape[1]
        data = stream.decompress(_bytes(path, offset, size), most + 1)
    except zlib.error as error:
        raise FrameError(path, f"the depth map at byte {offset} cannot be decoded: {error}") from error
    if len(data) != most or not stream.eof:
        has = f"more than {most}" if len(data) > most else f"{len(data)}"
        expected = f"{shape[1]}x{shape[0]} of {_BYTES_PER_DEPTH}"
        raise FrameError(path, f"the depth map at byte {offset} has {has} bytes, expected {expected}")
    return (np.frombuffer(data, "<u2").reshape(shape) * scale).astype(np.float32)


def _bytes(path: Path, offset: int, size: int) -> bytes:
    """Read a part of the file. Raises FrameError: it cannot be read."""
    try:
        with path.open("rb") as file:
            file.seek(offset)
            data = file.read(size)
    except OSError as error:
        raise FrameError(path, f"cannot be read: {error}") from error
    if len(data) < size:
        raise FrameError(path, f"ends within the {size} bytes at {offset}")
    return data

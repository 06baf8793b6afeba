"""Depth maps in OpenEXR files, read without a library.

Current OpenCV wheels are built without OpenEXR and no other library we depend on reads a file's ``Z``
channel, so this reads the part of the format that OpenCV, Blender and FFmpeg write by default: one part,
scan lines, uncompressed, RLE or ZIP; half, float or uint channels
(https://openexr.com/en/latest/OpenEXRFileLayout.html).
"""

from __future__ import annotations

import struct
import zlib
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ufmstar_torch.eval.sequences.frame import FrameError

_MAGIC = 20000630
_TILED, _DEEP, _MULTIPART = 0x200, 0x800, 0x1000
_PIXEL_TYPES: dict[int, np.dtype] = {0: np.dtype("<u4"), 1: np.dtype("<f2"), 2: np.dtype("<f4")}
_COMPRESSIONS = ("none", "RLE", "ZIPS", "ZIP", "PIZ", "PXR24", "B44", "B44A", "DWAA", "DWAB")
_LINES_PER_CHUNK = {"none": 1, "RLE": 1, "ZIPS": 1, "ZIP": 16}
# What a depth channel is called, best first; Blender prefixes its layer ("ViewLayer.Depth.Z").
_DEPTH_NAMES = ("Z", "depth", "V", "Y", "R")


@dataclass(frozen=True)
class _Header:
    channels: tuple[tuple[str, np.dtype], ...]
    compression: str
    height: int
    width: int
    first_line: int
    end: int


def read_exr(path: str | Path) -> np.ndarray:
    """The depth channel of an OpenEXR file as [H, W] float32, values as stored.

    It is the only channel, or the first that is called Z, depth, V, Y or R (after a layer prefix).

    Raises:
        FrameError: not an OpenEXR file, truncated, no such channel, or a variant this reader does not
            know (tiles, several parts, PIZ and the lossy compressions).
    """
    data = Path(path).read_bytes()
    try:
        header = _read_header(data)
        name = _depth_channel([channel for channel, _ in header.channels])
        return _read_channel(data, header, name)
    except (struct.error, zlib.error, IndexError, ValueError) as error:
        raise FrameError(path, f"cannot be read as OpenEXR: {error}") from error


def _read_header(data: bytes) -> _Header:
    magic, version = struct.unpack_from("<II", data, 0)
    if magic != _MAGIC:
        raise ValueError("wrong magic number")
    if version & (_TILED | _DEEP | _MULTIPART):
        raise ValueError("tiled, deep and multi-part files are not supported, save single-part scan lines")
    attributes, at = {}, 8
    while data[at] != 0:
        name, at = _c_string(data, at)
        _, at = _c_string(data, at)
        (size,) = struct.unpack_from("<i", data, at)
        attributes[name] = data[at + 4 : at + 4 + size]
        at += 4 + size
    missing = {"channels", "compression", "dataWindow"} - attributes.keys()
    if missing:
        raise ValueError(f"the header has no {sorted(missing)}")
    x0, y0, x1, y1 = struct.unpack("<4i", attributes["dataWindow"])
    compression = _COMPRESSIONS[attributes["compression"][0]]
    if compression not in _LINES_PER_CHUNK:
        raise ValueError(f"{compression} compression is not supported, save with ZIP, or as .npy")
    channels = _read_channel_list(attributes["channels"])
    return _Header(channels, compression, y1 - y0 + 1, x1 - x0 + 1, y0, at + 1)


def _read_channel_list(data: bytes) -> tuple[tuple[str, np.dtype], ...]:
    channels: list[tuple[str, np.dtype]] = []
    at = 0
    while data[at] != 0:
        name, at = _c_string(data, at)
        kind, _, x_sampling, y_sampling = struct.unpack_from("<iIii", data, at)
        if (x_sampling, y_sampling) != (1, 1) or kind not in _PIXEL_TYPES:
            raise ValueError(f"channel {name!r} is subsampled or of an unknown type")
        channels.append((name, _PIXEL_TYPES[kind]))
        at += 16
    return tuple(channels)


def _depth_channel(names: list[str]) -> str:
    if len(names) == 1:
        return names[0]
    for wanted in _DEPTH_NAMES:
        found = [name for name in names if name.rsplit(".", 1)[-1].lower() == wanted.lower()]
        if len(found) == 1:
            return found[0]
    raise ValueError(f"no channel is the depth: expected one of {_DEPTH_NAMES}, got {names}")


def _read_channel(data: bytes, header: _Header, name: str) -> np.ndarray:
    lines = _LINES_PER_CHUNK[header.compression]
    chunks = -(-header.height // lines)
    offsets = struct.unpack_from(f"<{chunks}Q", data, header.end)
    line_bytes = header.width * sum(kind.itemsize for _, kind in header.channels)
    before = 0
    for channel, kind in header.channels:
        if channel == name:
            break
        before += header.width * kind.itemsize
    out = np.empty((header.height, header.width), dtype=np.float32)
    for offset in offsets:
        y, size = struct.unpack_from("<ii", data, offset)
        row = y - header.first_line
        rows = min(lines, header.height - row)
        packed = data[offset + 8 : offset + 8 + size]
        raw = _decompress(packed, rows * line_bytes, header.compression)
        block = np.frombuffer(raw, dtype=np.uint8).reshape(rows, line_bytes)
        part = np.ascontiguousarray(block[:, before : before + header.width * kind.itemsize])
        out[row : row + rows] = part.view(kind)
    return out


def _decompress(packed: bytes, size: int, compression: str) -> bytes:
    if compression == "none" or len(packed) == size:  # a chunk that does not shrink is stored as it is
        return packed
    unpacked = _unpack_runs(packed) if compression == "RLE" else zlib.decompress(packed)
    # Undo the predictor (differences of neighbouring bytes, offset by 128), then put the bytes of the
    # first and the second half back into even and odd places.
    steps = np.frombuffer(unpacked, dtype=np.uint8).astype(np.int64)
    steps[1:] -= 128
    plain = (np.cumsum(steps) & 0xFF).astype(np.uint8)
    if len(plain) != size:
        raise ValueError(f"a chunk unpacks to {len(plain)} bytes, expected {size}")
    out = np.empty(size, dtype=np.uint8)
    half = (size + 1) // 2
    out[0::2], out[1::2] = plain[:half], plain[half:]
    return out.tobytes()


def _unpack_runs(packed: bytes) -> bytes:
    out, at = bytearray(), 0
    while at < len(packed):
        (count,) = struct.unpack_from("<b", packed, at)
        if count < 0:
            out += packed[at + 1 : at + 1 - count]
            at += 1 - count
        else:
            out += packed[at + 1 : at + 2] * (count + 1)
            at += 2
    return bytes(out)


def _c_string(data: bytes, at: int) -> tuple[str, int]:
    end = data.index(b"\0", at)
    return data[at:end].decode("latin-1"), end + 1

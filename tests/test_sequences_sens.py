"""ScanNet's .sens container: the read data equals the written data; truncation; unsupported compressions."""

from __future__ import annotations

import itertools
import os
import shutil
import struct
import tracemalloc
import zlib

import layouts
import numpy as np
import pytest
from layouts_more import write_sens

from ufmstar_torch.eval.sequences import FrameError, find_sequences, open_sequence

# Bytes before the first frame: version, name with its length (15), four matrices, sizes and counts.
HEADER = 4 + 8 + 15 + 4 * 64 + 2 * 4 + 4 * 4 + 4 + 8
FRAME = 64 + 4 * 8


@pytest.fixture(scope="module")
def written(tmp_path_factory):
    return write_sens(tmp_path_factory.mktemp("scans") / "scene0000_00" / "scene0000_00.sens", lost=(2,))


@pytest.fixture
def file(written, tmp_path):
    """A copy that the test may change."""
    return shutil.copy(written[0], tmp_path / "scene.sens")


def frame_offsets(path):
    """Return the byte offset of each frame, from the sizes in the file."""
    data, position, result = path.read_bytes(), HEADER, []
    for _ in range(struct.unpack_from("<Q", data, HEADER - 8)[0]):
        result.append(position)
        color, depth = struct.unpack_from("<2Q", data, position + 64 + 16)
        position += FRAME + color + depth
    assert position == len(data) - 8  # the number of IMU frames
    return result


def test_times_and_frames_that_were_not_tracked(written):
    sequence = open_sequence(written[0])
    assert (sequence.layout, sequence.name) == ("sens", "scene0000_00")
    assert sequence.names == ("0", "1", "3", "4", "5")
    assert [(f.name, f.reason) for f in sequence.skipped] == [("2", "non-finite pose")]
    assert [frame.timestamp for frame in sequence] == pytest.approx([10 + i / 30 for i in (0, 1, 3, 4, 5)], abs=1e-6)


def test_a_folder_that_holds_one(written, tmp_path):
    path = written[0]
    assert open_sequence(path.parent).names == open_sequence(path).names
    assert [(f.name, f.layout) for f in find_sequences(path.parents[1])] == [("scene0000_00", "sens")]
    export, _, _ = layouts.write_scannet(tmp_path)
    shutil.copy(path, export)
    assert open_sequence(export).layout == "scannet"  # the same frames, exported
    assert open_sequence(export / path.name).layout == "sens"


def test_opening_takes_no_memory_for_what_the_frames_hold(tmp_path):
    """Three frames with depth maps of 4 MB: opening them allocates a small part of one."""
    path, _, _ = write_sens(tmp_path / "a.sens", frames=3)
    data, offsets = path.read_bytes(), [*frame_offsets(path), path.stat().st_size - 8]
    parts, filler = [data[:HEADER]], bytes(4_000_000)
    for start, end in itertools.pairwise(offsets):
        color, depth = struct.unpack_from("<2Q", data, start + 80)
        sizes = struct.pack("<2Q", color, depth + len(filler))
        parts += [data[start : start + 80], sizes, data[start + FRAME : end], filler]
    path.write_bytes(b"".join(parts))
    del parts, filler, data
    tracemalloc.start()
    opened = open_sequence(path)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert len(opened) == 3
    assert peak < 1_000_000


@pytest.mark.parametrize("share", [0.35, 0.6, 0.9])
def test_a_truncated_file_keeps_the_frames_before_the_break(file, written, share):
    offsets = frame_offsets(file)
    cut = int(file.stat().st_size * share)
    os.truncate(file, cut)
    complete = sum(offset <= cut for offset in offsets[1:])
    sequence = open_sequence(file)
    beyond = [f.name for f in sequence.skipped if f.reason == "beyond the end of the truncated file"]
    assert beyond == [str(i) for i in range(complete, 6)]
    assert sequence.names == tuple(str(i) for i in range(complete) if i != 2)
    assert sequence.names_on_disk == ("0", "1", "2", "3", "4", "5")
    whole = open_sequence(written[0])
    np.testing.assert_array_equal(sequence[-1].depth, whole[len(sequence) - 1].depth)


def test_a_file_cut_within_a_frames_header_or_the_files(file):
    os.truncate(file, frame_offsets(file)[1] + 50)
    assert open_sequence(file).names == ("0",)
    os.truncate(file, HEADER + 50)
    with pytest.raises(ValueError, match="no usable frame: 6 x beyond the end of the truncated file"):
        open_sequence(file)
    os.truncate(file, 100)
    with pytest.raises(ValueError, match=r"scene\.sens: the \.sens file ends within its header"):
        open_sequence(file)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"color": 0}, "colour is raw and depth zlib_ushort; .* jpeg or png with zlib_ushort can be read: export it"),
        ({"depth": 0}, "colour is jpeg and depth raw_ushort"),
        ({"depth": 2}, "colour is jpeg and depth occi_ushort"),
        ({"color": -1, "depth": -1}, "colour is unknown and depth unknown"),
        ({"version": 3}, r"expected version 4 of the \.sens format, got 3"),
        ({"name": b"x" * 20_000}, "its sensor's name would have 20000 bytes"),
    ],
)
def test_what_cannot_be_read_is_refused(tmp_path, options, message):
    path, _, _ = write_sens(tmp_path / "a.sens", frames=1, **options)
    with pytest.raises(ValueError, match=message):
        open_sequence(path)


def test_depth_that_expands_without_limit(tmp_path):
    """A depth map that expands from 300 kB to 300 MB, or has a size of 32 EB in its header."""
    path, _, _ = write_sens(tmp_path / "a.sens", frames=1)
    data, (offset,) = bytearray(path.read_bytes()), frame_offsets(path)
    color, _ = struct.unpack_from("<2Q", data, offset + 80)
    bomb = zlib.compress(bytes(300_000_000), 1)
    struct.pack_into("<Q", data, offset + 88, len(bomb))
    path.write_bytes(data[: offset + FRAME + color] + bomb)
    sequence = open_sequence(path)
    tracemalloc.start()
    with pytest.raises(FrameError, match=r"a\.sens.* more than 6144 bytes"):
        sequence[0]
    assert tracemalloc.get_traced_memory()[1] < 20_000_000
    tracemalloc.stop()
    struct.pack_into("<2I", data, HEADER - 8 - 4 - 8, 2**32 - 1, 2**32 - 1)
    path.write_bytes(data)
    with pytest.raises(ValueError, match=r"a\.sens: broken header"):
        open_sequence(path)


@pytest.mark.parametrize("frames", [2**62, 10**7])
def test_a_broken_header_is_refused(file, frames):
    """The number of frames in the header is bounded by the file's size, because each frame needs an entry."""
    data = bytearray(file.read_bytes())
    struct.pack_into("<Q", data, HEADER - 8, frames)
    file.write_bytes(data)
    with pytest.raises(ValueError, match=rf"scene\.sens: broken header: {frames} frames cannot be in"):
        open_sequence(file)


def test_broken_frames_are_found_when_decoding(file):
    data, offsets = bytearray(file.read_bytes()), frame_offsets(file)
    data[offsets[0] + FRAME : offsets[0] + FRAME + 60] = bytes(60)
    color, _ = struct.unpack_from("<2Q", data, offsets[1] + 80)
    data[offsets[1] + FRAME + color + 10 : offsets[1] + FRAME + color + 40] = bytes(30)
    struct.pack_into("<2I", data, HEADER - 8 - 4 - 8, 64, 47)  # the header's depth size
    file.write_bytes(data)
    errors = []
    assert list(open_sequence(file).readable(errors.append)) == []
    message = [str(error) for error in errors]
    assert "cannot be decoded" in message[0]
    assert "depth map at byte" in message[1]
    assert "has more than 6016 bytes, expected 64x47 of 2" in message[2]
    struct.pack_into("<2I", data, HEADER - 8 - 4 - 16, 161, 121)
    file.write_bytes(data)
    with pytest.raises(FrameError, match="the image is 162x121, the sequence's are 161x121"):
        open_sequence(file)[3]


def test_frames_without_image_or_depth(file):
    """The sizes in a frame's header may be 0. A frame without an image is skipped; a frame without a depth map has
    none."""
    data, offsets = file.read_bytes(), frame_offsets(file)
    out = bytearray(data[: offsets[0]])
    for number, (start, end) in enumerate(zip(offsets, [*offsets[1:], len(data) - 8], strict=True)):
        color, depth = struct.unpack_from("<2Q", data, start + 80)
        sizes = (0 if number == 3 else color, 0 if number == 4 else depth)
        body = data[start + FRAME : end]
        out += data[start : start + 80] + struct.pack("<2Q", *sizes)
        out += body[color - sizes[0] :][: sizes[0]] + body[color : color + sizes[1]]
    file.write_bytes(out)
    sequence = open_sequence(file)
    assert {f.name: f.reason for f in sequence.skipped} == {"2": "non-finite pose", "3": "no image in the file"}
    assert sequence.without_depth == ("4",)
    assert sequence[-1].depth is not None

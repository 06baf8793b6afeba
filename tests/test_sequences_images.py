"""Decoding of images and depth maps."""

from __future__ import annotations

import os
import struct
import subprocess
import sys
import tracemalloc
import zipfile
import zlib
from contextlib import suppress
from pathlib import Path

import numpy as np
import pytest
from layouts import truncate, write_depth_png, write_image
from PIL import Image

from ufmstar_torch.eval.sequences import images
from ufmstar_torch.eval.sequences.frame import FrameError
from ufmstar_torch.eval.sequences.images import image_size, read_color, read_depth
from ufmstar_torch.eval.sequences.paths import list_files
from ufmstar_torch.files import limits

RNG = np.random.default_rng(0)


def test_sixteen_bits_stay_positive(tmp_path):
    values = np.array([[0, 1, 32767], [32768, 40000, 65535]], dtype=np.uint16)
    Image.fromarray(values).save(tmp_path / "d.png")
    depth = read_depth(tmp_path / "d.png", scale=1 / 5000)
    assert depth.dtype == np.float32
    np.testing.assert_allclose(depth, values / 5000.0, rtol=1e-7)
    np.testing.assert_allclose(read_depth(tmp_path / "d.png"), values / 1000.0, rtol=1e-7)


def test_the_scale_of_the_png_text_wins_over_a_default_and_must_be_that_of_the_argument(tmp_path):
    write_depth_png(tmp_path / "d.png", np.full((2, 3), 2.0), 4000, scale_text="0.00025")
    assert (read_depth(tmp_path / "d.png") == 2.0).all()
    assert (read_depth(tmp_path / "d.png", default_scale=1 / 5000) == 2.0).all()
    np.testing.assert_allclose(read_depth(tmp_path / "d.png", scale=0.00025), 2.0)
    with pytest.raises(FrameError, match=r"states 0\.00025 metres per unit, which contradicts the given 0\.001"):
        read_depth(tmp_path / "d.png", scale=0.001)


@pytest.mark.parametrize("suffix", ["npy", "npz", "tif"])
def test_float_maps_are_metres_and_invalid_values_zero(tmp_path, suffix):
    stored = np.array([[1.5, -1.0, np.nan], [np.inf, 0.0, 70.25]], np.float32 if suffix == "tif" else np.float64)
    stored[1, 1] = 0 if suffix == "tif" else 1e300
    path = tmp_path / f"d.{suffix}"
    if suffix == "npy":
        np.save(path, stored)
    elif suffix == "npz":
        np.savez(path, depth=stored, variance=-stored)
    else:
        Image.fromarray(stored).save(path)
    np.testing.assert_array_equal(read_depth(path), np.array([[1.5, 0, 0], [0, 0, 70.25]], dtype=np.float32))
    np.testing.assert_array_equal(read_depth(path, scale=0.5)[1], np.array([0, 0, 35.125], dtype=np.float32))


def test_integer_arrays_are_millimetres_and_one_channel_is_dropped(tmp_path):
    np.save(tmp_path / "d.npy", np.full((1, 4, 5), 1500, dtype=np.uint16))
    depth = read_depth(tmp_path / "d.npy")
    assert depth.shape == (4, 5)
    assert (depth == np.float32(1.5)).all()


def test_color_is_rgb_whatever_the_file(tmp_path, caplog):
    image = RNG.integers(0, 255, (6, 5, 3), dtype=np.uint8)
    write_image(tmp_path / "a.png", image)
    np.testing.assert_array_equal(read_color(tmp_path / "a.png"), image)
    alpha = np.dstack([image, np.full((6, 5), 7, np.uint8)])
    write_image(tmp_path / "b.png", alpha)
    np.testing.assert_array_equal(read_color(tmp_path / "b.png"), image)
    write_image(tmp_path / "c.png", image[..., 0])
    np.testing.assert_array_equal(read_color(tmp_path / "c.png"), np.repeat(image[..., :1], 3, axis=2))
    Image.fromarray(image[..., 0]).save(
        tmp_path / "turned.png", exif=b"Exif\0\0MM\0*\0\0\0\x08\0\x01\x01\x12\0\x03\0\0\0\x01\0\x06\0\0\0\0\0\0"
    )
    assert read_color(tmp_path / "turned.png").shape == (6, 5, 3)
    assert "EXIF turns the images; K and depth must be those of the stored pixels" in caplog.text


def test_both_png_decoders_have_the_same_pixels(tmp_path):
    """kornia_rs decodes 8-bit RGB, Pillow everything else."""
    image, grey = RNG.integers(0, 255, (6, 5, 3), dtype=np.uint8), RNG.integers(0, 65535, (6, 5), dtype=np.uint16)
    palette = Image.fromarray(image).quantize(16)
    for name, picture, plain in (("rgb", Image.fromarray(image), True), ("palette", palette, False)):
        picture.save(tmp_path / f"{name}.png")
        assert (images._plain_png(tmp_path / f"{name}.png") is not None) == plain
        np.testing.assert_array_equal(read_color(tmp_path / f"{name}.png"), np.array(picture.convert("RGB")))
    for text in (None, "0.5"):
        write_depth_png(tmp_path / "d.png", grey / 1000, 1000, scale_text=text)
        np.testing.assert_array_equal(images.read_map(tmp_path / "d.png", "depth")[0], grey)
        expected = (grey * np.float64(0.5 if text else 1 / 5000)).astype(np.float32)
        np.testing.assert_array_equal(read_depth(tmp_path / "d.png", default_scale=1 / 5000), expected)


def write_depth(path, depth):
    if path.suffix == ".png":
        write_depth_png(path, depth, 1000)
    elif path.suffix == ".exr":
        encode_exr(path, depth, "zip16")
    else:
        {".npy": np.save, ".npz": np.savez_compressed}[path.suffix](path, depth)


@pytest.mark.parametrize("name", ["a.png", "a.jpg", "d.png", "d.npy", "d.npz", "d.exr"])
@pytest.mark.parametrize("share", [0.0, 0.05, 0.5, 0.95])
def test_truncated_files_raise(tmp_path, name, share):
    path, noise = tmp_path / name, RNG.uniform(1, 5, (48, 64)).astype(np.float32)
    if name[0] == "a":
        write_image(path, (50 * noise[..., None] * [1, 0.7, 0.3]).astype(np.uint8))
    else:
        write_depth(path, noise)
    truncate(path, share)
    with pytest.raises(FrameError) as caught:
        (read_color if name[0] == "a" else read_depth)(path)
    assert caught.value.path == path


def test_a_damaged_png_raises(tmp_path):
    write_depth_png(tmp_path / "d.png", RNG.uniform(1, 5, (48, 64)), 1000)
    data = bytearray((tmp_path / "d.png").read_bytes())
    data[200] ^= 0xFF
    (tmp_path / "d.png").write_bytes(bytes(data))
    with pytest.raises(FrameError):
        read_depth(tmp_path / "d.png")


def test_what_is_no_depth_map_is_named(tmp_path):
    write_image(tmp_path / "grey.png", np.zeros((4, 5), np.uint8))
    with pytest.raises(FrameError, match="expected a 16-bit or float depth image"):
        read_depth(tmp_path / "grey.png")
    np.savez(tmp_path / "two.npz", a=np.zeros((2, 2)), b=np.zeros((2, 2)))
    with pytest.raises(FrameError, match=r"two\.npz.*expected the arrays depth, got a, b"):
        read_depth(tmp_path / "two.npz")
    np.save(tmp_path / "rgb.npy", np.zeros((4, 5, 3)))
    with pytest.raises(FrameError, match="expected a map"):
        read_depth(tmp_path / "rgb.npy")
    np.save(tmp_path / "object.npy", np.array([{"a": 1}], dtype=object), allow_pickle=True)
    with pytest.raises(FrameError):
        read_depth(tmp_path / "object.npy")
    with pytest.raises(FrameError):
        read_depth(tmp_path / "absent.png")
    Image.fromarray(np.ones((4, 5), np.float32)).save(tmp_path / "depth.tif")
    with pytest.raises(FrameError, match="expected an image of 8 or 16 bits, got mode F"):
        read_color(tmp_path / "depth.tif")


def _npy(shape: str, descr: str = "'<f4'", content: bytes = bytes(64)) -> bytes:
    header = f"{{'descr': {descr}, 'fortran_order': False, 'shape': {shape}}}".encode()
    return b"\x93NUMPY\x01\x00" + struct.pack("<H", len(header)) + header + content


_HEADERS = {
    "huge": _npy("(1000000, 1000000)"),
    "overflow": _npy("(99999999999999999999, 4)"),
    "negative": _npy("(-4, -4)"),
    "type": _npy("(4, 4)", "'<q99'"),
    "objects": _npy("(4, 4)", "'|O'"),
    "brackets": _npy("(" * 5000),
    "short": _npy("(4, 4)")[:9],
    "cut": _npy("(4, 4)", content=bytes(63)),
    "words": _npy("(4, 4,"),
}


@pytest.mark.parametrize("kind", _HEADERS)
@pytest.mark.parametrize("suffix", ["npy", "npz"])
def test_a_damaged_header_of_an_array_is_a_frame_error(tmp_path, kind, suffix):
    file = tmp_path / f"a.{suffix}"
    if suffix == "npy":
        file.write_bytes(_HEADERS[kind])
    else:
        with zipfile.ZipFile(file, "w", zipfile.ZIP_DEFLATED) as archive:
            archive.writestr("depth.npy", _HEADERS[kind])
    with pytest.raises(FrameError, match=rf"a\.{suffix}"):
        read_depth(file)


def test_an_array_that_expands_has_a_bound(tmp_path, monkeypatch):
    """Reads at most a member's stated size, and allocates at most the limit."""
    file = tmp_path / "a.npz"
    np.savez_compressed(file, depth=np.zeros((2000, 5000), np.float32))
    monkeypatch.setattr(limits, "MOST_BYTES", 1_000_000)
    tracemalloc.start()
    with pytest.raises(FrameError, match=r"a\.npz"):
        read_depth(file)
    content = bytearray(file.read_bytes())
    entry = content.index(b"PK\x01\x02")
    struct.pack_into("<I", content, entry + 24, 200)  # the expanded size in the archive's directory
    file.write_bytes(content)
    with pytest.raises(FrameError, match=r"a\.npz"):
        read_depth(file)
    assert tracemalloc.get_traced_memory()[1] < 5_000_000
    tracemalloc.stop()


def test_damage_at_any_byte_of_an_archive_is_a_frame_error(tmp_path):
    np.savez_compressed(tmp_path / "a.npz", depth=np.ones((4, 5), np.float32))
    content, file = (tmp_path / "a.npz").read_bytes(), tmp_path / "b.npz"
    for index in range(len(content)):
        file.write_bytes(content[:index] + bytes([content[index] ^ 0xFF]) + content[index + 1 :])
        with suppress(FrameError):
            assert read_depth(file).shape == (4, 5)  # a byte without effect
        file.write_bytes(content[:index])
        with pytest.raises(FrameError, match=r"b\.npz"):
            read_depth(file)


def test_numbers_in_names_sort_by_value(tmp_path):
    for name in ("10.png", "2.png", "b1.png", "a03.png", "a2.png", "1.txt"):
        (tmp_path / name).touch()
    assert [p.name for p in list_files(tmp_path, (".png",))] == ["2.png", "10.png", "a2.png", "a03.png", "b1.png"]


def encode_exr(path, values, compression, pixel_type="float"):
    """FFmpeg's encoder, an independent implementation of the format (channel Y)."""
    imageio_ffmpeg = pytest.importorskip("imageio_ffmpeg")
    height, width = values.shape
    command = [imageio_ffmpeg.get_ffmpeg_exe(), "-v", "error", "-y", "-f", "rawvideo", "-pix_fmt", "grayf32le"]
    command += ["-s", f"{width}x{height}", "-i", "-", "-c:v", "exr", "-compression", compression]
    command += ["-format", pixel_type, "-frames:v", "1", str(path)]
    subprocess.run(command, input=values.astype("<f4").tobytes(), check=True)


@pytest.mark.parametrize("pixel_type", ["float", "half"])
@pytest.mark.parametrize("compression", ["none", "rle", "zip1", "zip16"])
@pytest.mark.parametrize("smooth", [True, False])  # noise does not compress: its chunks are stored uncompressed
def test_exr_equals_what_ffmpeg_wrote(tmp_path, compression, pixel_type, smooth):
    noise = RNG.uniform(0.1, 60, (37, 53))
    values = (np.linspace(1, 9, 37)[:, None] + np.linspace(0, 2, 53).round(1) if smooth else noise).astype(np.float32)
    if pixel_type == "half":
        values = values.astype(np.float16).astype(np.float32)  # exact in half precision: no rounding
    encode_exr(tmp_path / "d.exr", values, compression, pixel_type)
    np.testing.assert_array_equal(read_depth(tmp_path / "d.exr"), values)


def write_exr(path, channels, compression="ZIP", **header):
    """Write a file with [H, W] arrays by channel name."""
    OpenEXR = pytest.importorskip("OpenEXR")
    kind = OpenEXR.tiledimage if "tiles" in header else OpenEXR.scanlineimage
    header |= {"compression": getattr(OpenEXR, f"{compression}_COMPRESSION"), "type": kind}
    OpenEXR.File(header, dict(channels)).write(str(path))


@pytest.mark.parametrize("names", [("B", "G", "R", "Z"), ("A", "View.Depth.Z"), ("A", "B", "R"), ("whatever",)])
def test_the_depth_channel_is_found(tmp_path, names):
    expected = next((n for n in names if n.endswith("Z")), "R" if "R" in names else names[0])
    channels = {name: RNG.uniform(1, 2, (4, 6)).astype(np.float32) for name in names}
    write_exr(tmp_path / "d.exr", channels)
    np.testing.assert_array_equal(read_depth(tmp_path / "d.exr"), channels[expected])


def test_what_is_no_depth_in_an_exr_is_named(tmp_path, capfd):
    values = np.ones((4, 6), np.float32)
    write_exr(tmp_path / "d.exr", {"B": values, "U": values})
    with pytest.raises(FrameError, match="no channel is the depth"):
        read_depth(tmp_path / "d.exr")
    (tmp_path / "d.exr").write_bytes(b"not an EXR file")
    with pytest.raises(FrameError, match="cannot be decoded as OpenEXR"):
        read_depth(tmp_path / "d.exr")
    write_exr(tmp_path / "d.exr", {"Z": RNG.uniform(1, 2, (70, 90)).astype(np.float32)})
    truncate(tmp_path / "d.exr", 0.7)
    with pytest.raises(FrameError, match="no pixels can be decoded"):
        read_depth(tmp_path / "d.exr")
    assert capfd.readouterr().out == ""


@pytest.mark.parametrize("name", ["d.png", "d.exr"])
def test_a_file_that_claims_a_huge_image_is_a_frame_error(tmp_path, name):
    """A header with a huge size and no data is refused before memory is allocated."""
    path = tmp_path / name
    if name == "d.png":
        write_depth_png(path, np.ones((4, 5)), 1000)
        data = bytearray(path.read_bytes())
        data[16:24] = struct.pack(">2I", 60_000, 60_000)
        data[29:33] = struct.pack(">I", zlib.crc32(data[12:29]))
    else:
        write_exr(path, {"Z": np.ones((4, 6), np.float32)})
        data = bytearray(path.read_bytes())
        at = data.index(b"dataWindow\0box2i\0") + len(b"dataWindow\0box2i\0") + 4
        data[at : at + 16] = struct.pack("<4i", 0, 0, 59_999, 59_999)
    path.write_bytes(bytes(data))
    for read in (read_depth, read_color, image_size) if name == "d.png" else (read_depth,):
        with pytest.raises(FrameError, match="cannot be decoded"):
            read(path)


@pytest.mark.parametrize("kind", [RuntimeError, MemoryError])
def test_only_a_bare_exception_of_the_png_decoder_leaves_the_file_to_pillow(tmp_path, monkeypatch, kind):
    """kornia_rs raises plain Exception; another exception type does not mean a damaged file."""
    write_image(tmp_path / "a.png", np.full((4, 5, 3), 7, np.uint8))

    def fails(error):
        def read(*_):
            raise error

        monkeypatch.setattr("kornia_rs.io.read_image_png_u8", read)

    fails(Exception("damaged"))
    np.testing.assert_array_equal(read_color(tmp_path / "a.png"), np.full((4, 5, 3), 7, np.uint8))
    fails(kind("no memory"))
    with pytest.raises(kind, match="no memory"):
        read_color(tmp_path / "a.png")


@pytest.mark.skipif(sys.platform != "linux", reason="names of files are text")
def test_a_name_that_is_not_utf_8(tmp_path):
    pixels = np.random.default_rng(0).integers(0, 256, (4, 5, 3), np.uint8)
    path = Path(os.fsdecode(os.fsencode(tmp_path) + b"/1\xff.png"))
    with path.open("wb") as file:
        Image.fromarray(pixels).save(file, "PNG")
    np.testing.assert_array_equal(read_color(path), pixels)

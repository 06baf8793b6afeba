"""Images of 16 bits and with transparency: their scale, and the unit of depth in a PNG."""

from __future__ import annotations

import cv2
import layouts
import layouts_calibrated as written
import numpy as np
import pytest
from PIL import Image

from ufmstar_torch.eval.sequences import FrameError, open_sequence
from ufmstar_torch.eval.sequences.images import full_scale, grey_bytes, read_color, read_depth

RNG = np.random.default_rng(0)


def write_grey16(path, values):
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(values.astype(np.uint16)).save(path)


# ---- 16-bit grey and transparent images


@pytest.mark.parametrize(
    ("highest", "full"), [(0, 255), (255, 255), (256, 1023), (4095, 4095), (4096, 16383), (65535,) * 2]
)
def test_the_scale_is_that_of_the_camera_s_bits(highest, full):
    assert full_scale(np.array([[0, highest]], np.uint16)) == full
    assert grey_bytes(np.array([0, full // 2, full, 65535]), full).tolist() in ([0, 127, 255, 255], [0, 128, 255, 255])


@pytest.mark.parametrize("suffix", ["png", "tif", "pgm"])
def test_16_bit_grey_is_scaled_by_its_folder(tmp_path, caplog, suffix):
    """A dark image of a 12-bit camera stays dark, and the scale is logged once."""
    path, truth = layouts.write_generic(tmp_path)
    grey = [cv2.cvtColor(image, cv2.COLOR_RGB2GRAY) for image in truth.images]
    for i, values in enumerate(grey):
        (path / "images" / f"{i + 7}.png").unlink()
        dark = 0.1 if i == 2 else 1.0
        write_grey16(path / "images" / f"{i + 7}.{suffix}", np.rint(values * dark * 4095 / 255))
    brightest = max(values.max() for i, values in enumerate(grey) if i != 2)
    assert brightest > 64, "the largest value needs 12 bits"
    sequence = open_sequence(path)
    for i, frame in enumerate(sequence):
        expected = grey[i] * (0.1 if i == 2 else 1.0)
        np.testing.assert_allclose(frame.image, np.repeat(expected[..., None], 3, axis=2), atol=0.6)
    assert [record.getMessage() for record in caplog.records if "16 bits" in record.message] == [
        f"{path / 'images'}: images of 16 bits, read as 0 to 4095 and scaled to bytes"
    ]
    assert read_color("image", (path / "images" / f"7.{suffix}").read_bytes()).shape == (48, 64, 3)


@pytest.mark.parametrize("suffix", ["png", "tiff"])
def test_16_bit_colours_are_scaled_too(tmp_path, suffix):
    """Pillow would keep the high bytes: 12 bits would be black."""
    colours = RNG.integers(0, 256, (6, 5, 3))
    colours[0, 0] = 255
    for i, factor in enumerate((1.0, 0.1)):
        values = np.rint(colours * factor * 4095 / 255).astype(np.uint16)
        cv2.imwrite(str(tmp_path / f"{i}.{suffix}"), values[..., ::-1])
        np.testing.assert_allclose(read_color(tmp_path / f"{i}.{suffix}"), colours * factor, atol=0.6)
    content = (tmp_path / f"0.{suffix}").read_bytes()
    np.testing.assert_allclose(read_color("image", content), colours, atol=0.6)
    if suffix == "tiff":  # Pillow warns of truncated ones
        return
    layouts.truncate(tmp_path / f"1.{suffix}", 0.9)
    with pytest.raises(FrameError):
        read_color(tmp_path / f"1.{suffix}")


def test_euroc_with_16_bit_images(tmp_path):
    """TUM-VI."""
    path, truth = written.write_euroc(tmp_path)
    files = sorted((path / "mav0" / "cam0" / "data").iterdir())
    for file, image in zip(files, truth.images, strict=True):
        write_grey16(file, image[..., 0].astype(np.uint16) * 257)
    sequence = open_sequence(path)
    for frame, image in zip(sequence, truth.images, strict=True):
        np.testing.assert_array_equal(frame.image, np.repeat(image[..., :1], 3, axis=2))


def test_transparent_pixels_are_black(tmp_path, caplog):
    image = RNG.integers(0, 255, (6, 5, 3), dtype=np.uint8)
    alpha = np.full((6, 5), 255, np.uint8)
    alpha[:2], alpha[2] = 0, 51
    for i in range(2):
        layouts.write_image(tmp_path / f"{i}.png", np.dstack([image, alpha]))
        found = read_color(tmp_path / f"{i}.png")
        assert not found[:2].any()
        np.testing.assert_allclose(found[2], image[2] * 0.2, atol=0.5)
        np.testing.assert_array_equal(found[3:], image[3:])
    assert [record.getMessage() for record in caplog.records] == [
        f"{tmp_path}: images with transparent pixels, which are read as black"
    ]
    for value in (0, 255):  # some programs leave alpha 0
        layouts.write_image(tmp_path / "same.png", np.dstack([image, alpha * 0 + np.uint8(value)]))
        np.testing.assert_array_equal(read_color(tmp_path / "same.png"), image)


def test_a_png_s_unit_of_depth_is_positive(tmp_path):
    for text in ("nan", "0", "-1", "inf"):
        layouts.write_depth_png(tmp_path / "d.png", np.ones((2, 3)), 1000, scale_text=text)
        with pytest.raises(FrameError, match=f"its text depth_scale must be positive metres per unit, got {text}"):
            read_depth(tmp_path / "d.png")

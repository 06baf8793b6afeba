"""Decoding of colour images and depth maps; every file that cannot be decoded raises ``FrameError``.

PNGs of 8-bit RGB are decoded by kornia_rs, in a third of Pillow's time; all other files by Pillow, which raises errors
for truncated files, while OpenCV returns partial images. An EXIF orientation is not applied, because intrinsics are
those of the stored pixels. Images of 16 bits are scaled to bytes by the range of their folder's images, transparent
pixels become black; both are logged once per folder.
"""

from __future__ import annotations

from collections.abc import Iterable
from contextlib import redirect_stdout, suppress
from functools import lru_cache, partial
from io import BytesIO, StringIO
from pathlib import Path

import numpy as np
import torch
from PIL import ExifTags, Image

from ufmstar_torch.eval.sequences.frame import Entry, Frame, FrameError, Loader, Size, Skipped
from ufmstar_torch.eval.sequences.paths import list_files
from ufmstar_torch.files.limits import MOST_PIXELS, require_pixels
from ufmstar_torch.files.read import read_npy, read_npz
from ufmstar_torch.frames.warnings import LOGGER
from ufmstar_torch.runtime.optional import optional

# Errors of Pillow's plugins for broken files (SyntaxError: bad PNG chunk).
_BROKEN_IMAGE = (OSError, SyntaxError, ValueError, EOFError, Image.DecompressionBombError)
# Key of a PNG's text chunk: metres per unit of its 16-bit values.
SCALE_KEY = "depth_scale"
# Bit depth, colour type, compression, filter and interlacing, from a PNG's header.
_SIGNATURE, _RGB = b"\x89PNG\r\n\x1a\n", bytes((8, 2, 0, 0, 0))
_MILLIMETRE = 1e-3
# Largest values of images of 8, 10, 12, 14 and 16 bits, which are all stored in 16 bits.
_FULL_SCALES = (255, 1023, 4095, 16383, 65535)
_DEEP = ";16"  # in Pillow's name of the stored pixels of an image with 16 bits
_SCALE_SAMPLES = 8  # images of a folder that determine its scale
# Names of a depth channel of an EXR file, best first; Blender prefixes its layer ("ViewLayer.Depth.Z").
_DEPTH_NAMES = ("Z", "depth", "V", "Y", "R")


def read_color(path: str | Path, content: bytes | None = None) -> np.ndarray:
    """An image of a file, or of its ``content``, as [H, W, 3] uint8 RGB; grey is repeated. 16 bits are scaled by the
    range of the images in the folder (without a folder: of the image), and transparent colours are blended with black.
    Raises FrameError: missing, truncated, corrupt, or an image of floating-point or negative numbers."""
    try:
        if content is None and (plain := _plain_png(Path(path))) is not None:
            return plain
        with Image.open(path if content is None else BytesIO(content)) as image:
            require_pixels("the image", (image.height, image.width))
            if (values := _deep_values(path, image, content)) is not None:
                full = full_scale(values)
                if content is None:
                    full = _folder_scale(Path(path).parent, Path(path).suffix)
                return np.ascontiguousarray(np.broadcast_to(grey_bytes(values, full), (*values.shape[:2], 3)))
            if image.has_transparency_data:
                return _opaque(np.array(image.convert("RGBA")), Path(path).parent)
            if image.getexif().get(ExifTags.Base.Orientation, 1) != 1:
                _log_once(Path(path).parent, "EXIF turns the images; K and depth must be those of the stored pixels")
            return np.array(image.convert("RGB"))
    except _BROKEN_IMAGE as error:
        raise FrameError(path, f"cannot be decoded: {error}") from error


def full_scale(values: np.ndarray) -> int:
    """The largest value that a camera stores, by the bits of its largest value here: 8, 10, 12, 14 or 16."""
    highest = int(values.max(initial=0))
    return next((scale for scale in _FULL_SCALES if highest <= scale), _FULL_SCALES[-1])


def grey_bytes(values: np.ndarray, full: int) -> np.ndarray:
    """Integers from 0 to ``full`` as bytes from 0 to 255; larger ones become 255."""
    return np.asarray(np.rint(np.minimum(values, full) * np.float32(255 / full)), np.uint8)


def read_depth(
    path: str | Path,
    scale: float | None = None,
    key: str = "depth",
    *,
    default_scale: float = _MILLIMETRE,
    invalid: int | None = None,
) -> np.ndarray:
    """A depth map as [H, W] float32 [m], 0 = invalid, of a 16-bit PNG or TIFF, float TIFF, EXR, npy or npz (``key``, or
    its only array).

    Args:
        path: of the file.
        scale: metres per unit of the stored values. None = floats are metres, integers have the unit in a PNG's text
            ``depth_scale``, or else ``default_scale``.
        key: name of the depth in an npz with several arrays.
        default_scale: default metres per unit of integers.
        invalid: stored value of pixels without a depth, besides 0; None = none.

    Raises:
        FrameError: missing, truncated, corrupt, not a depth map (8-bit, several channels), or the file states another
            scale.
    """
    values, named_scale = read_map(path, key)
    require_scale(path, scale, named_scale)
    if invalid is not None:
        values = np.where(values == invalid, np.zeros((), values.dtype), values)
    if scale is None and np.issubdtype(values.dtype, np.integer):
        scale = named_scale or default_scale
    with np.errstate(over="ignore", invalid="ignore"):
        return positive(np.asarray(values if scale is None else values * np.float64(scale), np.float32))


def require_scale(path: str | Path, scale: float | None, stated: float | None) -> None:
    """Raises FrameError: a given ``scale`` contradicts the one that the file states [m per unit]."""
    if scale is not None and stated is not None and not np.isclose(scale, stated, rtol=1e-6, atol=0):
        unit = f"its text {SCALE_KEY} states {stated:g} metres per unit, which contradicts the given {scale:g}"
        raise FrameError(path, f"{unit}: leave that out")


def read_map(path: str | Path, key: str) -> tuple[np.ndarray, float | None]:
    """The stored one-channel map [H, W], and the metres per unit in a PNG's text (or None). ``key`` is the array's name
    in an npz with several arrays. Raises FrameError: as :func:`read_depth`."""
    path = Path(path)
    suffix = path.suffix.lower()
    scale = None
    try:
        if suffix == ".exr":
            values = _read_exr(path)
        elif suffix == ".npy":
            values = read_npy(path)
        elif suffix == ".npz":
            (values,) = read_npz(path, [key], or_single=True)
        else:
            values, scale = _from_image(path)
    except _BROKEN_IMAGE as error:
        raise FrameError(path, f"cannot be decoded: {error}") from error
    if values.ndim == 3 and 1 in (values.shape[0], values.shape[-1]):
        values = values[0] if values.shape[0] == 1 else values[..., 0]
    if values.ndim != 2 or not (np.issubdtype(values.dtype, np.number) and np.isrealobj(values)):
        raise FrameError(path, f"expected a map [H, W] of numbers, got {values.dtype} {list(values.shape)}")
    return values, scale


def image_tensor(frame: Frame) -> torch.Tensor:
    """The frame's image [1, 3, H, W] uint8 RGB, the input of a network's ``preprocess``. Raises FrameError: the frame
    has no image."""
    if frame.image is None:
        raise FrameError(frame.name, "no image")
    return torch.from_numpy(frame.image).permute(2, 0, 1)[None]


def image_size(path: str | Path) -> Size:
    """(H, W) from an image's header. Raises FrameError: the header cannot be read."""
    try:
        with Image.open(path) as image:
            require_pixels("the image", (image.height, image.width))
            return image.height, image.width
    except _BROKEN_IMAGE as error:
        raise FrameError(path, f"cannot be decoded: {error}") from error


def first_image_size(paths: Iterable[Path]) -> Size | None:
    """(H, W) of the first image whose header can be read, or None."""
    for path in paths:
        with suppress(FrameError):  # raised again, and counted, when that frame is read
            return image_size(path)
    return None


def first_depth_size(frames: Iterable[Entry | Skipped]) -> Size | None:
    """(H, W) of the first depth map that can be loaded, or None."""
    for frame in frames:
        if isinstance(frame, Entry) and frame.load_depth is not None:
            with suppress(FrameError):  # as above
                height, width = frame.load_depth().shape
                return height, width
    return None


def depth_loader(
    path: Path | None, scale: float | None, default_scale: float = _MILLIMETRE, invalid: int | None = None
) -> Loader | None:
    """The loader of a depth file for :class:`Entry`; None for None."""
    return None if path is None else partial(read_depth, path, scale, default_scale=default_scale, invalid=invalid)


def within(load: Loader, most: float) -> np.ndarray:
    """A depth map without the depths beyond ``most`` [m]."""
    depth = load()
    return np.where(depth <= most, depth, np.float32(0))


def positive(depth: np.ndarray) -> np.ndarray:
    """A depth map of float32 with 0 for values that are not finite or not positive."""
    return np.where(np.isfinite(depth) & (depth > 0), depth, np.float32(0))


def _plain_png(path: Path) -> np.ndarray | None:
    """The pixels of a PNG of 8-bit RGB; None for other or damaged files, which Pillow decodes or rejects."""
    if path.suffix.lower() != ".png" or not path.is_file():
        return None
    with path.open("rb") as file:
        header = file.read(29)
    width, height = int.from_bytes(header[16:20]), int.from_bytes(header[20:24])
    if header[:8] != _SIGNATURE or header[24:] != _RGB or width * height > MOST_PIXELS:
        return None
    from kornia_rs import io

    try:
        return np.asarray(io.read_image_png_u8(str(path), "rgb"))
    except UnicodeEncodeError:  # a name that is not UTF-8
        return None
    except Exception as error:
        # kornia_rs raises a plain Exception for a file that it cannot decode.
        if type(error) is not Exception:
            raise
        return None


def _deep_values(path: str | Path, image: Image.Image, content: bytes | None = None) -> np.ndarray | None:
    """[H, W, 1] or [H, W, 3] RGB, integers from 0 to 65535, of an opened image of more than 8 bits; None for 8 bits.
    Raises FrameError: other numbers."""
    if image.mode[0] in "IF":
        values = np.array(image)[..., None]
    elif any(_DEEP in str(tile[3]) for tile in getattr(image, "tile", ())):  # of colours, Pillow keeps high bytes
        import cv2

        image.load()  # raises for truncated files, while OpenCV returns partial images
        stored = np.frombuffer(Path(path).read_bytes() if content is None else content, np.uint8)
        decoded = cv2.imdecode(stored, cv2.IMREAD_UNCHANGED)
        values = np.zeros(0) if decoded is None else np.asarray(decoded)[..., 2::-1]
    else:
        return None
    if not np.issubdtype(values.dtype, np.integer) or values.min(initial=0) < 0 or values.max(initial=0) > 65535:
        raise FrameError(path, f"expected an image of 8 or 16 bits, got mode {image.mode}: a depth map?")
    return values


@lru_cache(maxsize=64)
def _folder_scale(folder: Path, suffix: str) -> int:
    """The scale of a folder's 16-bit images, by the largest value in some of them, so that all are equally bright."""
    files = list_files(folder, (suffix.lower(),))
    chosen = [files[i] for i in np.unique(np.linspace(0, len(files) - 1, min(_SCALE_SAMPLES, len(files))).astype(int))]
    scales = [_FULL_SCALES[0]]
    for file in chosen:
        with suppress(FrameError, *_BROKEN_IMAGE), Image.open(file) as image:
            if (values := _deep_values(file, image)) is not None:
                scales.append(full_scale(values))
    LOGGER.warning("%s: images of 16 bits, read as 0 to %d and scaled to bytes", folder, max(scales))
    return max(scales)


def _opaque(rgba: np.ndarray, folder: Path) -> np.ndarray:
    """[H, W, 3] colours of [H, W, 4], blended with black by their alpha. One alpha for all pixels has no meaning."""
    alpha = rgba[..., 3:]
    if (alpha == alpha[:1, :1]).all():
        return np.ascontiguousarray(rgba[..., :3])
    _log_once(folder, "images with transparent pixels, which are read as black")
    return np.asarray(np.rint(rgba[..., :3] * (alpha / np.float32(255))), np.uint8)


@lru_cache(maxsize=64)
def _log_once(folder: Path, text: str) -> None:
    LOGGER.warning("%s: %s", folder, text)


def _from_image(path: Path) -> tuple[np.ndarray, float | None]:
    with Image.open(path) as image:
        require_pixels("the map", (image.height, image.width))
        image.load()
        if image.mode[0] not in "IF":
            raise FrameError(path, f"expected a 16-bit or float depth image with one channel, got {image.mode}")
        text = image.info.get(SCALE_KEY)
        values = np.array(image)
    scale = None if text is None else float(text)
    if scale is not None and not 0 < scale < np.inf:
        raise FrameError(path, f"its text {SCALE_KEY} must be positive metres per unit, got {text}")
    return values, scale


def _read_exr(path: Path) -> np.ndarray:
    """The stored depth channel of an OpenEXR file as [H, W] float32: the only channel, or the first one named Z, depth,
    V, Y or R (after a layer prefix)."""
    OpenEXR = optional("OpenEXR", "EXR files need OpenEXR", "'ufmstar-torch[eval]'")
    try:
        with redirect_stdout(StringIO()):  # the library prints messages for damaged files
            for header in (part.header for part in OpenEXR.File(str(path), header_only=True).parts):
                (left, top), (right, bottom) = (np.asarray(corner).tolist() for corner in header["dataWindow"])
                require_pixels("the map", (bottom - top + 1, right - left + 1))
            parts = OpenEXR.File(str(path), separate_channels=True).parts
        if not parts:
            raise ValueError("no pixels can be decoded")
        channels = {name: channel for part in parts for name, channel in part.channels.items()}
        channel = channels[_depth_channel(list(channels))]
    except (RuntimeError, TypeError, ValueError) as error:
        raise FrameError(path, f"cannot be decoded as OpenEXR: {error}") from error
    pixels = channel.pixels
    if pixels.ndim != 2 or pixels.dtype == object or (channel.xSampling, channel.ySampling) != (1, 1):
        raise FrameError(path, "cannot be decoded as OpenEXR: the depth channel is deep or subsampled")
    return np.asarray(pixels, dtype=np.float32)


def _depth_channel(names: list[str]) -> str:
    if len(names) == 1:
        return names[0]
    for wanted in _DEPTH_NAMES:
        matching = [name for name in names if name.rsplit(".", 1)[-1].lower() == wanted.lower()]
        if len(matching) == 1:
            return matching[0]
    raise ValueError(f"no channel is the depth: expected one of {_DEPTH_NAMES}, got {names}")

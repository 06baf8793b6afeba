"""The preview video: image, depth, sigma and error side by side, on scales that stay the same throughout."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from functools import cache
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ufmstar_torch.eval.run.colours import FAINT, INK, colour_table, require_matplotlib
from ufmstar_torch.eval.run.panels import FramePanel, MapColumn

GAP, HEAD, FOOT, BAR = 4, 22, 36, 8  # pixels


def preview_frame(panel: FramePanel, columns: Sequence[MapColumn]) -> NDArray[np.uint8]:
    """[H, W, 3] uint8 RGB, H and W even: the image and maps side by side, 240 px high (less if wider than 16:9), with
    names, colour bars and units. Raises ImportError: Pillow or matplotlib is missing."""
    from PIL import Image, ImageDraw

    height, width = panel.shape
    cell_height = min(240, max(1, round(427 * height / width)))
    cell_width = max(1, round(cell_height * width / height))
    total = (1 + len(columns)) * (cell_width + GAP) - GAP
    canvas = Image.new("RGB", (total + total % 2, (HEAD + cell_height + FOOT + 1) // 2 * 2), "white")
    draw = ImageDraw.Draw(canvas)
    pictures = [panel.image, *(column.rgb(panel) for column in columns)]
    for number, picture in enumerate(pictures):
        left = number * (cell_width + GAP)
        if picture is not None:
            # Maps keep their pixels, since blending would invent colours between valid and invalid.
            kind = Image.Resampling.BILINEAR if number == 0 else Image.Resampling.NEAREST
            canvas.paste(Image.fromarray(picture).resize((cell_width, cell_height), kind), (left, HEAD))
        else:
            _text(draw, (left + cell_width // 2, HEAD + cell_height // 2), "no ground truth", FAINT, "mm")
    for number, column in enumerate(columns, start=1):
        _draw_bar(canvas, draw, number * (cell_width + GAP), cell_width, HEAD + cell_height, column)
    _text(draw, (4, HEAD // 2), panel.name, INK, "lm")
    _text(draw, (4, HEAD + cell_height + 11), panel.note, FAINT, "lm")
    return np.asarray(canvas)


def _draw_bar(canvas: Any, draw: Any, left: int, width: int, top: int, column: MapColumn) -> None:
    """Name above the cell; below it the colour bar with the values of its ends, beyond which colours do not change."""
    from PIL import Image

    _text(draw, (left + width // 2, HEAD // 2), f"{column.label} [m]", INK, "mm")
    table = colour_table(column.scale.colour_map)
    strip = table[np.linspace(0, 255, width).astype(np.intp)][None]
    canvas.paste(Image.fromarray(strip).resize((width, BAR)), (left, top + 4))
    scale = column.scale
    low = "0" if scale.low == 0 else f"≤ {scale.low:.2g}"
    _text(draw, (left + 1, top + BAR + 15), low, FAINT, "lm")
    _text(draw, (left + width - 1, top + BAR + 15), f"≥ {scale.high:.2g}", FAINT, "rm")


def _text(draw: Any, at: tuple[int, int], text: str, colour: str, anchor: str) -> None:
    draw.text(at, text, fill=colour, anchor=anchor, font=_font())


@cache
def _font() -> Any:
    """DejaVu Sans, which matplotlib brings: Pillow's own font has neither σ nor ≥."""
    from PIL import ImageFont

    return ImageFont.truetype(Path(require_matplotlib().get_data_path()) / "fonts/ttf/DejaVuSans.ttf", 12)


@contextmanager
def write_video(path: str | Path, fps: float) -> Iterator[Callable[[NDArray[np.uint8]], None]]:
    """Write an H.264 mp4 with imageio, ``fps`` frames per second; the value appends a frame [H, W, 3] uint8 RGB, H and
    W even and the same for all.

    The file (.mp4, in an existing folder) takes its name when the block ends, also by Ctrl-C or an error: it then holds
    the frames so far. Without a frame there is no file.

    Raises:
        ImportError: imageio or imageio-ffmpeg is missing; names the extra that brings it.
        ValueError: another ending, fps is not positive, or a frame of a wrong shape or type.
        OSError: ffmpeg stopped, on a full disk, say, or wrote no file.
    """
    path = Path(path)
    if path.suffix != ".mp4":
        raise ValueError(f"path must end in .mp4, got {path.name}")
    if not fps > 0:
        raise ValueError(f"fps must be positive, got {fps}")
    if find_spec("imageio_ffmpeg") is None:
        raise ImportError("a video needs imageio-ffmpeg: pip install 'ufmstar-torch[eval]'")
    import imageio.v2

    # ffmpeg goes by the ending, so it comes last here.
    temporary = path.with_name(f".{path.stem}.{os.getpid()}.tmp.mp4")
    # yuv420p is what browsers and slide programs play.
    how: dict[str, Any] = {"codec": "libx264", "pixelformat": "yuv420p", "macro_block_size": 2, "quality": 7}
    writer: Any = None
    size: tuple[int, ...] = ()

    def add(frame: NDArray[np.uint8]) -> None:
        nonlocal writer, size
        if frame.dtype != np.uint8 or frame.ndim != 3 or frame.shape[2] != 3 or any(n % 2 for n in frame.shape[:2]):
            raise ValueError(f"frame must be uint8 [H, W, 3] of even size, got {frame.dtype} {frame.shape}")
        if writer is None:
            writer = imageio.v2.get_writer(temporary, format="FFMPEG", fps=fps, ffmpeg_log_level="error", **how)
            size = frame.shape
        if frame.shape != size:
            raise ValueError(f"frame must have the size of the first, {size[1::-1]}, got {frame.shape[1::-1]}")
        writer.append_data(np.ascontiguousarray(frame))

    try:
        yield add
    finally:
        try:
            if writer is not None:
                writer.close()
                if not temporary.is_file() or temporary.stat().st_size == 0:
                    raise OSError(f"ffmpeg wrote no video for {path}")
                os.replace(temporary, path)
        finally:
            temporary.unlink(missing_ok=True)

"""The preview video: image, depth, sigma and error side by side, on scales that stay the same throughout."""

from __future__ import annotations

import os
from collections.abc import Sequence
from functools import cache
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ufmstar_torch.eval.report.colours import colour_table, require_matplotlib
from ufmstar_torch.eval.report.panels import FramePanel, MapColumn

GAP, HEAD, FOOT, BAR = 4, 22, 36, 8  # pixels
PAPER, INK, FAINT = (255, 255, 255), (26, 26, 26), (107, 107, 107)


def preview_frame(
    panel: FramePanel, columns: Sequence[MapColumn], *, cell_height: int | None = None
) -> NDArray[np.uint8]:
    """One video frame: the image and maps side by side, with names, colour bars and units.

    Args:
        panel: the frame.
        columns: the maps, fixed for the whole video: ``map_columns`` of a few frames, say.
        cell_height: height of each map [px], its width follows; None = 240, or less for maps wider than 16:9.

    Returns:
        [H, W, 3] uint8 RGB, H and W even.

    Raises:
        ImportError: Pillow or matplotlib is missing.
    """
    from PIL import Image, ImageDraw

    height, width = panel.depth.shape
    if cell_height is None:
        cell_height = min(240, max(1, round(427 * height / width)))
    cell_width = max(1, round(cell_height * width / height))
    total = (1 + len(columns)) * (cell_width + GAP) - GAP
    canvas = Image.new("RGB", (total + total % 2, (HEAD + cell_height + FOOT + 1) // 2 * 2), PAPER)
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


def _text(draw: Any, at: tuple[int, int], text: str, colour: tuple[int, int, int], anchor: str) -> None:
    draw.text(at, text, fill=colour, anchor=anchor, font=_font(12))


@cache
def _font(size: int) -> Any:
    """DejaVu Sans, which matplotlib brings: Pillow's own font has neither σ nor ≥."""
    from PIL import ImageFont

    return ImageFont.truetype(Path(require_matplotlib().get_data_path()) / "fonts/ttf/DejaVuSans.ttf", size)


class VideoWriter:
    """Writes an H.264 mp4 frame by frame with imageio; a context manager.

    The file appears under its name when the block ends, also when it ends by Ctrl-C or an error: it then
    holds the frames so far. Without a frame there is no file.

    Args:
        path: ends in .mp4; its folder must exist.
        fps: frames per second.

    Raises:
        ImportError: imageio or imageio-ffmpeg is missing; names the extra that brings it.
        ValueError: another ending, or fps is not positive.
    """

    def __init__(self, path: str | Path, fps: float) -> None:
        self.path = Path(path)
        if self.path.suffix != ".mp4":
            raise ValueError(f"path must end in .mp4, got {self.path.name}")
        if not fps > 0:
            raise ValueError(f"fps must be positive, got {fps}")
        if find_spec("imageio_ffmpeg") is None:
            raise ImportError("a video needs imageio-ffmpeg: pip install 'ufmstar-torch[eval]'")
        self.fps = fps
        self._size: tuple[int, ...] = ()
        self._writer: Any = None
        # ffmpeg goes by the ending, so it comes last here.
        self._temporary = self.path.with_name(f".{self.path.stem}.{os.getpid()}.tmp.mp4")

    def add(self, frame: NDArray[np.uint8]) -> None:
        """Append a frame [H, W, 3] uint8 RGB, H and W even and the same for all.

        Raises:
            ValueError: wrong shape or type.
            OSError: ffmpeg stopped, on a full disk, say.
        """
        if frame.dtype != np.uint8 or frame.ndim != 3 or frame.shape[2] != 3 or any(n % 2 for n in frame.shape[:2]):
            raise ValueError(f"frame must be uint8 [H, W, 3] of even size, got {frame.dtype} {frame.shape}")
        if self._writer is None:
            self._writer, self._size = self._open(), frame.shape
        if frame.shape != self._size:
            raise ValueError(f"frame must have the size of the first, {self._size[1::-1]}, got {frame.shape[1::-1]}")
        self._writer.append_data(np.ascontiguousarray(frame))

    def _open(self) -> Any:
        import imageio.v2

        return imageio.v2.get_writer(
            self._temporary,
            format="FFMPEG",
            fps=self.fps,
            codec="libx264",
            pixelformat="yuv420p",  # what browsers and slide programs play
            macro_block_size=2,
            quality=7,
            ffmpeg_log_level="error",
        )

    def close(self) -> None:
        """Finish the file.

        Raises:
            OSError: ffmpeg wrote no file.
        """
        if self._writer is None:
            return
        writer, self._writer = self._writer, None
        try:
            writer.close()
            if not self._temporary.is_file() or self._temporary.stat().st_size == 0:
                raise OSError(f"ffmpeg wrote no video for {self.path}")
            os.replace(self._temporary, self.path)
        finally:
            self._temporary.unlink(missing_ok=True)

    def __enter__(self) -> VideoWriter:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

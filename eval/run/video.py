"""The preview video: image, depth, sigma and error side by side, on scales that stay the same throughout."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ufmstar_torch.eval.run.panels import FramePanel, MapColumn

HEAD = 22  # [px] of the words above the pictures


def preview_frame(panel: FramePanel, columns: Sequence[MapColumn]) -> NDArray[np.uint8]:
    """[H, W, 3] uint8 RGB, H and W even: the image and maps side by side, 240 px high (less if wider than 16:9), with
    the names of the maps and the ends of their scales [m] above."""
    import cv2

    height, width = panel.shape
    cell_height = min(240, max(1, round(427 * height / width)))
    cell_width = max(1, round(cell_height * width / height))
    cells: list[NDArray[np.uint8]] = []
    for words, picture in [(panel.name, panel.image), *((_words(column), column.rgb(panel)) for column in columns)]:
        cell = np.full((HEAD + cell_height, cell_width, 3), 255, np.uint8)
        if picture is not None:
            # Maps keep their pixels, since blending would invent colours between valid and invalid.
            kind = cv2.INTER_NEAREST if cells else cv2.INTER_LINEAR
            cell[HEAD:] = cv2.resize(picture, (cell_width, cell_height), interpolation=kind)
        cv2.putText(cell, words, (2, HEAD - 7), cv2.FONT_HERSHEY_SIMPLEX, 0.4, (26, 26, 26), 1, cv2.LINE_AA)
        cells.append(cell)
    row = np.hstack(cells)
    return np.pad(row, [(0, row.shape[0] % 2), (0, row.shape[1] % 2), (0, 0)], constant_values=255)


def _words(column: MapColumn) -> str:
    """The name of a map and the ends of its scale, in letters that OpenCV draws."""
    return f"{column.field.replace('_', ' ')} {column.scale.low:.2g}-{column.scale.high:.2g} m"


@contextmanager
def write_video(path: Path, fps: float) -> Iterator[Callable[[NDArray[np.uint8]], None]]:
    """Write an H.264 mp4 with imageio, ``fps`` frames per second; the value appends a frame [H, W, 3] uint8 RGB, H and
    W even and the same for all.

    The file takes its name when the block ends, also by Ctrl-C or an error: it then holds the frames so far. Without a
    frame there is no file.

    Raises:
        ImportError: imageio or imageio-ffmpeg is missing; names the extra that brings it.
        OSError: ffmpeg stopped, on a full disk, say, or wrote no file.
    """
    if find_spec("imageio_ffmpeg") is None:
        raise ImportError("a video needs imageio-ffmpeg: pip install 'ufmstar-torch[eval]'")
    import imageio.v2

    # ffmpeg goes by the ending, so it comes last here.
    temporary = path.with_name(f".{path.stem}.{os.getpid()}.tmp.mp4")
    # yuv420p is what browsers and slide programs play.
    how: dict[str, Any] = {"codec": "libx264", "pixelformat": "yuv420p", "macro_block_size": 2, "quality": 7}
    writer = imageio.v2.get_writer(temporary, format="FFMPEG", fps=fps, ffmpeg_log_level="error", **how)
    count = 0

    def add(frame: NDArray[np.uint8]) -> None:
        nonlocal count
        writer.append_data(frame)
        count += 1

    try:
        yield add
    finally:
        try:
            writer.close()
            if count:
                if not temporary.is_file() or temporary.stat().st_size == 0:
                    raise OSError(f"ffmpeg wrote no video for {path}")
                os.replace(temporary, path)
        finally:
            temporary.unlink(missing_ok=True)

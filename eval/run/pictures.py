"""Pictures of a run: contact sheet and preview video.

A run's pictures are drawn from its finished frames on disk. Their scales therefore fit the whole run.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from ufmstar_torch.eval.engine.rows import RowResult
from ufmstar_torch.eval.run.colours import INVALID_GREY, known_where
from ufmstar_torch.eval.run.panels import FramePanel, MapColumn, contact_sheet, map_columns
from ufmstar_torch.eval.run.writers import frame_file, read_frame
from ufmstar_torch.eval.sequences.frame import Frame, FrameError, FrameSequence, Size
from ufmstar_torch.eval.sequences.ground_truth import resample_nearest, truth_at
from ufmstar_torch.eval.sequences.intrinsics import pinhole
from ufmstar_torch.gaussians.camera import resize_intrinsics

SHEET, VIDEO = "contact_sheet.png", "preview.mp4"
SHEET_ROWS, POSTERIOR_ROWS, SCALE_FRAMES = 6, 3, 12
# Rate of videos without timestamps, and range of rates with them.
DEFAULT_FPS, FPS_RANGE = 10.0, (2.0, 30.0)


@dataclass(frozen=True, eq=False)
class FinishedRun:
    """The finished frames of a run in the folder ``out``: their sequence, and their lines of frames.jsonl in order.
    ``with_error``: True if there is ground truth other than the prediction itself."""

    out: Path
    frames: FrameSequence
    records: Sequence[Mapping[str, Any]]
    with_error: bool

    def panel(self, number: int) -> FramePanel:
        """Finished frame ``number`` with square pixels, and its image cropped to the prediction's field of view."""
        record = self.records[number]
        stored = read_frame(frame_file(self.out, record["name"]))
        K, size = pinhole(*record["intrinsics"]), (record["size"][0], record["size"][1])
        K_square, size_square = square_pixels(K, size)
        try:
            frame: Frame | None = self.frames[record["index"]]
        except FrameError:  # the recording can no longer be read
            frame = None
        maps = {"depth": stored["depth"], "sigma": np.sqrt(stored["variance"]), "measured": stored["measured"]}
        note = f"{record['components']} components"
        if "anchored" in stored:
            note += f", {record['anchors']['used']} anchors"
        if "network_depth" in stored:
            maps["network_depth"], maps["ufm_sigma"] = stored["network_depth"], np.sqrt(stored["ufm_variance"])
        elif "anchored" in stored:
            maps["anchored"] = np.sqrt(stored["anchored"])
        truth = truth_at(frame, K, size) if self.with_error and frame is not None else None
        if truth is not None:
            pairs = {"error": "depth", "network_error": "network_depth"}
            maps |= {name: absolute_error(maps[of], truth) for name, of in pairs.items() if of in maps}
        valid, *square = (resample_nearest(m, K, K_square, size_square) for m in (stored["valid"], *maps.values()))
        shown = {name: known_where(valid, values) for name, values in zip(maps, square, strict=True)}
        image = None if frame is None or frame.image is None else field_of_view(frame.image, frame.intrinsics, K, size)
        if image is None:
            image = np.full((*size_square, 3), INVALID_GREY, np.uint8)
        return FramePanel(record["name"], image, shown, note)

    def spread(self, count: int) -> list[int]:
        """Numbers of at most ``count`` frames spread over the run, the first and the last included."""
        return sorted(set(np.linspace(0, len(self.records) - 1, count).round().astype(int).tolist()))

    def fps(self) -> float:
        """Frames per second of the recording, for the video."""
        times = [self.frames.entries[record["index"]].timestamp for record in self.records]
        stamps = np.array([time for time in times if time is not None])
        if len(stamps) < 2 or len(stamps) < len(times) or not np.median(np.diff(stamps)) > 0:
            return DEFAULT_FPS
        return float(np.clip(1 / np.median(np.diff(stamps)), *FPS_RANGE))


def panel_of(name: str, note: str, frame: Frame, row: RowResult) -> FramePanel:
    """The image of a frame and a row's maps: depth, sigma and, with ground truth, the absolute error."""
    assert frame.image is not None
    maps = {"depth": row.depth.float().numpy(), "sigma": row.out.std[0].float().numpy()}
    if row.truth is not None:
        maps["error"] = absolute_error(maps["depth"], row.truth)
    if (measured := row.map("measured")) is not None:
        maps["measured"] = measured.float().numpy()
    image = field_of_view(frame.image, frame.intrinsics, row.intrinsics, row.size)
    shown = {key: known_where(row.valid.numpy(), values) for key, values in maps.items()}
    return FramePanel(name, image, shown, note)


def common_columns(finished: FinishedRun) -> list[MapColumn]:
    """The maps of sheet and video, on scales that fit frames spread over the whole run."""
    return map_columns([finished.panel(number) for number in finished.spread(SCALE_FRAMES)])


def draw_sheet(finished: FinishedRun, columns: Sequence[MapColumn], title: str) -> None:
    """Write contact_sheet.png: frames spread over the run, the last one included. The first frame has no other view and
    is excluded unless it is the only one."""
    wide = "posterior" in finished.records[-1]
    numbers = finished.spread((POSTERIOR_ROWS if wide else SHEET_ROWS) + 1)
    panels = [finished.panel(number) for number in numbers[1:] or numbers]
    contact_sheet(panels, finished.out / SHEET, title=title, columns=columns)


def draw_video(finished: FinishedRun, columns: Sequence[MapColumn]) -> Iterator[int]:
    """Write preview.mp4 frame by frame. Yields the number of finished frames, so that the caller can report and
    stop."""
    with write_video(finished.out / VIDEO, finished.fps()) as add:
        for number in range(len(finished.records)):
            add(preview_frame(finished.panel(number), columns))
            yield number + 1


def square_pixels(K: NDArray, size: Size) -> tuple[NDArray, Size]:
    """K [3, 3] and (h, w) of the same view, enlarged to fx = fy. Networks with square inputs predict squeezed maps of
    wide images."""
    f = max(K[0, 0], K[1, 1])
    new = (round(size[0] * f / K[1, 1]), round(size[1] * f / K[0, 0]))
    return resize_intrinsics(torch.from_numpy(K), size, new).numpy(), new


def field_of_view(image: NDArray[np.uint8], K_image: NDArray, K: NDArray, size: Size) -> NDArray[np.uint8]:
    """The part of an image that a map with intrinsics K and size (h, w) shows."""
    corners = np.array([[-0.5, -0.5, 1.0], [size[1] - 0.5, size[0] - 0.5, 1.0]])
    (left, top), (right, bottom) = np.rint((corners @ (K_image @ np.linalg.inv(K)).T)[:, :2] + 0.5).astype(int)
    height, width = image.shape[:2]
    part = image[max(top, 0) : min(bottom, height), max(left, 0) : min(right, width)]
    return part if part.size else image


def absolute_error(depth: NDArray[Any], truth: NDArray[Any]) -> NDArray[np.float32]:
    """[h, w] |depth - truth| [m], NaN without ground truth (0)."""
    return known_where(truth > 0, np.abs(depth - truth))


HEAD = 22  # [px] height of the text above the pictures


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
            # Nearest neighbour for maps: blending would add colours between valid and invalid.
            kind = cv2.INTER_NEAREST if cells else cv2.INTER_LINEAR
            cell[HEAD:] = cv2.resize(picture, (cell_width, cell_height), interpolation=kind)
        cv2.putText(cell, words, (2, HEAD - 7), cv2.FONT_HERSHEY_SIMPLEX, 0.4, (26, 26, 26), 1, cv2.LINE_AA)
        cells.append(cell)
    row = np.hstack(cells)
    return np.pad(row, [(0, row.shape[0] % 2), (0, row.shape[1] % 2), (0, 0)], constant_values=255)


def _words(column: MapColumn) -> str:
    """The name of a map and the ends of its scale, in ASCII for OpenCV."""
    return f"{column.field.replace('_', ' ')} {column.scale.low:.2g}-{column.scale.high:.2g} m"


@contextmanager
def write_video(path: Path, fps: float) -> Iterator[Callable[[NDArray[np.uint8]], None]]:
    """Write an H.264 mp4 with ``fps`` frames per second. Yields a function that appends a frame [H, W, 3] uint8 RGB, H
    and W even and equal for all frames. When the block ends, also by Ctrl-C or an error, the file with the frames so
    far is renamed to ``path``; without a frame there is no file.

    Raises:
        ImportError: imageio or imageio-ffmpeg is missing; the message names the extra to install.
        OSError: ffmpeg stopped, as on a full disk, or wrote no file.
    """
    if find_spec("imageio_ffmpeg") is None:
        raise ImportError("a video needs imageio-ffmpeg: pip install 'ufmstar-torch[eval]'")
    import imageio.v2

    # ffmpeg chooses the format by the suffix, so the temporary name ends with it.
    temporary = path.with_name(f".{path.stem}.{os.getpid()}.tmp.mp4")
    # Browsers and slide programs play yuv420p.
    encoding: dict[str, Any] = {"codec": "libx264", "pixelformat": "yuv420p", "macro_block_size": 2, "quality": 7}
    writer = imageio.v2.get_writer(temporary, format="FFMPEG", fps=fps, ffmpeg_log_level="error", **encoding)
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

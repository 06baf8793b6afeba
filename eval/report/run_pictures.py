"""What a run leaves to look at: contact sheet, preview video, and the mixture for viewers.

The pictures are drawn from the finished frames on disk, so that their scales fit the whole run, and a run
that was stopped and continued gets the same ones.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ufmstar_torch.eval.gaussians import write_ellipsoids_ply, write_mixture_npz, write_mixture_ply
from ufmstar_torch.eval.report.colours import INVALID_GREY
from ufmstar_torch.eval.report.plots import FramePanel, PanelScales, contact_sheet, fit_scales
from ufmstar_torch.eval.report.video import VideoWriter, preview_frame
from ufmstar_torch.eval.results.writers import read_frame
from ufmstar_torch.eval.sequences import FrameSequence
from ufmstar_torch.eval.sequences.frame import Frame, FrameError, Size
from ufmstar_torch.eval.sequences.ground_truth import resample_nearest, truth_at
from ufmstar_torch.eval.sequences.intrinsics import pinhole
from ufmstar_torch.ufmstar import UfMStar

SHEET_ROWS, SCALE_FRAMES = 6, 12
# Without timestamps; and the range in which a recording's own rate is kept.
DEFAULT_FPS, FPS_RANGE = 10.0, (2.0, 30.0)


@dataclass(frozen=True, eq=False)
class Finished:
    """The finished frames of a run.

    Attributes:
        out: the run's folder.
        frames: the sequence.
        records: the frames' lines of frames.jsonl, in order.
        with_error: whether there is a ground truth that the prediction can differ from.
    """

    out: Path
    frames: FrameSequence
    records: Sequence[Mapping[str, Any]]
    with_error: bool

    def panel(self, number: int) -> FramePanel:
        """Finished frame ``number``, with square pixels, and the image cut to what the prediction shows."""
        record = self.records[number]
        stored = read_frame(self.out / "frames" / f"{record['name']}.npz")
        K, size = pinhole(*record["intrinsics"]), (record["size"][0], record["size"][1])
        K_square, size_square = square_pixels(K, size)
        frame = self._frame(record["index"])
        truth = truth_at(frame, K, size) if self.with_error and frame is not None else None
        maps = {"depth": stored["depth"], "sigma": np.sqrt(stored["variance"]), "valid": stored["valid"]}
        note = f"K = {record['components']}"
        if "anchored" in stored:
            maps["anchored"] = np.sqrt(stored["anchored"])
            note += f", {record['anchors']['used']} anchors"
        if truth is not None:
            maps["error"] = np.where(truth > 0, np.abs(stored["depth"] - truth), np.nan).astype(np.float32)
        shown = {name: resample_nearest(value, K, K_square, size_square) for name, value in maps.items()}
        image = None if frame is None or frame.image is None else field_of_view(frame.image, frame.intrinsics, K, size)
        if image is None:
            image = np.full((*size_square, 3), INVALID_GREY, np.uint8)
        return FramePanel(name=record["name"], image=image, note=note, **shown)

    def fps(self) -> float:
        """Frames per second of the recording, for the video."""
        times = [self.frames.entries[record["index"]].timestamp for record in self.records]
        known = np.array([time for time in times if time is not None])
        if len(known) < 2 or len(known) < len(times) or not np.median(np.diff(known)) > 0:
            return DEFAULT_FPS
        return float(np.clip(1 / np.median(np.diff(known)), *FPS_RANGE))

    def _frame(self, index: int) -> Frame | None:
        """The frame again, or None if it cannot be read any more."""
        try:
            return self.frames[index]
        except FrameError:
            return None


def draw_sheet(finished: Finished, scales: PanelScales, title: str) -> None:
    """Write contact_sheet.png: frames spread over the run, the last one included.

    The first is not: nothing has been compared by then, so its disagreement is 0.
    """
    count = len(finished.records)
    rows = sorted(set(np.linspace(0, count - 1, SHEET_ROWS + 1).round().astype(int)[1:].tolist()))
    contact_sheet([finished.panel(n) for n in rows], finished.out / "contact_sheet.png", title=title, scales=scales)


def draw_video(finished: Finished, scales: PanelScales) -> Iterator[int]:
    """Write preview.mp4 frame by frame; yields how many are done, so that the caller can report and stop."""
    with VideoWriter(finished.out / "preview.mp4", finished.fps()) as video:
        for number in range(len(finished.records)):
            video.add(preview_frame(finished.panel(number), scales, with_error=finished.with_error))
            yield number + 1


def common_scales(finished: Finished) -> PanelScales:
    """Colour scales for sheet and video, from frames spread over the whole run."""
    chosen = sorted(set(np.linspace(0, len(finished.records) - 1, SCALE_FRAMES).round().astype(int).tolist()))
    return fit_scales([finished.panel(number) for number in chosen])


def write_mixture(out: Path, ufm: UfMStar) -> None:
    """Write the mixture in world coordinates as splats and ellipsoids, and exactly as npz."""
    write_mixture_ply(out / "mixture.ply", ufm.mixture, T_world_first=ufm.T_world_first)
    write_ellipsoids_ply(out / "ellipsoids.ply", ufm.mixture, T_world_first=ufm.T_world_first)
    write_mixture_npz(out / "mixture.npz", ufm.mixture, T_world_first=ufm.T_world_first)


def square_pixels(K: NDArray, size: Size) -> tuple[NDArray, Size]:
    """K [3, 3] and (h, w) of the same view with fx = fy, not smaller than it is.

    Networks that take squares of a wide image predict maps that look squeezed.
    """
    f = max(K[0, 0], K[1, 1])
    new = (round(size[0] * f / K[1, 1]), round(size[1] * f / K[0, 0]))
    sx, sy = new[1] / size[1], new[0] / size[0]
    cx, cy = (K[0, 2] + 0.5) * sx - 0.5, (K[1, 2] + 0.5) * sy - 0.5
    return pinhole(K[0, 0] * sx, K[1, 1] * sy, cx, cy), new


def field_of_view(image: NDArray[np.uint8], K_image: NDArray, K: NDArray, size: Size) -> NDArray[np.uint8]:
    """The part of an image that a map with intrinsics K and size (h, w) shows, in the image's own pixels."""
    corners = np.array([[-0.5, -0.5, 1.0], [size[1] - 0.5, size[0] - 0.5, 1.0]])
    (left, top), (right, bottom) = np.rint((corners @ (K_image @ np.linalg.inv(K)).T)[:, :2] + 0.5).astype(int)
    height, width = image.shape[:2]
    part = image[max(top, 0) : min(bottom, height), max(left, 0) : min(right, width)]
    return part if part.size else image

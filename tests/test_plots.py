"""Pictures: colours that mean what the bar says, sheets and videos that can be read back."""

from __future__ import annotations

import errno
import os
import sys
from collections.abc import Iterable
from pathlib import Path
from typing import Any, NoReturn

import numpy as np
import pytest
from PIL import Image

from ufmstar_torch.eval.run.colours import (
    DEPTH_MAP,
    ERROR_MAP,
    INVALID_GREY,
    ColourScale,
    colour_table,
    robust_range,
)
from ufmstar_torch.eval.run.panels import FramePanel, contact_sheet, fit_scales, map_columns
from ufmstar_torch.eval.run.video import preview_frame, write_video


def panel(name: str = "a", *, error: bool = True, size: tuple[int, int] = (24, 32), seed: int = 0) -> FramePanel:
    rng = np.random.default_rng(seed)
    depth, sigma = rng.uniform(1, 4, size), rng.uniform(0, 0.5, size)
    depth[:4] = sigma[:4] = np.nan
    image = rng.integers(0, 255, (2 * size[0], 2 * size[1], 3), dtype=np.uint8)
    return FramePanel(name, image, {"depth": depth, "sigma": sigma} | ({"error": 2 * sigma} if error else {}))


def write(path: Path, frames: Iterable[np.ndarray[Any, Any]], fps: float = 5) -> None:
    with write_video(path, fps) as add:
        for frame in frames:
            add(frame)


def load(path: Path) -> np.ndarray[Any, Any]:
    with Image.open(path) as picture:
        return np.asarray(picture)


class TestColours:
    @pytest.mark.parametrize("name", [DEPTH_MAP, ERROR_MAP])
    def test_lightness_rises_evenly(self, name: str) -> None:
        """Perceptually uniform: CIELAB lightness rises all the way, in equal steps."""
        import cv2

        table = colour_table(name)
        lab = cv2.cvtColor(table[None].astype(np.float32) / 255, cv2.COLOR_RGB2LAB)[0]
        steps = np.diff(lab[::8, 0])
        assert steps.min() > 0
        assert steps.max() < 2 * steps.mean()

    def test_ends_and_beyond(self) -> None:
        scale, table = ColourScale(1.0, 3.0, DEPTH_MAP), colour_table(DEPTH_MAP)
        rgb = scale.rgb(np.array([1.0, 3.0, 0.0, 99.0, 2.0]))
        np.testing.assert_array_equal(rgb, table[[0, 255, 0, 255, 128]])

    def test_invalid_is_grey_and_no_colour_of_the_map_is(self) -> None:
        scale = ColourScale(0.0, 1.0, ERROR_MAP)
        rgb = scale.rgb(np.array([np.nan, np.inf, -np.inf]))
        assert (rgb == INVALID_GREY).all()
        for name in (DEPTH_MAP, ERROR_MAP):
            distance = np.abs(colour_table(name).astype(int) - INVALID_GREY).max(1)
            assert distance.min() > 40

    def test_robust_range(self) -> None:
        values = np.linspace(0.0, 100.0, 10_001)
        values[-5:] = 1e9
        assert robust_range([values], from_zero=False) == pytest.approx((1.0, 99.0))
        assert robust_range([values], from_zero=True)[0] == 0.0
        half = np.where(values < 50, values, np.nan)
        assert robust_range([half], from_zero=False)[1] == pytest.approx(49.5, abs=0.01)
        both = robust_range([np.array([1.0]), np.array([np.nan, 3.0])], from_zero=False)
        assert both == pytest.approx((1.02, 2.98))

    def test_ranges_without_extent(self) -> None:
        for maps in ([], [np.full(4, np.nan)], [np.zeros(4)], [np.full(4, 2.0)]):
            low, high = robust_range(maps, from_zero=False)
            assert low < high
        with pytest.raises(ValueError, match="low must be less"):
            ColourScale(1.0, 1.0, DEPTH_MAP)

    def test_missing_matplotlib_names_the_extra(self, monkeypatch: pytest.MonkeyPatch) -> None:
        monkeypatch.setitem(sys.modules, "matplotlib", None)
        with pytest.raises(ImportError, match=r"ufmstar-torch\[viz\]"):
            contact_sheet([panel()], "x.png")


class TestContactSheet:
    def test_columns_show_the_maps_on_common_scales(self, tmp_path: Path) -> None:
        panels = [panel("a", seed=1), panel("b", seed=2)]
        contact_sheet(panels, tmp_path / "s.png", title="t")
        scales = fit_scales(panels)
        picture = load(tmp_path / "s.png")[..., :3]
        # Every colour of both depth maps is in the picture, so both rows were drawn on the one scale.
        shown = {tuple(c) for c in picture.reshape(-1, 3).tolist()}
        for one in panels:
            expected = {tuple(c) for c in scales.depth.rgb(one.maps["depth"]).reshape(-1, 3).tolist()}
            assert len(expected & shown) > 0.95 * len(expected)

    def test_without_ground_truth_there_is_no_error_column(self, tmp_path: Path) -> None:
        contact_sheet([panel(error=False)], tmp_path / "without.png")
        contact_sheet([panel(error=False), panel("b")], tmp_path / "mixed.png")
        widths = [load(tmp_path / f"{n}.png").shape[1] for n in ("without", "mixed")]
        assert widths[1] / widths[0] == pytest.approx((1.2 + 4 * 2.4) / (1.2 + 3 * 2.4), abs=0.02)

    def test_sigma_and_error_share_a_scale(self, tmp_path: Path) -> None:
        one = panel()  # the error is twice sigma
        scales = fit_scales([one])
        assert scales.length.low == 0
        assert scales.length.high == pytest.approx(np.percentile(2 * one.maps["sigma"][4:], 99))
        labels = [(c.label, c.scale) for c in map_columns([one])]
        assert labels[1:] == [(name, scales.length) for name in ("σ", "|error|")]

    def test_frames_without_a_pixel_and_names_like_formulas(self, tmp_path: Path) -> None:
        import matplotlib

        before, loaded = dict(matplotlib.rcParams), "matplotlib.pyplot" in sys.modules
        empty = np.full((5, 6), np.nan)
        nothing = FramePanel("a$b$_{", np.zeros((5, 6, 3), np.uint8), dict.fromkeys(("depth", "sigma", "error"), empty))
        contact_sheet([nothing], tmp_path / "s.png", title=r"$\\x$ $")
        assert load(tmp_path / "s.png").shape[1] > 100
        assert dict(matplotlib.rcParams) == before
        assert ("matplotlib.pyplot" in sys.modules) == loaded

    def test_full_disk_keeps_the_old_sheet(self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        contact_sheet([panel()], tmp_path / "s.png")
        before = (tmp_path / "s.png").read_bytes()

        def full(*_: object) -> NoReturn:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

        monkeypatch.setattr(os, "replace", full)
        with pytest.raises(OSError, match="No space left"):
            contact_sheet([panel("b", seed=3)], tmp_path / "s.png")
        assert (tmp_path / "s.png").read_bytes() == before
        assert [p.name for p in tmp_path.iterdir()] == ["s.png"]

    def test_errors_name_the_argument(self) -> None:
        with pytest.raises(ValueError, match="at least one frame"):
            contact_sheet([], "x.png")
        depth = np.ones((2, 3))
        in_floats: Any = np.ones((2, 3, 3))
        with pytest.raises(ValueError, match="image must be uint8"):
            FramePanel("a", in_floats, {"depth": depth, "sigma": depth})
        with pytest.raises(ValueError, match="sigma must have the depth's shape"):
            FramePanel("a", np.ones((2, 3, 3), np.uint8), {"depth": depth, "sigma": np.ones((3, 3))})


class TestPreview:
    @pytest.mark.parametrize("size", [(24, 32), (15, 17), (16, 9), (1, 1)])
    def test_frame_is_even_and_holds_the_maps(self, size: tuple[int, int]) -> None:
        one = panel(size=size)
        frame = preview_frame(one, map_columns([one]))
        assert frame.dtype == np.uint8
        assert all(n % 2 == 0 for n in frame.shape[:2])
        step = 240 // size[0]
        left = step * size[1] + 4  # behind the image and a gap
        cell = frame[22 : 22 + 240 : step, left : left + step * size[1] : step]
        np.testing.assert_array_equal(cell, fit_scales([one]).depth.rgb(one.maps["depth"]))

    def test_size_does_not_depend_on_the_frame(self) -> None:
        columns, alone = map_columns([panel()]), map_columns([panel(error=False)])
        without = preview_frame(panel(error=False), columns)
        assert preview_frame(panel(), columns).shape == without.shape
        assert preview_frame(panel(error=False), alone).shape[1] < without.shape[1]

    def test_video_reads_back(self, tmp_path: Path) -> None:
        import cv2

        # Flat colours, which survive the codec: frame i is grey 40 i.
        frames = [np.full((48, 64, 3), 40 * i, np.uint8) for i in range(6)]
        write(tmp_path / "v.mp4", frames)
        video = cv2.VideoCapture(str(tmp_path / "v.mp4"))
        assert video.get(cv2.CAP_PROP_FPS) == pytest.approx(5)
        for i in range(6):
            ok, got = video.read()
            assert ok
            assert got.shape == (48, 64, 3)
            assert abs(float(got.mean()) - 40 * i) < 4
        assert not video.read()[0]
        video.release()
        assert [p.name for p in tmp_path.iterdir()] == ["v.mp4"]

    def test_interrupt_keeps_the_frames_so_far(self, tmp_path: Path) -> None:
        import cv2

        def interrupted() -> Any:
            yield from (np.zeros((32, 32, 3), np.uint8) for _ in range(3))
            raise KeyboardInterrupt

        with pytest.raises(KeyboardInterrupt):
            write(tmp_path / "v.mp4", interrupted())
        video = cv2.VideoCapture(str(tmp_path / "v.mp4"))
        assert video.get(cv2.CAP_PROP_FRAME_COUNT) == 3
        video.release()

    def test_no_frame_no_file(self, tmp_path: Path) -> None:
        write(tmp_path / "v.mp4", [])
        assert list(tmp_path.iterdir()) == []

    def test_errors(self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        with pytest.raises(ValueError, match="path must end in"):
            write(tmp_path / "v.avi", [])
        with pytest.raises(ValueError, match="fps"):
            write(tmp_path / "v.mp4", [], 0)
        with pytest.raises(ValueError, match="even size"):
            write(tmp_path / "v.mp4", [np.zeros((3, 4, 3), np.uint8)])
        frames = [np.zeros((32, 32, 3), np.uint8), np.zeros((32, 34, 3), np.uint8)]
        with pytest.raises(ValueError, match="size of the first"):
            write(tmp_path / "v.mp4", frames)
        monkeypatch.setitem(sys.modules, "imageio_ffmpeg", None)
        with pytest.raises(ImportError, match=r"ufmstar-torch\[eval\]"):
            write(tmp_path / "v.mp4", [])

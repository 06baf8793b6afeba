"""Pictures: colours that agree with the colour bar; sheets and videos that can be read back."""

from __future__ import annotations

import sys
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from ufmstar_torch.eval.run.colours import (
    DEPTH_MAP,
    ERROR_MAP,
    INVALID_GREY,
    ColourScale,
    colour_table,
)
from ufmstar_torch.eval.run.panels import FramePanel, contact_sheet, map_columns
from ufmstar_torch.eval.run.pictures import preview_frame, write_video


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


class TestContactSheet:
    def test_columns_show_the_maps_on_common_scales(self, tmp_path: Path) -> None:
        panels = [panel("a", seed=1), panel("b", seed=2)]
        contact_sheet(panels, tmp_path / "s.png", title="t")
        depth = map_columns(panels)[0].scale
        picture = load(tmp_path / "s.png")[..., :3]
        # Every colour of both depth maps is in the picture, so both rows have one scale.
        shown = {tuple(c) for c in picture.reshape(-1, 3).tolist()}
        for one in panels:
            expected = {tuple(c) for c in depth.rgb(one.maps["depth"]).reshape(-1, 3).tolist()}
            assert len(expected & shown) > 0.95 * len(expected)

    def test_sigma_and_error_share_a_scale(self) -> None:
        one = panel()  # the error is twice sigma
        sigma, error = (column.scale for column in map_columns([one])[1:])
        assert sigma == error
        assert sigma.high == pytest.approx(np.percentile(2 * one.maps["sigma"][4:], 99))

    def test_a_small_sigma_of_the_posterior_is_not_black_beside_the_networks_errors(self) -> None:
        one = panel()
        small = {name: one.maps[name] / 10 for name in ("sigma", "error")}
        before = {
            "network_depth": one.maps["depth"],
            "ufm_sigma": one.maps["sigma"],
            "network_error": one.maps["error"],
        }
        both = FramePanel("a", one.image, {**one.maps, **before, **small})
        columns = {c.field: c for c in map_columns([both])}
        assert columns["sigma"].scale == columns["error"].scale == columns["ufm_sigma"].scale
        ends = [columns[name].rgb(both)[-1, -1].astype(int).sum() for name in ("sigma", "ufm_sigma")]
        assert 100 < ends[0] < ends[1]

    def test_equal_factors_are_equal_steps_of_a_logarithmic_scale(self) -> None:
        scale, table = ColourScale(0.01, 1.0, ERROR_MAP, logarithmic=True), colour_table(ERROR_MAP)
        values = np.array([0.0, 0.01, 0.1, 1.0, 3.0])
        np.testing.assert_array_equal(scale.rgb(values), table[[0, 0, 128, 255, 255]])

    def test_frames_without_a_pixel_and_names_like_formulas(self, tmp_path: Path) -> None:
        import matplotlib

        before, loaded = dict(matplotlib.rcParams), "matplotlib.pyplot" in sys.modules
        empty = np.full((5, 6), np.nan)
        nothing = FramePanel("a$b$_{", np.zeros((5, 6, 3), np.uint8), dict.fromkeys(("depth", "sigma", "error"), empty))
        contact_sheet([nothing], tmp_path / "s.png", title=r"$\\x$ $")
        assert load(tmp_path / "s.png").shape[1] > 100
        assert dict(matplotlib.rcParams) == before
        assert ("matplotlib.pyplot" in sys.modules) == loaded


class TestPreview:
    @pytest.mark.parametrize("size", [(24, 32), (15, 17), (16, 9), (1, 1)])
    def test_frame_is_even_and_holds_the_maps(self, size: tuple[int, int]) -> None:
        one = panel(size=size)
        frame = preview_frame(one, map_columns([one]))
        assert frame.dtype == np.uint8
        assert all(n % 2 == 0 for n in frame.shape[:2])
        step = 240 // size[0]
        left = step * size[1]
        cell = frame[22 : 22 + 240 : step, left : left + step * size[1] : step]
        np.testing.assert_array_equal(cell, map_columns([one])[0].scale.rgb(one.maps["depth"]))

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

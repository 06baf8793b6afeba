"""Frames on disk: exact round trips, honest scales, and nothing half-written when the disk is full."""

from __future__ import annotations

import errno
import io
import json
import math
import os
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NoReturn

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from PIL import Image

from ufmstar_torch.eval.run import files
from ufmstar_torch.eval.run.files import to_json, write_atomic, write_json_atomic
from ufmstar_torch.eval.run.writers import (
    FULL,
    FrameWriter,
    encode_length_png,
    fitting_unit,
    read_frame,
)
from ufmstar_torch.eval.sequences.images import read_depth, read_map


def frame(seed: int = 0, far: float = 8.0) -> dict[str, torch.Tensor]:
    rng = np.random.default_rng(seed)
    depth = torch.tensor(rng.uniform(0.2, far, (12, 17)), dtype=torch.float32)
    variance = torch.tensor(rng.uniform(0, 0.5, (12, 17)), dtype=torch.float32)
    valid = torch.tensor(rng.random((12, 17)) > 0.2)
    return {"depth": depth, "variance": variance, "disagreement": 0.5 * variance, "valid": valid}


def tree(folder: Path) -> dict[str, bytes]:
    return {str(p.relative_to(folder)): p.read_bytes() for p in sorted(folder.rglob("*")) if p.is_file()}


def write_length_png(path: Path, values: np.ndarray, valid: np.ndarray, unit: float, quantity: str = "depth") -> int:
    content, saturated = encode_length_png(values, valid, unit, quantity=quantity)
    path.write_bytes(content)
    return saturated


def full_disk(*_: object, **__: object) -> NoReturn:
    raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))


class TestPng:
    @settings(max_examples=30)
    @given(st.lists(st.floats(0.001, 65.535), min_size=1, max_size=40))
    def test_within_half_a_unit(self, values: list[float]) -> None:
        from tempfile import TemporaryDirectory

        with TemporaryDirectory() as folder:
            path = Path(folder) / "d.png"
            array = np.array([values])
            assert write_length_png(path, array, np.ones_like(array, bool), 0.001) == 0
            got = read_depth(path)
            assert (got > 0).all()
            # Half a unit, and float32's rounding of the result (4e-6 m at 65 m).
            assert np.abs(got - array).max() <= 0.0005 + 4e-6

    def test_counts_and_scale_are_exact(self, tmp_path: Path) -> None:
        counts = np.array([[1, 2, 32767, 32768, 65535]])
        write_length_png(tmp_path / "d.png", counts / 256, counts > 0, 1 / 256)
        with Image.open(tmp_path / "d.png") as image:
            stored = np.asarray(image)
            assert image.info["depth_scale"] == "0.00390625"
            assert image.info["unit"] == "metres per count"
            assert image.info["quantity"] == "depth"
        np.testing.assert_array_equal(stored, counts)
        np.testing.assert_array_equal(read_depth(tmp_path / "d.png"), (counts / 256).astype(np.float32))

    def test_opencv_reads_the_same_counts(self, tmp_path: Path) -> None:
        import cv2

        values = np.linspace(0.5, 60, 300).reshape(15, 20)
        write_length_png(tmp_path / "d.png", values, values > 0, 0.001)
        counts = cv2.imread(str(tmp_path / "d.png"), cv2.IMREAD_UNCHANGED)
        assert counts.dtype == np.uint16
        np.testing.assert_array_equal(counts, np.rint(values * 1000))

    def test_saturation_is_counted_and_does_not_wrap(self, tmp_path: Path) -> None:
        values = np.array([[65.535, 65.536, 70.0, 1e9, 65.5354]])
        assert write_length_png(tmp_path / "d.png", values, values > 0, 0.001) == 3
        np.testing.assert_array_equal(read_depth(tmp_path / "d.png"), np.float32(65.535))
        with Image.open(tmp_path / "d.png") as image:
            assert image.info["saturated"] == "3"

    def test_zero_means_invalid_only(self, tmp_path: Path) -> None:
        values = np.array([[0.0, 1e-7, 2.0, np.nan, np.inf, -1.0, 3.0]])
        usable = np.array([[True, True, True, True, True, True, False]])
        write_length_png(tmp_path / "s.png", values, usable, 1e-4, quantity="sigma")
        got = read_depth(tmp_path / "s.png")
        assert (got > 0).tolist() == [[True, True, True, False, False, False, False]]
        np.testing.assert_array_equal(got[0, :3], np.float32([1e-4, 1e-4, 2.0]))

    def test_fitting_unit(self) -> None:
        assert fitting_unit(np.array([3.0, 8.0])) == 0.001
        assert fitting_unit(np.array([100.0] * 9)) == 1 / 256
        assert fitting_unit(np.array([300.0] * 9)) == 0.01
        assert fitting_unit(np.array([1e6] * 9)) == 0.1
        assert fitting_unit(np.array([])) == 0.001
        sky = np.full(1000, 10.0)
        sky[:5] = 10_000.0
        assert fitting_unit(sky) == 0.001


class TestFrames:
    def test_round_trip(self, tmp_path: Path) -> None:
        maps = frame()
        written = FrameWriter(tmp_path).write("1305031102.175304", **maps)
        assert written == {"depth": 0, "sigma": 0}
        back = read_frame(tmp_path / "frames" / "1305031102.175304.npz")
        for name, value in maps.items():
            np.testing.assert_array_equal(back[name], value.numpy())
            assert back[name].dtype == value.numpy().dtype
        depth, sigma = (read_depth(tmp_path / kind / "1305031102.175304.png") for kind in ("depth", "sigma"))
        valid = depth > 0
        np.testing.assert_array_equal(valid, maps["valid"])
        np.testing.assert_array_equal(sigma > 0, maps["valid"])
        assert np.abs(depth - maps["depth"].numpy())[valid].max() <= 0.0005 + 1e-6
        assert np.abs(sigma - maps["variance"].sqrt().numpy())[valid].max() <= 0.00005 + 1e-7
        assert (depth[~valid] == 0).all()

    def test_one_scale_for_the_whole_run_and_its_continuation(self, tmp_path: Path) -> None:
        writer = FrameWriter(tmp_path)
        writer.write("a", **frame(far=100.0))
        lost = writer.write("b", **frame(far=2.0))
        assert lost["depth"] == 0
        FrameWriter(tmp_path, writer.unit).write("c", **frame(far=2.0))
        for kind, unit in (("depth", 1 / 256), ("sigma", 1 / 2560)):
            assert [read_map(tmp_path / kind / f"{n}.png", "depth")[1] for n in "abc"] == [unit] * 3

    def test_saturation_is_reported(self, tmp_path: Path) -> None:
        writer, maps = FrameWriter(tmp_path), frame(far=100.0)
        writer.write("near", **frame(far=8.0))
        maps |= {"valid": torch.ones_like(maps["valid"]), "variance": 200 * maps["variance"]}
        lost = writer.write("far", **maps)
        assert lost["depth"] == int((maps["depth"].double() > (FULL + 0.5) * 1e-3).sum()) > 0
        sigma = maps["variance"].double().sqrt()
        assert lost["sigma"] == int((sigma > (FULL + 0.5) * 1e-4).sum()) > 0

    def test_finished_needs_every_file(self, tmp_path: Path) -> None:
        writer = FrameWriter(tmp_path)
        assert not writer.finished("a")
        for kind in ("depth", "sigma", "frames"):
            writer.write("a", **frame())
            assert writer.finished("a")
            writer.paths("a")[kind].unlink()
            assert not writer.finished("a")

    @pytest.mark.parametrize("name", ["", "../a", "a/b", ".hidden", "a\\b"])
    def test_names_stay_in_the_folder(self, tmp_path: Path, name: str) -> None:
        with pytest.raises(ValueError, match="plain file name"):
            FrameWriter(tmp_path).write(name, **frame())

    def test_errors_name_the_argument(self, tmp_path: Path) -> None:
        writer, maps = FrameWriter(tmp_path), frame()
        with pytest.raises(ValueError, match="variance must have the depth's shape"):
            writer.write("a", **{**maps, "variance": maps["variance"][:3]})
        with pytest.raises(ValueError, match="depth must be a floating-point map"):
            writer.write("a", **{**maps, "depth": maps["depth"][None]})
        with pytest.raises(ValueError, match="valid must be a bool"):
            writer.write("a", **{**maps, "valid": maps["valid"].float()})
        assert tree(tmp_path) == {}


class TestFullDisk:
    @pytest.mark.parametrize("survives", [0, 1, 2])
    def test_replace_fails_in_the_middle_of_a_frame(
        self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, survives: int
    ) -> None:
        writer = FrameWriter(tmp_path)
        writer.write("a", **frame(0))
        write_json_atomic(tmp_path / "summary.json", {"frames": 1})
        before, calls, replace = tree(tmp_path), [0], os.replace

        def replace_until_full(source: Path, target: Path) -> None:
            calls[0] += 1
            if calls[0] > survives:
                full_disk()
            replace(source, target)

        with monkeypatch.context() as patch:
            patch.setattr(files.os, "replace", replace_until_full)
            with pytest.raises(OSError, match="No space left"):
                writer.write("b", **frame(1))
            with pytest.raises(OSError, match="No space left"):
                write_json_atomic(tmp_path / "summary.json", {"frames": 2})
        after = tree(tmp_path)
        assert {name: after[name] for name in before} == before
        assert not writer.finished("b")
        assert writer.finished("a")
        assert not [name for name in after if name.endswith(".tmp")]
        assert json.loads(after["summary.json"]) == {"frames": 1}
        writer.write("b", **frame(1))  # space again: the run goes on
        assert writer.finished("b")

    def test_write_fails_in_the_middle_of_a_file(self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        writer = FrameWriter(tmp_path)
        writer.write("a", **frame(0))
        before = tree(tmp_path)

        class TinyDisk(io.FileIO):
            def write(self, data: Any) -> int:
                if self.tell() + len(data) > 300:
                    super().write(bytes(data)[:100])
                    full_disk()
                return super().write(data)

        with monkeypatch.context() as patch:
            patch.setattr(files, "open", TinyDisk, raising=False)
            for _ in range(2):  # overwriting a finished frame, then a new one
                with pytest.raises(OSError, match="No space left"):
                    writer.write("a", **frame(1))
                with pytest.raises(OSError, match="No space left"):
                    writer.write("b", **frame(1))
        assert tree(tmp_path) == before

    def test_interrupt_leaves_no_rubbish(self, tmp_path: Path) -> None:
        path = tmp_path / "x"
        path.write_text("old")

        def interrupted(file: Any) -> None:
            file.write(b"half")
            raise KeyboardInterrupt

        with pytest.raises(KeyboardInterrupt):
            write_atomic(path, interrupted)
        assert tree(tmp_path) == {"x": b"old"}

    def test_a_pipe_is_written_to_and_a_link_leads_to_the_new_file(self, tmp_path: Path) -> None:
        pipe, path, link = tmp_path / "pipe", tmp_path / "x", tmp_path / "link"
        os.mkfifo(pipe)
        path.write_text("old")
        link.symlink_to(path)
        with ThreadPoolExecutor(1) as pool:
            received = pool.submit(pipe.read_bytes)
            for target in (pipe, link):
                write_json_atomic(target, {"ms": 1})
            assert received.result(10) == path.read_bytes() == b'{\n  "ms": 1\n}\n'
        assert pipe.is_fifo()
        assert link.is_symlink()
        assert {file.name for file in tmp_path.iterdir()} == {"pipe", "x", "link"}


@dataclass
class Settings:
    eta: float
    paths: tuple[Path, ...]


class TestJson:
    def test_everything_a_summary_holds(self, tmp_path: Path) -> None:
        data = {
            "nll": math.nan,
            "curve": np.array([1.0, np.inf]),
            "frames": np.int64(3),
            "k": torch.tensor([1, 2]),
            "m": torch.tensor(0.5),
            "settings": Settings(0.5, (Path("a"),)),
            "none": None,
            "ok": np.bool_(True),
        }
        write_json_atomic(tmp_path / "s.json", data)

        def forbid(constant: str) -> NoReturn:
            raise AssertionError(constant)

        text = (tmp_path / "s.json").read_text()
        assert json.loads(text, parse_constant=forbid) == {
            "nll": None,
            "curve": [1.0, None],
            "frames": 3,
            "k": [1, 2],
            "m": 0.5,
            "settings": {"eta": 0.5, "paths": ["a"]},
            "none": None,
            "ok": True,
        }

    def test_unknown_value_is_named_and_the_old_file_stays(self, tmp_path: Path) -> None:
        write_json_atomic(tmp_path / "s.json", {"a": 1})
        with pytest.raises(TypeError, match=r"data\.b\[1\] must have a JSON form.*object"):
            write_json_atomic(tmp_path / "s.json", {"b": [1, object()]})
        assert json.loads((tmp_path / "s.json").read_text()) == {"a": 1}
        assert to_json({1: (1, 2)}) == {"1": [1, 2]}

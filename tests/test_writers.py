"""Frames on disk: exact round trips, one scale per run, and no partial file when the disk is full."""

from __future__ import annotations

import errno
import json
import math
import os
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image
from runs import read_summary

from ufmstar_torch.eval.engine.files import to_json, write_atomic, write_json_atomic
from ufmstar_torch.eval.run.writers import encode_length_png, frame_file, read_frame, write_frame
from ufmstar_torch.eval.sequences.images import read_depth


def frame(seed=0, far=8.0):
    rng = np.random.default_rng(seed)
    depth, variance = (rng.uniform(low, high, (12, 17)).astype(np.float32) for low, high in ((0.2, far), (0, 0.5)))
    pose = {"T_world_cam": np.eye(4), "intrinsics": np.eye(3)}
    valid = rng.random((12, 17)) > 0.2
    return {"depth": depth, "variance": variance, "disagreement": variance / 2, "valid": valid, **pose}


def tree(folder):
    return {str(p.relative_to(folder)): p.read_bytes() for p in sorted(folder.rglob("*")) if p.is_file()}


def write_png(path, values, unit):
    path.write_bytes(encode_length_png(values, unit, "depth"))


def write(folder, name, maps):
    file = frame_file(folder, name)
    file.parent.mkdir(exist_ok=True)
    write_frame(file, maps)


# ---- PNGs ----


def test_counts_and_scale_are_exact(tmp_path):
    import cv2

    counts = np.array([[1, 2, 32767, 32768, 65535]])
    write_png(tmp_path / "d.png", counts / 256, 1 / 256)
    with Image.open(tmp_path / "d.png") as image:
        np.testing.assert_array_equal(np.asarray(image), counts)
        assert image.info == {
            "depth_scale": "0.00390625", "unit": "metres per count", "quantity": "depth", "invalid": "0",
            "saturated": "0",
        }  # fmt: skip
    np.testing.assert_array_equal(read_depth(tmp_path / "d.png"), (counts / 256).astype(np.float32))
    stored = cv2.imread(str(tmp_path / "d.png"), cv2.IMREAD_UNCHANGED)
    assert stored.dtype == np.uint16
    np.testing.assert_array_equal(stored, counts)


def test_zero_means_invalid_only(tmp_path):
    values = np.array([[0.0, 1e-7, 2.0, np.nan, np.inf, -1.0, 3.0]])
    write_png(tmp_path / "s.png", values, 1e-4)
    got = read_depth(tmp_path / "s.png")
    assert (got > 0).tolist() == [[True, True, True, False, False, False, True]]
    np.testing.assert_array_equal(got[0, :3], np.float32([1e-4, 1e-4, 2.0]))


# ---- frames ----


def test_round_trip(tmp_path):
    maps = frame()
    write(tmp_path, "1305031102.175304", maps)
    back = read_frame(tmp_path / "frames" / "1305031102.175304.npz")
    for name, value in maps.items():
        np.testing.assert_array_equal(back[name], value)
        assert back[name].dtype == value.dtype


@pytest.mark.parametrize("name", ["", "../a", "a/b", ".hidden", "a\\b"])
def test_refusals(tmp_path, name):
    with pytest.raises(ValueError, match="plain file name"):
        write(tmp_path, name, frame())
    assert tree(tmp_path) == {}


# ---- a full disk ----


def test_an_interrupt_leaves_no_partial_file(tmp_path):
    (tmp_path / "x").write_text("old")

    def interrupted(file):
        file.write(b"half")
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        write_atomic(tmp_path / "x", interrupted)
    assert tree(tmp_path) == {"x": b"old"}


def test_a_pipe_is_written_to_and_a_link_leads_to_the_new_file(tmp_path):
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


# ---- JSON ----


@dataclass
class Settings:
    eta: float
    paths: tuple[Path, ...]


def test_everything_a_summary_holds(tmp_path):
    data = {
        "nll": math.nan,
        "curve": np.array([1.0, np.inf]),
        "frames": np.int64(3),
        "k": torch.tensor([1, 2]),
        "settings": Settings(0.5, (Path("a"),)),
        "none": None,
        "ok": np.bool_(True),
    }
    write_json_atomic(tmp_path / "summary.json", data)
    plain = {"nll": None, "curve": [1.0, None], "frames": 3, "k": [1, 2], "settings": {"eta": 0.5, "paths": ["a"]}}
    assert read_summary(tmp_path) == {**plain, "none": None, "ok": True}
    with pytest.raises(TypeError, match=r"data\.b\[1\] must have a JSON form.*object"):
        write_json_atomic(tmp_path / "summary.json", {"b": [1, object()]})
    assert json.loads((tmp_path / "summary.json").read_text())["frames"] == 3
    assert to_json({1: (1, 2)}) == {"1": [1, 2]}


@pytest.mark.parametrize(
    "error", [OSError(errno.ENOSPC, "No space left on device"), OSError("9 requested and 4 written")]
)
def test_a_full_disk_is_reported_with_the_file(tmp_path, error):
    """NumPy's error has no errno, and neither error has a file name."""

    def write(file):
        file.write(b"begun")
        raise error

    with pytest.raises(OSError, match=rf"({error.strerror or error}): .*maps\.npy"):
        write_atomic(tmp_path / "maps.npy", write)
    assert not list(tmp_path.iterdir())

"""Frames on disk: exact round trips, one scale per run, and no partial file when the disk is full."""

from __future__ import annotations

import errno
import io
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

from ufmstar_torch import atomic
from ufmstar_torch.eval.run.files import to_json, write_atomic, write_json_atomic
from ufmstar_torch.eval.run.writers import FULL, FrameWriter, encode_length_png, read_frame
from ufmstar_torch.eval.sequences.images import read_depth, read_map


def frame(seed=0, far=8.0):
    rng = np.random.default_rng(seed)
    depth = torch.tensor(rng.uniform(0.2, far, (12, 17)), dtype=torch.float32)
    variance = torch.tensor(rng.uniform(0, 0.5, (12, 17)), dtype=torch.float32)
    valid = torch.tensor(rng.random((12, 17)) > 0.2)
    return {"depth": depth, "variance": variance, "disagreement": 0.5 * variance, "valid": valid}


def tree(folder):
    return {str(p.relative_to(folder)): p.read_bytes() for p in sorted(folder.rglob("*")) if p.is_file()}


def write_png(path, values, unit, valid=None, quantity="depth"):
    content, saturated = encode_length_png(values, values > 0 if valid is None else valid, unit, quantity=quantity)
    path.write_bytes(content)
    return saturated


def full_disk(*_, **__):
    raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))


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
    write_png(tmp_path / "s.png", values, 1e-4, np.arange(7)[None] < 6, "sigma")
    got = read_depth(tmp_path / "s.png")
    assert (got > 0).tolist() == [[True, True, True, False, False, False, False]]
    np.testing.assert_array_equal(got[0, :3], np.float32([1e-4, 1e-4, 2.0]))


# ---- frames ----


def test_round_trip(tmp_path):
    maps = frame()
    writer = FrameWriter(tmp_path)
    assert writer.write("1305031102.175304", **maps) == {"depth": 0, "sigma": 0}
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
    for path in writer.paths("1305031102.175304").values():
        assert writer.finished("1305031102.175304")
        path.rename(tmp_path / "away")
        assert not writer.finished("1305031102.175304")
        (tmp_path / "away").rename(path)


def test_one_scale_for_the_whole_run_and_its_continuation(tmp_path):
    writer = FrameWriter(tmp_path)
    writer.write("a", **frame(far=100.0))
    assert writer.write("b", **frame(far=2.0))["depth"] == 0
    FrameWriter(tmp_path, writer.unit).write("c", **frame(far=2.0))
    for kind, unit in (("depth", 1 / 256), ("sigma", 1 / 2560)):
        assert [read_map(tmp_path / kind / f"{n}.png", "depth")[1] for n in "abc"] == [unit] * 3
    near, maps = FrameWriter(tmp_path), frame(far=100.0)
    near.write("near", **frame(far=8.0))
    maps |= {"valid": torch.ones_like(maps["valid"]), "variance": 200 * maps["variance"]}
    lost = near.write("far", **maps)
    assert lost["depth"] == int((maps["depth"].double() > (FULL + 0.5) * 1e-3).sum()) > 0
    assert lost["sigma"] == int((maps["variance"].double().sqrt() > (FULL + 0.5) * 1e-4).sum()) > 0


@pytest.mark.parametrize(
    ("name", "change", "reason"),
    [
        *((name, {}, "plain file name") for name in ("", "../a", "a/b", ".hidden", "a\\b")),
        ("a", {"variance": torch.ones(3, 17)}, "variance must have the depth's shape"),
        ("a", {"depth": torch.ones(1, 12, 17)}, "depth must be a floating-point map"),
        ("a", {"valid": torch.ones(12, 17)}, "valid must be a bool"),
    ],
)
def test_refusals(tmp_path, name, change, reason):
    with pytest.raises(ValueError, match=reason):
        FrameWriter(tmp_path).write(name, **{**frame(), **change})
    assert tree(tmp_path) == {}


# ---- a full disk ----


@pytest.mark.parametrize("survives", [0, 1, 2])
def test_replace_fails_in_the_middle_of_a_frame(tmp_path, monkeypatch, survives):
    writer = FrameWriter(tmp_path)
    writer.write("a", **frame(0))
    write_json_atomic(tmp_path / "summary.json", {"frames": 1})
    before, calls, replace = tree(tmp_path), [], os.replace

    def replace_until_full(source, target):
        calls.append(1)
        if len(calls) > survives:
            full_disk()
        replace(source, target)

    with monkeypatch.context() as patch:
        patch.setattr(atomic.os, "replace", replace_until_full)
        with pytest.raises(OSError, match="No space left"):
            writer.write("b", **frame(1))
        with pytest.raises(OSError, match="No space left"):
            write_json_atomic(tmp_path / "summary.json", {"frames": 2})
    after = tree(tmp_path)
    assert {name: after[name] for name in before} == before
    assert writer.finished("a")
    assert not writer.finished("b")
    assert not [name for name in after if name.endswith(".tmp")]
    writer.write("b", **frame(1))  # space again: the run goes on
    assert writer.finished("b")


def test_write_fails_in_the_middle_of_a_file(tmp_path, monkeypatch):
    writer = FrameWriter(tmp_path)
    writer.write("a", **frame(0))
    before = tree(tmp_path)

    class TinyDisk(io.FileIO):
        def write(self, data):
            if self.tell() + len(data) > 300:
                super().write(bytes(data)[:100])
                full_disk()
            return super().write(data)

    monkeypatch.setattr(atomic, "open", TinyDisk, raising=False)
    for name in ("a", "b"):  # overwriting a finished frame, then a new one
        with pytest.raises(OSError, match="No space left"):
            writer.write(name, **frame(1))
    assert tree(tmp_path) == before


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

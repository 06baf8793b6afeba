"""``ufmstar live``: recordings, growing folders, lines on standard input, and the viewer."""

from __future__ import annotations

import base64
import io
import json
import math
import os
import re
import subprocess
import sys
import threading
import time
from itertools import count
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from demo_networks import write_members
from layouts import quaternion_line
from live_inputs import POSE, TOUR, content
from PIL import Image
from rerun_stand_in import stand_in

from ufmstar_torch import cli
from ufmstar_torch.eval.commands import live as live_command
from ufmstar_torch.eval.run import rerun_log
from ufmstar_torch.eval.sequences import live as sources
from ufmstar_torch.eval.sequences import open_sequence
from ufmstar_torch.eval.sequences.live import json_lines
from ufmstar_torch.files.write import hold
from ufmstar_torch.frames.prediction import NetworksInTurn

__all__ = ["stand_in"]


@pytest.fixture(scope="module")
def weights(tmp_path_factory):
    return write_members(tmp_path_factory.mktemp("weights") / "one.safetensors", 1)


@pytest.fixture
def ufmstar(capsys, weights):
    """Run the command with the test's network; its exit code, output and errors."""

    def run(*words):
        code = cli.main(["live", *map(str, words), "--model", "trained", "--weights", str(weights)])
        return code, *capsys.readouterr()

    return run


def malicious(folder):
    """A torch.save file that creates FOLDER/ran when its objects are unpickled."""

    class Code:
        def __reduce__(self):
            return open, (str(folder / "ran"), "w")

    torch.save({"ufm": Code()}, folder / "malicious.pt")
    return (folder / "malicious.pt").read_bytes()


def test_a_recording_live(ufmstar, tmp_path):
    words = ("--state", tmp_path / "state.pt", "--out", tmp_path / "out", "--json", "--speed", "0.2")
    code, out, err = ufmstar(TOUR, *words)
    assert code == 0, err + out
    lines = [json.loads(line) for line in out.splitlines()]
    summary = json.loads((tmp_path / "out" / "realtime.json").read_text())
    assert summary["images"] == 5
    assert len(lines) == summary["results"] == 5 - sum(summary["dropped"].values()) >= 1
    assert "UfM*'s share of the time" in err
    assert 0 < summary["ours_share"] < 1
    assert summary["latency_ms"]["p50"] <= summary["latency_ms"]["p99"]
    assert (summary["program"], summary["state"]) == ("ufmstar live", "finished")
    with np.load(tmp_path / "out" / f"{lines[-1]['stamp']:.6f}.npz") as maps:
        assert maps["depth"].shape == maps["variance"].shape == (64, 96)
        np.testing.assert_allclose(maps["T_world_cam"], open_sequence(TOUR)[-1].T_world_cam, atol=1e-12)
        assert float(np.median(maps["depth"])) == pytest.approx(lines[-1]["depth_m"], abs=1e-3)
    images = int(torch.load(tmp_path / "state.pt")["image_index"])
    assert images == summary["results"]
    code, _, err = ufmstar(TOUR, "--state", tmp_path / "state.pt", "--speed", "0.2")
    assert code == 0, err + out
    assert int(torch.load(tmp_path / "state.pt")["image_index"]) > images  # the run continued
    before = sorted((tmp_path / "out").iterdir())
    code, _, err = ufmstar(TOUR, "--plain", "--out", tmp_path / "out")
    assert code == 2
    assert f"--out {tmp_path / 'out'} holds an earlier live run: --overwrite replaces it" in err
    assert sorted((tmp_path / "out").iterdir()) == before
    lock = hold(tmp_path / ".state.pt.lock")
    plain = (TOUR, "--plain", "--state", tmp_path / "state.pt")
    code, _, err = ufmstar(*plain, "--out", tmp_path / "out", "--overwrite")
    assert (code, sorted((tmp_path / "out").iterdir())) == (2, before)  # refused before anything is replaced
    assert "another process is writing" in err
    lock.release()
    assert ufmstar("tour:3?frames=2&size=64x96", "--plain", "--out", tmp_path / "out", "--overwrite")[0] == 0
    assert not any((tmp_path / "out" / f"{line['stamp']:.6f}.npz").exists() for line in lines[2:])
    for stored, text in ((b"no state", "it begins with b'no state'"), (malicious(tmp_path), "never loaded because")):
        (tmp_path / "state.pt").write_bytes(stored)
        code, _, err = ufmstar(*plain)
        assert code == 2
        assert "cannot be continued" in err
        assert text in err
        assert "weights_only" not in err, "torch's advice is to run the code"
        assert not (tmp_path / "ran").exists()


def test_a_recording_waits_for_a_network_that_starts_slowly(ufmstar, monkeypatch):
    """As on a GPU, whose libraries take seconds: the recording's clock starts after the first prediction."""
    member, running, too_early = NetworksInTurn.member, threading.Event(), []

    def perf_counter():
        running.set()
        return time.perf_counter()

    def slow_at_first(*words):
        if not too_early:
            too_early.append(running.wait(0.3))
        return member(*words)

    monkeypatch.setattr(sources, "time", SimpleNamespace(sleep=time.sleep, perf_counter=perf_counter))
    monkeypatch.setattr(NetworksInTurn, "member", slow_at_first)
    code, out, err = ufmstar(TOUR, "--plain", "--speed", "100", "--json")
    assert code == 0, err + out
    assert too_early == [False]
    assert running.is_set()


@pytest.mark.parametrize("source", ["-", "folder"])
def test_seconds_and_silence_of_a_source_that_stays_open(ufmstar, tmp_path, monkeypatch, source):
    """A client that sends one image and then nothing does not hold the command; before the first image, a line says
    that there is none."""
    monkeypatch.setattr("ufmstar_torch.eval.commands.live._SILENCE", 0.0)
    image, camera = content(np.full((48, 64, 3), 7, np.uint8)), (50, 50, 31.5, 23.5)
    words = ("--plain", "--seconds", "0.1", "--intrinsics", *camera)
    if source == "-":
        read, write = os.pipe()
        embedded = "data:;base64," + base64.b64encode(image).decode()
        lines = [{"stamp": 1, "pose": POSE}, {"stamp": 1, "pose": POSE, "image": embedded}]
        os.write(write, "".join(f"{json.dumps(line)}\n" for line in lines).encode())
        with os.fdopen(read) as stream:
            monkeypatch.setattr(sys, "stdin", stream)
            code, out, err = ufmstar("-", *words)
            os.close(write)
    else:
        (tmp_path / "images").mkdir()
        (tmp_path / "poses.txt").write_text("1 0 0 0 0 0 0 1\n")
        new = sources.PoseFile.new

        def written_later(poses):
            yield from new(poses)
            if not list((tmp_path / "images").iterdir()):
                (tmp_path / "images" / "1.0.png").write_bytes(image)

        monkeypatch.setattr(sources.PoseFile, "new", written_later)
        code, out, err = ufmstar(tmp_path / "images", "--follow", "--trajectory", tmp_path / "poses.txt", *words)
    assert code == 0, err + out
    assert "1 of 1 images" in out
    assert "ufmstar live: no image yet from" in err


def test_lines_on_standard_input_live(ufmstar, tmp_path, monkeypatch):
    sequence, lines = open_sequence(TOUR), []
    for n, frame in enumerate(sequence):
        Image.fromarray(frame.image).save(tmp_path / f"{n}.png")
        lines.append(json.dumps({"stamp": n, "pose": frame.T_world_cam.tolist()}))
        lines.append(json.dumps({"stamp": n, "image": str(tmp_path / f"{n}.png")}))
    monkeypatch.setattr(sys, "stdin", io.StringIO("\n".join(lines)))
    K = sequence.intrinsics
    code, out, err = ufmstar("-", "--intrinsics", K[0, 0], K[1, 1], K[0, 2], K[1, 2])
    assert code == 0, err + out
    assert "of 5 images" in out
    monkeypatch.setattr(sys, "stdin", io.StringIO("\n".join([*lines, "no JSON"])))
    intrinsics = ("--intrinsics", K[0, 0], K[1, 1], K[0, 2], K[1, 2])
    code, out, err = ufmstar("-", "--plain", *intrinsics, "--out", tmp_path / "out")
    assert code == 1
    assert "line 11: no JSON" in err
    assert "of 5 images" in out, "the summary table"
    summary = json.loads((tmp_path / "out" / "realtime.json").read_text())
    assert (summary["state"], summary["reason"]) == ("failed", "line 11: no JSON: no JSON")
    monkeypatch.setattr(sys, "stdin", io.StringIO(lines[1]))
    code, _, err = ufmstar("-", "--plain")
    assert code == 1
    assert "line 1: an image needs intrinsics, in its line, an earlier one or --intrinsics" in err


def test_intrinsics_hold_for_later_lines_and_images_may_be_missing(tmp_path, caplog):
    (tmp_path / "a.png").write_bytes(content(np.full((8, 8, 3), 7, np.uint8)))
    lines = [
        {"intrinsics": [9, 9, 4, 4]},
        {"stamp": 1, "image": "a.png"},
        {"stamp": 2, "image": "none.png"},
        {"stamp": 3, "image": "none.png", "pose": [0, 0, 0, 0, 0, 0, 1]},
        {"stamp": 4, "image": "a.png", "intrinsics": [8, 8, 4, 4]},
        {"stamp": 5, "image": "a.png"},
    ]
    events = list(json_lines(map(json.dumps, lines), tmp_path))
    assert [(event.stamp, event.image is not None) for event in events] == [(1, True), (3, False), (4, True), (5, True)]
    assert [event.intrinsics[0, 0] for event in events] == [9, 9, 8, 8]
    assert "line 3: the image is left out: " in caplog.text
    assert "2 images could not be read" in caplog.text


def test_a_folder_that_grows_live(ufmstar, tmp_path, monkeypatch):
    """Until --seconds are over: here, after the first result."""
    out = tmp_path / "out"
    monkeypatch.setattr(live_command, "monotonic", lambda: math.inf if any(out.glob("*.npz")) else 0.0)
    sequence = open_sequence(TOUR)
    folder = tmp_path / "images"
    folder.mkdir()

    ended = threading.Event()

    def write():
        for n in count():
            frame = sequence[n % len(sequence)]
            (folder / f"{n / 20}.png").write_bytes(content(frame.image))
            with (tmp_path / "poses.txt").open("a") as file:
                file.write(f"{n / 20} {quaternion_line(frame.T_world_cam)}\n")
            if ended.wait(0.05):
                return

    writer = threading.Thread(target=write)
    writer.start()
    K = sequence.intrinsics
    words = ("--trajectory", tmp_path / "poses.txt", "--intrinsics", K[0, 0], K[1, 1], K[0, 2], K[1, 2])
    code, printed, err = ufmstar(folder, "--plain", "--follow", "--seconds", "1", "--out", out, *words)
    ended.set()
    writer.join()
    assert code == 0, err + printed
    assert "UfM*'s share" in printed


_VIEWER = """
import socket, sys
host, port = (sys.argv[sys.argv.index(option) + 1] for option in ("--bind", "--port"))
with socket.create_server((host, int(port))) as server:
    server.accept()
    server.accept()
"""


@pytest.mark.parametrize("display", [True, False])
def test_a_viewer_shows_the_results_on_this_computer_alone(ufmstar, stand_in, monkeypatch, display):
    started, start = [], subprocess.Popen

    def viewer(words, **how):
        assert words[words.index("--bind") + 1] == "127.0.0.1"
        assert words[1:3] == ["-m", "rerun_cli"]
        started.append(start([sys.executable, "-c", _VIEWER if display else "", *words[3:]], **how))
        return started[0]

    monkeypatch.setattr(rerun_log.subprocess, "Popen", viewer)
    code, out, err = ufmstar(TOUR, "--plain", "--view", "--speed", "0.2")
    started[0].terminate()
    started[0].wait(10)
    if not display:
        assert code == 2
        assert "rerun's viewer does not start: is there a display?" in err
        return
    assert code == 0, err + out
    (address,) = [words[0] for name, words, _ in stand_in.calls if name == "connect_grpc"]
    assert address.startswith("rerun+http://127.0.0.1:")
    (count,) = re.findall(r"(\d) of 5 images", out)
    depths, images = stand_in.logged("world/camera/maps/depth"), stand_in.logged("world/camera/image/rgb")
    assert len(depths) == len(images) == len(stand_in.logged("milliseconds/latency_ms")) == int(count)
    assert images[0].words[0].shape == (64, 96, 3)
    assert depths[0].words[0].dtype == np.uint16


def test_poses_that_contradict_the_images_of_a_recording_are_named(ufmstar, rendered_walk, caplog):
    for poses, named in (((), 0), (("--poses", "opengl"), 1)):
        caplog.clear()
        assert ufmstar(rendered_walk, "--plain", "--speed", "100", *poses)[0] == 0
        assert (
            sum(text.startswith(f"{rendered_walk}: poses disagree with the images") for text in caplog.messages)
            == named
        )

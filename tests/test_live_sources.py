"""``ufmstar live`` and its sources: recordings in real time, growing files, lines of JSON, options and output."""

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
from dataclasses import replace
from itertools import count
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from demo_networks import write_members
from layouts import quaternion_line
from PIL import Image
from rerun_stand_in import stand_in

from ufmstar_torch import cli
from ufmstar_torch.eval.commands import live as live_command
from ufmstar_torch.eval.run import rerun_log
from ufmstar_torch.eval.sequences import live as sources
from ufmstar_torch.eval.sequences import open_sequence
from ufmstar_torch.eval.sequences.live import LONGEST_LINE, PoseFile, growing_folder, json_lines, replay
from ufmstar_torch.files.write import hold
from ufmstar_torch.frames.prediction import NetworksInTurn

__all__ = ["stand_in"]

TOUR = "tour:3?frames=5&size=64x96"
POSE = [1, 2, 3, 0, 0, 0, 1]


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


def content(image):
    file = io.BytesIO()
    Image.fromarray(image).save(file, "PNG")
    return file.getvalue()


def test_a_recording_comes_at_its_pace():
    sequence = open_sequence(TOUR)
    list(replay(sequence))  # renders
    started, moments = time.perf_counter(), []
    for event in replay(sequence, speed=2):
        moments.append(time.perf_counter() - started)
        assert event.image.shape == (64, 96, 3)
    assert all(moment >= n / 15 / 2 for n, moment in enumerate(moments))
    assert [event.stamp for event in replay(sequence, np.inf)] == [n / 15 for n in range(5)]
    for stamps in ([None] * 5, [0.0, 1.0, 2.0, 3.0, 4.0]):
        entries = [replace(entry, timestamp=stamp) for entry, stamp in zip(sequence.entries, stamps, strict=True)]
        assert [event.stamp for event in replay(replace(sequence, entries=tuple(entries)), np.inf)][1] == 1 / 30


def test_poses_are_read_as_their_lines_are_completed(tmp_path):
    poses = PoseFile(tmp_path / "poses.txt", "world-to-camera", scale=2.0)
    assert list(poses.new()) == []
    with (tmp_path / "poses.txt").open("w") as file:
        for text, expected in (
            ("# time x y z qw qx qy qz\n1.5 1 2 3 1 0 0 0\n2.5 1 2", [1.5]),
            (" 3 1 0 0", []),
            (" 0\n3 nan 0 0 1 0 0 0\n", [2.5, 3.0]),
        ):
            file.write(text)
            file.flush()
            events = list(poses.new())
            assert [event.stamp for event in events] == expected
            if expected == [1.5]:
                np.testing.assert_allclose(events[0].T_world_cam[:3, 3], [-2, -4, -6], atol=1e-12)
        assert np.isnan(events[-1].T_world_cam).all()
        file.write("4 1 2 3\n")
        file.flush()
        with pytest.raises(ValueError, match=r"poses\.txt:5: expected 8 columns or more"):
            list(poses.new())


def test_a_file_of_poses_that_is_written_anew_is_read_from_its_start(tmp_path, caplog):
    """Longer and shorter, with the same inode and with another one. A copy that continues it is not read again."""
    file = tmp_path / "poses.txt"
    poses = PoseFile(file)

    def write(stamps, *, replaced=False, x=0):
        target = tmp_path / "new.txt" if replaced else file
        target.write_text("".join(f"{stamp} {x} 0 0 0 0 0 1\n" for stamp in stamps))
        target.replace(file)
        return [event.stamp for event in poses.new()]

    assert write(range(100)) == list(range(100))
    for replaced in (False, True):
        assert write(range(200, 250), replaced=replaced) == list(range(200, 250))  # a shorter file
        assert write(range(300, 500), replaced=replaced) == list(range(300, 500))  # a longer one
        assert write(range(300, 500), replaced=replaced, x=1) == list(range(300, 500))  # of the same length
    assert caplog.text.count("was written anew") == 6
    assert write(range(300, 600), replaced=True, x=1) == list(range(500, 600))
    assert list(poses.new()) == []
    assert caplog.text.count("was written anew") == 6


def test_an_image_that_replaces_an_earlier_one_is_new(tmp_path):
    """A camera that starts again writes the same names."""
    file = tmp_path / "0.png"
    file.write_bytes(content(np.full((8, 8, 3), 7, np.uint8)))
    os.utime(file, (1, 1))

    def clock():  # first read after the folder has been listed
        file.write_bytes(content(np.full((8, 8, 3), 9, np.uint8)))
        return 0.0

    assert next(growing_folder(tmp_path, PoseFile(tmp_path / "none"), clock=clock)).image[0, 0, 0] == 9


def test_a_folder_that_grows(tmp_path, monkeypatch):
    monkeypatch.setattr(sources, "_UNREADABLE", 1000)  # [s] this machine may be slow
    folder, image = tmp_path / "images", np.full((8, 8, 3), 7, np.uint8)
    folder.mkdir()
    (folder / "1.0.png").write_bytes(content(image))  # existed before

    def first():
        (folder / "2.0.png").write_bytes(content(image)[:40])  # still being written
        (folder / "3.0.png").write_bytes(content(image))
        (folder / "notes.txt").write_text("no image")
        (folder / "0.png").symlink_to("nowhere.png")
        (tmp_path / "poses.txt").write_text("2.5 0 0 0 0 0 0 1\n")

    steps = [first, lambda: None, lambda: (folder / "2.0.png").write_bytes(content(image))]

    def clock():  # first read after the folder has been listed, then before each look into it
        if steps:
            steps.pop(0)()
        return 0.0

    events = (event for event in growing_folder(folder, PoseFile(tmp_path / "poses.txt"), clock=clock) if event)
    found = [next(events) for _ in range(3)]
    (folder / "front.png").write_bytes(content(image))
    found.append(next(events))
    assert [event.stamp for event in found[:3]] == [2.5, 2.0, 3.0]
    assert found[0].image is None
    assert abs(found[3].stamp - time.time()) < 60  # the file's metadata
    assert set(growing_folder(folder, PoseFile(tmp_path / "none"), idle=0.05)) == {None}
    with pytest.raises(FileNotFoundError, match="no such folder"):
        next(growing_folder(tmp_path / "nowhere", PoseFile(tmp_path / "none")))


def test_lines_of_json(tmp_path):
    image = np.arange(8 * 8 * 3, dtype=np.uint8).reshape(8, 8, 3)
    (tmp_path / "a.png").write_bytes(content(image))
    embedded = "data:image/png;base64," + base64.b64encode(content(image)).decode()
    lines = [
        {"stamp": 1, "pose": POSE},
        {"stamp": 2, "image": "a.png", "intrinsics": [5, 5, 4, 4]},
        {"stamp": 3, "image": embedded, "pose": np.eye(4).tolist()},
    ]
    pose, file, both = json_lines(["\n", *map(json.dumps, lines)], tmp_path)
    np.testing.assert_array_equal(pose.T_world_cam[:3, 3], [1, 2, 3])
    np.testing.assert_array_equal(file.image, image)
    np.testing.assert_array_equal(both.image, image)
    np.testing.assert_array_equal(both.T_world_cam, np.eye(4))
    assert file.intrinsics.tolist() == [[5, 0, 4], [0, 5, 4], [0, 0, 1]]


def test_an_unfinished_last_line_and_names_that_no_file_has_are_left_out(tmp_path, caplog):
    """As of a program that is killed; a line without an end is refused."""
    lines = ['\ufeff{"stamp": 1, "pose": [1, 2, 3, 0, 0, 0, 1], "intrinsics": [9, 9, 4, 4]}\n']
    lines += [
        json.dumps({"stamp": 2, "image": name}) + "\n"
        for name in (5000 * "a" + ".png", "\0.png", "", "data:;base64,%", "data:;base64,")
    ]
    assert [event.stamp for event in json_lines([*lines, '{"stamp": 3, "pose": [1, 2'], tmp_path)] == [1]
    assert "line 7 is unfinished and left out" in caplog.text
    assert "5 images could not be read" in caplog.text
    with pytest.raises(ValueError, match="line 1: it is longer than"):
        list(json_lines(["0" * LONGEST_LINE], tmp_path))


@pytest.mark.parametrize(
    ("line", "text"),
    [
        ("{\n", "line 1: no JSON: {"),
        ("[1]", "line 1: expected"),
        ('{"stamp": 1}', "line 1: a stamp and a pose or an image"),
        ('{"stamp": 1, "poses": []}', "line 1: expected"),
        ('{"stamp": "now", "pose": [1, 2, 3, 0, 0, 0, 1]}', "line 1: a stamp is a finite number .*'now'"),
        ('{"stamp": 1, "pose": [1, 2, 3]}', r"line 1: a pose has 7 \(x y z qx qy qz qw\) or 12"),
        ('{"stamp": 1, "pose": [1, 2, 3, 0, 0, 0, 2]}', "line 1: pose: the quaternion's norm is 2"),
        ('{"stamp": 1, "pose": [[1, 2], [3]]}', "line 1: a pose has 7"),
        ('{"stamp": 1, "pose": {"x": 1}}', "line 1: a pose has 7"),
        ('{"stamp": 1, "image": "none.png"}', "line 1: an image needs intrinsics, in its line, an earlier"),
        ('{"intrinsics": [1, 2]}', "line 1: intrinsics are fx, fy, cx, cy"),
        ('{"intrinsics": "9 9 4 4"}', "line 1: intrinsics are fx, fy, cx, cy"),
        ('{"intrinsics": [0, 9, 4, 4]}', "line 1: intrinsics must be a finite 3x3 matrix with positive focal lengths"),
        *(
            (f'{{"stamp": {stamp}, "pose": [1, 2, 3, 0, 0, 0, 1]}}', "line 1: .*(finite|too large)")
            for stamp in ("NaN", "1e999", 10**400)
        ),
        ("[" * 100000, "line 1: "),
        ('{"stamp": 1, "image": 5, "intrinsics": [9, 9, 4, 4]}', "line 1: an image is the name of a file, got 5"),
    ],
)
def test_a_line_that_is_none_is_named(tmp_path, line, text):
    with pytest.raises(ValueError, match=text):
        list(json_lines([line], tmp_path))


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
    for content, text in ((b"no state", "it begins with b'no state'"), (malicious(tmp_path), "never loaded because")):
        (tmp_path / "state.pt").write_bytes(content)
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

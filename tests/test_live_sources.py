"""Sources of ``ufmstar live``: recordings at their pace, growing files and folders, and lines of JSON."""

from __future__ import annotations

import base64
import json
import os
import time
from dataclasses import replace

import numpy as np
import pytest
from live_inputs import POSE, TOUR, content

from ufmstar_torch.eval.sequences import live as sources
from ufmstar_torch.eval.sequences import open_sequence
from ufmstar_torch.eval.sequences.live import LONGEST_LINE, PoseFile, growing_folder, json_lines, replay


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

"""Recorded sequences and rendered tours for training: parts, sequences without poses, the cache of tours."""

from __future__ import annotations

import re
import shutil
from dataclasses import replace

import numpy as np
import pytest
from layouts import truncate, write_generic, write_scannet, write_tum
from training_data import TINY

from ufmstar_torch.eval.sequences import FrameError, open_sequence
from ufmstar_torch.eval.sequences.ground_truth import truth_at
from ufmstar_torch.train import SequenceFrames, tour_frames
from ufmstar_torch.train.data import sources
from ufmstar_torch.train.data_config import DataConfig, Part
from ufmstar_torch.train.sequence_data import open_rgbd
from ufmstar_torch.train.tour_data import digest, tour_file


@pytest.mark.parametrize(
    ("text", "length", "expected"),
    [
        ("0:70%", 10, range(7)),
        ("75%:100%", 10, range(7, 10)),
        ("75%:", 1000, range(750, 1000)),
        (":30", 100, range(30)),
        ("100:400", 250, range(100, 250)),
        (":", 5, range(5)),
        ("10:50%", 100, range(10, 50)),
        ("0:29%", 100, range(29)),
        ("12.5%:25%", 8, range(1, 2)),
        (" 0 : 5 ", 9, range(5)),
    ],
)
def test_parts_of_a_sequence(text, length, expected):
    assert Part.parse(text).frames(length) == expected
    assert Part.parse(str(Part.parse(text))) == Part.parse(text)


def test_frames_of_a_sequence_are_the_readers(tmp_path):
    path, *_ = write_tum(tmp_path)
    sequence = open_sequence(path)
    frames = SequenceFrames([sequence, sequence], "0:50%")
    half = len(sequence) // 2
    assert len(frames) == 2 * half
    assert frames.name(half) == f"{sequence.name}/{sequence.names[0]}"
    for index in (0, 1, half):
        frame, raw = sequence[index % half], frames.load(index)
        np.testing.assert_array_equal(raw.image, frame.image)
        np.testing.assert_array_equal(raw.depth, frame.depth)
        np.testing.assert_array_equal(raw.intrinsics, frame.intrinsics)


def test_depth_with_a_camera_of_its_own_is_seen_by_the_images(tmp_path):
    sequence = open_sequence(write_scannet(tmp_path)[0])  # 121 x 162 colour, 48 x 64 depth
    raw = SequenceFrames([sequence]).load(2)
    np.testing.assert_array_equal(raw.depth, truth_at(sequence[2], raw.intrinsics, (121, 162)))
    np.testing.assert_array_equal(raw.intrinsics, sequence.intrinsics)


def test_depth_in_another_unit_than_the_poses_is_named(rendered_walk, tmp_path, caplog):
    sources(DataConfig(kind="sequences", paths=(str(rendered_walk),)))
    assert not caplog.messages
    path = shutil.copytree(rendered_walk, tmp_path / "walk")
    for file in (path / "depth").iterdir():
        np.save(file, 0.2 * np.load(file))
    sources(DataConfig(kind="sequences", paths=(str(path),)))
    (text,) = caplog.messages
    assert re.search(r"depth looks too small: times (4\.\d+|5(\.\d+)?) fits", text)


def test_images_and_depth_without_poses(tmp_path):
    path, scene = write_generic(tmp_path)
    posed = SequenceFrames([open_rgbd(path)])
    assert posed.sequences[0].layout == "generic"
    (path / "poses.txt").unlink()
    (path / "depth" / "12.png").unlink()
    unposed = SequenceFrames([open_rgbd(path)])
    assert len(unposed) == len(posed) - 1
    assert [s.name for s in unposed.sequences[0].skipped] == ["12"]
    for i in range(len(unposed)):
        one, two = posed.load(i), unposed.load(i)
        for name in ("image", "depth", "intrinsics"):
            np.testing.assert_array_equal(getattr(one, name), getattr(two, name))
    np.testing.assert_allclose(unposed.load(0).intrinsics, scene.K, atol=1e-12)


@pytest.fixture(scope="module")
def tours(tmp_path_factory):
    folder = tmp_path_factory.mktemp("cache")
    return folder, tour_frames([5, 6], replace(TINY, cache=str(folder)))


def test_stored_tours_are_the_rendered_ones(tours):
    from ufmstar_torch.eval.tour import tour_sequence

    _, frames = tours
    assert len(frames) == 6
    sequence = tour_sequence(6, frames=12, size=(24, 32), path_seed=0)
    for i in range(3):
        frame, raw = sequence[4 * i], frames.load(3 + i)
        np.testing.assert_array_equal(raw.image, frame.image)
        np.testing.assert_allclose(raw.depth, frame.depth, atol=5.1e-4)
        np.testing.assert_array_equal(raw.intrinsics, frame.intrinsics)


def test_tours_are_rendered_once_and_completed(tours, tmp_path):
    folder, frames = tours
    shutil.copytree(folder, tmp_path / "cache")
    inside = tmp_path / "cache" / f"tours-{digest(TINY)}"
    times = {path.name: path.stat().st_mtime_ns for path in inside.iterdir()}
    tour_frames([5, 6], replace(TINY, cache=str(tmp_path / "cache")))
    assert times == {path.name: path.stat().st_mtime_ns for path in inside.iterdir()}
    tour_file(inside, 6).unlink()
    again = tour_frames([5, 6], replace(TINY, cache=str(tmp_path / "cache")))
    assert tour_file(inside, 5).stat().st_mtime_ns == times["5.npy"]
    np.testing.assert_array_equal(again.load(4).image, frames.load(4).image)
    assert sorted(times) == sorted(path.name for path in inside.iterdir())  # no temporary file is left


def test_a_truncated_cache_file_is_named(tours, tmp_path):
    folder, _ = tours
    shutil.copytree(folder, tmp_path / "cache")
    config = replace(TINY, cache=str(tmp_path / "cache"))
    copy = tour_frames([5, 6], config)
    truncate(tour_file(tmp_path / "cache" / f"tours-{digest(TINY)}", 5), 0.5)
    with pytest.raises(FrameError, match=r"tour-5/1: .*5\.npy"):
        copy.load(1)
    assert copy.load(3).depth.any()
    with pytest.raises(ValueError, match=r"5\.npy"):
        tour_frames([5], config)

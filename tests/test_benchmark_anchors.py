"""What anchors cost: as many corners as are told are really followed, parts add up, threads are put back."""

from __future__ import annotations

import functools
import json

import cv2
import numba
import numpy as np
import pytest
import torch

from ufmstar_torch import cli
from ufmstar_torch.anchors.tracker import LandmarkTracker, TrackerConfig
from ufmstar_torch.eval.bench import benchmark
from ufmstar_torch.eval.bench.anchors import PARTS, TrackedTour, measure_tracker
from ufmstar_torch.eval.bench.text import format_report
from ufmstar_torch.eval.bench.timing import pinned_threads
from ufmstar_torch.eval.commands import bench_command

TIMES = {f"{clock}{name}_ms" for clock in ("", "cpu_") for name in ("median", "p90", "mean", "min")}
SMALL = TrackedTour(size=(120, 160), path_frames=400)


def threads():
    of_numba = numba.get_num_threads()  # the first call starts numba's threads, which may change torch's number
    return of_numba, torch.get_num_threads(), cv2.getNumThreads()


@pytest.fixture(scope="module", autouse=True)
def one_core():
    """Beside other work, torch's second thread would wait by spinning."""
    with pinned_threads(1):
        yield


@functools.cache
def rendered():
    return SMALL.frames(18)


@pytest.fixture(scope="module")
def report(one_core):
    """What ``ufmstar bench --anchors 60`` measures, in small."""
    words = "--sizes 48 --frames 6 --history 4 --in-view 5 --backends numba --skip-compile --threads 1"
    options = bench_command.read([*words.split(), "--anchors", "60"])
    before, seen = threads(), rendered()
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(TrackedTour, "frames", lambda _, count: seen[:count])
        patch.setattr(benchmark, "reference_networks", lambda size, fastdepth, runtime: ({}, {}))
        result = benchmark.run_benchmark(options)
    assert threads() == before
    return result


def test_every_figure_is_there_and_possible(report):
    result = json.loads(json.dumps(report["anchors"]))
    tracker, step = result["tracker"], result["step"]
    assert (result["points"], result["frames"], result["threads"]) == (60, 6, 1)
    for times in (tracker["update"], step["plain"], step["anchored"], step["posterior"]):
        assert set(times) == TIMES | {"count"}
        assert times["count"] == 6
        assert 0 < times["min_ms"] <= times["median_ms"] <= times["p90_ms"]
        assert 0 < times["cpu_min_ms"] <= times["cpu_mean_ms"]
    assert set(tracker["parts"]) == set(PARTS)
    assert min(times["min_ms"] for times in tracker["parts"].values()) >= 0
    assert step["size"] == 224
    assert step["used"]["max"] <= step["anchors"] == 60
    assert step["used"]["min"] > 50, "the anchors contradict nobody"
    assert 0 < step["ratio"]["q1"] <= step["ratio"]["median"] <= step["ratio"]["q3"]
    # Three float32 sums for each slot allocated, 1024 or more, and three for the stream.
    assert step["extra_bytes"]["per_slot"] == 12
    assert step["extra_bytes"]["total"] >= 12 * step["components"]
    assert step["extra_bytes"]["total"] % 12 == 0


def test_corners_are_really_followed(report):
    tracker = report["anchors"]["tracker"]
    assert tracker["slots"] == 75
    assert tracker["followed"]["min"] > 0
    assert 40 < tracker["followed"]["mean"] <= 75, "about the number asked for"
    assert 0 < tracker["landmarks"]["mean"] <= tracker["followed"]["mean"]
    # Positions [75, 10, 2] and poses [10, 4, 4] in float64, who saw what, K, the gray image, an index, the noise.
    assert tracker["state_bytes"] == 8 * (75 * 20 + 160 + 9 + 1 + 1) + 750 + 120 * 160


def test_the_standard_scene_keeps_300_corners():
    """Of its first two frames: what is found in one is followed into the next."""
    tracker = LandmarkTracker(TrackerConfig(max_points=375))
    frames = TrackedTour().frames(2)
    assert [frame.image.shape for frame in frames] == [(480, 640, 3)] * 2
    tracked = [tracker.update(f.image, f.T_world_cam, f.intrinsics).tracked for f in frames]
    assert tracked[0] == 0
    assert tracked[1] >= 300


def test_parts_are_parts_of_the_whole(monkeypatch):
    """With a clock that moves by one at every look, parts and the whole are numbers of looks."""
    ticks = iter(range(10**6))
    monkeypatch.setattr("time.perf_counter", lambda: float(next(ticks)))
    result = measure_tracker(rendered()[:14], 60)
    # Following, searching and triangulating take a tick each; the whole update, from its own first look at the clock to
    # its last, seven.
    assert [result["parts"][name]["median_ms"] for name in PARTS] == [1e3, 1e3, 1e3, 4e3]
    assert result["update"]["count"] == 2


@pytest.mark.parametrize("fails", [False, True])
def test_opencv_gets_one_thread_and_its_own_back(fails):
    before = threads()
    cv2.setNumThreads(2)
    try:
        with pinned_threads(1, opencv=True):
            assert threads() == (1, 1, 1)
            if fails:
                raise KeyError("anything")
    except KeyError:
        pass
    finally:
        restored = cv2.getNumThreads()
        cv2.setNumThreads(before[2])
    assert restored == 2
    assert threads() == before


def test_the_report_in_words(report):
    message = format_report(report)
    assert "corners followed at 640 x 480" in message
    assert "step of 224 x 224 with 60 anchors" in message
    assert "triangulating" in message
    assert {row["name"]: row["met"] for row in report["targets"]}["tracker_cpu_ms"] is None, "the target is for 300"
    as_if = {**report, "anchors": {**report["anchors"], "points": 300}}
    value = {row["name"]: row["value"] for row in benchmark.targets(as_if)}["tracker_cpu_ms"]
    assert value == report["anchors"]["tracker"]["update"]["cpu_mean_ms"]


def test_impossible_numbers(capsys):
    assert cli.main(["bench", "--anchors", "0", "--skip-compile"]) == 2
    assert "--anchors must be at least 1" in capsys.readouterr().err
    with pytest.raises(ValueError, match="the path has 400"):
        SMALL.frames(401)


def test_without_a_number_it_is_300():
    assert bench_command.read(["--anchors"]).anchors == 300
    assert bench_command.read([]).anchors is None
    assert np.isclose(dict(benchmark._TARGETS)["tracker_cpu_ms"], 3.0)

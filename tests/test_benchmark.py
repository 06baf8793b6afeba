"""The benchmark: its arithmetic, its clocks, its rendered room, and a tiny run from end to end."""

from __future__ import annotations

import json
import sys
import time

import numba
import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from onnx_files import small_network

from ufmstar_torch import MergeConfig, UfMStar, UfMStarConfig, cli
from ufmstar_torch.eval.bench import benchmark
from ufmstar_torch.eval.bench.compare import compare, measure_peer
from ufmstar_torch.eval.bench.floors import stage_floors
from ufmstar_torch.eval.bench.frames import (
    PosedDepth,
    RenderedBuilding,
    RenderedRoom,
    RenderedStreet,
)
from ufmstar_torch.eval.bench.growth import measure_growth, measure_long_run
from ufmstar_torch.eval.bench.memory import state_memory
from ufmstar_torch.eval.bench.runtimes import fastest
from ufmstar_torch.eval.bench.step import build_up, components_in_view
from ufmstar_torch.eval.bench.text import format_report
from ufmstar_torch.eval.bench.timing import STAGES, StagedStep, TimedCalls, pinned_threads
from ufmstar_torch.eval.commands import bench_command
from ufmstar_torch.eval.engine.clock import CallTimes, paired_ratio, spread
from ufmstar_torch.eval.report.figures_cost import draw_growth
from ufmstar_torch.eval.report.style import save_figure
from ufmstar_torch.eval.run.machine import available_cores, cpu_model, versions
from ufmstar_torch.eval.tour import box_room as synthetic
from ufmstar_torch.models import MonodepthResNet

SPREAD = {"median_ms", "iqr_ms", "q1_ms", "q3_ms", "min_ms", "count"}


# ---- statistics ----


def test_spread_of_known_values():
    message = spread([5.0, 1.0, 2.0, 4.0, 3.0])
    assert message == {"median_ms": 3.0, "iqr_ms": 2.0, "q1_ms": 2.0, "q3_ms": 4.0, "min_ms": 1.0, "count": 5}
    assert spread([1.0, 2.0, 3.0, 4.0])["q1_ms"] == 1.75  # linear between the sorted values
    assert spread([7.0])["iqr_ms"] == 0
    assert spread([1.0, 1.0, 1.0, 1.0, 1000.0])["median_ms"] == 1.0
    with pytest.raises(ValueError, match="at least one"):
        spread([])


@given(st.lists(st.floats(0.01, 1e4), min_size=1, max_size=30), st.floats(0.1, 10))
def test_spread_is_ordered_and_scales(times, factor):
    message, scaled = spread(times), spread([factor * t for t in times])
    assert message["min_ms"] <= message["q1_ms"] <= message["median_ms"] <= message["q3_ms"]
    assert scaled["median_ms"] == pytest.approx(factor * message["median_ms"])
    assert scaled["iqr_ms"] == pytest.approx(factor * message["iqr_ms"], abs=1e-9 * factor * max(times))


def test_paired_ratio_cancels_a_common_slowdown():
    quiet = paired_ratio([1.0, 2.0, 3.0], [2.0, 4.0, 6.0])
    assert quiet == {"median": 0.5, "q1": 0.5, "q3": 0.5, "count": 3}
    assert paired_ratio([1.0, 40.0, 3.0], [2.0, 80.0, 6.0])["median"] == 0.5
    for a, b in (([], []), ([1.0], [1.0, 2.0])):
        with pytest.raises(ValueError, match="as many numerators"):
            paired_ratio(a, b)


# ---- clocks ----


def test_stopwatch_tells_waiting_from_computing():
    watch = CallTimes()
    for _ in range(3):
        assert watch.time("sleep", lambda x: (time.sleep(0.02), x)[1], 7) == 7
    assert watch.spread("sleep")["min_ms"] >= 20
    assert watch.spread("sleep")["cpu_median_ms"] < 15
    watch.drop(2)
    assert watch.spread("sleep")["count"] == 1


class Clock:
    """Replaces ``time.perf_counter`` and ``time.process_time``: only work moves it."""

    def __init__(self, monkeypatch):
        self.now = 0.0
        monkeypatch.setattr(time, "perf_counter", lambda: self.now)
        monkeypatch.setattr(time, "process_time", lambda: self.now)

    def work(self, seconds, result=None):
        self.now += seconds
        return result


@pytest.fixture
def clock(monkeypatch):
    return Clock(monkeypatch)


def test_calls_alternate_and_each_follows_a_network(clock):
    log = []

    def call(name, seconds):
        return lambda frame: clock.work(seconds, log.append((name, frame)) or (name, frame))

    timed = TimedCalls(before={"small": call("small", 0.5), "large": call("large", 2.0)})
    calls = {"a": call("a", 1.0), "b": call("b", 3.0), "c": call("c", 5.0)}
    for frame in timed.frames(range(3), warm_up=1):
        assert timed.call(calls, frame) == {name: (name, frame) for name in calls}
    networks, orders = ("small", "large", "small"), ("abc", "cba", "abc")
    pairs = [(n, pair) for n, order in enumerate(orders) for pair in zip(networks, order, strict=True)]
    assert log == [(name, n) for n, pair in pairs for name in pair]
    milliseconds = {"small": 500.0, "large": 2000.0, "a": 1000.0, "b": 3000.0, "c": 5000.0}
    assert timed.times.wall == {name: [ms, ms] for name, ms in milliseconds.items()}, "once a frame, less the warm-up"


def test_every_moment_belongs_to_the_stage_that_needs_it(clock):
    class Module:
        observer = None

        def __call__(self, seconds):
            for number, name in enumerate(STAGES):
                clock.work(seconds)
                with self.observer.kernel({"segment": "spgf", "average": "smooth"}.get(name, "fuse")):
                    clock.work(0.1 * number)
                self.observer.stage(name)
            clock.work(1000)  # the output's assembly
            return seconds

    staged = StagedStep(Module())
    assert [staged(seconds) for seconds in (100, 1, 2, 3)] == [100, 1, 2, 3]
    summary = staged.summary(warm_up=1)
    medians = {name: times["median_ms"] for name, times in summary["stages"].items()}
    assert medians == pytest.approx({name: 2000 + 100 * number for number, name in enumerate(STAGES)})
    kernels = {name: times["median_ms"] for name, times in summary["kernels"].items()}
    others = sum(100 * n for n, name in enumerate(STAGES) if name not in ("segment", "average"))
    expected = {"spgf": 100, "floor_covariance": 0, "correspond": 0, "fuse": others, "regress_image": 0}
    assert kernels == pytest.approx(expected)
    assert summary["stages_total"]["median_ms"] == pytest.approx(sum(medians.values()))
    assert summary["stages_total"]["count"] == 3


@pytest.mark.parametrize("fails", [False, True])
def test_threads_are_pinned_and_restored(fails):
    numba.get_num_threads()  # the first call starts numba's threads, which may change torch's number
    before = torch.get_num_threads(), numba.get_num_threads()
    try:
        with pinned_threads(1):
            assert (torch.get_num_threads(), numba.get_num_threads()) == (1, 1)
            if fails:
                raise KeyError("anything")
    except KeyError:
        pass
    assert (torch.get_num_threads(), numba.get_num_threads()) == before


@pytest.mark.parametrize("count", [0, -1, 10_000])
def test_impossible_thread_counts(count):
    before = torch.get_num_threads(), numba.get_num_threads()
    with pytest.raises(ValueError, match="threads must be at"), pinned_threads(count):
        pass
    assert (torch.get_num_threads(), numba.get_num_threads()) == before


# ---- what is counted ----


def test_components_in_view_are_those_whose_mean_projects_inside():
    ufm = UfMStar()
    frame = next(iter(RenderedRoom().frames(64, 1)))
    out = ufm(frame.depth, frame.T_world_cam, frame.intrinsics)
    total = int(out.statistics.components)
    assert components_in_view(ufm, frame) == total > 5, "the frame that made them sees them all"
    behind = frame.T_world_cam @ torch.from_numpy(synthetic.look((0, 0, 0), np.pi))
    assert components_in_view(ufm, PosedDepth(frame.depth, behind, frame.intrinsics)) == 0


def test_memory_counts_components_slots_and_the_map():
    ufm = UfMStar(UfMStarConfig(initial_capacity=256))
    frame = next(iter(RenderedRoom().frames(64, 1)))
    used = int(ufm(frame.depth, frame.T_world_cam, frame.intrinsics).statistics.components)
    # mean 3, covariance 9, weight and disagreement 1 each in float32, and an int64 count
    assert state_memory(ufm) == {
        "bytes_per_component": 64,
        "packed_bytes_per_component": 44,  # the paper's 11 numbers
        "packed": 44 * used,
        "components": used,
        "in_use": 64 * used,
        "allocated": 64 * 256,
        "moving_average": 4 * 64 * 64,
    }


def test_building_up_ends_at_the_number_in_view():
    source = RenderedRoom(period=30)
    ufm, frames, seen = build_up(source, UfMStarConfig(), size=48, in_view=5, history=60, rounds=2)
    assert 20 <= seen < 60, "the mean over 20 frames decides"
    assert int(ufm.frames) == seen
    expected = list(source.frames(48, seen + 2))[seen:]
    assert [torch.equal(a.depth, b.depth) for a, b in zip(frames, expected, strict=True)] == [True, True]
    assert build_up(source, UfMStarConfig(), size=48, in_view=10**6, history=3, rounds=1)[2] == 3


def test_machine_facts():
    assert available_cores() >= 1
    assert cpu_model().strip()
    assert versions()["torch"] == torch.__version__.split("+")[0] or versions()["torch"] == torch.__version__
    assert versions()["numpy"] == np.__version__


# ---- beside something else ----

# Prints the height of every frame that it gets as its time.
PEER = """
import json, os, pathlib
import numpy as np
for file in sorted(pathlib.Path(os.environ["UFMSTAR_BENCH_FRAMES"]).iterdir()):
    with np.load(file) as frame:
        assert frame["T_world_cam"].shape == (4, 4) and frame["K"].shape == (3, 3)
        print(json.dumps({"ms": frame["depth"].shape[0]}))
"""


def small_report(step=2.0, cores=2):
    times = {"median_ms": step}
    result = {"size": 224, "backend": "numba", "step": times, "stages": {"segment": {"median_ms": 1.0}}, "ratios": {}}
    hardware = {"cpu": "a", "cores": cores, "machine": "x86_64"}
    return {
        "schema": 1, "date": "then", "hardware": hardware, "settings": {"threads": 2}, "results": [result]
    }  # fmt: skip


def test_against_an_earlier_report(tmp_path):
    file = tmp_path / "earlier.json"
    file.write_text(json.dumps(small_report(step=4.0)))
    result = compare(small_report(), file)
    assert result == {"file": "earlier.json", "date": "then", "ratios": {"224 numba": {"step": 0.5, "segment": 1.0}}}
    with pytest.raises(ValueError, match="other hardware: cores 2, here 4"):
        compare(small_report(cores=4), file)
    file.write_text("{}")
    with pytest.raises(ValueError, match="no report of ufmstar bench with schema 1"):
        compare(small_report(), file)


def test_a_peer_that_fails():
    with pytest.raises(ValueError, match=r"--peer 'false' failed: .*non-zero exit status 1"):
        measure_peer("false", [])


@pytest.mark.slow
def test_the_faster_runtime_of_a_network_is_taken():
    """Exported by torch, both give the same depth."""
    forward, about = fastest(small_network().folded(), 64)
    names = {"torch": "torch", "onnx": "onnxruntime"}
    assert about["runtimes"].keys() == names.keys()
    assert about["runtime"] == names[min(about["runtimes"], key=about["runtimes"].get)]
    assert about["version"] == (torch.__version__ if about["runtime"] == "torch" else versions()["onnxruntime"])
    assert about["apart"] < 1e-3
    assert forward().shape == (1, 64, 64)


def test_floors_grow_with_what_they_count():
    """The larger of traffic and arithmetic, at rates that are known."""
    counts = {name: {"median": 10.0} for name in ("segments", "matched", "new", "in_view")}
    slow_memory = stage_floors(100, counts, {"bytes_per_second": 1e6, "flops_per_second": 1e12})
    assert slow_memory["average"] == {"bytes": 120_000, "flops": 30_000, "ms": 120.0}
    assert slow_memory["append"]["ms"] == pytest.approx(1000 * 2 * 44 * 10 / 1e6)
    slow_processor = stage_floors(100, counts, {"bytes_per_second": 1e12, "flops_per_second": 1e6})
    assert slow_processor["average"]["ms"] == pytest.approx(30.0)
    larger = stage_floors(200, counts, {"bytes_per_second": 1e6, "flops_per_second": 1e12})
    assert larger["average"]["ms"] == 4 * slow_memory["average"]["ms"]


# ---- end to end ----


def test_a_tiny_run_from_end_to_end(tmp_path, capsys):
    path = tmp_path / "bench.json"
    peer = tmp_path / "peer.py"
    peer.write_text(PEER)
    words = "--sizes 48 --frames 2 --history 4 --in-view 5 --backends numba torch --skip-compile --threads 1"
    words = [*words.split(), "--runtime", "torch", "--peer", f"{sys.executable} {peer}"]
    before = torch.get_num_threads(), numba.get_num_threads()
    assert bench_command.main(bench_command.read([*words, "--json", str(path)])) == 0
    assert (torch.get_num_threads(), numba.get_num_threads()) == before
    report = json.loads(path.read_text())
    assert report["settings"]["threads"] == 1
    assert report["settings"]["config"]["eta"] == 0.5
    assert report["settings"]["source"]["kind"] == "rendered room"
    assert set(report["versions"]) >= {"ufmstar_torch", "torch", "numba", "numpy", "python"}
    assert set(report["hardware"]) >= {"cpu", "cores", "platform", "environment"}
    assert set(report["load_average"]) == {"before", "after"}
    assert [(r["size"], r["backend"]) for r in report["results"]] == [(48, "numba"), (48, "torch")]
    for result in report["results"]:
        check_result(result)
    ours, reference = report["results"]
    assert ours["counts"]["segments"]["max"] > 3
    assert abs(ours["memory"]["components"] - reference["memory"]["components"]) < 20, "the same mixture"
    assert {row["met"] for row in report["targets"]} == {None}, "targets are for 224 x 224"
    assert report["peer"]["process"]["count"] == 3
    assert (report["peer"]["frame"]["median_ms"], report["peer"]["frame"]["count"]) == (48, 6), "3 runs of 2 frames"
    printed = capsys.readouterr()
    assert "whole step" in printed.out
    assert "floor" in printed.out
    assert "peer" in printed.out
    assert "48 x 48, numba" in printed.err


def check_result(result):
    assert set(result["stages"]) == set(STAGES)
    assert set(result["kernels"]) == {"spgf", "floor_covariance", "correspond", "fuse", "regress_image"}
    timed = [*result["stages"].values(), *result["kernels"].values(), result["step"], result["mean_uncertainty"]]
    for times in timed:
        assert set(times) >= SPREAD
        assert times["count"] == result["frames"]["timed"] == 2
        assert 0 <= times["min_ms"] <= times["median_ms"]
    assert result["mean_uncertainty"]["pixels"] == 1000
    assert set(result["networks"]) == {"fastdepth", "resnet50"}
    beside = {"step/ufm"} if result["backend"] == "numba" else set()
    assert set(result["ratios"]) == {"step/fastdepth", "step/resnet50", "mean_uncertainty/step", *beside}
    for name, about in result["networks_about"].items():
        assert (about["runtime"], about["version"]) == ("torch", torch.__version__), name
        assert about["runtimes"].keys() == {"torch"}
    assert all(floor["ms"] > 0 for stage, floor in result["floors"].items() if stage not in ("append", "fuse"))
    assert set(result["floors"]) == set(STAGES)
    assert result["allocations"]["python_peak"] > 0
    assert result["networks_about"]["fastdepth"]["size"] == 64
    # torchvision's ResNet50 without its classifier, and Monodepth2's decoder
    decoder = sum(p.nelement() for name, p in MonodepthResNet().named_parameters() if not name.startswith("encoder."))
    assert result["networks_about"]["resnet50"]["parameters"] == 25_557_032 - (2048 * 1000 + 1000) + decoder
    assert result["counts"]["in_view"]["min"] <= result["counts"]["components"]["max"]
    assert result["memory"]["in_use"] <= result["memory"]["allocated"]
    assert result["history"] == 4


def test_a_long_run_compares_the_same_room_early_and_late():
    run = measure_long_run(RenderedRoom(period=10), UfMStarConfig(), size=48, frames=40, window=10)
    assert (run["early"]["frames"], run["late"]["frames"]) == ([6, 15], [31, 40])
    assert run["ratio"] == run["late"]["step_median_ms"] / run["early"]["step_median_ms"]
    assert [row["frames"] for row in run["rows"]] == [[1, 10], [11, 20], [21, 30], [31, 40]]
    components = [row["components"] for row in run["rows"]]
    assert components == sorted(components)
    assert components[-1] == run["memory"]["components"]
    with pytest.raises(ValueError, match="at least 25 frames"):
        measure_long_run(RenderedRoom(), UfMStarConfig(), size=48, frames=24, window=10)


@pytest.mark.slow
def test_long_runs_are_drawn_by_world(tmp_path):
    """With merging and without, with a limit of the components in memory and without."""
    config = UfMStarConfig(merge=MergeConfig(every=5))
    worlds = {"room": (RenderedRoom(period=10), config), "building": (RenderedBuilding(boxes=5, period=10), config)}
    said = []
    runs = measure_growth(worlds, (0.0, 2.0), (0, 40), size=48, frames=40, window=10, progress=said.append)
    assert [(run["world"], run["merge"], run["max_components"]) for run in runs] == [
        (world, merge, most) for world in worlds for merge in (0.0, 2.0) for most in (None, 40)
    ]
    assert len(said) == 8
    room, bounded, merged, *_ = runs
    assert merged["memory"]["components"] < room["memory"]["components"]
    assert bounded["memory"]["components"] <= 40
    figure = draw_growth(runs)
    lines = [line for axes in figure.axes for line in axes.lines]
    assert len(figure.axes) == 4
    assert [list(line.get_xdata()) for line in lines] == [[10, 20, 30, 40]] * 16
    save_figure(figure, tmp_path / "growth.svg")
    assert "merge 2, at most 40" in (tmp_path / "growth.svg").read_text()


def test_a_building_is_seen_again_and_a_street_is_not():
    first, *_, again = RenderedBuilding(floors=1, boxes=3, period=4, flicker=0.0).frames(48, 17)
    assert float((first.T_world_cam - again.T_world_cam)[:3, 3].abs().max()) < 1.0, "in the middle of the same room"
    rooms = [f.T_world_cam[:3, 3] for f in RenderedBuilding(floors=2, boxes=3, period=1).frames(16, 8)]
    assert int((torch.cdist(*[torch.stack(rooms)] * 2) > 2.0).sum()) == 8 * 7
    street = list(RenderedStreet().frames(48, 30))
    assert [round(float(f.T_world_cam[2, 3]), 9) for f in street] == [2.0 * i for i in range(30)]
    for frame in street:
        assert 1.0 < float(frame.depth[frame.depth > 0].min()) < float(frame.depth.max()) <= 1.2 * 60


def report_with(**changes):
    result = {
        "size": 224,
        "backend": "numba",
        "kernels": {"spgf": {"median_ms": 0.4}},
        "step": {"median_ms": 12.0},
        "memory": {"in_use": 20_000},
        "ratios": {"step/fastdepth": {"median": 0.4}, "step/resnet50": {"median": 0.02}},
    }
    return {"results": [result | changes.pop("result", {})], "long_run": None, "anchors": None, **changes}


def test_targets_are_told_as_met_or_missed():
    message = {row["name"]: (row["value"], row["met"]) for row in benchmark.targets(report_with())}
    assert message == {
        "spgf_ms": (0.4, True),
        "step_ms": (12.0, False),
        "step/fastdepth": (0.4, False),
        "step/resnet50": (0.02, True),
        "components_bytes": (20_000, True),
        "long_run_ratio": (None, None),
        "tracker_cpu_ms": (None, None),
    }
    long_run = {"ratio": 1.5, "memory": {"in_use": 50_000}}
    message = {row["name"]: row["met"] for row in benchmark.targets(report_with(long_run=long_run))}
    assert message["long_run_ratio"] is False
    assert message["components_bytes"] is False, "a room is what the long run has seen"
    assert benchmark.targets(report_with(result={"backend": "torch"}))[0]["met"] is None


@pytest.mark.parametrize(
    ("words", "told"),
    [
        (["--frames", "0"], "--frames"),
        (["--in-view", "0"], "--in-view"),
        (["--sizes", "8"], "--sizes"),
        (["--threads", "-2"], "threads"),
        (["--sequence", "nowhere"], "nowhere"),
        (["--weights", "nothing.onnx"], "nothing.onnx"),
        (["--merge", "-1"], "at least 0"),
        (["--max-components", "-1"], "at least 0"),
    ],
)
def test_arguments_that_do_not_fit(words, told, capsys):
    assert cli.main(["bench", *words, "--skip-compile"]) == 2
    assert told in capsys.readouterr().err


def test_a_busy_machine_is_mentioned():
    machine = {"cpu": "c", "cores": 2, "platform": "p"}
    report = dict.fromkeys(("compilation", "long_run", "anchors", "peer", "against", "device"))
    report |= {"hardware": machine, "load_average": {"before": 3.0, "after": None}, "settings": {"threads": 2}}
    report |= {"rates": {"bytes_per_second": 1e10, "flops_per_second": 1e11}, "versions": {}}
    report |= {"results": [], "growth": [], "targets": []}
    assert "the machine was busy" in format_report(report)
    assert "the machine was busy" not in format_report(report | {"load_average": {"before": 0.1, "after": 1.0}})

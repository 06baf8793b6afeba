"""The benchmark: its clocks, and a tiny run of ``ufmstar bench``."""

from __future__ import annotations

import json
import time

import cv2
import numba
import pytest
import torch
from layouts import write_tum
from onnx_files import small_network, write_fastdepth

from ufmstar_torch import cli
from ufmstar_torch.eval.bench.measure import Plan
from ufmstar_torch.eval.bench.overlap import time_overlap
from ufmstar_torch.eval.bench.timing import STAGES, StagedStep, paired_ratio, pinned_threads, spread
from ufmstar_torch.eval.commands.bench import main, read
from ufmstar_torch.eval.sequences import open_sequence

# ---- statistics and clocks ----


def test_spread_of_known_values():
    message = spread([5.0, 1.0, 2.0, 4.0, 3.0])
    assert message == {"median_ms": 3.0, "iqr_ms": 2.0, "q1_ms": 2.0, "q3_ms": 4.0, "min_ms": 1.0, "count": 5}
    assert spread([1.0, 2.0, 3.0, 4.0])["q1_ms"] == 1.75  # linear between the sorted values


def test_paired_ratio_cancels_a_common_slowdown():
    assert paired_ratio([1.0, 40.0, 3.0], [2.0, 80.0, 6.0]) == {"median": 0.5, "q1": 0.5, "q3": 0.5, "count": 3}


@pytest.fixture
def work(monkeypatch):
    """Advance the fake ``time.perf_counter`` by a number of seconds."""
    now = [0.0]
    monkeypatch.setattr(time, "perf_counter", lambda: now[0])

    def move(seconds):
        now[0] += seconds
        return seconds

    return move


def test_every_moment_belongs_to_the_stage_that_needs_it(work):
    class Module:
        observer = None

        def __call__(self, seconds):
            for number, name in enumerate(STAGES):
                work(seconds + 0.1 * number)
                self.observer.stage(name)
            return work(1000)  # the output's assembly

    module = Module()
    staged = StagedStep(module, module, clock=time.perf_counter)
    for seconds in (100, 1, 2, 3):
        staged(seconds)
    summary = staged.summary(warm_up=1)
    medians = {name: times["median_ms"] for name, times in summary["stages"].items()}
    assert medians == pytest.approx({name: 2000 + 100 * number for number, name in enumerate(STAGES)})
    assert summary["stages_total"]["median_ms"] == pytest.approx(sum(medians.values()))


def test_a_single_timed_frame_overlaps_nothing():
    sequence = open_sequence("tour:1?frames=2&size=48x64")
    assert time_overlap(None, sequence, device=torch.device("cpu"), plan=Plan(frames=1, warm_up=1)) is None


def threads():
    of_numba = numba.get_num_threads()  # the first call starts numba's threads, which may change torch's number
    return of_numba, torch.get_num_threads(), cv2.getNumThreads()


@pytest.mark.parametrize("fails", [False, True])
def test_threads_are_pinned_and_restored(fails):
    before = threads()
    try:
        with pinned_threads(1):
            assert threads() == (1, 1, 1)
            if fails:
                raise KeyError("anything")
    except KeyError:
        pass
    assert threads() == before


# ---- end to end ----


@pytest.fixture(scope="module")
def weights(tmp_path_factory):
    return str(write_fastdepth(tmp_path_factory.mktemp("net") / "net.onnx", small_network()))


def bench(path, weights, *words):
    """The report of a tiny run."""
    words = ["--model", "fastdepth", "--weights", weights, "--runtime", "torch", *words]
    words += ["--frames", "2", "--history", "2", "--threads", "1", "--json", str(path)]
    before = threads()
    assert main(read(words)) == 0
    assert threads() == before
    return json.loads(path.read_text())


def test_a_network_on_a_rendered_room(tmp_path, weights, capsys):
    report = bench(tmp_path / "bench.json", weights, "--sequence", "tour:1?frames=5&size=96x128")
    assert report["map"] == "224 x 224"
    assert set(report["machine"]["versions"]) >= {"ufmstar_torch", "torch", "numba", "numpy", "python"}
    assert set(report["machine"]["hardware"]) >= {"cpu", "cores", "platform", "environment"}
    rows = {row["row"].partition("-DepthOnly")[::2]: row for row in report["rows"]}
    plain, corners, posterior = (
        rows["UfM*", setting] for setting in ("", " (anchors corners)", " (anchors dense, posterior)")
    )
    assert len(rows) == 4, "UfM, and three rows of UfM*"
    for row in rows.values():
        assert row["latency"]["multiview"]["count"] == row["ratios_to_depth"]["multiview"]["count"] == 2
        assert row["latency"]["multiview"]["min_ms"] > 0
    assert report["networks"]["depth_only"]["latency"]["once"]["count"] == 2
    assert plain["stages"].keys() == {"stages", "stages_total", "beyond_the_paper"}
    assert 0 < plain["stages"]["beyond_the_paper"]["median"] < 1
    assert plain["sample"]["ratio_to_step"]["count"] == plain["sample"]["latency"]["count"] == 2
    sizes = [row["memory"]["multiview"]["bytes_end"] for row in (plain, corners, posterior)]
    assert sizes == sorted(sizes), "landmarks and the posterior add to the mixture's memory"
    overlapped = report["overlapped"]
    assert overlapped["latency"]["count"] == overlapped["ratio_to_network"]["count"] == 1, "nothing overlaps the last"
    printed = capsys.readouterr().out
    assert "UfM*-DepthOnly (anchors corners)" in printed
    assert "\nmedians of ratios within one frame; step: UfM* alone, default: with dense anchors" in printed
    ratios = report["ratios"]
    assert len(ratios) == 6
    for name, ratio in ratios.items():
        assert f"\n{name}: {ratio:.3f}\n" in printed
    assert ratios["step / network"] == plain["ratios_to_depth"]["multiview"]["median"]
    assert ratios["default / network"] == posterior["ratios_to_depth"]["multiview"]["median"]
    assert overlapped["ratio_to_network"]["median"] in ratios.values()


def test_on_a_recording(tmp_path, weights):
    path, _ = write_tum(tmp_path, frames=5)
    report = bench(tmp_path / "bench.json", weights, "--sequence", str(path))
    assert report["sequence"]["layout"] == "tum"
    assert cli.main(["bench", "--model", "fastdepth", "--weights", weights, "--sequence", "nowhere"]) == 2


def test_the_processor_s_time_needs_one_thread_on_the_cpu(weights):
    network = ["--model", "fastdepth", "--weights", weights, "--clock", "cpu"]
    assert read([*network, "--threads", "1"]).clock == "cpu"
    for wrong in (["--threads", "2"], [], ["--threads", "1", "--device", "cuda"]):
        with pytest.raises(ValueError, match="--clock cpu needs --threads 1"):
            read([*network, *wrong])

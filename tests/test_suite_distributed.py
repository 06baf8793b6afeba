"""An evaluation in several processes: of this computer and of a Dask cluster, with the same result bit for bit."""

from __future__ import annotations

import multiprocessing
import subprocess
import sys
import time
from pathlib import Path

import forked
import pytest
import torch
from process_parts import acting
from tiny_suite import NAMES, TRUTH, stored_results
from trainings import SPEC

from ufmstar_torch.eval.commands.evaluate import job_from, read
from ufmstar_torch.eval.run import machine
from ufmstar_torch.eval.suite.tasks import evaluate_suite, process_pool
from ufmstar_torch.models.spec import build_network
from ufmstar_torch.models.trained import save_trained

# ---- processes ----


@pytest.mark.slow
def test_one_process_and_two_give_the_same_bits(rooms, tmp_path):
    torch.manual_seed(3)
    save_trained(tmp_path / "net.safetensors", [build_network(SPEC) for _ in range(2)], SPEC)
    (tmp_path / "some.toml").write_text(
        '[[rows]]\nmethods = ["Ensemble", "UfM-Ensemble-100K", "UfM*-Ensemble"]\n'
        '[[rows]]\nmethods = ["UfM*-Ensemble"]\nsetting = {rotation_noise = 2.0, skip = 1}\n'
    )
    words = ["--suite", str(tmp_path / "some.toml"), "--network", f"ensemble=trained:{tmp_path / 'net.safetensors'}"]
    words += ["--root", f"rooms={rooms}", "--examples", "0", "--out"]
    one, two = (job_from(read([*words, str(tmp_path / name)])) for name in ("one", "two"))
    lines, shown = list[str](), []
    with process_pool(2) as pool:
        outcome = evaluate_suite(two, pool, threads=1, report=lines.append, progress=shown.append)
    assert (outcome.finished, outcome.stopped, dict(outcome.failed)) == (True, False, {})
    assert sorted(line.partition(":")[0] for line in lines) == [f"rooms/{name}" for name in NAMES]
    assert [(now.stage, now.done, now.total) for now in shown] == [("sequences", done, 3) for done in (1, 2, 3)]
    before = torch.get_num_threads()
    try:
        evaluate_suite(one, threads=1)
    finally:
        torch.set_num_threads(before)
    assert len(stored_results(one.out)) == 12
    assert stored_results(one.out) == stored_results(two.out)


def is_alive(number):
    try:
        return Path(f"/proc/{number}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except FileNotFoundError:
        return False


def at_work(folder):
    """The ids of the processes that have opened a sequence."""
    return {int(path.suffix[1:]) for path in folder.glob("*.[0-9]*")}


def in_two(words, stop=lambda: False):
    """Run an evaluation in two processes: whether it finished, and its output lines."""
    lines: list[str] = []
    with process_pool(2) as pool:
        return evaluate_suite(job_from(read(words)), pool, threads=1, stop=stop, report=lines.append).finished, lines


@pytest.mark.slow
def test_processes_end_in_good_order_by_a_stop_by_an_error_and_by_a_kill(tmp_path, monkeypatch):
    monkeypatch.setattr(multiprocessing, "get_context", lambda _: forked.CONTEXT)  # the other tests here spawn
    with pytest.raises(RuntimeError, match=r"d/c: TypeError: a mistake"):
        in_two(acting(tmp_path / "a", TRUTH, "go", "wait", "fail"))
    assert len(list(tmp_path.glob("a/out/records/*/*/DepthOnly.json"))) == 1, "finished records remain"
    finished, lines = in_two(acting(tmp_path / "b", TRUTH, "go", "wait", "kill"))
    assert (finished, lines[0].partition(":")[0]) == (False, "d/a")
    assert len(lines) == 2
    assert "processes were lost (killed for want of memory" in lines[1]
    assert "at one of d/b, d/c; finished rows remain" in lines[1]
    words = acting(tmp_path / "c", TRUTH, "wait", "wait", "go")
    assert in_two(words, stop=lambda: len(at_work(tmp_path / "c")) == 2) == (False, [])
    assert not any(is_alive(number) for folder in tmp_path.iterdir() for number in at_work(folder))


@pytest.mark.slow
@pytest.mark.skipif(sys.platform != "linux", reason="reads /proc")
def test_processes_end_with_a_parent_that_is_killed(tmp_path):
    words = [
        sys.executable,
        "-P",
        "-m",
        "ufmstar_torch.cli",
        "eval",
        *acting(tmp_path / "a", TRUTH, "wait", "wait"),
        "--processes",
        "2",
    ]
    parent = subprocess.Popen(words)
    try:
        while len(at_work(tmp_path / "a")) < 2:
            assert parent.poll() is None
            time.sleep(0.05)
    finally:
        parent.kill()
        parent.wait()
    while any(map(is_alive, at_work(tmp_path / "a"))):
        time.sleep(0.02)


def test_devices_go_round(monkeypatch):
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    monkeypatch.setattr(torch.cuda, "device_count", lambda: 2)
    monkeypatch.setattr(machine, "require_device", lambda name: name)
    assert [machine.device_of("cuda", number) for number in range(3)] == ["cuda:0", "cuda:1", "cuda:0"]
    assert machine.device_of("cuda:1", 0) == "cuda:1"

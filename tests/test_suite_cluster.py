"""``ufmstar eval --scheduler``: a Dask cluster of two workers, a killed worker, a lost scheduler."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import threading
import time
from contextlib import contextmanager
from pathlib import Path

import pytest
from process_parts import acting
from tiny_suite import TRUTH, job_on, stored_results

from ufmstar_torch.eval.commands.evaluate import job_from, read
from ufmstar_torch.eval.suite import tasks
from ufmstar_torch.eval.suite.tasks import dask_cluster, evaluate_suite

pytest.importorskip("distributed")
pytestmark = pytest.mark.slow


@contextmanager
def cluster(folder, threads="1"):
    """A scheduler and its workers in processes of their own: the address, and the scheduler's process."""
    file, running = folder / "scheduler.json", []
    quiet = {"DASK_LOGGING__DISTRIBUTED": "critical", **os.environ}

    def begin(kind, *words):
        command = [sys.executable, "-P", "-m", f"distributed.cli.{kind}", "--no-dashboard", "--scheduler-file", file]
        running.append(subprocess.Popen([*map(str, command), *words], env=quiet, stderr=subprocess.DEVNULL, cwd="/"))

    try:
        begin("dask_scheduler", "--port", "0", "--host", "127.0.0.1")
        until(file.exists)
        for _ in range(2):
            begin("dask_worker", "--no-nanny", "--nthreads", threads, "--death-timeout", "60")
        yield json.loads(file.read_text())["address"], running[0]
    finally:
        for process in running:
            process.kill()
            process.wait()


def until(condition):
    """Wait until a condition holds."""
    while not condition():
        time.sleep(0.05)


def workers_at(folder, name):
    """The ids of the processes that have opened a sequence."""
    return [int(path.suffix[1:]) for path in folder.glob(f"{name}.[0-9]*")]


def in_thread(job, address):
    """Evaluate in a thread: the thread, and a list that gets the outcome and the lines."""
    result, lines = [], []

    def work():
        with dask_cluster(address) as workers:
            result.append((evaluate_suite(job, workers, threads=1, report=lines.append), lines))

    thread = threading.Thread(target=work)
    thread.start()
    return thread, result


def test_two_workers_give_the_bits_of_one_process(rooms, tmp_path, monkeypatch):
    """Each has two threads and another working folder."""
    monkeypatch.chdir(tmp_path)
    alone, shared = job_on(rooms, tmp_path / "alone"), job_on(rooms, Path("shared"))
    shown = []
    with cluster(tmp_path, "2") as (address, _), dask_cluster(address) as workers:
        outcome = evaluate_suite(shared, workers, threads=1, progress=shown.append)
    assert (outcome.finished, outcome.stopped, dict(outcome.failed)) == (True, False, {})
    assert [(now.done, now.total) for now in shown] == [(1, 3), (2, 3), (3, 3)]
    evaluate_suite(alone)
    assert stored_results(shared.out) == stored_results(alone.out)
    assert len(stored_results(alone.out)) == 12
    assert not (shared.out / "eval.stop").exists()


def test_a_killed_worker_is_replaced_and_a_lost_scheduler_ends_the_evaluation(tmp_path, monkeypatch):
    """Finished records remain, and the same evaluation goes on without the cluster."""
    monkeypatch.setattr(tasks, "_CONNECT_SECONDS", 2)
    with cluster(tmp_path) as (address, scheduler):
        folder = tmp_path / "killed"
        thread, result = in_thread(job_from(read(acting(folder, TRUTH, "hold", "go", "go"))), address)
        until(lambda: workers_at(folder, "a"))
        os.kill(workers_at(folder, "a")[0], signal.SIGKILL)
        until(lambda: len(workers_at(folder, "a")) == 2)
        (folder / "release").touch()
        thread.join()
        outcome, lines = result[0]
        assert (outcome.finished, dict(outcome.failed)) == (True, {})
        assert sorted(line.partition(":")[0] for line in lines) == ["d/a", "d/b", "d/c"]
        folder = tmp_path / "lost"
        job = job_from(read(acting(folder, TRUTH, "go", "hold", "hold")))
        thread, result = in_thread(job, address)
        until(lambda: list(folder.glob("out/records/d/a/*.json")) and workers_at(folder, "b"))
        before = stored_results(job.out)
        scheduler.kill()
        thread.join()
    outcome, lines = result[0]
    assert not outcome.finished
    assert "processes were lost" in lines[-1]
    assert "d/b" in lines[-1]
    assert stored_results(job.out) == before != {}
    with pytest.raises(OSError, match="Timed out"), dask_cluster(address):
        pass
    (folder / "release").touch()
    assert evaluate_suite(job).finished
    assert len(stored_results(job.out)) == 3

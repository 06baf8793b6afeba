"""Several processes that share an evaluation: real ones, and the same result to the last bit."""

from __future__ import annotations

import multiprocessing
import os
import pickle
import subprocess
import sys
import threading
import time
from contextlib import nullcontext
from dataclasses import replace
from types import SimpleNamespace

import pytest
import torch
from suite_runs import NAMES, TRUTH, Stub, go, job_on, kept
from trainings import SPEC

from ufmstar_torch.eval.commands.eval_command import job_from, launch_from, read
from ufmstar_torch.eval.engine.evaluate import evaluate_sequence
from ufmstar_torch.eval.methods.suite import suite_named
from ufmstar_torch.eval.report.data import load_results
from ufmstar_torch.eval.results import launch
from ufmstar_torch.eval.results.eval_folder import EvalFolder
from ufmstar_torch.eval.results.launch import (
    ClusterTask,
    LaunchOptions,
    Rank,
    Slurm,
    evaluate_suite,
    run_processes,
    run_slurm,
    tasks_of,
)
from ufmstar_torch.eval.results.work import WorkerTask
from ufmstar_torch.eval.results.worklist import Shard
from ufmstar_torch.eval.run import machine
from ufmstar_torch.eval.run.folder import FolderError
from ufmstar_torch.models.spec import build_network
from ufmstar_torch.models.trained import save_trained


@pytest.fixture
def no_torchrun(monkeypatch):
    for name in ("RANK", "WORLD_SIZE", "LOCAL_RANK"):
        monkeypatch.delenv(name, raising=False)


def options_for(rooms, out, *words, network=TRUTH, suite="depth-only"):
    """Parsed options of an evaluation of the rooms."""
    fixed = ["--suite", suite, "--network", network, "--root", f"rooms={rooms}", "--out", str(out), "--examples", "0"]
    return read([*fixed, *words])


def quiet(options, evaluate=None, stop=lambda: False):
    """Carry the options out, in silence: the outcome and the lines that were reported."""
    lines: list[str] = []
    own = {} if evaluate is None else {"evaluate": evaluate}
    job, how = job_from(options), launch_from(options)
    outcome = evaluate_suite(job, how, stop=stop, report=lines.append, progress=lambda *_: None, **own)
    return outcome, lines


# ---- processes on this computer ----


@pytest.mark.slow
@pytest.mark.usefixtures("no_torchrun")
def test_one_process_and_two_give_the_same_bits(rooms, tmp_path):
    torch.manual_seed(3)
    save_trained(tmp_path / "net.safetensors", [build_network(SPEC) for _ in range(2)], SPEC)
    network = f"ensemble=trained:{tmp_path / 'net.safetensors'}"
    (tmp_path / "some.toml").write_text(
        '[[rows]]\nmethods = ["Ensemble", "UfM-Ensemble-100K", "UfM*-Ensemble"]\n'
        '[[rows]]\nmethods = ["UfM*-Ensemble"]\nsetting = {rotation_noise = 2.0, skip = 1}\n'
    )
    given = {"network": network, "suite": str(tmp_path / "some.toml")}
    before = torch.get_num_threads()
    ended, message = quiet(options_for(rooms, tmp_path / "two", "--processes", "2", "--threads", "1", **given))
    assert (ended.finished, ended.stopped, dict(ended.failed)) == (True, False, {}), message
    try:
        torch.set_num_threads(1)
        quiet(options_for(rooms, tmp_path / "one", **given))
    finally:
        torch.set_num_threads(before)
    one, two = kept(tmp_path / "one"), kept(tmp_path / "two")
    assert len(one) == 12
    assert one == two
    both = [load_results(tmp_path / name).merged for name in ("one", "two")]
    assert both[0].keys() == both[1].keys()
    assert all(str(both[0][key]) == str(both[1][key]) for key in both[0])


SCRIPT = """
import os, pickle, signal, sys, time
task = pickle.load(sys.stdin.buffer)
folder = task.job.out
signal.signal(signal.SIGTERM, lambda *_: (open(f"{folder}/ended{task.shard.index}", "w").close(), sys.exit(130)))
number = task.shard.index
open(f"{folder}/started{number}", "w").write(str(os.getpid()))
os.rename(f"{folder}/started{number}", f"{folder}/pid{number}")
while True:
    time.sleep(0.02)
"""


def scripted(tmp_path, text, stop, count=3):
    """Processes that run a script: whether all came to their end, and the lines that were reported."""
    lines: list[str] = []
    tasks = [WorkerTask(SimpleNamespace(out=tmp_path), Shard(n + 1, count), n, threads=1) for n in range(count)]
    return run_processes(tasks, stop=stop, report=lines.append, command=(sys.executable, "-c", text)), lines


@pytest.mark.slow
def test_a_pool_that_is_stopped_tells_all_its_processes(tmp_path):
    ended, message = scripted(tmp_path, SCRIPT, lambda: len(list(tmp_path.glob("pid*"))) == 3)
    assert not ended
    assert message == []
    assert {path.name for path in tmp_path.glob("ended*")} == {"ended1", "ended2", "ended3"}


@pytest.mark.slow
def test_a_pool_whose_starter_fails_leaves_no_process(tmp_path):
    def interrupted():
        if len(list(tmp_path.glob("pid*"))) == 3:
            raise KeyboardInterrupt
        return False

    with pytest.raises(KeyboardInterrupt):
        scripted(tmp_path, SCRIPT, interrupted)
    for file in tmp_path.glob("pid*"):
        with pytest.raises(ProcessLookupError):
            os.kill(int(file.read_text()), 0)


@pytest.mark.slow
def test_a_pool_tells_of_a_process_that_was_killed_and_lets_the_others_finish(tmp_path):
    text = "import os, pickle, sys\nif pickle.load(sys.stdin.buffer).shard.index == 2: os.kill(os.getpid(), 9)"
    assert scripted(tmp_path, text, lambda: False) == (False, ["process 2/3 ended early (signal 9)"])
    assert scripted(tmp_path, "import sys; sys.stdin.buffer.read()", lambda: False) == (True, [])


def test_threads_are_divided_and_devices_go_round(rooms, tmp_path, monkeypatch):
    monkeypatch.setattr(launch, "available_cores", lambda: 7)
    tasks = tasks_of(job_on(rooms, tmp_path), LaunchOptions(processes=3))
    assert [(str(t.shard), t.local, t.threads) for t in tasks] == [("1/3", 0, 2), ("2/3", 1, 2), ("3/3", 2, 2)]
    assert len({t.launch for t in tasks}) == 1
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    monkeypatch.setattr(torch.cuda, "device_count", lambda: 2)
    monkeypatch.setattr(machine, "require_device", lambda name: name)
    assert [machine.device_of("cuda", t.local) for t in tasks] == ["cuda:0", "cuda:1", "cuda:0"]
    assert machine.device_of("cuda:1", 0) == "cuda:1"


def test_a_job_is_the_same_in_another_process(rooms, tmp_path):
    words = ["--frames", "1::2", "--cache", str(tmp_path / "cache"), "--depth-scale", "0.5", "--samples", "3"]
    job = job_from(options_for(rooms, tmp_path / "out", *words, suite="ablation-anchors"))
    again = pickle.loads(pickle.dumps(job))
    assert again == job
    assert [item.opening for item in again.items] == [item.opening for item in job.items]
    assert [row.setting.to_dict() for row in again.suite.rows] == [row.setting.to_dict() for row in job.suite.rows]


def test_a_device_that_is_not_there():
    with pytest.raises(ValueError, match="--device abacus is not available"):
        machine.device_of("abacus", 0)


# ---- torchrun ----


def as_rank(rank, world, options, result):
    """One of torchrun's processes, judging by a stub that takes its time."""
    os.environ |= {"RANK": str(rank), "WORLD_SIZE": str(world), "LOCAL_RANK": str(rank)}
    stub = Stub(lambda *_: time.sleep(0.02))
    ended, _ = quiet(options, stub)
    result.put((rank, ended.finished, ended.reports, [name for name, _ in stub.asked]))


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:This process:DeprecationWarning")  # of forks, from Python 3.12 on
def test_torchruns_processes_share_the_work_and_the_first_waits_for_the_rest(rooms, tmp_path):
    options = options_for(rooms, tmp_path / "out")
    fork = multiprocessing.get_context("fork")
    results = fork.Queue()
    children = [fork.Process(target=as_rank, args=(rank, 2, options, results)) for rank in range(2)]
    for child in children:
        child.start()
    result = sorted(results.get(timeout=60) for _ in children)
    for child in children:
        child.join(60)
    assert [rank[:2] for rank in result] == [(0, True), (1, True)]
    assert [rank[2] for rank in result] == [True, False]
    assert sorted(result[0][3] + result[1][3]) == list(NAMES)
    go(job_on(rooms, tmp_path / "whole", suite=suite_named("depth-only")))
    assert kept(tmp_path / "out") == kept(tmp_path / "whole")


def test_ranks_of_torchrun():
    variables = {"RANK": "3", "WORLD_SIZE": "4", "LOCAL_RANK": "1"}
    assert Rank.of(variables) == Rank(3, 4, 1)
    assert Rank.of({}) is None
    assert Rank.of({"WORLD_SIZE": "4"}) is None
    assert Rank.of({**variables, "RANK": "0", "WORLD_SIZE": "1"}) is None
    with pytest.raises(ValueError, match="must be numbers"):
        Rank.of({**variables, "RANK": "first"})
    with pytest.raises(ValueError, match="RANK 4 must be in"):
        Rank.of({**variables, "RANK": "4"})


@pytest.mark.parametrize("words", [["--shard", "1/2"], ["--processes", "2"], ["--overwrite"], ["--slurm", "jobs=2"]])
def test_what_contradicts_torchrun(rooms, tmp_path, monkeypatch, words):
    for name, value in {"RANK": "0", "WORLD_SIZE": "2", "LOCAL_RANK": "0"}.items():
        monkeypatch.setenv(name, value)
    with pytest.raises(ValueError, match=f"{words[0]} goes without torchrun"):
        quiet(options_for(rooms, tmp_path / "out", *words))
    assert not (tmp_path / "out").exists()


def test_the_first_waits_for_a_sequence_that_another_is_at(rooms, tmp_path):
    job = job_on(rooms, tmp_path / "out")
    go(replace(job, items=job.items[1:]))
    claim, stub = EvalFolder(job.out).claim(job.items[0], "other"), Stub()
    waiter = threading.Thread(target=go, args=(job, stub), kwargs={"resume": True, "waits": True})
    waiter.start()
    time.sleep(0.5)
    assert waiter.is_alive()
    assert stub.asked == []
    claim.release()
    waiter.join(30)
    assert [name for name, _ in stub.asked] == ["ash"]


# ---- parts by hand ----


@pytest.mark.usefixtures("no_torchrun")
def test_parts_may_begin_in_any_order_and_share_a_folder(rooms, tmp_path):
    ends = []
    for part in ("2/2", "1/2"):
        ended, _ = quiet(options_for(rooms, tmp_path / "out", "--shard", part), Stub())
        ends.append((ended.finished, len(list((tmp_path / "out" / "records").glob("*/*")))))
    assert ends == [(True, 1), (True, 3)]
    go(job_on(rooms, tmp_path / "whole", suite=suite_named("depth-only")))
    assert kept(tmp_path / "out") == kept(tmp_path / "whole")
    with pytest.raises(FolderError, match=r"other input: settings\.confident was 0\.5"):
        quiet(options_for(rooms, tmp_path / "out", "--shard", "1/2", "--confident", "0.1"), Stub())


# ---- SLURM ----


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:unclosed file:ResourceWarning")  # submitit's debug executor leaves its logs open
@pytest.mark.usefixtures("no_torchrun")
def test_jobs_through_submitit(rooms, tmp_path):
    # submitit's debug executor runs a job here, when its result is asked for.
    options = options_for(
        rooms, tmp_path / "out", "--slurm", "cluster=debug", "jobs=2", "partition=gpu", "timeout_min=5"
    )
    ended, message = quiet(options)
    assert ended.finished
    assert message[0].startswith("jobs ")
    go(job_on(rooms, tmp_path / "whole", suite=suite_named("depth-only")), evaluate_sequence)
    assert kept(tmp_path / "out") == kept(tmp_path / "whole")


def test_what_slurm_is_told():
    slurm_ = Slurm.parse(["jobs=4", "partition=gpu", "mem_gb=16", "slurm_qos=high", "gres=gpu:1"])
    assert (slurm_.jobs, slurm_.cluster) == (4, "slurm")
    assert dict(slurm_.parameters) == {
        "slurm_partition": "gpu", "mem_gb": 16, "slurm_qos": "high", "slurm_gres": "gpu:1"
    }  # fmt: skip
    for words, message in (
        (["gpu"], "KEY=VALUE"),
        (["a=1", "a=2"], "each key once"),
        (["jobs=0"], "at least 1"),
        (["jobs=many"], "at least 1"),
        (["cluster=moon"], "slurm, local or debug"),
        (["nodes=2"], "jobs=N sets their number"),
    ):
        with pytest.raises(ValueError, match=message):
            Slurm.parse(words)


def test_a_job_is_queued_again_with_the_same_task():
    job = ClusterTask(WorkerTask(SimpleNamespace(out="x"), Shard(1, 2)))
    again = job.checkpoint()
    assert again.function == job


class Submitted:
    """submitit with a cluster on which jobs end as they are meant to, in their order; None = never."""

    def __init__(self, *ends):
        self.ends, self.cancelled = list(ends), []

    def AutoExecutor(self, folder, cluster):
        return self

    def update_parameters(self, **_):
        pass

    def batch(self):
        return nullcontext()

    def submit(self, task):
        end, number = self.ends.pop(0), task.task.shard.index
        return SimpleNamespace(
            job_id=str(number),
            done=lambda: end is not None,
            exception=lambda: end if isinstance(end, Exception) else None,
            result=lambda: end,
            cancel=lambda: self.cancelled.append(number),
        )


@pytest.mark.parametrize(
    ("ends", "stops", "finished", "failed", "cancelled"),
    [
        ([True, True], False, True, [], []),
        ([True, False], False, False, [], []),
        ([RuntimeError("node died"), True], False, False, ["job 1 failed: node died"], []),
        ([None, None], True, False, [], [1, 2]),
    ],
)
def test_jobs_that_fail_are_reported_and_stopping_cancels_all(
    tmp_path, monkeypatch, ends, stops, finished, failed, cancelled
):
    cluster, lines = Submitted(*ends), []
    monkeypatch.setitem(sys.modules, "submitit", cluster)
    tasks = [WorkerTask(SimpleNamespace(out=tmp_path), Shard(n + 1, 2)) for n in range(2)]
    assert run_slurm(Slurm.parse(["jobs=2"]), tasks, stop=lambda: stops, report=lines.append) == finished
    assert lines == [f"jobs 1, 2; their output is in {tmp_path}/slurm", *failed]
    assert cluster.cancelled == cancelled


@pytest.mark.usefixtures("no_torchrun")
def test_without_submitit_the_error_names_what_to_install(rooms, tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "submitit", None)
    with pytest.raises(ImportError, match=r"pip install 'ufmstar-torch\[cluster\]'"):
        quiet(options_for(rooms, tmp_path / "out", "--slurm", "jobs=2"))


# ---- one process of several ----


@pytest.mark.slow
def test_a_worker_reads_its_task_and_its_code_is_how_it_ended(rooms, tmp_path):
    def run(out, debug=False, **changes):
        task = pickle.dumps(
            WorkerTask(job_on(rooms, out, **changes), Shard(1, 2), helps=True, launch="abc", threads=1, debug=debug)
        )
        ended = subprocess.run(launch.WORKER, input=task, capture_output=True, check=False)
        return ended.returncode, ended.stderr.decode()

    code, text = run(tmp_path / "out")
    assert code == launch.DONE, text
    assert "[1/2] rooms/ash: 4 rows, 4 frames" in text
    assert len(kept(tmp_path / "out")) == 12
    (tmp_path / "home").mkdir()
    (tmp_path / "home" / "thesis.tex").write_text("x")
    code, text = run(tmp_path / "home")
    assert code == launch.FAILED
    assert text.startswith("[1/2] failed: --out")
    assert "Traceback" in run(tmp_path / "home", debug=True)[1]


@pytest.mark.usefixtures("no_torchrun")
def test_the_folder_is_prepared_before_any_process_starts(rooms, tmp_path, monkeypatch):
    monkeypatch.setattr(subprocess, "Popen", lambda *_, **__: pytest.fail("no process may start"))
    out = tmp_path / "out"
    out.mkdir()
    (out / "thesis.tex").write_text("x")
    with pytest.raises(FolderError, match="files of someone else"):
        quiet(options_for(rooms, out, "--processes", "2"))

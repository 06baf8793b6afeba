"""An evaluation divided into shards and processes: real ones, and the same result to the last bit."""

from __future__ import annotations

import multiprocessing
import os
import subprocess
import sys
import threading
import time
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import pytest
import torch
from pool_tasks import pool
from tiny_suite import NAMES, Stub, go, job_on, kept
from trainings import SPEC

from ufmstar_torch.eval.commands.evaluate import job_from, read
from ufmstar_torch.eval.commands.terminal import warned_once
from ufmstar_torch.eval.engine.evaluate import evaluate_sequence
from ufmstar_torch.eval.run import machine
from ufmstar_torch.eval.run.folder import FolderError
from ufmstar_torch.eval.suite.shards import KILLED, Slurm, evaluate_on_slurm, evaluate_suite, rank_of
from ufmstar_torch.eval.suite.work_items import Shard
from ufmstar_torch.models.spec import build_network
from ufmstar_torch.models.trained import save_trained

TORCHRUN = {"RANK": "3", "WORLD_SIZE": "4", "LOCAL_RANK": "1"}


@pytest.fixture
def whole(rooms, tmp_path):
    """The records that one undisturbed process leaves, from the real judge."""
    go(job_on(rooms, tmp_path / "whole"), evaluate_sequence)
    return kept(tmp_path / "whole")


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
    lines: list[str] = []
    outcome = evaluate_suite(two, shard=Shard(), processes=2, threads=1, report=lines.append)
    assert (outcome.finished, outcome.stopped, outcome.complete, dict(outcome.failed)) == (True, False, True, {}), lines
    assert sorted(line.partition(":")[0] for line in lines) == [f"rooms/{name}" for name in NAMES]
    before = torch.get_num_threads()
    try:
        evaluate_suite(one, shard=Shard(), threads=1)
    finally:
        torch.set_num_threads(before)
    assert len(kept(one.out)) == 12
    assert kept(one.out) == kept(two.out)


def at_work(folder):
    """The numbers of the processes that have begun to wait."""
    return [int(path.name.rpartition("-")[2]) for path in folder.glob("wait*-*")]


def is_alive(number):
    try:
        return Path(f"/proc/{number}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except FileNotFoundError:
        return False


def all_end(numbers):
    """Return True if the processes end within seconds."""
    for _ in range(500):
        if not any(is_alive(number) for number in numbers):
            return True
        time.sleep(0.02)
    return False


def test_the_parent_logs_what_its_processes_warn_of(tmp_path, caplog):
    with warned_once():
        assert pool(tmp_path, ["warn1", "warn2", "warn3"])[0]
    assert [text[10:] for text in caplog.messages] == ["hardly a segment matches"], "once"


@pytest.mark.slow
def test_a_pool_ends_in_good_order_by_a_stop_by_an_error_and_by_a_kill(tmp_path):
    finished, lines = pool(tmp_path, ["a", "b", "c"])
    assert (finished, sorted(lines)) == (True, ["a done", "b done", "c done"])
    with pytest.raises(OSError, match="disk full"):
        pool(tmp_path, ["fail", "wait1"])
    assert pool(tmp_path, ["kill", "wait2"]) == (False, [KILLED])
    assert pool(tmp_path, ["wait3", "wait4"], lambda: len(list(tmp_path.glob("wait[34]-*"))) == 2) == (False, [])
    assert all_end(at_work(tmp_path))


@pytest.mark.slow
def test_a_process_that_is_killed_while_it_logs_does_not_hold_up_the_pool(tmp_path):
    ended: list[object] = []
    thread = threading.Thread(target=lambda: ended.append(pool(tmp_path, ["half", "wait2"])), daemon=True)
    thread.start()
    thread.join(60)
    assert ended == [(False, [KILLED])]


@pytest.mark.slow
def test_processes_end_with_a_parent_that_is_killed(tmp_path):
    code = f"from pool_tasks import pool; pool({str(tmp_path)!r}, ['wait1', 'wait2'])"
    parent = subprocess.Popen(
        [sys.executable, "-c", code], env={**os.environ, "PYTHONPATH": str(Path(__file__).parent)}
    )
    try:
        while len(at_work(tmp_path)) < 2:
            assert parent.poll() is None
            time.sleep(0.05)
    finally:
        parent.kill()
        parent.wait()
    assert all_end(at_work(tmp_path))


def test_devices_go_round(monkeypatch):
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    monkeypatch.setattr(torch.cuda, "device_count", lambda: 2)
    monkeypatch.setattr(machine, "require_device", lambda name: name)
    assert [machine.device_of("cuda", number) for number in range(3)] == ["cuda:0", "cuda:1", "cuda:0"]
    assert machine.device_of("cuda:1", 0) == "cuda:1"


# ---- shards ----


def test_shards_may_begin_in_any_order_and_share_a_folder(rooms, tmp_path, whole):
    job = job_on(rooms, tmp_path / "out")
    outcomes = [go(job, evaluate_sequence, shard=Shard(number, 2))[0] for number in (2, 1)]
    assert [(outcome.finished, outcome.complete) for outcome in outcomes] == [(True, False), (True, True)]
    assert kept(job.out) == whole
    with pytest.raises(FolderError, match=r"other input: settings\.bins was null"):
        go(replace(job, bins="authors"), shard=Shard(1, 2))
    with pytest.raises(ValueError, match="--overwrite goes without shards"):
        go(job, shard=Shard(1, 2), overwrite=True)
    assert kept(job.out) == whole


def as_rank(rank, job, result):
    """One of torchrun's processes."""
    os.environ |= {"RANK": str(rank), "WORLD_SIZE": "2", "LOCAL_RANK": str(rank)}
    stub = Stub(lambda *_: time.sleep(0.02))
    outcome, _ = go(job, stub, shard=None)
    result.put((outcome.finished, [name for name, _ in stub.asked]))


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:This process:DeprecationWarning")  # of forks, from Python 3.12 on
def test_torchruns_processes_are_shards(rooms, tmp_path):
    fork = multiprocessing.get_context("fork")
    results, job = fork.Queue(), job_on(rooms, tmp_path / "out")
    children = [fork.Process(target=as_rank, args=(rank, job, results)) for rank in range(2)]
    for child in children:
        child.start()
    assert sorted(results.get(timeout=60) for _ in children) == [(True, ["ash", "cedar"]), (True, ["birch"])]
    for child in children:
        child.join(60)
    go(job_on(rooms, tmp_path / "stubbed"))
    assert kept(job.out) == kept(tmp_path / "stubbed")


def test_ranks_of_torchrun():
    assert rank_of(TORCHRUN) == (Shard(4, 4), 1)
    alone = {**TORCHRUN, "RANK": "0", "WORLD_SIZE": "1", "LOCAL_RANK": "0"}
    assert rank_of({}) == rank_of({"WORLD_SIZE": "4"}) == rank_of(alone) == (Shard(), 0)


# ---- SLURM ----


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:unclosed file:ResourceWarning")  # submitit's debug executor leaves its logs open
def test_jobs_through_submitit(rooms, tmp_path, whole):
    # submitit's debug executor runs a job here, when its result is asked for.
    slurm, lines = Slurm.parse(["cluster=debug", "jobs=2", "partition=gpu", "timeout_min=5"]), []
    outcome = evaluate_on_slurm(job_on(rooms, tmp_path / "out"), slurm, stop=lambda: False, report=lines.append)
    assert (outcome.finished, outcome.complete) == (True, True)
    assert lines[0].startswith("jobs ")
    assert kept(tmp_path / "out") == whole


def test_words_of_slurm():
    slurm = Slurm.parse(["jobs=4", "partition=gpu", "mem_gb=16", "slurm_qos=high", "gres=gpu:1"])
    assert (slurm.jobs, slurm.cluster) == (4, "slurm")
    assert dict(slurm.parameters) == {
        "slurm_partition": "gpu", "mem_gb": 16, "slurm_qos": "high", "slurm_gres": "gpu:1"
    }  # fmt: skip


class Submitted:
    """submitit with a cluster on which jobs end as they are meant to, in their order; None = never."""

    def __init__(self, *ends):
        self.ends, self.cancelled = list(ends), []

    def AutoExecutor(self, folder, cluster):
        return self

    def update_parameters(self, **_):
        pass

    def map_array(self, task, shards):
        return [self.job(shard.index, end) for shard, end in zip(shards, self.ends, strict=True)]

    def job(self, number, end):
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
    rooms, tmp_path, monkeypatch, ends, stops, finished, failed, cancelled
):
    cluster, lines, job = Submitted(*ends), [], job_on(rooms, tmp_path)
    monkeypatch.setitem(sys.modules, "submitit", cluster)
    outcome = evaluate_on_slurm(job, Slurm.parse(["jobs=2"]), stop=lambda: stops, report=lines.append)
    assert (outcome.finished, outcome.stopped, outcome.complete) == (finished, stops, False)
    assert lines == [f"jobs 1, 2; their output is in {tmp_path}/slurm", *failed]
    assert cluster.cancelled == cancelled

"""Several processes train as one: the same global batch gives the same losses and the same weights."""

from __future__ import annotations

import os
import socket
import subprocess
import sys
import time
from dataclasses import replace

import pytest
import torch
from forked import start
from trainings import RECIPE, logged, tiny_job, trained, with_network

from ufmstar_torch.train.fit import fit
from ufmstar_torch.train.member import make_data

# Sums depend on the number of threads, and the compared processes have one.
pytestmark = pytest.mark.usefixtures("one_thread")

# Without batch norm, whose statistics would differ between the processes' parts of the batch.
PLAIN = replace(with_network(RECIPE, norm=False), epochs=1, learning_rate=0.002, clip=0.0)


def command(job):
    """The command line of a job on two processes."""
    r, n = job.recipe, job.recipe.network
    words = ["--preset", "fastdepth-aleatoric", "--data", "sequences", "--root", *job.data.paths]
    words += ["--out", str(job.settings.out)]
    settings = {"data.part": job.data.part, "data.validation_part": job.data.validation_part}
    settings |= {"network.widths": n.widths, "network.norm": "false", "network.positive": n.positive}
    settings |= {"network.dropout": n.dropout, "network.size": list(n.size), "network.preprocess": n.preprocess}
    settings |= {"average": r.average, "clip": r.clip, "warmup_steps": r.warmup_steps}
    settings |= {"session.log_every": 1, "session.strategy": "ddp"}
    words += [f"--set={name}={value}" for name, value in settings.items()]
    for name in ("epochs", "batch_size", "learning_rate"):
        words += [f"--{name.replace('_', '-')}", str(getattr(r, name))]
    words += ["--no-progress", "--no-tensorboard", "--accelerator", "cpu", "--no-augmentation"]
    return [sys.executable, "-m", "ufmstar_torch.cli", "train", *words, "--devices", "2"]


def job_of(frames, out, **settings):
    """Without augmentation, which every process draws for itself."""
    return tiny_job(frames, out, PLAIN, augment=False, **settings)


def losses(out):
    return logged(out, "train_loss_step")


@pytest.fixture(scope="module")
def alone(frames, tmp_path_factory):
    """The folder of a training by one process. Tests must not change it."""
    out = tmp_path_factory.mktemp("alone") / "one"
    fit(job_of(frames, out))
    return out


@pytest.mark.slow
def test_two_processes_give_the_losses_of_one(frames, alone, tmp_path):
    job = job_of(frames, tmp_path / "two")
    environment = {**os.environ, "OMP_NUM_THREADS": "1"}
    done = subprocess.run(
        [*command(job), "--debug"], capture_output=True, text=True, env=environment, cwd=tmp_path, check=False
    )
    assert done.returncode == 0, done.stdout + done.stderr
    assert len(losses(tmp_path / "two")) == 3
    assert losses(tmp_path / "two") == pytest.approx(losses(alone), abs=1e-6)
    mine, theirs = (trained(job_of(frames, out)).state_dict() for out in (tmp_path / "two", alone))
    for name, value in theirs.items():
        torch.testing.assert_close(mine[name], value, atol=2e-5, rtol=0, msg=name)
    for name in ("train_loss_epoch", "val_nll", "val_nll_constant", "val_rmse", "val_delta1"):
        assert logged(tmp_path / "two", name) == pytest.approx(logged(alone, name), abs=2e-4), name


def _train(job):
    fit(job, overwrite=True)


def free_port():
    with socket.socket() as s:
        s.bind(("127.0.0.1", 0))
        return s.getsockname()[1]


def train_as_two(job, launch):
    """Train in the job's folder, as two externally started processes; the second starts two seconds before the
    first."""
    environment = {"MASTER_ADDR": "127.0.0.1", "MASTER_PORT": str(free_port())}
    processes = [start(_train, job, **launch(1), **environment)]
    try:
        time.sleep(2)
        processes.append(start(_train, job, **launch(0), **environment))
        for process in reversed(processes):
            process.join()
        assert [process.exitcode for process in processes] == [0, 0]
    finally:
        for process in processes:
            process.kill()


def as_torchrun(rank):
    return {"TORCHELASTIC_RUN_ID": "none", "WORLD_SIZE": "2", "RANK": str(rank), "LOCAL_RANK": str(rank)}


def as_two_computers(rank):
    return {"NODE_RANK": str(rank)}


@pytest.mark.slow
@pytest.mark.parametrize(
    ("launch", "settings"), [(as_torchrun, {"devices": 2}), (as_two_computers, {"devices": 1, "nodes": 2})]
)
def test_the_second_process_may_come_first(frames, alone, tmp_path, launch, settings):
    """It must not read an earlier training's files."""
    out = tmp_path / "out"
    fit(tiny_job(frames, out, replace(PLAIN, max_steps=2, learning_rate=0.1), augment=False))
    train_as_two(job_of(frames, out, strategy="ddp", **settings), launch)
    assert losses(out) == pytest.approx(losses(alone), abs=1e-6)


@pytest.mark.slow
def test_one_validation_frame_for_two_processes(frames, tmp_path):
    """With batch norm, whose statistics DistributedDataParallel broadcasts in the first validation batch."""
    recipe = replace(with_network(PLAIN, norm=True), max_steps=2)
    job = tiny_job(frames, tmp_path / "out", recipe, strategy="ddp", devices=2)
    train_as_two(replace(job, data=replace(job.data, validation_part="12:13")), as_torchrun)
    assert logged(tmp_path / "out", "val_rmse")[-1] > 0


@pytest.mark.slow
def test_the_processes_above_had_unequal_numbers_of_valid_pixels(frames, tmp_path):
    """Otherwise the mean of the processes' means would pass as well."""
    data = make_data(job_of(frames, tmp_path), 0, 1)
    counts = [(batch["depth"] > 0).flatten(1).sum(1) for batch in data.train_dataloader()]
    assert max(abs(int(c[::2].sum() - c[1::2].sum())) / int(c.sum()) for c in counts) > 0.03


def test_a_batch_that_cannot_be_divided_is_refused(frames, tmp_path):
    with pytest.raises(ValueError, match="batch_size 4 must be a multiple of the 3 processes"):
        make_data(tiny_job(frames, tmp_path, PLAIN), 0, 3)

"""Several processes train as one: the same global batch gives the same losses and the same weights."""

from __future__ import annotations

import os
import subprocess
import sys
from dataclasses import replace

import pytest
import torch
from trainings import RECIPE, tiny_job, with_network, write_frames

from ufmstar_torch.models.checkpoints import read_safetensors
from ufmstar_torch.train.ensemble import share_of_time
from ufmstar_torch.train.fit import fit
from ufmstar_torch.train.history import METRICS, STEPS, read_rows
from ufmstar_torch.train.member import WEIGHTS, make_data
from ufmstar_torch.train.settings import FitSettings

# Without batch norm, whose statistics are those of each process's own part of the batch.
PLAIN = replace(with_network(RECIPE, norm=False), epochs=1, learning_rate=0.002, clip=0.0)


@pytest.fixture(scope="module")
def frames(tmp_path_factory):
    """A sequence. Nobody may change it."""
    return write_frames(tmp_path_factory.mktemp("frames") / "walk")


def command(job):
    """The command line that means a job on two processes."""
    r, n = job.recipe, job.recipe.network
    words = ["--preset", "fastdepth-aleatoric", "--data", "sequences", "--root", *job.data.paths]
    words += ["--part", job.data.part, "--validation-part", job.data.validation_part, "--out", str(job.settings.out)]
    words += ["--network.widths", str(n.widths), "--network.norm", "false", "--network.positive", n.positive]
    words += ["--network.dropout", str(n.dropout)]
    words += ["--network.size", str(list(n.size)), "--network.preprocess", n.preprocess]
    for name in ("epochs", "batch_size", "learning_rate", "average", "clip", "warmup_steps"):
        words += [f"--{name.replace('_', '-')}", str(getattr(r, name))]
    words += ["--log-every", "1", "--examples", "0", "--no-progress", "--no-tensorboard", "--accelerator", "cpu"]
    return [sys.executable, "-m", "ufmstar_torch.cli", "train", *words, "--devices", "2", "--strategy", "ddp"]


def losses(out):
    return [float(row["train_loss"]) for row in read_rows(out / "member_0" / STEPS)]


def test_two_processes_give_the_losses_of_one(frames, tmp_path):
    fit(tiny_job(frames, tmp_path / "one", PLAIN))
    job = tiny_job(frames, tmp_path / "two", PLAIN)
    environment = {**os.environ, "OMP_NUM_THREADS": "1"}
    done = subprocess.run(
        [*command(job), "--debug"], capture_output=True, text=True, timeout=250, env=environment, cwd=tmp_path
    )
    assert done.returncode == 0, done.stdout + done.stderr
    assert len(losses(tmp_path / "two")) == 3
    assert losses(tmp_path / "two") == pytest.approx(losses(tmp_path / "one"), abs=1e-6)
    mine, theirs = (read_safetensors(tmp_path / name / "member_0" / WEIGHTS)[0] for name in ("two", "one"))
    for name, value in theirs.items():
        torch.testing.assert_close(mine[name], value, atol=2e-5, rtol=0, msg=name)
    validations = [read_rows(tmp_path / name / "member_0" / METRICS)[-1] for name in ("two", "one")]
    for name in ("train_loss", "val_nll", "val_nll_constant", "val_nll_constant_best", "val_rmse", "val_delta1"):
        assert float(validations[0][name]) == pytest.approx(float(validations[1][name]), abs=2e-4), name


def test_the_processes_above_had_unequal_numbers_of_valid_pixels(frames, tmp_path):
    """Otherwise a mean of the processes' means would pass as well."""
    data = make_data(tiny_job(frames, tmp_path, PLAIN), 0, 1)
    counts = [batch["valid"].flatten(1).sum(1) for batch in data.train_dataloader()]
    assert max(abs(int(c[::2].sum() - c[1::2].sum())) / int(c.sum()) for c in counts) > 0.03


def test_a_batch_that_cannot_be_divided_is_refused(frames, tmp_path):
    with pytest.raises(ValueError, match="batch_size 4 must be a multiple of the 3 processes"):
        make_data(tiny_job(frames, tmp_path, PLAIN), 0, 3)


def test_settings_that_cannot_be(tmp_path):
    for values, told in [
        ({"strategy": "ddp_spawn"}, "'ddp', not 'ddp_spawn'"),
        ({"member_processes": 2, "devices": 2}, "goes with devices = 1"),
        ({"checkpoint_every": -1}, "checkpoint_every must be at least 0"),
        ({"max_minutes": float("nan")}, "max_minutes must be at least 0"),
    ]:
        with pytest.raises(ValueError, match=told):
            FitSettings(out=tmp_path, **values)


def test_members_side_by_side_are_those_of_one_after_another(frames, tmp_path):
    recipe = replace(RECIPE, members=2, max_steps=2)
    fit(tiny_job(frames, tmp_path / "one", recipe))
    summary = fit(tiny_job(frames, tmp_path / "two", recipe, member_processes=2))
    assert [m["finished"] for m in summary["members"]] == [True, True]
    mine, theirs = (read_safetensors(tmp_path / name / WEIGHTS)[0] for name in ("two", "one"))
    assert mine.keys() == theirs.keys()
    assert all(torch.equal(mine[name], theirs[name]) for name in theirs)


def test_time_is_divided_evenly():
    import time

    now = time.monotonic()
    assert share_of_time(None, 3) is None
    assert share_of_time(now + 30, 3) == pytest.approx(now + 10, abs=1)
    assert share_of_time(now - 5, 3) == pytest.approx(now, abs=1)

"""A stopped or failed training continues from its last epoch, with all finished results."""

from __future__ import annotations

import json
import os
import signal
from dataclasses import replace

import pytest
import torch
from forked import CONTEXT
from trainings import RECIPE, logged, tiny_job, trained, with_network

from ufmstar_torch.eval.run.folder import FolderError
from ufmstar_torch.models import load_trained
from ufmstar_torch.models.checkpoints import read_safetensors
from ufmstar_torch.train import ResumeError, TrainingModule
from ufmstar_torch.train.fit import fit
from ufmstar_torch.train.folder import WEIGHTS
from ufmstar_torch.train.member import CHECKPOINT, AtomicCheckpointIO, train_member

# Sums depend on the number of threads, and the compared processes have one.
pytestmark = pytest.mark.usefixtures("one_thread")

# All parts with a state: dropout, batch norm, augmentation, a schedule and a running mean.
DROPOUT = with_network(method="mc_dropout", dropout=0.2)


def stop_in(monkeypatch, epoch):
    """Ctrl-C at the second step of an epoch."""
    original = TrainingModule.training_step

    def interrupted(module, batch, batch_idx):
        if (module.current_epoch, batch_idx) == (epoch, 1):
            raise KeyboardInterrupt
        return original(module, batch, batch_idx)

    monkeypatch.setattr(TrainingModule, "training_step", interrupted)


def stored(out, member=0):
    return torch.load(out / f"member_{member}" / CHECKPOINT, weights_only=True)


# ---- stopped ----


@pytest.mark.parametrize("workers", [0, pytest.param(1, marks=pytest.mark.slow)])
def test_interrupted_in_every_epoch_it_goes_on_from_the_last_whole_one_bit_for_bit(
    frames, tmp_path, workers, monkeypatch
):
    monkeypatch.setattr(torch.multiprocessing, "get_context", lambda _: CONTEXT)  # test_train_data.py spawns
    whole, job = (tiny_job(frames, tmp_path / name, DROPOUT) for name in ("whole", "out"))
    assert fit(whole)["stopped"] is None
    job = replace(job, data=replace(job.data, workers=workers))
    for epoch in (1, 2):
        with monkeypatch.context() as patch:
            stop_in(patch, epoch)
            with pytest.raises(KeyboardInterrupt):
                fit(job)
        summary = json.loads((tmp_path / "out" / "summary.json").read_text())
        assert (summary["stopped"], summary["members"][0]["steps"]) == ("interrupted", 3 * epoch)
        assert (tmp_path / "out" / WEIGHTS).is_file()
    assert fit(job)["stopped"] is None
    mine, theirs = (trained(one).state_dict() for one in (job, whole))
    assert [key for key in theirs if not torch.equal(mine[key], theirs[key])] == []
    states = [stored(folder)["optimizer_states"][0]["state"] for folder in (tmp_path / "out", tmp_path / "whole")]
    for key, state in states[1].items():
        for name, value in state.items():
            assert torch.equal(value, states[0][key][name]), (key, name)
    for name in ("train_loss_step", "val_rmse", "lr-Adam"):
        assert logged(tmp_path / "out", name)[-1] == logged(tmp_path / "whole", name)[-1]


def test_a_time_budget_is_shared_by_the_members_and_resuming_goes_on(frames, tmp_path):
    """The budget ends a member inside an epoch, with a validation and its weights."""
    recipe = replace(RECIPE, members=2, epochs=1)
    summary = fit(tiny_job(frames, tmp_path / "out", recipe, max_minutes=1e-9))
    assert summary["stopped"] == "time budget spent"
    assert [m["steps"] for m in summary["members"]] == [1, 1]
    assert len(load_trained(tmp_path / "out" / WEIGHTS)) == 2
    seconds = [m["seconds"] for m in summary["members"]]
    # Each session has its own budget.
    summary = fit(tiny_job(frames, tmp_path / "out", recipe, max_minutes=1e-9))
    assert [m["steps"] for m in summary["members"]] == [2, 2]
    summary = fit(tiny_job(frames, tmp_path / "out", recipe))
    assert summary["stopped"] is None
    assert [(m["steps"], m["finished"]) for m in summary["members"]] == [(3, True), (3, True)]
    assert all(m["seconds"] >= before for m, before in zip(summary["members"], seconds, strict=True))


def test_a_finished_member_is_not_trained_again(frames, tmp_path, monkeypatch):
    recipe = replace(RECIPE, members=2, epochs=1)
    out = tmp_path / "out"

    def stopped(job, member, **_):
        if member == 1:
            raise KeyboardInterrupt
        train_member(job, member)

    with monkeypatch.context() as patch:
        patch.setattr("ufmstar_torch.train.fit.train_member", stopped)
        with pytest.raises(KeyboardInterrupt):
            fit(tiny_job(frames, out, recipe))
    first = out / "member_0"
    before = {path: (path.stat().st_mtime_ns, path.read_bytes()) for path in first.iterdir() if path.is_file()}
    summary = fit(tiny_job(frames, out, recipe))
    assert [m["finished"] for m in summary["members"]] == [True, True]
    assert {path: (path.stat().st_mtime_ns, path.read_bytes()) for path in before} == before
    both = read_safetensors(out / WEIGHTS)[0]
    key = "backbone.encoder.0.conv.weight"
    assert not torch.equal(both[f"member.0.{key}"], both[f"member.1.{key}"])
    # The same training, when it is finished, trains nothing; further members are added.
    more = replace(recipe, members=3)
    assert [m["seed"] for m in fit(tiny_job(frames, out, more))["members"]] == [0, 1, 2]
    assert {path: (path.stat().st_mtime_ns, path.read_bytes()) for path in before} == before


def test_a_full_disk_does_not_hide_an_interruption(frames, tmp_path, monkeypatch, caplog):
    def stopped(*_, **__):
        raise KeyboardInterrupt

    def full(*_, **__):
        raise OSError("No space left on device")

    monkeypatch.setattr("ufmstar_torch.train.fit.train_member", stopped)
    monkeypatch.setattr("ufmstar_torch.train.fit.write_json_atomic", full)
    with pytest.raises(KeyboardInterrupt):
        fit(tiny_job(frames, tmp_path / "out", RECIPE))
    assert "the weights so far cannot be written: No space left" in caplog.text


@pytest.fixture
def interruptible():
    """Ctrl-C interrupts, also in a job that a shell has put into the background, where it is ignored."""
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, before)


@pytest.mark.usefixtures("interruptible")
@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT])
def test_signals_end_the_command_and_leave_the_last_epoch(ufmstar, frames, tmp_path, number, monkeypatch):
    """Lightning would end the program with exit code 0 after SIGTERM, without weights."""
    original = TrainingModule.training_step

    def signalled(module, batch, batch_idx):
        if (module.current_epoch, batch_idx) == (1, 0):
            os.kill(os.getpid(), number)
        return original(module, batch, batch_idx)

    monkeypatch.setattr(TrainingModule, "training_step", signalled)
    words = ["train", "--preset", "fastdepth-aleatoric", "--data", "sequences", "--root", frames]
    words += [f"--set={name}" for name in ("data.part=0:12", "network.size=[32,32]", "network.widths=0.05")]
    words += ["--batch-size", "4", "--epochs", "3", "--accelerator", "cpu", "--no-progress", "--no-tensorboard"]
    before = signal.getsignal(number)
    code, _, err = ufmstar(*words, "--out", tmp_path / "out")
    assert signal.getsignal(number) == before
    assert (code, err) == (130, "ufmstar train: interrupted; the same command goes on with the last whole epoch\n")
    assert stored(tmp_path / "out")["global_step"] == 3
    assert len(load_trained(tmp_path / "out" / WEIGHTS)) == 1


# ---- what must not be lost ----


def test_a_write_that_fails_leaves_the_checkpoint_before_it(tmp_path):
    path = tmp_path / CHECKPOINT
    io = AtomicCheckpointIO()
    io.save_checkpoint({"x": torch.ones(3)}, path)

    class Unwritable:
        def __reduce__(self):
            raise OSError("disk full")

    with pytest.raises(OSError, match="disk full"):
        io.save_checkpoint({"x": torch.ones(10_000), "y": Unwritable()}, path)
    assert torch.equal(torch.load(path, weights_only=True)["x"], torch.ones(3))
    assert [p.name for p in tmp_path.iterdir()] == [CHECKPOINT]


def test_a_damaged_checkpoint_is_named(frames, tmp_path):
    job = tiny_job(frames, tmp_path / "out", replace(RECIPE, epochs=1))
    fit(job)
    file = tmp_path / "out" / "member_0" / CHECKPOINT
    whole = file.read_bytes()
    for broken in (whole[: len(whole) // 2], b"", b"hello"):
        file.write_bytes(broken)
        with pytest.raises(ResumeError, match=r"last\.ckpt cannot be read .*--overwrite"):
            fit(job)
    torch.save({"weights": torch.ones(1)}, file)
    with pytest.raises(ResumeError, match="no checkpoint of this program"):
        fit(job)
    assert fit(job, overwrite=True)["stopped"] is None


def test_a_folder_is_refused_that_is_not_this_training(frames, tmp_path):
    recipe = replace(RECIPE, epochs=1, max_steps=1)
    job = tiny_job(frames, tmp_path / "out", recipe)
    fit(job)
    others = [
        (replace(job, recipe=replace(recipe, learning_rate=0.5)), r"recipe\.learning_rate was 0\.01, now 0\.5"),
        (replace(job, settings=replace(job.settings, seed=3)), "seed was 0, now 3"),
        (replace(job, data=replace(job.data, part="0:8")), r'data\.part was "0:12", now "0:8"'),
    ]
    for other, message in others:
        with pytest.raises(FolderError, match=message):
            fit(other)
    # Settings that only affect the speed do not make another training.
    same = replace(job, settings=replace(job.settings, log_every=7, max_minutes=3.0))
    assert fit(same)["stopped"] is None


def test_overwriting_removes_what_was_there_and_nothing_else(frames, tmp_path):
    out = tmp_path / "out"
    fit(tiny_job(frames, out, replace(RECIPE, members=2, max_steps=1)))
    (out / "notes.txt").write_text("x")
    fit(tiny_job(frames, out, replace(RECIPE, members=1, max_steps=1, learning_rate=0.02)), overwrite=True)
    names = sorted(path.name for path in out.iterdir())
    assert names == ["lock", "member_0", "notes.txt", "summary.json", "trained.safetensors", "training.json"]
    assert json.loads((out / "summary.json").read_text())["recipe"]["learning_rate"] == 0.02

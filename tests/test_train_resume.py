"""A stopped or failed training continues from its last epoch, with all finished results (killed: test_kills.py)."""

from __future__ import annotations

import json
import os
import signal
from dataclasses import replace

import pytest
import torch
from forked import CONTEXT
from trainings import RECIPE, logged, tiny_job, with_network

from ufmstar_torch.eval.run.folder import FolderError
from ufmstar_torch.models.checkpoints import read_safetensors
from ufmstar_torch.train import ResumeError
from ufmstar_torch.train.checkpoints import NAME, AtomicCheckpointIO
from ufmstar_torch.train.fit import fit
from ufmstar_torch.train.member import WEIGHTS

# Sums depend on the number of threads, and the compared processes have one.
pytestmark = pytest.mark.usefixtures("one_thread")

# All parts with a state: dropout, batch norm, augmentation, a schedule and a running mean.
DROPOUT = with_network(method="mc_dropout", dropout=0.2)


@pytest.fixture(scope="module")
def uninterrupted(frames, tmp_path_factory):
    """The folder of an undisturbed training."""
    out = tmp_path_factory.mktemp("reference") / "out"
    assert fit(tiny_job(frames, out, DROPOUT))["stopped"] is None
    return out


def tensors(path):
    return read_safetensors(path)[0]


def stored(out, member=0):
    return torch.load(out / f"member_{member}" / NAME, weights_only=True)


def assert_same_result(out, reference, member=0):
    """Weights bit for bit, the optimizer's state too, and the losses of the last epoch."""
    mine, theirs = (tensors(folder / f"member_{member}" / WEIGHTS) for folder in (out, reference))
    assert mine.keys() == theirs.keys()
    assert [key for key in mine if not torch.equal(mine[key], theirs[key])] == []
    states = [stored(folder, member)["optimizer_states"][0]["state"] for folder in (out, reference)]
    for key, state in states[1].items():
        for name, value in state.items():
            assert torch.equal(value, states[0][key][name]), (key, name)
    for name in ("train_loss", "val_rmse"):
        assert logged(out, name)[-1] == logged(reference, name)[-1]


def stop_after(steps):
    """Request a stop after ``steps`` steps of the first member (the callback runs once before the first step)."""
    count = iter(range(10_000))
    return lambda: next(count) >= steps


# ---- stopped ----


@pytest.mark.parametrize("workers", [0, pytest.param(1, marks=pytest.mark.slow)])
def test_stopped_again_and_again_it_goes_on_bit_for_bit(frames, uninterrupted, tmp_path, workers, monkeypatch):
    """Stops two steps into the second and third of three epochs of three steps; weights exist after each session."""
    monkeypatch.setattr(torch.multiprocessing, "get_context", lambda _: CONTEXT)  # test_train_data.py spawns
    job = tiny_job(frames, tmp_path / "out", DROPOUT)
    job = replace(job, data=replace(job.data, workers=workers))
    for reached, checkpointed in ((5, 3), (8, 6), (9, 9)):
        summary = fit(job, resume=True, asked=stop_after(5))
        assert (summary["members"][0]["steps"], stored(tmp_path / "out")["global_step"]) == (reached, checkpointed)
        assert (tmp_path / "out" / WEIGHTS).is_file()
    assert summary["stopped"] is None
    assert_same_result(tmp_path / "out", uninterrupted)


def test_a_time_budget_is_shared_by_the_members_and_resuming_goes_on(frames, tmp_path):
    recipe = replace(RECIPE, members=2, epochs=1)
    summary = fit(tiny_job(frames, tmp_path / "out", recipe, max_minutes=1e-9))
    assert summary["stopped"] == "time budget spent"
    assert [m["steps"] for m in summary["members"]] == [1, 1]
    summary = fit(tiny_job(frames, tmp_path / "out", recipe), resume=True)
    assert summary["stopped"] is None
    assert [(m["steps"], m["finished"]) for m in summary["members"]] == [(3, True), (3, True)]


def test_a_finished_member_is_not_trained_again(frames, tmp_path):
    recipe = replace(RECIPE, members=2, epochs=1)
    out = tmp_path / "out"
    # The callback runs before each member and after each step: stop before the second member.
    count = iter(range(100))
    summary = fit(tiny_job(frames, out, recipe), asked=lambda: next(count) >= 4)
    assert [m["finished"] for m in summary["members"]] == [True]
    assert summary["stopped"] == "stopped"
    first = out / "member_0"
    before = {path: (path.stat().st_mtime_ns, path.read_bytes()) for path in first.iterdir() if path.is_file()}
    summary = fit(tiny_job(frames, out, recipe), resume=True)
    assert [m["finished"] for m in summary["members"]] == [True, True]
    assert {path: (path.stat().st_mtime_ns, path.read_bytes()) for path in before} == before
    both = tensors(out / WEIGHTS)
    key = "backbone.encoder.0.conv.weight"
    assert not torch.equal(both[f"member.0.{key}"], both[f"member.1.{key}"])
    # Resuming a finished training trains nothing; further members are added.
    more = replace(recipe, members=3)
    assert [m["seed"] for m in fit(tiny_job(frames, out, more), resume=True)["members"]] == [0, 1, 2]
    assert {path: (path.stat().st_mtime_ns, path.read_bytes()) for path in before} == before


def test_sigterm_reaches_who_asks_for_the_stop(frames, tmp_path):
    """Lightning's handler would end the program with exit code 0, without weights and result."""
    received = []

    def asked():
        if list((tmp_path / "out" / "member_0").glob("version_0/*.csv")) and not received:
            os.kill(os.getpid(), signal.SIGTERM)
        return bool(received)

    before = signal.signal(signal.SIGTERM, lambda number, _: received.append(number))
    try:
        summary = fit(tiny_job(frames, tmp_path / "out"), asked=asked)
    finally:
        signal.signal(signal.SIGTERM, before)
    assert received == [signal.SIGTERM]
    assert summary["stopped"] == "stopped"
    assert summary["members"][0]["steps"] in (1, 2)


# ---- what must not be lost ----


def test_a_write_that_fails_leaves_the_checkpoint_before_it(tmp_path):
    path = tmp_path / NAME
    io = AtomicCheckpointIO()
    io.save_checkpoint({"x": torch.ones(3)}, path)

    class Unwritable:
        def __reduce__(self):
            raise OSError("disk full")

    with pytest.raises(OSError, match="disk full"):
        io.save_checkpoint({"x": torch.ones(10_000), "y": Unwritable()}, path)
    assert torch.equal(torch.load(path, weights_only=True)["x"], torch.ones(3))
    assert [p.name for p in tmp_path.iterdir()] == [NAME]


def test_a_damaged_checkpoint_is_named(frames, tmp_path):
    job = tiny_job(frames, tmp_path / "out", replace(RECIPE, epochs=2))
    fit(job, asked=stop_after(4))
    file = tmp_path / "out" / "member_0" / NAME
    whole = file.read_bytes()
    for broken in (whole[: len(whole) // 2], b"", b"hello"):
        file.write_bytes(broken)
        with pytest.raises(ResumeError, match=r"last\.ckpt cannot be read .*--overwrite"):
            fit(job, resume=True)
    torch.save({"weights": torch.ones(1)}, file)
    with pytest.raises(ResumeError, match="no checkpoint of this program"):
        fit(job, resume=True)
    assert fit(job, overwrite=True)["stopped"] is None


def test_a_folder_is_refused_that_is_not_this_training(frames, tmp_path):
    recipe = replace(RECIPE, epochs=1, max_steps=1)
    job = tiny_job(frames, tmp_path / "out", recipe)
    fit(job)
    with pytest.raises(FolderError, match="--resume goes on with it, --overwrite replaces it"):
        fit(job)
    others = [
        (replace(job, recipe=replace(recipe, learning_rate=0.5)), r"recipe\.learning_rate was 0\.01, now 0\.5"),
        (replace(job, settings=replace(job.settings, seed=3)), "seed was 0, now 3"),
        (replace(job, data=replace(job.data, part="0:8")), r'data\.part was "0:12", now "0:8"'),
    ]
    for other, message in others:
        with pytest.raises(FolderError, match=message):
            fit(other, resume=True)
    # Settings that only affect the speed do not make another training.
    same = replace(job, settings=replace(job.settings, log_every=7, max_minutes=3.0))
    assert fit(same, resume=True)["stopped"] is None
    (tmp_path / "home").mkdir()
    (tmp_path / "home" / "thesis.tex").write_text("x")
    with pytest.raises(FolderError, match="files of someone else"):
        fit(replace(job, settings=replace(job.settings, out=tmp_path / "home")), overwrite=True)
    assert (tmp_path / "home" / "thesis.tex").read_text() == "x"


def test_overwriting_removes_what_was_there_and_nothing_else(frames, tmp_path):
    out = tmp_path / "out"
    fit(tiny_job(frames, out, replace(RECIPE, members=2, max_steps=1)))
    (out / "notes.txt").write_text("x")
    fit(tiny_job(frames, out, replace(RECIPE, members=1, max_steps=1, learning_rate=0.02)), overwrite=True)
    names = sorted(path.name for path in out.iterdir())
    assert names == ["lock", "member_0", "notes.txt", "summary.json", "trained.safetensors", "training.json"]
    assert json.loads((out / "summary.json").read_text())["recipe"]["learning_rate"] == 0.02


def test_a_folder_in_use_is_refused(frames, tmp_path):
    from ufmstar_torch.train.folder import open_folder

    job = tiny_job(frames, tmp_path / "out")
    with (
        open_folder(job),
        pytest.raises(FolderError, match="another training is writing there"),
        open_folder(job, resume=True),
    ):
        pass

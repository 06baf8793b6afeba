"""``ufmstar eval`` and ``train`` killed at any moment: finished work remains, and a second start completes
the rest with the same results. (``ufmstar run``: tests/test_run.py.)"""

from __future__ import annotations

import os
import random
import signal
import time
from contextlib import suppress
from io import BytesIO

import pytest
import torch
from forked import start_program
from tiny_suite import TRUTH, stored_results, write_rooms
from trainings import write_frames

from ufmstar_torch.models.checkpoints import read_safetensors
from ufmstar_torch.train.folder import WEIGHTS
from ufmstar_torch.train.member import CHECKPOINT
from ufmstar_torch.train.module import OF_MEMBER

KILLS = 3
SUITE = """
title = "Kills"
[[rows]]
methods = ["DepthOnly", "UfM-DepthOnly", "UfM*-DepthOnly"]
"""
TRAINING = (
    "--preset fastdepth-ensemble --members 2 --data sequences --set data.part=0:12 --set data.validation_part=12:16 "
    "--epochs 2 --batch-size 4 --set network.widths=0.05 --set network.size=[32,32] --set network.preprocess=resize"
)
pytestmark = pytest.mark.slow


def finish(words):
    """An undisturbed process."""
    process = start_program(words)
    process.join()
    assert process.exitcode == 0


def kill_at(words, out, files, delay):
    """SIGKILL the process and its children ``delay`` [s] after it has written ``files`` files to ``out``. Return
    whether it was still running."""
    began, process = time.time(), start_program(words)
    while process.is_alive() and written_since(out, began) < files:
        time.sleep(0.02)
    time.sleep(delay)
    if process.is_alive():
        os.killpg(process.pid, signal.SIGKILL)
    process.join()
    return process.exitcode == -signal.SIGKILL


def written_since(out, began):
    """Files in a folder that are younger than a time [s]."""
    count = 0
    for path in out.rglob("*"):
        with suppress(FileNotFoundError):  # a temporary file
            count += path.is_file() and path.stat().st_mtime >= began
    return count


def killed_and_finished(words, again, out, whole, seed, finished):
    """Kill a command a few times at random moments of its work, then let it finish.

    Args:
        words: command of the first start.
        again: command of later starts.
        out: the command's output folder.
        whole: the output folder of an undisturbed run.
        seed: seed of the random moments.
        finished: returns the finished files by name; they must not change.
    """
    draw, kills, done = random.Random(seed), 0, {}
    files = written_since(whole, 0)
    for _ in range(KILLS):
        at, delay = 1 + draw.randrange(max(1, int(0.6 * files))), draw.uniform(0, 0.3)
        kills += kill_at(again if kills else words, out, at, delay)
        after = finished()
        assert {name: after.get(name) for name in done} == done, "finished work is lost"
        done = after
    finish(again)
    assert {name: finished().get(name) for name in done} == done, "finished work has changed"
    assert kills > 0


def content(folder, *patterns):
    """The bytes of files by name."""
    files = sorted(path for pattern in patterns for path in folder.glob(pattern) if path.is_file())
    return {str(path.relative_to(folder)): path.read_bytes() for path in files}


@pytest.fixture(scope="module")
def evaluation(tmp_path_factory):
    """The command of an evaluation without report and without ``--out``, and the output folder of an undisturbed
    run."""
    folder = tmp_path_factory.mktemp("evaluation")
    rooms = write_rooms(folder / "rooms", frames=6)
    (folder / "kills.toml").write_text(SUITE)
    words = ["eval", "--suite", folder / "kills.toml", "--network", TRUTH, "--root", f"rooms={rooms}"]
    words += ["--threads", 1, "--no-report"]
    finish([*words, "--out", folder / "whole"])
    return words, folder / "whole"


def test_eval(evaluation, tmp_path):
    words, whole = evaluation
    out = tmp_path / "out"
    words = [*words, "--out", out]
    killed_and_finished(words, [*words, "--resume"], out, whole, 0, lambda: content(out, "records/*/*/*.json"))
    assert stored_results(out) == stored_results(whole)
    assert not list(out.rglob(".*.tmp"))


@pytest.fixture(scope="module")
def training(tmp_path_factory):
    """The command of a training, up to the value of ``--out``, and the output folder of an undisturbed run."""
    folder = tmp_path_factory.mktemp("training")
    frames = write_frames(folder / "frames")
    words = ["train", *TRAINING.split(), "--root", frames, "--threads", 1, "--out"]
    finish([*words, folder / "whole"])
    return words, folder / "whole"


def finished_members(out):
    """The bytes of the checkpoints of finished members, by name."""
    checkpoints = content(out, f"member_*/{CHECKPOINT}")
    stored = {name: torch.load(BytesIO(bytes_), weights_only=True) for name, bytes_ in checkpoints.items()}
    ends = {name: one[OF_MEMBER]["total_steps"] == one["global_step"] for name, one in stored.items()}
    return {name: bytes_ for name, bytes_ in checkpoints.items() if ends[name]}


def test_train(training, tmp_path):
    words, whole = training
    out = tmp_path / "out"
    again = [*words, out, "--resume"]
    killed_and_finished([*words, out], again, out, whole, 1, lambda: finished_members(out))
    mine, theirs = (read_safetensors(folder / WEIGHTS)[0] for folder in (out, whole))
    assert [name for name in theirs if not torch.equal(mine[name], theirs[name])] == []

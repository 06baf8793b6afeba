"""The loop over sequences: stored results, recomputation, and the effect of a broken sequence on the rest."""

from __future__ import annotations

import json
import shutil
from dataclasses import replace

import numpy as np
import pytest
import torch
from layouts_more import write_nyu
from tiny_suite import NAMES, TRUTH, Stub, evaluate, go, job_on, rows_of, stored_results, write_rooms

from ufmstar_torch.eval.commands.evaluate import job_from, read
from ufmstar_torch.eval.engine.evaluate import SequenceError, evaluate_sequence
from ufmstar_torch.eval.engine.predictions import CacheError, content_digest
from ufmstar_torch.eval.engine.record import Record
from ufmstar_torch.eval.report.data import load_results
from ufmstar_torch.eval.run.folder import FolderError
from ufmstar_torch.eval.suite.evaluate import with_references


@pytest.fixture(scope="module")
def whole(rooms, tmp_path_factory):
    """The stored results of an undisturbed evaluation by the stub."""
    out = tmp_path_factory.mktemp("whole")
    go(job_on(rooms, out))
    return stored_results(out)


def test_every_row_of_every_sequence_is_kept_as_a_record(rooms, tmp_path):
    job = job_on(rooms, tmp_path / "out")
    outcome, message = go(job)
    assert outcome.finished
    assert [line.split(":")[0] for line in message] == [f"rooms/{name}" for name in NAMES]
    record = Record.load(job.out / "records" / "rooms" / "birch" / "UfMstar-DepthOnly.json")
    assert (record.suite, record.dataset, record.sequence) == ("depth-only", "rooms", "birch")
    assert (record.network, record.method, record.setting) == ("ground truth", "UfM*-DepthOnly", {})
    assert record.provenance["sequence"] == content_digest(job.items[1].open())
    results = load_results(job.out)
    assert len(results.records) == 12
    assert not results.missing
    assert ("rooms", job.suite.rows[3]) in results.merged


def test_what_does_not_fit_together_is_named_before_it_is_judged(tmp_path, caplog):
    rooms = write_rooms(tmp_path / "rooms", NAMES[:2])
    poses = np.loadtxt(rooms / NAMES[1] / "poses.txt").reshape(-1, 4, 4)
    poses[:, :3, 3] *= 100
    np.savetxt(rooms / NAMES[1] / "poses.txt", poses.reshape(-1, 16))
    outcome, _ = go(job_on(rooms, tmp_path / "out"))
    assert outcome.finished
    warnings = [text for text in caplog.messages if "ufmstar data check" in text]
    assert [text.split(":")[0] for text in warnings] == [f"rooms/{NAMES[1]}"], warnings
    assert "depth looks too small: times 1" in warnings[0]


def test_the_real_judge_gives_what_it_gives_when_called_alone(rooms, tmp_path):
    job = replace(job_on(rooms, tmp_path / "out"), frames=slice(1, None, 2), examples=1)
    go(job, evaluate_sequence)
    networks = job.load(torch.device("cpu"))
    for item in job.items:
        for slug, result in evaluate(item.open(), job.suite.rows, networks, frames=job.frames).items():
            record = job.folder.records(item)[slug]
            assert record.frames["done"] == 2
            assert {k: v for k, v in record.figures.items() if v is not None} == {
                k: v for k, v in result.figures.items() if np.isfinite(v)
            }
    # Pictures of the first sequence only.
    assert [path.parent.name for path in sorted(job.out.glob("records/*/*/examples"))] == ["ash"]


def test_the_same_evaluation_computes_rows_and_sequences_added_since(rooms, tmp_path, whole):
    job = job_on(rooms, tmp_path / "out")
    rows = job.suite.rows
    go(replace(job, suite=replace(job.suite, rows=rows[:2]), items=job.items[:2]))
    stub = Stub()
    go(job, stub)
    names = [row.method.name for row in rows]
    assert stub.asked == [("ash", names[2:]), ("birch", names[2:]), ("cedar", names)]
    assert stored_results(job.out) == whole


def test_missing_rows_are_judged_beside_their_references():
    rows = rows_of("Aleatoric", "UfM-Aleatoric", "UfM-Aleatoric-100K", "UfM*-Aleatoric", "Ensemble")
    needed = with_references(rows[3:4], rows)
    assert [row.method.name for row in needed] == ["Aleatoric", "UfM-Aleatoric-100K", "UfM*-Aleatoric"]
    assert with_references(rows[4:], rows) == [rows[4]]


def test_a_broken_sequence_is_told_and_the_rest_goes_on(tmp_path, whole, rooms):
    root = write_rooms(tmp_path / "own")
    (root / "birch" / "poses.txt").write_text("not a pose\n")
    job = job_on(root, tmp_path / "out")
    outcome, message = go(job)
    assert outcome.finished
    assert "rooms/birch: failed: " in message[1]
    assert sorted(path.split("/")[2] for path in stored_results(job.out)) == ["ash"] * 4 + ["cedar"] * 4
    failed = json.loads((job.out / "records" / "rooms" / "birch" / "failed.json").read_text())
    assert (failed["sequence"], failed["dataset"], len(failed["rows"])) == ("birch", "rooms", 4)
    assert "poses.txt" in failed["reason"]
    assert job.folder.failures().keys() == {("rooms", "birch")}
    # After the repair the sequence is evaluated again.
    write_rooms(root, ["birch"])
    stub = Stub()
    assert go(job, stub)[0].finished
    assert [name for name, _ in stub.asked] == ["birch"]
    assert not job.folder.failures()
    assert stored_results(job.out) == whole


def test_what_the_judge_cannot_use_is_broken_and_what_it_cannot_write_ends_all(rooms, tmp_path):
    def fails(error):
        def judge(sequence, *arguments, **named):
            if sequence.name == "birch":
                raise error
            return Stub()(sequence, *arguments, **named)

        return judge

    job = job_on(rooms, tmp_path / "out")
    go(job, fails(SequenceError("no frame has ground truth")))
    assert job.folder.failures() == {("rooms", "birch"): "no frame has ground truth"}
    go(job, fails(RuntimeError("out of memory")))
    assert job.folder.failures() == {("rooms", "birch"): "out of memory"}
    for error in (CacheError("disk full"), OSError("disk full"), TypeError("a mistake of ours")):
        with pytest.raises(type(error)):
            go(job, fails(error))
    assert go(job)[0].finished


def test_images_without_poses_are_for_networks_alone(tmp_path):
    root, _ = write_nyu(tmp_path / "nyu")
    job = job_on(root, tmp_path / "out")
    outcome, message = go(job, evaluate_sequence)
    assert outcome.finished
    folder, (item,) = job.folder, job.items
    done = sorted(path.stem for path in folder.sequence_folder(item).glob("*.json") if path.stem != "failed")
    assert done == ["DepthOnly"]
    failure = json.loads((folder.sequence_folder(item) / "failed.json").read_text())
    assert "no poses" in failure["reason"]
    assert failure["rows"] == ["UfM-DepthOnly", "UfM-DepthOnly-100K", "UfMstar-DepthOnly"]
    assert sum("failed" in line for line in message) == 1
    outcome, message = go(job, evaluate_sequence)
    assert outcome.finished
    assert sum("failed" in line for line in message) == 1, "the failure is reported each time"


def test_poses_of_another_program(tmp_path):
    root = write_rooms(tmp_path / "own", ["ash", "birch"], frames=3)
    for name in ("ash", "birch"):
        shutil.copy(root / name / "poses.txt", root / name / "slam.txt")
        (root / name / "poses.txt").write_text("not a pose\n")
    words = ["--suite", "depth-only", "--network", TRUTH, "--root", f"rooms={root}", "--out", str(tmp_path / "out")]
    job = job_from(read([*words, "--trajectory", "slam.txt"]))
    go(job)
    write_rooms(tmp_path / "plain", ["ash", "birch"], frames=3)
    go(job_on(tmp_path / "plain", tmp_path / "expected", suite=job.suite))
    assert len(stored_results(job.out)) == 12
    assert stored_results(job.out) == stored_results(tmp_path / "expected")
    assert json.loads((job.out / "eval.json").read_text())["settings"]["trajectory"] == "slam.txt"
    with pytest.raises(FolderError, match="settings"):
        go(job_from(read(words)))
    for wrong, message in (("--poses sideways", "--poses"), ("--fps 0", "fps must lie in")):
        with pytest.raises(ValueError, match=message):
            job_from(read([*words, *wrong.split()]))


def test_another_sequence_of_the_name_is_refused(tmp_path):
    root = write_rooms(tmp_path / "own", ["ash"])
    job = job_on(root, tmp_path / "out")
    go(job)
    poses = root / "ash" / "poses.txt"
    poses.write_text("\n".join(poses.read_text().splitlines()[::-1]))
    with pytest.raises(FolderError, match="rooms/ash has other frames, cameras or poses than when DepthOnly was"):
        go(job)


def test_a_kill_in_the_middle_of_writing_leaves_no_half_row(rooms, tmp_path, whole, monkeypatch):
    job, saved, write = job_on(rooms, tmp_path / "out"), [], Record.save

    def save(self, path):
        if len(saved) == 6:
            raise KeyboardInterrupt
        saved.append(path)
        write(self, path)

    monkeypatch.setattr(Record, "save", save)
    with pytest.raises(KeyboardInterrupt):
        go(job)
    monkeypatch.undo()
    assert len(stored_results(job.out)) == 6
    folder = job.folder.sequence_folder(job.items[1])
    begun, mine = folder / ".A.npz.0123456789ab.tmp", folder / ".mine.tmp"
    for file in (begun, mine):
        file.write_text("x")
    stub = Stub()
    go(job, stub)
    assert [(name, len(rows)) for name, rows in stub.asked] == [("birch", 2), ("cedar", 4)]
    assert (begun.exists(), mine.exists()) == (False, True), "temporary files of a killed process are removed"
    assert stored_results(job.out) == whole

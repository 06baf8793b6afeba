"""The work list and the output folder of ``ufmstar eval``."""

from __future__ import annotations

import errno
import fcntl
import json
import os
import random

import pytest
from hypothesis import given
from hypothesis import strategies as st
from layouts import write_seven_scenes
from tiny_suite import NAMES, go, job_on, write_rooms

from ufmstar_torch.eval.methods.row import Row
from ufmstar_torch.eval.methods.setting import Setting
from ufmstar_torch.eval.run.folder import FolderError, hold, output_folder
from ufmstar_torch.eval.suite.folder import EVALUATION
from ufmstar_torch.eval.suite.work_items import WorkItem, find_work, read_names

# ---- work list ----


@given(st.lists(st.text(min_size=1, max_size=30), min_size=1, unique=True))
def test_sequences_of_any_name_have_folders_of_their_own(sequence_names):
    items = [WorkItem("d", name, "p") for name in sequence_names]
    folders = [item.folder.parts for item in items]
    assert len(set(folders)) == len(items)
    for _, folder in folders:
        assert folder.isascii()
        assert not set(folder) & set('/\\:*?<>|" ')
        assert not folder.startswith(".")


def test_work_is_found_by_layout_or_named_data_set(tmp_path):
    write_rooms(tmp_path / "a")
    write_seven_scenes(tmp_path / "b")
    result = find_work([str(tmp_path / "a"), f"mine={tmp_path / 'b'}", "tour:3?frames=2"])
    assert [(item.dataset, item.opening.layout) for item in result] == [("generic", "generic")] * 3 + [
        ("mine", "7scenes"),
        ("tour", "auto"),
    ]
    assert [item.sequence for item in result[:3]] == list(NAMES)
    assert [len(item.open()) for item in result[:4]] == [4, 4, 4, 6]


def test_sample_and_list(tmp_path):
    folder = write_rooms(tmp_path / "rooms", [f"r{n}" for n in range(7)], frames=1)
    root = f"d={folder}"
    everything = find_work([root])
    sample = find_work([root], sample=3, seed=5)
    assert sample == sorted(random.Random(5).sample(everything, 3))
    assert find_work([root], sample=3, seed=6) != sample
    assert find_work([root], sample=99) == everything
    (tmp_path / "list.txt").write_text("r5  # the fifth\n\nd/r2\n")
    assert [item.sequence for item in find_work([root], only=read_names(tmp_path / "list.txt"))] == ["r2", "r5"]
    with pytest.raises(ValueError, match="names sequences that are not there: r9"):
        find_work([root], only=["r9", "r1"])


def test_mistaken_roots(tmp_path):
    write_rooms(tmp_path / "a", ["ash"], frames=1)
    write_rooms(tmp_path / "b", ["ash"], frames=1)
    (tmp_path / "empty").mkdir()
    with pytest.raises(ValueError, match="name their data sets"):
        find_work([str(tmp_path / "a"), str(tmp_path / "b")])
    assert len(find_work([f"x={tmp_path / 'a'}", str(tmp_path / "b")])) == 2
    assert len(find_work([str(tmp_path / "a"), str(tmp_path / "a")])) == 1
    with pytest.raises(ValueError, match="no sequence of a known layout"):
        find_work([str(tmp_path / "empty")])
    with pytest.raises(FileNotFoundError, match="nowhere"):
        find_work([str(tmp_path / "nowhere")])


# ---- the folder ----

ABOUT = {
    "suite": "x", "title": "", "networks": {"aleatoric": {"sha256": "a" * 64}}, "rows": [{"method": "A"}],
    "datasets": ["d"], "sequences": [{"dataset": "d", "sequence": "s"}], "missing_bases": ["ensemble"],
    "settings": {"frames": [None, None, 2]},
}  # fmt: skip


def enter(out, about, **how):
    with output_folder(out, EVALUATION, about, **how):
        pass


def test_overwriting_removes_our_files_alone(tmp_path):
    root, out = write_rooms(tmp_path / "rooms", ["ash"]), tmp_path / "out"
    go(job_on(root, out))
    users = [out / "notes.txt", out / "tables" / "mine.txt", out / "records" / "rooms" / "ash" / "note.md"]
    for file in users:
        file.parent.mkdir(exist_ok=True)
        file.write_text("mine")
    made = [out / "tables" / "main.tex", out / "results.csv", out / "cache" / "kept"]
    for file in made:
        file.write_text("made")
    enter(out, ABOUT, overwrite=True)
    assert all(file.read_text() == "mine" for file in users)
    assert [file.exists() for file in made] == [False, False, True]
    after = {path.name for path in out.rglob("*") if path.is_file()}
    assert after == {"eval.json", "eval.lock", "kept", *(file.name for file in users)}


@pytest.mark.parametrize(
    ("changed", "told"),
    [
        ({"suite": "y"}, 'suite was "x", now "y"'),
        ({"networks": {"aleatoric": {"sha256": "b" * 64}}}, r"networks.aleatoric.sha256 was \"aaaaaaaa.*, now \"bbbb"),
        ({"settings": {"frames": [None, 9, 2]}}, "settings.frames was"),
        ({"settings": {"frames": [None, None, 2], "bins": "authors"}}, 'settings.bins was null, now "authors"'),
    ],
)
def test_continuing_something_else_is_refused_by_name(tmp_path, changed, told):
    enter(tmp_path, ABOUT)
    with pytest.raises(FolderError, match=told):
        enter(tmp_path, {**ABOUT, **changed})


def test_continuing_adds_rows_sequences_and_networks(tmp_path):
    enter(tmp_path, ABOUT)
    more = {
        "networks": {"ensemble": {"sha256": "c"}},
        "rows": [{"method": "B"}, {"method": "A"}],
        "sequences": [{"dataset": "d", "sequence": "t"}],
        "missing_bases": ["aleatoric", "evidential"],
    }
    enter(tmp_path, {**ABOUT, **more})
    about = json.loads((tmp_path / "eval.json").read_text())
    assert about["networks"].keys() == {"aleatoric", "ensemble"}
    assert about["rows"] == [{"method": "A"}, {"method": "B"}]
    assert [s["sequence"] for s in about["sequences"]] == ["s", "t"]
    assert about["missing_bases"] == ["evidential"]


def test_a_row_without_its_sums_or_with_half_a_record_is_missing(tmp_path):
    job = job_on(write_rooms(tmp_path / "rooms", ["ash"]), tmp_path / "out")
    go(job)
    folder, item, rows = job.folder, job.items[0], job.suite.rows
    assert folder.missing(item, rows) == []
    assert folder.missing(item, [Row(rows[3].method, Setting(skip=1))]) == [Row(rows[3].method, Setting(skip=1))]
    (folder.sequence_folder(item) / "DepthOnly.npz").unlink()
    (folder.sequence_folder(item) / "UfM-DepthOnly.json").write_text('{"format": 2')
    assert [row.method.name for row in folder.missing(item, rows)] == ["DepthOnly", "UfM-DepthOnly"]
    go(job)
    assert folder.missing(item, rows) == []


# ---- small parts ----


@pytest.mark.parametrize("code", [errno.ENOLCK, errno.ENOSYS])
def test_a_file_system_without_locks_is_named(tmp_path, monkeypatch, code):
    def refuse(*_):
        raise OSError(code, os.strerror(code))

    monkeypatch.setattr(fcntl, "flock", refuse)
    with pytest.raises(OSError, match="the file system does not support locks"):
        hold(tmp_path / "lock")

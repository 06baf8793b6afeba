"""Components in files: matching and fusion as if nothing had been written out, memory bounded, resumable."""

from __future__ import annotations

import copy
import functools
import json

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from modules import same

import scenes
from ufmstar_torch import UfMStar, UfMStarConfig
from ufmstar_torch.spill import MEMORY
from ufmstar_torch.spill_index import CELL, Page, PageIndex, View
from ufmstar_torch.spill_store import VERSION, Folder

FRAMES, LIMIT = 36, 60


@functools.cache
def corridor() -> list[tuple[torch.Tensor, torch.Tensor, torch.Tensor]]:
    """A corridor with boxes on both sides: 24 frames ahead, 1.5 m each, then back over the last third."""
    rng = np.random.default_rng(0)
    room = ((-1.5, -1.4, -3.0), (1.5, 1.4, 60.0))
    boxes = [((s - 0.35, 0.1, z), (s + 0.35, 1.4, z + rng.uniform(0.4, 1.2))) for z in range(50) for s in (-1.15, 1.15)]
    K, frames = torch.tensor(scenes.intrinsics(48, 64)), []
    for i in range(FRAMES):
        z, yaw = (1.5 * i, 0.0) if i < 24 else (1.5 * (47 - i), np.pi)
        T = scenes.look((0.0, 0.0, z), yaw + 0.1 * np.sin(i), 0.1)
        depth = scenes.flicker(scenes.render(T, K.numpy(), 48, 64, boxes, room), 0.02, i)
        frames.append((torch.tensor(np.where(depth < 8, depth, np.nan))[None], torch.tensor(T), K))
    return frames


def walk(config: UfMStarConfig, first: int = 0, last: int = FRAMES, ufm: UfMStar | None = None):
    """The module after the frames, the maps, and the components in memory after each."""
    ufm = UfMStar(config, dtype=torch.float64) if ufm is None else ufm
    maps, counts = [], []
    for frame in corridor()[first:last]:
        maps.append(ufm(*frame).disagreement)
        counts.append(int(ufm.mixture.components))
    return ufm, maps, counts


def rows(ufm: UfMStar) -> torch.Tensor:
    """All components, those that are out included, in an order of their own."""
    state = ufm.state if ufm._spill is None else ufm._spill.everything(ufm.state)
    n = int(state.mixture.components)
    table = torch.cat([v[0, :n].double().reshape(n, -1) for v in state.mixture.tensors().values()], 1)
    return torch.tensor(sorted(table.tolist()))


def changes_of(folder) -> list[dict]:
    """The lines of the journal behind its first, which has the version."""
    head, *lines = (folder / "pages.jsonl").read_text().splitlines()
    assert json.loads(head) == {"version": VERSION}
    return [json.loads(line) for line in lines]


@pytest.mark.parametrize("kind", ["folder", "memory"])
def test_written_out_and_read_back_equals_never_written_out(kind, tmp_path):
    plain, expected, growing = walk(UfMStarConfig())
    config = UfMStarConfig(max_components=LIMIT, spill=MEMORY if kind == "memory" else str(tmp_path / "out"))
    ufm, maps, counts = walk(config)
    assert torch.equal(rows(ufm), rows(plain)), "to the last bit"
    for ours, theirs in zip(maps, expected, strict=True):
        torch.testing.assert_close(ours, theirs, rtol=1e-5, atol=1e-9, equal_nan=True)
    assert counts[23] < 0.7 * growing[23]
    assert ufm.spilled.pages > 0
    assert ufm.spilled.read > 0
    assert ufm.spilled.components + counts[-1] == len(rows(plain))
    assert ufm.mean.shape[1] < plain.mean.shape[1]
    points = torch.tensor([[[0.5, 1.0, 2.0], [1.0, 1.0, 20.0]]], dtype=torch.float64)
    torch.testing.assert_close(ufm.query(points).disagreement, plain.query(points).disagreement, rtol=1e-9, atol=1e-12)


def test_a_killed_run_goes_on_from_its_last_saved_state(tmp_path):
    """Also where the killed run had gone on: pages of later frames do not count."""
    config = UfMStarConfig(max_components=LIMIT, spill=str(tmp_path))
    whole, maps, _ = walk(UfMStarConfig(max_components=LIMIT, spill=MEMORY))
    killed, _, _ = walk(config, 0, 20)
    saved = copy.deepcopy(killed.state_dict())
    walk(config, 20, 33, killed)
    again = UfMStar(config, dtype=torch.float64)
    again.load_state_dict(saved)
    again, later, _ = walk(config, 20, FRAMES, again)
    for name, value in whole.state_dict().items():
        ours = again.state_dict()[name]
        assert name == "_extra_state" or same(ours, value), name
    assert all(same(a, b) for a, b in zip(later, maps[20:], strict=True))
    assert again.spilled.pages == whole.spilled.pages > 0


@pytest.mark.parametrize("fails", ["write", "append"])
def test_a_frame_that_raises_loses_no_page(fails, tmp_path, monkeypatch):
    config = UfMStarConfig(max_components=LIMIT, spill=str(tmp_path))
    ufm, _, _ = walk(config, 0, 24)
    before = rows(ufm)
    with monkeypatch.context() as patch:
        patch.setattr(UfMStar, "_step", lambda *_: (_ for _ in ()).throw(RuntimeError("no step")))
        with pytest.raises(RuntimeError, match="no step"):
            ufm(*corridor()[24])
    assert torch.equal(rows(ufm), before)

    def full(*_: object) -> None:
        raise OSError("no space left")

    with monkeypatch.context() as patch:
        patch.setattr(Folder, fails, full)
        with pytest.raises(OSError, match="no space"):
            walk(config, 24, FRAMES, ufm)
    done = int(ufm.frames)
    plain, _, _ = walk(UfMStarConfig(), 0, done)
    assert 24 <= done < FRAMES
    assert torch.equal(rows(ufm), rows(plain)), "the frame that could not write is not taken in"


def test_a_reset_begins_anew(tmp_path):
    config = UfMStarConfig(max_components=LIMIT, spill=str(tmp_path))
    ufm, _, _ = walk(config, 0, 24)
    ufm.reset()
    ufm, _, _ = walk(config, 0, 3, ufm)
    changes = changes_of(tmp_path)
    assert all(change["frames"] <= 3 for change in changes), "the old journal is gone"
    fresh, _, _ = walk(UfMStarConfig(), 0, 3)
    assert torch.equal(rows(ufm), rows(fresh))


def test_files_are_named_by_their_content_and_the_journal_keeps_what_changed(tmp_path):
    ufm, _, _ = walk(UfMStarConfig(max_components=LIMIT, spill=str(tmp_path)), 0, 30)
    changes = changes_of(tmp_path)
    frames = [change["frames"] for change in changes]
    assert frames == sorted(set(frames))
    assert frames[-1] <= 30
    written = [page for change in changes for page in change["out"]]
    assert {page["name"] for page in written} == {p.name for p in tmp_path.glob("*.f64")}
    back = {number for change in changes for number in change["back"]}
    assert len(back) == ufm.spilled.read > 0
    out = [page["count"] for number, page in enumerate(written) if number not in back]
    assert (len(out), sum(out)) == (ufm.spilled.pages, ufm.spilled.components)
    assert ufm.spilled.components + int(ufm.mixture.components) == len(rows(ufm))


def test_a_page_holds_at_most_sixteen_neighbours(tmp_path):
    walk(UfMStarConfig(max_components=LIMIT, spill=str(tmp_path)), 0, 24)
    divided = [change["out"] for change in changes_of(tmp_path) if len(change["out"]) > 1]
    shares = []
    for pages in divided:
        assert all(8 <= page["count"] <= 16 for page in pages)
        low, high = np.moveaxis(np.array([page["boxes"] for page in pages])[:, 1], 1, 0)  # reach of their components
        shares.extend(np.prod(high - low, axis=1) / np.prod(high.max(0) - low.min(0)))
    assert np.mean(shares) < 0.5, "of the space that all pages of a frame reach"


def test_what_a_killed_process_left_of_a_line_does_not_count(tmp_path):
    config = UfMStarConfig(max_components=LIMIT, spill=str(tmp_path))
    ufm, _, _ = walk(config, 0, 24)
    saved = copy.deepcopy(ufm.state_dict())
    with open(tmp_path / "pages.jsonl", "ab") as journal:
        journal.write(b'{"frames": 25, "out": [{"na')
    again = UfMStar(config, dtype=torch.float64)
    again.load_state_dict(saved)
    again, _, _ = walk(config, 24, FRAMES, again)
    plain, _, _ = walk(UfMStarConfig())
    assert torch.equal(rows(again), rows(plain))
    fresh = UfMStar(config, dtype=torch.float64)
    fresh.load_state_dict(again.state_dict())
    assert torch.equal(rows(fresh), rows(plain)), "the journal can be read to its end"


def test_a_journal_of_this_version_without_its_first_line_is_read(tmp_path):
    config = UfMStarConfig(max_components=LIMIT, spill=str(tmp_path))
    ufm, _, _ = walk(config, 0, 24)
    journal = tmp_path / "pages.jsonl"
    journal.write_text("".join(line + "\n" for line in journal.read_text().splitlines()[1:]))
    again = UfMStar(config, dtype=torch.float64)
    again.load_state_dict(ufm.state_dict())
    assert torch.equal(rows(again), rows(ufm))


@pytest.mark.parametrize(("name", "text"), [("pages-000000000007.json", "[]"), ("pages.jsonl", '{"version": 1}\n')])
def test_a_folder_of_another_version_is_an_error(name, text, tmp_path):
    (tmp_path / name).write_text(text)
    with pytest.raises(ValueError, match="version 1, this release reads version 2"):
        UfMStar(UfMStarConfig(max_components=LIMIT, spill=str(tmp_path)))(*corridor()[0])
    assert [p.name for p in tmp_path.iterdir()] == [name], "nothing was written"


@pytest.mark.parametrize("values", [{"spill": "x"}, {"spill": "", "max_components": 5}])
def test_a_folder_needs_a_limit(values):
    with pytest.raises(ValueError, match="spill needs a folder or 'memory', and max_components"):
        UfMStarConfig(**values)


def test_streams_have_pages_of_their_own(tmp_path):
    """Two streams at different places of the corridor equal two runs of one stream each."""
    config = UfMStarConfig(max_components=LIMIT, spill=str(tmp_path))
    both, starts = UfMStar(config, dtype=torch.float64), (0, 6)
    for i in range(28):
        depth, pose, K = zip(*(corridor()[i + start] for start in starts), strict=True)
        both(torch.cat(depth), torch.stack(pose), torch.stack(K))
    state = both._spill.everything(both.state)
    for b, start in enumerate(starts):
        plain, _, _ = walk(UfMStarConfig(), start, start + 28)
        n = int(state.mixture.components[b])
        table = torch.cat([v[b, :n].double().reshape(n, -1) for v in state.mixture.tensors().values()], 1)
        assert torch.equal(torch.tensor(sorted(table.tolist())), rows(plain))
        assert int(both.mixture.components[b]) < n
        assert (tmp_path / f"stream-{b}" / "pages.jsonl").exists()


@given(seed=st.integers(0, 10**6), pages=st.integers(0, 60))
@settings(max_examples=40)
def test_the_index_returns_what_a_look_at_every_page_returns(seed, pages):
    rng = np.random.default_rng(seed)
    index, scale = PageIndex(), 10 ** rng.uniform(0, 3.5)
    for number in range(pages):
        corner = CELL * np.floor(rng.normal(0, scale, 3) / CELL)
        means = np.sort(corner + rng.uniform(0, CELL, (2, 3)), 0)
        reach = means + np.array([[-1], [1]]) * rng.exponential(2.0, 3)
        index.add(number, Page(f"{number}", 1, np.stack([means, reach])))
    for number in rng.permutation(pages)[: pages // 3]:
        index.remove(int(number))
    for _ in range(5):
        planes = [np.concatenate([rng.normal(size=(n, 3)), rng.normal(0, scale, (n, 1))], 1) for n in (3, 4)]
        view = View(*planes)
        every = view.reaches(np.array([index[n].boxes for n in index]).reshape(-1, 2, 2, 3))
        assert index.reached(view) == [number for number, hit in zip(index, every, strict=True) if hit]
    for number in list(index):
        index.remove(number)
    assert not index._root.children


def test_a_frame_looks_at_few_of_many_pages(monkeypatch):
    """A street of 8 km: the boxes that a view is compared with do not depend on the length behind it."""
    looked = []

    def counting(self, boxes):
        looked[-1] += len(boxes)
        return reaches(self, boxes)

    reaches = View.reaches
    monkeypatch.setattr(View, "reaches", counting)
    ahead = np.array([[0.0, 0.0, 1.0, -1.0]])
    for length in (500, 2000):  # pages of 4 m
        index = PageIndex()
        for number in range(length):
            box = np.array([[0.0, 0.0, -4.0 * number], [3.0, 3.0, -4.0 * number + 3.0]])
            index.add(number, Page("", 1, np.stack([box, box])))
        looked.append(0)
        assert index.reached(View(ahead, ahead)) == [0]
    assert max(looked) < 40

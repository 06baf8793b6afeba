"""Components in files: matching and fusion as if nothing had been written out, memory bounded, resumable."""

from __future__ import annotations

import copy
import functools
import json

import numpy as np
import pytest
import torch

import scenes
from ufmstar_torch import UfMStar, UfMStarConfig
from ufmstar_torch.spill import MEMORY, Folder

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


@pytest.mark.parametrize("kind", ["folder", "memory"])
def test_written_out_and_read_back_equals_never_written_out(kind, tmp_path):
    plain, expected, growing = walk(UfMStarConfig())
    config = UfMStarConfig(max_components=LIMIT, spill=MEMORY if kind == "memory" else str(tmp_path / "out"))
    ufm, maps, counts = walk(config)
    assert torch.equal(rows(ufm), rows(plain)), "to the last bit"
    for ours, theirs in zip(maps, expected, strict=True):
        torch.testing.assert_close(ours, theirs, rtol=1e-5, atol=1e-9, equal_nan=True)
    assert counts[23] < 0.7 * growing[23]
    assert ufm._spill.pages
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
        assert name == "_extra_state" or torch.equal(ours.nan_to_num(-1), value.nan_to_num(-1)), name
    assert all(torch.equal(a.nan_to_num(-1), b.nan_to_num(-1)) for a, b in zip(later, maps[20:], strict=True))
    assert again._spill.pages == whole._spill.pages


def test_a_frame_that_raises_loses_no_page(tmp_path, monkeypatch):
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
        patch.setattr(Folder, "__setitem__", full)
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
    assert all(path.name <= "pages-000000000003.json" for path in tmp_path.glob("*.json")), "old lists are gone"
    fresh, _, _ = walk(UfMStarConfig(), 0, 3)
    assert torch.equal(rows(ufm), rows(fresh))


def test_files_are_named_by_their_content_and_lists_by_frames(tmp_path):
    ufm, _, _ = walk(UfMStarConfig(max_components=LIMIT, spill=str(tmp_path)), 0, 24)
    lists = sorted(tmp_path.glob("pages-*.json"))
    assert lists
    assert int(lists[-1].stem.split("-")[1]) <= 24
    listed = json.loads(lists[-1].read_text())
    assert {page["name"] for page in listed} <= {p.name for p in tmp_path.glob("*.npy")}
    assert sum(page["count"] for page in listed) + int(ufm.mixture.components) == len(rows(ufm))


@pytest.mark.parametrize("values", [{"spill": "x"}, {"spill": "", "max_components": 5}])
def test_a_folder_needs_a_limit(values):
    with pytest.raises(ValueError, match="spill needs a folder or 'memory', and max_components"):
        UfMStarConfig(**values)


def test_one_stream_only():
    depth, pose, K = corridor()[0]
    ufm = UfMStar(UfMStarConfig(max_components=LIMIT, spill=MEMORY))
    with pytest.raises(ValueError, match="spill needs one stream, got 2"):
        ufm(depth.expand(2, -1, -1), pose, K)

"""The cache of predictions: cached values equal the predictions; no wrong entry is read."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from layouts import truncate, write_generic, write_image
from tiny_suite import CPU, evaluate, row, same

from ufmstar_torch.eval.engine.predictions import CacheError, PredictionCache, frame_digest, sequence_digest
from ufmstar_torch.eval.sequences import open_sequence
from ufmstar_torch.frames.prediction import DepthPrediction

ROWS = [row(name) for name in ("Ensemble", "UfM*-Ensemble", "UfM*-MCD", "MC-Dropout", "Evidential", "UfM-DepthOnly")]
PATH, CONTENT = Path("network", "sequence", "frame-7@all.npz"), "c" * 64


@pytest.fixture(scope="module")
def path(tmp_path_factory):
    return write_generic(tmp_path_factory.mktemp("cache"), frames=4)[0]


def maps(seed=0):
    depth, a, e = torch.rand(3, 5, 7, generator=torch.Generator().manual_seed(seed)).unbind()
    depth[0, 0], a[1, 1], e[2, 2] = torch.nan, torch.inf, -0.0
    K = torch.arange(9.0, dtype=torch.float64).reshape(1, 3, 3) / 7
    return DepthPrediction(depth[None], a[None], e[None], intrinsics=K)


class Counted(PredictionCache):
    """Counts cache hits and misses."""

    hits = misses = 0

    def load(self, path, content, device):
        cached = super().load(path, content, device)
        self.hits += cached is not None
        self.misses += cached is None
        return cached


@pytest.mark.parametrize("left_out", [(), ("aleatoric_variance",), ("aleatoric_variance", "epistemic_variance")])
def test_what_is_stored_is_read_bit_for_bit(tmp_path, left_out):
    cache, whole = Counted(tmp_path / "new" / "cache"), maps()
    written = replace(whole, **dict.fromkeys(left_out))
    assert cache.load(PATH, CONTENT, CPU) is None
    cache.store(PATH, CONTENT, written)
    read = cache.load(PATH, CONTENT, CPU)
    assert (cache.hits, cache.misses) == (1, 1)
    for name in ("depth", "aleatoric_variance", "epistemic_variance"):
        one, other = getattr(read, name), getattr(written, name)
        assert one is other is None or torch.equal(one.view(torch.int32), other.view(torch.int32))
    assert torch.equal(read.intrinsics, written.intrinsics)
    assert read.ms is None


def test_path_and_content_matter(tmp_path):
    cache = Counted(tmp_path)
    cache.store(PATH, CONTENT, maps())
    assert cache.load(PATH.with_name("frame-7@0.npz"), CONTENT, CPU) is None
    assert cache.load(PATH, "d" * 64, CPU) is None
    assert (cache.hits, cache.misses) == (0, 2)


@pytest.mark.parametrize("damage", ["flip", "cut", "empty", "short"])
def test_a_damaged_file_is_noticed_and_replaced(tmp_path, damage):
    cache = Counted(tmp_path)
    cache.store(PATH, CONTENT, maps())
    file, content = tmp_path / PATH, (tmp_path / PATH).read_bytes()
    if damage == "flip":
        at = len(content) // 2
        file.write_bytes(content[:at] + bytes([content[at] ^ 1]) + content[at + 1 :])
    else:
        truncate(file, {"cut": 0.9, "empty": 0.0, "short": 20 / len(content)}[damage])
    assert cache.load(PATH, CONTENT, CPU) is None
    cache.store(PATH, CONTENT, maps())
    assert cache.load(PATH, CONTENT, CPU) is not None


def test_two_who_write_the_same_do_no_harm(tmp_path):
    caches, written = [Counted(tmp_path) for _ in range(4)], maps()

    def work(cache):
        for _ in range(25):
            cache.store(PATH, CONTENT, written)
            assert cache.load(PATH, CONTENT, CPU) is not None

    with ThreadPoolExecutor(4) as pool:
        list(pool.map(work, caches))
    assert [(cache.hits, cache.misses) for cache in caches] == [(25, 0)] * 4
    assert [file.name for file in tmp_path.rglob("*") if file.name.endswith(".tmp")] == []


def test_a_folder_that_cannot_be_written_is_named(tmp_path):
    (tmp_path / "file").write_text("in the way")
    with pytest.raises(CacheError, match="file"):
        PredictionCache(tmp_path / "file")
    cache = Counted(tmp_path / "cache")
    (tmp_path / "cache" / PATH.parts[0]).write_text("in the way")
    with pytest.raises(CacheError, match="cannot be written"):
        cache.store(PATH, CONTENT, maps())


def test_from_the_cache_everything_is_as_from_the_networks(path, networks, tmp_path):
    sequence, cache = open_sequence(path), Counted(tmp_path)
    without = evaluate(sequence, ROWS, networks)
    first = evaluate(sequence, ROWS, networks, cache)
    requested = 4 * 6  # frames, and predictions per frame: ensemble full and single, MC-Dropout both, two networks
    assert (cache.hits, cache.misses) == (0, requested)
    again = Counted(tmp_path)
    second = evaluate(sequence, ROWS, networks, again)
    assert (again.hits, again.misses) == (requested, 0)
    for slug, result in without.items():
        assert same(result, first[slug])
        assert same(result, second[slug])
        assert "network" in first[slug].ms
        assert "network" not in second[slug].ms, "no network ran, so there is no time to report"
        assert "uncertainty" in second[slug].ms


def test_another_image_under_the_same_name_is_predicted_anew(networks, tmp_path):
    path, scene = write_generic(tmp_path, frames=3)
    rows, folder = [row("Evidential")], tmp_path / "cache"
    before = evaluate(open_sequence(path), rows, networks, PredictionCache(folder))
    write_image(path / "images" / "8.png", 255 - scene.images[1])
    cache = Counted(folder)
    after = evaluate(open_sequence(path), rows, networks, cache)
    assert (cache.hits, cache.misses) == (2, 1)
    fresh = evaluate(open_sequence(path), rows, networks)
    assert same(after["Evidential"], fresh["Evidential"])
    assert not same(after["Evidential"], before["Evidential"])


def test_digests_tell_frames_and_sequences_apart(tmp_path):
    one, other = (open_sequence(write_generic(tmp_path, frames=3, folder=name)[0]) for name in ("one", "other"))
    assert sequence_digest(one) != sequence_digest(other)
    assert sequence_digest(one) == sequence_digest(open_sequence(tmp_path / "one"))
    frame = one[1]
    moved = frame.intrinsics.copy()
    moved[0, 2] += 1
    changed = [replace(frame, intrinsics=moved), replace(frame, index=2), replace(frame, image=frame.image[:, ::-1])]
    assert len({frame_digest(f) for f in [frame, *changed]}) == 4
    assert frame_digest(replace(frame, name="x", depth=None)) == frame_digest(frame)

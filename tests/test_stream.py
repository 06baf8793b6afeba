"""The loop over frames: decoded images, cost of skipped frames, stopping, cached predictions."""

from __future__ import annotations

import threading
from dataclasses import replace

import numpy as np
import pytest
import torch
from runs import Brightness, networks
from tiny_suite import CPU

from ufmstar_torch import UfMStarConfig
from ufmstar_torch.eval.engine.estimators import Alone, Gaussians, output_of
from ufmstar_torch.eval.engine.maps import own_depth
from ufmstar_torch.eval.engine.predictions import PredictionCache
from ufmstar_torch.eval.engine.rows import RowRunner
from ufmstar_torch.eval.engine.stream import FrameResult, Stopped, frame_progress, frame_results
from ufmstar_torch.eval.methods.setting import Setting
from ufmstar_torch.eval.sequences import FrameError

FRAMES = 6  # of the fixture sequence


def results_of(sequence, indices, rows, **options):
    """The results of all frames."""
    return list(frame_results(sequence, indices, rows, **options))


def counted(sequence, broken=()):
    """The sequence, with images that record their decoding; some cannot be decoded."""
    decoded = []

    def load(i, entry):
        decoded.append(i)
        if i in broken:
            raise FrameError(entry.name, "cannot be decoded")
        return entry.load_image()

    entries = [replace(e, load_image=lambda i=i, e=e: load(i, e)) for i, e in enumerate(sequence.entries)]
    return replace(sequence, entries=tuple(entries)), decoded


def in_turn(key="row", members=2, **options):
    source = networks(*(Brightness(1 + 0.1 * n, spread=0.02) for n in range(members)))
    return RowRunner(key, source, Alone(), **options)


def test_every_frame_has_a_result_in_order(sequence):
    results = results_of(sequence, range(1, FRAMES, 2), [in_turn()])
    assert [(result.number, result.index) for result in results] == [(0, 1), (1, 3), (2, 5)]
    assert [result.name for result in results] == [sequence.names[i] for i in (1, 3, 5)]
    assert all(result.ms.keys() == {"read", "predict", "truth", "cycle"} for result in results)


def test_a_frame_that_no_row_selects_is_not_decoded(sequence):
    watched, decoded = counted(sequence)
    results = results_of(watched, range(FRAMES), [in_turn(setting=Setting(skip=2))])
    assert decoded == [0, 3]
    assert [result.frame is not None for result in results] == [True, False, False, True, False, False]
    assert all(not result.rows and not result.skipped for result in results if result.frame is None)


def test_an_unreadable_frame_is_skipped_by_the_rows_that_select_it_and_takes_no_turn(sequence):
    watched, _ = counted(sequence, broken=(2,))
    rows = [in_turn("all"), in_turn("odd", setting=Setting(skip=2))]
    results = results_of(watched, range(FRAMES), rows)
    assert [dict(result.skipped) for result in results if result.skipped] == [{"all": "cannot be decoded"}]
    members = [result.rows["all"].out.member for result in results if "all" in result.rows]
    assert members == [0, 1, 0, 1, 0]
    assert results[2].frame is None


def test_a_frame_with_an_unusable_pose_is_skipped_and_takes_no_turn(sequence):
    entries = list(sequence.entries)
    stretched = entries[1].T_world_cam.copy()
    stretched[:3, :3] *= 1.3
    entries[1] = replace(entries[1], T_world_cam=stretched)
    members = Brightness(1.0), Brightness(1.1)
    runner = RowRunner("row", networks(*members), Gaussians(UfMStarConfig(), CPU))
    results = results_of(replace(sequence, entries=tuple(entries)), range(4), [runner])
    assert [member.calls for member in members] == [2, 1]
    assert "not orthonormal" in results[1].skipped["row"]
    assert [result.rows["row"].out.member for result in results if result.rows] == [0, 1, 0]


def test_ground_truth_is_at_the_pixels_of_each_rows_maps(sequence):
    rows = [in_turn("network"), RowRunner("depth", own_depth((12, 16)), Alone())]
    blind = replace(sequence.entries[1], load_depth=None)
    entries = (sequence.entries[0], blind)
    results = results_of(replace(sequence, entries=entries), range(2), rows[:1])
    assert results[0].rows["network"].truth.shape == (24, 32)
    assert results[1].rows["network"].truth is None
    results = results_of(sequence, range(1), rows)
    depth = results[-1].rows["depth"]
    np.testing.assert_array_equal(depth.truth, depth.depth.numpy())
    assert depth.out.member is None
    assert "network" not in depth.ms


def test_it_stops_between_frames_and_ends_its_thread(sequence):
    shown, before = [], threading.active_count()
    progress = frame_progress(lambda now: shown.append((now.done, now.total)), FRAMES)
    stream = frame_results(sequence, range(FRAMES), [in_turn()], stop=lambda: len(shown) > 2)
    assert next(stream).number == 0
    progress(FrameResult(0, 0, "a"))
    assert next(stream).number == 1
    progress(FrameResult(1, 1, "b"))
    with pytest.raises(Stopped):
        next(stream)
    assert shown == [(0, FRAMES), (1, FRAMES), (2, FRAMES)]
    assert threading.active_count() == before
    unfinished = frame_results(sequence, range(FRAMES), [in_turn()])
    next(unfinished)
    unfinished.close()
    assert threading.active_count() == before


def test_predictions_of_a_cache_give_the_same_bits_and_run_no_network(sequence, tmp_path):
    def never():
        raise AssertionError("the network was called")

    def cached(**trouble):
        source = networks(Brightness(1.0, spread=0.02, **trouble), Brightness(1.1, spread=0.02, **trouble))
        source.digest = "0" * 64
        row = RowRunner("row", source, Gaussians(UfMStarConfig(), CPU))
        return results_of(sequence, range(FRAMES), [row], cache=PredictionCache(tmp_path))

    first, again = cached(), cached(at=0, then=never)
    assert len(list(tmp_path.rglob("*@*.npz"))) == FRAMES
    for one, other in zip(first, again, strict=True):
        for name in ("depth", "variance", "disagreement", "aleatoric"):
            np.testing.assert_array_equal(other.rows["row"].map(name), one.rows["row"].map(name))
        assert "network" in one.rows["row"].ms
        assert "network" not in other.rows["row"].ms


def test_the_output_of_a_method_other_than_ufm_star():
    depth, valid = torch.ones(1, 2, 2), torch.tensor([[[True, True], [True, False]]])
    out = output_of(depth, 0.1 * depth, valid, aleatoric=0.2 * depth, epistemic=None)
    assert out.variance.isnan().equal(~valid)
    assert out.maps.keys() == {"aleatoric"}
    assert (int(out.statistics.valid_pixels[0]), int(out.statistics.components[0])) == (3, 0)
    assert output_of(depth, None, valid).variance.isnan().all()

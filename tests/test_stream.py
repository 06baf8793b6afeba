"""The loop over frames: order of the sinks, decoded images, cost of skipped frames, stopping and continuing."""

from __future__ import annotations

import copy
from dataclasses import replace

import numpy as np
import pytest
import torch
from runs import Brightness, networks
from tiny_suite import CPU, row

from ufmstar_torch import UfMStarConfig
from ufmstar_torch.eval.engine.anchors import anchor_sources
from ufmstar_torch.eval.engine.estimators import Alone, Gaussians, make_estimator
from ufmstar_torch.eval.engine.maps import own_depth
from ufmstar_torch.eval.engine.progress import ProgressSink
from ufmstar_torch.eval.engine.rows import RowRunner
from ufmstar_torch.eval.engine.stream import FrameSink, FrameStream, Stopped
from ufmstar_torch.eval.methods.setting import Setting
from ufmstar_torch.eval.sequences import FrameError
from ufmstar_torch.eval.sequences.frame import in_memory
from ufmstar_torch.eval.tour.sequence import open_tour

FRAMES = 6  # of the fixture sequence


class Recorded(FrameSink):
    """Records every call in a list shared by the sinks, and stores the results."""

    def __init__(self, name, calls):
        self.name, self.calls, self.results = name, calls, []

    def begin(self, stream):
        self.calls.append((self.name, "begin", stream.position))

    def take(self, result):
        self.calls.append((self.name, "take", result.number))
        self.results.append(result)

    def end(self):
        self.calls.append((self.name, "end", None))


@pytest.fixture(scope="module")
def tour():
    """Rendered frames in memory, with corners to track."""
    return in_memory(open_tour("tour:5?frames=6&size=96x128"))


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


def test_sinks_get_every_frame_in_their_order(sequence):
    calls = []
    first, second = Recorded("first", calls), Recorded("second", calls)
    stream = FrameStream(sequence, range(1, FRAMES, 2), [in_turn()])
    stream.drive([first, second])
    assert calls[:2] == [("first", "begin", 0), ("second", "begin", 0)]
    assert calls[2:-2] == [(name, "take", number) for number in range(3) for name in ("first", "second")]
    assert calls[-2:] == [("first", "end", None), ("second", "end", None)]
    assert [result.index for result in second.results] == [1, 3, 5]
    assert [result.name for result in second.results] == [sequence.names[i] for i in (1, 3, 5)]
    assert all(result.ms.keys() == {"read", "predict", "truth"} for result in second.results)
    assert stream.position == 3


def test_a_frame_that_no_row_selects_is_not_decoded(sequence):
    watched, decoded = counted(sequence)
    sink = Recorded("sink", [])
    FrameStream(watched, range(FRAMES), [in_turn(setting=Setting(skip=2))]).drive([sink])
    assert decoded == [0, 3]
    assert [result.frame is not None for result in sink.results] == [True, False, False, True, False, False]
    assert all(not result.rows and not result.skipped for result in sink.results if result.frame is None)


def test_an_unreadable_frame_is_skipped_by_the_rows_that_select_it_and_takes_no_turn(sequence):
    watched, _ = counted(sequence, broken=(2,))
    sink, rows = Recorded("sink", []), [in_turn("all"), in_turn("odd", setting=Setting(skip=2))]
    FrameStream(watched, range(FRAMES), rows).drive([sink])
    assert [dict(result.skipped) for result in sink.results if result.skipped] == [{"all": "cannot be decoded"}]
    members = [result.rows["all"].member for result in sink.results if "all" in result.rows]
    assert members == [0, 1, 0, 1, 0]
    assert sink.results[2].frame is None


def test_a_frame_that_the_estimator_refuses_takes_a_turn(sequence):
    entries = list(sequence.entries)
    stretched = entries[1].T_world_cam.copy()
    stretched[:3, :3] *= 1.3
    entries[1] = replace(entries[1], T_world_cam=stretched)
    source = networks(Brightness(1.0), Brightness(1.1))
    estimator = Gaussians(UfMStarConfig(on_bad_frame="skip"), CPU)
    sink, runner = Recorded("sink", []), RowRunner("row", source, estimator, skips_faults=True)
    FrameStream(replace(sequence, entries=tuple(entries)), range(4), [runner]).drive([sink])
    assert "not orthonormal" in sink.results[1].skipped["row"]
    assert [result.rows["row"].member for result in sink.results if result.rows] == [0, 0, 1]


def test_ground_truth_is_at_the_pixels_of_each_rows_maps(sequence):
    sink, rows = Recorded("sink", []), [in_turn("network"), RowRunner("depth", own_depth((12, 16)), Alone())]
    blind = replace(sequence.entries[1], load_depth=None)
    entries = (sequence.entries[0], blind)
    FrameStream(replace(sequence, entries=entries), range(2), rows[:1]).drive([sink])
    assert sink.results[0].rows["network"].truth.shape == (24, 32)
    assert sink.results[1].rows["network"].truth is None
    FrameStream(sequence, range(1), rows).drive([sink])
    depth = sink.results[-1].rows["depth"]
    np.testing.assert_array_equal(depth.truth, depth.depth.numpy())
    assert depth.member is None
    assert "network" not in depth.ms


def test_it_stops_between_frames_and_goes_on(sequence):
    calls, seen = [], []
    stream = FrameStream(sequence, range(FRAMES), [in_turn()])
    with pytest.raises(Stopped):
        stream.drive(
            [Recorded("sink", calls), ProgressSink(lambda now: seen.append((now.done, now.total)))],
            stop=lambda: len(seen) > 2,
        )
    assert calls == [("sink", "begin", 0), ("sink", "take", 0), ("sink", "take", 1)]
    assert seen == [(0, FRAMES), (1, FRAMES), (2, FRAMES)]
    sink = Recorded("sink", calls)
    stream.drive([sink])
    assert [result.number for result in sink.results] == [2, 3, 4, 5]
    assert sink.results[0].rows["row"].member == 0
    assert calls[-1] == ("sink", "end", None)


def rows_with_memory():
    """UfM* with tracked anchors at drifting poses, and a row that skips images."""
    expected = [
        row("UfM*-DepthOnly", anchors="corners", rotation_drift=0.3, translation_drift=0.01, seed=2),
        row("UfM*-DepthOnly", anchors="corners", rotation_drift=0.3, translation_drift=0.01, seed=2, posterior=True),
        row("UfM*-DepthOnly", skip=1),
    ]
    anchors, source = anchor_sources(expected), networks(Brightness(1.0), Brightness(1.1))
    return [
        RowRunner(one.slug, source, make_estimator(one, CPU), setting=one.setting, anchors=anchors.get(one))
        for one in expected
    ]


def test_a_state_taken_at_any_frame_gives_the_same_bits(tour):
    sink, states = Recorded("sink", []), []
    whole = FrameStream(tour, range(FRAMES), rows_with_memory())

    class States(FrameSink):
        def take(self, result):
            states.append(copy.deepcopy(whole.state()))

    whole.drive([sink, States()])
    for start in range(1, FRAMES):
        rows = rows_with_memory()
        for one in rows:
            one.load_state(states[start - 1][one.key])
        stream = FrameStream(tour, range(FRAMES), rows, start=start)
        again = Recorded("again", [])
        stream.drive([again])
        assert len(again.results) == FRAMES - start
        for expected, actual in zip(sink.results[start:], again.results, strict=True):
            assert actual.rows.keys() == expected.rows.keys()
            for key, one in expected.rows.items():
                other = actual.rows[key]
                assert other.member == one.member
                np.testing.assert_array_equal(other.T_world_cam, one.T_world_cam)
                np.testing.assert_array_equal(other.variance.numpy(), one.variance.numpy())
        last = stream.state()
        assert last.keys() == states[-1].keys()
        assert all(torch.equal(value, states[-1][key][name]) for key in last for name, value in last[key].items())


def test_the_state_of_another_estimator_is_refused():
    gaussians = RowRunner("row", own_depth(), Gaussians(UfMStarConfig(), CPU))
    with pytest.raises(RuntimeError, match=r"Unexpected key.*mean"):
        RowRunner("row", own_depth(), Alone()).load_state(gaussians.state())
    with pytest.raises(RuntimeError, match=r"Missing key.*mean"):
        gaussians.load_state({"image_index": torch.tensor(0)})

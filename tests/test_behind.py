"""Prefetched frames and sinks in the writer thread: order, completion at the loop's end, and where errors are
raised."""

from __future__ import annotations

import copy
import threading
import time
from dataclasses import replace

import pytest
import torch
from layouts import write_generic
from runs import Brightness, networks

from ufmstar_torch import UfMStarConfig
from ufmstar_torch.eval.engine.estimators import Gaussians
from ufmstar_torch.eval.engine.rows import RowRunner
from ufmstar_torch.eval.engine.stream import FrameSink, FrameStream, prefetch
from ufmstar_torch.eval.engine.writer_thread import WriterThread
from ufmstar_torch.eval.sequences import FrameError, open_sequence

FRAMES = 9


@pytest.fixture(scope="module")
def sequence(tmp_path_factory):
    return open_sequence(write_generic(tmp_path_factory.mktemp("behind"), frames=FRAMES)[0])


class Slow(FrameSink):
    """A slow sink in the writer thread; fails at a given frame."""

    def __init__(self, at=None, error=None):
        self.at, self.error = at, error
        self.results, self.threads, self.ended = [], set(), False

    def take(self, result):
        if result.number == self.at:
            raise self.error
        time.sleep(0.01)
        self.threads.add(threading.get_ident())
        self.results.append(result)

    def end(self):
        self.ended = True


def stream_of(sequence, network=None):
    row = RowRunner("row", networks(network or Brightness()), Gaussians(UfMStarConfig(), torch.device("cpu")))
    return FrameStream(sequence, range(FRAMES), [row])


def test_every_frame_comes_in_order_with_the_state_after_it(sequence):
    """The states equal those of a loop without a thread after the same frames."""
    expected = []

    class States(FrameSink):
        def take(self, result):
            expected.append(copy.deepcopy(plain.state()["row"]))

    plain = stream_of(sequence)
    plain.drive([States()])
    first, second = Slow(), Slow()
    with WriterThread([first, second]) as behind:
        stream_of(sequence).drive([behind])
    assert [r.number for r in first.results] == [r.number for r in second.results] == list(range(FRAMES))
    assert len(first.threads | second.threads) == 1
    assert threading.get_ident() not in first.threads
    assert first.ended
    assert second.ended
    for result, state in zip(first.results, expected, strict=True):
        assert result.state["row"].keys() == state.keys()
        assert all(torch.equal(value, state[name]) for name, value in result.state["row"].items())
        assert result.ms.keys() == {"read", "predict", "truth", "cycle"}


@pytest.mark.parametrize("error", [OSError("full"), ValueError("a mistake")], ids=["disk", "program"])
def test_an_error_of_a_sink_ends_the_loop_and_no_later_frame_is_taken(sequence, error):
    sink, after = Slow(at=2, error=error), Slow()
    with pytest.raises(type(error), match=str(error)), WriterThread([sink, after]) as behind:
        stream_of(sequence).drive([behind])
    assert [result.number for result in after.results] == [0, 1]
    assert not sink.ended


@pytest.mark.parametrize("error", [KeyboardInterrupt, RuntimeError])
def test_whatever_ends_the_loop_all_frames_that_were_computed_are_through(sequence, error):
    def fail():
        raise error

    sink = Slow()
    with pytest.raises(error), WriterThread([sink]) as behind:
        stream_of(sequence, Brightness(at=6, then=fail)).drive([behind])
    assert [result.number for result in sink.results] == list(range(6))
    assert not sink.ended


def test_only_a_few_frames_wait(sequence):
    """The loop waits for slow sinks, so that memory is bounded."""
    behind_by = []

    class Count(FrameSink):
        def take(self, result):
            behind_by.append(result.number + 1 - len(slow.results))

    slow = Slow()
    with WriterThread([slow]) as behind:
        stream_of(sequence).drive([behind, Count()])
    assert max(behind_by) <= 6  # 5 queued, and one being written


def test_frames_are_read_ahead_in_order_by_one_thread(sequence):
    read = []

    def load(i, entry):
        read.append((i, threading.get_ident()))
        if i == 3:
            raise FrameError(entry.name, "cannot be decoded")
        return entry.load_image()

    entries = [replace(e, load_image=lambda i=i, e=e: load(i, e)) for i, e in enumerate(sequence.entries)]
    frames = prefetch(replace(sequence, entries=tuple(entries)), [1, 3, 4, 6])
    assert next(frames).result().index == 1
    with pytest.raises(FrameError, match="cannot be decoded"):
        next(frames).result()
    assert [frame.result().index for frame in frames] == [4, 6]
    assert [i for i, _ in read] == [1, 3, 4, 6]
    assert {thread for _, thread in read} != {threading.get_ident()}
    assert len({thread for _, thread in read}) == 1

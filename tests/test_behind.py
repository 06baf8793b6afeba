"""Prefetched frames and the writer thread: order, completion at the loop's end, and where errors are raised."""

from __future__ import annotations

import threading
import time

import pytest
from layouts import write_generic

from ufmstar_torch.eval.engine.threads import call_behind, read_ahead
from ufmstar_torch.eval.sequences import FrameError, open_sequence

FRAMES = 9


class Slow:
    """A slow writer; fails at a given frame."""

    def __init__(self, at=None, error=None):
        self.at, self.error = at, error
        self.numbers, self.threads = [], set()

    def write(self, number):
        if number == self.at:
            raise self.error
        time.sleep(0.01)
        self.threads.add(threading.get_ident())
        self.numbers.append(number)


def write_all(slow, fail_at=None, error=None):
    """Write the frames in a thread; the loop itself may fail at a frame."""
    with call_behind() as call:
        for number in range(FRAMES):
            if number == fail_at:
                raise error
            call(slow.write, number)


def test_every_frame_is_written_in_order_by_another_thread():
    slow = Slow()
    write_all(slow)
    assert slow.numbers == list(range(FRAMES))
    assert len(slow.threads) == 1
    assert threading.get_ident() not in slow.threads


@pytest.mark.parametrize("error", [OSError("full"), ValueError("a mistake")], ids=["disk", "program"])
def test_an_error_ends_the_loop_and_no_later_frame_is_written(error):
    slow = Slow(at=2, error=error)
    with pytest.raises(type(error), match=str(error)):
        write_all(slow)
    assert slow.numbers == [0, 1]


@pytest.mark.parametrize("error", [KeyboardInterrupt, RuntimeError])
def test_whatever_ends_the_loop_all_frames_that_were_computed_are_through(error):
    slow = Slow()
    with pytest.raises(error):
        write_all(slow, fail_at=6, error=error)
    assert slow.numbers == list(range(6))


def test_only_a_few_frames_wait():
    """The loop waits for slow writers, so that memory is bounded."""
    slow, behind_by = Slow(), []
    with call_behind() as call:
        for number in range(FRAMES):
            call(slow.write, number)
            behind_by.append(number + 1 - len(slow.numbers))
    assert max(behind_by) <= 4  # 3 queued, and one being written


def test_frames_are_read_ahead_in_order_by_one_thread(tmp_path):
    sequence, read = open_sequence(write_generic(tmp_path, frames=FRAMES)[0]), []

    def load(index):
        read.append((index, threading.get_ident()))
        if index == 3:
            raise FrameError("3", "cannot be decoded")
        return sequence[index]

    frames = read_ahead(load, [1, 3, 4, 6])
    assert next(frames).result().index == 1
    with pytest.raises(FrameError, match="cannot be decoded"):
        next(frames).result()
    assert [frame.result().index for frame in frames] == [4, 6]
    assert [i for i, _ in read] == [1, 3, 4, 6]
    assert {thread for _, thread in read} != {threading.get_ident()}
    assert len({thread for _, thread in read}) == 1

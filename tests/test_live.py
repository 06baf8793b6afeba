"""``LiveDepth``: processed and dropped images, late and missing poses, errors (its state: test_live_state.py)."""

from __future__ import annotations

import threading
import time

import numpy as np
import pytest
import torch
from live_model import HANGS, PICTURE, K, Network, at, compiled, model, network, require_all_counted, show, stamps

from ufmstar_torch import AnchorConfig, LiveDepth, UfMStarConfig, UncertainDepth
from ufmstar_torch.frames.clock import StreamClock, Verdict
from ufmstar_torch.frames.image_queue import BACKWARDS, CLOSED, DOUBTFUL, GAP, LATE, LOST, NEWER

__all__ = ["compiled", "model", "network"]


def test_a_result_has_the_pose_at_its_stamp(model):
    """Poses arrive in any order. A later pose with the same stamp replaces the earlier one."""
    results = []
    with LiveDepth(model, results.append, K) as live:
        for stamp, x in ((0.1, 1), (0.0, 5), (0.0, 0)):
            live.push_pose(stamp, at(x))
        live.push_image(0.025, torch.zeros(3, 48, 64, dtype=torch.uint8))
        assert live.wait_idle(HANGS)
    (result,) = results
    assert live.statistics.poses == 3
    np.testing.assert_allclose(result.T_world_cam, at(0.25), atol=1e-12)
    assert result.out.depth.shape == (1, 48, 64)
    assert bool((result.out.variance > 0).any())
    assert 0 < result.finished - result.started <= result.latency
    same = UncertainDepth(Network())(PICTURE, at(0.25), K)
    torch.testing.assert_close(result.out.variance, same.variance)


def test_a_late_pose_is_waited_for_and_others_go_on_being_pushed(model):
    results = []
    with LiveDepth(model, results.append, K, max_wait=HANGS) as live:
        live.push_pose(0.0, at(0))
        for n in range(1, 40):  # more images than the queue holds; the oldest image's pose arrives first
            live.push_image(n / 100, PICTURE)
        time.sleep(0.05)
        assert not results
        live.push_pose(0.015, at(1))
        while not results:
            time.sleep(0.001)
        assert stamps(results) == [0.01]
        live.push_pose(0.15, at(2))
        live.push_pose(0.4, at(2))  # a gap around the newest image
        assert live.wait_idle(HANGS)
        assert live.statistics.skipped == {GAP: 1}
    assert stamps(results) == [0.01, 0.15]
    require_all_counted(live)


def test_the_newest_image_wins_while_the_model_is_busy(model, network):
    results = []
    network.gate.clear()
    with LiveDepth(model, results.append, K) as live:
        for n in range(4):
            live.push_pose(n / 100, at(n / 100))
        live.push_image(0.0, PICTURE)
        assert network.entered.wait(HANGS)
        for n in (1, 2, 3):
            live.push_image(n / 100, PICTURE)
        network.gate.set()
        assert live.wait_idle(HANGS)
    assert stamps(results) == [0.0, 0.03]
    assert require_all_counted(live).dropped == {NEWER: 2}


def test_the_image_may_be_overwritten_after_the_push(model, network):
    network.gate.clear()
    results, buffer = [], PICTURE.copy()
    with LiveDepth(model, results.append, K) as live:
        live.push_pose(0, at(0))
        live.push_image(0, buffer)
        buffer[:] = 255
        network.gate.set()
        assert live.wait_idle(HANGS)
    assert not results[0].image.any()


def test_why_images_are_skipped(model, caplog):
    results = []
    with LiveDepth(model, results.append, K, max_wait=0.02, max_gap=0.1) as live:
        live.push_image(0.5, PICTURE)  # no pose at all
        assert live.wait_idle(HANGS)
        assert live.statistics.skipped == {LATE: 1}
        for stamp, T in ((1.0, at(0)), (1.05, np.full((4, 4), np.nan)), (1.1, at(0)), (1.5, at(0))):
            live.push_pose(stamp, T)
        for stamp in (0.9, 1.02, 1.07, 1.3):  # before all poses, before and after a lost pose, in a gap
            live.push_image(stamp, PICTURE)
            assert live.wait_idle(HANGS)
        for stamp in (1.3, 0.2):  # its stamp is not after the previous one
            live.push_image(stamp, PICTURE)
        live.push_image(1.5, PICTURE)
        live.push_image(1.504, PICTURE)  # its next pose never arrives: use the pose within 5 ms
        assert live.wait_idle(HANGS)
    assert stamps(results) == [1.5, 1.504]
    assert require_all_counted(live).skipped == {LATE: 1, GAP: 2, LOST: 2, BACKWARDS: 2}
    assert "image at 0.500 s skipped: no pose in time (poses: none" in caplog.text
    assert caplog.text.count(BACKWARDS) == 1


@pytest.mark.parametrize("wrong", [1e6, 30.0, -1e6])
@pytest.mark.parametrize("what", ["pose", "image"])
def test_a_single_wrong_stamp_is_dropped_and_counted(model, what, wrong, caplog):
    results = []
    with LiveDepth(model, results.append, K, max_wait=HANGS) as live:
        for n in range(6):
            if n in (0, 3):  # also before the first pose or image
                live.push_pose(wrong, at(9)) if what == "pose" else live.push_image(wrong, PICTURE)
            live.push_pose(n / 30, at(n / 100))
            live.push_image(n / 30, PICTURE)
            if n > 2:
                assert live.wait_idle(HANGS)
        counts = require_all_counted(live)
    assert [round(stamp * 30) for stamp in stamps(results) if stamp != wrong][-3:] == [3, 4, 5]
    assert (counts.dropped_poses, counts.skipped.get(DOUBTFUL, 0)) >= ((1, 0) if what == "pose" else (0, 1))
    assert all(result.T_world_cam[0, 3] < 1 for result in results if result.stamp != wrong)
    assert caplog.text.count("clock jumped") == 1, "only after the wrong first stamp"


@pytest.mark.parametrize("jump", [1e6, 10.0, -10.0, -1e6])
def test_a_clock_that_jumps_is_named_and_followed_after_three_frames(model, jump, caplog):
    results = []
    with LiveDepth(model, results.append, K, max_wait=HANGS) as live:
        for n in range(5):
            show(live, 2e6 + n / 30, x=n / 100)
        for n in range(8):
            live.push_pose(2e6 + jump + n / 30, at(n / 100))
            live.push_image(2e6 + jump + n / 30, PICTURE)
            if n > 1:
                assert live.wait_idle(HANGS)
        counts = require_all_counted(live)
    assert stamps(results)[-6:] == [2e6 + jump + n / 30 for n in range(2, 8)]
    assert counts.skipped == {DOUBTFUL: 2}
    assert counts.dropped_poses == 0, "the poses before the third one are of the new clock"
    assert "the images' clock jumped from 2000000.133 s" in caplog.text
    assert "the poses' clock jumped from 2000000.133 s" in caplog.text


def test_poses_that_are_sent_again_replace_the_earlier_ones(model, caplog):
    """As after a loop closure; poses that are older than the buffer do not count as another clock."""
    results = []
    with LiveDepth(model, results.append, K, max_wait=HANGS) as live:
        for n in range(200):
            live.push_pose(n / 20, at(0))
        live.push_image(9.9, PICTURE)
        for n in range(-100, 200):
            live.push_pose(n / 20, at(1))
        live.push_image(9.925, PICTURE)
        assert live.wait_idle(HANGS)
    assert stamps(results)[-1] == 9.925
    assert results[-1].T_world_cam[0, 3] == 1
    assert "jumped" not in caplog.text


def test_a_slow_stream_and_a_pause_are_no_jump(monkeypatch):
    now = 0.0
    clock = StreamClock()
    assert clock.judge(0.0, now) == Verdict.USE
    for n in range(1, 10):  # a frame every 30 s, replayed at once
        expected = {1: Verdict.WAIT, 2: Verdict.WAIT, 3: Verdict.JUMPED}.get(n, Verdict.USE)
        assert clock.judge(30.0 * n, now) == expected
    assert clock.judge(270.0 + 3600.0, now + 3600.0) == Verdict.USE  # an hour without frames
    assert clock.judge(3871.0, now + 3600.0) == Verdict.USE
    for stamp in (1e9, 5e8, 7e8, 1e5):  # damaged stamps that do not agree
        assert clock.judge(stamp, now + 3600.0) == Verdict.WAIT
    assert clock.judge(3872.0, now + 3600.0) == Verdict.USE


def test_a_reset_forgets_views_and_times(model):
    results = []
    with LiveDepth(model, results.append, K, max_wait=0.02) as live:
        show(live, 9)
        live.reset()
        live.push_image(1, PICTURE)  # the old pose is discarded
        assert live.wait_idle(HANGS)
        show(live, 2)
    assert stamps(results) == [9, 2]
    assert live.statistics.skipped == {LATE: 1}
    assert int(model.image_index) == 1


def test_a_reset_after_an_image_was_taken_holds_for_the_next_one(model):
    """The image in progress belongs to the old poses."""
    with LiveDepth(model, lambda _: None, K) as live:
        process = live._process

        def reset_first(*chosen):
            live._process = process
            live.reset()
            return process(*chosen)

        live._process = reset_first
        show(live, 0)
        show(live, 1)
    assert int(model.image_index) == 1


@pytest.mark.parametrize("anchors", ["corners", "dense"])
def test_a_camera_that_changes_its_size_restarts_the_evidence_of_its_anchors(network, anchors):
    rng, results = np.random.default_rng(0), []
    model = UncertainDepth(network, UfMStarConfig(anchors=AnchorConfig()), anchors=anchors)
    with LiveDepth(model, results.append, K) as live:
        for n, (h, w) in enumerate([(48, 64)] * 3 + [(24, 32)] * 3):
            scale, picture = w / 64, rng.integers(0, 256, (h, w, 3), dtype=np.uint8)
            live.push_pose(n, at(n / 100))
            live.push_image(n, picture, (50 * scale, 50 * scale, (w - 1) / 2, (h - 1) / 2))
            assert live.wait_idle(HANGS)
    assert len(results) == 6
    assert require_all_counted(live).restarts == 1


@pytest.mark.parametrize("what", ["model", "on_result", "exit"])
def test_an_error_reaches_every_thread_that_pushes(model, what):
    def on_result(_):
        if what == "exit":
            raise SystemExit(3)
        if what == "on_result":
            raise ZeroDivisionError("no plan")

    expected = {"model": OSError, "on_result": ZeroDivisionError, "exit": SystemExit}[what]
    live = LiveDepth(model, on_result, K)
    live.push_pose(0, at(0))
    live.push_image(0, PICTURE + (255 if what == "model" else 0))
    with pytest.raises(expected):
        live.wait_idle(HANGS)
    for call in (lambda: live.push_image(1, PICTURE), lambda: live.push_pose(1, at(0)), live.reset, live.close):
        with pytest.raises(expected):
            call()
    with pytest.raises(KeyError), live:  # an error raised inside the with block is not replaced
        raise KeyError


def test_closing_while_busy_waits_for_the_image_and_drops_the_rest(model, network):
    results = []
    network.gate.clear()
    live = LiveDepth(model, results.append, K)
    live.push_pose(0, at(0))
    live.push_pose(1, at(0))
    live.push_image(0, PICTURE)
    assert network.entered.wait(HANGS)
    live.push_image(1, PICTURE)
    closing = threading.Thread(target=live.close)
    closing.start()
    time.sleep(0.02)
    assert closing.is_alive()
    network.gate.set()
    closing.join(HANGS)
    live.push_image(2, PICTURE)  # a camera callback after the end
    live.push_pose(2, at(0))
    live.close()
    assert stamps(results) == [0]
    assert require_all_counted(live).dropped == {CLOSED: 2}
    assert live.wait_idle(HANGS)


def test_on_result_may_close(model):
    def on_result(_):
        live.close()

    live = LiveDepth(model, on_result, K)
    live.push_pose(0, at(0))
    live.push_image(0, PICTURE)
    live._worker.join(HANGS)
    live.close()
    assert live.statistics.results == 1


def test_many_threads(model):
    results = []
    live = LiveDepth(model, results.append, K, max_gap=1)

    def push(n):
        for i in range(30):
            live.push_pose(i / 100 + n / 1e4, at(i / 100))
            live.push_image(i / 100 + n / 1e4, PICTURE)

    threads = [threading.Thread(target=push, args=(n,)) for n in range(8)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join(HANGS)
    assert live.wait_idle(HANGS)
    live.close()
    assert require_all_counted(live).images == 8 * 30
    assert live.statistics.poses == 8 * 30
    assert stamps(results) == sorted(stamps(results))
    assert results


@pytest.mark.parametrize(
    ("call", "error", "text"),
    [
        (lambda live: live.push_image(float("nan"), PICTURE), ValueError, "stamp must be finite"),
        (lambda live: live.push_pose(10**400, np.eye(4)), ValueError, "stamp must be finite"),
        (
            lambda live: live.push_pose(np.float32(1.3e9), np.eye(4)),
            ValueError,
            "in seconds and exact to 1 ms, .* 128 s",
        ),
        (lambda live: live.push_image(13 * 10**17, PICTURE), ValueError, "in seconds and exact to 1 ms, .* 256 s"),
        (lambda live: live.push_image("1.0", PICTURE), TypeError, "stamp must be a number of seconds, got str"),
        (lambda live: live.push_image(0, PICTURE[..., 0]), ValueError, r"\[H, W, 3\] RGB"),
        (lambda live: live.push_image(0, np.stack([PICTURE] * 2)), ValueError, "must be one image"),
        (lambda live: live.push_image(0, PICTURE), ValueError, "intrinsics of the image are needed"),
        (lambda live: live.push_image(0, PICTURE, (1, 2, 3)), ValueError, "intrinsics must be"),
        (lambda live: live.push_pose(0, np.eye(3)), ValueError, "pose must be camera-to-world"),
        (lambda live: live.push_pose(0, np.eye(4)[None]), ValueError, "T must be one pose"),
        (lambda live: live.push_pose(0, np.diag([2.0, 2, 2, 1])), ValueError, "T: pose has a rotation that is not"),
        (lambda live: live.push_pose(0, np.diag([1.0, 1, -1, 1])), ValueError, "T: pose has a reflection"),
    ],
)
def test_impossible_arguments_are_refused_in_the_callers_thread(model, call, error, text):
    with LiveDepth(model, print) as live:
        with pytest.raises(error, match=text):
            call(live)
        assert live.statistics.images == 0


def test_impossible_settings_are_refused(model, tmp_path):
    with pytest.raises(ValueError, match="max_wait must be a number of seconds"):
        LiveDepth(model, print, max_wait=-1)
    with pytest.raises(TypeError, match="on_result must be callable, got NoneType"):
        LiveDepth(model, None)
    with pytest.raises(TypeError, match="model must be an UncertainDepth, got UfMStar"):
        LiveDepth(model.ufm, print)
    with pytest.raises(IsADirectoryError, match="state must be a file"):
        LiveDepth(model, print, state=tmp_path)
    with pytest.raises(FileNotFoundError, match="state: no such folder"):
        LiveDepth(model, print, state=tmp_path / "nowhere" / "state.pt")

"""The state of ``LiveDepth`` in a file: continued, refused, written by one process, saved at a signal."""

from __future__ import annotations

import os
import subprocess
import sys
import textwrap
from pathlib import Path

import pytest
import torch
from live_model import HANGS, PICTURE, K, Network, at, compiled, model, network, show

from ufmstar_torch import LiveDepth, UncertainDepth
from ufmstar_torch.files.state_file import StateFile

__all__ = ["compiled", "model", "network"]


def test_a_second_process_may_not_write_the_same_state(model, tmp_path):
    """Temporary files of a killed one are removed at the start, other files stay."""
    file = tmp_path / "s.pt"
    left, other = tmp_path / ".s.pt.0123456789ab.tmp", tmp_path / ".other.pt.0123456789ab.tmp"
    left.write_text("half a state")
    other.write_text("of another program")
    code = f"""
import sys, torch
from ufmstar_torch import DepthPrediction, LiveDepth, UncertainDepth
class Network(torch.nn.Module):
    def forward(self, x): return DepthPrediction(torch.full((1, 8, 8), 2.0))
with LiveDepth(UncertainDepth(Network()), print, state={str(file)!r}):
    print("holds it", flush=True)
    sys.stdin.read()
"""
    words = [sys.executable, "-P", "-c", code]
    first = subprocess.Popen(words, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
    try:
        assert first.stdout.readline() == "holds it\n"
        assert (left.exists(), other.exists()) == (False, True)
        with pytest.raises(ValueError, match=r"state: another process is writing .*s\.pt"):
            LiveDepth(model, print, K, state=file)
    finally:
        first.kill()
        first.communicate()
    with LiveDepth(model, print, K, state=file):
        (tmp_path / "link.pt").symlink_to(file)
        with pytest.raises(ValueError, match="another process is writing"):
            LiveDepth(model, print, K, state=tmp_path / "link.pt")


@pytest.mark.skipif(not Path("/proc/self").exists(), reason="no file system that creates no files")
def test_a_state_where_no_file_can_be_created_is_named(model):
    with pytest.raises(FileNotFoundError, match="no file can be created there"):
        LiveDepth(model, print, K, state=Path("/proc/x.pt"))


def test_the_state_goes_on_where_it_ended(model, tmp_path):
    with LiveDepth(model, lambda _: None, K, state=tmp_path / "state.pt", save_every=0) as live:
        for n in range(3):
            show(live, n, x=n / 100)
    assert live.statistics.saved == 3
    again = UncertainDepth(Network())
    with LiveDepth(again, print, K, state=tmp_path / "state.pt"):
        assert int(again.image_index) == 3
    assert live.statistics.saved == 3  # no change, so nothing is written
    torch.testing.assert_close(
        again(PICTURE, at(0.03), K).variance, model(PICTURE, at(0.03), K).variance, rtol=0, atol=0
    )
    assert sorted(path.name for path in tmp_path.iterdir()) == [".state.pt.lock", "state.pt"]
    with LiveDepth(model, print, K, state=tmp_path / "other.pt"):
        pass  # no change, so no file is overwritten
    assert not (tmp_path / "other.pt").exists()


def test_a_state_that_does_not_fit_is_refused_and_stays(model, tmp_path):
    file, before = tmp_path / "state.pt", {name: value.clone() for name, value in model.stream_state().items()}
    plain = UncertainDepth(Network(), posterior=False)
    torch.save(plain.stream_state(), file)
    (tmp_path / "damaged.pt").write_bytes(file.read_bytes()[:500])
    for path, words in ((file, "the state must hold"), (tmp_path / "damaged.pt", "damaged")):
        content = path.read_bytes()
        with pytest.raises(
            ValueError, match=rf"state .*{path.name} cannot be continued: (.|\n)*{words}(.|\n)*Delete the"
        ) as refused:  # its traceback keeps all objects
            LiveDepth(model, print, K, state=path)
        assert path.read_bytes() == content
        path.unlink()
        LiveDepth(model, print, K, state=path).close()
    assert refused.value.__cause__ is not None
    after = model.stream_state()
    assert all(torch.equal(after[name], value) for name, value in before.items())


def test_a_state_that_cannot_be_written_is_an_error(model, tmp_path):
    live = LiveDepth(model, lambda _: None, K, state=tmp_path / "state.pt")
    (tmp_path / "state.pt").mkdir()
    show(live, 0)
    with pytest.raises(OSError, match=r"state\.pt"):
        live.close()


@pytest.mark.parametrize(("picture", "words"), [(PICTURE, "no release"), (PICTURE + 255, "the network failed")])
def test_a_lock_that_cannot_be_released_is_an_error_without_a_hang(model, tmp_path, monkeypatch, picture, words):
    def release(_):
        raise OSError("no release")

    monkeypatch.setattr(StateFile, "release", release)
    live = LiveDepth(model, lambda _: None, K, state=tmp_path / "s.pt")

    def used():
        show(live, 0, picture)
        live.close()

    with pytest.raises(OSError, match=words):
        used()
    with pytest.raises(OSError, match=words):  # the first error, and at once
        live.wait_idle()


@pytest.mark.slow
def test_sigterm_as_an_exception_saves_the_state(tmp_path):
    """As in docs/live.md."""
    script = textwrap.dedent(
        f"""
        import signal, sys, time
        sys.path.insert(0, {str(os.path.dirname(__file__))!r})
        import live_model as t
        signal.signal(signal.SIGTERM, signal.default_int_handler)
        from ufmstar_torch import LiveDepth, UncertainDepth
        model = UncertainDepth(t.Network(), posterior=False)
        ready, state = lambda _: print("ready", flush=True), {str(tmp_path / "state.pt")!r}
        with LiveDepth(model, ready, t.K, state=state) as live:
            live.push_pose(0, t.at(0)); live.push_image(0, t.PICTURE)
            time.sleep(60)
        """
    )
    process = subprocess.Popen(
        [sys.executable, "-c", script], stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True
    )
    assert process.stdout.readline() == "ready\n"
    process.terminate()
    assert process.wait(HANGS) != 0
    process.stdout.close()
    assert "image_index" in torch.load(tmp_path / "state.pt")

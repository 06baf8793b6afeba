"""The runner: its outputs equal a loop written by hand, and no interruption changes them."""

from __future__ import annotations

import errno
import json
import os
import shutil
import signal
from dataclasses import replace
from functools import partial

import numpy as np
import pytest
import torch
from forked import start
from layouts import truncate, write_depth_png, write_generic
from PIL import Image
from runs import CONFIG, Brightness, network_job, outputs, own_depth_job, read_summary, records

from ufmstar_torch import UncertainDepth
from ufmstar_torch.eval.metrics import SequenceMetrics
from ufmstar_torch.eval.run import writers
from ufmstar_torch.eval.run.folder import FolderError
from ufmstar_torch.eval.run.run import run
from ufmstar_torch.eval.run.writers import read_frame
from ufmstar_torch.eval.sequences import open_sequence
from ufmstar_torch.models import Preprocess


class Crash(BaseException):
    """An exception that the program does not handle."""


def crash():
    raise Crash


@pytest.fixture(scope="module")
def uninterrupted(scene, tmp_path_factory):
    """The outputs of an undisturbed run of two alternating networks."""
    out = tmp_path_factory.mktemp("uninterrupted") / "out"
    assert run(network_job(scene[0], *pair()), out)["state"] == "finished"
    return outputs(out)


def pair(**trouble):
    """Two members that disagree; interruptions happen in the second one."""
    return Brightness(1.0, spread=0.02), Brightness(1.1, spread=0.02, **trouble)


# ---- what a run writes ----


def test_a_run_equals_a_loop_by_hand(scene, tmp_path):
    path, truth = scene
    summary = run(network_job(path, Brightness(spread=0.02)), tmp_path / "out")
    sequence, preprocess = open_sequence(path), Preprocess(size=(24, 32))
    pipeline = UncertainDepth(Brightness(spread=0.02), CONFIG, posterior=False, preprocess=preprocess)
    ours, alone = SequenceMetrics(), SequenceMetrics()
    disagreements, unmeasured = [], []
    for frame, depth in zip(sequence, truth.depths, strict=True):
        image = torch.from_numpy(frame.image).permute(2, 0, 1)[None]
        result = pipeline(image, torch.from_numpy(frame.T_world_cam)[None], torch.from_numpy(frame.intrinsics)[None])
        stored = read_frame(tmp_path / "out" / "frames" / f"{frame.name}.npz")
        np.testing.assert_array_equal(stored["depth"], result.depth[0].numpy())
        np.testing.assert_array_equal(stored["variance"], result.variance[0].numpy())
        np.testing.assert_array_equal(stored["disagreement"], result.disagreement[0].numpy())
        np.testing.assert_array_equal(stored["measured"], result.measured[0].numpy())
        unmeasured.append(int(result.statistics.unmeasured[0]))
        target = preprocess.apply_depth(torch.from_numpy(frame.depth))
        assert np.abs(target.numpy() - preprocess.apply_depth(torch.from_numpy(depth)).numpy()).max() < 1e-3
        ours.update(result.depth[0], result.variance[0], target)
        alone.update(result.depth[0], 0.02 * result.depth[0], target)
        np.testing.assert_array_equal(stored["T_world_cam"], frame.T_world_cam)
        np.testing.assert_allclose(stored["intrinsics"][0, 2], frame.intrinsics[0, 2] / 2 - 0.25)
        disagreements.append(result.disagreement.double().mean().item())
    lines = records(tmp_path / "out")
    np.testing.assert_array_equal([line["T_world_cam"] for line in lines], [e.T_world_cam for e in sequence.entries])
    expected = json.loads(json.dumps(ours.compute()))
    assert summary["metrics"] == pytest.approx(expected, rel=1e-12, nan_ok=True)
    assert summary["network_alone"]["nll"] == pytest.approx(alone.compute()["nll"], rel=1e-6)
    assert summary["uncertainty"]["mean_disagreement"] == pytest.approx(np.mean(disagreements), rel=1e-12)
    assert unmeasured[0] == 24 * 32 > unmeasured[-1]
    assert summary["uncertainty"]["unmeasured_share"] == sum(unmeasured) / summary["uncertainty"]["valid_pixels"]
    assert summary["mixture"]["components"] == int(pipeline.ufm.mixture.components)
    assert summary["mixture"]["components_over_time"][-1] == summary["mixture"]["components"]
    counts = summary["mixture"]
    assert counts["matched"] + counts["new"] + counts["dropped"] == counts["segments"] > 0
    assert summary["frames"]["done"] == summary["frames"]["with_ground_truth"] == 6


def test_the_summary_says_what_it_came_from(path, tmp_path):
    text = run(network_job(path, frames=slice(0, 4, 2)), tmp_path / "out")
    assert text == read_summary(tmp_path / "out")
    assert (text["state"], text["reason"]) == ("finished", "2 of 2 frames")
    assert (text["sequence"]["name"], text["settings"]) == ("walk", {"note": "a test"})
    assert {"ufmstar_torch", "torch", "numpy", "numba", "python"} <= text["versions"].keys()
    assert text["network_alone"] is None
    assert "without a variance" in text["network_alone_reason"]
    assert all(text["time"]["median_ms"][stage] > 0 for stage in ("read", "network", "ufm", "metrics", "write"))
    assert text["time"]["frames_per_second"] > 0
    assert text["mixture"]["bytes_allocated"] >= text["mixture"]["bytes_in_use"] > 0
    lines = records(tmp_path / "out")
    assert [line["name"] for line in lines] == ["7", "9"]
    # The intrinsics of the written maps, for 24x32 images resized from 48x64.
    K = np.array([500 / 20, 510 / 20, (310 + 0.5) / 20 - 0.5, (245 + 0.5) / 20 - 0.5])
    np.testing.assert_allclose(lines[0]["intrinsics"], K, rtol=1e-9)


def test_pictures_and_mixture(path, tmp_path):
    import cv2

    out = tmp_path / "out"
    summary = run(network_job(path, video=True, sheet=True, frames=slice(0, 4)), out)
    made = {"mixture.ply", "mixture.npz", "contact_sheet.png", "preview.mp4"}
    assert summary["outputs"] == dict.fromkeys(made)
    assert all((out / name).is_file() for name in made)
    video = cv2.VideoCapture(str(out / "preview.mp4"))
    assert video.get(cv2.CAP_PROP_FRAME_COUNT) == 4
    sheet = cv2.imread(str(out / "contact_sheet.png"))
    run(own_depth_job(path, sheet=True, frames=slice(0, 4)), tmp_path / "own")
    without_error = cv2.imread(str(tmp_path / "own" / "contact_sheet.png"))
    assert without_error.shape[1] < 0.8 * sheet.shape[1]  # no column for an error that is zero by construction


def test_ufm_star_stays_on_the_cpu_where_the_networks_run_elsewhere(path):
    job = replace(own_depth_job(path), device=torch.device("cuda"))
    assert job.row()[1].mean.device.type == "cpu"


def test_without_ground_truth(tmp_path):
    path, _ = write_generic(tmp_path, frames=3)
    for file in (path / "depth").iterdir():
        file.unlink()
    (path / "depth").rmdir()
    summary = run(network_job(path, Brightness(spread=0.02), sheet=True), tmp_path / "out")
    assert (summary["state"], summary["frames"]["with_ground_truth"]) == ("finished", 0)
    assert summary["metrics"] is summary["network_alone"] is None
    assert summary["metrics_reason"] == summary["network_alone_reason"] == "no ground truth"


def test_frames_that_cannot_be_used_are_skipped_and_counted(tmp_path):
    path, _ = write_generic(tmp_path)
    truncate(path / "images" / "8.png")
    poses = np.loadtxt(path / "poses.txt")
    poses[3, :3] *= 1.3  # not a rotation any more
    np.savetxt(path / "poses.txt", poses)
    summary = run(network_job(path), tmp_path / "out")
    assert (summary["state"], summary["frames"]["done"]) == ("finished", 4)
    assert [frame["name"] for frame in summary["frames"]["skipped_frames"]] == ["8"]
    (reason,) = summary["frames"]["skipped"]
    assert "cannot be decoded" in reason
    assert summary["sequence"]["left_out"] == {"pose that is no rotation, but has a scale, shear or reflection": 1}
    assert sorted(file.stem for file in (tmp_path / "out" / "frames").iterdir()) == ["11", "12", "7", "9"]


def test_a_run_without_a_usable_frame_has_failed(tmp_path):
    path, _ = write_generic(tmp_path, frames=2)
    for name in ("7.png", "8.png"):
        truncate(path / "images" / name, share=0.9)
    summary = run(network_job(path), tmp_path / "out")
    assert summary["state"] == "failed"
    assert "no frame could be used" in summary["reason"]


def test_nothing_is_written_outside(path, tmp_path):
    before = {file: file.stat().st_mtime_ns for file in path.rglob("*")}
    run(network_job(path, sheet=True, video=True, frames=slice(0, 2)), tmp_path / "deep" / "out")
    assert {file: file.stat().st_mtime_ns for file in path.rglob("*")} == before
    assert [file.name for file in tmp_path.iterdir()] == ["deep"]
    hidden = list((tmp_path / "deep" / "out").rglob(".*"))
    assert not hidden, "temporary files are left"


def test_an_ensemble_alternates(path, tmp_path):
    run(network_job(path, *pair()), tmp_path / "out")
    lines = records(tmp_path / "out")
    assert [line["member"] for line in lines] == [0, 1, 0, 1, 0, 1]
    full = run(network_job(path, *pair(), mode="full", frames=slice(0, 2)), tmp_path / "full")
    assert full["uncertainty"]["mean_network_sigma"] > 0


# ---- interruptions ----


def between_files(count, error=Crash):
    """Raise after the ``count``-th of the frames' files (three per frame), before it is recorded."""

    def break_(monkeypatch):
        calls = []

        def broken(write, file, *rest):
            write(file, *rest)
            calls.append(1)
            if len(calls) == count:
                raise error

        for name in ("write_atomic", "write_bytes_atomic"):
            monkeypatch.setattr(writers, name, partial(broken, getattr(writers, name)))

    return break_


@pytest.mark.parametrize("break_", [between_files(1), between_files(3), between_files(12)])
def test_a_crash_anywhere_is_made_good(path, tmp_path, uninterrupted, break_):
    with pytest.MonkeyPatch.context() as patch:
        break_(patch)
        with pytest.raises(Crash):
            run(network_job(path, *pair()), tmp_path / "out")
    assert read_summary(tmp_path / "out")["state"] == "failed"
    assert run(network_job(path, *pair()), tmp_path / "out")["state"] == "finished"
    assert outputs(tmp_path / "out") == uninterrupted


def interrupt():
    raise KeyboardInterrupt


def test_ctrl_c_leaves_what_is_finished_and_the_same_command_does_the_rest(path, tmp_path, uninterrupted):
    out = tmp_path / "out"
    summary = run(network_job(path, *pair(at=1, then=interrupt)), out)
    done = 3
    assert (summary["state"], summary["frames"]["done"]) == ("interrupted", done)
    assert f"{done} of 6 frames" in summary["reason"]
    assert len(list((out / "frames").iterdir())) == done
    # The summary covers finished frames only, although the next frame was in progress.
    assert len(summary["mixture"]["components_over_time"]) == done
    assert summary["metrics"]["pixels"] == done * 24 * 32
    assert "the same command computes the rest" in summary["reason"]
    again = pair()
    assert run(network_job(path, *again), out)["state"] == "finished"
    assert sum(network.calls for network in again) == 6 - done, "finished predictions are read from the cache"
    assert outputs(out) == uninterrupted


def test_a_finished_run_is_repeated_without_its_networks(path, tmp_path, uninterrupted):
    out = tmp_path / "out"
    run(network_job(path, *pair()), out)
    never = (Brightness(gain, spread=0.02, at=0, then=crash) for gain in (1.0, 1.1))
    assert run(network_job(path, *never), out)["state"] == "finished"
    assert outputs(out) == uninterrupted


def test_an_error_of_the_network_is_in_the_summary(path, tmp_path):
    def fail():
        raise RuntimeError("out of memory")

    with pytest.raises(RuntimeError, match="out of memory"):
        run(network_job(path, *pair(at=1, then=fail)), tmp_path / "out")
    summary = read_summary(tmp_path / "out")
    assert (summary["state"], summary["frames"]["done"]) == ("failed", 3)
    assert summary["reason"] == "RuntimeError: out of memory"


def test_a_full_disk_leaves_finished_frames(path, tmp_path, uninterrupted):
    out = tmp_path / "out"
    with pytest.MonkeyPatch.context() as patch:
        between_files(13, OSError(errno.ENOSPC, "No space left on device"))(patch)
        summary = run(network_job(path, *pair()), out)
    assert (summary["state"], summary["frames"]["done"]) == ("failed", 4)
    assert "No space left on device" in summary["reason"]
    run(network_job(path, *pair()), out)
    assert outputs(out) == uninterrupted


def _killed(path, out):
    """A run that is killed in the second call of the second network."""
    kill = partial(os.kill, os.getpid(), signal.SIGKILL)
    run(network_job(path, *pair(at=1, then=kill)), out)


@pytest.mark.slow
def test_sigkill_loses_no_prediction(path, tmp_path, uninterrupted):
    out = tmp_path / "out"
    process = start(_killed, path, out)
    process.join(200)
    assert process.exitcode == -signal.SIGKILL
    summary = read_summary(out)
    assert summary["state"] == "interrupted"
    assert "killed" in summary["reason"]
    written = len(list((out / "frames").iterdir()))
    assert written <= 3
    again = pair()
    assert run(network_job(path, *again), out)["state"] == "finished"
    assert sum(network.calls for network in again) == 3
    assert outputs(out) == uninterrupted
    assert not list(out.rglob(".*.tmp"))


# ---- the output folder ----


def test_another_run_does_not_replace_the_first(path, tmp_path):
    out = tmp_path / "out"
    run(network_job(path, *pair(at=1, then=interrupt)), out)
    before = outputs(out)
    with pytest.raises(FolderError, match=r"other input: .*ufm\.eta was 0\.5, now 0\.4.*--overwrite replaces"):
        run(network_job(path, *pair(), config=CONFIG.replace(eta=0.4)), out)
    with pytest.raises(FolderError, match=r"source\.networks was .*1\.1.*, now .*1\.2"):
        run(network_job(path, Brightness(1.0), Brightness(1.2)), out)
    with pytest.raises(FolderError, match=r"sequence\.frames was 6, now 3"):
        run(network_job(path, *pair(), frames=slice(None, None, 2)), out)
    assert outputs(out) == before


def test_other_pixels_or_poses_under_the_same_names_are_noticed(tmp_path):
    path, _ = write_generic(tmp_path, frames=2)
    out = tmp_path / "out"
    run(network_job(path), out)
    poses = np.loadtxt(path / "poses.txt")
    np.savetxt(path / "poses.txt", poses + [0, 0, 0, 1e-6] * 4)
    with pytest.raises(FolderError, match=r"sequence\.names_and_poses"):
        run(network_job(path), out)
    np.savetxt(path / "poses.txt", poses)
    (path / "images" / "7.png").write_bytes((path / "images" / "8.png").read_bytes())
    with pytest.raises(FolderError, match=r"sequence\.first_frame"):
        run(network_job(path), out)


def test_overwriting_removes_what_the_run_wrote_and_nothing_else(path, tmp_path, uninterrupted):
    """Files of a user, in every folder and with every ending of the run's files."""
    out = tmp_path / "out"
    run(network_job(path, frames=slice(0, 6)), out)
    mine = [
        out / "depth" / "photo.png",
        out / "frames" / "mine.npz",
        out / "sigma" / "notes.txt",
        out / "cache" / "a.pt",
    ]
    Image.fromarray(np.full((5, 5, 3), 9, np.uint8)).save(mine[0])
    np.savez(mine[1], depth=np.ones((3, 3)))
    for file in mine[2:]:
        file.write_text("mine")
    before = [file.read_bytes() for file in mine]
    (out / "frames" / "orphan.npz").write_bytes((out / "frames" / "7.npz").read_bytes())  # of a killed run
    run(network_job(path, *pair()), out, overwrite=True)
    assert [file.read_bytes() for file in mine] == before
    for file in mine:
        file.unlink()
    assert outputs(out) == uninterrupted


@pytest.fixture(scope="module")
def two_frames(path, tmp_path_factory):
    """The folder of a run of two frames. Tests must not change it."""
    out = tmp_path_factory.mktemp("two") / "out"
    run(network_job(path, frames=slice(0, 2)), out)
    return out


@pytest.mark.parametrize("options", [{"overwrite": True}, {}])
@pytest.mark.parametrize("link", ["depth", "frames", "run.json", "frames/7.npz", "summary.json", "preview.mp4"])
def test_nothing_is_written_through_a_link(path, tmp_path, two_frames, link, options):
    out, victim = tmp_path / "out", tmp_path / "victim"
    shutil.copytree(two_frames, out)
    if link == "preview.mp4":
        (out / link).symlink_to(tmp_path / "nothing")
    else:
        (out / link).rename(victim)
        (out / link).symlink_to(victim)
    before = outputs(victim) if victim.is_dir() else None
    with pytest.raises(FolderError, match=rf"{link} is a symbolic link, through which nothing is written"):
        run(network_job(path, frames=slice(0, 2)), out, **options)
    assert (outputs(victim) if victim.is_dir() else None) == before


def test_a_link_that_the_user_names_is_followed(path, tmp_path, two_frames):
    (tmp_path / "elsewhere").symlink_to(tmp_path / "new")
    (tmp_path / "new").mkdir()
    run(network_job(path, frames=slice(0, 2)), tmp_path / "elsewhere")
    assert outputs(tmp_path / "new").keys() == outputs(two_frames).keys()


@pytest.mark.parametrize("options", [{}, {"overwrite": True}])
def test_a_folder_of_someone_else_is_left_alone(path, tmp_path, options):
    out = tmp_path / "dataset"
    write_depth_png(out / "depth" / "7.png", np.ones((4, 4)), 1000)
    before = outputs(out)
    with pytest.raises(FolderError, match="someone else"):
        run(network_job(path), out, **options)
    assert outputs(out) == before


def test_two_runs_do_not_share_a_folder(path, tmp_path):
    out = tmp_path / "out"
    refused = []

    def another():
        with pytest.raises(FolderError, match="another run") as caught:
            run(network_job(path, *pair()), out)
        refused.append(caught)

    assert run(network_job(path, *pair(at=1, then=another)), out)["state"] == "finished"
    assert len(refused) == 1


@pytest.mark.parametrize("content", ["", "{}", '{"program": "ufmstar run", "format": 7}'])
def test_a_damaged_manifest_is_named(path, tmp_path, two_frames, content):
    out = tmp_path / "out"
    shutil.copytree(two_frames, out)
    (out / "run.json").write_text(content)
    with pytest.raises(FolderError, match=r"run.json is .*--overwrite starts again"):
        run(network_job(path, frames=slice(0, 2)), out)
    assert run(network_job(path, frames=slice(0, 2)), out, overwrite=True)["state"] == "finished"

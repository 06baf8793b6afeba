"""``ufmstar run`` with anchors: equal to a loop written by hand, after any interruption; reports frames without
anchors."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
import torch
from runs import job_of, outputs, read_summary, records

from ufmstar_torch import AnchorConfig, PosteriorConfig, UfMStar, UfMStarConfig, cli
from ufmstar_torch.anchors.tracker import LandmarkTracker, TrackerConfig
from ufmstar_torch.eval.commands import rank
from ufmstar_torch.eval.commands.run import job_from, read
from ufmstar_torch.eval.engine.maps import MapSource, folder_source
from ufmstar_torch.eval.report.text import run_table
from ufmstar_torch.eval.run.export import gated_frames
from ufmstar_torch.eval.run.folder import FolderError
from ufmstar_torch.eval.run.panels import map_columns
from ufmstar_torch.eval.run.pictures import FinishedRun
from ufmstar_torch.eval.run.run import run
from ufmstar_torch.eval.run.writers import read_frame
from ufmstar_torch.eval.sequences.frame import in_memory
from ufmstar_torch.eval.sequences.images import read_depth
from ufmstar_torch.eval.sequences.open import open_sequence

TOUR = "tour:5?frames=8&size=120x160"
ON = UfMStarConfig(on_bad_frame="skip", anchors=AnchorConfig())
OFF = ON.replace(anchors=None)


@pytest.fixture(scope="module")
def tour():
    """Eight rendered frames, 120x160, in memory. Tests must not change them."""
    return in_memory(open_sequence(TOUR))


def with_entries(sequence, change):
    """The sequence with entries changed by a function of the frame number; None removes an entry."""
    changed = [change(i, entry) for i, entry in enumerate(sequence.entries)]
    return dataclasses.replace(sequence, entries=tuple(entry for entry in changed if entry is not None))


def too_far(frame, stop_at=None):
    """Depth that is 30 % too far, subsampled by 2, with a variance of 1 cm^2."""
    if frame.index == stop_at:
        raise KeyboardInterrupt
    depth = 1.3 * frame.depth[::2, ::2]
    return depth, np.full_like(depth, 1e-4), np.diag([0.5, 0.5, 1.0]) @ frame.intrinsics


def map_job(sequence, config=ON, read=too_far, **options):
    return job_of(sequence, MapSource(read, {"maps": "30 % too far"}), config=config, **options)


@pytest.fixture(scope="module")
def finished(tour, tmp_path_factory):
    """An undisturbed run: its folder and summary."""
    out = tmp_path_factory.mktemp("finished") / "out"
    return out, run(map_job(tour), out)


# ---- the same as by hand ----


def test_a_run_with_maps_equals_a_loop_by_hand(tour, finished):
    out, summary = finished
    ufm, tracker, expected = UfMStar(ON), LandmarkTracker(), []
    for frame, record in zip(tour, records(out), strict=True):
        landmarks = tracker.update(frame.image, frame.T_world_cam, frame.intrinsics)
        depth, a, K = (torch.from_numpy(x)[None] for x in too_far(frame))
        anchors = landmarks.anchors(frame.intrinsics, K)
        result = ufm(depth, torch.from_numpy(frame.T_world_cam)[None], K, a, anchors=anchors)
        stored = read_frame(out / "frames" / f"{frame.name}.npz")
        for name in ("variance", "disagreement", "anchored", "bias"):
            np.testing.assert_allclose(stored[name], getattr(result, name)[0].numpy(), rtol=1e-5, atol=1e-7)
        np.testing.assert_allclose(
            stored["variance"], stored["disagreement"] + stored["anchored"] + np.float32(1e-4), rtol=1e-5
        )
        used = int(result.statistics.anchors_used[0])
        counts = [landmarks.tracked, len(landmarks.depth), int(result.statistics.anchors[0]), used]
        assert [record["anchors"][key] for key in ("tracked", "found", "usable", "used")] == counts
        assert (record["anchors"]["without"] is None) == (used > 0)
        assert record["mean_anchored"] == pytest.approx(float(result.anchored[result.valid].double().mean()), rel=1e-4)
        assert record["mean_bias"] == pytest.approx(float(result.bias[result.valid].double().mean()), rel=1e-4)
        expected.append([*counts, record["mean_anchored"], record["mean_bias"]])
    message = summary["anchors"]
    means = [message[f"{key}_per_frame"] for key in ("tracked", "found", "usable", "used")]
    np.testing.assert_allclose(
        [*means, message["mean_anchored"], message["mean_bias"]], np.mean(expected, axis=0), rtol=1e-6
    )
    used = [record["anchors"]["used"] for record in records(out)]
    assert sum(message["frames_without"].values()) == used.count(0)
    assert used[message["frames_before_the_first"]] > 0 == sum(used[: message["frames_before_the_first"]])
    # The last frame's bias is roughly 1/1.3 - 1 = -.23; in such small images it is not exact.
    assert -0.35 < records(out)[-1]["mean_bias"] < -0.12
    assert summary["time"]["median_ms"]["anchors"] > 0


def test_without_anchors_nothing_is_said_of_them(tour, tmp_path):
    summary = run(map_job(tour, OFF, frames=slice(2)), tmp_path / "out")
    assert summary["anchors"] is None
    assert "anchors" not in run_table(summary)
    assert summary["time"]["median_ms"]["anchors"] is None
    assert not {"anchors", "mean_anchored", "mean_bias"} & records(tmp_path / "out")[0].keys()
    stored = read_frame(tmp_path / "out" / "frames" / f"{tour.names[0]}.npz")
    assert stored.keys() == {"depth", "variance", "disagreement", "measured", "valid", "T_world_cam", "intrinsics"}


# ---- frames without anchors ----


def test_a_standing_camera_is_plain_ufm_star_and_the_summary_says_so(tour, tmp_path):
    still = with_entries(tour, lambda i, e: dataclasses.replace(tour.entries[0], name=e.name) if i < 4 else None)
    summary = run(map_job(still), tmp_path / "on")
    run(map_job(still, OFF), tmp_path / "off")
    message = summary["anchors"]
    assert (
        message["used_per_frame"] == message["found_per_frame"] == message["mean_anchored"] == message["mean_bias"] == 0
    )
    assert message["tracked_per_frame"] > 20
    assert message["frames_without"] == {
        "no corner followed from the frame before": 1,
        "no parallax, or no track that fits the poses": 3,
    }
    for name in still.names:
        on, off = (read_frame(tmp_path / folder / "frames" / f"{name}.npz") for folder in ("on", "off"))
        np.testing.assert_array_equal(on["variance"], off["variance"])


def test_what_was_learnt_stays_where_anchors_end(tour, tmp_path):
    blind = with_entries(tour, lambda i, e: dataclasses.replace(e, load_image=None) if i >= 6 else e)
    summary = run(map_job(blind), tmp_path / "out")
    before, *rest = records(tmp_path / "out")[5:]
    for record in rest:
        assert record["anchors"]["used"] == record["anchors"]["tracked"] == 0
        assert 0.6 < record["mean_anchored"] / before["mean_anchored"] < 1.5
    before = summary["anchors"]["frames_before_the_first"]
    assert before < 6
    assert "2 x no image" in run_table(summary)


def test_a_frame_with_a_bad_pose_does_not_spoil_the_tracks(tour, tmp_path):
    def spoil(i, entry):
        return dataclasses.replace(entry, T_world_cam=1.1 * entry.T_world_cam) if i == 4 else entry

    summary = run(map_job(with_entries(tour, spoil)), tmp_path / "spoiled")
    run(map_job(with_entries(tour, lambda i, e: None if i == 4 else e)), tmp_path / "without")
    assert summary["frames"]["done"] == 7
    spoiled, without = outputs(tmp_path / "spoiled"), outputs(tmp_path / "without")
    names = [f"frames/{name}.npz" for i, name in enumerate(tour.names) if i != 4]
    assert all(spoiled[name] == without[name] for name in names)
    assert records(tmp_path / "spoiled")[-1]["anchors"]["used"] > 3


# ---- beginning again ----


def test_a_stopped_run_begins_again_with_the_same_tracks(tour, finished, tmp_path):
    out = tmp_path / "out"
    stopped = run(map_job(tour, read=lambda frame: too_far(frame, stop_at=5)), out)
    assert (stopped["state"], stopped["frames"]["done"]) == ("interrupted", 5)
    assert stopped["anchors"]["used_per_frame"] == np.mean([record["anchors"]["used"] for record in records(out)])
    assert run(map_job(tour), out)["state"] == "finished"
    assert outputs(out) == outputs(finished[0])


def test_only_a_run_with_anchors_is_repeated_with_anchors(tour, finished, tmp_path, monkeypatch):
    run(map_job(tour, OFF, frames=slice(2)), tmp_path / "out")
    with pytest.raises(FolderError, match=r"other input: source.anchors was null, now .corners"):
        run(map_job(tour, frames=slice(2)), tmp_path / "out")
    with monkeypatch.context() as patch:
        patch.setattr(TrackerConfig, "to_dict", lambda config: {**dataclasses.asdict(config), "window": 9})
        with pytest.raises(FolderError, match=r"other input: source.tracker.window was 10, now 9"):
            run(map_job(tour), finished[0])


# ---- the command ----


def test_the_flag(tmp_path, capfd):
    words = ["run", TOUR, "--depth", "self", "--plain", "--anchors", "corners", "--set", "ema_alpha=1"]
    words += ["--no-video", "--no-sheet"]
    assert cli.main([*words, "--frames", ":5", "--out", str(tmp_path / "a")]) == 0
    printed = capfd.readouterr().out
    summary = read_summary(tmp_path / "a")
    assert (summary["settings"]["anchors"], summary["settings"]["plain"], summary["result"]) == ("corners", True, "ufm")
    assert "posterior" not in summary
    assert summary["settings"]["set"]["anchors"] == AnchorConfig().to_dict()
    assert summary["settings"]["set"]["ema_alpha"] == 1.0
    assert "UfM*, anchored  " in printed
    used, result = (summary["anchors"][key] for key in ("used_per_frame", "found_per_frame"))
    assert f"anchors: {used:.1f} used a frame, of {result:.1f} triangulated" in printed
    # Exact depth has no bias; tracks in such small images have errors of some per cent.
    assert abs(summary["anchors"]["mean_bias"]) < 0.1
    assert summary["anchors"]["mean_anchored"] < 0.1


@pytest.mark.slow
def test_a_run_with_a_posterior_corrects_the_depth(tour, tmp_path):
    whole = tmp_path / "whole"
    summary = run(map_job(tour, ON.replace(posterior=PosteriorConfig())), whole)
    corrected, before = summary["metrics"], summary["ufm"]["metrics"]
    assert summary["result"] == "posterior"
    assert corrected["rmse"] < 0.8 * before["rmse"]
    assert corrected["ece_delta"] < before["ece_delta"]
    last = read_frame(whole / "frames" / f"{tour.names[-1]}.npz")  # before the first anchors, sigma is large
    assert np.nanmean(np.sqrt(last["variance"])) < np.nanmean(np.sqrt(last["ufm_variance"]))
    assert summary["posterior"]["unseen"] > 0
    _, first, second, *_ = run_table(summary).splitlines()
    assert first.startswith("posterior  ")
    assert first.endswith(f" {summary['uncertainty']['mean_sigma']:.3g}")
    assert second.startswith("UfM*, anchored  ")
    assert second.endswith(f" {summary['ufm']['mean_sigma']:.3g}")
    assert "times that of tracked corners" in run_table(summary)
    assert "the posterior corrects it" in run_table(summary)
    covered = [corrected[f"coverage_{level}"] for level in (50, 90, 99)]
    assert 0 < covered[0] < covered[1] <= covered[2] <= 1
    text = ", ".join(f"{share:.0%}" for share in covered)
    assert f"intervals of 50, 90 and 99 % hold {text}" in run_table(summary)
    assert "coverage_90" not in before
    assert len(summary["posterior"]["quantiles"]) == 3
    one, name = last, tour.names[-1]
    for kind, values, unit in (
        ("depth", one["depth"], 1e-3),
        ("sigma", np.sqrt(one["variance"]), 1e-4),
        ("network_depth", one["network_depth"], 1e-3),
        ("ufm_sigma", np.sqrt(one["ufm_variance"]), 1e-4),
    ):
        image = read_depth(whole / kind / f"{name}.png")
        expected = np.minimum(values, 65535 * unit)[one["valid"]]
        np.testing.assert_allclose(image[one["valid"]], expected, atol=unit)
    panel = FinishedRun(whole, tour, records(whole), with_error=True).panel(7)
    labels = [column.label for column in map_columns([panel])]
    assert labels == ["depth, network", "depth", "σ", "|error|", "σ, UfM*", "|error|, network"]
    assert np.nanmean(panel.maps["error"]) < 0.7 * np.nanmean(panel.maps["network_error"])
    valid = one["valid"]
    np.testing.assert_allclose(one["network_depth"][valid], 1.3 * tour[7].depth[::2, ::2][valid], rtol=1e-5)
    (exported,) = [frame for frame in gated_frames(whole, np.inf, np.inf) if frame.name == name]
    np.testing.assert_array_equal(exported.depth[valid], one["depth"][valid])
    again = folder_source(tour, whole).one(tour[7], 0)  # UfM* again, on the depth that the network predicted
    np.testing.assert_array_equal(again.depth[0].numpy(), one["network_depth"])


def test_pictures_have_a_column_for_what_anchors_add(tour, finished):
    panel = FinishedRun(finished[0], tour, records(finished[0]), with_error=True).panel(7)
    stored = read_frame(finished[0] / "frames" / f"{tour.names[7]}.npz")
    expected = np.where(stored["valid"], np.sqrt(stored["anchored"]), np.nan)
    np.testing.assert_array_equal(panel.maps["anchored"], expected)
    assert [column.label for column in map_columns([panel])] == ["depth", "σ", "√B", "|error|"]


def saved_depths(tour, folder):
    """The tour's depth, one npy a frame, as a program would predict it."""
    folder.mkdir()
    for frame in tour:
        np.save(folder / f"{frame.name}.npy", frame.depth)
    return str(folder)


def test_images_are_needed(tour, monkeypatch, tmp_path, caplog):
    words = [TOUR, "--depth", "self", "--out", str(tmp_path / "out")]
    blind = with_entries(tour, lambda _, e: dataclasses.replace(e, load_image=None))
    monkeypatch.setattr("ufmstar_torch.eval.sequences.open.open_sequence", lambda *_, **__: blind)
    with pytest.raises(ValueError, match=r"--anchors corners searches images, of which the sequence .* has none"):
        job_from(read([*words, "--anchors", "corners"]), TOUR)
    assert not caplog.messages
    words[2] = saved_depths(tour, tmp_path / "maps")
    job = job_from(read(words), TOUR)
    assert job.config.posterior is job.config.anchors is None
    assert job.settings["plain"] is True
    assert [text for text in caplog.messages if "UfM* alone" in text and "has no images" in text]
    caplog.clear()
    assert job_from(read([*words, "--plain"]), TOUR).config == job.config
    assert not caplog.messages


def test_the_default_is_the_posterior_with_dense_evidence_and_plain_is_ufm_star_alone(tour, tmp_path):
    words = [TOUR, "--depth", saved_depths(tour, tmp_path / "maps"), "--out", "out"]
    jobs = {option: job_from(read([*words, *option.split()]), TOUR) for option in ("", "--plain", "--anchors corners")}
    assert {option: job.landmarks for option, job in jobs.items() if job.config.posterior} == {
        "": "dense",
        "--anchors corners": "corners",
    }
    assert jobs["--plain"].config == UfMStarConfig(on_bad_frame="skip")
    ranked = rank.read([TOUR, "--depth", "self", "--out", "out"])
    assert ranked.config.anchors is ranked.config.posterior is None
    assert rank.read([TOUR, "--depth", "self", "--out", "out", "--anchors", "dense"]).config.anchors is not None


@pytest.mark.parametrize("depth", ["self", "ground-truth"])
def test_the_recordings_own_depth_is_not_corrected_unless_anchors_are_named(depth, caplog):
    """A correction by depths that are searched in images makes a perfect depth worse."""
    words = [TOUR, "--depth", depth, "--out", "out"]
    plain = job_from(read(words), TOUR)
    assert plain.config == UfMStarConfig(on_bad_frame="skip")
    assert [text for text in caplog.messages if "the recording's own depth is not corrected" in text]
    assert plain.settings["plain"] is True
    for option in (["--anchors", "dense"], ["--set", "posterior.half_life=9"]):
        assert job_from(read([*words, *option]), TOUR).config.posterior is not None

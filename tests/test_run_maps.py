"""Depth maps from files as the input of a run: their intrinsics, the output of an earlier run, maps of a part."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from layouts import write_depth_png
from runs import Brightness, job_of, networks, own_depth_job

from ufmstar_torch import cli
from ufmstar_torch.eval.engine.maps import folder_source
from ufmstar_torch.eval.run.run import run
from ufmstar_torch.eval.run.writers import read_frame
from ufmstar_torch.eval.sequences import open_sequence
from ufmstar_torch.eval.sequences.ground_truth import resample_nearest
from ufmstar_torch.eval.tour import export_tour
from ufmstar_torch.models import Preprocess


def test_maps_of_another_size_get_their_intrinsics(scene, tmp_path):
    path, truth = scene
    for i, depth in enumerate(truth.depths):
        half = depth[1::2, 1::2]
        write_depth_png(tmp_path / "maps" / f"{i + 7}.png", half, 1000, scale_text="0.001")
        (tmp_path / "spread").mkdir(exist_ok=True)
        np.save(tmp_path / "spread" / f"{i + 7}.npy", np.full(half.shape, 0.04, np.float32))
    sequence = open_sequence(path)
    source = folder_source(sequence, tmp_path / "maps", variance=tmp_path / "spread")
    summary = run(job_of(sequence, source), tmp_path / "out")
    K = [truth.K[0, 0] / 2, truth.K[1, 1] / 2, (truth.K[0, 2] - 0.5) / 2, (truth.K[1, 2] - 0.5) / 2]
    np.testing.assert_allclose(summary["prediction"]["intrinsics"], K)
    assert summary["prediction"]["size"] == [24, 32]
    assert summary["metrics"]["delta1"] > 0.999
    assert summary["metrics"]["rmse"] < 1e-6, "the truth is sampled at the maps' pixels"
    assert summary["uncertainty"]["mean_network_sigma"] == pytest.approx(0.2)
    assert summary["uncertainty"]["mean_sigma"] > 0.2
    alone = summary["network_alone"]
    assert alone["nll"] == pytest.approx(0.5 * np.log(2 * np.pi * 0.04), abs=1e-6)


def test_the_variance_of_a_run_is_not_a_networks(path, tmp_path):
    run(own_depth_job(path), tmp_path / "first")
    with pytest.raises(ValueError, match="is the output of a run, whose variance contains M"):
        folder_source(open_sequence(path), tmp_path / "first", variance=tmp_path / "first" / "frames")


@pytest.mark.parametrize("shown", [1.0, 0.75])
def test_maps_of_the_middle_of_the_images_are_named(tmp_path, shown):
    path = export_tour(open_sequence("tour:41?frames=12&size=120x160"), tmp_path / "walk")
    sequence = open_sequence(path)
    for frame in (sequence[i] for i in range(len(sequence))):
        (height, width), K = frame.depth.shape, frame.intrinsics.copy()
        K[:2, :2] /= shown
        maps = resample_nearest(frame.depth, frame.intrinsics, K, (height, width))
        write_depth_png(tmp_path / "maps" / f"{frame.name}.png", maps, 1000, scale_text="0.001")
    summary = run(job_of(sequence, folder_source(sequence, tmp_path / "maps")), tmp_path / "out")
    named = [text for text in summary["warnings"] if "only the middle of the image (--map-intrinsics)" in text]
    assert len(named) == (shown < 1)
    assert (summary["depth_fit"]["ratio"] == pytest.approx(1, abs=0.05)) == (shown == 1)


def test_maps_that_were_cropped_need_their_intrinsics(path, tmp_path):
    for name in range(7, 13):
        write_depth_png(tmp_path / "maps" / f"{name}.png", np.ones((48, 48)), 1000, scale_text="0.001")
    sequence = open_sequence(path)
    with pytest.raises(ValueError, match=r"7\.png: the map is 48x48, the images are 64x48: .*give .* --map-intrinsics"):
        folder_source(sequence, tmp_path / "maps")
    # Only a later trajectory row is present: that frame is left out.
    for name in (7, 8, 9):
        write_depth_png(tmp_path / "maps" / f"{name}.png", np.ones((48, 64)), 1000, scale_text="0.001")
    summary = run(job_of(sequence, folder_source(sequence, tmp_path / "maps")), tmp_path / "out")
    assert summary["frames"]["done"] == 3
    assert "does not show the whole image" in next(iter(summary["frames"]["skipped"]))


def test_the_depth_of_a_run_as_maps_of_another_gives_the_same(path, tmp_path):
    """A network's cropped input: once predicted, and once from its stored maps and intrinsics."""
    preprocess = Preprocess(resize_height=40, crop=(30, 40), size=(24, 36))
    sequence = open_sequence(path)
    first = run(job_of(sequence, networks(Brightness(), preprocess=preprocess)), tmp_path / "first")
    K = first["prediction"]["intrinsics"]
    source = folder_source(sequence, tmp_path / "first" / "frames", intrinsics=K)
    second = run(job_of(sequence, source), tmp_path / "second")
    third = run(job_of(sequence, folder_source(sequence, tmp_path / "first")), tmp_path / "third")
    assert second["metrics"] == third["metrics"] == first["metrics"]
    for name in range(7, 13):
        a, *others = (read_frame(tmp_path / out / "frames" / f"{name}.npz") for out in ("first", "second", "third"))
        assert all(a[key].tobytes() == b[key].tobytes() for key in a for b in others)


def test_a_run_reads_back_what_another_left_and_skips_what_it_skipped(path, tmp_path):
    sequence, preprocess = open_sequence(path), Preprocess(resize_height=40, crop=(30, 40), size=(24, 36))
    broken = replace(sequence.entries[2], load_image=lambda: np.zeros((5, 5, 3), np.uint8))
    spoiled = replace(sequence, entries=(*sequence.entries[:2], broken, *sequence.entries[3:]))
    run(job_of(spoiled, networks(Brightness(), preprocess=preprocess), frames=slice(1, 5)), tmp_path / "first")
    for folder in ("first", "first/depth"):
        source = folder_source(sequence, tmp_path / folder, indices=range(1, 5))
        summary = run(job_of(sequence, source, frames=slice(1, 5)), tmp_path / "second", overwrite=True)
        assert summary["frames"]["done"] == 3
        assert "skipped in" in next(iter(summary["frames"]["skipped"]))
    with pytest.raises(ValueError, match="no map for 2 of 5 frames"):
        folder_source(sequence, tmp_path / "first")
    (tmp_path / "first" / "frames.jsonl").write_text("{}\n")
    with pytest.raises(ValueError, match=r"frames.jsonl, line 1 is not the record of a frame \(its name\): \{\}"):
        folder_source(sequence, tmp_path / "first")


def test_maps_of_some_frames_are_enough_where_only_those_are_run(path, tmp_path):
    words = ["run", str(path), "--plain", "--depth", str(tmp_path / "maps"), "--no-video", "--no-sheet", "--out"]
    for name, value in (("first", 1.0), ("second", 2.0)):  # paired in order: file and frame names differ
        write_depth_png(tmp_path / "maps" / f"{name}.png", np.full((48, 64), value), 1000, scale_text="0.001")
    assert cli.main([*words, str(tmp_path / "out"), "--frames", "2:4"]) == 0
    assert [read_frame(tmp_path / "out" / "frames" / f"{n}.npz")["depth"].max() for n in (9, 10)] == [1, 2]
    assert cli.main([*words, str(tmp_path / "other")]) == 2


def test_a_run_on_things_that_move_has_metrics_on_them_and_outside_of_them(tmp_path):
    job = own_depth_job("tour:62?style=hall&frames=8&size=24x32&movers=2")
    summary = run(job, tmp_path / "out")
    parts = summary["parts"]
    assert set(parts) == {"ufm.moving", "ufm.still"}
    assert min(figures["pixels"] for figures in parts.values()) > 0
    assert sum(figures["pixels"] for figures in parts.values()) == summary["metrics"]["pixels"]

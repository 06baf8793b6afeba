"""``ufmstar poses``: a rendered walk without its poses; scale from a trajectory, a length, pixels; refusals."""

from __future__ import annotations

import json

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from ufmstar_torch import cli
from ufmstar_torch.eval.reconstruct.keyframes import write_keyframes
from ufmstar_torch.eval.reconstruct.reconstruct import endpoint, scale_model, similarity
from ufmstar_torch.eval.sequences import open_sequence
from ufmstar_torch.eval.tour.sequence import export_tour

pytest.importorskip("pycolmap", reason="needs the extra recordings")
TOUR = "tour:5?style=home&frames=14&size=240x320&sensor=0"


@pytest.fixture(scope="module")
def walk(tmp_path_factory):
    """The tour, and its export: images, depth, poses.txt and K.txt."""
    tour = open_sequence(TOUR)
    return tour, export_tour(tour, tmp_path_factory.mktemp("walk") / "walk")


@pytest.fixture(scope="module")
def reconstructed(walk, tmp_path_factory):
    out = tmp_path_factory.mktemp("poses") / "out"
    assert cli.main(["poses", str(walk[1]), "--trajectory", "poses.txt", "--threads", "1", "--out", str(out)]) == 0
    return out


def test_a_walk_without_poses_gets_them(walk, reconstructed):
    tour, folder = walk
    truth = {name: entry.T_world_cam for name, entry in zip(tour.names, tour.entries, strict=True)}
    found = json.loads((reconstructed / "poses.json").read_text())
    assert (found["state"], found["scale_from"], found["gaps"]) == ("finished", "trajectory", [])
    assert found["models"] == [found["keyframes"]]
    assert found["residual"] < 0.03
    sequence = open_sequence(reconstructed, truth=str(folder / "depth"))
    assert sequence.metric
    np.testing.assert_allclose(sequence.intrinsics, tour.intrinsics, atol=1e-9)  # known and fixed
    for frame in sequence:
        assert np.linalg.norm(frame.T_world_cam[:3, 3] - truth[frame.name][:3, 3]) < 0.06
    depth = {frame.name: frame.depth for frame in tour}
    stored = np.load(reconstructed / "landmarks.npz")
    points, sigma = stored["points"], stored["sigma"]
    assert len(points) == found["landmarks"] > 50
    error = []
    for frame in sequence:  # visible landmarks against the rendered depth
        T = np.linalg.inv(frame.T_world_cam)
        x, y, z = (points @ T[:3, :3].T + T[:3, 3]).T
        with np.errstate(all="ignore"):
            u, v = (
                frame.intrinsics[0, 0] * x / z + frame.intrinsics[0, 2],
                frame.intrinsics[1, 1] * y / z + frame.intrinsics[1, 2],
            )
            inside = (z > 0) & (u > 0) & (u < 319) & (v > 0) & (v < 239)
        column, row = np.rint(u[inside]).astype(int), np.rint(v[inside]).astype(int)
        error.append(z[inside] / depth[frame.name][row, column] - 1)
    assert np.median(np.abs(np.concatenate(error))) < 0.03
    assert 0 < np.median(sigma) < 0.3


@pytest.mark.slow
def test_the_result_is_what_run_reads(reconstructed, walk, tmp_path):
    words = [
        "run",
        str(reconstructed),
        "--truth",
        str(walk[1] / "depth"),
        "--depth",
        "self",
        "--no-video",
        "--no-sheet",
    ]
    assert cli.main([*words, "--anchors", "landmarks.npz", "--frames", ":4", "--out", str(tmp_path / "out")]) == 0
    summary = json.loads((tmp_path / "out" / "summary.json").read_text())
    assert summary["anchors"]["used_per_frame"] > 10
    assert abs(summary["anchors"]["mean_bias"]) < 0.1


def test_a_length_between_images_gives_the_scale(walk, tmp_path, capfd):
    tour, folder = walk
    first, last = tour[0], tour[6]
    metres = np.linalg.norm(first.T_world_cam[:3, 3] - last.T_world_cam[:3, 3])
    words = ["--length", first.name, "6", f"{metres:.6f}", "--threads", "1", "--out", str(tmp_path / "out")]
    assert cli.main(["poses", str(folder), *words]) == 0
    assert "scale from the length" in capfd.readouterr().out
    sequence = open_sequence(tmp_path / "out")
    truth = {name: entry.T_world_cam for name, entry in zip(tour.names, tour.entries, strict=True)}
    ours = np.array([entry.T_world_cam[:3, 3] for entry in sequence.entries])
    scale, *_ = similarity(ours, np.array([truth[name][:3, 3] for name in sequence.names]))
    assert scale == pytest.approx(1, abs=0.05)


def test_a_length_from_an_image_that_is_not_there_is_refused_before_it_takes_time(walk, tmp_path, capfd, monkeypatch):
    monkeypatch.setattr(
        "ufmstar_torch.eval.reconstruct.keyframes.write_keyframes", lambda *_, **__: pytest.fail("too late")
    )
    words = ["poses", str(walk[1]), "--length", "000000", "99:3,4", "0.8", "--out", str(tmp_path / "out")]
    assert cli.main(words) != 0
    assert "--length: there is no image 99" in capfd.readouterr().err


def test_a_length_between_pixels_is_that_of_their_landmarks(walk, reconstructed):
    import pycolmap

    frame, model = walk[0][0], pycolmap.Reconstruction(reconstructed / "sparse" / "0")
    image = next(image for image in model.images.values() if image.name == f"{frame.name}.jpg")
    seen = sorted((p for p in image.points2D if p.has_point3D()), key=lambda point: point.xy[0])
    positions = [f"{frame.name}:{p.xy[0] - 0.5:.1f},{p.xy[1] - 0.5:.1f}" for p in (seen[0], seen[-1])]
    expected = [model.points3D[p.point3D_id].xyz for p in (seen[0], seen[-1])]
    ends = [endpoint(model, position) for position in positions]
    np.testing.assert_allclose(ends, expected)
    apart = np.linalg.norm(ends[1] - ends[0])
    assert scale_model(model, [], length=(*positions, 3 * apart))["metres_per_unit"] == pytest.approx(3)
    np.testing.assert_allclose(
        endpoint(model, positions[0]) - endpoint(model, positions[1]), 3 * (ends[0] - ends[1]), rtol=1e-6
    )
    for bad, message in (
        ("nowhere", "has no pose"),
        ("0:x", "must be NAME, or"),
        ("0:-99,-99", "no landmark within 6 px"),
    ):
        with pytest.raises(ValueError, match=message):
            endpoint(model, bad)


def test_without_a_scale_run_refuses(walk, tmp_path, capfd):
    out = tmp_path / "out"
    assert cli.main(["poses", str(walk[1]), "--frames", ":10", "--threads", "1", "--out", str(out)]) == 0
    assert "scale unknown" in capfd.readouterr().out
    assert not open_sequence(out).metric
    assert cli.main(["run", str(out), "--depth", "self", "--out", str(tmp_path / "run")]) == 2
    assert "--pose-scale M" in capfd.readouterr().err
    assert cli.main(["poses", str(walk[1]), "--out", str(out)]) == 2
    assert "--overwrite replaces it" in capfd.readouterr().err


def test_keyframes_are_apart(walk, tmp_path):
    tour, _ = walk
    still = [tour.entries[0]] * 3 + list(tour.entries[:2])
    chosen, broken = write_keyframes(still, tmp_path)
    assert chosen[0] == broken == 0
    assert not {1, 2, 3} & set(chosen), "the same image again"
    assert write_keyframes(still, tmp_path, always={tour.names[1]})[0][-1] == 4


def test_similarity_is_exact_and_leaves_outliers_out():
    rng = np.random.default_rng(0)
    x, R = rng.normal(size=(20, 3)), Rotation.from_euler("xyz", [0.3, -1.0, 2.0]).as_matrix()
    y = 2.5 * x @ R.T + [1, -2, 3]
    y[4] += 50
    scale, rotation, shift, residual = similarity(x, y)
    assert scale == pytest.approx(2.5)
    np.testing.assert_allclose(rotation, R, atol=1e-9)
    np.testing.assert_allclose(shift, [1, -2, 3], atol=1e-9)
    assert residual < 1e-9
    for bad in (x[:2], np.ones((5, 3))):
        with pytest.raises(ValueError, match="--trajectory"):
            similarity(bad, y[: len(bad)])


def test_images_that_fit_no_model(tmp_path, capfd):
    from PIL import Image

    (tmp_path / "blank" / "images").mkdir(parents=True)
    for i in range(4):
        Image.new("RGB", (160, 120), (90, 90, 90)).save(tmp_path / "blank" / "images" / f"{i}.png")
    assert cli.main(["poses", str(tmp_path / "blank"), "--out", str(tmp_path / "out")]) == 2
    assert "0 keyframes, of which 3 are needed" in capfd.readouterr().err
    assert cli.main(["poses", str(tmp_path / "none"), "--out", str(tmp_path / "out2")]) == 2
    assert "no such file or folder" in capfd.readouterr().err

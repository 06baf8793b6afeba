"""docs/anchors.md: the code blocks run in order and give the stated results."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch
from pages import blocks

import scenes
from ufmstar_torch.eval.commands.run import read
from ufmstar_torch.gaussians.camera import resize_intrinsics

PAGE = Path(__file__).resolve().parents[1] / "docs" / "anchors.md"
H, W = 48, 64
TOO_FAR = 1.25


def seen_points(truth, K, v, u):
    """[N, 3] points at the pixels (u, v) of a depth map, in the camera's frame."""
    z = truth[v, u]
    return np.stack([(u - K[0, 2]) / K[0, 0] * z, (v - K[1, 2]) / K[1, 1] * z, z], axis=-1)


def video():
    """Images of a rendered room, and depth at half their size, 25 % too far."""
    from ufmstar_torch.eval.sequences.open import open_sequence

    for frame in open_sequence("tour:5?frames=6&size=120x160"):
        K_map = resize_intrinsics(torch.from_numpy(frame.intrinsics), (120, 160), (60, 80))
        depth = torch.from_numpy(TOO_FAR * frame.depth[::2, ::2])
        yield frame.image, depth, torch.from_numpy(frame.T_world_cam), frame.intrinsics, K_map


def two_cameras():
    """The inputs of the page: a map of 30 landmarks for one camera, and a lidar of 20 beams for the other."""
    depths, poses, K = scenes.sequence(2, H, W, 0.0)
    rng = np.random.default_rng(0)
    v, u = rng.permutation(np.argwhere(depths[0] > 0))[:30].T
    in_world = seen_points(depths[0], K, v, u) @ poses[0][:3, :3].T + poses[0][:3, 3]
    T_cam_lidar = scenes.camera_pose((0.1, -0.05, 0.02), 0.1)
    row, columns = H // 2, np.linspace(4, W - 5, 20).astype(int)
    in_camera = seen_points(depths[1], K, np.full(20, row), columns)
    in_lidar = (in_camera - T_cam_lidar[:3, 3]) @ T_cam_lidar[:3, :3]
    ranges = np.linalg.norm(in_lidar, axis=1)
    beams = in_lidar / ranges[:, None]
    ranges[[3, 7]] = np.nan
    arrays = {
        "depth": TOO_FAR * np.stack(depths),
        "pose": np.stack(poses),
        "K_map": K,
        "landmarks": in_world,
        "sigma_landmarks": np.full(30, 0.01),
        "T_cam_lidar": T_cam_lidar,
        "beams": beams,
        "ranges": ranges,
    }
    expected = [(u, v, depths[0][v, u]), (columns, np.full(20, row), depths[1][row, columns])]
    return {name: torch.from_numpy(value) for name, value in arrays.items()}, expected


def test_every_piece_of_code_runs(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    track, two_sources, next_start = blocks(PAGE.read_text())
    scope = {"video": list(video())}
    exec(compile(track, PAGE.name, "exec"), scope)
    assert scope["out"].statistics.anchors_used.item() > 0
    assert float(scope["out"].anchored.nan_to_num(0).max()) > 0

    inputs, expected = two_cameras()
    scope = dict(inputs)
    exec(compile(two_sources, PAGE.name, "exec"), scope)
    actual = scope["anchors"]
    assert actual.valid.sum(1).tolist() == [30, 18]
    for stream, (u, v, z) in enumerate(expected):
        use = actual.valid[stream, : len(z)].numpy()
        pixel = np.stack([u, v], axis=-1)[use]
        np.testing.assert_allclose(actual.pixel[stream, : len(z)].numpy()[use], pixel, atol=1e-6)
        np.testing.assert_allclose(actual.depth[stream, : len(z)].numpy()[use], z[use], rtol=1e-9)
    out = scope["out"]
    assert "[30, 18]" in capsys.readouterr().out
    # Both streams estimate r = 1/1.25 - 1 = -.2, reduced by the shrinkage for few anchors.
    for stream in (0, 1):
        assert -0.21 < float(out.bias[stream].nanmean()) < -0.13

    exec(compile(next_start, PAGE.name, "exec"), scope)
    first = scope["ufm"](inputs["depth"], inputs["pose"], inputs["K_map"])
    assert float(first.bias.nanmean()) == pytest.approx(float(out.bias.nanmean()), rel=0.2)
    assert first.statistics.unmeasured.tolist() == first.statistics.valid_pixels.tolist(), "a first view"


def test_the_flag_on_the_page_is_one():
    (command,) = [block for block in blocks(PAGE.read_text(), "bash") if block.startswith("ufmstar run")]
    options = read(command.split()[2:])
    assert options.uncertainty.anchors == "corners"
    assert options.config.posterior is not None
    assert options.network.model == "fastdepth"

"""The check of a sequence recognises the mistakes people make, and finds nothing wrong where nothing is."""

from __future__ import annotations

import dataclasses

import layouts
import numpy as np
import pytest

from scenes import look
from ufmstar_torch.eval.check.check import check_sequence
from ufmstar_torch.eval.check.depth_image_fit import depth_edges, depth_image_fit
from ufmstar_torch.eval.sequences import open_sequence
from ufmstar_torch.eval.sequences.ground_truth import register_depth
from ufmstar_torch.eval.sequences.poses import OURS

SIZE = (120, 160)


def with_poses(sequence, convert):
    entries = tuple(dataclasses.replace(e, T_world_cam=convert(e.T_world_cam)) for e in sequence.entries)
    return dataclasses.replace(sequence, entries=entries)


@pytest.fixture(scope="module")
def walk(tmp_path_factory):
    """A rendered walk of 20 frames in the generic layout, 160x120."""
    path = tmp_path_factory.mktemp("walk")
    K = layouts.resized(500, 500, 320, 240, (480, 640), SIZE)
    truth = layouts.truth(K, 20, SIZE)
    for i in range(20):
        layouts.write_image(path / "images" / f"{i}.png", truth.images[i])
        layouts.write_depth_png(path / "depth" / f"{i}.png", truth.depths[i], 1000)
    np.savetxt(path / "K.txt", K)
    np.savetxt(path / "poses.txt", [T.ravel() for T in truth.T_world_cam])
    return path


@pytest.mark.parametrize("factor", [0.2, 0.5, 5.0, 1000.0])
def test_a_wrong_depth_scale_is_recognised(walk, factor):
    result = check_sequence(open_sequence(walk, depth_scale=min(1.0, 1e-3 * factor)))
    assert len(result.problems) == 1
    assert ("too large" if factor > 1 else "too small") in result.problems[0]
    assert result.scale == pytest.approx(1 / factor, rel=0.05)


def test_nonsense_poses_fit_no_reading(walk):
    rng = np.random.default_rng(0)

    def turned(T):
        return T @ look(rng.normal(0, 1, 3), *rng.normal(0, 0.4, 2))

    result = check_sequence(with_poses(open_sequence(walk), turned))
    assert not result.ok
    assert any("disagree" in problem or "no two frames overlap" in problem for problem in result.problems)


def test_a_camera_that_stands_still_leaves_it_undecided(walk):
    sequence = open_sequence(walk)
    still = dataclasses.replace(sequence, entries=(sequence.entries[3],) * 10)
    result = check_sequence(still)
    assert result.ok
    assert any("tell the depth's scale" in text for text in result.undecided)
    assert any("does not tell the poses from world-to-camera" in text for text in result.undecided)


@pytest.mark.parametrize("writer", ["write_tum", "write_seven_scenes", "write_scannet", "write_tartanair"])
def test_every_generated_layout_is_consistent(tmp_path, writer):
    path = getattr(layouts, writer)(tmp_path, frames=8)[0]
    result = check_sequence(open_sequence(path))
    assert result.ok
    assert result.error < 0.02
    assert result.poses == OURS
    if writer == "write_seven_scenes":
        own = check_sequence(open_sequence(path, register=False))
        assert own.ok
        assert own.registration is None  # the sequence does not claim that depth lies on the images


def test_depth_edges_lie_on_the_near_side_and_planes_have_none():
    v, u = np.mgrid[0:40, 0:60].astype(float)
    slanted = 1 / (0.2 + 0.01 * u + 0.005 * v)  # a plane: inverse depth is linear
    assert not depth_edges(slanted).any()
    step = np.where(u < 30, 1.0, 2.0)
    edge = depth_edges(step)
    assert edge[:, 27:30].all()
    assert edge.sum() == 40 * 3
    step[:, 33:] = 0  # nothing known on one side: no edge can be told
    assert depth_edges(step)[:, 30:].sum() == 0
    assert not depth_edges(np.zeros((40, 60))).any()
    assert np.isnan(depth_image_fit([(np.zeros((40, 60, 3), np.uint8), np.zeros((40, 60)))]).quality)


def test_unregistered_depth_is_flagged():
    """Depth as 7-Scenes' depth camera sees it, taken for the colour camera's."""
    size = (240, 320)
    K_color = layouts.resized(525, 525, 320, 240, (480, 640), size)
    K_depth = layouts.resized(585, 585, 320, 240, (480, 640), size)
    truth = layouts.truth(K_color, 8, size)
    T_depth_color = np.eye(4)
    T_depth_color[0, 3] = 0.025
    good = depth_image_fit(zip(truth.images, truth.depths, strict=True))
    assert good.quality > 0.8
    unregistered = [register_depth(d, K_color, K_depth, T_depth_color, size) for d in truth.depths]
    bad = depth_image_fit(zip(truth.images, unregistered, strict=True))
    assert bad.quality < 0.25
    assert bad.zoom == pytest.approx(525 / 585, abs=0.03)
    assert bad.shift_x < 0
    moved = [np.roll(depth, (6, -8), axis=(0, 1)) for depth in truth.depths]  # what undoes it is found
    result = depth_image_fit(zip(truth.images, moved, strict=True))
    assert result.quality < 0.25
    assert result.zoom == pytest.approx(1, abs=0.03)
    assert result.shift_x - good.shift_x == pytest.approx(8, abs=2)  # steps of 2 px
    assert result.shift_y - good.shift_y == pytest.approx(-6, abs=2)

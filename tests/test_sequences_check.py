"""The check of a sequence recognises the mistakes people make, and finds nothing wrong where nothing is."""

from __future__ import annotations

import dataclasses

import layouts
import numpy as np
import pytest

from scenes import look
from ufmstar_torch.eval.check.check import check_sequence
from ufmstar_torch.eval.sequences import open_sequence
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

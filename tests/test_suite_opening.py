"""``ufmstar eval`` opens sequences with the options of ``ufmstar run``."""

from __future__ import annotations

import layouts
import numpy as np

from ufmstar_torch.eval.commands.evaluate import job_from, read
from ufmstar_torch.eval.sequences import open_sequence


def test_seven_scenes_with_its_own_calibration(tmp_path):
    path, _, of_depth = layouts.write_seven_scenes(tmp_path)
    np.savetxt(tmp_path / "T.txt", np.eye(4))
    K = [of_depth.K[0, 0], of_depth.K[1, 1], of_depth.K[0, 2], of_depth.K[1, 2]]
    words = ["--suite", "depth-only", "--network", "depth_only=ground-truth", "--root", path, "--out", "out"]
    words += ["--T-color-depth", tmp_path / "T.txt", "--intrinsics", *K, "--depth-intrinsics", *K]
    (item,) = job_from(read([str(word) for word in words])).items
    expected = open_sequence(path, T_color_depth=np.eye(4), intrinsics=K, depth_intrinsics=K)
    np.testing.assert_array_equal(item.open()[2].depth, expected[2].depth)
    np.testing.assert_allclose(item.open()[2].depth, of_depth.depths[2], atol=1e-3)
    np.testing.assert_array_equal(item.open()[2].T_world_cam, expected[2].T_world_cam)

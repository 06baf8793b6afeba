"""``ufmstar eval`` opens sequences and networks with the options of ``ufmstar run``."""

from __future__ import annotations

import json

import layouts
import numpy as np
import pytest
import torch

from ufmstar_torch.eval.commands.evaluate import job_from, read
from ufmstar_torch.eval.sequences import open_sequence


class TwoMetres(torch.nn.Module):
    def forward(self, image):
        return torch.full_like(image[:, :1], 2.0)


@pytest.mark.filterwarnings("ignore:`torch.jit:FutureWarning", "ignore:`torch.jit:DeprecationWarning")
def test_a_torchscript_network_with_its_spec(ufmstar, tmp_path):
    path, truth = layouts.write_generic(tmp_path / "data")
    torch.jit.trace(TwoMetres(), torch.zeros(1, 3, 48, 64)).save(tmp_path / "n.ts")
    spec = {"preprocess": {"size": [48, 64]}, "outputs": {"kind": "metric", "scale": 1.5}}
    (tmp_path / "spec.json").write_text(json.dumps(spec))
    words = ["eval", "--suite", "depth-only", "--root", path, "--layout", "generic", "--max-truth", "3.5"]
    words += ["--network", f"depth_only=torchscript:{tmp_path / 'n.ts'}", "--no-report", "--out", tmp_path / "out"]
    assert ufmstar(*words)[0] != 0  # the file does not say what it returns
    code, _, err = ufmstar(*words, "--spec", tmp_path / "spec.json", "--overwrite")
    assert code == 0, err
    record = json.loads((tmp_path / "out/records/generic/walk/DepthOnly.json").read_text())
    near = [np.rint(depth * 1000) / 1000 for depth in truth.depths]
    errors = np.concatenate([(3.0 - depth)[depth <= 3.5] for depth in near])
    assert errors.size < sum(depth.size for depth in near)
    assert record["figures"]["rmse"] == pytest.approx(np.sqrt(np.square(errors).mean()), rel=1e-5)
    assert ufmstar(*words, "--spec", tmp_path / "spec.json", "--resume")[0] == 0
    code, _, err = ufmstar(*words, "--spec", tmp_path / "spec.txt", "--overwrite")
    assert (code, err) == (2, f"ufmstar eval: --spec must be a file *.json, got '{tmp_path / 'spec.txt'}'\n")


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

"""Depth predicted by another program: formats, scales, variance, pairing with frames."""

from __future__ import annotations

import numpy as np
import pytest
from layouts import truncate, write_depth_png

from ufmstar_torch.eval.sequences import FrameError, depth_maps
from ufmstar_torch.eval.sequences.images import read_depth

NAMES = ("000000_left", "000001_left", "000002_left")
DEPTHS = [np.full((3, 4), value) for value in (1.0, 2.0, 3.0)]


def write_pngs(folder, names, units=1000, scale_text=None):
    for name, depth in zip(names, DEPTHS, strict=True):
        write_depth_png(folder / f"{name}.png", depth, units, scale_text)


def values(maps):
    return [float(depth[0, 0]) for depth, _ in maps]


def test_png_scale_is_given_or_in_the_file(tmp_path):
    write_pngs(tmp_path / "a", NAMES, units=4000)
    with pytest.raises(ValueError, match="holds integers and no text 'depth_scale': pass metres per unit"):
        depth_maps(tmp_path / "a", NAMES)
    assert values(depth_maps(tmp_path / "a", NAMES, scale=1 / 4000)) == [1, 2, 3]
    write_pngs(tmp_path / "b", NAMES, units=4000, scale_text="0.00025")
    assert values(depth_maps(tmp_path / "b", NAMES)) == [1, 2, 3]
    with pytest.raises(ValueError, match=r"^scale is in metres per unit"):
        depth_maps(tmp_path / "b", NAMES, scale=4000)


def test_a_scale_that_the_file_contradicts_is_refused(tmp_path):
    write_pngs(tmp_path, NAMES, units=4000, scale_text="0.00025")
    assert values(depth_maps(tmp_path, NAMES, scale=1 / 4000)) == [1, 2, 3], "the same unit"
    contradiction = (
        r"000000_left\.png: its text depth_scale states 0\.00025 metres per unit, which contradicts .* 0\.001"
    )
    with pytest.raises(ValueError, match=rf"^scale: .*{contradiction}"):
        depth_maps(tmp_path, NAMES, scale=1e-3)
    with pytest.raises(FrameError, match=contradiction):
        read_depth(tmp_path / f"{NAMES[0]}.png", scale=1e-3)


@pytest.mark.parametrize(
    "names",
    [
        NAMES,
        [f"{name}_depth" for name in NAMES],
        ["pred_0", "pred_1", "pred_2"],
        ["first", "second", "third"],  # no common names: paired in sorted order, as the counts agree
    ],
)
def test_maps_pair_by_stem_by_number_or_in_order(tmp_path, names):
    write_pngs(tmp_path, names)
    assert values(depth_maps(tmp_path, NAMES, scale=1e-3)) == [1, 2, 3]


def test_a_damaged_first_map_is_a_frame_that_cannot_be_read(tmp_path):
    for number, depth in enumerate(DEPTHS):
        np.save(tmp_path / f"{number}.npy", depth.astype(np.float32))
    truncate(tmp_path / "0.npy")
    maps = depth_maps(tmp_path, ("0", "1", "2"))
    with pytest.raises(FrameError, match=r"0\.npy"):
        maps[0]
    assert float(maps[1][0][0, 0]) == 2


def test_sorted_order_counts_skipped_frames(tmp_path):
    write_pngs(tmp_path, ["x", "y", "z"])
    assert values(depth_maps(tmp_path, NAMES[1:], scale=1e-3, names_on_disk=NAMES)) == [2, 3]
    with pytest.raises(ValueError, match=r"no map for 2 of 2 frames \(000001_left, 000002_left\); its 3 files"):
        depth_maps(tmp_path, NAMES[1:], scale=1e-3)


def test_variance_beside_depth_in_one_npz(tmp_path):
    for name, depth in zip(NAMES, DEPTHS, strict=True):
        variance = 0.01 * depth
        variance[0, 1], variance[0, 2] = -1, np.nan
        np.savez(tmp_path / f"{name}.npz", depth=depth, variance=variance, other=depth)
    maps = depth_maps(tmp_path, NAMES, variance=tmp_path)
    depth, variance = maps[1]
    np.testing.assert_allclose(variance[0], [0.02, 0, 0, 0.02])
    np.testing.assert_allclose(depth[0], [2, 0, 0, 2])  # no variance, no prediction
    assert (depth.dtype, variance.dtype) == (np.float32, np.float32)
    assert depth_maps(tmp_path, NAMES)[1][1] is None


def test_variance_in_a_folder_of_its_own(tmp_path):
    write_pngs(tmp_path / "depth", NAMES)
    (tmp_path / "variance").mkdir()
    for name, depth in zip(NAMES, DEPTHS, strict=True):
        np.save(tmp_path / "variance" / f"{name}.npy", depth**2)
    maps = depth_maps(tmp_path / "depth", NAMES, scale=1e-3, variance=tmp_path / "variance")
    # the scale applies to the depth; the variance stays in m^2
    assert [float(maps[i][1][0, 0]) for i in range(3)] == [1, 4, 9]
    np.save(tmp_path / "variance" / f"{NAMES[0]}.npy", np.ones((2, 2)))
    with pytest.raises(FrameError, match=r"the variance is \[2, 2\], its depth \[3, 4\]"):
        maps[0]


def test_broken_maps_and_folders(tmp_path):
    write_pngs(tmp_path / "a", NAMES)
    maps = depth_maps(tmp_path / "a", NAMES, scale=1e-3)
    truncate(tmp_path / "a" / f"{NAMES[2]}.png")
    assert values([maps[0]]) == [1]
    with pytest.raises(FrameError):
        maps[2]
    with pytest.raises(NotADirectoryError, match="no such folder"):
        depth_maps(tmp_path / "absent", NAMES)
    (tmp_path / "empty").mkdir()
    with pytest.raises(ValueError, match="holds no map"):
        depth_maps(tmp_path / "empty", NAMES)
    np.save(tmp_path / "a" / "x.npy", DEPTHS[0])
    with pytest.raises(ValueError, match=r"holds several formats, \.npy, \.png"):
        depth_maps(tmp_path / "a", NAMES)

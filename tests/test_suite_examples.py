"""The maps of pictures belong to the named frame."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from layouts import truncate, write_generic
from tiny_suite import base_network, evaluate, row, unbatched

from ufmstar_torch import UfMStar
from ufmstar_torch.eval.sequences import open_sequence
from ufmstar_torch.eval.sequences.ground_truth import truth_at

ROWS = [row("UfM*-Aleatoric"), row("Aleatoric"), row("DepthOnly"), row("UfM-Aleatoric-100K")]


@pytest.fixture(scope="module")
def folder(networks, sequence, tmp_path_factory):
    folder = tmp_path_factory.mktemp("out")
    evaluate(sequence, ROWS, networks, examples=folder)
    return folder


def read(path):
    with np.load(path, allow_pickle=False) as stored:
        return {name: stored[name] for name in stored.files}


def test_a_few_evenly_spaced_frames(folder, sequence):
    frames = sorted(file.stem for file in (folder / "examples").iterdir() if "@" not in file.name)
    assert frames == sorted(sequence.names[i] for i in (0, 2, 4))
    for frame in frames:
        rows = {file.name.partition("@")[2] for file in (folder / "examples").glob(f"{frame}@*.npz")}
        assert rows == {f"{one.slug}.npz" for one in ROWS}


def test_the_maps_are_the_frames(folder, networks, sequence):
    ufm = UfMStar()
    for frame in sequence:
        p = unbatched(networks["aleatoric"], frame)
        out = ufm(p.depth[None], torch.from_numpy(frame.T_world_cam), p.intrinsics, p.aleatoric[None])
        if frame.index == 2:
            break
    scene, maps = (read(folder / "examples" / f"{frame.name}{end}.npz") for end in ("", "@UfMstar-Aleatoric"))
    assert scene["index"] == 2
    np.testing.assert_array_equal(scene["K"], p.intrinsics)
    np.testing.assert_array_equal(scene["truth"], truth_at(frame, p.intrinsics.numpy(), p.size))
    assert maps.keys() == {"depth", "variance", "aleatoric", "disagreement", "measured"}
    np.testing.assert_array_equal(maps["depth"], p.depth)
    np.testing.assert_array_equal(maps["variance"], out.variance[0])
    np.testing.assert_array_equal(maps["aleatoric"], p.aleatoric)
    np.testing.assert_array_equal(maps["disagreement"], out.disagreement[0])
    assert all(values.dtype == np.float32 for values in maps.values())
    assert read(folder / "examples" / f"{frame.name}@DepthOnly.npz").keys() == {"depth"}
    assert read(folder / "examples" / f"{frame.name}@Aleatoric.npz").keys() == {"depth", "variance", "aleatoric"}


def test_the_image_is_what_the_network_saw(folder, networks, sequence):
    frame = sequence[2]
    shown = read(folder / "examples" / f"{frame.name}.npz")["image"]
    assert shown.shape == (32, 64, 3)
    assert shown.dtype == np.uint8
    image = torch.from_numpy(frame.image).permute(2, 0, 1)[None]
    x, _ = networks["aleatoric"].networks[0].preprocess(image, torch.from_numpy(frame.intrinsics)[None])
    seen = 255 * x[0].permute(1, 2, 0).numpy()
    assert np.abs(shown - seen).mean() < 4, "grey levels"


def test_a_broken_frame_hands_its_place_to_the_next(networks, tmp_path):
    path = write_generic(tmp_path, frames=6)[0]
    sequence = open_sequence(path)
    truncate(path / "images" / f"{sequence.names[2]}.png")
    truncate(path / "images" / f"{sequence.names[5]}.png")
    evaluate(sequence, [row("UfM*-Aleatoric")], networks, examples=tmp_path / "out")
    assert {file.name.partition(".")[0] for file in (tmp_path / "out" / "examples").glob("*[0-9].npz")} == {
        sequence.names[i] for i in (0, 3, 4)
    }


def test_maps_of_another_camera_bring_their_own(networks, sequence, tmp_path):
    both = {"aleatoric": networks["aleatoric"], "depth_only": base_network("depth_only=ground-truth:24x32")}
    evaluate(sequence, [row("Aleatoric"), row("DepthOnly")], both, examples=tmp_path)
    name = sequence.names[2]
    other = read(tmp_path / "examples" / f"{name}@DepthOnly.npz")
    assert read(tmp_path / "examples" / f"{name}.npz")["truth"].shape == (32, 64)
    assert other["truth"].shape == other["depth"].shape == other["image"].shape[:2] == (24, 32)
    np.testing.assert_array_equal(other["truth"], other["depth"])

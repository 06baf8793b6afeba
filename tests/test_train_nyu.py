"""NYU Depth V2 for training: the read data equals the written data; damage; conversion."""

from __future__ import annotations

import h5py
import numpy as np
import pytest
from layouts import truncate
from layouts_more import write_h5
from scipy.io import savemat
from training_data import PLAIN, nyu_frame, write_nyu

from ufmstar_torch.eval.sequences import FrameError, open_sequence
from ufmstar_torch.train import SampleDataset, SequenceFrames, convert_labelled, nyu


def frames_of(root, part="train"):
    return SequenceFrames([open_sequence(root / part)])


def test_nyu_frames_are_what_the_files_hold(tmp_path):
    frames = frames_of(write_nyu(tmp_path))
    # 8 before 10 before 12: numbers by value.
    names = [f"nyu_train/kitchen_{s}__{n}" for s, n in ((0, 8), (0, 10), (0, 12), (1, 9), (1, 11), (1, 13))]
    assert [frames.name(index) for index in range(6)] == names
    for index, number in enumerate((0, 2, 4, 1, 3, 5)):
        rgb, depth = nyu_frame(number)
        raw = frames.load(index)
        np.testing.assert_array_equal(raw.image, rgb.transpose(1, 2, 0))
        np.testing.assert_array_equal(raw.depth, depth)
        assert np.isnan(raw.T_world_cam).all()
    assert len(frames_of(tmp_path, "val")) == 3


RGB, DEPTH = nyu_frame(0)
BROKEN = {
    "empty": lambda p: p.write_bytes(b""),
    "half": lambda p: truncate(p, 0.5),
    "last byte": lambda p: truncate(p, 0.9999),
    "text": lambda p: p.write_text("<html>404</html>" * 200),
    "folder": lambda p: (p.unlink(), p.mkdir()),
    "gone": lambda p: p.unlink(),
    "no depth": lambda p: (p.unlink(), write_h5(p, RGB, None)),
    "no rgb": lambda p: (p.unlink(), write_h5(p, None, DEPTH)),
    "float rgb": lambda p: (p.unlink(), write_h5(p, RGB.astype(np.float32), DEPTH)),
    "rgb last": lambda p: (p.unlink(), write_h5(p, RGB.transpose(1, 2, 0), DEPTH)),
    "integer depth": lambda p: (p.unlink(), write_h5(p, RGB, DEPTH.astype(np.int16))),
    "depth size": lambda p: (p.unlink(), write_h5(p, RGB, DEPTH[:-1])),
    "depth channel": lambda p: (p.unlink(), write_h5(p, RGB, DEPTH[None])),
    "no pixels": lambda p: (p.unlink(), write_h5(p, RGB[:, :0], DEPTH[:0])),
}


@pytest.mark.parametrize("how", BROKEN.values(), ids=BROKEN.keys())
def test_a_broken_h5_is_named_or_skipped(how, tmp_path, caplog):
    frames = frames_of(write_nyu(tmp_path))
    how(tmp_path / "train" / "kitchen_0" / "12.h5")
    with pytest.raises(FrameError, match=r"kitchen_0__12: "):
        SampleDataset(frames, PLAIN)[2]
    dataset = SampleDataset(frames, PLAIN, on_bad_file="skip")
    samples = [dataset[i] for i in range(len(dataset))]
    np.testing.assert_array_equal(samples[2]["depth"][0].numpy(), nyu_frame(1)[1])
    assert f"skipped a broken file: {frames.name(2)}: " in caplog.text


def test_damage_anywhere_is_an_error_of_the_file_or_none_at_all(tmp_path):
    path = tmp_path / "train" / "a" / "1.h5"
    write_h5(path, *nyu_frame(0))
    whole, frames = path.read_bytes(), frames_of(tmp_path)
    rng, errors, harmless = np.random.default_rng(0), 0, 0
    for _ in range(60):
        at = int(rng.integers(len(whole))) if rng.random() < 0.5 else int(rng.integers(2500))
        broken = whole[:at] if rng.random() < 0.3 else whole[:at] + rng.bytes(64) + whole[at + 64 :]
        path.write_bytes(broken)
        try:
            frames.load(0)
        except FrameError as error:
            errors += frames.name(0) in str(error)
        else:
            harmless += 1
    assert errors + harmless == 60
    assert errors > 10


SCENES = ["attic_1", "attic_1", "bath_1", "cafe_1", "den_1", "den_1"]


def write_mat(path, width=64, height=48):
    """Write the file like MATLAB 7.3: column-major, strings as references to columns of UTF-16."""
    rng = np.random.default_rng(5)
    rgb = rng.integers(0, 256, (len(SCENES), height, width, 3), np.uint8)
    depth = rng.uniform(0.7, 9, (len(SCENES), height, width)).astype(np.float32)
    raw = np.where(rng.random(depth.shape) < 0.2, 0, depth).astype(np.float32)
    with h5py.File(path, "w") as file:
        file["images"] = rgb.transpose(0, 3, 2, 1)
        file["depths"], file["rawDepths"] = depth.transpose(0, 2, 1), raw.transpose(0, 2, 1)
        references = file.create_dataset("scenes", (1, len(SCENES)), dtype=h5py.ref_dtype)
        for i, scene in enumerate(SCENES):
            codes = np.array([[ord(letter)] for letter in scene], np.uint16)
            references[0, i] = file.create_dataset(f"#refs#/{i}", data=codes).ref
    return rgb, depth, raw


def test_the_labelled_file_becomes_fastdepths_layout(tmp_path):
    rgb, depth, _ = write_mat(tmp_path / "labelled.mat")
    counts = convert_labelled(tmp_path / "labelled.mat", tmp_path / "nyu")
    assert counts == {"train": 4, "val": 2}  # every fourth scene, the den, with all its frames
    train, val = (frames_of(tmp_path / "nyu", part) for part in ("train", "val"))
    assert [train.name(i) for i in range(4)] == [f"nyu_train/{s}__0000{i + 1}" for i, s in enumerate(SCENES[:4])]
    assert [val.name(i) for i in range(2)] == ["nyu_val/den_1__00005", "nyu_val/den_1__00006"]
    for frames, indices in ((train, range(4)), (val, range(4, 6))):
        for k, i in enumerate(indices):
            np.testing.assert_array_equal(frames.load(k).image, rgb[i])
            np.testing.assert_array_equal(frames.load(k).depth, depth[i])


def test_the_official_split_and_the_sensors_own_depth(tmp_path):
    _, _, raw = write_mat(tmp_path / "labelled.mat")
    splits = {"trainNdxs": np.array([[1], [3], [6]]), "testNdxs": np.array([[2], [4], [5]])}
    savemat(tmp_path / "splits.mat", splits)
    counts = convert_labelled(tmp_path / "labelled.mat", tmp_path / "nyu", tmp_path / "splits.mat", raw=True)
    assert counts == {"train": 3, "val": 3}
    val = frames_of(tmp_path / "nyu", "val")
    assert [val.name(i)[-2:] for i in range(3)] == ["02", "04", "05"]
    np.testing.assert_array_equal(val.load(1).depth, raw[3])
    savemat(tmp_path / "splits.mat", {**splits, "testNdxs": np.array([[2], [4]])})
    with pytest.raises(ValueError, match="divide the frames 1 to 6"):
        convert_labelled(tmp_path / "labelled.mat", tmp_path / "other", tmp_path / "splits.mat")


def test_an_interrupted_conversion_goes_on(tmp_path, monkeypatch):
    write_mat(tmp_path / "labelled.mat")
    write = nyu.write_atomic

    def full_after_3(path, function):
        if path.name == "00004.h5":
            raise OSError("disk full")
        write(path, function)

    monkeypatch.setattr(nyu, "write_atomic", full_after_3)
    with pytest.raises(OSError, match="disk full"):
        convert_labelled(tmp_path / "labelled.mat", tmp_path / "nyu")
    monkeypatch.setattr(nyu, "write_atomic", write)
    first = {p: p.stat().st_mtime_ns for p in (tmp_path / "nyu").rglob("*.h5")}
    assert len(first) == 3
    convert_labelled(tmp_path / "labelled.mat", tmp_path / "nyu")
    assert len(list((tmp_path / "nyu").rglob("*.h5"))) == 6
    assert all(p.stat().st_mtime_ns == t for p, t in first.items())
    assert not list((tmp_path / "nyu").rglob("*.tmp"))

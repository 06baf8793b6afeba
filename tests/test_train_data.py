"""Training data: what is read is what was written, broken files, held-back parts, order, resumption, workers."""

from __future__ import annotations

import logging
import pickle
import shutil
from types import SimpleNamespace

import h5py
import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from layouts import truth, write_generic, write_scannet, write_tum
from scipy.io import savemat

from ufmstar_torch.eval.sequences import open_sequence
from ufmstar_torch.models.preprocess import Preprocess
from ufmstar_torch.train.augment import Augmentation, AugmentationConfig
from ufmstar_torch.train.batches import EpochBatches, EpochLoader
from ufmstar_torch.train.data import DataConfig, DepthDataModule
from ufmstar_torch.train.nyu import INTRINSICS, NyuFrames, convert_labelled
from ufmstar_torch.train.parts import Part
from ufmstar_torch.train.samples import RawSample, SampleDataset, SampleError, SampleKey, make_sample
from ufmstar_torch.train.sequence_data import SequenceFrames, open_rgbd
from ufmstar_torch.train.tour_data import TourFrames, TourSettings, tour_files, tour_frames
from ufmstar_torch.train.unposed import open_unposed

SMALL = (48, 64)  # NYU's aspect ratio
PLAIN = Preprocess()


def nyu_frame(number: int, size=SMALL) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(number)
    return rng.integers(0, 256, (3, *size), np.uint8), rng.uniform(0.5, 9, size).astype(np.float32)


def write_h5(path, rgb, depth, **others):
    path.parent.mkdir(parents=True, exist_ok=True)
    with h5py.File(path, "w") as file:
        for name, value in {"rgb": rgb, "depth": depth, **others}.items():
            if value is not None:
                file[name] = value


def write_nyu(root, frames=6):
    """Two scenes of training frames, numbered without leading zeros, and one of validation frames."""
    for i in range(frames):
        write_h5(root / "train" / f"kitchen_{i % 2}" / f"{i + 8}.h5", *nyu_frame(i))
    for i in range(3):
        write_h5(root / "val" / "official" / f"{i}.h5", *nyu_frame(100 + i))
    return root


class Numbered:
    """A source whose frame i is grey i at depth i + 1; those in ``broken`` cannot be read."""

    def __init__(self, length: int, broken: tuple[int, ...] = ()) -> None:
        self.length, self.broken = length, broken

    def __len__(self) -> int:
        return self.length

    def name(self, index: int) -> str:
        return f"frame-{index}"

    def load(self, index: int) -> RawSample:
        if index in self.broken:
            raise SampleError(self.name(index), "torn")
        image = torch.full((3, 6, 8), index, dtype=torch.uint8)
        return RawSample(image, torch.full((6, 8), index + 1.0), torch.eye(3, dtype=torch.float64) + 2)


def numbers(batch) -> list[int]:
    return [round(x.item()) - 1 for x in batch["depth"][:, 3, 4]]


# Samples


def test_a_sample_is_what_the_network_and_the_losses_take():
    raw = RawSample(
        torch.arange(3 * 6 * 8).reshape(3, 6, 8).to(torch.uint8),
        torch.tensor([[1.0, 0.0, np.nan, np.inf, -2.0, 3.0, 4.0, 5.0]] * 6),
        torch.eye(3, dtype=torch.float64),
    )
    sample = make_sample(raw, PLAIN, None, (0, 0, 0))
    torch.testing.assert_close(sample["image"], raw.image.float() / 255)
    assert sample["depth"][0].tolist() == [1, 0, 0, 0, 0, 3, 4, 5]
    assert sample["valid"][0].tolist() == [True, False, False, False, False, True, True, True]
    assert [sample[k].dtype for k in ("image", "depth", "valid", "intrinsics")] == [
        torch.float32, torch.float32, torch.bool, torch.float64,
    ]  # fmt: skip
    assert torch.isnan(raw.depth[0, 2])  # the frame is left as it was


def test_normalised_networks_get_normalised_images():
    """The augmentation sees the image before the network's mean and deviation, so colours stay in [0, 1] for it."""
    preprocess = Preprocess(mean=(0.4, 0.5, 0.6), std=(0.2, 0.2, 0.25))
    raw = RawSample(torch.full((3, 6, 8), 204, dtype=torch.uint8), torch.ones(6, 8), torch.eye(3, dtype=torch.float64))
    image = make_sample(raw, preprocess, None, (0, 0, 0))["image"]
    torch.testing.assert_close(image[:, 0, 0], torch.tensor([2.0, 1.5, 0.8]))


def test_epoch_and_index_decide_the_augmentation():
    source, augmentation = Numbered(5), Augmentation(AugmentationConfig(scale=(1.1, 1.5)))
    dataset = SampleDataset(source, PLAIN, augmentation, seed=3)
    one = dataset[SampleKey(2, 4)]
    assert torch.equal(one["image"], SampleDataset(source, PLAIN, augmentation, seed=3)[SampleKey(2, 4)]["image"])
    assert torch.equal(dataset[4]["image"], dataset[SampleKey(0, 4)]["image"])
    for other in (dataset[SampleKey(3, 4)], SampleDataset(source, PLAIN, augmentation, seed=4)[SampleKey(2, 4)]):
        assert not torch.equal(other["depth"], one["depth"])
    expected = make_sample(source.load(4), PLAIN, augmentation, (3, 2, 4))
    assert all(torch.equal(one[name], expected[name]) for name in one)


# Broken files


def test_a_broken_file_stops_the_run_with_its_name():
    dataset = SampleDataset(Numbered(5, broken=(2,)), PLAIN)
    assert dataset[1]["depth"][0, 0] == 2
    with pytest.raises(SampleError, match="frame-2: torn"):
        dataset[2]


@pytest.mark.parametrize("order", [range(6), reversed(range(6)), [3, 2, 3, 5, 5, 0, 2]], ids=["up", "down", "mixed"])
def test_skipping_takes_the_next_good_frame_whatever_came_before(order, caplog):
    dataset = SampleDataset(Numbered(6, broken=(2, 3, 5)), PLAIN, on_bad_file="skip")
    taken = {0: 0, 1: 1, 2: 4, 3: 4, 4: 4, 5: 0}
    order = list(order)
    with caplog.at_level(logging.WARNING):
        for index in order:
            assert dataset[index]["depth"][0, 0] == taken[index] + 1
    assert set(dataset.bad_files()) == {"frame-2", "frame-3", "frame-5"} & set(dataset.bad_files())
    # Frame 3 is met also where only 2 was asked for.
    assert dataset.bad_files() == ("frame-2", "frame-3", "frame-5")
    assert len(caplog.records) == 3  # each one once
    assert "frame-2: torn" in caplog.text


def test_a_replaced_frame_does_not_count_twice_in_validation():
    dataset = SampleDataset(Numbered(4, broken=(1,)), PLAIN, on_bad_file="skip", evaluate=True)
    assert [bool(dataset[i]["valid"].any()) for i in range(4)] == [True, False, True, True]
    assert SampleDataset(Numbered(4, broken=(1,)), PLAIN, on_bad_file="skip")[1]["valid"].all()


def test_no_good_frame_at_all():
    with pytest.raises(SampleError, match="all others of 3 files are broken"):
        SampleDataset(Numbered(3, broken=(0, 1, 2)), PLAIN, on_bad_file="skip")[1]


def test_dataset_arguments_are_checked():
    with pytest.raises(ValueError, match="on_bad_file"):
        SampleDataset(Numbered(3), PLAIN, on_bad_file="ignore")
    with pytest.raises(ValueError, match="at least one frame"):
        SampleDataset(Numbered(0), PLAIN)
    for index in (3, -1):
        with pytest.raises(IndexError, match=r"\[0, 3\)"):
            SampleDataset(Numbered(3), PLAIN)[index]


def test_errors_survive_the_way_from_a_worker():
    error = pickle.loads(pickle.dumps(SampleError("a.h5", "torn")))
    assert (error.name, error.reason, str(error)) == ("a.h5", "torn", "a.h5: torn")


# NYU Depth V2


def test_nyu_frames_are_what_the_files_hold(tmp_path):
    frames = NyuFrames(write_nyu(tmp_path), "train")
    names = [f.relative_to(tmp_path / "train").as_posix() for f in frames.files]
    # 8 before 10 before 12: numbers by value.
    assert names == [f"kitchen_{s}/{n}.h5" for s, n in ((0, 8), (0, 10), (0, 12), (1, 9), (1, 11), (1, 13))]
    for index, number in enumerate((0, 2, 4, 1, 3, 5)):
        rgb, depth = nyu_frame(number)
        raw = frames.load(index)
        np.testing.assert_array_equal(raw.image.numpy(), rgb)
        np.testing.assert_array_equal(raw.depth.numpy(), depth)
    assert len(NyuFrames(tmp_path, "val")) == 3


def test_nyu_validation_is_the_fields(tmp_path):
    """480 x 640 by Preprocess.nyu(): 224 x 224, fx' = fx (333/640)(224/304), fy' = fy (250/480)(224/228)."""
    rng = np.random.default_rng(0)
    depth = rng.uniform(1, 9, (480, 640)).astype(np.float32)
    write_h5(tmp_path / "val" / "official" / "00001.h5", rng.integers(0, 256, (3, 480, 640), np.uint8), depth)
    frames = NyuFrames(tmp_path, "val")
    K = frames.load(0).intrinsics
    assert (K[0, 0], K[1, 1], K[0, 2], K[1, 2]) == INTRINSICS
    sample = SampleDataset(frames, Preprocess.nyu())[0]
    assert sample["image"].shape == (3, 224, 224)
    fx, fy, cx, cy = INTRINSICS
    expected = [fx * 333 / 640 * 224 / 304, fy * 250 / 480 * 224 / 228]
    torch.testing.assert_close(sample["intrinsics"].diagonal()[:2], torch.tensor(expected, dtype=torch.float64))
    # The depth of the network's pixel nearest to the optical axis is the one that the camera sees there.
    v, u = (round(float(sample["intrinsics"][i, 2])) for i in (1, 0))
    x = (u - float(sample["intrinsics"][0, 2])) / float(sample["intrinsics"][0, 0])
    y = (v - float(sample["intrinsics"][1, 2])) / float(sample["intrinsics"][1, 1])
    assert sample["depth"][v, u] == depth[round(fy * y + cy), round(fx * x + cx)]


def test_nyu_files_of_another_size(tmp_path):
    write_h5(tmp_path / "train" / "a" / "1.h5", *nyu_frame(0, (240, 320)))
    write_h5(tmp_path / "train" / "a" / "2.h5", *nyu_frame(0, (228, 304)))
    write_h5(tmp_path / "train" / "a" / "3.h5", *nyu_frame(0, (224, 224)))
    frames = NyuFrames(tmp_path, "train")
    K = frames.load(0).intrinsics
    expected = [INTRINSICS[0] / 2, (INTRINSICS[2] + 0.5) / 2 - 0.5]
    torch.testing.assert_close(K[0, ::2], torch.tensor(expected, dtype=torch.float64))
    with pytest.raises(SampleError, match=r"3\.h5: is 224 x 224.*intrinsics"):
        frames.load(2)


def truncated(path, share):
    path.write_bytes(path.read_bytes()[: int(path.stat().st_size * share)])


RGB, DEPTH = nyu_frame(0)
BROKEN = {
    "empty": lambda p: p.write_bytes(b""),
    "half": lambda p: truncated(p, 0.5),
    "last byte": lambda p: truncated(p, 0.9999),
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
def test_a_broken_h5_is_named_or_skipped(how, tmp_path):
    frames = NyuFrames(write_nyu(tmp_path), "train")
    how(frames.files[2])
    with pytest.raises(SampleError, match=r"kitchen_0/12\.h5: "):
        SampleDataset(frames, PLAIN)[2]
    dataset = SampleDataset(frames, PLAIN, on_bad_file="skip")
    samples = [dataset[i] for i in range(len(dataset))]
    np.testing.assert_array_equal(samples[2]["depth"].numpy(), nyu_frame(1)[1])
    assert dataset.bad_files() == (str(frames.files[2]),)


def test_damage_anywhere_is_an_error_of_the_file_or_none_at_all(tmp_path):
    """Cut and overwritten at many places: nothing but SampleError comes out."""
    path = tmp_path / "train" / "a" / "1.h5"
    write_h5(path, *nyu_frame(0))
    whole, frames = path.read_bytes(), NyuFrames(tmp_path, "train")
    rng, errors, harmless = np.random.default_rng(0), 0, 0
    for _ in range(60):
        at = int(rng.integers(len(whole))) if rng.random() < 0.5 else int(rng.integers(2500))
        broken = whole[:at] if rng.random() < 0.3 else whole[:at] + rng.bytes(64) + whole[at + 64 :]
        path.write_bytes(broken)
        try:
            frames.load(0)
        except SampleError as error:
            errors += error.name == str(path)
        else:
            harmless += 1
    assert errors + harmless == 60
    assert errors > 10


def test_a_folder_without_the_layout_is_named(tmp_path):
    with pytest.raises(FileNotFoundError, match=r"val holds no <scene>/\*\.h5"):
        NyuFrames(tmp_path, "val")
    with pytest.raises(ValueError, match="part must be"):
        NyuFrames(tmp_path, "test")


SCENES = ["attic_1", "attic_1", "bath_1", "cafe_1", "den_1", "den_1"]


def write_mat(path, width=64, height=48):
    """As MATLAB 7.3 writes it: columns first, strings as references to columns of UTF-16."""
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
    told = []
    counts = convert_labelled(
        tmp_path / "labelled.mat", tmp_path / "nyu", progress=lambda done, of: told.append((done, of))
    )
    assert counts == {"train": 4, "val": 2}  # every fourth scene, the den, with all its frames
    assert told == [(i + 1, 6) for i in range(6)]
    train, val = NyuFrames(tmp_path / "nyu", "train"), NyuFrames(tmp_path / "nyu", "val")
    assert [f.parent.name for f in train.files] == SCENES[:4]
    assert [f.name for f in val.files] == ["00005.h5", "00006.h5"]
    for frames, indices in ((train, range(4)), (val, range(4, 6))):
        for k, i in enumerate(indices):
            np.testing.assert_array_equal(frames.load(k).image.numpy(), rgb[i].transpose(2, 0, 1))
            np.testing.assert_array_equal(frames.load(k).depth.numpy(), depth[i])


def test_the_official_split_and_the_sensors_own_depth(tmp_path):
    _, _, raw = write_mat(tmp_path / "labelled.mat")
    splits = {"trainNdxs": np.array([[1], [3], [6]]), "testNdxs": np.array([[2], [4], [5]])}
    savemat(tmp_path / "splits.mat", splits)
    counts = convert_labelled(tmp_path / "labelled.mat", tmp_path / "nyu", tmp_path / "splits.mat", raw=True)
    assert counts == {"train": 3, "val": 3}
    val = NyuFrames(tmp_path / "nyu", "val")
    assert [f.name for f in val.files] == ["00002.h5", "00004.h5", "00005.h5"]
    np.testing.assert_array_equal(val.load(1).depth.numpy(), raw[3])
    savemat(tmp_path / "splits.mat", {**splits, "testNdxs": np.array([[2], [4]])})
    with pytest.raises(ValueError, match="divide the frames 1 to 6"):
        convert_labelled(tmp_path / "labelled.mat", tmp_path / "other", tmp_path / "splits.mat")


def test_an_interrupted_conversion_goes_on(tmp_path):
    write_mat(tmp_path / "labelled.mat")

    class Stop(Exception):
        pass

    def stop_at_3(done, _):
        if done == 3:
            raise Stop

    with pytest.raises(Stop):
        convert_labelled(tmp_path / "labelled.mat", tmp_path / "nyu", progress=stop_at_3)
    first = {p: p.stat().st_mtime_ns for p in (tmp_path / "nyu").rglob("*.h5")}
    assert len(first) == 3
    convert_labelled(tmp_path / "labelled.mat", tmp_path / "nyu")
    assert len(list((tmp_path / "nyu").rglob("*.h5"))) == 6
    assert all(p.stat().st_mtime_ns == t for p, t in first.items())
    assert not list((tmp_path / "nyu").rglob("*.tmp"))


def test_another_mat_file_is_named(tmp_path):
    with h5py.File(tmp_path / "x.mat", "w") as file:
        file["labels"] = np.zeros(3)
    with pytest.raises(ValueError, match=r"x\.mat has no depths, images, scenes"):
        convert_labelled(tmp_path / "x.mat", tmp_path / "nyu")


# Parts of sequences


@pytest.mark.parametrize(
    ("text", "length", "expected"),
    [
        ("0:70%", 10, range(7)),
        ("75%:100%", 10, range(7, 10)),
        ("75%:", 1000, range(750, 1000)),
        (":30", 100, range(30)),
        ("100:400", 250, range(100, 250)),
        (":", 5, range(5)),
        ("10:50%", 100, range(10, 50)),
        ("0:29%", 100, range(29)),
        ("12.5%:25%", 8, range(1, 2)),
        (" 0 : 5 ", 9, range(5)),
    ],
)
def test_parts_of_a_sequence(text, length, expected):
    assert Part.parse(text).frames(length) == expected
    assert Part.parse(str(Part.parse(text))) == Part.parse(text)


@pytest.mark.parametrize("text", ["", "5", "0:70:90", "a:b", "-5:10", "0:120%", "50%:20%", "7:7", "1.5:3", "0.5:0.7"])
def test_what_is_no_part_is_named(text):
    with pytest.raises(ValueError, match="a part must"):
        Part.parse(text)


def test_an_empty_part_is_named():
    with pytest.raises(ValueError, match="50:60 of 20 frames is empty"):
        Part.parse("50:60").frames(20)


@settings(max_examples=100, deadline=None)
@given(length=st.integers(1, 5000), edge=st.integers(1, 99))
def test_two_parts_that_meet_divide_every_sequence(length, edge):
    covered = []
    for text in (f"0:{edge}%", f"{edge}%:100%"):
        try:
            covered += list(Part.parse(text).frames(length))
        except ValueError:
            continue
    assert covered == list(range(length))


# Sequences


def test_frames_of_a_sequence_are_the_readers(tmp_path):
    path, *_ = write_tum(tmp_path)
    sequence = open_sequence(path)
    frames = SequenceFrames([sequence, sequence], "0:50%")
    half = len(sequence) // 2
    assert len(frames) == 2 * half
    assert frames.name(half) == f"{sequence.name}/{sequence.names[0]}"
    for index in (0, 1, half):
        frame, raw = sequence[index % half], frames.load(index)
        np.testing.assert_array_equal(raw.image.numpy().transpose(1, 2, 0), frame.image)
        np.testing.assert_array_equal(raw.depth.numpy(), frame.depth)
        np.testing.assert_array_equal(raw.intrinsics.numpy(), frame.intrinsics)


def test_depth_with_a_camera_of_its_own_is_seen_by_the_images(tmp_path):
    """ScanNet: 121 x 162 colour, 48 x 64 depth. At the image's pixels it is the colour camera's depth, but for
    the coarser depth map's edges."""
    path, of_color, _ = write_scannet(tmp_path)
    raw = SequenceFrames([open_sequence(path)]).load(2)
    assert raw.depth.shape == raw.image.shape[1:] == (121, 162)
    np.testing.assert_allclose(raw.intrinsics.numpy(), of_color.K)
    valid = raw.depth.numpy() > 0
    error = np.abs(raw.depth.numpy() - of_color.depths[2])[valid] / of_color.depths[2][valid]
    assert valid.mean() > 0.9
    assert np.median(error) < 0.01
    assert (error < 0.03).mean() > 0.9


def test_frames_without_depth_are_left_out_and_counted_in_the_part(tmp_path):
    path, _ = write_generic(tmp_path)
    (path / "depth" / "8.png").unlink()
    sequence = open_sequence(path)
    frames = SequenceFrames([sequence], "0:50%")  # of six frames: 7, 8, 9
    assert [frames.name(i) for i in range(len(frames))] == [f"{sequence.name}/7", f"{sequence.name}/9"]
    with pytest.raises(ValueError, match="no frame of the part 1:2"):
        SequenceFrames([sequence], "1:2")
    with pytest.raises(ValueError, match="at least one sequence"):
        SequenceFrames([])


def test_a_broken_image_of_a_sequence_is_named_or_skipped(tmp_path):
    path, _ = write_generic(tmp_path)
    frames = SequenceFrames([open_sequence(path)])
    truncated(path / "images" / "9.png", 0.4)
    with pytest.raises(SampleError, match=r"walk/9: .*9\.png"):
        frames.load(2)
    dataset = SampleDataset(frames, PLAIN, on_bad_file="skip")
    assert torch.equal(dataset[2]["image"], dataset[3]["image"])
    assert dataset.bad_files() == ("walk/9",)


def test_images_and_depth_without_poses(tmp_path):
    path, scene = write_generic(tmp_path)
    posed = SequenceFrames([open_rgbd(path)])
    assert posed.sequences[0].layout == "generic"
    (path / "poses.txt").unlink()
    (path / "depth" / "12.png").unlink()
    unposed = SequenceFrames([open_rgbd(path)])
    assert len(unposed) == len(posed) - 1
    assert [s.name for s in unposed.sequences[0].skipped] == ["12"]
    for i in range(len(unposed)):
        one, two = posed.load(i), unposed.load(i)
        assert torch.equal(one.image, two.image)
        assert torch.equal(one.depth, two.depth)
        assert torch.equal(one.intrinsics, two.intrinsics)
    np.testing.assert_allclose(unposed.load(0).intrinsics.numpy(), scene.K)


def test_a_tum_recording_without_its_trajectory(tmp_path):
    """Names are timestamps that differ between image and depth, and depth is in 1/5000 m."""
    path, *_ = write_tum(tmp_path)
    posed = open_sequence(path)
    (path / "groundtruth.txt").unlink()
    with pytest.raises(ValueError, match="pass intrinsics"):
        open_rgbd(path)
    np.savetxt(path / "K.txt", posed.intrinsics)
    unposed = open_rgbd(path)
    for frame in posed:
        if frame.depth is not None:
            same = unposed[unposed.names.index(frame.name)]
            np.testing.assert_array_equal(same.depth, frame.depth)


def test_what_is_missing_in_an_unposed_folder_is_named(tmp_path):
    path, scene = write_generic(tmp_path)
    (path / "poses.txt").unlink()
    shutil.move(path / "K.txt", tmp_path / "K.txt")
    with pytest.raises(ValueError, match="pass intrinsics"):
        open_unposed(path)
    np.testing.assert_allclose(open_unposed(path, tmp_path / "K.txt").intrinsics, scene.K)
    for i, file in enumerate(sorted((path / "depth").iterdir())):
        file.rename(file.with_name(f"map{i + 500}.png"))
    with pytest.raises(ValueError, match="none of 6 depth maps is named like"):
        open_unposed(path, tmp_path / "K.txt")
    shutil.rmtree(path / "depth")
    with pytest.raises(ValueError, match="must hold one of"):
        open_unposed(path, tmp_path / "K.txt")


# Tours

TINY = TourSettings(frames=3, stride=4, size=(24, 32))


@pytest.fixture(scope="module")
def tours(tmp_path_factory):
    folder = tmp_path_factory.mktemp("cache")
    return folder, tour_frames([5, 6], TINY, folder)


def test_stored_tours_are_the_rendered_ones(tours):
    from ufmstar_torch.eval.tour import tour_sequence

    _, frames = tours
    assert len(frames) == 6
    sequence = tour_sequence(6, frames=12, size=(24, 32), path_seed=0)
    for i in range(3):
        frame, raw = sequence[4 * i], frames.load(3 + i)
        np.testing.assert_array_equal(raw.image.numpy().transpose(1, 2, 0), frame.image)
        np.testing.assert_allclose(raw.depth.numpy(), frame.depth, atol=5.1e-4)
        np.testing.assert_array_equal(raw.intrinsics.numpy(), frame.intrinsics)


def test_tours_are_rendered_once_and_completed(tours, tmp_path):
    folder, frames = tours
    shutil.copytree(folder, tmp_path / "cache")
    inside = tmp_path / "cache" / frames.folder.name
    times = {path.name: path.stat().st_mtime_ns for path in inside.iterdir()}
    told = []
    tour_frames([5, 6], TINY, tmp_path / "cache", progress=lambda *done: told.append(done))
    assert not told
    tour_files(inside, 6)[2].unlink()  # as a kill between the writes leaves it
    again = tour_frames([5, 6], TINY, tmp_path / "cache", progress=lambda *done: told.append(done))
    assert told == [(2, 2)]
    for path in tour_files(inside, 5):
        assert path.stat().st_mtime_ns == times[path.name]
    assert torch.equal(again.load(4).image, frames.load(4).image)
    assert sorted(times) == sorted(path.name for path in inside.iterdir())  # nothing temporary is left


def test_every_setting_has_a_cache_of_its_own():
    others = [
        TourSettings(frames=4, stride=4, size=(24, 32)),
        TourSettings(frames=3, stride=5, size=(24, 32)),
        TourSettings(frames=3, stride=4, size=(32, 24)),
        TourSettings(frames=3, stride=4, size=(24, 32), style="hall"),
        TourSettings(frames=3, stride=4, size=(24, 32), fov=60.0),
    ]
    digests = {one.digest() for one in (TINY, *others)}
    assert len(digests) == 6
    assert TourSettings(frames=3, stride=4, size=(24, 32)).digest() == TINY.digest()


def test_a_truncated_cache_file_is_named(tours, tmp_path):
    folder, frames = tours
    shutil.copytree(folder, tmp_path / "cache")
    inside = tmp_path / "cache" / frames.folder.name
    truncated(tour_files(inside, 5)[1], 0.5)
    copy = TourFrames(inside, [5, 6], 3)
    with pytest.raises(SampleError, match=r"5\.image\.npy\[1\]"):
        copy.load(1)
    assert torch.equal(copy.load(3).depth, frames.load(3).depth)


def test_pickled_tours_map_their_files_anew(tours):
    _, frames = tours
    frames.load(0)
    packed = pickle.dumps(frames)
    assert len(packed) < 2000
    assert torch.equal(pickle.loads(packed).load(0).depth, frames.load(0).depth)


def test_impossible_tours_are_named(tmp_path):
    for wrong in ({"frames": 0}, {"stride": 0}, {"size": (4, 32)}, {"fov": 170.0}, {"style": "castle"}):
        with pytest.raises(ValueError, match=next(iter(wrong))):
            TourSettings(**wrong)
    with pytest.raises(ValueError, match="seeds"):
        tour_frames([], TINY, tmp_path)


# Order

LENGTHS = {"length": st.integers(1, 200), "batch_size": st.integers(1, 9), "world": st.integers(1, 4)}


@settings(max_examples=60, deadline=None)
@given(**LENGTHS, seed=st.integers(0, 2**32), epoch=st.integers(0, 1000))
def test_processes_share_each_batch_of_one_process(length, batch_size, world, seed, epoch):
    step = batch_size * world
    if length < step:
        with pytest.raises(ValueError, match="a step takes"):
            EpochBatches(length, batch_size, world=world)
        return
    single = EpochBatches(length, step, seed=seed)
    parts = [EpochBatches(length, batch_size, seed=seed, rank=r, world=world) for r in range(world)]
    for one in (single, *parts):
        one.set_epoch(epoch)
    whole = list(single)
    assert len(whole) == len(single) == length // step == len(parts[0])
    for batch, *shares in zip(whole, *parts, strict=True):
        assert all(len(share) == batch_size for share in shares)
        assert sorted(batch) == sorted(key for share in shares for key in share)
    seen = [key.frame for batch in whole for key in batch]
    assert len(set(seen)) == len(seen) == length // step * step
    assert all(key.epoch == epoch for batch in whole for key in batch)


@settings(max_examples=60, deadline=None)
@given(**LENGTHS)
def test_validation_takes_every_frame_once(length, batch_size, world):
    parts = [EpochBatches(length, batch_size, rank=r, world=world, shuffle=False) for r in range(world)]
    seen = [key.frame for part in parts for batch in part for key in batch if key.counts]
    assert sorted(seen) == list(range(length))
    # A process without a batch would leave the others waiting at DistributedDataParallel's next synchronisation.
    assert all(len(list(part)) == len(part) > 0 for part in parts)
    idle = [key for part in parts[length:] for batch in part for key in batch]
    assert [key.counts for key in idle] == [False] * max(0, world - length)
    assert all(0 < len(batch) <= batch_size for part in parts for batch in part)


def test_order_depends_on_seed_and_epoch_alone():
    def order(seed, epoch, start=0):
        batches = EpochBatches(50, 7, seed=seed)
        batches.set_epoch(epoch, start)
        torch.manual_seed(np.random.default_rng().integers(1000))
        return [key.frame for batch in batches for key in batch]

    assert order(1, 2) == order(1, 2)
    assert len({tuple(order(s, e)) for s in range(3) for e in range(3)}) == 9
    assert order(1, 2)[3 * 7 :] == order(1, 2, start=3)
    assert order(1, 2, start=7) == []
    assert sorted(order(1, 2)) != order(1, 2)


def test_impossible_orders_are_named():
    for wrong in ({"length": 0}, {"batch_size": 0}, {"seed": -1}, {"rank": 1}, {"rank": -1}):
        with pytest.raises(ValueError, match=next(iter(wrong))):
            EpochBatches(**{"length": 9, "batch_size": 3, **wrong})
    for epoch, start in ((-1, 0), (0, 4), (0, -1)):
        with pytest.raises(ValueError, match="epoch"):
            EpochBatches(9, 3).set_epoch(epoch, start)


# Loaders


def loader(length=23, **options):
    dataset = SampleDataset(Numbered(length), PLAIN, Augmentation(AugmentationConfig(scale=(1.0, 1.0))))
    return EpochLoader(dataset, EpochBatches(length, 4, seed=9, **options))


def test_a_loader_goes_on_inside_an_epoch():
    """What a killed run has seen, and what the next one sees from its checkpoint's state, is one epoch."""
    whole = loader()
    whole.set_epoch(3)
    expected = list(whole)
    killed = loader()
    killed.set_epoch(3)
    seen = []
    for batch in killed:
        seen.append(batch)
        if len(seen) == 2:
            state = killed.state_dict()
            break
    assert state == {"epoch": 3, "batch": 2}
    resumed = loader()
    resumed.load_state_dict(state)
    resumed.set_epoch(3)  # Lightning calls it at the start of the epoch it goes on with
    assert len(resumed) == len(expected) == 5
    assert resumed.state_dict() == state
    seen += list(resumed)
    assert len(seen) == 5
    for one, two in zip(seen, expected, strict=True):
        assert all(torch.equal(one[name], two[name]) for name in one)
    assert resumed.state_dict() == {"epoch": 4, "batch": 0}
    resumed.set_epoch(4)
    assert len(list(resumed)) == 5


def test_epochs_differ_and_passes_over_one_do_not():
    batches = loader()
    first = [numbers(batch) for batch in batches]
    assert [numbers(batch) for batch in batches] == first
    batches.set_epoch(1)
    assert [numbers(batch) for batch in batches] != first


def test_loading_leaves_the_global_generator_alone():
    torch.manual_seed(0)
    state = torch.get_rng_state()
    list(loader())
    assert torch.equal(torch.get_rng_state(), state)


def test_worker_processes_load_the_same_and_report_broken_files(tmp_path):
    """Spawned; what they find broken is known here, and they know what epoch it is."""
    frames = NyuFrames(write_nyu(tmp_path), "train")
    truncated(frames.files[1], 0.5)

    def made(workers):
        augmentation = Augmentation(AugmentationConfig(crop="random"))
        dataset = SampleDataset(frames, Preprocess(size=(32, 40)), augmentation, on_bad_file="skip")
        return EpochLoader(dataset, EpochBatches(len(frames), 2, seed=9), workers=workers)

    alone, apart = made(0), made(1)
    for epoch in (0, 1):
        for one in (alone, apart):
            one.set_epoch(epoch)
        for one, two in zip(alone, apart, strict=True):
            assert all(torch.equal(one[name], two[name]) for name in one)
    assert apart.dataset.bad_files() == alone.dataset.bad_files() == (str(frames.files[1]),)


# The data module


def module(tmp_path, preprocess=PLAIN, **config):
    data = DepthDataModule(DataConfig(**config), preprocess)
    data.setup("fit")
    return data


def test_sequences_are_divided_with_a_gap(tmp_path):
    path, _ = write_generic(tmp_path, frames=10)
    data = module(tmp_path, kind="sequences", paths=(str(path),), part="0:60%", validation_part="80%:", batch_size=2)
    train = [data.train_set.source.name(i) for i in range(len(data.train_set))]
    held_back = [data.validation_set.source.name(i) for i in range(len(data.validation_set))]
    assert train == [f"walk/{i + 7}" for i in range(6)]
    assert held_back == ["walk/15", "walk/16"]
    batch = next(iter(data.train_dataloader()))
    assert {name: tuple(x.shape) for name, x in batch.items()} == {
        "image": (2, 3, 48, 64), "depth": (2, 48, 64), "valid": (2, 48, 64), "intrinsics": (2, 3, 3),
    }  # fmt: skip
    exact = truth(np.loadtxt(path / "K.txt"), 10).depths
    for i, sample in enumerate(next(iter(data.val_dataloader()))["depth"]):
        np.testing.assert_allclose(sample.numpy(), exact[8 + i], atol=6e-4)  # never augmented


def test_parts_must_not_overlap(tmp_path):
    path, _ = write_generic(tmp_path, frames=10)
    other, _ = write_generic(tmp_path, frames=10, folder="other")
    overlapping = {"kind": "sequences", "part": "0:60%", "validation_part": "50%:"}
    with pytest.raises(ValueError, match="share 1 frames of walk"):
        module(tmp_path, paths=(str(path),), **overlapping)
    with pytest.raises(ValueError, match="share 1 frames of walk"):
        module(tmp_path, paths=(str(path),), validation_paths=(str(other), str(other / ".." / "walk")), **overlapping)
    apart = module(tmp_path, paths=(str(path),), validation_paths=(str(other),), **overlapping)
    assert apart.validation_set.source.name(0) == "other/12"


def test_nyu_and_tours_as_data_modules(tmp_path, tours):
    data = module(tmp_path, kind="nyu", paths=(str(write_nyu(tmp_path / "nyu")),), preprocess=Preprocess(size=(32, 40)))
    assert (len(data.train_set), len(data.validation_set)) == (6, 3)
    assert data.train_set[0]["image"].shape == (3, 32, 40)
    folder, frames = tours
    tiny = {"tour_frames": 3, "tour_stride": 4, "tour_size": (24, 32), "first_tour": 5, "cache": str(folder)}
    data = module(tmp_path, tours=1, validation_tours=1, batch_size=3, **tiny)
    assert data.train_set.source.seeds == (5,)
    assert data.validation_set.source.seeds == (6,)
    assert torch.equal(data.validation_set[1]["depth"], frames.load(4).depth)


def test_a_data_module_gives_each_process_its_share_and_tells_broken_files(tmp_path):
    root = write_nyu(tmp_path)
    truncated(root / "train" / "kitchen_1" / "9.h5", 0.3)
    config = {"kind": "nyu", "paths": (str(root),), "on_bad_file": "skip", "batch_size": 1, "augmentation": None}
    data = module(tmp_path, **config)
    with pytest.raises(RuntimeError, match="setup"):
        DepthDataModule(data.config, PLAIN).train_dataloader()
    seen = []
    for rank in (0, 1):
        data.trainer = SimpleNamespace(global_rank=rank, world_size=2)
        assert len(data.train_dataloader()) == 3
        seen += [batch["depth"].sum().item() for batch in data.val_dataloader()]
        list(data.train_dataloader())
    assert sorted(seen) == pytest.approx(sorted(float(nyu_frame(100 + i)[1].sum()) for i in range(3)))
    assert data.bad_files() == (str(root / "train" / "kitchen_1" / "9.h5"),)


# Lightning 2.6 asks torch's pytree in a way that newer versions of torch deprecate.
@pytest.mark.filterwarnings("ignore:.*LeafSpec:FutureWarning")
def test_lightning_walks_through_the_epochs(tmp_path):
    """Its calls of set_epoch arrive, whatever it iterates over beforehand."""
    import lightning.pytorch as pl

    class Recorder(pl.LightningModule):
        def __init__(self):
            super().__init__()
            self.weight, self.seen = torch.nn.Parameter(torch.zeros(())), []

        def training_step(self, batch, _):
            self.seen += numbers(batch)
            return self.weight * 0

        def configure_optimizers(self):
            return torch.optim.SGD(self.parameters(), lr=0.1)

    recorder = Recorder()
    pl.Trainer(
        max_epochs=3, accelerator="cpu", logger=False, enable_checkpointing=False, enable_progress_bar=False,
        enable_model_summary=False, use_distributed_sampler=False, default_root_dir=tmp_path,
    ).fit(recorder, loader())  # fmt: skip
    expected, batches = [], EpochBatches(23, 4, seed=9)
    for epoch in range(3):
        batches.set_epoch(epoch)
        expected += [key.frame for batch in batches for key in batch]
    assert recorder.seen == expected


@pytest.mark.parametrize(
    "wrong",
    [
        {"kind": "kitti"},
        {"on_bad_file": "ignore"},
        {"batch_size": 0},
        {"workers": -1},
        {"seed": -1},
        {"tours": 0},
        {"batch_size": 2.5},
        {"paths": ("x",)},
        {"kind": "nyu"},
        {"kind": "nyu", "paths": ("a", "b")},
        {"kind": "sequences"},
        {"validation_paths": ("x",)},
        {"part": "70"},
        {"validation_part": "90%:80%"},
    ],
    ids=str,
)
def test_impossible_data_are_named(wrong):
    field = {"nyu": "paths", "sequences": "paths"}.get(wrong.get("kind"), next(iter(wrong)))
    with pytest.raises(ValueError, match=f"DataConfig.{field}"):
        DataConfig(**wrong)


def test_the_config_goes_through_json():
    import json

    config = DataConfig(kind="sequences", paths=("a", "b"), augmentation=AugmentationConfig(scale=(1.0, 1.2)))
    assert DataConfig.from_dict(json.loads(json.dumps(config.to_dict()))) == config
    assert DataConfig.from_dict({"augmentation": None}).augmentation is None
    with pytest.raises(ValueError, match="shuffle"):
        DataConfig.from_dict({"shuffle": True})

"""Training samples, broken files, held-back parts, and the data module."""

from __future__ import annotations

import logging
import pickle
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from layouts import truth, write_generic
from training_data import PLAIN, TINY, Numbered, loader, numbers, nyu_frame, truncated, write_nyu

from ufmstar_torch.models import Preprocess
from ufmstar_torch.train import (
    Augmentation,
    AugmentationConfig,
    DataConfig,
    DepthDataModule,
    EpochBatches,
    SampleDataset,
    SampleError,
    tour_frames,
)
from ufmstar_torch.train.samples import RawSample, SampleKey, make_sample


def test_a_sample_is_what_the_network_and_the_losses_take():
    raw = RawSample(
        np.arange(3 * 6 * 8, dtype=np.uint8).reshape(3, 6, 8),
        np.array([[1.0, 0.0, np.nan, np.inf, -2.0, 3.0, 4.0, 5.0]] * 6, np.float32),
        np.eye(3),
    )
    sample = make_sample(raw, PLAIN, None, (0, 0, 0))
    torch.testing.assert_close(sample["image"], torch.from_numpy(raw.image).float() / 255)
    assert sample["depth"][0].tolist() == [1, 0, 0, 0, 0, 3, 4, 5]
    assert sample["valid"][0].tolist() == [True, False, False, False, False, True, True, True]
    assert [sample[k].dtype for k in ("image", "depth", "valid", "intrinsics")] == [
        torch.float32, torch.float32, torch.bool, torch.float64,
    ]  # fmt: skip
    assert np.isnan(raw.depth[0, 2])  # the frame is left as it was


def test_normalised_networks_get_normalised_images():
    """The augmentation sees the image before the network's mean and deviation, so colours stay in [0, 1] for it."""
    preprocess = Preprocess(mean=(0.4, 0.5, 0.6), std=(0.2, 0.2, 0.25))
    raw = RawSample(np.full((3, 6, 8), 204, np.uint8), np.ones((6, 8), np.float32), np.eye(3))
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
    assert all(torch.equal(one[name].nan_to_num(-1), expected[name].nan_to_num(-1)) for name in one)


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


@pytest.fixture(scope="module")
def tours(tmp_path_factory):
    folder = tmp_path_factory.mktemp("cache")
    return folder, tour_frames([5, 6], TINY, folder)


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
        "T_world_cam": (2, 4, 4),
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
    np.testing.assert_array_equal(data.validation_set[1]["depth"].numpy(), frames.load(4).depth)


def test_a_data_module_gives_each_process_its_share_and_tells_broken_files(tmp_path):
    root = write_nyu(tmp_path)
    truncated(root / "train" / "kitchen_1" / "9.h5", 0.3)
    config = {"kind": "nyu", "paths": (str(root),), "on_bad_file": "skip", "batch_size": 1, "augmentation": None}
    data = module(tmp_path, **config)
    with pytest.raises(RuntimeError, match="setup"):
        DepthDataModule(data.config, PLAIN).train_dataloader()
    seen = []
    for rank in (0, 1):
        progress = SimpleNamespace(current=SimpleNamespace(processed=0))
        fit_loop = SimpleNamespace(epoch_progress=progress)
        data.trainer = SimpleNamespace(global_rank=rank, world_size=2, fit_loop=fit_loop)
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

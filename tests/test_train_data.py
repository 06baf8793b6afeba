"""Training samples, broken files, held-back parts, the data module, and the order of samples."""

from __future__ import annotations

import logging
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from layouts import truncate, truth, write_generic
from training_data import PLAIN, Numbered, loader, numbers, nyu_frame, write_nyu

from ufmstar_torch.eval.sequences import open_sequence
from ufmstar_torch.eval.sequences.frame import Frame
from ufmstar_torch.models import Preprocess
from ufmstar_torch.train import (
    Augmentation,
    AugmentationConfig,
    DataConfig,
    DepthDataModule,
    EpochBatches,
    SampleDataset,
    SequenceFrames,
)
from ufmstar_torch.train.data import sample_loader
from ufmstar_torch.train.samples import SampleKey, make_sample


def test_a_sample_is_what_the_network_and_the_losses_take():
    image = np.arange(3 * 6 * 8, dtype=np.uint8).reshape(6, 8, 3)
    depth = np.array([[1.0, 0.0, np.nan, np.inf, -2.0, 3.0, 4.0, 5.0]] * 6, np.float32)
    sample = make_sample(Frame(0, "a", image, depth, np.eye(4), np.eye(3)), PLAIN, None, (0, 0, 0))
    torch.testing.assert_close(sample["image"], torch.from_numpy(image).permute(2, 0, 1).float() / 255)
    assert sample["depth"][0].tolist() == [1, 0, 0, 0, 0, 3, 4, 5]
    assert sample["valid"][0].tolist() == [True, False, False, False, False, True, True, True]
    assert [sample[k].dtype for k in ("image", "depth", "valid", "intrinsics")] == [
        torch.float32, torch.float32, torch.bool, torch.float64,
    ]  # fmt: skip
    assert np.isnan(depth[0, 2])  # the frame is unchanged


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


@pytest.mark.parametrize("order", [range(6), reversed(range(6)), [3, 2, 3, 5, 5, 0, 2]], ids=["up", "down", "mixed"])
def test_skipping_takes_the_next_good_frame_whatever_came_before(order, caplog):
    dataset = SampleDataset(Numbered(6, broken=(2, 3, 5)), PLAIN, on_bad_file="skip")
    good_index = {0: 0, 1: 1, 2: 4, 3: 4, 4: 4, 5: 0}
    order = list(order)
    with caplog.at_level(logging.WARNING):
        for index in order:
            assert dataset[index]["depth"][0, 0] == good_index[index] + 1
    assert set(dataset.bad_files()) == {"frame-2", "frame-3", "frame-5"} & set(dataset.bad_files())
    # A request for frame 2 also reads frame 3.
    assert dataset.bad_files() == ("frame-2", "frame-3", "frame-5")
    assert len(caplog.records) == 3  # each once
    assert "frame-2: torn" in caplog.text


def module(tmp_path, preprocess=PLAIN, batch_size=8, **config):
    data = DepthDataModule(DataConfig(**config), preprocess, batch_size)
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


def test_a_data_module_gives_each_process_its_share_and_tells_broken_files(tmp_path):
    root = write_nyu(tmp_path)
    truncate(root / "train" / "kitchen_1" / "9.h5", 0.3)
    config = {"kind": "nyu", "paths": (str(root),), "on_bad_file": "skip", "augmentation": None}
    data = module(tmp_path, batch_size=1, **config)
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
    assert data.bad_files() == ("nyu_train/kitchen_1__9",)


# Lightning 2.6 calls torch's pytree in a way that newer versions of torch deprecate.
@pytest.mark.filterwarnings("ignore:.*LeafSpec:FutureWarning")
def test_lightning_walks_through_the_epochs(tmp_path):
    """Lightning's calls of set_epoch reach the dataset, also after other iterations."""
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


# ---- the order: shares of processes, epochs, workers ----

LENGTHS = {"length": st.integers(1, 200), "batch_size": st.integers(1, 9), "world": st.integers(1, 4)}


@given(**LENGTHS, seed=st.integers(0, 2**32), epoch=st.integers(0, 1000))
def test_processes_share_each_batch_of_one_process(length, batch_size, world, seed, epoch):
    step = batch_size * world
    if length < step:
        with pytest.raises(ValueError, match="a step needs"):
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
    def order(seed, epoch):
        batches = EpochBatches(50, 7, seed=seed)
        batches.set_epoch(epoch)
        torch.manual_seed(np.random.default_rng().integers(1000))
        return [key.frame for batch in batches for key in batch]

    assert order(1, 2) == order(1, 2)
    assert len({tuple(order(s, e)) for s in range(3) for e in range(3)}) == 9
    assert sorted(order(1, 2)) != order(1, 2)


def test_loading_leaves_the_global_generator_alone():
    torch.manual_seed(0)
    state = torch.get_rng_state()
    list(loader())
    assert torch.equal(torch.get_rng_state(), state)


@pytest.mark.slow
def test_worker_processes_load_the_same_and_report_broken_files(tmp_path):
    """Spawned workers report broken files to this process, and receive the epoch."""
    frames = SequenceFrames([open_sequence(write_nyu(tmp_path) / "train")])
    truncate(tmp_path / "train" / "kitchen_0" / "10.h5", 0.5)

    def made(workers):
        augmentation = Augmentation(AugmentationConfig(crop="random"))
        dataset = SampleDataset(frames, Preprocess(size=(32, 40)), augmentation, on_bad_file="skip")
        return sample_loader(dataset, EpochBatches(len(frames), 2, seed=9), workers)

    alone, apart = made(0), made(1)
    for epoch in (0, 1):
        for one in (alone, apart):
            one.batch_sampler.sampler.set_epoch(epoch)
        for one, two in zip(alone, apart, strict=True):
            assert all(torch.equal(one[name].nan_to_num(-1), two[name].nan_to_num(-1)) for name in one)
    assert apart.dataset.bad_files() == alone.dataset.bad_files() == (frames.name(1),)

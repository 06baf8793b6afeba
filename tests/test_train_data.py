"""Training samples, broken files, held-back parts, and the data module."""

from __future__ import annotations

import logging
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from layouts import truth, write_generic
from training_data import PLAIN, Numbered, loader, numbers, nyu_frame, truncated, write_nyu

from ufmstar_torch.train import (
    Augmentation,
    AugmentationConfig,
    DataConfig,
    DepthDataModule,
    EpochBatches,
    SampleDataset,
    SampleError,
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

"""Training samples, broken files, held-back parts, the data module, and the order of samples."""

from __future__ import annotations

import logging
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from layouts import truncate, truth, write_generic
from training_data import PLAIN, SMALL, Numbered, nyu_frame, write_nyu

from ufmstar_torch.eval.sequences.frame import Frame, FrameError
from ufmstar_torch.models import Preprocess
from ufmstar_torch.train import DataConfig, DepthDataModule, SampleDataset
from ufmstar_torch.train.samples import make_sample


def numbers(batch) -> list[int]:
    """The numbers of the frames of a batch of :class:`Numbered`."""
    return [round(x.item()) - 1 for x in batch["depth"][:, 3, 4]]


def test_a_sample_is_what_the_network_and_the_losses_take():
    image = np.arange(3 * 6 * 8, dtype=np.uint8).reshape(6, 8, 3)
    depth = np.array([[1.0, 0.0, np.nan, np.inf, -2.0, 3.0, 4.0, 5.0]] * 6, np.float32)
    sample = make_sample(Frame(0, "a", image, depth, np.eye(4), np.eye(3)), PLAIN)
    torch.testing.assert_close(sample["image"], torch.from_numpy(image).permute(2, 0, 1).float() / 255)
    assert sample["depth"][0].tolist() == [1, 0, 0, 0, 0, 3, 4, 5]
    assert [value.dtype for value in sample.values()] == [torch.float32, torch.float32, torch.float64, torch.float64]
    assert np.isnan(depth[0, 2])  # the frame is unchanged


@pytest.mark.parametrize("order", [range(6), reversed(range(6)), [3, 2, 3, 5, 5, 0, 2]], ids=["up", "down", "mixed"])
def test_skipping_takes_the_next_good_frame_whatever_came_before(order, caplog):
    dataset = SampleDataset(Numbered(6, broken=(2, 3, 5)), PLAIN, on_bad_file="skip")
    good_index = {0: 0, 1: 1, 2: 4, 3: 4, 4: 4, 5: 0}
    with caplog.at_level(logging.WARNING):
        for index in order:
            sample = dataset[index]
            assert sample["depth"][0, 0, 0] == good_index[index] + 1
            assert bool(sample["T_world_cam"].isnan().all()) == (index in (2, 3, 5))
    assert "frame-2: torn" in caplog.text
    assert "frame-4" not in caplog.text
    with pytest.raises(FrameError, match="all others of 2 files are broken"):
        SampleDataset(Numbered(2, broken=(0, 1)), PLAIN, on_bad_file="skip")[0]


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
        "image": (2, 3, 48, 64), "depth": (2, 48, 64), "intrinsics": (2, 3, 3), "T_world_cam": (2, 4, 4),
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


def test_processes_share_each_batch_of_one_process(tmp_path):
    data = module(tmp_path, kind="nyu", paths=(str(write_nyu(tmp_path, frames=9)),), augmentation=None, batch_size=4)

    def batches(size, rank=0, world=1):
        progress = SimpleNamespace(current=SimpleNamespace(processed=3))
        trainer = SimpleNamespace(global_rank=rank, world_size=world, fit_loop=SimpleNamespace(epoch_progress=progress))
        data.trainer, data.batch_size = trainer, size
        return [sorted(batch["depth"].sum((1, 2)).tolist()) for batch in data.train_dataloader()]

    whole, shares = batches(4), zip(batches(2, 0, 2), batches(2, 1, 2), strict=True)
    assert len(whole) == 2
    assert whole == [sorted(one + two) for one, two in shares]
    with pytest.raises(RuntimeError, match="setup"):
        DepthDataModule(data.config, PLAIN).train_dataloader()


@pytest.mark.parametrize("stage", ["training", "validating"])
def test_batches_are_normalised_and_augmented_in_training_alone(tmp_path, stage):
    preprocess = Preprocess(size=SMALL, mean=(0.4, 0.5, 0.6), std=(0.2, 0.3, 0.4), value_range=1.0)
    data = module(tmp_path, preprocess, kind="nyu", paths=(str(write_nyu(tmp_path)),), batch_size=2)
    batch = next(iter(data.val_dataloader()))
    data.trainer = SimpleNamespace(training=stage == "training")
    torch.manual_seed(1)
    changed = data.on_after_batch_transfer(batch, 0)
    same = torch.equal(changed["depth"], batch["depth"]), torch.equal(changed["intrinsics"], batch["intrinsics"])
    assert same == ((False, False) if stage == "training" else (True, True))
    if stage == "validating":
        frames = torch.stack([torch.from_numpy(nyu_frame(100 + i)[0]) for i in range(2)])
        torch.testing.assert_close(changed["image"], preprocess.apply_image(frames))


# Lightning 2.6 calls torch's pytree in a way that newer versions of torch deprecate.
@pytest.mark.filterwarnings(
    "ignore:.*LeafSpec:FutureWarning", "ignore:.*(does not have many workers|no `validation_step`)"
)
def test_every_epoch_has_an_order_of_its_own_that_depends_on_the_seed_alone(tmp_path):
    import lightning.pytorch as pl

    class Recorder(pl.LightningModule):
        def __init__(self):
            super().__init__()
            self.weight, self.seen = torch.nn.Parameter(torch.zeros(())), []

        def on_train_epoch_start(self):
            self.seen.append([])

        def training_step(self, batch, _):
            self.seen[-1] += numbers(batch)
            return self.weight * 0

        def configure_optimizers(self):
            return torch.optim.SGD(self.parameters(), lr=0.1)

    def orders(seed, epochs=3):
        data = DepthDataModule(DataConfig(augmentation=None), PLAIN, 4, seed=seed)
        data.prepare_data = lambda: None
        data.train_set = SampleDataset(Numbered(23), PLAIN)
        recorder = Recorder()
        trainer = pl.Trainer(
            max_epochs=epochs, accelerator="cpu", logger=False, enable_checkpointing=False, enable_progress_bar=False,
            enable_model_summary=False, limit_val_batches=0, default_root_dir=tmp_path,
        )  # fmt: skip
        trainer.fit(recorder, data)
        return recorder.seen

    first = orders(9)
    torch.manual_seed(5)
    assert orders(9) == first
    assert all(len(set(order)) == len(order) == 20 for order in first)
    several = {tuple(order) for seed in (9, 10, 11) for order in orders(seed)}
    assert len(several) == 9


def test_loading_leaves_the_global_generator_alone(tmp_path):
    data = module(tmp_path, kind="nyu", paths=(str(write_nyu(tmp_path)),), batch_size=2)
    torch.manual_seed(0)
    state = torch.get_rng_state()
    list(data.train_dataloader())
    assert torch.equal(torch.get_rng_state(), state)


@pytest.mark.slow
def test_worker_processes_load_the_same(tmp_path):
    config = {"kind": "nyu", "paths": (str(write_nyu(tmp_path)),), "on_bad_file": "skip", "batch_size": 2}
    truncate(tmp_path / "train" / "kitchen_0" / "10.h5", 0.5)
    alone, apart = (module(tmp_path, Preprocess(size=(32, 40)), workers=n, **config) for n in (0, 1))
    for one, two in zip(alone.train_dataloader(), apart.train_dataloader(), strict=True):
        assert all(torch.equal(one[name].nan_to_num(-1), two[name].nan_to_num(-1)) for name in one)

"""The order of training samples: shares of processes, epochs, workers."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from training_data import loader, numbers, truncated, write_nyu

from ufmstar_torch.models import Preprocess
from ufmstar_torch.train import Augmentation, AugmentationConfig, EpochBatches, NyuFrames, SampleDataset
from ufmstar_torch.train.data import sample_loader

LENGTHS = {"length": st.integers(1, 200), "batch_size": st.integers(1, 9), "world": st.integers(1, 4)}


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


def test_epochs_differ_and_passes_over_one_do_not():
    batches = loader()
    first = [numbers(batch) for batch in batches]
    assert [numbers(batch) for batch in batches] == first
    batches.batch_sampler.sampler.set_epoch(1)
    assert [numbers(batch) for batch in batches] != first


def test_loading_leaves_the_global_generator_alone():
    torch.manual_seed(0)
    state = torch.get_rng_state()
    list(loader())
    assert torch.equal(torch.get_rng_state(), state)


@pytest.mark.slow
def test_worker_processes_load_the_same_and_report_broken_files(tmp_path):
    """Spawned; what they find broken is known here, and they know what epoch it is."""
    frames = NyuFrames(write_nyu(tmp_path), "train")
    truncated(frames.files[1], 0.5)

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
    assert apart.dataset.bad_files() == alone.dataset.bad_files() == (str(frames.files[1]),)

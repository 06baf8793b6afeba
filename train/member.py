"""The training of one network, from its start or its last checkpoint to its weights on disk."""

from __future__ import annotations

import logging
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import lightning.pytorch as pl
import torch
from lightning.pytorch.callbacks import Timer, TQDMProgressBar
from lightning.pytorch.loggers import CSVLogger, Logger, TensorBoardLogger

from ufmstar_torch.eval.engine.files import write_json_atomic
from ufmstar_torch.models.network import DepthNetwork
from ufmstar_torch.models.trained import save_trained
from ufmstar_torch.train.checkpoints import NAME, AtomicCheckpointIO, Checkpoints, Stops, require_checkpoint
from ufmstar_torch.train.data import DepthDataModule
from ufmstar_torch.train.module import TrainingModule, step_seed
from ufmstar_torch.train.settings import Job
from ufmstar_torch.train.start import starting_network, train_only

_LIGHTNINGS_OWN = r"`isinstance\(treespec, LeafSpec\)` is deprecated"
_ADVICE = r".*(does not have many workers|smaller than the logging interval|in eval mode at the start)"
WEIGHTS, RESULT = "trained.safetensors", "result.json"


def new_network(job: Job, member: int) -> DepthNetwork:
    """The initial network of a member; its random weights depend only on the seed."""
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(step_seed(job.seed(member), 0, -1))
        network = starting_network(job.recipe.network, job.settings.init, member, job.backbone)
    train_only(network, job.settings.trainable)
    return network.train()


def train_member(
    job: Job, member: int, *, deadline: float | None = None, asked: Callable[[], bool] | None = None
) -> str | None:
    """Train one member, from its checkpoint if there is one, until ``deadline``, in ``time.monotonic()``'s seconds, or
    until ``asked`` returns True. Writes its weights. Returns None if it is finished, otherwise the reason of the stop.
    Raises NonFiniteLossError: the training has diverged; ResumeError: the checkpoint cannot be read."""
    folder = job.folder(member)
    folder.mkdir(parents=True, exist_ok=True)
    checkpoint = folder / NAME
    stored = checkpoint if checkpoint.is_file() else None
    if stored is not None:
        require_checkpoint(stored)
    with quiet_lightning():
        trainer: Any = make_trainer(job, member)
        data = make_data(job, member, trainer.world_size)
        total = training_length(job, data)
        stops = Stops(total, deadline, asked)
        timer = Timer()  # its checkpoint contains the time of earlier sessions
        trainer.callbacks[:0] = [stops, timer, Checkpoints(checkpoint)]
        module = TrainingModule(new_network(job, member), job.recipe, total, job.seed(member))
        trainer.fit(module, data, ckpt_path=stored, weights_only=True)
    # After the last step, the training is finished despite a request to stop.
    reason = stops.reason if trainer.global_step < total else None
    if trainer.is_global_zero:
        figures = {"epoch": trainer.current_epoch, **module.figures}
        session = {"steps": trainer.global_step, "seconds": round(timer.time_elapsed(), 1), "figures": figures}
        _finish(job, member, module, {**session, "finished": reason is None, "stopped": reason})
    trainer.strategy.barrier("member is written")
    return reason


def make_data(job: Job, member: int, world: int) -> DepthDataModule:
    """Open the member's data for ``world`` processes. Raises ValueError: the batch cannot be divided among them."""
    if job.recipe.batch_size % world:
        raise ValueError(f"batch_size {job.recipe.batch_size} must be a multiple of the {world} processes")
    order = {"seed": job.seed(member), "clip_frames": job.recipe.clip_frames}
    data = DepthDataModule(job.data, job.recipe.network.input(), job.recipe.batch_size // world, **order)
    data.setup("fit")
    return data


def training_length(job: Job, data: DepthDataModule) -> int:
    """Optimizer steps of the whole training. Raises ValueError: an epoch has no full batch."""
    images, batch = len(data.train_set or ()), job.recipe.batch_size
    if data.clips is not None:
        images = len(data.clips) * job.recipe.clip_frames
    if images < batch:
        raise ValueError(f"the training part has {images} images, fewer than batch_size {batch}")
    return job.recipe.max_steps or job.recipe.epochs * (images // batch)


def make_trainer(job: Job, member: int) -> pl.Trainer:
    """Lightning's trainer; only :class:`Checkpoints` writes checkpoints."""
    r, s = job.recipe, job.settings
    precision: Any = s.precision  # Lightning checks the literal
    # Every session has a new version_N/metrics.csv, since the logger cannot continue a file.
    loggers: list[Logger] = [CSVLogger(s.out, name=f"member_{member}", flush_logs_every_n_steps=s.log_every)]
    if s.tensorboard:
        loggers.append(TensorBoardLogger(str(s.out), name="tensorboard", version=f"member_{member}"))
    return pl.Trainer(
        accelerator=("gpu" if torch.cuda.is_available() else "cpu") if s.accelerator == "auto" else s.accelerator,
        devices=s.devices,
        num_nodes=s.nodes,
        strategy=s.strategy,
        precision=precision,
        max_epochs=-1 if r.max_steps else r.epochs,
        max_steps=r.max_steps or -1,
        gradient_clip_val=r.clip or None,
        logger=loggers,
        callbacks=[TQDMProgressBar(leave=True)] if s.progress else [],
        sync_batchnorm=s.sync_batchnorm,
        plugins=[AtomicCheckpointIO()],
        log_every_n_steps=s.log_every,
        enable_checkpointing=False,
        enable_model_summary=False,
        enable_progress_bar=s.progress,
        num_sanity_val_steps=0,
        use_distributed_sampler=False,
        default_root_dir=str(s.out),
    )


def _finish(job: Job, member: int, module: TrainingModule, session: dict[str, Any]) -> None:
    """Write the weights, and then result.json, whose "finished" is True if the member's training is complete."""
    folder = job.folder(member)
    result = {"member": member, "seed": job.seed(member), **session}
    info = {"recipe": job.recipe.to_dict(), **result}
    save_trained(folder / WEIGHTS, [module.result.eval()], job.recipe.network, info=info)
    write_json_atomic(folder / RESULT, result)


@contextmanager
def quiet_lightning() -> Iterator[None]:
    """Suppress Lightning's messages on hardware, its tips, and torch's warning about Lightning's code."""
    loggers = [logging.getLogger(f"lightning.{part}") for part in ("pytorch", "fabric")]
    before = [logger.level for logger in loggers]
    for logger in loggers:
        logger.setLevel(logging.WARNING)
    try:
        with warnings.catch_warnings():
            warnings.filterwarnings("ignore", _LIGHTNINGS_OWN, FutureWarning)
            warnings.filterwarnings("ignore", _ADVICE)
            yield
    finally:
        for logger, level in zip(loggers, before, strict=True):
            logger.setLevel(level)

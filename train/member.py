"""The training of one network by Lightning, and its checkpoint.

``OUT/member_0/last.ckpt`` is Lightning's checkpoint of the last epoch, or of the step at which the time budget was
spent; its weights are those to use.
"""

from __future__ import annotations

import logging
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from datetime import timedelta
from pathlib import Path
from typing import Any

import lightning.pytorch as pl
import torch
from lightning.pytorch.callbacks import Callback, LearningRateMonitor, ModelCheckpoint, Timer, TQDMProgressBar
from lightning.pytorch.loggers import CSVLogger, Logger, TensorBoardLogger
from lightning.pytorch.plugins.io import TorchCheckpointIO

from ufmstar_torch.files.read import read_tensors
from ufmstar_torch.files.write import write_atomic
from ufmstar_torch.models.network import DepthNetwork
from ufmstar_torch.train.data import DepthDataModule
from ufmstar_torch.train.module import OF_MEMBER, TrainingModule, averaging
from ufmstar_torch.train.settings import Job
from ufmstar_torch.train.start import starting_network, train_only

CHECKPOINT = "last.ckpt"
_LIGHTNINGS_OWN = r"`isinstance\(treespec, LeafSpec\)` is deprecated"
_ADVICE = r".*(does not have many workers|smaller than the logging interval|in eval mode at the start|is not resumable)"
_FOLDER = r".*(Checkpoint directory .* exists|The dirpath has changed)"


class ResumeError(ValueError):
    """The checkpoint cannot be read or does not fit; the message names the option to use."""


class AtomicCheckpointIO(TorchCheckpointIO):
    """Writes atomically and durably.

    Lightning writes to the system's folder of temporary files, and may have to copy from there: a kill in the middle
    would leave no checkpoint.
    """

    def save_checkpoint(self, checkpoint: dict[str, Any], path: str | Path, storage_options: Any = None) -> None:
        """Replace ``path`` durably. Raises OSError: for example a full disk; the previous checkpoint remains."""
        write_atomic(Path(path), lambda file: torch.save(checkpoint, file), durable=True)


def new_network(job: Job, member: int) -> DepthNetwork:
    """The initial network of a member; its random weights depend only on the seed."""
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(job.seed(member))
        network = starting_network(job.recipe.network, job.settings.init, member, job.backbone)
    train_only(network, job.settings.trainable)
    return network.train()


def read_checkpoint(job: Job, member: int) -> dict[str, Any] | None:
    """The content of a member's checkpoint, or None if there is none. Raises ResumeError: it is damaged, or not of this
    program."""
    path = job.folder(member) / CHECKPOINT
    if not path.is_file():
        return None
    try:
        with path.open("rb") as file:
            stored = read_tensors(file, "it")
    except (OSError, ValueError) as error:
        raise ResumeError(f"{path} cannot be read ({error}); --overwrite starts again") from error
    if not isinstance(stored, dict) or OF_MEMBER not in stored:
        raise ResumeError(f"{path} is no checkpoint of this program; --overwrite starts again")
    return stored


def result_of(job: Job, member: int, stored: dict[str, Any]) -> dict[str, Any]:
    """Steps, seconds of all sessions and figures of a member, from its checkpoint."""
    content, steps = stored[OF_MEMBER], stored["global_step"]
    result = {"member": member, "seed": job.seed(member), "steps": steps, "seconds": round(_seconds(stored), 1)}
    return {**result, "figures": content["figures"], "finished": steps >= content["total_steps"]}


def _seconds(stored: dict[str, Any]) -> float:
    seconds: float = stored["callbacks"]["Timer"]["time_elapsed"]["train"]
    return seconds


def trained_network(job: Job, member: int, stored: dict[str, Any]) -> DepthNetwork:
    """A member with the weights of its checkpoint, in eval mode."""
    network = new_network(job, member)
    prefix = "network."
    weights = stored["state_dict"].items()
    network.load_state_dict({key.removeprefix(prefix): value for key, value in weights if key.startswith(prefix)})
    return network.eval()


def train_member(job: Job, member: int, *, seconds: float | None = None) -> None:
    """Train one member, from its checkpoint if there is one, for at most ``seconds`` [s].

    Raises NonFiniteLossError: the training has diverged; ResumeError: the checkpoint cannot be read; KeyboardInterrupt:
    Ctrl-C or SIGTERM; the last checkpoint remains.
    """
    stored = read_checkpoint(job, member)
    before = 0.0 if stored is None else _seconds(stored)
    timer = Timer(None if seconds is None else timedelta(seconds=before + seconds), verbose=False)
    with quiet_lightning():
        trainer: Any = make_trainer(job, member, timer)
        data = make_data(job, member, trainer.world_size)
        module = TrainingModule(new_network(job, member), job.recipe, training_length(job, data), job.seed(member))
        path = None if stored is None else job.folder(member) / CHECKPOINT
        try:
            trainer.fit(module, data, ckpt_path=path, weights_only=True)
        except SystemExit as error:  # of Lightning, after Ctrl-C or SIGTERM
            raise KeyboardInterrupt from error


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
    images, batch = len(data.train_set or ()) * job.recipe.clip_frames, job.recipe.batch_size
    if images < batch:
        raise ValueError(f"the training part has {images} images, fewer than batch_size {batch}")
    return job.recipe.max_steps or job.recipe.epochs * (images // batch)


def make_trainer(job: Job, member: int, timer: Timer | None = None) -> pl.Trainer:
    """Lightning's trainer of a member."""
    r, s = job.recipe, job.settings
    precision: Any = s.precision  # Lightning checks the literal
    # Every session has a new version_N/metrics.csv, since the logger cannot continue a file.
    loggers: list[Logger] = [CSVLogger(s.out, name=f"member_{member}", flush_logs_every_n_steps=s.log_every)]
    if s.tensorboard:
        loggers.append(TensorBoardLogger(str(s.out), name="tensorboard", version=f"member_{member}"))
    every_epoch: dict[str, Any] = {"enable_version_counter": False, "save_on_train_epoch_end": True}
    callbacks: list[Callback] = [
        timer or Timer(),
        LearningRateMonitor("step"),
        ModelCheckpoint(job.folder(member), Path(CHECKPOINT).stem, **every_epoch),
        *([averaging(r.average)] if r.average else []),
        *([TQDMProgressBar(leave=True)] if s.progress else []),
    ]
    return pl.Trainer(
        accelerator=("gpu" if torch.cuda.is_available() else "cpu") if s.accelerator == "auto" else s.accelerator,
        devices=s.devices,
        num_nodes=s.nodes,
        strategy=s.strategy,
        precision=precision,
        max_epochs=-1,  # the module stops it at the last step, so that a validation follows
        gradient_clip_val=r.clip or None,
        logger=loggers,
        callbacks=callbacks,
        sync_batchnorm=s.sync_batchnorm,
        plugins=[AtomicCheckpointIO()],
        log_every_n_steps=s.log_every,
        enable_model_summary=False,
        enable_progress_bar=s.progress,
        num_sanity_val_steps=0,
        default_root_dir=str(s.out),
    )


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
            for text in (_ADVICE, _FOLDER):
                warnings.filterwarnings("ignore", text)
            yield
    finally:
        for logger, level in zip(loggers, before, strict=True):
            logger.setLevel(level)

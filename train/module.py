"""The Lightning module: loss, optimizer, schedule, running mean of the weights, and logged figures."""

from __future__ import annotations

import copy
import math
from collections.abc import Mapping
from itertools import islice
from typing import Any

import lightning.pytorch as pl
import torch
import torch.distributed as dist
from torch import Tensor, nn
from torch.nn.utils import get_total_norm
from torch.optim import Adam, Optimizer
from torch.optim.lr_scheduler import LambdaLR

from ufmstar_torch.frames.prediction import stated_range
from ufmstar_torch.models.batch_ensemble import BatchEnsemble
from ufmstar_torch.models.distribution import DepthDistribution, GaussianDepth
from ufmstar_torch.models.network import DepthNetwork
from ufmstar_torch.train.distil import Teacher, distillation_sums
from ufmstar_torch.train.losses import loss_sums
from ufmstar_torch.train.presets import Recipe
from ufmstar_torch.train.progress import Sums, Validation

Batch = Mapping[str, Any]
FIGURES_KEY = "ufmstar_figures"  # of the last validation, in checkpoints


class NonFiniteLossError(RuntimeError):
    """The loss is NaN or infinite; the message names the batch and its samples."""


class TrainingModule(pl.LightningModule):
    """Trains one network.

    The random numbers of a step (dropout) depend only on (seed, process, step), so that a resumed training gives the
    same weights as an uninterrupted one.

    Args:
        network: an ``UncertaintyNetwork``, ``MonteCarloDropout`` or ``BatchEnsemble``, with ``.distribution(image)``.
        recipe: of its training.
        total_steps: length of the schedule.
        seed: of the training.

    Attributes:
        averaged: running mean of the network's weights (``recipe.average``), or None.
        residuals: sums of squared errors at the training steps of this epoch, for the constant-variance baseline.
        losses: sums of the loss at the training steps of this epoch.
        figures: of the last validation, by name.
    """

    def __init__(self, network: nn.Module, recipe: Recipe, total_steps: int, seed: int = 0) -> None:
        super().__init__()
        # Halves the time of a step on CPUs, and suits tensor cores.
        self.network: Any = network.to(memory_format=torch.channels_last)
        self.recipe = recipe
        self.total_steps = total_steps
        self.seed = seed
        self.averaged: Any = copy.deepcopy(network).requires_grad_(False) if recipe.average else None
        self.residuals = Sums()
        self.losses = Sums()
        self.validation = Validation()
        self.figures: dict[str, float] = {}
        self._batch_idx = 0
        # Not a submodule: it has no state between steps.
        self._teacher = Teacher(recipe.clip_frames, stated_range([network])) if recipe.clip_frames > 1 else None

    @property
    def result(self) -> DepthNetwork:
        """The network to validate and save: the running mean if there is one."""
        network: DepthNetwork = self.network if self.averaged is None else self.averaged
        return network

    # ---- training ----

    def on_train_start(self) -> None:
        """Set eval mode for frozen submodules, so that their batch norms keep their statistics."""
        for part in self.network.modules():
            parameters = list(part.parameters(recurse=False))
            if parameters and not any(p.requires_grad for p in parameters):
                part.eval()

    def on_train_epoch_start(self) -> None:
        """Reset the sums."""
        self.residuals, self.losses = Sums(), Sums()

    def on_train_batch_start(self, batch: Batch, batch_idx: int) -> None:
        """Seed torch's generator from seed, process and step."""
        self._batch_idx = batch_idx
        torch.manual_seed(step_seed(self.seed, self.global_rank, self.global_step))

    def training_step(self, batch: Batch, batch_idx: int) -> Tensor:
        """The loss of this process's share of the batch.

        Returns the process's sum over the whole batch's number of pixels, times the number of processes: its gradient,
        averaged over processes by DistributedDataParallel, is that of the mean over all pixels. Raises
        NonFiniteLossError: it is NaN or infinite.
        """
        distribution = self._distribution(batch["image"])
        target, valid = _tiled(batch["depth"], distribution), _tiled(batch["valid"], distribution)
        total, count = self._loss_sums(batch, distribution, target, valid)
        error = torch.where(valid, distribution.depth.detach().float() - target, 0.0).double()
        sums = torch.stack([total.detach().double(), count.double(), error.square().sum(), valid.sum().double()])
        all_sums, world = self._over_processes(sums)
        if not math.isfinite(all_sums[0]):
            raise NonFiniteLossError(self._blame("loss", batch_idx, float(total.detach())))
        self.residuals = self.residuals.plus(all_sums[2:])
        self.losses = self.losses.plus(all_sums[:2])
        mean = all_sums[0] / all_sums[1].clamp(min=1)
        self.log("train_loss", mean.float(), prog_bar=True, batch_size=len(target))
        self.log("learning_rate", self.trainer.optimizers[0].param_groups[0]["lr"], batch_size=1)
        return total * (world / all_sums[1].clamp(min=1)).to(total)

    def on_before_optimizer_step(self, optimizer: Optimizer) -> None:
        """Raise NonFiniteLossError if the gradient of a finite loss is not finite, before it changes the weights."""
        if self.trainer.precision == "16-mixed":
            return  # the gradient scaler skips such steps and reduces the scale
        gradients = [p.grad for p in self.network.parameters() if p.grad is not None]
        if gradients and not math.isfinite(get_total_norm(gradients)):
            raise NonFiniteLossError(self._blame("gradient", self._batch_idx))

    def optimizer_step(self, *arguments: Any, **named: Any) -> None:
        """A step, and then an update of the running mean, so that a checkpoint after the step contains both.

        Lightning's ``WeightAveraging`` is not used: its mean begins with the weights after the first step, it averages
        batch norm's counters, and it swaps the weights in checkpoints.
        """
        super().optimizer_step(*arguments, **named)
        if self.averaged is not None:
            # A shorter memory in the first steps, so that the mean forgets the initial weights soon.
            decay = min(self.recipe.average, self.global_step / (self.global_step + 10))
            move_average(self.averaged, self.network, decay)

    def on_train_epoch_end(self) -> None:
        """Log the epoch's mean loss over pixels."""
        if self.losses.pixels:
            self.log("train_loss_epoch", self.losses.mean(), sync_dist=True)

    def configure_optimizers(self) -> Any:
        """Adam, and the schedule per step."""
        r = self.recipe
        # Weight decay pulls to 0, but the factors of a BatchEnsemble are multipliers around 1.
        factors = {id(p) for p in (self.network.factors() if isinstance(self.network, BatchEnsemble) else ())}
        trained = [p for p in self.network.parameters() if p.requires_grad]
        groups = [
            {"params": [p for p in trained if id(p) not in factors], "weight_decay": r.weight_decay},
            {"params": [p for p in trained if id(p) in factors], "weight_decay": 0.0},
        ]
        optimizer = Adam([g for g in groups if g["params"]], r.learning_rate, betas=(r.beta1, r.beta2))
        schedule = LambdaLR(optimizer, lambda step: share_of_rate(step, self.total_steps, r))
        return {"optimizer": optimizer, "lr_scheduler": {"scheduler": schedule, "interval": "step"}}

    # ---- validation ----

    def on_validation_epoch_start(self) -> None:
        """Reset the sums."""
        self.validation = Validation(self.device)

    def validation_step(self, batch: Batch, batch_idx: int) -> None:
        """Add a batch to the sums."""
        self.validation.update(self.result(batch["image"]), batch["depth"], batch["valid"])

    def on_validation_epoch_end(self) -> None:
        """Log the validation's figures, over all processes."""
        self.figures = self.validation.figures(self.residuals)
        for name, value in self.figures.items():
            self.log(name, value, prog_bar=name in ("val_nll", "val_delta1"), sync_dist=True)

    # ---- state ----

    def on_save_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        """Add the figures to Lightning's checkpoint."""
        checkpoint[FIGURES_KEY] = self.figures

    def on_load_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        """Restore the figures."""
        self.figures = checkpoint[FIGURES_KEY]

    def _distribution(self, image: Tensor) -> DepthDistribution:
        image = image.contiguous(memory_format=torch.channels_last)
        if self.recipe.split_batch:
            return self.network.distribution(image, repeat=False)
        return self.network.distribution(image)

    def _loss_sums(
        self, batch: Batch, distribution: DepthDistribution, target: Tensor, valid: Tensor
    ) -> tuple[Tensor, Tensor]:
        """The sum of the loss over this process's pixels, and their number."""
        if self._teacher is None or not isinstance(distribution, GaussianDepth):
            return loss_sums(distribution, target, valid)
        variance, measured = self._teacher(distribution.depth, batch["T_world_cam"], batch["intrinsics"])
        return distillation_sums(distribution, target, valid, variance, measured)

    def _over_processes(self, values: Tensor) -> tuple[Tensor, int]:
        """The sum over all processes, and their number."""
        if not (dist.is_available() and dist.is_initialized()):
            return values, 1
        total = values.clone()
        dist.all_reduce(total)
        return total, dist.get_world_size()

    def _samples(self, batch_idx: int) -> list[str]:
        """Names of the frames in this process's batch, whose order depends on the epoch."""
        loader: Any = self.trainer.train_dataloader
        batches = copy.copy(loader.batch_sampler)
        batches.set_epoch(self.current_epoch)
        return [loader.dataset.source.name(key.frame) for key in next(islice(batches, batch_idx, None))]

    def _blame(self, what: str, batch_idx: int, loss: float | None = None) -> str:
        moment = f"epoch {self.current_epoch}, batch {batch_idx} (step {self.global_step})"
        samples = f"samples {', '.join(self._samples(batch_idx))}"
        if self.trainer.world_size > 1:
            samples = f"process {self.global_rank}{f' with loss {loss}' if loss is not None else ''}, {samples}"
        return (
            f"the {what} is not finite in {moment}, {samples}; a smaller learning rate or --set clip=1 may help; "
            "the previous checkpoint remains"
        )


def step_seed(seed: int, rank: int, step: int) -> int:
    """A hash of (seed, process, step) in 63 bits."""
    # SplitMix64's mixing, so that successive seeds are uncorrelated.
    z = (seed * 0x9E3779B97F4A7C15 + rank * 0xBF58476D1CE4E5B9 + step * 0x94D049BB133111EB + 1) % 2**64
    z = (z ^ (z >> 30)) * 0xBF58476D1CE4E5B9 % 2**64
    z = (z ^ (z >> 27)) * 0x94D049BB133111EB % 2**64
    return (z ^ (z >> 31)) >> 1


def share_of_rate(step: int, total: int, recipe: Recipe) -> float:
    """The learning rate of a step (from 0) as a share of ``recipe.learning_rate``."""
    warm = min(1.0, (step + 1) / (recipe.warmup_steps + 1))
    if recipe.schedule == "constant":
        return warm
    past = max(0, step - recipe.warmup_steps) / max(1, total - recipe.warmup_steps)
    return warm * 0.5 * (1 + math.cos(math.pi * min(1.0, past)))


@torch.no_grad()
def move_average(averaged: nn.Module, network: nn.Module, decay: float) -> None:
    """averaged <- decay averaged + (1 - decay) network, in place, also for batch norm's statistics; copies counters."""
    state = network.state_dict()
    for name, mean in averaged.state_dict().items():
        if mean.is_floating_point():
            mean.lerp_(state[name], 1 - decay)
        else:
            mean.copy_(state[name])


def _tiled(target: Tensor, distribution: DepthDistribution) -> Tensor:
    """The target repeated for every member of a BatchEnsemble, whose predictions are concatenated."""
    times = len(distribution.depth) // len(target)
    return target if times == 1 else target.repeat(times, 1, 1)

"""The Lightning module: loss, optimizer, schedule, and logged figures."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import lightning.pytorch as pl
import numpy as np
import torch
from lightning.pytorch.callbacks import WeightAveraging
from torch import Tensor, nn
from torch.nn.utils import get_total_norm
from torch.optim import Adam
from torch.optim.lr_scheduler import CosineAnnealingLR, LinearLR, LRScheduler, SequentialLR

from ufmstar_torch.eval.metrics import NLL, DepthAccuracy
from ufmstar_torch.frames.prediction import stated_range
from ufmstar_torch.models.batch_ensemble import BatchEnsemble
from ufmstar_torch.models.distribution import DepthDistribution, GaussianDepth
from ufmstar_torch.runtime.kinds import check_kinds
from ufmstar_torch.train.distil import Teacher, distillation_sums
from ufmstar_torch.train.losses import gaussian_nll, loss_sums
from ufmstar_torch.train.presets import Recipe

Batch = Mapping[str, Any]
# Of the last validation: the likelihood; that of the same depth with one variance for all pixels, the mean squared
# error, which is the best constant; and the accuracy of the depth.
FIGURES = ("val_nll", "val_nll_constant", "val_delta1", "val_rmse", "val_rel")
OF_MEMBER = "ufmstar"  # key of a checkpoint: the figures, and the length of the training
# [m^2] Smallest predicted variance: (1 mm)^2, as for the heads.
VARIANCE_FLOOR = 1e-6


class NonFiniteLossError(RuntimeError):
    """The loss or a weight is NaN or infinite; the message names the epoch and the step."""


class TrainingModule(pl.LightningModule):
    """Trains one network.

    The random numbers of an epoch (augmentation, dropout) depend only on (seed, process, epoch), so that a training
    that continues after an epoch gives the same weights as an uninterrupted one.

    Args:
        network: an ``UncertaintyNetwork``, ``MonteCarloDropout`` or ``BatchEnsemble``, with ``.distribution(image)``.
        recipe: of its training.
        total_steps: length of the schedule, after which the training stops.
        seed: of the training.
    """

    @check_kinds
    def __init__(self, network: nn.Module, recipe: Recipe, total_steps: int, seed: int = 0) -> None:
        super().__init__()
        # Halves the time of a step on CPUs, and suits tensor cores.
        self.network: Any = network.to(memory_format=torch.channels_last)
        self.recipe = recipe
        self.total_steps = total_steps
        self.seed = seed
        self.accuracy = DepthAccuracy()
        self.likelihood = NLL()
        self.figures: dict[str, float] = {}
        # Not a submodule: it has no state between steps.
        self._teacher = Teacher(recipe.clip_frames, stated_range([network])) if recipe.clip_frames > 1 else None

    # ---- training ----

    def on_train_start(self) -> None:
        """Set eval mode for frozen submodules, so that their batch norms keep their statistics."""
        for part in self.network.modules():
            parameters = list(part.parameters(recurse=False))
            if parameters and not any(p.requires_grad for p in parameters):
                part.eval()

    def on_train_epoch_start(self) -> None:
        """Seed torch's generators from seed, process and epoch."""
        words = np.random.SeedSequence((self.seed, self.global_rank, self.current_epoch)).generate_state(1, np.uint64)
        torch.manual_seed(int(words[0]) >> 1)

    def training_step(self, batch: Batch, batch_idx: int) -> Tensor:
        """The loss of this process's share of the batch.

        Returns the process's sum over the mean number of pixels of all processes: its gradient, averaged over processes
        by DistributedDataParallel, is that of the mean over all pixels. Raises NonFiniteLossError: the loss of a logged
        step is NaN or infinite.
        """
        total, count = self._loss_sums(batch, self._distribution(batch["image"]))
        pixels: Any = self.trainer.strategy.reduce(count.to(total.dtype), reduce_op="mean")
        loss: Tensor = total / pixels.clamp(min=1)
        where: dict[str, Any] = {"on_step": True, "on_epoch": True, "prog_bar": True, "sync_dist": True}
        self.log("train_loss", loss.detach(), batch_size=len(batch["image"]), **where)
        trainer: Any = self.trainer
        if batch_idx % trainer.log_every_n_steps == 0:  # the log reads the value, too
            self._require_finite(loss)
        return loss

    def on_train_batch_end(self, *_: Any) -> None:
        """Stop at the last step, which may lie inside an epoch, after a validation."""
        if self.global_step >= self.total_steps:
            self.trainer.should_stop = True

    def on_train_epoch_end(self) -> None:
        """Raise NonFiniteLossError if the epoch's loss or a weight is not finite, before a checkpoint is written."""
        self._require_finite(self.trainer.callback_metrics["train_loss_epoch"])
        self._require_finite(get_total_norm(self.network.parameters()))

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
        schedule = learning_rates(optimizer, r, self.total_steps)
        return {"optimizer": optimizer, "lr_scheduler": {"scheduler": schedule, "interval": "step"}}

    # ---- validation ----

    def validation_step(self, batch: Batch, batch_idx: int) -> None:
        """Add a batch to the metrics."""
        prediction, depth = self.network(batch["image"]), batch["depth"]
        self.accuracy.update(prediction.depth, None, depth, depth > 0)
        if prediction.variance is not None:
            variance = prediction.variance.clamp(min=VARIANCE_FLOOR)
            self.likelihood.update(prediction.depth, variance, depth, depth > 0)

    def on_validation_epoch_end(self) -> None:
        """Log the validation's figures, over all processes; none without a pixel."""
        figures = validation_figures(self.accuracy.compute(), self.likelihood.compute()["nll"])
        self.accuracy.reset()
        self.likelihood.reset()
        self.figures = {name: float(value) for name, value in figures.items()}
        for name, value in figures.items():
            self.log(name, value.float(), prog_bar=name in ("val_nll", "val_delta1"), sync_dist=True)

    def on_save_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        """Add the figures and the length of the training to Lightning's checkpoint."""
        checkpoint[OF_MEMBER] = {"figures": self.figures, "total_steps": self.total_steps}

    def _distribution(self, image: Tensor) -> DepthDistribution:
        image = image.contiguous(memory_format=torch.channels_last)
        if self.recipe.split_batch:
            return self.network.distribution(image, repeat=False)
        return self.network.distribution(image)

    def _loss_sums(self, batch: Batch, distribution: DepthDistribution) -> tuple[Tensor, Tensor]:
        """The sum of the loss over this process's pixels, and their number."""
        # The predictions of a BatchEnsemble's members are concatenated.
        target = batch["depth"].repeat(len(distribution.depth) // len(batch["depth"]), 1, 1)
        if self._teacher is None or not isinstance(distribution, GaussianDepth):
            return loss_sums(distribution, target, target > 0)
        variance, measured = self._teacher(distribution.depth, batch["T_world_cam"], batch["intrinsics"])
        return distillation_sums(distribution, target, target > 0, variance, measured)

    def _require_finite(self, value: Tensor) -> None:
        if not bool(value.isfinite()):
            raise NonFiniteLossError(
                f"the loss or a weight is not finite in epoch {self.current_epoch}, by step {self.global_step}; "
                "a smaller learning rate or --set clip=1 may help; the previous checkpoint remains"
            )


def learning_rates(optimizer: Adam, recipe: Recipe, total: int) -> LRScheduler:
    """The learning rate of every step: a linear rise over the warm-up, then constant, or a cosine down to 0."""
    warm = recipe.warmup_steps
    rise = LinearLR(optimizer, 1 / (warm + 1), total_iters=warm)
    if recipe.schedule == "constant":
        return rise
    return SequentialLR(optimizer, [rise, CosineAnnealingLR(optimizer, max(1, total - warm))], [warm])


def averaging(decay: float) -> WeightAveraging:
    """Lightning's running mean of the weights and batch norm's statistics, from the first step's on.

    The decay per step is smaller in the first steps, so that the mean forgets the initial weights soon."""

    def mean_of(mean: Tensor, value: Tensor, updates: Any) -> Tensor:
        if not mean.is_floating_point():
            return value  # counters
        factor = ((updates + 1) / (updates + 11)).clamp(max=decay)
        return torch.lerp(mean, value, (1 - factor).to(mean))

    return WeightAveraging(avg_fn=mean_of)


def validation_figures(accuracy: Mapping[str, Tensor], likelihood: Tensor) -> dict[str, Tensor]:
    """By name in metrics.csv, from the metrics' values: ``val_nll`` only if it is a number, which needs a variance, no
    figures without a pixel."""
    if not accuracy["pixels"]:
        return {}
    rmse = accuracy["rmse"]
    constant = gaussian_nll(torch.zeros_like(rmse), rmse.square().clamp(min=VARIANCE_FLOOR).log(), rmse)
    nll = {} if likelihood.isnan() else {"val_nll": likelihood}
    of_depth = {"val_delta1": accuracy["delta1_ratio"], "val_rmse": rmse, "val_rel": accuracy["abs_rel"]}
    return {**nll, "val_nll_constant": constant, **of_depth}

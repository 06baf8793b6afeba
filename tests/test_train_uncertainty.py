"""The validation of uncertainty on sequences: figures of the evaluation, logged by a user's Lightning module."""

from __future__ import annotations

import csv

import lightning.pytorch as pl
import pytest
import torch
from lightning.pytorch.loggers import CSVLogger
from torch import nn
from torch.utils.data import DataLoader

from ufmstar_torch.eval.sequences import open_sequence
from ufmstar_torch.eval.sequences.frame import in_memory
from ufmstar_torch.models import AleatoricHead, Preprocess
from ufmstar_torch.train import UncertaintyCallback, judge_network, loss_of
from ufmstar_torch.train.member import quiet_lightning
from ufmstar_torch.train.uncertainty import LOGGED


class Own(nn.Module):
    """Depth and a head's variance of a network with batch norm."""

    def __init__(self) -> None:
        super().__init__()
        torch.manual_seed(0)
        self.features = nn.Sequential(nn.Conv2d(3, 4, 3, padding=1), nn.BatchNorm2d(4), nn.ReLU())
        self.depth, self.head = nn.Conv2d(4, 1, 3, padding=1), AleatoricHead(4)

    def distribution(self, image):
        features = self.features(image)
        return self.head(features, 2 + self.depth(features)[:, 0].tanh())

    def forward(self, image):
        return self.distribution(image).prediction()


class Training(pl.LightningModule):
    """A user's training module."""

    def __init__(self, network) -> None:
        super().__init__()
        self.network = network

    def training_step(self, batch, _):
        image, depth = batch
        return loss_of(self.network.distribution(image), depth, depth > 0)

    def validation_step(self, batch, _):
        self.modes = [part.training for part in self.network.modules()]

    def configure_optimizers(self):
        return torch.optim.Adam(self.parameters(), 1e-2)


@pytest.fixture(scope="module")
def walk():
    return in_memory(open_sequence("tour:5?frames=4&size=64x96"))


def test_figures_over_sequences_are_of_all_their_pixels(walk):
    network = Own()
    network.features.eval()
    judged = judge_network(network, [walk], rows=("network",))["network"].compute()
    assert network.training
    assert not network.features.training
    errors, likelihood = [], []
    with torch.no_grad():
        for frame in walk:
            out = network.eval()(torch.from_numpy(frame.image).permute(2, 0, 1)[None] / 255)
            truth = torch.from_numpy(frame.depth)
            use, error = truth > 0, out.depth[0] - truth
            errors.append(error[use].square())
            likelihood.append(-torch.distributions.Normal(out.depth[0], out.variance[0].sqrt()).log_prob(truth)[use])
    assert judged["rmse"] == pytest.approx(float(torch.cat(errors).mean().sqrt()), rel=1e-3)
    assert judged["nll"] == pytest.approx(float(torch.cat(likelihood).mean()), rel=1e-3)
    twice = judge_network(network, [walk, walk], rows=("network",))["network"].compute()
    assert twice["nll"] == pytest.approx(judged["nll"], rel=1e-5)
    assert twice["pixels"] == 2 * judged["pixels"]
    few = judge_network(network, [walk], rows=("network",), frames=2)["network"].compute()
    assert 0 < few["pixels"] < judged["pixels"]


def test_a_module_of_ones_own_logs_every_row(walk, tmp_path):
    image = torch.rand(4, 3, 64, 96, generator=torch.Generator().manual_seed(0))
    loader = DataLoader(list(zip(image, 1 + image[:, 0], strict=True)), batch_size=2)
    module, callback = Training(Own()), UncertaintyCallback([walk], every=2)
    how = {"enable_progress_bar": False, "enable_model_summary": False, "enable_checkpointing": False}
    with quiet_lightning():
        trainer = pl.Trainer(max_epochs=2, accelerator="cpu", logger=CSVLogger(tmp_path), callbacks=[callback], **how)
        trainer.fit(module, loader, loader)
    with open(tmp_path / "lightning_logs" / "version_0" / "metrics.csv", newline="") as rows:
        logged = [row for row in csv.DictReader(rows) if row.get("network/nll")]
    assert len(logged) == 1
    names = {f"{row}/{name}" for row in ("network", "ufmstar", "posterior") for name in LOGGED}
    assert names <= set(logged[0])
    expected = {row: metrics.compute() for row, metrics in judge_network(module.network, [walk]).items()}
    for name in names:
        row, _, figure = name.partition("/")
        assert float(logged[0][name]) == pytest.approx(expected[row][figure], rel=1e-3), name
    assert (tmp_path / "lightning_logs" / "version_0" / "uncertainty" / "epoch_1.png").stat().st_size > 10_000
    assert all(module.network.modules())


def test_impossible_arguments(walk):
    with pytest.raises(ValueError, match=r"rows of .'network', 'ufmstar', 'posterior'., got 1 and .'ufm'."):
        judge_network(Own(), [walk], rows=("ufm",))
    with pytest.raises(ValueError, match="at least one sequence"):
        judge_network(Own(), [], preprocess=Preprocess())
    with pytest.raises(ValueError, match="every must be at least 1, got 0"):
        UncertaintyCallback([walk], every=0)

"""Example predictions: after a validation, a picture of image, depth, sigma and error of some of its frames."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import lightning.pytorch as pl
import numpy as np
import torch
from torch import Tensor

from ufmstar_torch.eval.run.panels import FramePanel, contact_sheet, map_columns
from ufmstar_torch.models.network import DepthNetwork
from ufmstar_torch.models.preprocess import Preprocess
from ufmstar_torch.train.data import DepthDataModule
from ufmstar_torch.train.samples import Sample

FOLDER = "examples"
# A long training leaves about so many pictures, not one per epoch.
PICTURES = 20


class Examples(pl.Callback):
    """Draws ``examples/epoch_007.png`` in the member's folder, on the first process: ``count`` frames, spread over the
    validation part. The last of the training's epochs is drawn always."""

    def __init__(self, folder: Path, data: DepthDataModule, count: int, epochs: int) -> None:
        self.folder = folder / FOLDER
        self.data = data
        self.count = count
        self.last = epochs - 1
        self.every = max(1, epochs // PICTURES)

    def on_validation_end(self, trainer: pl.Trainer, module: Any) -> None:
        """Draw, if it is this epoch's turn."""
        epoch = trainer.current_epoch
        due = epoch % self.every == 0 or epoch == self.last or trainer.should_stop
        frames = self.data.validation_set
        if not (trainer.is_global_zero and due) or frames is None or not len(frames):
            return
        self.folder.mkdir(exist_ok=True)
        chosen = sorted(set(np.linspace(0, len(frames) - 1, self.count).round().astype(int).tolist()))
        samples = [(frames.source.name(n), frames[n]) for n in chosen]
        title = f"epoch {epoch}, step {trainer.global_step}"
        draw_examples(self.folder / f"epoch_{epoch:03}.png", module.result, self.data.preprocess, samples, title)


@torch.no_grad()
def draw_examples(
    path: Path, network: torch.nn.Module, preprocess: Preprocess, samples: list[tuple[str, Sample]], title: str
) -> None:
    """Write a sheet (PNG) of the predictions of a network in eval mode for some samples, given with their names;
    ``preprocess`` is the network's, to show the image as it was."""
    panels = [_panel(network, preprocess, name, sample) for name, sample in samples]
    columns = map_columns(panels)
    if not any(panel.maps["sigma"].any() for panel in panels):
        columns = [column for column in columns if column.field != "sigma"]
    contact_sheet(panels, path, title=title, columns=columns)


def _panel(network: torch.nn.Module | DepthNetwork, preprocess: Preprocess, name: str, sample: Sample) -> FramePanel:
    device = next(network.parameters()).device
    prediction = network(sample["image"][None].to(device))
    depth = prediction.depth[0].float().cpu().numpy()
    variance = np.zeros_like(depth) if prediction.variance is None else prediction.variance[0].float().cpu().numpy()
    truth, valid = sample["depth"].numpy(), sample["valid"].numpy()
    error = np.where(valid, np.abs(depth - truth), np.nan).astype(np.float32)
    image = camera_image(sample["image"], preprocess)
    maps = {"depth": depth, "sigma": np.sqrt(variance), "error": error}
    return FramePanel(Path(name).name[-24:], image, maps)


def camera_image(image: Tensor, preprocess: Preprocess) -> np.ndarray:
    """[H, W, 3] uint8 what the camera saw, from the network's input [3, H, W]."""
    std, mean = image.new_tensor(preprocess.std)[:, None, None], image.new_tensor(preprocess.mean)[:, None, None]
    unit = (image * std + mean) / preprocess.value_range
    return (unit.clamp(0, 1) * 255).round().to(torch.uint8).permute(1, 2, 0).numpy()

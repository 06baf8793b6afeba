"""Metrics on a device: the same figures as on the CPU, without a transfer or a wait before ``compute``."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import lightning.pytorch as pl
import pytest
import torch
from metric_maps import ALL, maps
from pages import blocks
from torch import Tensor
from torch.utils.data import DataLoader

from ufmstar_torch.eval.metrics import NLL, Coverage, ECEDelta, ECEQuantile, base
from ufmstar_torch.eval.metrics.intervals import GatedPixels, IntervalCoverage
from ufmstar_torch.eval.metrics.mixture import Mixture

PAGE = Path(__file__).resolve().parents[1] / "docs" / "evaluation.md"
KINDS = [*ALL, Coverage, GatedPixels, IntervalCoverage, Mixture]


def frames() -> tuple[Tensor, ...]:
    """Depth, variance, truth, valid, mixture and level with every kind of invalid pixel."""
    depth, variance, truth = maps(2, 60, 70)
    generator = torch.Generator().manual_seed(0)
    for value, wrong in ((depth, torch.nan), (depth, torch.inf), (variance, torch.nan), (variance, -1.0),
                         (variance, 0.0), (truth, 0.0), (truth, torch.nan), (truth, torch.inf)):  # fmt: skip
        value[torch.rand(value.shape, generator=generator) < 0.03] = wrong
    valid = torch.rand(depth.shape, generator=generator) < 0.9
    outlier = 0.3 * torch.rand(depth.shape, generator=generator, dtype=torch.float64)
    level = torch.rand(depth.shape, generator=generator, dtype=torch.float64)
    level[torch.rand(level.shape, generator=generator) < 0.2] = torch.nan
    return depth, variance, truth, valid, 0.5 * variance, outlier, level


def added(metric, data: tuple[Tensor, ...]):
    """The metric after two updates."""
    depth, variance, truth, valid, inlier, outlier, level = data
    for part in (slice(0, 1), slice(1, 2)):
        views = (depth[part], variance[part], truth[part], valid[part])
        metric.add(base.flat_pixels(*views, (inlier[part], outlier[part]), level[part]))
    return metric


@pytest.fixture
def as_on_a_device(monkeypatch):
    """Use the form of devices on the CPU, and fail at every transfer to the host or read of a value."""
    monkeypatch.setattr(base, "_compacts", lambda device: False)

    def forbidden(name: str):
        def fail(*_, **__):
            raise AssertionError(f"{name} waits for the device")

        return fail

    def guard():
        for name in ("cpu", "numpy", "tolist", "item", "nonzero", "__bool__", "__int__", "__float__", "__index__"):
            monkeypatch.setattr(Tensor, name, forbidden(name))

    yield guard
    monkeypatch.undo()


@pytest.mark.parametrize("kind", KINDS)
def test_the_form_of_devices_has_the_figures_of_the_cpu(kind, as_on_a_device, monkeypatch):
    data, metric = frames(), kind()
    as_on_a_device()
    metric = added(metric, data)
    monkeypatch.undo()
    expected = added(kind(), data)
    assert metric.compute().keys() == expected.compute().keys()
    for name, value in expected.compute().items():
        torch.testing.assert_close(metric.compute()[name], value, rtol=1e-9, atol=1e-9, equal_nan=True)


@pytest.mark.parametrize("kind", KINDS)
def test_an_update_needs_no_value(kind):
    """Tensors of the device "meta" have none, so that an update that reads one fails."""
    metric = added(kind().to("meta"), tuple(x.to("meta") for x in frames()))
    assert all(getattr(metric, name).device.type == "meta" for name, *_ in metric.STATES)


def test_coverage_and_width_of_normal_errors():
    depth, variance, truth = maps(400, 500)
    for level in (0.5, 0.9):
        figures = Coverage(level)(depth, variance, truth)
        assert float(figures["coverage"]) == pytest.approx(level, abs=0.005)
        width = 2 * torch.special.ndtri(torch.tensor(0.5 + level / 2, dtype=torch.float64)) * variance.sqrt().mean()
        assert float(figures["interval_width"]) == pytest.approx(float(width), rel=1e-12)
    nothing = Coverage()(depth, variance, torch.zeros_like(truth))
    assert math.isnan(nothing["coverage"])
    with pytest.raises(ValueError, match=r"level must lie in \(0, 1\)"):
        Coverage(1.0)


@pytest.mark.gpu
@pytest.mark.parametrize("kind", KINDS)
def test_on_a_gpu_an_update_does_not_wait(kind):
    expected = added(kind(), frames()).compute()
    data, metric = tuple(x.to("cuda") for x in frames()), kind().to("cuda")
    added(kind().to("cuda"), data)  # compiles the kernels
    torch.cuda.set_sync_debug_mode("error")
    try:
        metric = added(metric, data)
    finally:
        torch.cuda.set_sync_debug_mode("default")
    for name, value in expected.items():
        torch.testing.assert_close(metric.compute()[name].cpu(), value, rtol=1e-9, atol=1e-9, equal_nan=True)


class TestThePage:
    """docs/evaluation.md: the metrics in anybody's Lightning module."""

    @pytest.mark.filterwarnings("ignore:.*LeafSpec:FutureWarning", "ignore:.*num_workers", "ignore:.*litlogger")
    def test_the_module_logs_the_figures_of_all_batches(self):
        (code,) = [block for block in blocks(PAGE.read_text()) if "LightningModule" in block]
        scope: dict[str, Any] = {}
        exec(compile(code, "evaluation.md", "exec"), scope)
        depth, variance, truth = maps(4, 20, 30)
        batches = [
            {"image": torch.stack([depth[n : n + 2], variance[n : n + 2]], 1), "depth": truth[n : n + 2]}
            for n in (0, 2)
        ]
        module = scope["MyDepth"](lambda image: image.unbind(1))
        quiet = {"logger": False, "enable_checkpointing": False, "enable_progress_bar": False}
        trainer = pl.Trainer(accelerator="cpu", devices=1, enable_model_summary=False, **quiet)
        (logged,) = trainer.validate(module, DataLoader(batches, batch_size=None), verbose=False)
        for kind in (NLL, ECEDelta, ECEQuantile):
            for name, value in kind()(depth, variance, truth).items():
                if value.dim() == 0:
                    assert logged[name] == pytest.approx(float(value), rel=1e-6), name

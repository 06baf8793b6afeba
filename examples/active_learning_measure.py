"""What the active-learning example measures: predictions on the held-back views, and the cost of a score."""

from __future__ import annotations

import time
from collections.abc import Sequence
from statistics import median
from typing import Any

import torch
from active_learning_data import View

from ufmstar_torch import DepthPrediction, UfMStar
from ufmstar_torch.eval.metrics import NLL, RMSE, Delta1
from ufmstar_torch.models import DepthNetwork


def predict(members: Sequence[DepthNetwork], view: View, index: int) -> DepthPrediction:
    """One inference, as `UncertainDepth` alternates them: image i by member i mod N."""
    with torch.no_grad():
        prediction: DepthPrediction = members[index % len(members)](view.image[None])
    return prediction


def judge(members: Sequence[DepthNetwork], views: Sequence[View]) -> dict[str, dict[str, float]]:
    """delta1, RMSE [m] and NLL [nats, with the network's own variance] of all views and by kind of room."""
    parts = ["all", *sorted({view.room for view in views} - {""}, reverse=True)]
    metrics = {part: (Delta1(), RMSE(), NLL()) for part in parts}
    for i, view in enumerate(views):
        p = predict(members, view, i)
        for part in {"all", view.room} - {""}:
            for metric in metrics[part]:
                metric.update(p.depth, p.variance, view.depth[None])
    figures = {part: {k: float(v) for m in metrics[part] for k, v in m.compute().items()} for part in parts}
    return {part: {name: figures[part][name] for name in ("delta1", "rmse", "nll")} for part in parts}


def measure_cost(members: Sequence[DepthNetwork], pool: Sequence[View], pixels: int) -> dict[str, Any]:
    """What the average over a sample of pixels costs against the dense map, frame by frame side by side.

    Returns:
        Median wall times [ms] of the network, of the dense map and of the sample; "ratio", the median over the frames
        of the sample's processor time by the dense map's; threads; the mean V of every image by either way [m^2].
    """
    ways = {"dense": UfMStar(), "sample": UfMStar()}
    clock = {name: _Clock() for name in ("network", *ways)}
    means: dict[str, list[float]] = {way: [] for way in ways}
    for i, view in enumerate(pool):
        with clock["network"]:
            p = predict(members, view, i)
        stream = (p.depth, view.T_world_cam[None], view.intrinsics[None], p.aleatoric_variance, p.epistemic_variance)
        for way in sorted(ways, reverse=bool(i % 2)):  # either goes first half of the time
            with clock[way]:
                if way == "dense":
                    mean = ways[way](*stream).variance.nanmean()
                else:
                    mean = ways[way].mean_uncertainty(*stream, pixels=pixels, seed=i).mean
            means[way].append(float(mean))
    warm = len(pool) // 10 + 1  # compilation, an almost empty mixture
    figures = {f"{name}_ms": 1e3 * median(c.wall[warm:]) for name, c in clock.items()}
    pairs = zip(clock["sample"].processor[warm:], clock["dense"].processor[warm:], strict=True)
    ratio = median(sample / dense for sample, dense in pairs)
    return {**figures, "ratio": ratio, "threads": torch.get_num_threads(), "pixels": pixels, "means": means}


class _Clock:
    """Wall and processor time [s] of every block it encloses; the latter also holds on a busy machine."""

    def __init__(self) -> None:
        self.wall: list[float] = []
        self.processor: list[float] = []

    def __enter__(self) -> None:
        self._began = time.perf_counter(), time.process_time()

    def __exit__(self, *error: object) -> None:
        self.wall.append(time.perf_counter() - self._began[0])
        self.processor.append(time.process_time() - self._began[1])

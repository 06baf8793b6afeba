"""UfM and UfM* as a row of the table runs them, with their clocks and the bytes that they keep."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any

import torch
from torch import Tensor

from ufmstar_torch import UfMStar
from ufmstar_torch.eval.bench.benchmark_timing import StageClock
from ufmstar_torch.eval.engine.estimators import ufm_star_config
from ufmstar_torch.eval.methods.method import ALONE, UFM, Method
from ufmstar_torch.eval.methods.row import Row
from ufmstar_torch.eval.methods.ufm import UfM, UfMConfig
from ufmstar_torch.prediction import DepthPrediction


@dataclass(frozen=True)
class Inputs:
    """What a multiview method is given for a frame.

    Attributes:
        prediction: [1, h, w] maps, on the network's device.
        T_world_cam: [1, 4, 4] float64 [m]; ``intrinsics``: [1, 3, 3] float64 of the maps [px].
        intrinsics: see ``T_world_cam``.
    """

    prediction: DepthPrediction
    T_world_cam: Tensor
    intrinsics: Tensor

    def maps(self, method: Method, device: torch.device) -> tuple[Tensor, Tensor, Tensor, Tensor | None, Tensor | None]:
        """Depth, pose, intrinsics, A and E as the method takes them, on its device."""
        p = self.prediction
        own = (p.aleatoric_variance, p.epistemic_variance) if method.uses_aleatoric else (None, None)
        A, E = (None if value is None else value.to(device) for value in own)
        return p.depth.to(device), self.T_world_cam.to(device), self.intrinsics.to(device), A, E


class Multiview:
    """The multiview part of a row, with a state of its own.

    Args:
        row: behind UfM or UfM*.
        device: where it runs.

    Raises:
        ValueError: a row without a multiview part.
    """

    def __init__(self, row: Row, device: torch.device) -> None:
        self.method, self.device = row.method, device
        self.module = build(row).to(device)
        self.bytes: list[int] = []
        self.count: list[int] = []

    def __call__(self, inputs: Inputs) -> Any:
        """The next frame: its maps to the device, and the step."""
        return self.module(*inputs.maps(self.method, self.device))

    def note(self) -> None:
        """Write down what is kept now."""
        held, count = state_bytes(self.module)
        self.bytes.append(held)
        self.count.append(count)

    def memory(self) -> dict[str, float]:
        """Bytes and points or components after the noted frames: at the end, on average, at most; and of the
        map that is kept for smoothing [bytes]."""
        smoothing = self.module.smoothed.nbytes if isinstance(self.module, UfMStar) else 0
        figures: dict[str, float] = {"smoothing_bytes": smoothing}
        for name, values in (("bytes", self.bytes), ("count", self.count)):
            figures |= {
                f"{name}_end": values[-1],
                f"{name}_mean": sum(values) / len(values),
                f"{name}_max": max(values),
            }
        return figures


class StagedUfMStar:
    """UfM* on a state of its own, with a clock at every stage; on an accelerator each stage is waited for.

    Args:
        row: behind UfM*.
        device: where it runs.

    Raises:
        ValueError: a row that is not behind UfM*.
    """

    def __init__(self, row: Row, device: torch.device) -> None:
        module = build(row)
        if not isinstance(module, UfMStar):
            raise ValueError(f"{row.label} is not behind UfM*, whose stages are known")
        self.method, self.device, self.module = row.method, device, module.to(device)
        self.clock = module.observer = StageClock(partial(synchronize, device))

    def __call__(self, inputs: Inputs) -> None:
        """The next frame."""
        maps = inputs.maps(self.method, self.device)
        self.clock.start()
        self.module(*maps)


def build(row: Row) -> UfM | UfMStar:
    """The module behind a row, as the evaluation builds it.

    Raises:
        ValueError: a row without a multiview part.
    """
    if row.method.fusion == ALONE:
        raise ValueError(f"{row.label} has no multiview part")
    if row.method.fusion == UFM:
        return UfM(UfMConfig(max_points=row.method.max_points, on_bad_frame="skip"))
    return UfMStar(ufm_star_config(row))


def state_bytes(module: UfM | UfMStar) -> tuple[int, int]:
    """What a module remembers of the views [bytes], without the map for smoothing, and how many points or
    components that is."""
    if isinstance(module, UfM):
        return module.moments.nbytes + module.count.nbytes, int(module.points.sum())
    mixture = module.mixture
    components = int(mixture.components.sum())
    return components * mixture.bytes_per_component(), components


def synchronize(device: torch.device) -> None:
    """Wait for what a device still computes."""
    if device.type == "cuda":
        torch.cuda.synchronize(device)


def waited(call: Callable[..., Any], device: torch.device) -> Callable[..., Any]:
    """A call that returns when the device has finished."""

    def run(*args: Any, **kwargs: Any) -> Any:
        result = call(*args, **kwargs)
        synchronize(device)
        return result

    return run

"""A network's forward pass in the runtime that is fastest here: torch with channels last, or ONNX Runtime."""

from __future__ import annotations

import copy
import tempfile
import warnings
from collections.abc import Callable
from importlib.metadata import version
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn

from ufmstar_torch.eval.bench.timing import TimedCalls
from ufmstar_torch.models.inference import ONNX, TORCH
from ufmstar_torch.models.onnx_network import open_session
from ufmstar_torch.prediction import DepthPrediction

_ROUNDS, _WARM_UP = 12, 2
# [1] Largest difference of two runtimes, of the largest output, that is rounding.
_AGREEMENT = 1e-3


class _Maps(nn.Module):
    """A network that returns a tensor: of a depth network, the depth."""

    def __init__(self, network: nn.Module) -> None:
        super().__init__()
        self.network = network

    def forward(self, image: Tensor) -> Tensor:
        maps = self.network(image)
        return maps.depth if isinstance(maps, DepthPrediction) else maps


def fastest(network: nn.Module, side: int, *, runtime: str = "auto") -> tuple[Callable[..., Tensor], dict[str, Any]]:
    """The pass of a network on a fixed random [1, 3, side, side] image; its arguments are not used.

    Args:
        network: in eval mode, batch norms folded where it can be.
        side: [px].
        runtime: "auto" compares those that are installed; "torch" or "onnx" takes that one.

    Returns:
        The pass, and "runtime" and "version" of it, "threads", "runtimes": the least time of each in turns [ms], and
        "apart": the largest difference of their outputs as a share of the largest.

    Raises:
        ModuleNotFoundError: "onnx" without the packages onnx and onnxruntime.
        ValueError: the runtimes do not agree.
    """
    image = torch.rand(1, 3, side, side, generator=torch.Generator().manual_seed(0))
    calls: dict[str, Callable[..., Tensor]] = {}
    if runtime != ONNX:
        calls[TORCH] = _in_torch(network, image)
    if runtime == ONNX or (runtime == "auto" and find_spec("onnx") and find_spec("onnxruntime")):
        calls[ONNX] = _in_onnx_runtime(network, image)
    timed, outputs = TimedCalls(), {}
    for _ in timed.frames(range(_WARM_UP + _ROUNDS), warm_up=_WARM_UP):
        outputs = timed.call(calls)
    least = {name: min(timed.times.wall[name]) for name in calls}
    chosen = min(least, key=lambda name: least[name])
    apart = None
    if len(calls) > 1:
        one, other = (outputs[name] for name in calls)
        apart = float((one - other).abs().max() / other.abs().max())
        if not apart <= _AGREEMENT:
            raise ValueError(f"the runtimes {', '.join(calls)} differ by {apart:.2g} of the largest output")
    about = {
        "runtime": "onnxruntime" if chosen == ONNX else "torch",
        "version": version("onnxruntime") if chosen == ONNX else torch.__version__,
        "threads": torch.get_num_threads(),
        "runtimes": least,
        "apart": apart,
    }
    return calls[chosen], about


def _in_torch(network: nn.Module, image: Tensor) -> Callable[..., Tensor]:
    fast = _Maps(copy.deepcopy(network)).to(memory_format=torch.channels_last)

    def call(*_: object) -> Tensor:
        with torch.inference_mode():
            maps: Tensor = fast(image)
        return maps

    return call


def _in_onnx_runtime(network: nn.Module, image: Tensor) -> Callable[..., Tensor]:
    """The network, exported by torch."""
    with tempfile.TemporaryDirectory() as folder, warnings.catch_warnings(), torch.no_grad():
        warnings.simplefilter("ignore")  # of the tracer, about checks of the input, and of the exporter's age
        path = str(Path(folder, "network.onnx"))
        torch.onnx.export(_Maps(network), (image,), path, dynamo=False)
        session = open_session(path, torch.get_num_threads(), ("CPUExecutionProvider",))
    feeds = {session.get_inputs()[0].name: image.numpy()}
    return lambda *_: torch.from_numpy(session.run(None, feeds)[0])

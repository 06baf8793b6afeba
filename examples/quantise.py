"""Quantisation of a network to an int8 graph for ONNX Runtime."""

from __future__ import annotations

import logging
import warnings
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import torch
from torch import Tensor, nn

from ufmstar_torch.frames.prediction import DepthPrediction
from ufmstar_torch.models.inference import Inference
from ufmstar_torch.models.network import DepthNetwork
from ufmstar_torch.models.onnx_network import OnnxNetwork, OnnxSpec
from ufmstar_torch.models.outputs import METRIC, OutputSpec
from ufmstar_torch.runtime.optional import optional

_IMAGE, _DEPTH, _VARIANCE = "image", "depth", "aleatoric_variance"


def quantise(network: DepthNetwork, images: Iterable[Tensor], path: Path, *, threads: int = 0) -> OnnxNetwork:
    """Write a network as a graph with int8 weights (a scale per channel) and uint8 activations, and open it.

    Args:
        network: on the CPU, in eval mode; predicts depth and possibly an aleatoric variance. Batch norms of FastDepth
            are folded first: quantised separately, they would change the depth by a sixth.
        images: outputs [1, 3, h, w] of ``network.preprocess``, to calibrate the ranges of the activations.
        path: the .onnx file to write.
        threads: as in :class:`OnnxNetwork`.

    Raises:
        ModuleNotFoundError: ``onnx`` or ``onnxruntime`` is not installed (extra ``models``).
        ValueError: no images.
    """
    optional("onnx", "quantising needs the package onnx", "'ufmstar-torch[models]'")
    tools = optional("onnxruntime.quantization", "quantising needs onnxruntime", "'ufmstar-torch[models]'")
    samples, network = list(images), Inference().ready(network, path.with_suffix(""), torch.device("cpu"))
    if not samples:
        raise ValueError("images must hold at least one input of the network")

    with TemporaryDirectory() as folder, _quiet():
        plain = Path(folder) / "float.onnx"
        names = _export(network, samples[0], plain)
        how = {"activation_type": tools.QuantType.QUInt8, "weight_type": tools.QuantType.QInt8, "per_channel": True}
        tools.quantize_static(plain, path, _Samples(samples), quant_format=tools.QuantFormat.QDQ, **how)
    outputs = OutputSpec(METRIC, _DEPTH, aleatoric=_VARIANCE if _VARIANCE in names else None)
    return OnnxNetwork(path, OnnxSpec(outputs, network.preprocess), threads=threads)


class _Samples:
    """onnxruntime's ``CalibrationDataReader`` over the network's inputs."""

    def __init__(self, inputs: Iterable[Tensor]) -> None:
        self._inputs = iter(inputs)

    def get_next(self) -> dict[str, Any] | None:
        """The next input by its name; None at the end."""
        x = next(self._inputs, None)
        return None if x is None else {_IMAGE: x.numpy()}


class _Maps(nn.Module):
    """The network with a tuple of maps [1, 1, h, w] as its output."""

    def __init__(self, network: DepthNetwork) -> None:
        super().__init__()
        self.network = network

    def forward(self, image: Tensor) -> tuple[Tensor, ...]:
        return tuple(value[:, None] for value in _maps(self.network(image)).values())


def _maps(prediction: DepthPrediction) -> dict[str, Tensor]:
    maps = {_DEPTH: prediction.depth, _VARIANCE: prediction.aleatoric_variance}
    return {name: value for name, value in maps.items() if value is not None}


def _export(network: DepthNetwork, image: Tensor, path: Path) -> list[str]:
    """Write the float graph. Returns the names of its outputs."""
    with torch.no_grad():
        names = list(_maps(network(image)))
        torch.onnx.export(_Maps(network), (image,), path, dynamo=False, input_names=[_IMAGE], output_names=names)
    return names


@contextmanager
def _quiet() -> Iterator[None]:
    """Suppress the exporter's warnings about tracing and deprecation, and the quantiser's advice to simplify the
    graph."""
    root, level = logging.getLogger(), logging.getLogger().level
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        root.setLevel(logging.ERROR)
        try:
            yield
        finally:
            root.setLevel(level)

"""A depth network in a TensorFlow Lite file, possibly quantised, run by LiteRT (``pip install ai-edge-litert``).

network = LiteRTNetwork("fastdepth_int8.tflite", {"outputs": {"kind": "metric"}})
model = UncertainDepth(network)
"""

from __future__ import annotations

from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from ufmstar_torch.frames.prediction import DepthPrediction
from ufmstar_torch.models.network import DeclaredNetwork, require_image
from ufmstar_torch.models.outputs import PlainSpec, ProgramSpec


class LiteRTNetwork(DeclaredNetwork):
    """A .tflite file as a module, on the CPU and without gradients; quantised tensors are converted by the scale and
    zero point in the file.

    Args:
        path: the .tflite file, with one image [1, H, W, 3] or [1, 3, H, W] as input.
        spec: declarations that the file does not contain: a :class:`ProgramSpec`, its plain values or a JSON file.
            Without ``preprocess``, the image in [0, 1] is stretched to H x W.
        threads: of the CPU; 0 = LiteRT's default.

    Raises:
        ModuleNotFoundError: ``ai-edge-litert`` is not installed.
        FileNotFoundError: there is no such file.
        ValueError: the file is damaged, or spec and file do not match.
    """

    def __init__(self, path: str | Path, spec: ProgramSpec | PlainSpec | None = None, *, threads: int = 0) -> None:
        super().__init__()
        declared = ProgramSpec.required(spec)
        self.path, self.outputs, self.threads = str(path), declared.outputs, threads
        if declared.takes_intrinsics:
            raise ValueError(f"{path}: takes_intrinsics is not supported for .tflite files")
        self._open()
        self.preprocess = self.sized(declared.preprocess, self.size)

    def _open(self) -> None:
        """Create an interpreter, and look up the input and the declared outputs."""
        runtime = import_module("ai_edge_litert.interpreter")
        if not Path(self.path).is_file():
            raise FileNotFoundError(f"no .tflite file {self.path}")
        try:
            self.interpreter = runtime.Interpreter(self.path, num_threads=self.threads or None)
            self.interpreter.allocate_tensors()
        except (ValueError, RuntimeError) as error:
            raise ValueError(f"{self.path} is not a file that LiteRT can run: {error}") from error
        inputs = self.interpreter.get_input_details()
        shape = tuple(int(side) for side in inputs[0]["shape"])
        self.channels_last = shape[-1] == 3
        if len(inputs) != 1 or len(shape) != 4 or shape[0] != 1 or 3 not in (shape[1], shape[3]):
            expected = "one input [1, H, W, 3] or [1, 3, H, W]"
            raise ValueError(f"{self.path}: expected {expected}, got {len(inputs)} of {shape}")
        self.input, kind = inputs[0], np.dtype(inputs[0]["dtype"])
        if not (kind.kind == "f" or kind == np.uint8 or self.input["quantization"][0]):
            raise ValueError(f"{self.path}: the input is {kind}, expected floats, bytes or a quantised type")
        self.size = (shape[1], shape[2]) if self.channels_last else (shape[2], shape[3])
        self.details = {one["name"]: one for one in self.interpreter.get_output_details()}
        if absent := [name for name in self.outputs.names() if name not in self.details]:
            raise ValueError(f"{self.path}: the outputs are {list(self.details)}; it has no {absent}")

    def forward(self, image: Tensor, intrinsics: Tensor | None = None) -> DepthPrediction:
        """Depth [B, H, W] [m], on the image's device, of the output ``image`` [B, 3, H, W] of ``preprocess``. Raises
        ValueError: another size, or an output contradicts the declaration."""
        if require_image(image) != self.size:
            raise ValueError(f"{self.path}: the input has {self.size} px, got {tuple(image.shape[-2:])}")
        array = image.detach().cpu().float()
        array = array.permute(0, 2, 3, 1) if self.channels_last else array
        runs = [self._run(one) for one in array.numpy()]
        maps = {name: torch.cat([run[name] for run in runs]).to(image.device) for name in self.details}
        return self.declared(maps, image, intrinsics)

    def _run(self, image: NDArray[np.float32]) -> dict[str, Tensor]:
        scale, zero = self.input["quantization"]
        dtype = np.dtype(self.input["dtype"])
        if dtype.kind != "f":
            limits = np.iinfo(dtype)
            image = (image / (scale or 1) + zero).round().clip(limits.min, limits.max)
        self.interpreter.set_tensor(self.input["index"], image[None].astype(dtype))
        self.interpreter.invoke()
        outputs: dict[str, Tensor] = {}
        for name, details in self.details.items():
            value = torch.from_numpy(np.atleast_1d(self.interpreter.get_tensor(details["index"])).astype(np.float32))
            scale, zero = details["quantization"]
            outputs[name] = (value - zero) * scale if scale else value
        return outputs

    def __getstate__(self) -> dict[str, Any]:
        # An interpreter cannot be copied or pickled; the copy creates one from the same file.
        unsaved = ("interpreter", "input", "details")
        return {key: value for key, value in self.__dict__.items() if key not in unsaved}

    def __setstate__(self, state: dict[str, Any]) -> None:
        super().__setstate__(state)
        self._open()

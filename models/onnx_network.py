"""Any depth network that was exported to ONNX, run by ONNX Runtime.

What the graph states (names, sizes, types, a fixed batch) is read from it; what it cannot state (how the
input is scaled, in which unit the output is) is declared by an :class:`OnnxSpec`, in JSON for instance::

    {"preprocess": {"resize_height": 250, "crop": [228, 304], "size": [224, 224]},
     "outputs": {"kind": "metric", "scale": 1.0}}
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from torch import Tensor

from ufmstar_torch.models.network import DepthNetwork
from ufmstar_torch.models.outputs import OutputSpec
from ufmstar_torch.models.preprocess import Preprocess
from ufmstar_torch.prediction import DepthPrediction

if TYPE_CHECKING:
    from onnxruntime import InferenceSession

_NUMPY_TYPES = {
    "tensor(float)": np.float32,
    "tensor(float16)": np.float16,
    "tensor(double)": np.float64,
    "tensor(uint8)": np.uint8,
}
_ERRORS_ONLY = 3  # ONNX Runtime's severity; below it, it reports every unused weight of a file


@dataclass(frozen=True)
class OnnxSpec:
    """What an ONNX file does not say about itself.

    Attributes:
        outputs: which output is depth, in which unit; and the variances, if any.
        preprocess: what the input needs; None: the image in [0, 1], stretched to the graph's size if that
            is fixed. A fixed size of the graph is taken over where ``preprocess.size`` is None.
        input: name of the image input; None where the graph has only one.
        layout: "NCHW" or "NHWC", of the input.
        channels: "rgb" or "bgr"; ``preprocess``'s mean and std are R, G, B in either case.

    Raises:
        ValueError: a field is out of range.
    """

    outputs: OutputSpec
    preprocess: Preprocess | None = None
    input: str | None = None
    layout: str = "NCHW"
    channels: str = "rgb"

    def __post_init__(self) -> None:
        if not isinstance(self.outputs, OutputSpec):
            raise ValueError(f"OnnxSpec.outputs must be an OutputSpec, got {type(self.outputs).__name__}")
        if isinstance(self.outputs.depth, int):
            raise ValueError(f"OnnxSpec.outputs must name ONNX outputs, got position {self.outputs.depth}")
        if self.layout not in ("NCHW", "NHWC"):
            raise ValueError(f"OnnxSpec.layout must be 'NCHW' or 'NHWC', got {self.layout!r}")
        if self.channels not in ("rgb", "bgr"):
            raise ValueError(f"OnnxSpec.channels must be 'rgb' or 'bgr', got {self.channels!r}")

    @classmethod
    def from_dict(cls, values: Mapping[str, Any]) -> OnnxSpec:
        """From JSON's plain values.

        Raises:
            ValueError: an unknown key, no ``outputs``, or a field out of range.
        """
        known = {f.name for f in fields(cls)}
        if unknown := sorted(set(values) - known):
            raise ValueError(f"an ONNX spec has no {unknown}; it has {sorted(known)}")
        plain = dict(values)
        if not isinstance(plain.get("outputs"), Mapping):
            raise ValueError("an ONNX spec must declare its outputs, as {'outputs': {'kind': 'metric', ...}}")
        plain["outputs"] = OutputSpec.from_dict(plain["outputs"])
        if plain.get("preprocess") is not None:
            plain["preprocess"] = Preprocess.from_dict(plain["preprocess"])
        return cls(**plain)

    @classmethod
    def from_json(cls, path: str | Path) -> OnnxSpec:
        """From a JSON file.

        Raises:
            FileNotFoundError: there is no such file.
            ValueError: not JSON, or as :meth:`from_dict`; the message names the file.
        """
        values = read_json(path)
        try:
            return cls.from_dict(values)
        except ValueError as error:
            raise ValueError(f"{path}: {error}") from error


def read_json(path: str | Path) -> dict[str, Any]:
    """The object in a JSON file.

    Raises:
        FileNotFoundError: there is no such file.
        ValueError: it is not JSON, or not an object; the message names the file.
    """
    try:
        values = json.loads(Path(path).read_text(encoding="utf-8"))
    except ValueError as error:
        raise ValueError(f"{path} is not JSON: {error}") from error
    if not isinstance(values, dict):
        raise ValueError(f"{path} must hold a JSON object, got {type(values).__name__}")
    return values


class OnnxNetwork(DepthNetwork):
    """An ONNX depth network as a module; no gradients, and the computation runs where ONNX Runtime does.

    Args:
        path: the .onnx file.
        spec: what the file does not say.
        threads: CPU threads of one run; 0 leaves it to ONNX Runtime.
        providers: ONNX Runtime's execution providers in order of preference.

    Raises:
        ModuleNotFoundError: ``onnxruntime`` is not installed (extra ``models``).
        FileNotFoundError: there is no such file.
        ValueError: the file is broken, or spec and graph do not fit; the message names the tensor.
    """

    def __init__(
        self,
        path: str | Path,
        spec: OnnxSpec,
        *,
        threads: int = 0,
        providers: Sequence[str] = ("CPUExecutionProvider",),
    ) -> None:
        super().__init__()
        self.path, self.spec = str(path), spec
        self.threads, self.providers = threads, tuple(providers)
        self._open()
        self.preprocess = self._fitted_preprocess(spec.preprocess or Preprocess())

    def _open(self) -> None:
        """Start a session and check the spec's names against the graph."""
        self.session = _session(self.path, self.threads, self.providers)
        inputs = {i.name: i for i in self.session.get_inputs()}
        name = self.spec.input
        if name is None and len(inputs) == 1:
            name = next(iter(inputs))
        if name not in inputs or len(inputs) != 1:
            raise ValueError(f"{self.path}: input {name!r} must be the graph's only input; it has {list(inputs)}")
        self.input = name
        self.input_type = inputs[name].type
        if self.input_type not in _NUMPY_TYPES:
            raise ValueError(f"{self.path}: input {name!r} is {self.input_type}, expected one of {list(_NUMPY_TYPES)}")
        shape = [d if isinstance(d, int) and d > 0 else None for d in inputs[name].shape]
        channels, self.size = _channels_and_size(shape, self.spec.layout)
        if len(shape) != 4 or channels not in (3, None):
            raise ValueError(
                f"{self.path}: input {name!r} has shape {inputs[name].shape}, expected 4 dimensions with 3 "
                f"channels in layout {self.spec.layout}"
            )
        self.batch = shape[0]
        outputs = [o.name for o in self.session.get_outputs()]
        missing = [n for n in self.spec.outputs.names() if n not in outputs]
        if missing or (self.spec.outputs.depth is None and len(outputs) != 1):
            raise ValueError(
                f"{self.path}: the graph's outputs are {outputs}; "
                + (f"it has no {missing}" if missing else "declare which one is depth")
            )
        declared = [str(n) for n in self.spec.outputs.names()]
        self.fetched = outputs if self.spec.outputs.depth is None else declared

    def _fitted_preprocess(self, preprocess: Preprocess) -> Preprocess:
        height, width = self.size
        if height is None or width is None:
            return preprocess
        if preprocess.size is None:
            return replace(preprocess, size=(height, width))
        if tuple(preprocess.size) != (height, width):
            raise ValueError(
                f"{self.path}: input {self.input!r} has a fixed size of {height} x {width} px, but the spec's "
                f"preprocess.size is {preprocess.size}"
            )
        return preprocess

    def forward(self, image: Tensor) -> DepthPrediction:
        """Depth [B, H, W] [m] on the image's device.

        Args:
            image: [B, 3, H, W] RGB as ``preprocess`` returns it.

        Raises:
            ValueError: the image does not fit the graph's input, or an output is not as declared.
        """
        self._check(image)
        array = image.detach().cpu()
        if self.spec.channels == "bgr":
            array = array.flip(1)
        if self.spec.layout == "NHWC":
            array = array.permute(0, 2, 3, 1)
        runs = [self._run(np.ascontiguousarray(part.numpy())) for part in array.split(self.batch or max(len(array), 1))]
        outputs: dict[str | int, Tensor] = {
            name: torch.cat([run[i] for run in runs]).to(image.device) for i, name in enumerate(self.fetched)
        }
        prediction = self.spec.outputs.prediction(outputs, (image.shape[-2], image.shape[-1]))
        if len(prediction.depth) != len(image):
            raise ValueError(
                f"{self.path}: the depth output holds {len(prediction.depth)} maps for {len(image)} images"
            )
        return prediction

    def _check(self, image: Tensor) -> None:
        height, width = self.size
        fits = image.dim() == 4 and image.shape[1] == 3 and torch.is_floating_point(image)
        fits = fits and height in (None, image.shape[-2]) and width in (None, image.shape[-1])
        if not fits:
            raise ValueError(
                f"{self.path}: the image for input {self.input!r} must be floating-point [B, 3, {height or 'H'}, "
                f"{width or 'W'}], got {image.dtype} {tuple(image.shape)}"
            )
        if self.batch and len(image) % self.batch:
            raise ValueError(
                f"{self.path}: input {self.input!r} has a fixed batch of {self.batch}, which must divide the "
                f"number of images, got {len(image)}"
            )

    def _run(self, array: np.ndarray[Any, Any]) -> list[Tensor]:
        dtype = _NUMPY_TYPES[self.input_type]
        if dtype is np.uint8:
            array = array.round().clip(0, 255)
        results = self.session.run(self.fetched, {self.input: array.astype(dtype, copy=False)})
        return [torch.from_numpy(np.asarray(value)).to(torch.float32) for value in results]

    def __getstate__(self) -> dict[str, Any]:
        # A session cannot be copied or pickled; the copy opens its own from the same file.
        return {key: value for key, value in self.__dict__.items() if key != "session"}

    def __setstate__(self, state: dict[str, Any]) -> None:
        super().__setstate__(state)
        self._open()


def _session(path: str, threads: int, providers: tuple[str, ...]) -> InferenceSession:
    try:
        import onnxruntime as ort
        from onnxruntime.capi import onnxruntime_pybind11_state as ort_errors
    except ModuleNotFoundError as error:
        raise ModuleNotFoundError(
            "running an ONNX network needs the package onnxruntime: pip install 'ufmstar-torch[models]'"
        ) from error
    if not Path(path).is_file():
        raise FileNotFoundError(f"no ONNX file {path}")
    if absent := [p for p in providers if p not in ort.get_available_providers()]:
        raise ValueError(f"providers {absent} are not available; this ONNX Runtime has {ort.get_available_providers()}")
    options = ort.SessionOptions()
    options.intra_op_num_threads = threads
    options.log_severity_level = _ERRORS_ONLY
    refusals = (ort_errors.InvalidProtobuf, ort_errors.InvalidGraph, ort_errors.InvalidArgument)
    failures = (ort_errors.Fail, ort_errors.NotImplemented)
    try:
        return ort.InferenceSession(path, options, providers=list(providers))
    except (*refusals, *failures) as error:
        raise ValueError(f"{path} is not an ONNX file that ONNX Runtime can run: {error}") from error


def _channels_and_size(shape: Sequence[int | None], layout: str) -> tuple[int | None, tuple[int | None, int | None]]:
    if len(shape) != 4:
        return None, (None, None)
    channels, height, width = (shape[1], shape[2], shape[3]) if layout == "NCHW" else (shape[3], shape[1], shape[2])
    return channels, (height, width)

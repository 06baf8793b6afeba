"""Any depth network that was exported to ONNX, run by ONNX Runtime.

Names, sizes, types and a fixed batch are read from the graph. An :class:`OnnxSpec` declares the scale of the input and
the unit of the output, which a graph does not contain.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from torch import Tensor

from ufmstar_torch.frames.prediction import DepthPrediction
from ufmstar_torch.models.network import DeclaredNetwork, require_image
from ufmstar_torch.models.onnx_sizes import require_sizes
from ufmstar_torch.models.outputs import PlainSpec, ProgramSpec
from ufmstar_torch.models.preprocess import Preprocess
from ufmstar_torch.runtime.checked import choice
from ufmstar_torch.runtime.kinds import check_kinds
from ufmstar_torch.runtime.optional import optional

if TYPE_CHECKING:
    from onnxruntime import InferenceSession, NodeArg

_NUMPY_TYPES = {
    "tensor(float)": np.float32,
    "tensor(float16)": np.float16,
    "tensor(double)": np.float64,
    "tensor(uint8)": np.uint8,
}
_FLOATS = [name for name, kind in _NUMPY_TYPES.items() if kind is not np.uint8]
_ERRORS_ONLY = 3  # ONNX Runtime's severity; a lower one logs every unused weight of a file


@dataclass(frozen=True)
class OnnxSpec(ProgramSpec):
    """Declarations that an ONNX file does not contain.

    Attributes:
        outputs: as in :class:`ProgramSpec`, with outputs by name.
        preprocess: preprocessing of the input; None: the image in [0, 1], stretched to the graph's size if that is
            fixed. ``preprocess.size`` None = a fixed size of the graph.
        input: name of the image input; None: the graph has only one. With ``takes_intrinsics``, the second input is
            that of the intrinsics [B, 3, 3] [px].
        layout: "NCHW" or "NHWC", of the input.
        channels: "rgb" or "bgr"; mean and std of ``preprocess`` are R, G, B in either case.

    Raises:
        ValueError: a field is out of range.
    """

    input: str | None = None
    layout: str = choice("NCHW", "NHWC")
    channels: str = choice("rgb", "bgr")

    def __post_init__(self) -> None:
        super().__post_init__()
        if isinstance(self.outputs.depth, int):
            raise ValueError(f"OnnxSpec.outputs must name ONNX outputs, got position {self.outputs.depth}")


class OnnxNetwork(DeclaredNetwork):
    """An ONNX depth network as a module, without gradients; ``providers`` determine the device of the computation.

    Args:
        path: the .onnx file.
        spec: declarations that the file does not contain: an :class:`OnnxSpec`, its plain values or a JSON file.
        threads: CPU threads of one run; 0 = ONNX Runtime's default. They do not spin between two runs.
        providers: ONNX Runtime's execution providers in order of preference.

    Raises:
        ModuleNotFoundError: ``onnxruntime`` is not installed (extra ``models``).
        FileNotFoundError: there is no such file.
        ValueError: the file is damaged, or spec and graph do not match; the message names the tensor.
    """

    @check_kinds
    def __init__(
        self,
        path: str | Path,
        spec: OnnxSpec | PlainSpec | None = None,
        *,
        threads: int = 0,
        providers: Sequence[str] = ("CPUExecutionProvider",),
    ) -> None:
        super().__init__()
        self.path, self.spec = str(path), OnnxSpec.required(spec)
        self.outputs = self.spec.outputs
        self.threads, self.providers = threads, tuple(providers)
        self._open()
        height, width = self.size
        if height is None or width is None:
            self.preprocess = self.spec.preprocess or Preprocess()
        else:
            self.preprocess = self.sized(self.spec.preprocess, (height, width))

    def _open(self) -> None:
        """Create a session, and check the spec's names against the graph."""
        self.session = open_session(self.path, self.threads, self.providers)
        inputs = {i.name: i for i in self.session.get_inputs()}
        name = self.spec.input
        if name is None and len(inputs) == 1:
            name = next(iter(inputs))
        self.K_input = self._intrinsics_input(name, inputs)
        assert name is not None  # one of the inputs
        self.input, self.input_type = name, inputs[name].type
        if self.input_type not in _NUMPY_TYPES:
            raise ValueError(f"{self.path}: input {name!r} is {self.input_type}, expected one of {list(_NUMPY_TYPES)}")
        shape, order = _fixed(inputs[name]), (0, 1, 2, 3) if self.spec.layout == "NCHW" else (0, 3, 1, 2)
        if len(shape) != 4 or shape[order[1]] not in (3, None):
            raise ValueError(
                f"{self.path}: input {name!r} has shape {inputs[name].shape}, expected 4 dimensions with 3 "
                f"channels in layout {self.spec.layout}"
            )
        self.batch, _, *self.size = (shape[i] for i in order)
        outputs = [o.name for o in self.session.get_outputs()]
        declared = [str(n) for n in self.outputs.names()]
        missing = [n for n in declared if n not in outputs]
        if missing or (self.outputs.depth is None and len(outputs) != 1):
            fault = f"it has no {missing}" if missing else "declare which one is depth"
            raise ValueError(f"{self.path}: the graph's outputs are {outputs}; {fault}")
        self.fetched = outputs if self.outputs.depth is None else declared

    def _intrinsics_input(self, name: str | None, inputs: Mapping[str, NodeArg]) -> tuple[str, Any] | None:
        """Name and NumPy type of the graph's second input, the intrinsics [B, 3, 3]; None: the image is its only
        input."""
        rest = [i for other, i in inputs.items() if other != name]
        if name in inputs and not rest and not self.spec.takes_intrinsics:
            return None
        if not self.spec.takes_intrinsics:
            raise ValueError(
                f"{self.path}: input {name!r} must be the graph's only input; it has {list(inputs)} "
                "(a second one for the intrinsics needs takes_intrinsics)"
            )
        if name not in inputs or len(rest) != 1:
            raise ValueError(
                f"{self.path}: takes_intrinsics needs two inputs, the image (the spec's input names it, got {name!r}) "
                f"and the intrinsics; the graph has {list(inputs)}"
            )
        shape = _fixed(rest[0])
        if len(shape) != 3 or {*shape[1:]} - {3, None} or rest[0].type not in _FLOATS:
            raise ValueError(
                f"{self.path}: input {rest[0].name!r} must be floating-point intrinsics [B, 3, 3], got {rest[0].type} "
                f"{rest[0].shape}"
            )
        return rest[0].name, _NUMPY_TYPES[rest[0].type]

    @property
    def takes_intrinsics(self) -> bool:
        """True if the graph takes intrinsics, or the unit of its depth depends on the focal length."""
        return self.K_input is not None or super().takes_intrinsics

    def forward(self, image: Tensor, intrinsics: Tensor | None = None) -> DepthPrediction:
        """Depth [B, H, W] [m], on the image's device, of the output ``image`` [B, 3, H, W] of ``preprocess``, with
        ``intrinsics`` [B, 3, 3] [px] if the graph takes them. Raises ValueError: the image does not fit the graph's
        input, the intrinsics are missing, or an output contradicts the declaration."""
        self._require_fit(image)
        if self.takes_intrinsics and intrinsics is None:
            raise ValueError(f"{self.path} takes intrinsics: call network(x, K), K [B, 3, 3] of its input x")
        array = image.detach().cpu()
        if self.spec.channels == "bgr":
            array = array.flip(1)
        if self.spec.layout == "NHWC":
            array = array.permute(0, 2, 3, 1)
        size = self.batch or max(len(array), 1)
        cameras = [None] * -(-len(array) // size)
        if self.K_input is not None and intrinsics is not None:
            cameras = intrinsics.detach().cpu().expand(len(array), 3, 3).split(size)
        runs = [self._run(part.contiguous(), K) for part, K in zip(array.split(size), cameras, strict=True)]
        outputs = {name: torch.cat([run[i] for run in runs]).to(image.device) for i, name in enumerate(self.fetched)}
        return self.declared(outputs, image, intrinsics)

    def _require_fit(self, image: Tensor) -> None:
        height, width = require_image(image)
        if self.size[0] not in (None, height) or self.size[1] not in (None, width):
            fixed = " x ".join(str(side or "any") for side in self.size)
            raise ValueError(f"{self.path}: input {self.input!r} has a fixed size of {fixed}, got {height} x {width}")
        if self.batch and len(image) % self.batch:
            raise ValueError(
                f"{self.path}: input {self.input!r} has a fixed batch of {self.batch}, which must divide the "
                f"number of images, got {len(image)}"
            )

    def _run(self, image: Tensor, K: Tensor | None) -> list[Tensor]:
        dtype, array = _NUMPY_TYPES[self.input_type], image.numpy()
        if dtype is np.uint8:
            array = array.round().clip(0, 255)
        feeds = {self.input: array.astype(dtype, copy=False)}
        if self.K_input is not None and K is not None:
            feeds[self.K_input[0]] = K.numpy().astype(self.K_input[1])
        try:
            results = self.session.run(self.fetched, feeds)
        except _runtime_errors() as error:
            shapes = {name: value.shape for name, value in feeds.items()}
            raise ValueError(
                f"{self.path}: a node fails when ONNX Runtime runs the graph on {shapes}: {error}; if the graph needs "
                "another size of image, declare it as the spec's preprocess.size"
            ) from error
        if wrong := [name for name, value in zip(self.fetched, results, strict=True) if not _numbers(value)]:
            raise ValueError(f"{self.path}: the outputs {wrong} are no tensors of numbers")
        return [torch.from_numpy(np.atleast_1d(value).astype(np.float32, copy=False)) for value in results]

    def __getstate__(self) -> dict[str, Any]:
        # A session cannot be copied or pickled; the copy creates one from the same file.
        return {key: value for key, value in self.__dict__.items() if key != "session"}

    def __setstate__(self, state: dict[str, Any]) -> None:
        super().__setstate__(state)
        self._open()


def open_session(path: str, threads: int, providers: tuple[str, ...]) -> InferenceSession:
    """A session on a file; arguments and errors as :class:`OnnxNetwork`."""
    ort = _onnxruntime()
    if not Path(path).is_file():
        raise FileNotFoundError(f"no ONNX file {path}")
    if absent := [p for p in providers if p not in ort.get_available_providers()]:
        raise ValueError(f"providers {absent} are not available; this ONNX Runtime has {ort.get_available_providers()}")
    require_sizes(path)
    options = ort.SessionOptions()
    options.intra_op_num_threads = threads
    # Spinning threads would occupy the cores between two runs.
    options.add_session_config_entry("session.intra_op.allow_spinning", "0")
    options.log_severity_level = _ERRORS_ONLY
    try:
        return ort.InferenceSession(path, options, providers=list(providers))
    except _runtime_errors() as error:
        raise ValueError(f"{path} is not an ONNX file that ONNX Runtime can run: {error}") from error


def providers_for(device: torch.device) -> tuple[str, ...]:
    """ONNX Runtime's execution providers for a device, the preferred one first; only the CPU's if there is no other.
    Raises ModuleNotFoundError: ``onnxruntime`` is not installed (extra ``models``)."""
    available, cpu, gpu = _onnxruntime().get_available_providers(), "CPUExecutionProvider", "CUDAExecutionProvider"
    return (gpu, cpu) if device.type == "cuda" and gpu in available else (cpu,)


def _onnxruntime() -> Any:
    need = "running an ONNX network needs the package onnxruntime"
    return optional("onnxruntime", need, "'ufmstar-torch[models]'")


def _runtime_errors() -> tuple[type[Exception], ...]:
    """Exceptions of ONNX Runtime for a graph that it cannot load or run; they have no common base class."""
    from onnxruntime.capi import onnxruntime_pybind11_state as state

    names = ("InvalidProtobuf", "InvalidGraph", "InvalidArgument", "Fail", "NotImplemented", "RuntimeException")
    return UnicodeDecodeError, *(getattr(state, name) for name in names)


def _numbers(value: object) -> bool:
    return isinstance(value, np.ndarray) and value.dtype.kind in "fiu"


def _fixed(node: NodeArg) -> list[int | None]:
    """The sides of an input's shape, None where the graph does not fix one."""
    return [side if isinstance(side, int) and side > 0 else None for side in node.shape]

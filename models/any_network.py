"""Wrappers of any network (an ``nn.Module``, a function, a saved program) that return a ``DepthPrediction``."""

from __future__ import annotations

import functools
import inspect
from collections.abc import Callable, Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any
from zipfile import BadZipFile

import torch
from torch import Tensor, nn

from ufmstar_torch.frames.prediction import DepthPrediction, infer, require_switchable
from ufmstar_torch.frames.prediction import takes_intrinsics as declares_intrinsics
from ufmstar_torch.frames.warnings import LOGGER
from ufmstar_torch.models.hugging_face import from_hugging_face, of_transformers
from ufmstar_torch.models.network import DeclaredNetwork, DepthNetwork
from ufmstar_torch.models.outputs import METRIC, OutputSpec, PlainSpec, ProgramSpec, Spread
from ufmstar_torch.models.preprocess import Preprocess
from ufmstar_torch.runtime.kinds import require

# Programs in files, by name of the network (``load_network``), and what their format can do.
PROGRAMS = {
    "exported": "a torch.export file (.pt2) holds pickled objects, which run any code when they are loaded",
    "torchscript": "a TorchScript file is a program, which can write any file when it runs",
}


class WrappedNetwork(DeclaredNetwork):
    """A network with an :class:`OutputSpec`, which declares its outputs; made by :func:`wrap_network`."""

    def __init__(
        self,
        network: Callable[..., Any],
        outputs: OutputSpec,
        preprocess: Preprocess,
        takes_intrinsics: bool = False,
        path: str = "",
    ) -> None:
        super().__init__()
        self.network = network
        self.outputs, self.preprocess, self.path = outputs, preprocess, path
        self._passes_intrinsics = takes_intrinsics or declares_intrinsics(network)

    @property
    def wrapped(self) -> tuple[Any]:
        """The network."""
        return (self.network,)

    @property
    def takes_intrinsics(self) -> bool:
        """True if the network takes intrinsics, or the unit of its depth depends on the focal length."""
        return self._passes_intrinsics or super().takes_intrinsics

    def forward(self, image: Tensor, intrinsics: Tensor | None = None) -> DepthPrediction:
        """Depth [B, H, W] [m] of the output ``image`` [B, 3, H, W] of ``preprocess``, with ``intrinsics`` [B, 3, 3]
        [px] if the network takes them. Raises ValueError: the network's output contradicts the declaration, a program
        does not accept the image, or the intrinsics are missing."""
        if not isinstance(image, Tensor):
            expected = "image must be a tensor [B, 3, H, W] as network.preprocess(image, intrinsics) returns it"
            raise TypeError(f"{expected}, got {type(image).__name__}; UncertainDepth takes pictures as they are")
        try:
            result = infer(self.network, image, intrinsics, takes=self._passes_intrinsics)
        except (AssertionError, RuntimeError, TypeError, ValueError) as error:  # a program may raise any of these
            if not self.path or isinstance(error, torch.OutOfMemoryError):
                raise
            inputs = f"{image.dtype} {tuple(image.shape)}{' and K' if self._passes_intrinsics else ''}"
            raise ValueError(
                f"{self.path} fails on {inputs}: {error}; if it needs another input, declare its size in the spec's "
                "preprocess, and intrinsics as a second input by takes_intrinsics, or export it for this input"
            ) from error
        return result if isinstance(result, DepthPrediction) else self.declared(result, image, intrinsics)


def refuse_relative(network: object) -> None:
    """Raise a ValueError for MiDaS (from ``torch.hub``), whose relative depth has the same form as metric depth."""
    if type(network).__module__.partition(".")[0] == "midas":
        raise ValueError(
            f"network is MiDaS ({type(network).__name__}), which predicts inverse depth up to scale and shift, not "
            "metres: use a metric network, or align it to measured depth (ufmstar_torch.models.AlignedNetwork)"
        )


def _warn_of_training(network: Callable[..., Any]) -> None:
    """Warn if a function uses a module in training mode, which UncertainDepth cannot set to eval mode."""
    if isinstance(network, nn.Module):
        return
    function = network.func if isinstance(network, functools.partial) else network
    used = [getattr(function, "__self__", None)]
    if inspect.isfunction(function):
        with suppress(ValueError):  # a variable that is not yet assigned
            closure = inspect.getclosurevars(function)
            used += [*closure.nonlocals.values(), *closure.globals.values()]
    for module in (one for one in used if isinstance(one, nn.Module) and one.training):
        LOGGER.warning(
            "the function given as network uses a %s in training mode, whose normalisation changes with every image: "
            "call its eval()", type(module).__name__,
        )  # fmt: skip


def wrap_network(
    network: Callable[..., Any],
    output: str | int | None = None,
    *,
    scale: float = 1.0,
    inverse: bool = False,
    aleatoric: str | int | None = None,
    aleatoric_kind: Spread = "variance",
    epistemic: str | int | None = None,
    epistemic_kind: Spread = "variance",
    confidence: str | int | None = None,
    resize: bool = False,
    focal: float | None = None,
    max_depth: float | None = None,
    takes_intrinsics: bool = False,
    preprocess: Preprocess | Any = None,
) -> DepthNetwork:
    """Wrap a custom network for UfM*.

    Args:
        network: maps an image [B, 3, H, W] to metric depth [B, 1, H, W] or [B, H, W], a mapping or an object with named
            tensors, a tuple of tensors, or a ``DepthPrediction``; NumPy arrays are accepted, too. Or a metric depth
            model or pipeline of ``transformers`` (``from_hugging_face``).
        output: the depth among several outputs: a name, or a position in a tuple.
        scale: [m] length of one unit of depth.
        inverse: declares inverse or relative depth, which raises.
        aleatoric, aleatoric_kind, epistemic, epistemic_kind, confidence, resize, focal, max_depth: as in
            :class:`OutputSpec`.
        takes_intrinsics: call the network as ``network(x, K)``, K [B, 3, 3] [px] of ``x``; an attribute
            ``takes_intrinsics = True`` of ``network`` has the same effect.
        preprocess: preprocessing of its input; None: images in [0, 1], not resized. For a model of ``transformers``,
            also its image processor; None: the pipeline's.

    Logs a warning (logger ``ufmstar_torch``) if a function uses a module in training mode.

    Raises:
        ValueError: ``inverse``, a value out of range, MiDaS, or a relative model of ``transformers``.
        TypeError: ``network`` cannot be called, does not estimate depth, or has a ``train`` that is not PyTorch's;
            ``preprocess`` has another type.
    """
    if isinstance(network, type) or not callable(network):
        raise TypeError(f"network must be an nn.Module or a function, got {_described(network)}")
    for name, value in (("inverse", inverse), ("resize", resize), ("takes_intrinsics", takes_intrinsics)):
        require(name, value, bool)
    refuse_relative(network)
    if isinstance(network, nn.Module):
        require_switchable(network)
    _warn_of_training(network)
    if of_transformers(network):
        if (
            inverse
            or resize
            or any(v is not None for v in (output, aleatoric, epistemic, confidence, focal, max_depth))
        ):
            raise ValueError("for a model of transformers, only scale, takes_intrinsics and preprocess can be declared")
        declares_preprocess = preprocess is None or isinstance(preprocess, Preprocess)
        declared: dict[str, Any] = {
            "preprocess" if declares_preprocess else "processor": preprocess,
            "takes_intrinsics": takes_intrinsics,
        }
        return from_hugging_face(network, kind=METRIC, scale=scale, **declared)
    if preprocess is not None and not isinstance(preprocess, Preprocess):
        raise TypeError(f"preprocess must be a Preprocess or None, got {_described(preprocess)}")
    kind, spreads = "inverse" if inverse else METRIC, (aleatoric, aleatoric_kind, epistemic, epistemic_kind)
    spec = OutputSpec(kind, output, scale, *spreads, confidence, resize, focal, max_depth)
    return WrappedNetwork(network, spec, preprocess or Preprocess(), takes_intrinsics)


def _described(value: object) -> str:
    """Describe an argument that is no network or preprocessing, and the remedy, for an error message."""
    if isinstance(value, type):
        return f"the class {value.__name__}: pass an instance, {value.__name__}(...)"
    if isinstance(value, str | Path):
        return f"{type(value).__name__} {str(value)!r}: load it, as load_network(name, weights) or from_hugging_face do"
    if isinstance(value, Mapping):
        return f"{type(value).__name__}: weights need their network, network.load_state_dict(weights)"
    several = "; several networks are a list of wrapped ones" if isinstance(value, list | tuple) else ""
    return type(value).__name__ + several


def load_torchscript(
    path: str | Path, spec: ProgramSpec | PlainSpec | None = None, *, trust_code: bool = False
) -> WrappedNetwork:
    """Load a TorchScript file (``torch.jit.save``) as a network, on the CPU.

    Args:
        path: the file.
        spec: a :class:`ProgramSpec`, its plain values or a JSON file.
        trust_code: True allows the file to run its code. Set it only for a file whose origin you trust.

    Raises:
        FileNotFoundError: there is no such file.
        ValueError: ``trust_code`` is not set, it is not a TorchScript file, or the spec is missing or invalid.
    """
    declared = ProgramSpec.required(spec)
    program_file = _trusted("torchscript", path, trust_code)
    try:
        program = torch.jit.load(program_file, map_location="cpu")
    except RuntimeError as error:
        raise ValueError(f"{path} is not a readable TorchScript file: {error}") from error
    return _wrapped(program.eval(), declared, path)


def load_exported(
    path: str | Path, spec: ProgramSpec | PlainSpec | None = None, *, trust_code: bool = False
) -> WrappedNetwork:
    """Load a ``torch.export`` file (``torch.export.save``, .pt2) as a network; arguments and errors as
    :func:`load_torchscript`."""
    declared = ProgramSpec.required(spec)
    program_file = _trusted("exported", path, trust_code)
    try:
        with open(program_file, "rb") as file:  # a name would have to end in .pt2
            program = torch.export.load(file).module()
    except (RuntimeError, ValueError, LookupError, TypeError, AttributeError, BadZipFile) as error:
        raise ValueError(
            f"{path} is not a readable torch.export file: {error}; expected a file of torch.export.save from a "
            f"compatible torch (this one is {torch.__version__}): export the network again"
        ) from error
    return _wrapped(_Exported(program), declared, path)


def _trusted(kind: str, path: str | Path, trust_code: bool) -> str:
    """The file of a program. Raises FileNotFoundError: there is no such file; ValueError: the caller does not trust
    it."""
    if not Path(path).is_file():
        raise FileNotFoundError(f"no network file {path}")
    if trust_code is not True:
        raise ValueError(
            f"{path} is not loaded: {PROGRAMS[kind]}. If you trust its origin, pass --trust-code (in Python "
            "trust_code=True); files of ONNX and safetensors cannot run code and need no trust"
        )
    return str(path)


def _wrapped(program: nn.Module, spec: ProgramSpec, path: str | Path) -> WrappedNetwork:
    return WrappedNetwork(program, spec.outputs, spec.preprocess or Preprocess(), spec.takes_intrinsics, str(path))


class _Exported(nn.Module):
    """An exported program, whose mode is fixed; ignores ``train()`` and ``eval()``, on which torch's class raises."""

    def __init__(self, program: nn.Module) -> None:
        super().__init__()
        self.program = program
        self.training = False

    def forward(self, *inputs: Tensor) -> Any:
        return self.program(*inputs)

    def train(self, mode: bool = True) -> _Exported:
        return self

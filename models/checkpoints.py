"""Reading and writing of weights: tensors only, checked key by key, written atomically.

Files are read with ``weights_only=True`` (or as safetensors), so that they cannot run code. A pickled module, as in
older repositories, raises with an explanation.
"""

from __future__ import annotations

import json
from collections.abc import Collection, Mapping, Sequence
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn

from ufmstar_torch.files.read import DAMAGE as DAMAGE
from ufmstar_torch.files.read import CheckpointError as CheckpointError
from ufmstar_torch.files.read import read_tensors
from ufmstar_torch.files.write import write_atomic
from ufmstar_torch.runtime.kinds import check_kinds
from ufmstar_torch.runtime.optional import optional

# Keys under which training programs store the weights in a checkpoint, and prefixes that wrappers add to every key.
_CONTAINERS = ("state_dict", "model_state_dict", "model")
_PREFIXES = ("module.", "_orig_mod.", "state_dict.", "model.", "network.")
_TORCH_SUFFIXES = (".pth", ".pt", ".ckpt", ".bin", ".tar")
_UNKNOWN_SUFFIX = f"{{}} must end in .safetensors or one of {', '.join(_TORCH_SUFFIXES)}"
_SHOWN = 8  # most keys in an error message


@check_kinds
def load_state_dict_file(path: str | Path, ignore: Collection[str] = ()) -> dict[str, Tensor]:
    """The weights in a file, on the CPU, by key.

    Containers ("state_dict", "model", ...) are opened, and prefixes of all keys ("module.", "model.", ...) are removed.

    Args:
        path: .pth, .pt, .ckpt, .bin, .tar (all of ``torch.save``) or .safetensors.
        ignore: keys of plain values that the file may hold in addition to weights.

    Raises:
        FileNotFoundError: there is no such file.
        CheckpointError: the file is truncated or damaged, holds pickled objects or no weights, or has another suffix.
        ModuleNotFoundError: a .safetensors file without the package safetensors.
    """
    return _without_prefixes(_read(Path(path), ignore))


def channels_of(state: Mapping[str, Tensor], keys: Sequence[str], network: str, source: object) -> tuple[int, ...]:
    """The output channels of the weights ``keys``, which determine a network's shape. Raises CheckpointError: a key is
    missing; the message names ``source``."""
    if missing := [key for key in keys if key not in state]:
        fault = f"not the weights of a {network}: no {missing[0]!r} ({len(missing)} such keys missing)"
        raise CheckpointError(f"{source}: {fault}")
    return tuple(len(state[key]) for key in keys)


def fill(module: nn.Module, state: Mapping[str, Tensor], source: str) -> None:
    """Fill a module from tensors, in place and in its dtypes (half-precision weights fill a float32 network). Raises
    CheckpointError: keys are missing or unexpected, shapes differ, or values are not finite; the message names their
    ``source``, and the module is unchanged."""
    broken = [key for key in sorted(state) if not torch.isfinite(state[key]).all()]
    require_shapes(module, {key: tuple(value.shape) for key, value in state.items()}, source, broken)
    module.load_state_dict(state, strict=True)


def require_shapes(
    module: nn.Module, shapes: Mapping[str, tuple[int, ...]], source: str, broken: Sequence[str] = ()
) -> None:
    """Compare the shapes of weights, by key, with those of a module, which may be on the device "meta" and then takes
    no memory. Raises CheckpointError: as :func:`fill`, also if there is a key of non-finite values in ``broken``."""
    expected = {key: tuple(value.shape) for key, value in module.state_dict().items()}
    both = [(key, shapes[key], expected[key]) for key in expected if key in shapes]
    faults = {
        "missing": sorted(set(expected) - set(shapes)),
        "unexpected": sorted(set(shapes) - set(expected)),
        "of another shape": [
            f"{key} is {actual}, expected {wanted}" for key, actual, wanted in both if actual != wanted
        ],
        "with NaN or infinity": list(broken),
    }
    if texts := [f"{len(keys)} {what}: {some(keys)}" for what, keys in faults.items() if keys]:
        fit = f"{source} does not fit {type(module).__name__} ({len(expected)} keys)"
        raise CheckpointError(f"{fit}: {'; '.join(texts)}")


def read_safetensors(path: str | Path, prefix: str | None = "") -> tuple[dict[str, Tensor], Any]:
    """Read the tensors of a .safetensors file whose keys begin with ``prefix`` (None: no tensors), by key without the
    prefix, and the metadata of :func:`save_checkpoint` (None if absent). Raises FileNotFoundError: there is no such
    file; CheckpointError: it is no safetensors file, truncated or damaged; ModuleNotFoundError: safetensors is not
    installed."""
    if not Path(path).is_file():
        raise FileNotFoundError(f"no file of weights {path}")
    safetensors = _safetensors("safetensors")
    try:
        with safetensors.safe_open(path, framework="pt") as file:
            names = file.keys()  # the file itself cannot be iterated over
            keys = [] if prefix is None else [name for name in names if name.startswith(prefix)]
            tensors = {key[len(prefix or "") :]: file.get_tensor(key) for key in keys}
            return tensors, json.loads((file.metadata() or {}).get("metadata", "null"))
    except (safetensors.SafetensorError, json.JSONDecodeError, RecursionError) as error:
        raise CheckpointError(f"{path} is not a readable safetensors file: {error}") from error


def safetensors_shapes(path: str | Path, prefix: str = "") -> dict[str, tuple[int, ...]]:
    """The shapes of the tensors of a .safetensors file, from its header; arguments, keys and errors as
    :func:`read_safetensors`."""
    if not Path(path).is_file():
        raise FileNotFoundError(f"no file of weights {path}")
    safetensors = _safetensors("safetensors")
    try:
        with safetensors.safe_open(path, framework="pt") as file:
            keys = [name for name in file.keys() if name.startswith(prefix)]  # noqa: SIM118 (the file is no mapping)
            return {key[len(prefix) :]: tuple(file.get_slice(key).get_shape()) for key in keys}
    except safetensors.SafetensorError as error:
        raise CheckpointError(f"{path} is not a readable safetensors file: {error}") from error


@check_kinds
def save_checkpoint(
    path: str | Path, weights: nn.Module | Mapping[str, Tensor], metadata: Mapping[str, Any] | None = None
) -> None:
    """Write weights atomically.

    Args:
        path: .safetensors, or a suffix of ``torch.save``, which writes {"state_dict", "metadata"}.
        weights: a module, or its state_dict.
        metadata: plain values (JSON) to store, such as widths and the training command.

    Raises:
        CheckpointError: another suffix.
        ModuleNotFoundError: .safetensors without the package safetensors.
    """
    path = Path(path)
    if not isinstance(weights, nn.Module) and not all(isinstance(value, Tensor) for value in weights.values()):
        raise TypeError("weights must be a module or its state_dict, tensors by name")
    state = weights.state_dict() if isinstance(weights, nn.Module) else dict(weights)
    state = {key: value.detach().cpu().contiguous() for key, value in state.items()}
    text = json.dumps(dict(metadata or {}))
    write_atomic(path, lambda file: _write(file, path, state, text), durable=True)


def _write(file: Any, path: Path, state: dict[str, Tensor], metadata: str) -> None:
    if path.suffix == ".safetensors":
        # safetensors does not allow tensors that share memory.
        separate = {key: value.clone() for key, value in state.items()}
        file.write(_safetensors("safetensors.torch").save(separate, metadata={"metadata": metadata}))
    elif path.suffix in _TORCH_SUFFIXES:
        torch.save({"state_dict": state, "metadata": json.loads(metadata)}, file)
    else:
        raise CheckpointError(_UNKNOWN_SUFFIX.format(path))


def _read(path: Path, ignore: Collection[str] = ()) -> dict[str, Tensor]:
    """The tensors of a file by its original keys, containers opened."""
    if not path.is_file():
        raise FileNotFoundError(f"no file of weights {path}")
    if path.suffix == ".safetensors":
        return read_safetensors(path)[0]
    if path.suffix not in _TORCH_SUFFIXES:
        raise CheckpointError(_UNKNOWN_SUFFIX.format(path))
    with path.open("rb") as file:
        return _weights_in(read_tensors(file, path), path, ignore)


def _weights_in(content: Any, path: Path, ignore: Collection[str]) -> dict[str, Tensor]:
    for name in _CONTAINERS:
        if isinstance(content, Mapping) and isinstance(content.get(name), Mapping):
            content = content[name]
            break
    if not isinstance(content, Mapping) or not content:
        raise CheckpointError(f"{path} holds no weights, but {type(content).__name__}")
    content = {key: value for key, value in content.items() if key not in ignore}
    if others := [k for k, value in content.items() if not isinstance(value, Tensor) or not isinstance(k, str)]:
        raise CheckpointError(f"{path} holds more than named tensors: {some(others)}")
    return dict(content)


def _without_prefixes(state: dict[str, Tensor]) -> dict[str, Tensor]:
    """Remove ``_PREFIXES`` that all keys share."""
    while prefix := next((p for p in _PREFIXES if state and all(key.startswith(p) for key in state)), None):
        state = {key.removeprefix(prefix): value for key, value in state.items()}
    return state


def some(keys: list[Any]) -> str:
    """The first keys of a list as text, and the number of further keys."""
    more = f", ... ({len(keys) - _SHOWN} more)" if len(keys) > _SHOWN else ""
    return ", ".join(str(key) for key in keys[:_SHOWN]) + more


def _safetensors(module: str) -> Any:
    return optional(module, "a .safetensors file needs the package safetensors", "safetensors")

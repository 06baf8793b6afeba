"""A checkpoint of Hugging Face's ``transformers``: its configuration, read from a directory or the hub, and its model.

``transformers`` initialises missing weights randomly; :func:`load_model` raises. A directory whose configuration states
a model much larger than its weights is refused before memory is taken.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from pickle import UnpicklingError
from typing import Any

import torch
from torch import nn

from ufmstar_torch.files.limits import MOST_BYTES
from ufmstar_torch.frames.arguments import as_path
from ufmstar_torch.models.checkpoints import DAMAGE, CheckpointError, some
from ufmstar_torch.runtime.optional import optional

MOST_LAYERS = 1000  # of a model


@dataclass(frozen=True)
class Checkpoint:
    """A checkpoint's configuration."""

    name: str  # directory or hub name
    config: dict[str, Any]  # config.json
    processor: dict[str, Any]  # preprocessor_config.json, empty if there is none
    options: dict[str, Any]  # keyword arguments of every call of ``transformers``; {} = random weights

    @property
    def model_type(self) -> str:
        """For example "depth_anything" or "dpt"."""
        return str(self.config.get("model_type"))

    @property
    def patch(self) -> int:
        """[px] required divisor of the input's sides: the patch of a vision transformer, otherwise 1."""
        value: Any = self.config.get("patch_size", 14 if self.model_type == "depth_anything" else 1)
        return int(max(value)) if isinstance(value, (list, tuple)) else int(value or 1)


def read_checkpoint(name_or_dir: str | Path, revision: str | None = None, local_files_only: bool = False) -> Checkpoint:
    """Read the configuration of a checkpoint; arguments as :func:`from_hugging_face`. Raises FileNotFoundError: a
    directory is missing, or lacks config.json; CheckpointError: config.json or preprocessor_config.json cannot be read;
    OSError: the hub cannot be reached, or has no such name; ModuleNotFoundError: transformers is missing."""
    optional("transformers", "a checkpoint of transformers needs the package transformers", "'ufmstar-torch[models]'")
    from transformers import PreTrainedConfig
    from transformers.image_processing_base import ImageProcessingMixin

    path = as_path("name_or_dir", name_or_dir).expanduser()
    # The name is a directory if that exists, or if it does not have the form "owner/name".
    local = path.is_dir() or path.is_absolute() or str(name_or_dir).startswith(".") or len(path.parts) != 2
    if local and not (path / "config.json").is_file():
        what = f"{path} has no config.json" if path.is_dir() else f"no such directory: {path}"
        raise FileNotFoundError(f"{what}; a checkpoint of transformers is a directory with config.json and weights")
    name, processor_file = path.as_posix(), "preprocessor_config.json"
    options = {"local_files_only": local_files_only or local, "revision": revision or "main"}
    readers: dict[str, Any] = {"config.json": PreTrainedConfig.get_config_dict}
    if not local or any((path / file).is_file() for file in (processor_file, "processor_config.json")):
        readers[processor_file] = ImageProcessingMixin.get_image_processor_dict
    read: dict[str, dict[str, Any]] = {}
    for file, reader in readers.items():
        try:
            read[file] = reader(name, **options)[0]
            if not isinstance(read[file], dict):
                raise TypeError("it must hold a JSON object")
        except (OSError, ValueError, TypeError, AttributeError) as error:
            if not local and file == "config.json":
                raise OSError(
                    f"{name} is no directory and cannot be read from the Hugging Face hub: {error}; with a connection, "
                    "`hf download NAME --local-dir DIR` fetches it; a directory needs no connection"
                ) from error
            raise CheckpointError(f"{name}: {file} cannot be read: {error}") from error
    return Checkpoint(name, read["config.json"], read.get(processor_file, {}), options)


def load_model(checkpoint: Checkpoint, dtype: torch.dtype, allow_missing: tuple[str, ...]) -> nn.Module:
    """Load the model with all weights of the checkpoint, on the CPU, or with random ones (empty ``options``). Raises
    CheckpointError: not a depth model, damaged, or with missing, misshapen or non-finite weights; the message names the
    directory."""
    from huggingface_hub.errors import StrictDataclassError
    from safetensors import SafetensorError
    from transformers import CONFIG_MAPPING, AutoModelForDepthEstimation

    if not checkpoint.options:
        untrained: nn.Module = AutoModelForDepthEstimation.from_config(
            CONFIG_MAPPING[checkpoint.model_type].from_dict(checkpoint.config), dtype=dtype
        )
        return untrained.eval()
    _require_size(checkpoint, dtype)
    try:
        model, report = AutoModelForDepthEstimation.from_pretrained(
            checkpoint.name, dtype=dtype, output_loading_info=True, **checkpoint.options
        )
    except (*DAMAGE, UnpicklingError, SafetensorError, StrictDataclassError) as error:
        raise _unbuilt(checkpoint, error) from error
    missing = sorted(key for key in report["missing_keys"] if not key.startswith(tuple(allow_missing)))
    if missing:
        raise CheckpointError(
            f"{checkpoint.name} lacks weights, which would stay random: {some(missing)}; where the model does not use "
            "them, name them in allow_missing"
        )
    if broken := [key for key, value in model.state_dict().items() if not value.isfinite().all()]:
        raise CheckpointError(f"{checkpoint.name} has weights that are not finite: {some(broken)}")
    network: nn.Module = model.eval()
    return network


def _require_size(checkpoint: Checkpoint, dtype: torch.dtype) -> None:
    """Raises CheckpointError: the configuration of a directory states a model that is much larger than its weights, or
    than the limit of layers, or that cannot be built; it is built without memory, on the device "meta"."""
    from huggingface_hub.errors import StrictDataclassError
    from transformers import CONFIG_MAPPING, AutoModelForDepthEstimation

    folder = Path(checkpoint.name)
    if not folder.is_dir() or checkpoint.model_type not in CONFIG_MAPPING:
        return  # the hub's own files, or another loader's error
    layers = [value for key, value in _numbers(checkpoint.config) if "layers" in key or "depths" in key]
    if max(layers, default=0) > MOST_LAYERS:
        raise CheckpointError(
            f"{checkpoint.name}: config.json states {max(layers)} layers, at most {MOST_LAYERS} can be"
        )
    try:
        with torch.device("meta"):
            config = CONFIG_MAPPING[checkpoint.model_type].from_dict(checkpoint.config)
            model: nn.Module = AutoModelForDepthEstimation.from_config(config, dtype=dtype)
    except (*DAMAGE, StrictDataclassError) as error:
        raise _unbuilt(checkpoint, error) from error
    size = sum(tensor.nbytes for tensor in (*model.parameters(), *model.buffers()))
    stored = sum(file.stat().st_size for file in folder.iterdir() if file.suffix in (".safetensors", ".bin"))
    if size > max(MOST_BYTES, 4 * stored):  # 4: weights in 8 bits
        stated = f"a model of {size:,} bytes, its weights have {stored:,}"
        raise CheckpointError(f"{checkpoint.name}: config.json states {stated}: the files do not belong together")


def _unbuilt(checkpoint: Checkpoint, error: Exception) -> CheckpointError:
    return CheckpointError(f"{checkpoint.name} ({checkpoint.model_type}) cannot be loaded as a depth model: {error}")


def _numbers(config: Any, key: str = "") -> Iterator[tuple[str, int]]:
    """The whole numbers in a configuration, with the names of their innermost keys."""
    if isinstance(config, int) and not isinstance(config, bool):
        yield key, config
    for name, value in config.items() if isinstance(config, dict) else ():
        yield from _numbers(value, str(name))
    for value in config if isinstance(config, list) else ():
        yield from _numbers(value, key)

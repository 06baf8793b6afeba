"""Checkpoints of ``transformers`` from disk or hub: read completely, or an error that names them.

``transformers`` itself fills weights that a file lacks with random numbers and goes on; here that is an error.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from pickle import UnpicklingError
from typing import Any

import torch
from torch import nn

from ufmstar_torch.models.checkpoints import DAMAGE, CheckpointError, some

_TO_DOWNLOAD = "with a connection, `hf download NAME --local-dir DIR` fetches it; a directory needs no connection"


@dataclass(frozen=True)
class Checkpoint:
    """A checkpoint whose configuration has been read."""

    name: str  # as given, for messages
    folder: Path | None  # None if it comes from the hub
    config: dict[str, Any]  # config.json
    processor: dict[str, Any]  # preprocessor_config.json, empty if there is none
    # keyword arguments for every further call of ``transformers``
    options: dict[str, Any] = field(default_factory=dict)

    @property
    def model_type(self) -> str:
        """As "depth_anything", "dpt"."""
        return str(self.config.get("model_type"))


def read_checkpoint(name_or_dir: str | Path, revision: str | None = None, local_files_only: bool = False) -> Checkpoint:
    """The configuration of a checkpoint; arguments as ``from_hugging_face``. Raises FileNotFoundError: a directory is
    missing, or lacks config.json; CheckpointError: config.json or preprocessor_config.json cannot be read; OSError: the
    hub cannot be reached, or has nothing of that name; ModuleNotFoundError: transformers is missing."""
    from transformers import PreTrainedConfig
    from transformers.image_processing_base import ImageProcessingMixin

    name = Path(name_or_dir).as_posix()
    folder = Path(name_or_dir).expanduser() if _is_path(str(name_or_dir)) else None
    if folder is not None and not (folder / "config.json").is_file():
        what = f"{folder} has no config.json" if folder.is_dir() else f"no such directory: {folder}"
        raise FileNotFoundError(f"{what}; a checkpoint of transformers is a directory with config.json and weights")
    source = str(folder or name)
    options = {"local_files_only": local_files_only or folder is not None, "revision": revision or "main"}

    def read(file: str, reader: Callable[..., tuple[dict[str, Any], dict[str, Any]]]) -> dict[str, Any]:
        try:
            values = reader(source, **options)[0]
        except (OSError, ValueError, TypeError, AttributeError) as error:
            if folder is None and file == "config.json":
                raise OSError(
                    f"{name} is no directory and cannot be had from the Hugging Face hub: {error}; {_TO_DOWNLOAD}"
                ) from error
            raise CheckpointError(f"{source}: {file} cannot be read: {error}") from error
        if not isinstance(values, dict):
            raise CheckpointError(f"{source}: {file} must hold a JSON object")
        return values

    config = read("config.json", PreTrainedConfig.get_config_dict)
    files = ("preprocessor_config.json", "processor_config.json")
    has_processor = folder is None or any((folder / file).is_file() for file in files)
    processor = read(files[0], ImageProcessingMixin.get_image_processor_dict) if has_processor else {}
    return Checkpoint(source, folder, config, processor, options)


def load_model(checkpoint: Checkpoint, dtype: torch.dtype, allow_missing: Sequence[str] = ()) -> nn.Module:
    """The model with every weight from the checkpoint, on the CPU.

    ``dtype`` is that of the weights, whatever the file has; ``allow_missing`` are beginnings of names of weights that
    the file may lack. Raises CheckpointError: not a depth model, damaged, or with missing, misshapen or non-finite
    weights; the message names the directory.
    """
    from huggingface_hub.errors import StrictDataclassError
    from safetensors import SafetensorError
    from transformers import AutoModelForDepthEstimation

    try:
        with _quiet(checkpoint.folder is not None):
            model, report = AutoModelForDepthEstimation.from_pretrained(
                checkpoint.name, dtype=dtype, output_loading_info=True, **checkpoint.options
            )
    except (*DAMAGE, UnpicklingError, SafetensorError, StrictDataclassError) as error:
        raise CheckpointError(
            f"{checkpoint.name} ({checkpoint.model_type}) cannot be loaded as a depth model: {error}"
        ) from error
    missing = sorted(key for key in report["missing_keys"] if not key.startswith(tuple(allow_missing)))
    if missing:
        raise CheckpointError(
            f"{checkpoint.name} lacks weights, which would stay random: {some(missing)}; where the model does not use "
            "them, name them in allow_missing"
        )
    if broken := [key for key, value in model.state_dict().items() if not value.isfinite().all()]:
        raise CheckpointError(f"{checkpoint.name} has weights that are not finite: {some(broken)}")
    return model.eval()


def _is_path(name: str) -> bool:
    """Whether a directory is meant: one that exists, or what no "owner/name" looks like."""
    path = Path(name)
    return path.is_dir() or path.is_absolute() or name.startswith((".", "~")) or len(path.parts) != 2


@contextmanager
def _quiet(local: bool) -> Iterator[None]:
    """Without the progress bar of a local file, and without a report on the weights, which are checked here."""
    from transformers.utils import logging

    level, bars = logging.get_verbosity(), logging.is_progress_bar_enabled()
    if local and bars:
        logging.disable_progress_bar()
    logging.set_verbosity(max(level, logging.CRITICAL if local else logging.ERROR))
    try:
        yield
    finally:
        logging.set_verbosity(level)
        if local and bars:
            logging.enable_progress_bar()

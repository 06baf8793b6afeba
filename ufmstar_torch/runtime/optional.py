"""Import of optional packages, with errors that name the extra to install."""

from __future__ import annotations

from importlib import import_module
from typing import Any

# By import name: the extra of ``ufmstar-torch`` that installs the package.
EXTRAS = {
    **dict.fromkeys(("torchvision", "onnx", "onnxruntime", "safetensors", "transformers"), "models"),
    **dict.fromkeys(("filelock", "torchmetrics", "scipy", "cv2", "imageio", "imageio_ffmpeg", "kornia_rs"), "eval"),
    **dict.fromkeys(("PIL", "tqdm", "tyro", "h5py", "jinja2", "pandas", "OpenEXR", "yaml"), "eval"),
    "matplotlib": "viz",
    "lightning": "train",
    "kornia": "train",
    "tensorboard": "train",
    "zeus": "energy",
}


def optional(module: str, need: str, install: str) -> Any:
    """Import a module. Raises ModuleNotFoundError: it is not installed; the message states the ``need`` ("pictures need
    matplotlib") and the package to ``install``."""
    try:
        return import_module(module)
    except ModuleNotFoundError as error:
        raise ModuleNotFoundError(f"{need}: pip install {install}") from error


def naming_extra(error: BaseException, who: str) -> BaseException:
    """The error; if a package is missing, one that names the extra that ``who`` needs."""
    package = (getattr(error, "name", None) or "").partition(".")[0]
    if not isinstance(error, ModuleNotFoundError) or package not in EXTRAS:
        return error
    text = f"{who} needs the package {package}: pip install 'ufmstar-torch[{EXTRAS[package]}]'"
    return ModuleNotFoundError(text, name=error.name)

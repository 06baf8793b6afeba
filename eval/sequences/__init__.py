"""Dataset readers: posed frames from the layouts that the field uses, or from any images and poses."""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from ufmstar_torch.eval.sequences.conventions import CONVENTIONS as CONVENTIONS
    from ufmstar_torch.eval.sequences.depth_folder import DepthFolder as DepthFolder
    from ufmstar_torch.eval.sequences.find import Found as Found
    from ufmstar_torch.eval.sequences.find import find_sequences as find_sequences
    from ufmstar_torch.eval.sequences.frame import Frame as Frame
    from ufmstar_torch.eval.sequences.frame import FrameError as FrameError
    from ufmstar_torch.eval.sequences.frame import FrameSequence as FrameSequence
    from ufmstar_torch.eval.sequences.frame import Skipped as Skipped
    from ufmstar_torch.eval.sequences.layout import open_sequence as open_sequence

_HOME = {
    "CONVENTIONS": "conventions",
    "DepthFolder": "depth_folder",
    "Found": "find",
    "Frame": "frame",
    "FrameError": "frame",
    "FrameSequence": "frame",
    "Skipped": "frame",
    "find_sequences": "find",
    "open_sequence": "layout",
}


def __getattr__(name: str) -> Any:
    """Imports a name's module when it is first asked for (PEP 562): Pillow and SciPy are not free."""
    if name not in _HOME:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(f"{__name__}.{_HOME[name]}"), name)

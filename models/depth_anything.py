"""Depth Anything V2 (Yang et al., NeurIPS 2024): a DINOv2 encoder with a DPT decoder, by ``transformers``.

The checkpoints are depth-anything/Depth-Anything-V2-[Metric-Indoor-|Metric-Outdoor-]{Small,Base,Large}-hf on the hub.
The metric checkpoints (indoor up to 20 m, outdoor up to 80 m) can be used directly. The relative ones predict inverse
depth up to scale and shift and need an alignment. Small is Apache-2.0, Base and Large are CC BY-NC 4.0: not for
commercial use.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Self

import torch

from ufmstar_torch.models.checkpoints import CheckpointError
from ufmstar_torch.models.hugging_face import HuggingFaceDepth, HuggingFaceSpec, load_hugging_face
from ufmstar_torch.models.hugging_face_checkpoint import Checkpoint, read_checkpoint
from ufmstar_torch.models.network import DepthNetwork
from ufmstar_torch.models.outputs import PlainSpec
from ufmstar_torch.runtime.kinds import check_kinds

SIZE = (518, 518)  # [px] of the input


class DepthAnything(HuggingFaceDepth):
    """Depth Anything V2 for UfM*; made by :meth:`from_pretrained`.

    A metric checkpoint is a depth network. Calling a relative one raises: ``network.raw(image)`` is its inverse depth
    up to scale and shift, and ``network.aligned(alignment)`` a depth network.
    """

    def __init__(self, checkpoint: Checkpoint, spec: HuggingFaceSpec, dtype: torch.dtype = torch.float32) -> None:
        """From a checkpoint's configuration; arguments and errors as :meth:`from_pretrained`."""
        if checkpoint.model_type != "depth_anything":
            raise CheckpointError(
                f"{checkpoint.name} is a {checkpoint.config.get('model_type')!r} model, expected 'depth_anything'; "
                "other depth models: from_hugging_face"
            )
        size, multiple = spec.size or SIZE, checkpoint.patch
        if len(size) != 2 or any(side < 1 or side % multiple for side in size):
            raise ValueError(f"size must be (height, width) in multiples of the patch, {multiple} px, got {size}")
        if spec.preprocess is None:
            spec = replace(spec, size=size, keep_aspect=bool(spec.keep_aspect))
        super().__init__(checkpoint, spec, dtype)

    @classmethod
    @check_kinds
    def from_pretrained(
        cls,
        name_or_dir: str | Path,
        *,
        size: tuple[int, int] = SIZE,
        keep_aspect: bool = False,
        dtype: torch.dtype = torch.float32,
        device: torch.device | str | None = None,
        revision: str | None = None,
        local_files_only: bool = False,
    ) -> Self:
        """As :func:`from_hugging_face`, for this architecture.

        Args:
            size: (height, width) [px] of the input, multiples of the patch (14).
            keep_aspect: keep the image's aspect like the checkpoint's image processor: 480 x 640 becomes 518 x 686.

        Raises:
            ValueError: ``size`` is no multiple of the patch.
        """
        checkpoint = read_checkpoint(name_or_dir, revision, local_files_only)
        return cls(checkpoint, HuggingFaceSpec(size=size, keep_aspect=keep_aspect), dtype).to(device)


def load_depth_anything(weights: Path, spec: HuggingFaceSpec | PlainSpec | None = None) -> DepthNetwork:
    """As ``load_hugging_face``, for this architecture."""
    return load_hugging_face(weights, spec, DepthAnything)

"""Depth models of Hugging Face's ``transformers``, from a hub name or a local directory.

Few configurations state what the model's numbers mean ("depth_estimation_type"). The others need a declaration, as
every network here; where both exist, they have to agree.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Self

import torch
from torch import Tensor

from ufmstar_torch.checked import Checked
from ufmstar_torch.models.aligned import AlignedNetwork
from ufmstar_torch.models.alignment import KINDS, Alignment
from ufmstar_torch.models.checkpoints import CheckpointError
from ufmstar_torch.models.hugging_face_files import Checkpoint, load_model, read_checkpoint
from ufmstar_torch.models.hugging_face_raw import CanonicalInverseDepth, PaddedDepth, RawDepth
from ufmstar_torch.models.network import DepthNetwork
from ufmstar_torch.models.outputs import METRIC
from ufmstar_torch.models.preprocess import Preprocess
from ufmstar_torch.prediction import DepthPrediction

# Pillow's numbers, which the configurations use.
_LINEAR, _CUBIC = 2, 3
# The architectures whose output is covered, and how it is read. Others, such as models that need a second input or
# predict no depth, are refused by name.
_ARCHITECTURES: dict[str, type[RawDepth]] = {
    "depth_anything": RawDepth,
    "depth_pro": CanonicalInverseDepth,
    "dpt": RawDepth,
    "glpn": RawDepth,
    "zoedepth": PaddedDepth,
}
# Architectures that always predict metric depth.
_METRIC = ("depth_pro", "zoedepth")
# "depth_estimation_type" in the terms of this package; "relative" is inverse depth in all of them.
_DECLARED = {"metric": METRIC, "relative": "inverse"}


@dataclass(frozen=True)
class HuggingFaceSpec(Checked):
    """What is declared about a checkpoint: arguments of :func:`from_hugging_face` for configuration files.

    Attributes:
        kind: what it predicts: "metric" (GLPN, DPT trained on NYU or KITTI; Depth Pro and ZoeDepth always), "inverse"
            (DPT and MiDaS otherwise) or "affine" (depth up to scale and shift). None = as the configuration or the
            architecture states, if it does.
        scale: [m] length of one unit of metric depth.
        size: (height, width) [px] of the input; None = that of preprocessor_config.json.
        keep_aspect: whether ``size`` is only approximate and the aspect kept; None = as the configuration states.
        preprocess: instead of the checkpoint's own; excludes ``size`` and ``keep_aspect``.
        allow_missing: beginnings of weights that the checkpoint may lack (and that stay random), as the unused
            "neck.fusion_stage.layers.0.residual_layer1" of Intel/dpt-large.
        alignment: of a relative network, in configuration files only.
    """

    kind: str | None = None
    scale: float = 1.0
    size: tuple[int, int] | None = None
    keep_aspect: bool | None = None
    preprocess: Preprocess | None = None
    allow_missing: tuple[str, ...] = ()
    alignment: Alignment | None = None


class HuggingFaceDepth(DepthNetwork):
    """A transformers depth model; made by :func:`from_hugging_face`.

    Attributes:
        raw: the :class:`RawDepth`; ``raw(image)`` is what alignments are fitted to.
        kind: "metric", "inverse" or "affine".
        scale: [m] length of one unit, where metric.
        max_depth: [m] the ``max_depth`` of a metric checkpoint, of which its output is a share.
    """

    max_depth: float | None = None

    def __init__(
        self, raw: RawDepth, preprocess: Preprocess, kind: str, *, scale: float = 1.0, source: str = ""
    ) -> None:
        super().__init__()
        if kind not in (METRIC, *KINDS):
            raise ValueError(f"kind must be one of {(METRIC, *KINDS)}, got {kind!r}")
        if not 0 < scale < float("inf"):
            raise ValueError(f"scale must be positive metres per unit, got {scale}")
        if kind != METRIC and scale != 1:
            raise ValueError(f"scale goes with kind {METRIC!r} only; a relative network gets an Alignment")
        self.raw, self.preprocess = raw, preprocess
        self.kind, self.scale, self.source = kind, scale, source

    @classmethod
    def of_checkpoint(cls, checkpoint: Checkpoint, spec: HuggingFaceSpec, dtype: torch.dtype = torch.float32) -> Self:
        """From a checkpoint that was read, in eval mode; errors as :func:`from_hugging_face`."""
        kind, preprocess = _kind(checkpoint, spec.kind), spec.preprocess
        if preprocess is None:
            preprocess = own_preprocess(checkpoint, spec.size, spec.keep_aspect)
        elif spec.size is not None or spec.keep_aspect is not None:
            raise ValueError("preprocess excludes size and keep_aspect, which it contains")
        model, reading = load_model(checkpoint, dtype, spec.allow_missing), _ARCHITECTURES[checkpoint.model_type]
        if reading is PaddedDepth and not checkpoint.processor.get("do_pad", True):
            reading = RawDepth
        raw = reading(model, patch_size(checkpoint))
        network = cls(raw, preprocess, kind, scale=spec.scale, source=checkpoint.name)
        if checkpoint.config.get("depth_estimation_type") == METRIC:
            network.max_depth = spec.scale * float(checkpoint.config["max_depth"])
        return network.eval()

    @property
    def is_metric(self) -> bool:
        """Whether it can be used without an alignment."""
        return self.kind == METRIC

    def forward(self, image: Tensor) -> DepthPrediction:
        """Depth [B, H, W] [m], float32, of ``image`` [B, 3, H, W] as ``preprocess`` returns it. Raises ValueError: the
        network is relative, or the image does not fit."""
        return DepthPrediction(self.required().raw(image) * self.scale)

    def required(self) -> Self:
        """This network. Raises ValueError: it is relative."""
        if not self.is_metric:
            what = "inverse depth" if self.kind == "inverse" else "depth"
            raise ValueError(
                f"{self.source or 'this network'} predicts relative depth ({what} up to scale and shift), not metres: "
                "give it an Alignment, fitted to measured depth (fit_inverse_depth, fit_affine_depth) or to the "
                "camera's height (align_to_camera_height), by network.aligned(alignment); or use a metric checkpoint"
            )
        return self

    def aligned(self, alignment: Alignment) -> AlignedNetwork:
        """The metric network that a relative one becomes by a fixed alignment; the weights are shared. Raises
        ValueError: this network is metric, or the alignment is for the other kind of output."""
        if alignment.kind != self.kind:
            raise ValueError(f"alignment must be of the network's kind {self.kind!r}, got {alignment.kind!r}")
        return AlignedNetwork(self.raw, alignment, self.preprocess)


def from_hugging_face(
    name_or_dir: str | Path,
    *,
    kind: str | None = None,
    scale: float = 1.0,
    size: tuple[int, int] | None = None,
    keep_aspect: bool | None = None,
    preprocess: Preprocess | None = None,
    allow_missing: Sequence[str] = (),
    dtype: torch.dtype = torch.float32,
    device: torch.device | str | None = None,
    revision: str | None = None,
    local_files_only: bool = False,
) -> HuggingFaceDepth:
    """A depth model of ``AutoModelForDepthEstimation`` in eval mode: DPT, GLPN, Depth Anything, Depth Pro, ZoeDepth.

    Its depth is what the image processor's ``post_process_depth_estimation`` makes of its output: Depth Pro's inverse
    depth becomes metric by the field of view that it estimates, ZoeDepth's padding is done and cut off again.

    Args:
        name_or_dir: "owner/name" on the hub, or a directory with config.json and weights.
        kind, scale, size, keep_aspect, preprocess, allow_missing: see :class:`HuggingFaceSpec`.
        dtype: of the weights; what comes out is float32 in any case (float64 for float64).
        device: where they go; None = the CPU.
        revision: branch, tag or commit on the hub.
        local_files_only: do not access the hub.

    Raises:
        ValueError: the kind is declared nowhere or contradicts the configuration, a Depth Pro without the part that
            estimates the field of view, or a value is out of range.
        CheckpointError: a directory or checkpoint is damaged, incomplete or of another kind of model; named.
        FileNotFoundError, OSError: there is no such directory, or the hub cannot be reached.
        ModuleNotFoundError: transformers is missing.
    """
    spec = HuggingFaceSpec(kind, scale, size, keep_aspect, preprocess, tuple(allow_missing))
    checkpoint = read_checkpoint(name_or_dir, revision, local_files_only)
    return HuggingFaceDepth.of_checkpoint(checkpoint, spec, dtype).to(device)


def load_hugging_face(weights: Path, spec: Mapping[str, Any] | str | Path | None = None) -> DepthNetwork:
    """The metric network in a directory, or of a hub name; ``spec``: :class:`HuggingFaceSpec`, its plain values or a
    JSON file. Raises ValueError: an unknown option, or a relative network without an alignment; others as
    :func:`from_hugging_face`."""
    declared = HuggingFaceSpec.read(spec or {})
    network = HuggingFaceDepth.of_checkpoint(read_checkpoint(weights), declared)
    return with_alignment(network, declared.alignment)


def with_alignment(network: HuggingFaceDepth, alignment: Alignment | None) -> DepthNetwork:
    """The aligned network, or without an alignment the network itself. Raises ValueError: the network is relative and
    has no alignment, or is metric and has one."""
    if alignment is not None:
        return network.aligned(alignment)
    try:
        return network.required()
    except ValueError as error:
        example = f'{{"alignment": {{"kind": "{network.kind}", "scale": ..., "shift": ...}}}}'
        raise ValueError(f"{error}. In a spec: {example}") from error


def own_preprocess(
    checkpoint: Checkpoint, size: tuple[int, int] | None = None, keep_aspect: bool | None = None
) -> Preprocess:
    """The preprocessing that a checkpoint's image processor describes. Raises ValueError: the description lacks what is
    needed, or contains what ``Preprocess`` cannot do."""
    processor, name = checkpoint.processor, checkpoint.name
    unknown = [option for option in ("do_center_crop", "do_flip_channel_order") if processor.get(option)]
    resample = processor.get("resample", _CUBIC)
    if unknown or resample not in (_LINEAR, _CUBIC):
        raise ValueError(
            f"{name}: its image processor needs {unknown or f'resample {resample}'}, which is not supported: give a "
            "Preprocess of your own"
        )
    own = processor.get("size")
    if size is None and isinstance(own, dict) and {"height", "width"} <= set(own):
        size = (int(own["height"]), int(own["width"]))
    if size is None or not processor:
        raise ValueError(f"{name} does not say what its input needs: give size or a Preprocess of your own")
    if len(size) != 2:
        raise ValueError(f"{name}: size must be (height, width) in pixels, got {size}")
    keep = bool(processor.get("keep_aspect_ratio")) if keep_aspect is None else keep_aspect
    divisor = int(processor.get("ensure_multiple_of") or processor.get("size_divisor") or 1)
    mean, std = processor.get("image_mean"), processor.get("image_std")
    if not processor.get("do_normalize", True):
        mean, std = (0.0, 0.0, 0.0), (1.0, 1.0, 1.0)
    if mean is None or std is None:
        raise ValueError(f"{name}: its image processor normalises, but names no image_mean and image_std")
    factor = float(processor.get("rescale_factor", 1 / 255)) if processor.get("do_rescale", True) else 1.0
    return Preprocess(
        size=(size[0], size[1]),
        aspect_multiple=max(patch_size(checkpoint), divisor) if keep else None,
        value_range=255 * factor,
        mean=tuple(mean),
        std=tuple(std),
        antialias=checkpoint.model_type != "depth_pro",
        cubic=resample == _CUBIC,
    )


def patch_size(checkpoint: Checkpoint) -> int:
    """[px] what an input's sides have to be multiples of: the patch of a vision transformer, otherwise 1."""
    value: Any = checkpoint.config.get("patch_size", 14 if checkpoint.model_type == "depth_anything" else 1)
    return int(max(value)) if isinstance(value, (list, tuple)) else int(value or 1)


def _kind(checkpoint: Checkpoint, kind: str | None) -> str:
    """The kind of depth, from the configuration, the architecture and the declaration."""
    config, name, model_type = checkpoint.config, checkpoint.name, checkpoint.model_type
    if model_type not in _ARCHITECTURES:
        known = ", ".join(_ARCHITECTURES)
        raise CheckpointError(f"{name} ({model_type}) cannot be loaded as a depth model: covered are {known}")
    if model_type == "depth_pro" and not config.get("use_fov_model"):
        raise ValueError(f"{name} predicts inverse depth per focal length, but not the field of view (use_fov_model)")
    stated = config.get("depth_estimation_type", "relative" if model_type == "depth_anything" else None)
    if stated is None and kind is None and model_type not in _METRIC:
        raise ValueError(
            f"{name} ({model_type}) does not say whether its depth is metric: declare kind='metric', 'inverse' "
            "(inverse depth up to scale and shift) or 'affine' (depth up to scale and shift)"
        )
    if stated not in (None, *_DECLARED):
        raise ValueError(f"{name}: depth_estimation_type must be one of {list(_DECLARED)}, got {stated!r}")
    own = METRIC if model_type in _METRIC else _DECLARED.get(str(stated))
    if own is not None and kind not in (None, own):
        said = f"depth_estimation_type {stated!r}" if stated else f"the architecture {model_type}"
        raise ValueError(f"kind={kind!r}, but {name} states {said}, which is {own!r}")
    if stated == METRIC and "max_depth" not in config:
        raise ValueError(f"{name} states metric depth, but not the max_depth [m] that its output is a share of")
    return own or str(kind)

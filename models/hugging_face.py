"""Depth models of Hugging Face's ``transformers``, from a hub name or a local directory.

Few configurations state the kind of depth ("depth_estimation_type"). The others need a declaration; if both exist, they
must agree. ``hugging_face_checkpoint`` reads the files.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn

from ufmstar_torch.frames.prediction import DepthPrediction
from ufmstar_torch.models.alignment import KINDS, AlignedNetwork, Alignment
from ufmstar_torch.models.checkpoints import DAMAGE, CheckpointError
from ufmstar_torch.models.hugging_face_checkpoint import Checkpoint, load_model, read_checkpoint
from ufmstar_torch.models.network import DepthNetwork, require_image
from ufmstar_torch.models.outputs import METRIC, PlainSpec, as_map
from ufmstar_torch.models.preprocess import Preprocess
from ufmstar_torch.runtime.checked import Checked, number
from ufmstar_torch.runtime.kinds import check_kinds

_LINEAR, _CUBIC = 2, 3  # Pillow's numbers, which the configurations use
# The supported architectures: their image processor, and whether they always predict metric depth. Others, such as
# models with a second input, raise.
_SUPPORTED = {
    "depth_anything": ("DPTImageProcessor", False),
    "depth_pro": ("DepthProImageProcessor", True),
    "dpt": ("DPTImageProcessor", False),
    "glpn": ("GLPNImageProcessor", False),
    "zoedepth": ("ZoeDepthImageProcessor", True),
}
# "depth_estimation_type" in the terms of this package; "relative" is inverse depth in all of them.
_DECLARED = {"metric": METRIC, "relative": "inverse"}


@dataclass(frozen=True)
class HuggingFaceSpec(Checked):
    """The user's declarations about a checkpoint.

    Attributes:
        kind: the predicted quantity: "metric" (GLPN, DPT trained on NYU or KITTI; Depth Pro and ZoeDepth always),
            "inverse" (DPT and MiDaS otherwise) or "affine" (depth up to scale and shift). None = from the configuration
            or the architecture, if they determine it.
        scale: [m] length of one unit of metric depth.
        size: (height, width) [px] of the input; None = that of preprocessor_config.json.
        keep_aspect: keep the aspect, so that ``size`` is only approximate; None = from the configuration.
        preprocess: replaces the checkpoint's preprocessing; excludes ``size`` and ``keep_aspect``.
        takes_intrinsics: for Depth Pro: use the camera's K to make its inverse depth metric, instead of the estimated
            field of view.
        allow_missing: prefixes of weights that the checkpoint may lack (they stay random), for example the unused
            "neck.fusion_stage.layers.0.residual_layer1" of Intel/dpt-large.
        alignment: of a relative network; for :func:`load_hugging_face`.
    """

    kind: str | None = field(default=None, metadata={"choices": (None, METRIC, *KINDS)})
    scale: float = number(1.0, "", "m", 0.0, open_low=True, open_high=True)
    size: tuple[int, int] | None = None
    keep_aspect: bool | None = None
    preprocess: Preprocess | None = None
    takes_intrinsics: bool = False
    allow_missing: tuple[str, ...] = ()
    alignment: Alignment | None = None


class RawDepth(nn.Module):
    """A model of ``transformers`` as an image-to-map network, in the model's units and the input's resolution.

    The model's image processor converts the output, and pads the input of ZoeDepth (Bhat et al. 2023). Depth Pro
    (Bochkovskii et al. 2025) predicts inverse depth for a focal length of one image width; its field of view makes it
    metric.

    Args:
        model: returns ``predicted_depth`` [B, h, w] for ``pixel_values``.
        processor: its image processor.
        multiple: [px] required divisor of the input's sides.
        padded: the model expects ZoeDepth's borders.
    """

    def __init__(self, model: nn.Module, processor: Any, multiple: int = 1, padded: bool = False) -> None:
        super().__init__()
        self.model, self.processor, self.multiple, self.padded = model, processor, multiple, padded

    def forward(self, image: Tensor, intrinsics: Tensor | None = None) -> Tensor:
        """[B, H, W], at least in float32, of ``image`` [B, 3, H, W]; a smaller output is enlarged. ``intrinsics``
        [B, 3, 3] [px] replace Depth Pro's estimate of the field of view. Raises ValueError: the image has another
        shape, or sides that are no multiples of ``multiple``."""
        height, width = require_image(image, self.multiple)
        if self.padded:
            exact = {"size": {"height": height, "width": width}, "keep_aspect_ratio": False, "ensure_multiple_of": 1}
            as_it_is = {"do_rescale": False, "do_normalize": False, "return_tensors": "pt"}
            image = self.processor(list(image), **exact, **as_it_is)["pixel_values"]
        outputs = self.model(pixel_values=image.to(next(self.model.parameters()).dtype))
        depth = as_map(outputs.predicted_depth, "predicted_depth")
        outputs.predicted_depth = depth if depth.dtype == torch.float64 else depth.float()
        if intrinsics is not None:
            half = (width / (2 * intrinsics[..., 0, 0].to(outputs.predicted_depth))).atan()
            outputs.field_of_view = (2 * half).rad2deg().expand(len(image))
        sizes = {"source_sizes" if self.padded else "target_sizes": [(height, width)] * len(image)}
        maps = self.processor.post_process_depth_estimation(outputs, **sizes)
        return torch.stack([one["predicted_depth"] for one in maps])


class HuggingFaceDepth(DepthNetwork):
    """A depth model of ``transformers``; made by :func:`from_hugging_face`.

    Attributes:
        raw: the :class:`RawDepth`; fit alignments to ``raw(image)``.
        kind: "metric", "inverse" or "affine".
        scale: [m] length of one unit, if metric.
        max_depth: [m] the ``max_depth`` of a metric checkpoint, whose raw output is a share of it.
        takes_intrinsics: call it as ``network(x, K)``: for Depth Pro, if so declared.
    """

    max_depth: float | None = None
    takes_intrinsics = False

    def __init__(
        self,
        checkpoint: Checkpoint,
        spec: HuggingFaceSpec,
        dtype: torch.dtype = torch.float32,
        model: nn.Module | None = None,
    ) -> None:
        """From a checkpoint, or with a ``model`` in memory, in eval mode; errors as :func:`from_hugging_face`."""
        super().__init__()
        self.kind, self.scale, self.source = _kind(checkpoint, spec), spec.scale, checkpoint.name
        if spec.preprocess is not None and (spec.size is not None or spec.keep_aspect is not None):
            raise ValueError("preprocess excludes size and keep_aspect: set them in preprocess")
        processor = image_processor(checkpoint)
        self.preprocess = spec.preprocess or _preprocess(checkpoint, processor, spec.size, spec.keep_aspect)
        model = load_model(checkpoint, dtype, spec.allow_missing) if model is None else model
        padded = checkpoint.model_type == "zoedepth" and processor.do_pad
        self.raw = RawDepth(model, processor, checkpoint.patch, padded)
        self.takes_intrinsics = spec.takes_intrinsics
        if checkpoint.config.get("depth_estimation_type") == METRIC:
            self.max_depth = spec.scale * float(checkpoint.config["max_depth"])
        self.eval()

    @property
    def is_metric(self) -> bool:
        """True if the network needs no alignment."""
        return self.kind == METRIC

    def forward(self, image: Tensor, intrinsics: Tensor | None = None) -> DepthPrediction:
        """Depth [B, H, W] [m], at least in float32, of the output ``image`` [B, 3, H, W] of ``preprocess``, with
        ``intrinsics`` [B, 3, 3] [px] if it takes them. Raises ValueError: the network is relative, the image does not
        fit, or the intrinsics are missing."""
        if self.takes_intrinsics and intrinsics is None:
            raise ValueError(
                "the network was declared to take intrinsics: call network(x, K), K [B, 3, 3] of its input x"
            )
        K = intrinsics if self.takes_intrinsics else None
        return DepthPrediction(self.aligned(None).raw(image, K) * self.scale)

    def aligned(self, alignment: Alignment | None) -> Any:
        """The network with a fixed alignment, which makes a relative one metric; shares the weights. None: this
        network, if it is metric. Raises ValueError: a relative network without an alignment, or an alignment for
        another kind of output."""
        if alignment is not None:
            if alignment.kind != self.kind:
                raise ValueError(f"alignment must be of the network's kind {self.kind!r}, got {alignment.kind!r}")
            return AlignedNetwork(self.raw, alignment, self.preprocess)
        if not self.is_metric:
            what = "inverse depth" if self.kind == "inverse" else "depth"
            example = f'{{"alignment": {{"kind": "{self.kind}", "scale": ..., "shift": ...}}}}'
            raise ValueError(
                f"{self.source or 'this network'} predicts relative depth ({what} up to scale and shift), not metres: "
                "add an Alignment, fitted to measured depth (fit_inverse_depth, fit_affine_depth), by "
                f"network.aligned(alignment), or in a spec: {example}; or use a metric checkpoint"
            )
        return self


@check_kinds
def from_hugging_face(
    name_or_dir: Any,
    *,
    processor: Any = None,
    dtype: torch.dtype = torch.float32,
    device: torch.device | str | None = None,
    revision: str | None = None,
    local_files_only: bool = False,
    **declared: Any,
) -> HuggingFaceDepth:
    """A depth model of ``AutoModelForDepthEstimation`` in eval mode: DPT, GLPN, Depth Anything, Depth Pro, ZoeDepth.

    Args:
        name_or_dir: "owner/name" on the hub, or a directory with config.json and weights; or a model or
            depth-estimation pipeline in memory, whose dtype and device are preserved.
        processor: image processor of a model in memory, if ``preprocess`` is not declared.
        dtype: of the weights; the output is float32 (float64 for float64).
        device: of the weights; None = the CPU.
        revision: branch, tag or commit on the hub.
        local_files_only: do not access the hub.
        declared: kind, scale, size, keep_aspect, preprocess, takes_intrinsics and allow_missing: see
            :class:`HuggingFaceSpec`.

    Raises:
        TypeError: a model or pipeline in memory that does not estimate depth.
        ValueError: the kind is not declared or contradicts the configuration, a Depth Pro without its estimator of the
            field of view, or a value is out of range.
        CheckpointError: a directory or checkpoint is damaged, incomplete or of another kind of model; the message names
            it.
        FileNotFoundError, OSError: there is no such directory, or the hub cannot be reached.
        ModuleNotFoundError: transformers is missing.
    """
    spec = HuggingFaceSpec(**declared)
    if of_transformers(name_or_dir):
        model, checkpoint = _in_memory(name_or_dir, processor)
        return HuggingFaceDepth(checkpoint, spec, model=model).to(device)
    if processor is not None:
        raise ValueError("processor goes with a model in memory: a checkpoint contains its processor")
    return HuggingFaceDepth(read_checkpoint(name_or_dir, revision, local_files_only), spec, dtype).to(device)


def of_transformers(network: object) -> bool:
    """True for a model or a pipeline of ``transformers``; does not import it."""
    bases = {cls.__name__ for cls in type(network).__mro__ if cls.__module__.startswith("transformers.")}
    return bool(bases & {"PreTrainedModel", "Pipeline"})


def _in_memory(network: Any, processor: Any) -> tuple[nn.Module, Checkpoint]:
    """A model or pipeline in memory, and its configuration. Raises TypeError: it does not estimate depth."""
    model, name = network, type(network).__name__
    if not isinstance(network, nn.Module):
        if network.task != "depth-estimation":
            raise TypeError(f"network must be a pipeline of the task depth-estimation, got {network.task!r}")
        model, processor = network.model, processor or network.image_processor
    if not type(model).__name__.endswith("ForDepthEstimation"):
        raise TypeError(f"network must be a ...ForDepthEstimation of transformers, got {type(model).__name__}")
    described = {} if processor is None else processor.to_dict()
    return model, Checkpoint(name, model.config.to_dict(), described, {})


def load_hugging_face(
    weights: Path, spec: HuggingFaceSpec | PlainSpec | None = None, kind: type[HuggingFaceDepth] = HuggingFaceDepth
) -> DepthNetwork:
    """Load the metric network of a directory or hub name; ``spec``: :class:`HuggingFaceSpec`, its plain values or a
    JSON file. Raises ValueError: an unknown option, or a relative network without an alignment; others as
    :func:`from_hugging_face`."""
    declared = HuggingFaceSpec.read(spec or {})
    network: DepthNetwork = kind(read_checkpoint(weights), declared).aligned(declared.alignment)
    return network


def image_processor(checkpoint: Checkpoint) -> Any:
    """The image processor of ``transformers`` as the checkpoint describes it, with the defaults of its class. Raises
    CheckpointError: the description has impossible values."""
    import transformers

    try:
        return getattr(transformers, _SUPPORTED[checkpoint.model_type][0])(**checkpoint.processor)
    except DAMAGE as error:
        raise CheckpointError(f"{checkpoint.name}: preprocessor_config.json cannot be used: {error}") from error


def _preprocess(
    checkpoint: Checkpoint, processor: Any, size: tuple[int, int] | None, keep_aspect: bool | None
) -> Preprocess:
    """The preprocessing of a checkpoint's image processor. Raises ValueError: its description is missing, or contains a
    step that ``Preprocess`` does not support."""
    name, stated = checkpoint.name, getattr(processor, "size", None)
    declare = (
        'in a spec: {"preprocess": {"size": [518, 518], "mean": [...], "std": [...]}}, or preprocess=Preprocess(...)'
    )
    if not checkpoint.processor:
        raise ValueError(
            f"{name} has no preprocessor_config.json, which states how images are resized and normalised: copy it "
            f"there from the source of the weights, or declare it {declare}"
        )
    unknown = [option for option in ("do_center_crop", "do_flip_channel_order") if getattr(processor, option, None)]
    if unknown or processor.resample not in (_LINEAR, _CUBIC):
        raise ValueError(
            f"{name}: its image processor needs {unknown or f'resample {processor.resample}'}, which is not supported: "
            f"declare another one {declare}"
        )
    if size is None:
        if not (stated and stated.height and stated.width):
            expected = f"preprocessor_config.json states no size with height and width: declare it {declare}"
            raise ValueError(f"{name}: {expected}")
        size = (int(stated.height), int(stated.width))
    keep = bool(getattr(processor, "keep_aspect_ratio", False)) if keep_aspect is None else keep_aspect
    divisors = (getattr(processor, option, None) or 1 for option in ("ensure_multiple_of", "size_divisor"))
    mean, std = (processor.image_mean, processor.image_std) if processor.do_normalize else ((0.0,) * 3, (1.0,) * 3)
    return Preprocess(
        size=size,
        aspect_multiple=int(max(checkpoint.patch, *divisors)) if keep else None,
        value_range=255 * processor.rescale_factor if processor.do_rescale else 255.0,
        mean=tuple(mean),
        std=tuple(std),
        antialias=checkpoint.model_type != "depth_pro",
        cubic=processor.resample == _CUBIC,
    )


def _kind(checkpoint: Checkpoint, spec: HuggingFaceSpec) -> str:
    """The kind of depth, from the configuration, the architecture and the declaration."""
    config, name, model_type = checkpoint.config, checkpoint.name, checkpoint.model_type
    kind, takes_intrinsics = spec.kind, spec.takes_intrinsics
    if model_type not in _SUPPORTED:
        names = ", ".join(_SUPPORTED)
        raise CheckpointError(f"{name} ({model_type}) cannot be loaded as a depth model: covered are {names}")
    if takes_intrinsics and model_type != "depth_pro":
        raise ValueError(
            f"takes_intrinsics goes with Depth Pro, whose depth depends on the focal length, not {model_type}"
        )
    if model_type == "depth_pro" and not config.get("use_fov_model") and not takes_intrinsics:
        raise ValueError(
            f"{name} predicts inverse depth per focal length, but not the field of view (use_fov_model): declare "
            "takes_intrinsics=True"
        )
    stated = config.get("depth_estimation_type", "relative" if model_type == "depth_anything" else None)
    if stated not in (None, *_DECLARED):
        raise ValueError(f"{name}: depth_estimation_type must be one of {list(_DECLARED)}, got {stated!r}")
    if stated == METRIC and "max_depth" not in config:
        raise ValueError(f"{name} states metric depth, but not the max_depth [m] that its output is a share of")
    stated_kind = METRIC if _SUPPORTED[model_type][1] else _DECLARED.get(str(stated))
    if stated_kind is None and kind is None:
        raise ValueError(
            f"{name} ({model_type}) does not state whether its depth is metric: declare kind='metric', 'inverse' "
            "(inverse depth up to scale and shift) or 'affine' (depth up to scale and shift)"
        )
    if stated_kind is not None and kind not in (None, stated_kind):
        aligned = "" if stated_kind == METRIC else ": from_hugging_face(...).aligned(alignment) makes it metric"
        source = f"depth_estimation_type {stated!r}" if stated else f"the architecture {model_type}"
        raise ValueError(f"kind={kind!r}, but {name} states {source}, which is {stated_kind!r}{aligned}")
    if (stated_kind or kind) != METRIC and spec.scale != 1:
        raise ValueError(f"scale goes with kind {METRIC!r} only; use an Alignment for a relative network")
    return stated_kind or str(kind)

"""Depth Anything and other ``transformers`` models as the command line and configuration files name them:
a directory, and what it does not say as JSON."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from ufmstar_torch.models.alignment import Alignment
from ufmstar_torch.models.depth_anything import DepthAnything
from ufmstar_torch.models.hugging_face import HuggingFaceDepth, from_hugging_face
from ufmstar_torch.models.network import DepthNetwork
from ufmstar_torch.models.onnx_network import read_json
from ufmstar_torch.models.preprocess import Preprocess


def load_depth_anything(weights: Path, spec: Any = None) -> DepthNetwork:
    """:meth:`DepthAnything.from_pretrained` with the options "size", "keep_aspect" and "alignment" of a spec.

    Raises:
        ValueError: an option that is not known, or a relative checkpoint without an alignment.
    """
    values = _options(spec, {"size", "keep_aspect", "alignment"})
    alignment = values.pop("alignment", None)
    return _metric(DepthAnything.from_pretrained(weights, **values), alignment)


def load_hugging_face(weights: Path, spec: Any = None) -> DepthNetwork:
    """:func:`from_hugging_face` with the options "kind", "scale", "size", "keep_aspect", "preprocess",
    "allow_missing" and "alignment" of a spec; errors as :func:`load_depth_anything`."""
    known = {"kind", "scale", "size", "keep_aspect", "preprocess", "allow_missing", "alignment"}
    values = _options(spec, known)
    alignment = values.pop("alignment", None)
    if values.get("preprocess") is not None:
        values["preprocess"] = Preprocess.from_dict(values["preprocess"])
    return _metric(from_hugging_face(weights, **values), alignment)


def _options(spec: Any, known: set[str]) -> dict[str, Any]:
    values = {} if spec is None else dict(spec) if isinstance(spec, Mapping) else read_json(spec)
    if unknown := sorted(set(values) - known):
        raise ValueError(f"this network's spec has no {unknown}; it has {sorted(known)}")
    return {name: tuple(value) if name == "size" and value is not None else value for name, value in values.items()}


def _metric(network: HuggingFaceDepth, alignment: Mapping[str, Any] | None) -> DepthNetwork:
    if alignment is not None:
        return network.aligned(Alignment.from_dict(alignment))
    try:
        network.require_metric()
    except ValueError as error:
        example = f'{{"alignment": {{"kind": "{network.kind}", "scale": ..., "shift": ...}}}}'
        raise ValueError(f"{error}. In a spec: {example}") from error
    return network

"""Training of a head on a custom network: any ``nn.Module`` or depth model of ``transformers``."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import fields, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import nn

from ufmstar_torch.models.alignment import Alignment, fit_affine_depth, fit_inverse_depth
from ufmstar_torch.models.heads import UncertaintyHead
from ufmstar_torch.models.hugging_face import HuggingFaceDepth, HuggingFaceSpec
from ufmstar_torch.models.hugging_face_checkpoint import read_checkpoint
from ufmstar_torch.models.module_backbone import ModuleSpec
from ufmstar_torch.models.network import DepthNetwork
from ufmstar_torch.models.outputs import PlainSpec
from ufmstar_torch.models.preprocess import Preprocess
from ufmstar_torch.models.spec import NetworkSpec
from ufmstar_torch.models.trained import load_ensemble
from ufmstar_torch.runtime.kinds import check_kinds
from ufmstar_torch.train.data import DepthDataModule
from ufmstar_torch.train.data_config import DataConfig
from ufmstar_torch.train.presets import DROPOUT, METHOD_ROWS, OF_HEAD, OF_MODULE, Recipe
from ufmstar_torch.train.settings import FitSettings, Job

_ALIGNED_FRAMES = 32  # training frames that determine a relative network's scale and shift


@check_kinds
def train_module(
    backbone: nn.Module | str | Path,
    head: str | type[UncertaintyHead],
    data: DataConfig,
    out: str | Path,
    *,
    overwrite: bool = False,
    settings: Mapping[str, Any] | None = None,
    **options: Any,
) -> DepthNetwork:
    """Train a head on a network, and write OUT/trained.safetensors; ``load_network("trained", FILE)`` loads it, with
    ``backbone=`` if that is a module.

    Args:
        backbone, head, data, options: see :func:`own_job`.
        out: folder for all results.
        overwrite: see ``fit``.
        settings: other fields of ``FitSettings``.

    Returns:
        The trained network in eval mode; several members as one ``Ensemble``.

    Raises:
        ValueError: an argument is invalid; others as ``fit`` and ``from_hugging_face``.
    """
    from ufmstar_torch.train.fit import fit
    from ufmstar_torch.train.folder import WEIGHTS

    job = own_job(backbone, head, data, FitSettings(out=Path(out), **(settings or {})), **options)
    fit(job, overwrite=overwrite)
    return load_ensemble(Path(out) / WEIGHTS, job.backbone).eval()


@check_kinds
def own_job(
    backbone: nn.Module | str | Path,
    head: str | type[UncertaintyHead],
    data: DataConfig,
    settings: FitSettings,
    *,
    fine_tune: bool = False,
    preprocess: Preprocess | None = None,
    features: str | None = None,
    spec: HuggingFaceSpec | PlainSpec | None = None,
    members: int | None = None,
    network: Mapping[str, Any] | None = None,
    **recipe: Any,
) -> Job:
    """The training of a head on a network.

    Args:
        backbone: a module that returns metric depth or features (``ModuleSpec.of``), which is copied; or the directory
            or hub name of a depth model of ``transformers``.
        data: for training and validation.
        head: "aleatoric", "evidential", "mc-dropout", "ensemble", "batch-ensemble" or "depth-only"; or a class of head.
        settings: of the session.
        fine_tune: also train the network; otherwise it is frozen.
        preprocess: preprocessing of the network's input; None = its attribute ``preprocess``, or its checkpoint's.
        features: name of the submodule whose input is the head's input; None = the last convolution that runs.
        spec: declarations about a checkpoint. A relative one without an alignment is aligned to the training depths.
        members: of an ensemble or BatchEnsemble; None = 10 of either.
        network: fields of the ``NetworkSpec``, such as dropout.
        recipe: fields of the :class:`Recipe`, such as epochs.

    Raises:
        ValueError: an unknown head, a network that does not fit it, or an invalid value.
    """
    row = head if isinstance(head, str) else getattr(head, "method", "")
    if row not in METHOD_ROWS or isinstance(head, nn.Module):
        raise ValueError(f"head must be one of {', '.join(METHOD_ROWS)}, AleatoricHead or EvidentialHead, got {head!r}")
    if row == "depth-only" and not fine_tune:
        raise ValueError("head 'depth-only' leaves nothing to train on a frozen network: fine_tune=True trains it")
    if unknown := sorted(set(recipe) - {f.name for f in fields(Recipe)}):
        raise ValueError(f"train_module has no {unknown}; a recipe has {[f.name for f in fields(Recipe)]}")
    of_row, several = METHOD_ROWS[row]
    if isinstance(backbone, nn.Module):
        module, network_input = backbone, preprocess or getattr(backbone, "preprocess", None) or Preprocess()
        module_spec = ModuleSpec.of(module, network_input, features)
    else:
        module, module_spec = None, _of_checkpoint(backbone, data, preprocess, features, spec)
    dropout = {"dropout": DROPOUT} if row == "mc-dropout" else {}
    shape: dict[str, Any] = {} if module_spec.preprocess.size is None else {"size": module_spec.preprocess.size}
    shape |= {"architecture": "module", "module": module_spec}
    described = NetworkSpec(**{**shape, **of_row, **dropout, **(network or {})})
    changed = Recipe(described, **{**(OF_MODULE if fine_tune else OF_HEAD), "members": several, **recipe})
    if not fine_tune and not settings.trainable:
        settings = replace(settings, trainable=_new_parts(described))
    return Job(changed if members is None else changed.with_members(members), data, settings, module)


def _of_checkpoint(
    name: str | Path, data: DataConfig, preprocess: Preprocess | None, part: str | None, spec: Any
) -> ModuleSpec:
    """The specification of a checkpoint, by default with inputs of one size, as batches require."""
    read, declared = read_checkpoint(name), HuggingFaceSpec.read({} if spec is None else spec)
    if preprocess is not None:
        declared = replace(declared, preprocess=preprocess)
    elif declared.preprocess is None and declared.keep_aspect is None:
        declared = replace(declared, keep_aspect=False)
    network = HuggingFaceDepth(read, declared)
    if not network.is_metric and declared.alignment is None:
        declared = replace(declared, alignment=_aligned(network, data))
    content = {"config": read.config, "processor": read.processor}
    details = {"source": read.name, "checkpoint": content, "declared": declared}
    return ModuleSpec.of(network.aligned(declared.alignment), network.preprocess, part, **details)


def _aligned(network: HuggingFaceDepth, data: DataConfig) -> Alignment:
    """Fit one alignment of a relative network to frames of the training part."""
    module = DepthDataModule(replace(data, augmentation=None), network.preprocess)
    module.setup("fit")
    frames = module.train_set
    assert frames is not None
    chosen = np.linspace(0, len(frames) - 1, min(_ALIGNED_FRAMES, len(frames))).round().astype(int).tolist()
    samples = [frames[index] for index in chosen]
    with torch.no_grad():
        predicted = torch.cat([network.raw(network.preprocess.normalized(sample["image"])) for sample in samples])
    depth = torch.cat([sample["depth"] for sample in samples])
    fit = {"inverse": fit_inverse_depth, "affine": fit_affine_depth}[network.kind]
    return fit(predicted, depth, depth > 0, shift=None, pooled=True).alignment


def _new_parts(spec: NetworkSpec) -> tuple[str, ...]:
    """The trained parameters on a frozen network: those of the head, of the depth's convolution if the network returns
    features, and of a BatchEnsemble's factors."""
    several = spec.method == "batch_ensemble"
    assert spec.module is not None
    parts = ["head", *(["backbone.last"] if spec.module.part is None else [])]
    return tuple(f"network.{part}" for part in (*parts, "*.r", "*.s")) if several else tuple(parts)

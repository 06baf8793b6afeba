"""A network by name: what the command line and configuration files use."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from ufmstar_torch.models.network import DepthNetwork
from ufmstar_torch.models.outputs import OutputSpec
from ufmstar_torch.models.preprocess import Preprocess


def load_network(name: str, weights: str | Path | None = None, **options: Any) -> DepthNetwork:
    """A depth network in eval mode, on the CPU.

    Args:
        name: one of :func:`network_names`.
        weights: the file it is loaded from.
        options: what the network of that name takes:
            fastdepth: ``size``, ``dropout``, and ``positive`` with a state_dict. ``weights``: an ONNX export, or a
                state_dict (.pth, .pt, .safetensors).
            monodepth2: ``strides`` ("v1.5" or "v1"), ``size``, ``dropout``. ``weights``: a state_dict.
            trained: none. ``weights``: a file of ``save_trained``; where it has several members, all of them as
                one network (``Ensemble``). ``load_trained`` gives them one by one, and takes several files.
            onnx: ``spec`` (an ``OnnxSpec``, a dict or a JSON file), ``threads``, ``providers``.
            depth_anything: ``spec`` with "size", "keep_aspect" and, for a relative checkpoint, "alignment" (a dict or
                a JSON file). ``weights``: a directory or hub name of ``transformers``.
            huggingface: ``spec`` with "kind" and what else ``from_hugging_face`` takes. ``weights`` as above.
            torchscript, exported: ``spec`` with "outputs" and, if needed, "preprocess" (a dict or a JSON file).

    Raises:
        ValueError: no such network, no weights, or a file or declaration that does not fit.
        TypeError: an option that this network does not have.
        FileNotFoundError, ModuleNotFoundError: a file or an optional package is missing.
    """
    if name not in _BUILDERS:
        raise ValueError(f"unknown network {name!r}, expected one of {list(network_names())}")
    if weights is None:
        raise ValueError(f"network {name!r} needs weights: the file to load")
    return _BUILDERS[name](Path(weights), **options).eval()


# Networks whose weights are a directory.
DIRECTORIES = frozenset({"depth_anything", "huggingface"})


def network_names() -> tuple[str, ...]:
    """The names that :func:`load_network` knows."""
    return tuple(sorted(_BUILDERS))


def _fastdepth(
    weights: Path, size: tuple[int, int] = (224, 224), dropout: float = 0.0, positive: str = "relu"
) -> DepthNetwork:
    from ufmstar_torch.models.checkpoints import load_state_dict_file, load_weights
    from ufmstar_torch.models.fastdepth import FastDepth, FastDepthWidths

    if weights.suffix == ".onnx":
        if positive != "relu":
            raise ValueError(f"an ONNX export of FastDepth ends in a ReLU, got positive={positive!r}")
        return FastDepth.from_onnx(weights, dropout=dropout, size=size)
    state = load_state_dict_file(weights)
    try:
        widths = FastDepthWidths.of_state_dict(state)
    except ValueError as error:
        raise ValueError(f"{weights}: {error}") from error
    norm = "encoder.0.norm.weight" in state
    network = FastDepth(widths, norm=norm, dropout=dropout, positive=positive, size=size)
    load_weights(network, weights)
    return network


def _monodepth2(
    weights: Path, size: tuple[int, int] = (224, 224), dropout: float = 0.0, strides: str = "v1.5"
) -> DepthNetwork:
    from ufmstar_torch.models.checkpoints import load_state_dict_file, load_weights
    from ufmstar_torch.models.monodepth2 import MonodepthResNet, shape_of_state_dict

    try:
        layers, decoder = shape_of_state_dict(load_state_dict_file(weights))
    except ValueError as error:
        raise ValueError(f"{weights}: {error}") from error
    network = MonodepthResNet(layers, strides=strides, dropout=dropout, decoder=decoder, size=size)
    load_weights(network, weights)
    return network


def _trained(weights: Path) -> DepthNetwork:
    from ufmstar_torch.models.ensemble import Ensemble
    from ufmstar_torch.models.trained import load_trained

    members = load_trained(weights)
    return members[0] if len(members) == 1 else Ensemble(members)


def _onnx(weights: Path, spec: Any = None, **options: Any) -> DepthNetwork:
    from ufmstar_torch.models.onnx_network import OnnxNetwork, OnnxSpec

    if spec is None:
        raise ValueError(
            "an ONNX network needs a spec, which declares what the file does not say; for metric depth in metres "
            '{"outputs": {"kind": "metric"}}'
        )
    if isinstance(spec, Mapping):
        spec = OnnxSpec.from_dict(spec)
    elif not isinstance(spec, OnnxSpec):
        spec = OnnxSpec.from_json(spec)
    return OnnxNetwork(weights, spec, **options)


def _torchscript(weights: Path, spec: Any = None) -> DepthNetwork:
    from ufmstar_torch.models.any_network import load_torchscript

    return load_torchscript(weights, *_declared(spec))


def _exported(weights: Path, spec: Any = None) -> DepthNetwork:
    from ufmstar_torch.models.any_network import load_exported

    return load_exported(weights, *_declared(spec))


def _declared(spec: Any) -> tuple[OutputSpec, Preprocess]:
    """Outputs and preprocessing of a program whose graph takes the image as it is."""
    from ufmstar_torch.models.onnx_network import read_json

    if spec is None:
        raise ValueError('a saved program needs a spec; for metric depth in metres {"outputs": {"kind": "metric"}}')
    values = dict(spec) if isinstance(spec, Mapping) else read_json(spec)
    unknown = sorted(set(values) - {"outputs", "preprocess"})
    if unknown or "outputs" not in values:
        raise ValueError(f"a spec has 'outputs' and, if needed, 'preprocess', got {sorted(values)}")
    return OutputSpec.from_dict(values["outputs"]), Preprocess.from_dict(values.get("preprocess") or {})


def _depth_anything(weights: Path, spec: Any = None) -> DepthNetwork:
    from ufmstar_torch.models.hugging_face_spec import load_depth_anything

    return load_depth_anything(weights, spec)


def _hugging_face(weights: Path, spec: Any = None) -> DepthNetwork:
    from ufmstar_torch.models.hugging_face_spec import load_hugging_face

    return load_hugging_face(weights, spec)


_BUILDERS: dict[str, Callable[..., DepthNetwork]] = {
    "depth_anything": _depth_anything,
    "exported": _exported,
    "fastdepth": _fastdepth,
    "huggingface": _hugging_face,
    "monodepth2": _monodepth2,
    "onnx": _onnx,
    "torchscript": _torchscript,
    "trained": _trained,
}

"""Loading of networks by name, for the command line and configuration files."""

from __future__ import annotations

from importlib import import_module
from pathlib import Path
from typing import Any

from ufmstar_torch.models.network import DepthNetwork
from ufmstar_torch.runtime.kinds import check_kinds

# Name -> module and function of its loader.
_LOADERS = {
    "depth_anything": ("depth_anything", "load_depth_anything"),
    "exported": ("any_network", "load_exported"),
    "fastdepth": ("fastdepth", "load_fastdepth"),
    "huggingface": ("hugging_face", "load_hugging_face"),
    "monodepth2": ("monodepth2_import", "load_monodepth_resnet"),
    "onnx": ("fastdepth", "load_graph"),
    "torchscript": ("any_network", "load_torchscript"),
    "trained": ("trained", "load_ensemble"),
}
# Networks whose weights are a directory.
DIRECTORIES = frozenset({"depth_anything", "huggingface"})


def network_names() -> tuple[str, ...]:
    """The names that :func:`load_network` accepts."""
    return tuple(_LOADERS)


@check_kinds
def load_network(name: str, weights: str | Path | None = None, **options: Any) -> DepthNetwork:
    """Load a depth network in eval mode, on the CPU.

    Args:
        name: one of :func:`network_names`.
        weights: its file.
        options: depend on the name:
            fastdepth: ``size``, ``dropout``, ``positive`` with a state_dict, ``runtime``, ``threads`` and ``device``.
                ``weights``: an ONNX export, which runs in ONNX Runtime (``runtime="torch"``: in torch), or a
                state_dict (.pth, .pt, .safetensors).
            monodepth2: ``strides`` ("v1.5" or "v1"), ``size``, ``dropout``. ``weights``: a state_dict. Or a folder with
                Monodepth2's published encoder.pth and depth.pth, and ``spec`` (see ``PublishedSpec``).
            trained: ``backbone``, the module below the head if it is a custom one. ``weights``: a file of
                ``save_trained``; several members become one network (``Ensemble``). ``load_trained`` returns them
                separately, and accepts several files.
            onnx: ``spec`` (an ``OnnxSpec``, a dict or a JSON file), ``threads``, ``providers``.
            depth_anything: ``spec`` with "size", "keep_aspect" and, for a relative checkpoint, "alignment" (a dict or
                a JSON file). ``weights``: a directory or hub name of ``transformers``.
            huggingface: ``spec`` with "kind" and other fields of ``HuggingFaceSpec``. ``weights`` as above.
            torchscript, exported: ``spec`` with "outputs" and, if needed, "preprocess" (a dict or a JSON file), and
                ``trust_code=True``, since these files run code.

    Raises:
        ValueError: an unknown name, no weights, or a file or declaration that does not match.
        TypeError: an unknown option of this network.
        FileNotFoundError, ModuleNotFoundError: a file or an optional package is missing.
    """
    if name not in _LOADERS:
        raise ValueError(f"name: unknown network {name!r:.60}, expected one of {list(_LOADERS)}")
    if weights is None:
        raise ValueError(f"network {name!r} needs weights: the file to load")
    module, loader = _LOADERS[name]
    network: DepthNetwork = getattr(import_module(f"ufmstar_torch.models.{module}"), loader)(Path(weights), **options)
    return network.eval()

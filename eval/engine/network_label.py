"""A network's name as tables show it."""

from __future__ import annotations

from pathlib import Path

from ufmstar_torch.models.network import DepthNetwork
from ufmstar_torch.models.trained import read_info


def label_of(model: str, file: Path, network: DepthNetwork) -> str:
    """ "FastDepth", "ResNet50-Monodepth2", "Depth Anything V2", or the name of the file.

    Args:
        model: as ``load_network`` has it.
        file: of the (first) weights.
        network: what was loaded from it.
    """
    if model == "trained":
        spec = read_info(file).spec
        return "FastDepth" if spec.architecture == "fastdepth" else f"ResNet{spec.layers}-Monodepth2"
    if model == "fastdepth":
        return "FastDepth"
    if model == "monodepth2":
        return f"ResNet{getattr(network, 'layers', 50)}-Monodepth2"
    return "Depth Anything V2" if model == "depth_anything" else file.stem

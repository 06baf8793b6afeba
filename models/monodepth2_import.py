"""Loading of a :class:`MonodepthResNet` from files, including the published weights of Monodepth2.

Its repository publishes two state_dicts. ``encoder.pth`` has torchvision's keys with the prefix "encoder.", and the
image size of the training. ``depth.pth`` numbers the decoder's convolutions in the order of execution: two for each of
the levels 4 to 0, then one disparity convolution per scale.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn

from ufmstar_torch.files.read import read_tensors
from ufmstar_torch.models.alignment import AlignedNetwork, Alignment
from ufmstar_torch.models.checkpoints import channels_of, fill, load_state_dict_file
from ufmstar_torch.models.monodepth2 import (
    IMAGENET_MEAN,
    IMAGENET_STD,
    LEVELS,
    MonodepthResNet,
    layers_of,
    shape_of_state_dict,
)
from ufmstar_torch.models.network import DepthNetwork
from ufmstar_torch.models.outputs import PlainSpec
from ufmstar_torch.models.preprocess import Preprocess
from ufmstar_torch.runtime.checked import Checked, number
from ufmstar_torch.runtime.kinds import check_kinds

# Keys of encoder.pth other than weights.
_NO_WEIGHTS = ("height", "width", "use_stereo")
# [m] Length of a unit of depth of networks that were trained on KITTI's stereo pairs: the baseline of .54 m is .1 units
# in training.
STEREO_SCALE = 5.4
# Monodepth2's mean and standard deviation for all colours of an image in [0, 1].
_MEAN, _STD = 0.45, 0.225
_CONVOLUTION = re.compile(r"decoder\.(\d+)(?:\.conv)?\.conv\.(weight|bias)")


@dataclass(frozen=True)
class Imported:
    """The loaded and the skipped tensors of two files."""

    loaded: tuple[str, ...]  # keys of the network that were filled
    skipped: Mapping[str, str]  # unused keys of the files, with the reason
    unchanged: tuple[str, ...]  # keys of the network that were not filled: the head of a metric network


@check_kinds
def load_monodepth2(network: MonodepthResNet, encoder_path: str | Path, depth_path: str | Path) -> Imported:
    """Fill a network's encoder and decoder with published Monodepth2 weights, in place.

    A network with ``disparity`` also gets the finest disparity convolution. Without it, the head stays untrained. The
    first convolution is rescaled from Monodepth2's normalisation of colours to ImageNet's. This is exact except at the
    border, which is padded with ImageNet's mean instead of Monodepth2's grey.

    Args:
        network: with ``strides="v1.5"`` and the layers and channels of the files.
        encoder_path, depth_path: encoder.pth and depth.pth.

    Raises:
        ValueError: the network's strides are not "v1.5".
        FileNotFoundError: a file is missing.
        CheckpointError: a file is damaged, or a tensor does not fit the network, which is then unchanged.
    """
    if network.strides != "v1.5":
        raise ValueError(f"Monodepth2's encoders have strides 'v1.5', got a network with {network.strides!r}")
    disparity = network.disparity is not None
    expected, loaded, skipped = network.state_dict(), dict[str, Tensor](), dict[str, str]()
    files = [load_state_dict_file(path, ignore=_NO_WEIGHTS) for path in (encoder_path, depth_path)]
    for key, value in (files[0] | files[1]).items():
        target = _network_key(key)
        if key.startswith("encoder.fc."):
            skipped[key] = "the classifier is not used"
        elif target is None or (target.startswith("head.") and not disparity):
            skipped[key] = "coarser disparities are not used" if disparity else "disparity is not metric depth"
        else:
            loaded[target] = value
    head = tuple(key for key in expected if key.startswith("head.") and not disparity)
    uncounted = [key for key in expected if key.endswith("num_batches_tracked")]  # missing in old files, and unused
    remaining = {key: expected[key] for key in (*head, *uncounted)}
    fill(network, remaining | loaded, f"{encoder_path} with {depth_path}")
    _to_imagenet_colours(network)
    return Imported(tuple(sorted(loaded)), skipped, tuple(sorted(head)))


@dataclass(frozen=True)
class PublishedSpec(Checked):
    """The meaning of published Monodepth2 weights' disparity.

    Attributes:
        scale: [m] length of a unit of depth; None = 5.4 for weights that were trained on stereo pairs.
        alignment: replaces the scale: "affine" for the depth in units, or "inverse" for its inverse.
        least, largest: depths [units] whose inverses bound the disparity.
        size: (height, width) [px] of the input; None = as in training.
    """

    scale: float | None = number(None, "s", "m", 0.0, open_low=True)
    alignment: Alignment | None = None
    least: float = 0.1
    largest: float = 100.0
    size: tuple[int, int] | None = None


class Units(nn.Module):
    """A network's depth [B, H, W], or its inverse, the input of an alignment."""

    def __init__(self, network: DepthNetwork, inverse: bool) -> None:
        super().__init__()
        self.network, self.inverse = network, inverse

    def forward(self, image: Tensor) -> Tensor:
        """The depth, or its inverse, of ``image`` [B, 3, H, W]."""
        depth: Tensor = self.network(image).depth
        return 1 / depth if self.inverse else depth


def load_published(folder: Path, spec: PublishedSpec | PlainSpec | None = None) -> DepthNetwork:
    """Load a metric network from a folder with Monodepth2's encoder.pth and depth.pth; ``spec``: declarations, plain
    values or a JSON file. Raises FileNotFoundError, CheckpointError: as :func:`load_monodepth2`; ValueError: weights
    trained on single images without a scale, or an invalid value."""
    s, files = PublishedSpec.read(spec or {}), (folder / "encoder.pth", folder / "depth.pth")
    if missing := [path for path in files if not path.is_file()]:
        raise FileNotFoundError(f"no {missing[0]}; expected a folder with Monodepth2's encoder.pth and depth.pth")
    with files[0].open("rb") as opened:
        encoder: Any = read_tensors(opened, files[0])
    if s.alignment is None and s.scale is None and not encoder.get("use_stereo"):
        raise ValueError(
            f'{folder}: trained on single images, Monodepth2\'s depth has no scale: declare "scale" [m] or "alignment" '
            "(fit_affine_depth, fit_inverse_depth) in a spec"
        )
    keys = [f"decoder.{2 * n + 1}.conv.conv.weight" for n in range(LEVELS)]
    widths = channels_of(load_state_dict_file(files[1]), keys, "Monodepth2 decoder", files[1])
    scale = (s.scale or STEREO_SCALE) if s.alignment is None else 1.0
    network = MonodepthResNet(layers_of(encoder), decoder=widths[::-1], disparity=(s.least, s.largest), scale=scale)
    load_monodepth2(network, *files)
    size = s.size or (int(encoder.get("height", 192)), int(encoder.get("width", 640)))
    network.preprocess = Preprocess(size=size, mean=IMAGENET_MEAN, std=IMAGENET_STD)
    if s.alignment is None:
        return network.eval()
    return AlignedNetwork(Units(network, s.alignment.kind == "inverse"), s.alignment, network.preprocess).eval()


def load_monodepth_resnet(
    weights: Path, size: tuple[int, int] = (224, 224), dropout: float = 0.0, strides: str = "v1.5", spec: Any = None
) -> DepthNetwork:
    """Load a network from a state_dict file, which determines its layers and widths; errors as
    ``checkpoints.fill``. For a folder, :func:`load_published` with ``spec``."""
    if weights.is_dir():
        return load_published(weights, spec)
    state = load_state_dict_file(weights)
    layers, decoder = shape_of_state_dict(state, weights)
    network = MonodepthResNet(layers, strides=strides, dropout=dropout, decoder=decoder, size=size)
    fill(network, state, str(weights))
    return network


def _network_key(key: str) -> str | None:
    """The network's key for a key of the files; "head." for the finest disparity, None for coarser ones. Unknown keys
    are returned unchanged."""
    match = _CONVOLUTION.fullmatch(key)
    if match is None:
        return key
    number, kind = int(match[1]), match[2]
    if number >= 2 * LEVELS:
        return f"head.{kind}" if number == 2 * LEVELS else None
    return f"levels.{LEVELS - 1 - number // 2}.{'after' if number % 2 else 'before'}.{kind}"


@torch.no_grad()
def _to_imagenet_colours(network: MonodepthResNet) -> None:
    """Rescale the first convolution, in place.

    With ImageNet's x = (c - m) / s for a colour c, Monodepth2's input is (x s + m - .45) / .225: a factor per channel,
    and a constant offset, which is subtracted from batch norm's mean.
    """
    weight, mean = network.encoder.conv1.weight, network.encoder.bn1.running_mean
    s, m = torch.tensor(IMAGENET_STD), torch.tensor(IMAGENET_MEAN)
    offset = (weight * ((m - _MEAN) / _STD)[:, None, None]).sum((1, 2, 3))
    weight.mul_((s / _STD)[:, None, None])
    mean.sub_(offset)

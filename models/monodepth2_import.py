"""Published Monodepth2 weights in a :class:`MonodepthResNet`.

Its repository publishes two state_dicts. ``encoder.pth`` holds torchvision's keys behind "encoder." and the
image size it was trained at. ``depth.pth`` numbers the decoder's convolutions in the order of execution: levels 4
to 0 with two each, then one convolution per scale that ends in disparity.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import torch
from torch import Tensor

from ufmstar_torch.models.checkpoints import CheckpointError, load_state_dict_file
from ufmstar_torch.models.monodepth2 import IMAGENET_MEAN, IMAGENET_STD, LEVELS, MonodepthResNet

# Keys of encoder.pth that are no weights.
_NO_WEIGHTS = ("height", "width", "use_stereo")
# Monodepth2 normalises every colour of an image in [0, 1] by these.
_MEAN, _STD = 0.45, 0.225
_CONVOLUTION = re.compile(r"decoder\.(\d+)(?:\.conv)?\.conv\.(weight|bias)")


@dataclass(frozen=True)
class Imported:
    """The tensors of two files that were loaded, and those that were not."""

    loaded: tuple[str, ...]  # keys of the network that were filled
    skipped: Mapping[str, str]  # keys of the files that were not used, with the reason
    kept: tuple[str, ...]  # keys of the network that stayed as they were; always its head, since disparity is not depth


def load_monodepth2(network: MonodepthResNet, encoder_path: str | Path, depth_path: str | Path) -> Imported:
    """Fill a network's encoder and decoder with published Monodepth2 weights, in place, where shapes allow.

    The result does not predict depth yet: Monodepth2's last convolutions give disparity without a metric
    scale, so the depth head stays untrained and needs fine-tuning. The first convolution is rescaled from
    Monodepth2's normalisation of colours to ImageNet's, exactly but for the border, which is padded with
    ImageNet's mean instead of its grey.

    Args:
        network: with ``strides="v1.5"`` and the number of layers that the files have.
        encoder_path, depth_path: encoder.pth and depth.pth.

    Raises:
        ValueError: the network's strides are not "v1.5".
        FileNotFoundError: a file is missing.
        CheckpointError: a file is damaged, or nothing in it fits the network, which is unchanged then.
    """
    if network.strides != "v1.5":
        raise ValueError(f"Monodepth2's encoders have strides 'v1.5', got a network with {network.strides!r}")
    expected = network.state_dict()
    skipped: dict[str, str] = {}
    loaded: dict[str, Tensor] = {}
    for path, place in ((encoder_path, _encoder_place), (depth_path, _decoder_place)):
        state = load_state_dict_file(path, ignore=_NO_WEIGHTS)
        fitting, unused = {}, {}
        for key, value in state.items():
            try:
                target = place(key)
                _require_fit(value, expected.get(target))
            except ValueError as reason:
                unused[key] = str(reason)
            else:
                fitting[target] = value
        if not fitting:
            why = ": ".join(next(iter(unused.items()), ("it is empty",)))
            raise CheckpointError(f"nothing in {path} fits the network; {why}")
        loaded |= fitting
        skipped |= unused
    _to_imagenet_colours(loaded)
    network.load_state_dict(expected | loaded, strict=True)
    return Imported(tuple(sorted(loaded)), skipped, tuple(sorted(set(expected) - set(loaded))))


def _encoder_place(key: str) -> str:
    """The network's key for one of encoder.pth. Raises ValueError: there is none."""
    if key.startswith("encoder.fc."):
        raise ValueError("the classifier is not used")
    return key


def _decoder_place(key: str) -> str:
    """The network's key for one of depth.pth. Raises ValueError: there is none."""
    match = _CONVOLUTION.fullmatch(key)
    if match is None:
        raise ValueError("not a key of Monodepth2's decoder")
    number, kind = int(match[1]), match[2]
    if number >= 2 * LEVELS:
        raise ValueError("disparity is not metric depth")
    return f"levels.{LEVELS - 1 - number // 2}.{'after' if number % 2 else 'before'}.{kind}"


def _require_fit(value: Tensor, expected: Tensor | None) -> None:
    """Raises ValueError unless a tensor can fill the network's."""
    if expected is None:
        raise ValueError("the network has no such tensor")
    if value.shape != expected.shape:
        raise ValueError(f"is {tuple(value.shape)}, expected {tuple(expected.shape)}")
    if not torch.isfinite(value).all():
        raise ValueError("has NaN or infinity")


def _to_imagenet_colours(loaded: dict[str, Tensor]) -> None:
    """Rescale the first convolution, in place.

    With ImageNet's x = (c - m) / s for a colour c, Monodepth2's input is (x s + m - .45) / .225: a factor per
    channel, and an offset, constant over the image, that batch norm subtracts again with its mean.
    """
    weight, mean = loaded.get("encoder.conv1.weight"), loaded.get("encoder.bn1.running_mean")
    if weight is None or mean is None:
        return
    s, m = torch.tensor(IMAGENET_STD), torch.tensor(IMAGENET_MEAN)
    offset = (weight * ((m - _MEAN) / _STD)[:, None, None]).sum((1, 2, 3))
    loaded["encoder.conv1.weight"] = weight * (s / _STD)[:, None, None]
    loaded["encoder.bn1.running_mean"] = mean - offset

"""ResNet50-Monodepth2: a ResNet encoder with Monodepth2's U-Net decoder (Godard et al., ICCV 2019), predicting
metric depth.

Written from the paper (section 3 and the supplementary's table of layers): five levels of 3x3 convolution, ELU,
nearest-neighbour upsampling by 2, concatenation with the encoder's features and another 3x3 convolution, with reflected
borders. Instead of Monodepth2's sigmoid disparities at four scales, one convolution and a softplus give depth in metres
at full resolution.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from ufmstar_torch.models.checkpoints import channels_of, fill, load_state_dict_file
from ufmstar_torch.models.dropout import DecoderDropout
from ufmstar_torch.models.network import INITIAL_DEPTH, MULTIPLE, Backbone, fits, require_image
from ufmstar_torch.models.preprocess import Preprocess
from ufmstar_torch.runtime.kinds import check_kinds
from ufmstar_torch.runtime.optional import optional

SMALLEST = 64  # [px] reflection padding needs maps of more than one pixel
LEVELS = 5
LAYERS = (18, 34, 50)
STRIDES = ("v1.5", "v1")
# Channels of the decoder's levels, from full resolution down to 1/16 (Godard et al., supplementary).
DECODER_WIDTHS = (16, 32, 64, 128, 256)
# ImageNet's colour statistics, for RGB in [0, 1].
IMAGENET_MEAN = (0.485, 0.456, 0.406)
IMAGENET_STD = (0.229, 0.224, 0.225)


class ResNetEncoder(nn.Module):
    """torchvision's ResNet without its classifier, with torchvision's keys.

    Args:
        layers: 18, 34 or 50.
        strides: the strided convolution of a bottleneck: "v1.5", the 3x3 convolution, as in torchvision, or "v1", the
            1x1 before it, as in the original paper. Weights are trained for one of them and do not state it. There are
            no bottlenecks in 18 and 34 layers.

    Raises:
        ValueError: other layers or strides.
        ModuleNotFoundError: torchvision is not installed.
    """

    def __init__(self, layers: int = 50, strides: str = "v1.5") -> None:
        super().__init__()
        if layers not in LAYERS:
            raise ValueError(f"layers must be one of {LAYERS}, got {layers}")
        if strides not in STRIDES:
            raise ValueError(f"strides must be one of {STRIDES}, got {strides!r}")
        resnet = _torchvision_models().get_model(f"resnet{layers}", weights=None)
        self.conv1, self.bn1 = resnet.conv1, resnet.bn1
        self.layer1, self.layer2, self.layer3, self.layer4 = resnet.layer1, resnet.layer2, resnet.layer3, resnet.layer4
        # At 1/2, 1/4, 1/8, 1/16 and 1/32 of the resolution.
        self.channels = (64, *(resnet.fc.in_features // 2**i for i in (3, 2, 1, 0)))
        if strides == "v1" and layers >= 50:
            for stage in (self.layer2, self.layer3, self.layer4):
                stage[0].conv1.stride, stage[0].conv2.stride = stage[0].conv2.stride, stage[0].conv1.stride

    def forward(self, image: Tensor) -> list[Tensor]:
        """Five maps [B, channels[i], H / 2^(i+1), W / 2^(i+1)] of ``image`` [B, 3, H, W]."""
        maps = [F.relu(self.bn1(self.conv1(image)))]
        x = F.max_pool2d(maps[0], 3, stride=2, padding=1)
        for stage in (self.layer1, self.layer2, self.layer3, self.layer4):
            x = stage(x)
            maps.append(x)
        return maps


class UpConvolution(nn.Module):
    """One level of the decoder: convolution, dropout with probability ``between``, upsampling by 2, concatenation with
    the skip, convolution, dropout with probability ``dropout``."""

    def __init__(self, inputs: int, skip: int, outputs: int, dropout: float, between: float) -> None:
        super().__init__()
        self.before = _convolution(inputs, outputs)
        self.after = _convolution(outputs + skip, outputs)
        self.between = DecoderDropout(between) if between else nn.Identity()
        self.dropout = DecoderDropout(dropout)

    def forward(self, x: Tensor, skip: Tensor | None) -> Tensor:
        x = F.interpolate(self.between(F.elu(self.before(x))), scale_factor=2.0, mode="nearest")
        x = x if skip is None else torch.cat([x, skip], 1)
        return self.dropout(F.elu(self.after(x)))


class MonodepthResNet(Backbone):
    """Monocular metric depth with a ResNet encoder and Monodepth2's decoder.

    ``preprocess`` gives NYU's crop, 224 x 224, normalised by ImageNet's colour statistics. The weights are initialised
    for training from scratch (depth about :data:`INITIAL_DEPTH` everywhere); :meth:`imagenet`, ``load_monodepth2`` and
    ``load_network`` load trained ones.

    Args:
        layers: of the encoder, 18, 34 or 50.
        strides: of the encoder, "v1.5" or "v1": see :class:`ResNetEncoder`.
        dropout: probability of decoder dropout, after each of the five levels.
        dropout_both: dropout after both convolutions of a level instead of the second only.
        decoder: channels of the five levels, full resolution first.
        disparity: (least, largest) depth in units of ``scale`` [m]: the last convolution's sigmoid interpolates between
            their inverses, as in Monodepth2; None = its softplus is depth.
        size: (height, width) [px] of the input, multiples of 32 and at least 64.

    Raises:
        ValueError: an argument is out of range.
        ModuleNotFoundError: torchvision is not installed.
    """

    @check_kinds
    def __init__(
        self,
        layers: int = 50,
        *,
        strides: str = "v1.5",
        dropout: float = 0.0,
        dropout_both: bool = False,
        decoder: tuple[int, ...] = DECODER_WIDTHS,
        disparity: tuple[float, float] | None = None,
        scale: float = 1.0,
        size: tuple[int, int] = (224, 224),
    ) -> None:
        super().__init__()
        if not (disparity is None or 0 < disparity[0] < disparity[1]) or not 0 < scale < math.inf:
            raise ValueError(f"disparity must be (least, largest) and scale positive, got {disparity} and {scale}")
        self.disparity, self.scale = disparity, scale
        if len(decoder) != LEVELS or min(decoder) < 1:
            raise ValueError(f"decoder must be {LEVELS} positive numbers of channels, got {decoder}")
        if not fits(*size, MULTIPLE, SMALLEST):
            raise ValueError(f"size must be multiples of {MULTIPLE} px, at least {SMALLEST}, got {size}")
        self.layers, self.strides = layers, strides
        self.preprocess = Preprocess.nyu(size, mean=IMAGENET_MEAN, std=IMAGENET_STD)
        self.feature_channels, self._widths = decoder[0], tuple(decoder)
        self.encoder = ResNetEncoder(layers, strides)
        skips = (0, *self.encoder.channels[:-1])  # of levels 0 to 4
        inputs = (*decoder[1:], self.encoder.channels[-1])
        # levels[i] returns features at 1/2^i of the resolution; level 4 runs first.
        self.levels = nn.ModuleList(
            UpConvolution(inputs[i], skips[i], decoder[i], dropout, dropout if dropout_both else 0.0)
            for i in range(LEVELS)
        )
        self.head = _convolution(decoder[0], 1)
        assert self.head.bias is not None
        nn.init.constant_(self.head.bias, math.log(math.expm1(INITIAL_DEPTH)))

    @property
    def pyramid_channels(self) -> tuple[int, ...]:
        """Channels at full resolution, 1/2, 1/4, 1/8 and 1/16."""
        return self._widths

    def features(self, image: Tensor) -> Tensor:
        """The decoder's output [B, decoder[0], H, W], the head's input; arguments as :meth:`pyramid`."""
        return self.pyramid(image)[0]

    def pyramid(self, image: Tensor) -> list[Tensor]:
        """The outputs of the decoder's five levels, [B, pyramid_channels[s], H / 2^s, W / 2^s], full resolution first,
        of ``image`` [B, 3, H, W], normalised as by ``preprocess``. Raises ValueError: another shape or type, or H or W
        no multiple of 32 from 64 on."""
        require_image(image, MULTIPLE, SMALLEST)
        skips = self.encoder(image)
        x, maps = skips.pop(), []
        for level in reversed(self.levels):
            x = level(x, skips.pop() if skips else None)
            maps.append(x)
        return maps[::-1]

    def depth(self, features: Tensor) -> Tensor:
        """Depth [B, H, W] [m] from :meth:`features`: a 3x3 convolution and softplus, or the inverse of a disparity."""
        raw = self.head(features)[:, 0]
        if self.disparity is None:
            return F.softplus(raw)
        far, near = (1 / depth for depth in reversed(self.disparity))
        return self.scale / (far + (near - far) * raw.sigmoid())

    @property
    def max_depth(self) -> float | None:
        """[m] The largest depth of a disparity."""
        return None if self.disparity is None else self.scale * self.disparity[1]

    @classmethod
    def imagenet(
        cls, weights: Any = None, layers: int = 50, *, strides: str = "v1.5", **options: Any
    ) -> MonodepthResNet:
        """The network with an encoder trained on ImageNet and an untrained decoder.

        Args:
            weights: a file (.pth, .safetensors, ...) with torchvision's keys, with or without classifier, of any
                floating-point dtype (a batch norm's variance that overflowed to infinity in float16 is set to its
                largest number, 65504); or one of torchvision's weights enums, which it downloads once; None:
                torchvision's default for these layers.
            layers: 18, 34 or 50.
            strides: of the weights' training; "v1.5" for torchvision's weights.
            options: other arguments of the class.

        Raises:
            FileNotFoundError: there is no such file.
            CheckpointError: the file does not fit the encoder tensor by tensor.
            ValueError: an argument is out of range, or torchvision's weights with strides "v1".
        """
        network = cls(layers, strides=strides, **options)
        if weights is None:
            weights = _torchvision_models().get_model_weights(f"resnet{layers}").DEFAULT
        if isinstance(weights, str | Path):
            state = load_state_dict_file(weights)
        elif strides != "v1.5":
            raise ValueError(f"torchvision's weights have strides 'v1.5', got strides={strides!r}")
        else:
            state = weights.get_state_dict(progress=False, check_hash=True)
        _fill_encoder(network.encoder, state, str(weights))
        return network


def shape_of_state_dict(state: Mapping[str, Tensor], source: object) -> tuple[int, tuple[int, ...]]:
    """(layers, decoder) of the :class:`MonodepthResNet` of a state_dict, which does not determine the strides. Errors
    as ``channels_of``."""
    keys = ["encoder.layer1.0.conv2.weight", *(f"levels.{i}.before.weight" for i in range(LEVELS))]
    _, *decoder = channels_of(state, keys, "MonodepthResNet", source)
    return layers_of(state), tuple(decoder)


def layers_of(state: Mapping[str, Any]) -> int:
    """Layers of the ResNet under "encoder.": its first stage has two (18) or three (34) blocks of two convolutions, or
    three blocks of three (50)."""
    deep = 34 if "encoder.layer1.2.conv1.weight" in state else 18
    return 50 if "encoder.layer1.0.conv3.weight" in state else deep


def _fill_encoder(encoder: ResNetEncoder, state: Mapping[str, Tensor], source: str) -> None:
    """Load the weights of a ResNet without the classifier's; errors as ``checkpoints.fill``."""
    # Files older than PyTorch 0.4.1 lack num_batches_tracked, which is not used.
    filled = {key: value for key, value in encoder.state_dict().items() if key.endswith("num_batches_tracked")}
    filled |= {key: value for key, value in state.items() if not key.startswith("fc.")}
    for key, value in filled.items():
        if value.dtype == torch.float16 and key.endswith("running_var"):
            # A variance that overflowed to infinity would make its channel constant.
            filled[key] = value.clamp(max=torch.finfo(torch.float16).max)
    fill(encoder, filled, source)


def _convolution(inputs: int, outputs: int) -> nn.Conv2d:
    return nn.Conv2d(inputs, outputs, 3, padding=1, padding_mode="reflect")


def _torchvision_models() -> Any:
    """torchvision.models, imported lazily, because that takes seconds."""
    return optional("torchvision.models", "a ResNet encoder needs torchvision", "torchvision")

"""FastDepth (Wofk et al., ICRA 2019): MobileNet encoder, depthwise NNConv5 decoder, additive skips.

The encoder is MobileNet (v1): a strided convolution and 13 pairs of a 3x3 depthwise and a 1x1 pointwise convolution,
down to 1/32 of the resolution. Each of the decoder's five layers is a 5x5 depthwise and a 1x1 pointwise convolution,
followed by nearest-neighbour upsampling by 2; the encoder's features at 1/8, 1/4 and 1/2 are added to the results. A
last 1x1 convolution gives depth in metres. The channel widths are arguments, because the published network is pruned
to irregular ones.
"""

from __future__ import annotations

import copy
import math
import warnings
from collections.abc import Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass
from importlib.util import find_spec
from itertools import pairwise
from pathlib import Path
from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor, nn
from torch.nn.utils.fusion import fuse_conv_bn_eval

from ufmstar_torch.models.checkpoints import channels_of, fill, load_state_dict_file
from ufmstar_torch.models.dropout import DecoderDropout
from ufmstar_torch.models.network import INITIAL_DEPTH, MULTIPLE, Backbone, DepthNetwork, require_image
from ufmstar_torch.models.onnx_network import OnnxNetwork, OnnxSpec, providers_for
from ufmstar_torch.models.onnx_weights import read_convolutions
from ufmstar_torch.models.outputs import METRIC, OutputSpec, PlainSpec
from ufmstar_torch.models.preprocess import Preprocess
from ufmstar_torch.runtime.kinds import check_fields, check_kinds

# Strides of the encoder's stem and 13 blocks.
_STRIDES = (2, 1, 2, 1, 2, 1, 2, 1, 1, 1, 1, 1, 2, 1)
# Decoder layer -> the encoder block (at 1/8, 1/4, 1/2 of the resolution) added to its doubled output.
_SKIPS = {1: 5, 2: 3, 3: 1}
# [1] Largest difference between ONNX Runtime's depth and the network's, over the largest depth, that is rounding.
_AGREEMENT = 1e-3
# The last activation, and its input for INITIAL_DEPTH.
_POSITIVE: dict[str, tuple[type[nn.Module], float]] = {
    "relu": (nn.ReLU, INITIAL_DEPTH),
    "softplus": (nn.Softplus, math.log(math.expm1(INITIAL_DEPTH))),
}


@dataclass(frozen=True)
class FastDepthWidths:
    """Channels after the encoder's stem and 13 blocks, and after the decoder's 5 layers. Raises ValueError: not 14 and
    5 positive numbers, or different widths at the two ends of a skip connection."""

    encoder: tuple[int, ...]
    decoder: tuple[int, ...]

    def __post_init__(self) -> None:
        check_fields(self)
        for name, count in (("encoder", len(_STRIDES)), ("decoder", 5)):
            value = getattr(self, name)
            if len(value) != count or min(value) < 1:
                raise ValueError(f"FastDepthWidths.{name} must be {count} positive numbers, got {value}")
        for d, e in _SKIPS.items():
            if self.decoder[d] != self.encoder[e]:
                raise ValueError(
                    f"FastDepthWidths: decoder[{d}] = {self.decoder[d]} must equal encoder[{e}] = "
                    f"{self.encoder[e]}, which is added to it"
                )

    @classmethod
    def full(cls) -> FastDepthWidths:
        """MobileNet's widths."""
        return cls((32, 64, 128, 128, 256, 256, *[512] * 6, 1024, 1024), (512, 256, 128, 64, 32))

    @classmethod
    def pruned(cls) -> FastDepthWidths:
        """The widths of the network trained on NYU Depth V2 and pruned by NetAdapt."""
        encoder = (16, 56, 88, 120, 144, 256, 408, 376, 272, 288, 296, 328, 480, 512)
        return cls(encoder, (200, 256, 120, 56, 16))

    @classmethod
    @check_kinds
    def scaled(cls, multiplier: float) -> FastDepthWidths:
        """:meth:`full` times MobileNet's width multiplier: multiples of 8, at least .9 of the exact width.
        Raises ValueError: the multiplier is not positive."""
        if not 0 < multiplier < float("inf"):
            raise ValueError(f"the width multiplier must be positive, got {multiplier}")

        def scale(width: int) -> int:
            exact = width * multiplier
            rounded = max(8, int(exact + 4) // 8 * 8)
            return rounded if rounded >= 0.9 * exact else rounded + 8

        full = cls.full()
        return cls(tuple(map(scale, full.encoder)), tuple(map(scale, full.decoder)))

    @classmethod
    def of_state_dict(cls, state: Mapping[str, Tensor], source: object) -> FastDepthWidths:
        """The widths of a :class:`FastDepth` from its state_dict; errors as ``channels_of``."""
        count = len(_STRIDES)
        units = [*(f"encoder.{i}.pointwise" for i in range(1, count)), *(f"decoder.{i}.pointwise" for i in range(5))]
        widths = channels_of(state, [f"{unit}.conv.weight" for unit in ("encoder.0", *units)], "FastDepth", source)
        return cls(widths[:count], widths[count:])


class ConvUnit(nn.Module):
    """Convolution with "same" padding, batch norm (or a bias, if it is folded), activation."""

    def __init__(
        self, inputs: int, outputs: int, kernel: int, *, stride: int = 1, groups: int = 1, relu6: bool, norm: bool
    ) -> None:
        super().__init__()
        self.conv = nn.Conv2d(inputs, outputs, kernel, stride=stride, padding=kernel // 2, groups=groups, bias=not norm)
        self.norm = nn.BatchNorm2d(outputs) if norm else nn.Identity()
        self.activation: nn.Module = nn.ReLU6() if relu6 else nn.ReLU()

    def forward(self, x: Tensor) -> Tensor:
        return self.activation(self.norm(self.conv(x)))


class SeparableUnit(nn.Module):
    """A depthwise and a pointwise :class:`ConvUnit`, with dropout between them."""

    def __init__(
        self, inputs: int, outputs: int, kernel: int, *, stride: int = 1, relu6: bool, norm: bool, dropout: float = 0.0
    ) -> None:
        super().__init__()
        self.depthwise = ConvUnit(inputs, inputs, kernel, stride=stride, groups=inputs, relu6=relu6, norm=norm)
        self.dropout = DecoderDropout(dropout) if dropout else nn.Identity()
        self.pointwise = ConvUnit(inputs, outputs, 1, relu6=relu6, norm=norm)

    def forward(self, x: Tensor) -> Tensor:
        return self.pointwise(self.dropout(self.depthwise(x)))


class FastDepth(Backbone):
    """Monocular metric depth at 224 x 224 for small computers.

    ``preprocess`` gives the centre crop of NYU's validation, RGB in [0, 1]. The weights are initialised for training
    from scratch; :meth:`from_onnx` and ``load_network`` load trained ones.

    Args:
        widths: channels of every layer.
        norm: batch norm after every convolution; False for weights with folded batch norms, which can be trained
            further as plain convolutions with a bias.
        dropout: probability of decoder dropout, after the convolutions of every decoder layer.
        dropout_both: dropout after both convolutions of a decoder layer instead of the second only.
        positive: last activation, "relu" as published or "softplus". A ReLU can leave a pixel at 0 without a gradient,
            so softplus suits training from scratch; trained weights require the activation of their training.
        size: (height, width) [px] of the input, multiples of 32.

    Raises:
        ValueError: an argument is out of range.
    """

    @check_kinds
    def __init__(
        self,
        widths: FastDepthWidths | None = None,
        *,
        norm: bool = True,
        dropout: float = 0.0,
        dropout_both: bool = False,
        positive: str = "relu",
        size: tuple[int, int] = (224, 224),
    ) -> None:
        super().__init__()
        if positive not in _POSITIVE:
            raise ValueError(f"positive must be one of {list(_POSITIVE)}, got {positive!r}")
        if any(side % MULTIPLE for side in size):
            raise ValueError(f"size must be multiples of {MULTIPLE} px, got {size}")
        self.widths = widths or FastDepthWidths.full()
        self.feature_channels = self.widths.decoder[-1]
        self.dropout, self.dropout_both = dropout, dropout_both
        self.positive = positive
        self.size = size
        self.preprocess = Preprocess.nyu(size)
        e, d = self.widths.encoder, (self.widths.encoder[-1], *self.widths.decoder)
        stem = ConvUnit(3, e[0], 3, stride=_STRIDES[0], relu6=True, norm=norm)
        self.encoder = nn.ModuleList([stem])
        for inputs, outputs, stride in zip(e, e[1:], _STRIDES[1:], strict=False):
            self.encoder.append(SeparableUnit(inputs, outputs, 3, stride=stride, relu6=True, norm=norm))
        self.decoder = nn.ModuleList(
            SeparableUnit(inputs, outputs, 5, relu6=False, norm=norm, dropout=dropout if dropout_both else 0.0)
            for inputs, outputs in pairwise(d)
        )
        self.dropouts = nn.ModuleList(DecoderDropout(dropout) for _ in self.decoder)
        self.head = ConvUnit(d[-1], 1, 1, relu6=False, norm=norm)
        activation, start = _POSITIVE[positive]
        self.head.activation = activation()
        nn.init.constant_(self.head.get_parameter("norm.bias" if norm else "conv.bias"), start)

    @property
    def pyramid_channels(self) -> tuple[int, ...]:
        """Channels at full resolution, 1/2, 1/4, 1/8 and 1/16."""
        return self.widths.decoder[::-1]

    def features(self, image: Tensor) -> Tensor:
        """The decoder's output [B, widths.decoder[-1], H, W], the head's input; arguments as :meth:`pyramid`."""
        return self.pyramid(image)[0]

    def pyramid(self, image: Tensor) -> list[Tensor]:
        """The outputs of the decoder's five layers, [B, pyramid_channels[s], H / 2^s, W / 2^s], full resolution first,
        of ``image`` [B, 3, H, W], RGB in [0, 1]. Raises ValueError: another shape or type, or H or W no multiple of
        32."""
        require_image(image, MULTIPLE)
        x, skips, maps = image, {}, []
        for i, block in enumerate(self.encoder):
            x = block(x)
            if i in _SKIPS.values():
                skips[i] = x
        for i, (block, dropout) in enumerate(zip(self.decoder, self.dropouts, strict=True)):
            x = F.interpolate(dropout(block(x)), scale_factor=2.0, mode="nearest")
            if i in _SKIPS:
                x = x + skips[_SKIPS[i]]
            maps.append(x)
        return maps[::-1]

    def depth(self, features: Tensor) -> Tensor:
        """Depth [B, H, W] [m] from :meth:`features`, at least 0 (where the last ReLU is 0, there is no prediction)."""
        return self.head(features)[:, 0]

    @classmethod
    @check_kinds
    def from_onnx(cls, path: str | Path, *, dropout: float = 0.0, size: tuple[int, int] = (224, 224)) -> FastDepth:
        """The network with the weights of an ONNX export, in eval mode.

        The file determines the widths. Every weight in it must be used and every parameter filled, and on one random
        image the network must agree with ONNX Runtime; without that package, a warning states that this was not tested.
        Batch norms stay separate, so that fine-tuning is possible after ``.train()``; a file with folded batch norms
        gives a network without norm layers (``norm=False``).

        Args:
            path: the ONNX file.
            dropout, size: as in the class.

        Raises:
            ModuleNotFoundError: ``onnx`` is not installed (extra ``models``).
            FileNotFoundError: there is no such file.
            ValueError: the file is broken or holds another network.
        """
        layers, expected = read_convolutions(path), 2 * (len(_STRIDES) + 5)  # pairs, except for the first and the last
        if len(layers) != expected:
            raise ValueError(f"{path} is not a FastDepth: expected {expected} convolutions, got {len(layers)}")
        folded = {not layer.norm for layer in layers}
        if len(folded) != 1:
            raise ValueError(f"{path} has batch norm after some convolutions only; export all or none folded")
        outputs = [layer.weight.shape[0] for layer in layers]
        encoder, decoder = (outputs[0], *outputs[2:27:2]), tuple(outputs[28:37:2])
        network = cls(FastDepthWidths(encoder, decoder), norm=not folded.pop(), dropout=dropout, size=size)
        state: dict[str, Tensor] = {}
        for (name, unit), layer in zip(network._units(), layers, strict=True):
            state |= {f"{name}.{key}": value for key, value in layer.state().items()}
            if isinstance(unit.norm, nn.BatchNorm2d):
                unit.norm.eps = layer.norm_eps
        fill(network, state, str(path))
        _require_same_function(network.eval(), path)
        return network

    def folded(self) -> FastDepth:
        """A copy for inference with every batch norm folded into its convolution, in eval mode: the same function up to
        rounding, in about three quarters of the time on a CPU."""
        options = {name: getattr(self, name) for name in ("dropout", "dropout_both", "positive", "size")}
        network = FastDepth(self.widths, norm=False, **options)
        network.preprocess = self.preprocess
        for (_, source), (_, target) in zip(self._units(), network._units(), strict=True):
            conv, norm = source.conv, source.norm
            if isinstance(norm, nn.BatchNorm2d):
                conv = fuse_conv_bn_eval(copy.deepcopy(conv).eval(), copy.deepcopy(norm).eval())
            target.conv.load_state_dict(conv.state_dict())
        return network.to(self.head.conv.weight).eval()

    def _units(self) -> Iterator[tuple[str, ConvUnit]]:
        """The convolutions in the order of execution."""
        for name, module in self.named_modules():
            if isinstance(module, ConvUnit):
                yield name, module


def load_fastdepth(
    weights: Path,
    size: tuple[int, int] = (224, 224),
    dropout: float = 0.0,
    positive: str = "relu",
    *,
    runtime: str = "auto",
    threads: int | None = None,
    device: torch.device | str = "cpu",
) -> DepthNetwork:
    """Load the network from an ONNX export or a state_dict file, which determines its widths.

    Args:
        weights: the file.
        size, dropout, positive: as in :class:`FastDepth`.
        runtime: "auto": an ONNX export without dropout runs in ONNX Runtime if that is installed and has a provider for
            the device; "onnx": it runs there if possible, also without such a provider; "torch": a :class:`FastDepth`,
            which can be trained.
        threads: of ONNX Runtime; None: torch's number.
        device: device of the inference.

    Raises:
        ValueError: the file does not fit, ``runtime`` is unknown, or ``positive`` contradicts an ONNX export, which
            ends in a ReLU.
        FileNotFoundError, ModuleNotFoundError: as :meth:`FastDepth.from_onnx` and ``load_state_dict_file``.
    """
    if runtime not in ("auto", "onnx", "torch"):
        raise ValueError(f"runtime must be 'auto', 'onnx' or 'torch', got {runtime!r}")
    threads = threads or torch.get_num_threads()
    if weights.suffix == ".onnx":
        if positive != "relu":
            raise ValueError(f"an ONNX export of FastDepth ends in a ReLU, got positive={positive!r}")
        network = FastDepth.from_onnx(weights, dropout=dropout, size=size)
        return _graph(network, weights, runtime, threads, torch.device(device)) or network
    state = load_state_dict_file(weights)
    widths, norm = FastDepthWidths.of_state_dict(state, weights), "encoder.0.norm.weight" in state
    network = FastDepth(widths, norm=norm, dropout=dropout, positive=positive, size=size)
    fill(network, state, str(weights))
    return network


def _graph(network: FastDepth, weights: Path, runtime: str, threads: int, device: torch.device) -> OnnxNetwork | None:
    """The file in ONNX Runtime if it can replace the network, else None."""
    if network.dropout or runtime == "torch" or (runtime == "auto" and find_spec("onnxruntime") is None):
        return None
    providers = providers_for(device)
    if runtime == "auto" and device.type != "cpu" and len(providers) == 1:
        return None
    graph = OnnxNetwork(weights, OnnxSpec(OutputSpec(METRIC)), threads=threads, providers=providers)
    if any(fixed not in (None, side) for fixed, side in zip(graph.size, network.size, strict=True)):
        return None
    graph.preprocess = network.preprocess
    return graph


def load_graph(weights: Path, spec: OnnxSpec | PlainSpec | None = None, **options: Any) -> OnnxNetwork:
    """As :class:`OnnxNetwork`; without ``preprocess`` in the spec, a FastDepth gets NYU's crop instead of a stretched
    image."""
    network = OnnxNetwork(weights, spec, **options)
    if network.spec.preprocess is None and find_spec("onnx") is not None:
        with suppress(ValueError):  # another network
            FastDepth.from_onnx(weights)
            network.preprocess = Preprocess.nyu(network.preprocess.size or (224, 224))
    return network


def _require_same_function(network: FastDepth, path: str | Path) -> None:
    """Raise a ValueError if ONNX Runtime returns another depth than the network, on an image of large noise, which
    reaches both limits of the activations."""
    if find_spec("onnxruntime") is None:
        warnings.warn(
            f"without onnxruntime, {path} runs in torch, more slowly, and is not compared with its graph: "
            "pip install 'ufmstar-torch[models]'",
            stacklevel=3,
        )
        return
    graph = OnnxNetwork(path, OnnxSpec(OutputSpec(METRIC)), threads=1)
    size = [side or 2 * MULTIPLE for side in graph.size]
    image = 8 * torch.rand(graph.batch or 1, 3, *size, generator=torch.Generator().manual_seed(0)) - 4
    with torch.inference_mode():
        try:
            depth, expected = network(image).depth, graph(image).depth
        except ValueError as error:
            raise ValueError(f"{path} is not a FastDepth: {error}") from error
    apart, largest = float((depth - expected).abs().max()), float(expected.abs().max())
    if not apart <= _AGREEMENT * largest:
        raise ValueError(
            f"{path} is not a FastDepth: its graph computes another depth from the same weights (up to {apart:.3g} m "
            f"apart, of at most {largest:.3g} m)"
        )

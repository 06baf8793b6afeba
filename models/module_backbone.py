"""Any network below an uncertainty head: an ``nn.Module`` that returns depth or features, or a depth model of
``transformers``.

The inputs of the head are the input of the network's last convolution, and the depth.
"""

from __future__ import annotations

import math
from contextlib import ExitStack, nullcontext
from dataclasses import dataclass
from functools import partial
from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from ufmstar_torch.frames.prediction import DepthPrediction, takes_intrinsics
from ufmstar_torch.models.dropout import DecoderDropout
from ufmstar_torch.models.heads import resized
from ufmstar_torch.models.hugging_face import HuggingFaceDepth, HuggingFaceSpec
from ufmstar_torch.models.hugging_face_checkpoint import Checkpoint, read_checkpoint
from ufmstar_torch.models.network import INITIAL_DEPTH, Backbone, in_eval_mode
from ufmstar_torch.models.outputs import as_map
from ufmstar_torch.models.preprocess import Preprocess
from ufmstar_torch.runtime.checked import Checked

_PROBE = (480, 640)  # [px] of the grey image for a test inference


@dataclass(frozen=True)
class ModuleSpec(Checked):
    """A network below a head, without its weights; made by :meth:`of`.

    Attributes:
        source: its class, or the directory or hub name of its checkpoint.
        preprocess: preprocessing of its input.
        part: dotted name of the submodule whose input is the head's input; "" = the image; None = the network's output,
            features without a depth.
        channels: of the head's input, without the depth.
        checkpoint: config.json and preprocessor_config.json of ``transformers``; None: a module built in Python.
        declared: declarations about that checkpoint.
    """

    source: str
    preprocess: Preprocess
    part: str | None
    channels: int
    checkpoint: dict[str, Any] | None = None
    declared: HuggingFaceSpec | None = None

    @classmethod
    def of(cls, network: nn.Module, preprocess: Preprocess, part: str | None = None, **about: Any) -> ModuleSpec:
        """The specification of a network, determined by one inference.

        Args:
            network: returns depth [B, 1, H, W] or [B, H, W] [m], of its input's size or smaller, a
                ``DepthPrediction``, or features [B, C, h, w].
            preprocess: preprocessing of its input.
            part: the submodule whose input is the head's input; None = the last ``nn.Conv2d`` that runs.
            about: other fields.

        Raises:
            ValueError: another output, a network that needs intrinsics, or no such submodule.
        """
        if takes_intrinsics(network):
            raise ValueError("backbone: a network that takes intrinsics cannot have a head")
        named = {name: m for name, m in network.named_modules() if isinstance(m, nn.Conv2d) or name == part}
        if part is not None and part not in named:
            raise ValueError(
                f"features: the network has no part {part!r}; it has {[n for n, _ in network.named_children()]}"
            )
        read: dict[str, int] = {}

        def note(name: str, _: nn.Module, inputs: tuple[Any, ...], by_name: dict[str, Any]) -> None:
            value = next(iter((*inputs, *by_name.values())), None)
            if part in (None, name) and isinstance(value, Tensor) and value.dim() == 4:
                read.pop(name, None)  # to keep the order of the last calls
                read[name] = value.shape[1]

        image = preprocess.apply_image(torch.full((1, 3, *_PROBE), 128, dtype=torch.uint8))
        first = next(network.parameters(), image)
        with ExitStack() as hooks, in_eval_mode(network):
            for name, module in named.items():
                hooks.enter_context(module.register_forward_pre_hook(partial(note, name), with_kwargs=True))
            output = network(image.to(first.device, first.dtype))
        source = about.pop("source", type(network).__name__)
        if _is_features(output):
            return cls(source, preprocess, None, output.shape[1], **about)
        _depth_of(output)
        if part is not None and not read:
            raise ValueError(f"features: {part!r} gets no map [B, C, h, w]")
        return cls(source, preprocess, *(list(read.items())[-1] if read else ("", 3)), **about)

    def build(self, weights: bool = False) -> nn.Module:
        """Build the network of a checkpoint, with its ``weights`` or random ones. Raises ValueError: the network has no
        checkpoint; others as ``from_hugging_face``."""
        if self.checkpoint is None:
            raise ValueError(
                f"{self.source} is a network of your own, which must be built in Python: "
                "load_network('trained', FILE, backbone=NETWORK)"
            )
        declared = self.declared or HuggingFaceSpec()
        read = read_checkpoint(self.source) if weights else Checkpoint(self.source, **self.checkpoint, options={})
        network: nn.Module = HuggingFaceDepth(read, declared).aligned(declared.alignment)
        return network


class ModuleBackbone(Backbone):
    """A network below a head; ``features`` are the input of its ``part``, at the image's resolution, and the depth.

    Args:
        network: becomes a submodule. If none of its parameters is trained, it stays in eval mode.
        spec: of the network.
        dropout: probability of dropout on the input of ``part``.
    """

    def __init__(self, network: nn.Module, spec: ModuleSpec, dropout: float = 0.0) -> None:
        super().__init__()
        self.network, self.part, self.preprocess = network, spec.part, spec.preprocess
        self.dropout = DecoderDropout(dropout)
        self.feature_channels = spec.channels + 1
        if spec.part is None:
            self.last = nn.Conv2d(spec.channels, 1, 3, padding=1)
            assert self.last.bias is not None
            nn.init.constant_(self.last.bias, math.log(math.expm1(INITIAL_DEPTH)))

    @property
    def wrapped(self) -> tuple[nn.Module]:
        """The network."""
        return (self.network,)

    def train(self, mode: bool = True) -> ModuleBackbone:
        """See ``nn.Module``; a network without trained parameters stays in eval mode."""
        super().train(mode)
        if not any(p.requires_grad for p in self.network.parameters()):
            self.network.eval()
        return self

    def features(self, image: Tensor) -> Tensor:
        """[B, channels + 1, H, W] of ``image`` [B, 3, H, W]. Raises ValueError: the network's output contradicts its
        specification."""
        size, read = (image.shape[-2], image.shape[-1]), [image]

        def replace(_: nn.Module, inputs: tuple[Any, ...], by_name: dict[str, Any]) -> Any:
            first, *others = (*inputs, *by_name.values())
            read[0] = self.dropout(first)
            values = [read[0], *others]
            named = dict(zip(by_name, values[len(inputs) :], strict=True))
            return tuple(values[: len(inputs)]), named

        # The hook exists during a call only: copies of the network or its layers must not contain it.
        part = self.network.get_submodule(self.part) if self.part else None
        with nullcontext() if part is None else part.register_forward_pre_hook(replace, with_kwargs=True):
            output = self.network(image)
        if self.part is None:
            if not _is_features(output):
                raise ValueError("the network must return features [B, C, h, w], as its specification states")
            read[0] = self.dropout(output)
            depth = F.softplus(resized(self.last(read[0]), size))
        else:
            depth = resized(_depth_of(output)[:, None], size)
        return torch.cat([resized(read[0], size).to(depth.dtype), depth], 1)

    def depth(self, features: Tensor) -> Tensor:
        """[B, H, W] [m]: the last channel of :meth:`features`."""
        return features[:, -1]


def _is_features(output: Any) -> bool:
    return isinstance(output, Tensor) and output.dim() == 4 and output.shape[1] > 1 and output.shape[3] > 1


def _depth_of(output: Any) -> Tensor:
    """The depth [B, H, W] in a network's output."""
    if isinstance(output, DepthPrediction):
        return output.depth
    if isinstance(output, Tensor):
        return as_map(output, "the network's depth")
    raise ValueError(
        f"a network below a head must return depth, features [B, C, h, w] or a DepthPrediction, got "
        f"{type(output).__name__}; declare its outputs by wrap_network(network, output=...)"
    )

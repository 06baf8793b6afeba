"""The base classes of all depth networks."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor, nn

from ufmstar_torch.models.preprocess import Preprocess
from ufmstar_torch.prediction import DepthPrediction, stated_range, states_confidence, takes_intrinsics

if TYPE_CHECKING:
    from ufmstar_torch.models.outputs import OutputSpec


class DepthNetwork(nn.Module, ABC):
    """A monocular network that predicts metric depth.

    ``x, K = network.preprocess(image, intrinsics)`` turns a camera image into the network's input ``x``
    [B, 3, H, W] with its intrinsics K, and ``network(x)`` is a :class:`DepthPrediction` at that resolution.
    """

    preprocess: Preprocess

    @property
    def wrapped(self) -> Sequence[nn.Module]:
        """The networks that this one calls; its declarations below are theirs."""
        return ()

    @property
    def takes_intrinsics(self) -> bool:
        """True if it is called as ``network(x, K)``, with K [B, 3, 3] of ``x`` [px]."""
        return any(takes_intrinsics(network) for network in self.wrapped)

    @property
    def max_depth(self) -> float | None:
        """[m] The largest depth that it can predict; None where it is not bounded, or not known."""
        return stated_range(self.wrapped)

    @property
    def states_confidence(self) -> bool:
        """True if its predictions have a ``confidence``."""
        return states_confidence(self.wrapped)

    if TYPE_CHECKING:

        def __call__(self, image: Tensor, intrinsics: Tensor | None = None) -> DepthPrediction:
            """As :meth:`forward`."""

    @abstractmethod
    def forward(self, image: Tensor) -> DepthPrediction:
        """Depth [B, H, W] [m] of ``image`` [B, 3, H, W] as ``preprocess`` returns it; a second argument, the image's
        intrinsics [B, 3, 3] [px], of a network that takes them (``infer`` passes what a network takes)."""


class Backbone(DepthNetwork):
    """An encoder and decoder that uncertainty heads can be put on.

    Depth is read from the decoder's last features, and so is everything that a head adds. The two steps are
    separate so that a head shares the features without computing them twice.
    """

    feature_channels: int

    @property
    def pyramid_channels(self) -> tuple[int, ...]:
        """Channels of the maps of :meth:`pyramid`."""
        return (self.feature_channels,)

    def pyramid(self, image: Tensor) -> list[Tensor]:
        """The decoder's features by scale: [B, pyramid_channels[s], H / 2^s, W / 2^s], :meth:`features` first."""
        return [self.features(image)]

    @abstractmethod
    def features(self, image: Tensor) -> Tensor:
        """The decoder's last features [B, feature_channels, H, W] at the resolution of ``image`` [B, 3, H, W]."""

    @abstractmethod
    def depth(self, features: Tensor) -> Tensor:
        """Depth [B, H, W] [m] from :meth:`features`."""

    def forward(self, image: Tensor) -> DepthPrediction:
        """Depth [B, H, W] [m] of ``image`` [B, 3, H, W] as ``preprocess`` returns it; no variances."""
        return DepthPrediction(self.depth(self.features(image)))


class DeclaredNetwork(DepthNetwork):
    """A network whose raw outputs are declared.

    Attributes:
        outputs: the declaration.
        path: the file that the network is in, which error messages name; "" without one.
    """

    outputs: OutputSpec
    path: str = ""
    _has_predicted: bool = False  # a depth at some pixel

    @property
    def takes_intrinsics(self) -> bool:
        """True if the network takes intrinsics, or the unit of its depth depends on the focal length."""
        return self.outputs.focal is not None or super().takes_intrinsics

    @property
    def states_confidence(self) -> bool:
        """True if a confidence is declared, or stated by a network that returns a ``DepthPrediction``."""
        return self.outputs.confidence is not None or super().states_confidence

    @property
    def max_depth(self) -> float | None:
        """[m] As declared, or stated by a network that returns a ``DepthPrediction``."""
        return self.outputs.max_depth or super().max_depth

    def sized(self, preprocess: Preprocess | None, size: tuple[int, int]) -> Preprocess:
        """The declared preprocessing with the (height, width) [px] of the file's input. Raises ValueError: another size
        is declared."""
        preprocess = preprocess or Preprocess()
        if preprocess.size not in (None, size):
            fixed = f"{self.path}: the input has a fixed size of {size[0]} x {size[1]} px"
            raise ValueError(f"{fixed}, but the spec's preprocess.size is {preprocess.size}")
        return replace(preprocess, size=size)

    def declared(self, result: Any, image: Tensor, intrinsics: Tensor | None) -> DepthPrediction:
        """The prediction in what the network returned; arguments and errors as :meth:`OutputSpec.prediction`, with the
        file's name. The first one must have a depth; a later one without any is a frame without a valid pixel."""
        try:
            prediction = self.outputs.prediction(result, image, intrinsics, require_depth=not self._has_predicted)
        except (TypeError, ValueError) as error:
            if not self.path:
                raise
            raise ValueError(f"{self.path}: {error}") from error
        self._has_predicted = True
        return prediction


@contextmanager
def in_eval_mode(network: nn.Module) -> Iterator[None]:
    """Without gradients and in eval mode; then each part is in its own mode again."""
    modes = {part: part.training for part in network.modules()}
    network.eval()
    try:
        with torch.no_grad():
            yield
    finally:
        for part, mode in modes.items():
            part.training = mode


def require_image(image: Tensor, multiple: int = 1, smallest: int = 1) -> tuple[int, int]:
    """(H, W) [px] of a network's input. Raises ValueError unless it is floating-point [B, 3, H, W] with H and W
    multiples of ``multiple`` and at least ``smallest``."""
    if image.dim() != 4 or image.shape[1] != 3 or not image.is_floating_point():
        shape = f"{image.dtype} {tuple(image.shape)}"
        raise ValueError(f"image must be floating-point [B, 3, H, W] as the network's preprocess makes it, got {shape}")
    height, width = image.shape[-2:]
    if not fits(height, width, multiple, smallest):
        expected = f"multiples of {multiple} px" + (f", at least {smallest}" if smallest > multiple else "")
        raise ValueError(f"image must have a height and width that are {expected}, got {height} x {width}")
    return height, width


def fits(height: int, width: int, multiple: int, smallest: int) -> bool:
    """True if both sides [px] are multiples of ``multiple`` and at least ``smallest``."""
    return not height % multiple and not width % multiple and min(height, width) >= smallest

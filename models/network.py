"""The base classes of all depth networks."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor, nn

from ufmstar_torch.frames.prediction import (
    DepthPrediction,
    require_switchable,
    stated_range,
    states_confidence,
    takes_intrinsics,
)
from ufmstar_torch.models.preprocess import Preprocess

if TYPE_CHECKING:
    from ufmstar_torch.models.outputs import OutputSpec

MULTIPLE = 32  # [px] FastDepth and Monodepth2 halve the image five times
# [m] Depth that an untrained network predicts: typical of rooms, and positive, so that a ReLU has a gradient.
INITIAL_DEPTH = 2.5


class DepthNetwork(nn.Module, ABC):
    """A monocular network that predicts metric depth.

    ``x, K = network.preprocess(image, intrinsics)`` converts a camera image to the network's input ``x`` [B, 3, H, W]
    with its intrinsics K, and ``network(x)`` returns a :class:`DepthPrediction` at that resolution.
    """

    preprocess: Preprocess

    @property
    def wrapped(self) -> Sequence[nn.Module]:
        """The networks that this one calls. By default, the properties below are derived from theirs."""
        return ()

    @property
    def takes_intrinsics(self) -> bool:
        """True if it must be called as ``network(x, K)``, with K [B, 3, 3] of ``x`` [px]."""
        return any(takes_intrinsics(network) for network in self.wrapped)

    @property
    def max_depth(self) -> float | None:
        """[m] The largest depth that it can predict; None if unbounded or unknown."""
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
        """Depth [B, H, W] [m] of the output ``image`` [B, 3, H, W] of ``preprocess``. A network that takes intrinsics
        has a second argument [B, 3, 3] [px] (``infer`` passes the right arguments)."""


class Backbone(DepthNetwork):
    """An encoder and decoder for uncertainty heads.

    Depth and the outputs of a head are functions of the decoder's last features. ``features`` and ``depth`` are
    separate, so that a head can share the features.
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
        """Depth [B, H, W] [m] of the output ``image`` [B, 3, H, W] of ``preprocess``, without variances."""
        return DepthPrediction(self.depth(self.features(image)))


class DeclaredNetwork(DepthNetwork):
    """A network with declared raw outputs.

    Attributes:
        outputs: the declaration.
        path: the network's file, for error messages; "" = none.
    """

    outputs: OutputSpec
    path: str = ""
    _has_predicted: bool = False  # after the first output with a depth

    @property
    def takes_intrinsics(self) -> bool:
        """True if the network takes intrinsics, or the unit of its depth depends on the focal length."""
        return self.outputs.focal is not None or super().takes_intrinsics

    @property
    def states_confidence(self) -> bool:
        """True if a confidence is declared, or the wrapped network predicts one."""
        return self.outputs.confidence is not None or super().states_confidence

    @property
    def max_depth(self) -> float | None:
        """[m] The declared largest depth, or that of the wrapped network."""
        return self.outputs.max_depth or super().max_depth

    def sized(self, preprocess: Preprocess | None, size: tuple[int, int]) -> Preprocess:
        """The declared preprocessing with the (height, width) [px] of the file's input. Raises ValueError: the
        declaration has another size."""
        preprocess = preprocess or Preprocess()
        if preprocess.size not in (None, size):
            fixed = f"{self.path}: the input has a fixed size of {size[0]} x {size[1]} px"
            raise ValueError(f"{fixed}, but the spec's preprocess.size is {preprocess.size}")
        return replace(preprocess, size=size)

    def declared(self, result: Any, image: Tensor, intrinsics: Tensor | None) -> DepthPrediction:
        """Convert the network's result to a prediction; arguments and errors as :meth:`OutputSpec.prediction`, with the
        file's name. The first result must have a depth; a later one may have no valid pixel."""
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
    """Disable gradients and set eval mode; restore the mode of each submodule afterwards. Raises TypeError: as
    ``require_switchable``."""
    require_switchable(network)
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
    if not isinstance(image, Tensor) or image.dim() != 4 or image.shape[1] != 3 or not image.is_floating_point():
        shape = f"{image.dtype} {tuple(image.shape)}" if isinstance(image, Tensor) else type(image).__name__
        raise ValueError(f"image must be floating-point [B, 3, H, W], as from the network's preprocess, got {shape}")
    height, width = image.shape[-2:]
    if not fits(height, width, multiple, smallest):
        expected = f"multiples of {multiple} px" + (f", at least {smallest}" if smallest > multiple else "")
        raise ValueError(f"image must have a height and width that are {expected}, got {height} x {width}")
    return height, width


def fits(height: int, width: int, multiple: int, smallest: int) -> bool:
    """True if both sides [px] are multiples of ``multiple`` and at least ``smallest``."""
    return not height % multiple and not width % multiple and min(height, width) >= smallest

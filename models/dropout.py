"""MC-Dropout in the decoder (Gal and Ghahramani 2016; only the decoder, as in Poggi et al. 2020).

Dropout samples at test time, too, while all other layers, in particular batch norm, stay in eval mode: every pass is a
draw from the network's approximate posterior.
"""

from __future__ import annotations

import torch
from torch import Tensor, nn

from ufmstar_torch.frames.prediction import DepthPrediction, combine, infer
from ufmstar_torch.models.distribution import DepthDistribution
from ufmstar_torch.models.heads import UncertaintyNetwork
from ufmstar_torch.models.network import DepthNetwork
from ufmstar_torch.runtime.kinds import check_kinds

SAMPLES = 10  # passes of the paper's multi-inference baseline


class DecoderDropout(nn.Module):
    """Zeroes whole channels with probability p in [0, 1) and scales the others by 1 / (1 - p), in training mode or
    while ``sampling``. It has no parameters, so that weights load with and without it.

    Each channel of each image has one draw, as in the decoder of Poggi et al. With one draw per value, neighbouring
    pixels would differ by decimetres, which segmentation cannot join to a surface. Raises ValueError: p is out of
    range.
    """

    @check_kinds
    def __init__(self, p: float) -> None:
        super().__init__()
        if not 0 <= p < 1:
            raise ValueError(f"dropout must be a probability in [0, 1), got {p}")
        self.p = p
        self.sampling = False
        self.generator: torch.Generator | None = None

    def forward(self, x: Tensor) -> Tensor:
        """x [B, C, ...] of any floating-point dtype, to the same shape."""
        if not self.p or not (self.training or self.sampling):
            return x
        # torch's dropout has no generator argument.
        draw = torch.rand(*x.shape[:2], *(1,) * (x.dim() - 2), generator=self.generator, device=x.device)
        return x * (draw >= self.p).to(x.dtype) / (1 - self.p)


@check_kinds
def set_sampling(module: nn.Module, on: bool, generator: torch.Generator | None = None) -> int:
    """Switch sampling in eval mode on or off for every :class:`DecoderDropout` in ``module`` with p > 0, in place.
    Returns their number. ``generator``: of the random numbers, on the network's device; None: torch's global one.
    Raises ValueError: there is no such layer."""
    layers = [m for m in module.modules() if isinstance(m, DecoderDropout) and m.p > 0]
    if not layers:
        raise ValueError(
            f"{type(module).__name__} has no decoder dropout: build its backbone with dropout=0.2, for example"
        )
    for layer in layers:
        layer.sampling, layer.generator = on, generator if on else None
    return len(layers)


class MonteCarloDropout(DepthNetwork):
    """A network with decoder dropout that samples in eval mode ("MC-Dropout").

    With one sample, a call is one draw: the single-inference form for ``UncertainDepth``. With more, every call runs
    that many passes, the multi-inference baseline: predictive mean, mean aleatoric variance, and the variance between
    the passes as epistemic variance.

    Args:
        network: not copied; its dropout samples in eval mode, too, until ``set_sampling(network, False)``. Training is
            the same as without this wrapper.
        samples: passes per call.
        generator: source of the random numbers, on the network's device; None: torch's global one.

    Raises:
        ValueError: the network has no decoder dropout, or ``samples`` is not positive.
    """

    stochastic = True

    @check_kinds
    def __init__(self, network: DepthNetwork, samples: int = 1, *, generator: torch.Generator | None = None) -> None:
        super().__init__()
        if samples < 1:
            raise ValueError(f"samples must be at least 1, got {samples}")
        set_sampling(network, True, generator)
        self.network = network
        self.preprocess = network.preprocess
        self.samples = samples

    def distribution(self, image: Tensor) -> DepthDistribution:
        """One pass, for the losses. Raises TypeError: the network has no uncertainty head."""
        if not isinstance(self.network, UncertaintyNetwork):
            raise TypeError(
                f"{type(self.network).__name__} is no UncertaintyNetwork; add a head for training (with_head)"
            )
        return self.network.distribution(image)

    @property
    def wrapped(self) -> tuple[DepthNetwork]:
        """The network."""
        return (self.network,)

    def forward(self, image: Tensor, intrinsics: Tensor | None = None) -> DepthPrediction:
        """Depth [B, H, W] [m] and variances [m^2] of ``image`` [B, 3, H, W] with ``intrinsics`` [B, 3, 3] [px]. With
        one sample, only the network's variances; otherwise E = the variance between the passes (+ mean E)."""
        passes = [infer(self.network, image, intrinsics) for _ in range(self.samples)]
        return passes[0] if self.samples == 1 else combine(passes)

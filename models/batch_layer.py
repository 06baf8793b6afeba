"""One layer of a BatchEnsemble (Wen, Tran and Ba, ICLR 2020).

Member n's weight is W_n = W o s_n r_n^T (their Eq. 1), which needs no W_n in memory (their Eq. 5):

    y = (W (x o r_n)) o s_n + b_n

for a linear layer, and the same per channel for a convolution, whatever its groups and padding: r_n scales
the input's channels, s_n the output's. Every member has its own bias b_n.
"""

from __future__ import annotations

import copy
import threading

from torch import Tensor, nn


class Selection(threading.local):
    """The member that every image goes through, for all layers of one network; each thread has its own."""

    members: Tensor | None = None  # [B] int64, the member of every image; None outside of a call

    def __reduce__(self) -> tuple[type[Selection], tuple[()]]:
        return Selection, ()  # a copied or unpickled network is outside of any call


class BatchLayer(nn.Module):
    """W, and for every member two factors and a bias.

    Args:
        layer: a Conv2d or Linear, which becomes a part of this one: W (the parameter itself, so that tied weights stay
            tied), and every member's first bias.
        members: N.
        selection: the member of every image; the same object for all layers of a network.
    """

    bias: Tensor | None

    def __init__(self, layer: nn.Conv2d | nn.Linear, members: int, selection: Selection) -> None:
        super().__init__()
        self.selection = selection
        self.convolution = isinstance(layer, nn.Conv2d)
        inputs = layer.in_channels if isinstance(layer, nn.Conv2d) else layer.in_features
        weight, bias = layer.weight.detach(), layer.bias
        self.r = nn.Parameter(weight.new_ones(members, inputs))
        self.s = nn.Parameter(weight.new_ones(members, weight.shape[0]))
        self.register_parameter("bias", None if bias is None else nn.Parameter(bias.detach().repeat(members, 1)))
        self.shared = layer
        self.shared.bias = None
        self.train(layer.training)

    @property
    def weight(self) -> Tensor:
        """W, whose type some networks look up."""
        return self.shared.weight

    def forward(self, x: Tensor) -> Tensor:
        """y of x ([B, C, H, W], or [B, ..., C] of a linear layer), image b by member ``selection.members[b]``. Raises
        RuntimeError: the layer was called other than through its BatchEnsemble; ValueError: the network changed the
        number of images on the way here."""
        members = self.selection.members
        if members is None:
            raise RuntimeError("a layer of a BatchEnsemble has to be called through it, which selects the members")
        if len(members) != len(x):
            raise ValueError(f"a BatchEnsemble of {len(members)} images has a layer that got {len(x)}")
        y = self.shared(x * self._per_channel(self.r, x))
        y = y * self._per_channel(self.s, y)
        return y if self.bias is None else y + self._per_channel(self.bias, y)

    def _per_channel(self, values: Tensor, x: Tensor) -> Tensor:
        """[B, 1 ..., C], or [B, C, 1, 1] of a convolution, to go with x; of its type, since under autocast a
        factor in float32 would make float32 of everything that follows."""
        chosen = values[self.selection.members].to(x.dtype)
        shape = (*chosen.shape, 1, 1) if self.convolution else (len(x), *[1] * (x.dim() - 2), chosen.shape[1])
        return chosen.view(shape)

    def weight_of(self, member: int) -> Tensor:
        """W_n, in W's shape [out, in / groups, ...]."""
        weight = self.shared.weight
        outputs, inputs = weight.shape[:2]
        groups = self.r.shape[1] // inputs
        # An output channel sees the input channels of its group.
        r = self.r[member].view(groups, 1, inputs).expand(groups, outputs // groups, inputs)
        scale = r.reshape(outputs, inputs) * self.s[member][:, None]
        return weight * scale.view(outputs, inputs, *[1] * (weight.dim() - 2))

    def plain(self, member: int) -> nn.Conv2d | nn.Linear:
        """Member n as a layer of its own, with its own weights."""
        layer = copy.deepcopy(self.shared)
        layer.weight = nn.Parameter(self.weight_of(member).detach().clone())
        if self.bias is not None:
            layer.bias = nn.Parameter(self.bias[member].detach().clone())
        return layer

"""One layer of a BatchEnsemble (Wen, Tran and Ba, ICLR 2020).

Member n's weight is W_n = W o s_n r_n^T (their Eq. 1). A linear layer does not store W_n (their Eq. 5):

    y = (W (x o r_n)) o s_n + b_n.

The same holds per channel for a convolution with any groups and padding: r_n scales the input's channels, s_n the
output's. Each member has a bias b_n.
"""

from __future__ import annotations

import copy
import threading

from torch import Tensor, nn


class Selection(threading.local):
    """The member of every image, for all layers of one network; thread-local."""

    members: Tensor | None = None  # [B] int64, the member of every image; None outside of a call

    def __reduce__(self) -> tuple[type[Selection], tuple[()]]:
        return Selection, ()  # a copied or unpickled network is not in a call


class BatchLayer(nn.Module):
    """W, and for every member two factors and a bias.

    Args:
        layer: a Conv2d or Linear, which becomes a submodule: W (the same parameter, so that tied weights stay tied),
            and every member's initial bias.
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
        """W, because some networks read its dtype."""
        return self.shared.weight

    def forward(self, x: Tensor) -> Tensor:
        """y of x ([B, C, H, W], or [B, ..., C] for a linear layer), image b by member ``selection.members[b]``. Raises
        RuntimeError: the call did not come from its BatchEnsemble; ValueError: the network changed the number of
        images before this layer."""
        members = self.selection.members
        if members is None:
            raise RuntimeError("call the BatchEnsemble, not its layers: it selects the members")
        if len(members) != len(x):
            raise ValueError(f"a BatchEnsemble of {len(members)} images has a layer that got {len(x)}")
        y = self.shared(x * self._per_channel(self.r, x))
        y = y * self._per_channel(self.s, y)
        return y if self.bias is None else y + self._per_channel(self.bias, y)

    def _per_channel(self, values: Tensor, x: Tensor) -> Tensor:
        """The selected members' values, [B, 1 ..., C], or [B, C, 1, 1] for a convolution, to broadcast against x; in
        x's dtype, since under autocast a float32 factor would promote all later results to float32."""
        chosen = values[self.selection.members].to(x.dtype)
        shape = (*chosen.shape, 1, 1) if self.convolution else (len(x), *[1] * (x.dim() - 2), chosen.shape[1])
        return chosen.view(shape)

    def weight_of(self, member: int) -> Tensor:
        """W_n, in W's shape [out, in / groups, ...]."""
        weight = self.shared.weight
        outputs, inputs = weight.shape[:2]
        groups = self.r.shape[1] // inputs
        # An output channel depends on the input channels of its group.
        r = self.r[member].view(groups, 1, inputs).expand(groups, outputs // groups, inputs)
        scale = r.reshape(outputs, inputs) * self.s[member][:, None]
        return weight * scale.view(outputs, inputs, *[1] * (weight.dim() - 2))

    def plain(self, member: int) -> nn.Conv2d | nn.Linear:
        """Member n as a plain layer with the weights W_n."""
        layer = copy.deepcopy(self.shared)
        layer.weight = nn.Parameter(self.weight_of(member).detach().clone())
        if self.bias is not None:
            layer.bias = nn.Parameter(self.bias[member].detach().clone())
        return layer

"""BatchEnsemble (Wen, Tran and Ba, ICLR 2020): an ensemble in one network, whose members share their weights except for
two vectors per layer.

The members also share the batch norms with their statistics. A member then has three vectors per layer (with its bias),
and the statistics are those of the whole batch even if it is split among the members.

Why not torch-uncertainty (0.13): its ``batch_ensemble(convert_layers=True)`` crashes on nested modules, and its layers
split every batch among all members, so that a single member cannot process an image.
"""

from __future__ import annotations

import copy
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any, TypeVar

import torch
from torch import Tensor, nn

from ufmstar_torch.frames.arguments import require_whole
from ufmstar_torch.frames.prediction import DepthPrediction, combine
from ufmstar_torch.models.batch_layer import BatchLayer, Selection
from ufmstar_torch.models.distribution import DepthDistribution, images_of
from ufmstar_torch.models.heads import UncertaintyNetwork
from ufmstar_torch.models.network import DepthNetwork
from ufmstar_torch.runtime.kinds import check_kinds

# [1] Standard deviation of the factors around 1, as in the published implementations. A smaller one keeps the members
# nearer to pretrained weights and to each other; random signs would destroy trained weights.
INIT_STD = 0.5
_PLAIN = (nn.Conv2d, nn.Linear)

Network = TypeVar("Network", bound=nn.Module)


@check_kinds
def convert(network: Network, members: int, *, std: float = INIT_STD) -> Network:
    """A copy of a network in which every ``Conv2d`` and ``Linear`` is a :class:`BatchLayer`.

    Weights are copied, and every member starts with the layer's bias. All references to a layer are replaced, also
    repeated ones and those in plain lists and dicts.

    Args:
        network: not changed.
        members: N.
        std: [1] standard deviation of the initial factors around 1, drawn from torch's generator; 0 = equal members.

    Raises:
        ValueError: nothing to convert, an option out of range, a converted network, or a layer that is only in a plain
            list (its weights would be neither trained nor saved).
        TypeError: a layer of a derived class or with other parameters (weight norm), whose computation is unknown.
        RuntimeError: not all layers were converted.
    """
    if members < 2 or not std >= 0:
        raise ValueError(f"need members >= 2 and std >= 0, got {members} and {std}")
    if converted_layers(network):
        raise ValueError(f"{type(network).__name__} is converted already")
    plain = [(name, module) for name, module in network.named_modules() if isinstance(module, _PLAIN)]
    if not plain:
        raise ValueError(f"{type(network).__name__} has no Conv2d and no Linear: nothing to convert")
    # deepcopy's memo, by id: it replaces a layer at all references.
    copies: dict[int, Any] = {}
    selection = Selection()
    for name, module in plain:
        _require_plain(name, module)
        copies[id(module)] = BatchLayer(copy.deepcopy(module, copies), members, selection)
    result = copy.deepcopy(network, copies)
    if unconverted := [type(copied).__name__ for copied in copies.values() if isinstance(copied, _PLAIN)]:
        raise ValueError(f"{type(network).__name__} keeps a {unconverted[0]} that is not registered: use nn.ModuleList")
    layers = converted_layers(result)
    if len(layers) != len(plain):
        raise RuntimeError(f"{len(layers)} of {len(plain)} layers were converted")
    for layer in layers:
        _draw(layer.r, std)
        _draw(layer.s, std)
    return result


def converted_layers(network: nn.Module) -> list[BatchLayer]:
    """The layers that :func:`convert` created, without repetitions."""
    return [module for module in network.modules() if isinstance(module, BatchLayer)]


class BatchEnsemble(DepthNetwork):
    """An ensemble whose members share their weights ("BatchEnsemble").

    A call runs the multi-inference baseline: all members in one batched pass, combined. :meth:`all_members` returns the
    single-inference form, for ``UncertainDepth``.

    Args:
        network: to convert, into a copy. Arguments and errors as in :func:`convert`.
    """

    @check_kinds
    def __init__(self, network: UncertaintyNetwork, members: int, *, std: float = INIT_STD) -> None:
        super().__init__()
        self.network = convert(network, members, std=std)
        self.preprocess = network.preprocess
        self.members = members

    @check_kinds
    def distribution(self, image: Tensor, member: int | None = None, *, repeat: bool = True) -> DepthDistribution:
        """The distributions of ``image`` [B, 3, H, W] for the losses: of one ``member``, [B, H, W], or of all. With
        ``repeat``, all members process every image: [N B, H, W], the B maps of member 0 first. Without it, the batch is
        split: [B, H, W], image b by member floor(b N / B). Raises IndexError: no such member; ValueError: a batch too
        small to be split."""
        count = len(image)
        if member is not None:
            members = torch.full((count,), self._checked(member), device=image.device)
        elif repeat:
            members = torch.arange(self.members, device=image.device).repeat_interleave(count)
            image = image.repeat(self.members, 1, 1, 1)
        elif count < self.members:
            raise ValueError(f"a batch of {count} cannot be split among {self.members} members")
        else:
            members = torch.arange(count, device=image.device) * self.members // count
        with self._selected(members):
            return self.network.distribution(image)

    def forward(self, image: Tensor) -> DepthPrediction:
        """The members' mixture of ``image`` [B, 3, H, W]: mean depth [B, H, W] [m], mean A and the variance
        between the members as E [m^2], from one pass with a batch of N B."""
        distribution = self.distribution(image)
        # In training mode, a network with heads at several scales returns that many blocks; use the first, the finest.
        parts = [slice(n * len(image), (n + 1) * len(image)) for n in range(self.members)]
        return combine([images_of(distribution, part).prediction() for part in parts])

    def member(self, n: int) -> BatchEnsembleMember:
        """Member n as a network that shares this one's weights. Raises IndexError: no such member."""
        return BatchEnsembleMember(self, self._checked(n))

    def all_members(self) -> list[BatchEnsembleMember]:
        """All members (:meth:`member`)."""
        return [self.member(n) for n in range(self.members)]

    def folded(self, n: int) -> UncertaintyNetwork:
        """Member n as a plain network with the weights W_n: the same function up to rounding, as fast as the original
        network, and independent of this one. Raises IndexError: no such member."""
        self._checked(n)
        return copy.deepcopy(self.network, {id(layer): layer.plain(n) for layer in converted_layers(self.network)})

    def factors(self) -> list[nn.Parameter]:
        """r and s of every layer. Exclude them from weight decay, which would pull them to 0 instead of to 1, the
        shared weights."""
        return [factor for layer in converted_layers(self.network) for factor in (layer.r, layer.s)]

    def _checked(self, member: int) -> int:
        if not 0 <= require_whole("member", member) < self.members:
            raise IndexError(f"member must be from 0 to {self.members - 1}, got {member}")
        return member

    @contextmanager
    def _selected(self, members: Tensor) -> Iterator[None]:
        """Select the member [B] of every image for all layers, in this thread, during a call."""
        selection = converted_layers(self.network)[0].selection
        selection.members = members
        try:
            yield
        finally:
            selection.members = None


class BatchEnsembleMember(DepthNetwork):
    """One member of a :class:`BatchEnsemble`, made by its ``member``.

    The whole ensemble is a submodule, so that all members still share their weights after ``.to()``, ``deepcopy`` (of a
    list of them) and ``load_state_dict``. A state_dict of several members repeats the names of the shared tensors, but
    not the tensors.
    """

    def __init__(self, ensemble: BatchEnsemble, n: int) -> None:
        super().__init__()
        self.ensemble = ensemble
        self.n = n
        self.preprocess = ensemble.preprocess
        self.training = ensemble.training

    def distribution(self, image: Tensor) -> DepthDistribution:
        """The distribution [B, H, W] of ``image`` [B, 3, H, W]."""
        return self.ensemble.distribution(image, self.n)

    def forward(self, image: Tensor) -> DepthPrediction:
        """Depth [B, H, W] [m] and variances [m^2] of ``image`` [B, 3, H, W]: one inference."""
        return self.distribution(image).prediction()


def _require_plain(name: str, module: nn.Module) -> None:
    """Raise a TypeError unless a layer computes the same as its plain class."""
    if type(module) not in _PLAIN or set(module._parameters) != {"weight", "bias"}:
        held = ", ".join(module._parameters)
        raise TypeError(f"{name or 'the network'} cannot be converted: it is a {type(module).__name__} of {held}")


def _draw(factor: nn.Parameter, std: float) -> None:
    """Fill a parameter with random values, drawn on the CPU in float32, so that they depend only on the seed."""
    with torch.no_grad():
        factor.copy_(1 + std * torch.randn(factor.shape, device="cpu"))

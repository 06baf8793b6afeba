"""Ensembles (Lakshminarayanan et al. 2017): the multi-inference baseline, which runs all members, and members that are
loaded at their first call and can be offloaded from the device."""

from __future__ import annotations

import threading
from collections.abc import Callable, Sequence
from typing import Any

import torch
from torch import Tensor, nn
from torch.func import functional_call

from ufmstar_torch.frames.prediction import DepthPrediction, combine, infer, takes_intrinsics
from ufmstar_torch.models.checkpoints import CheckpointError
from ufmstar_torch.models.network import DepthNetwork
from ufmstar_torch.models.preprocess import Preprocess
from ufmstar_torch.runtime.kinds import check_kinds


class Ensemble(DepthNetwork):
    """All members on every image ("Ensemble", the multi-inference baseline). ``UncertainDepth(members)``
    alternates them instead.

    Args:
        members: networks with the same preprocessing.

    Raises:
        ValueError: fewer than two members, or different preprocessing.
    """

    @check_kinds
    def __init__(self, members: Sequence[DepthNetwork]) -> None:
        super().__init__()
        if len(members) < 2:
            raise ValueError(f"members must be at least two networks, got {len(members)}")
        expected = [member.preprocess for member in members]
        if any(other != expected[0] for other in expected):
            raise ValueError(f"members must have the same preprocessing, got {expected}")
        self.members = nn.ModuleList(members)
        self.preprocess = expected[0]

    @property
    def wrapped(self) -> Sequence[nn.Module]:
        """The members."""
        return list(self.members)

    def forward(self, image: Tensor, intrinsics: Tensor | None = None) -> DepthPrediction:
        """Mean depth [B, H, W] [m], mean A, and the variance between the members (+ mean E) as E [m^2] of
        ``image`` [B, 3, H, W] with ``intrinsics`` [B, 3, 3] [px]; runs the members sequentially."""
        return combine([infer(member, image, intrinsics) for member in self.members])


class LazyMember(DepthNetwork):
    """A network that is loaded at its first call. For inference.

    ``.to()`` sets its device and dtype, before and after loading. Its weights are never part of its state_dict. A copy
    loads them again.

    Args:
        load: returns the network, on the CPU; called once, and again after an error.
        preprocess: of the network, needed before it is loaded.
        name: for error messages.
        offload: store the weights in host memory and copy them to the device during a call only. No effect on the CPU.
            Members that share weights (of a BatchEnsemble) must then not be called from several threads at once.
    """

    _where: Tensor

    def __init__(
        self, load: Callable[[], DepthNetwork], preprocess: Preprocess, *, name: str = "member", offload: bool = False
    ) -> None:
        super().__init__()
        self.preprocess = preprocess
        self.name = name
        self.offload = offload
        self._load = load
        # In a dict, so that nn.Module does not register it.
        self._held: dict[str, DepthNetwork] = {}
        self._loading, self._calling = threading.Lock(), threading.Lock()
        self.register_buffer("_where", torch.zeros(0), persistent=False)
        self.eval()

    @property
    def loaded(self) -> bool:
        """True if the weights are in memory."""
        return bool(self._held)

    def network(self) -> DepthNetwork:
        """The network, loaded at the first call: on the device, or with ``offload`` on the CPU. Raises CheckpointError:
        it cannot be loaded; the message has its name and the reason."""
        with self._loading:  # a second thread waits instead of loading again
            if not self._held:
                self._held["network"] = self._placed(self._loaded())
            return self._held["network"]

    def _loaded(self) -> DepthNetwork:
        try:
            network = self._load()
        except (OSError, RuntimeError, ValueError) as error:
            if isinstance(error, CheckpointError) and self.name in str(error):
                raise
            raise CheckpointError(f"{self.name} cannot be loaded: {error}") from error
        if not isinstance(network, DepthNetwork):
            raise CheckpointError(f"{self.name} must be a DepthNetwork, got {type(network).__name__}")
        if network.preprocess != self.preprocess:
            expected = f"expected {self.preprocess}"
            raise CheckpointError(f"{self.name} has the preprocessing {network.preprocess}, {expected}")
        return network.train(self.training)

    @property
    def takes_intrinsics(self) -> bool:
        """True if the network takes intrinsics; loads it."""
        return takes_intrinsics(self.network())

    def forward(self, image: Tensor, intrinsics: Tensor | None = None) -> DepthPrediction:
        """The network's prediction; ``intrinsics`` [B, 3, 3] [px] of ``image`` if the network takes them. Raises
        CheckpointError: it cannot be loaded."""
        network, device = self.network(), self._where.device
        if not self.offload or device.type == "cpu":
            prediction: DepthPrediction = infer(network, image, intrinsics)
            return prediction
        tensors = {**dict(network.named_parameters()), **dict(network.named_buffers())}
        # Temporary copies: nothing is copied back, and an error leaves none behind.
        copies = {name: tensor.to(device, non_blocking=True) for name, tensor in tensors.items()}
        with self._calling:  # functional_call swaps the copies into the network during the call
            return functional_call(network, copies, (image, intrinsics) if takes_intrinsics(network) else (image,))

    def train(self, mode: bool = True) -> LazyMember:
        """Set the mode of the network, also if it is loaded later."""
        super().train(mode)
        for network in self._held.values():
            network.train(mode)
        return self

    def _placed(self, network: DepthNetwork) -> DepthNetwork:
        device = "cpu" if self.offload else self._where.device
        return network.to(device=device, dtype=self._where.dtype)

    def _apply(self, fn: Callable[[Tensor], Tensor], recurse: bool = True) -> LazyMember:
        super()._apply(fn, recurse)
        for network in self._held.values():
            self._placed(network)
        return self

    def __getstate__(self) -> dict[str, Any]:
        """The state of copies and pickles: without locks and without the loaded network."""
        return {**self.__dict__, "_held": {}, "_loading": None, "_calling": None}

    def __setstate__(self, state: dict[str, Any]) -> None:
        super().__setstate__({**state, "_loading": threading.Lock(), "_calling": threading.Lock()})

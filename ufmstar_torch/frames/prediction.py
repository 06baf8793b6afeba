"""The output of every depth network, and the call of a network."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from typing import Any

import torch
from torch import Tensor

from ufmstar_torch.frames.arguments import as_tensor

_OPTIONAL = ("aleatoric_variance", "epistemic_variance", "confidence")


@dataclass(frozen=True)
class DepthPrediction:
    """One prediction of a monocular depth network (section "Single DNN inference"); NumPy arrays become tensors.

    Attributes:
        depth: [B, H, W] metric depth D along the optical axis [m].
        aleatoric_variance: [B, H, W] learned data variance A [m^2], or None.
        epistemic_variance: [B, H, W] learned model variance E [m^2], or None.
        confidence: [B, H, W] a map of any unit that ranks the pixels by quality, or None; its meaning in metres is
            learnt from anchors (``ufmstar_torch.anchors.confidence``).
        intrinsics: [B, 3, 3] of the depth map [px]; None = those of the network's input.
        ms: total time of the inferences [ms]; None = not measured.
        member: index of the network, or of the random sample, that predicted; 0 for a mean of all.
        informative: [B] bool, False where the image shows nothing, so that the depth is a guess; None = all True.

    Raises:
        TypeError: a map is neither a tensor nor an array.
        ValueError: the shapes disagree or depth is not [B, H, W].
    """

    depth: Tensor
    aleatoric_variance: Tensor | None = None
    epistemic_variance: Tensor | None = None
    confidence: Tensor | None = None
    intrinsics: Tensor | None = None
    ms: float | None = None
    member: int = 0
    informative: Tensor | None = None

    def __post_init__(self) -> None:
        for name in ("depth", *_OPTIONAL):
            if (value := getattr(self, name)) is not None or name == "depth":
                object.__setattr__(self, name, as_tensor(name, value))
        if self.depth.dim() != 3 or not torch.is_floating_point(self.depth):
            raise ValueError(
                f"depth must be a floating-point tensor [B, H, W], got {self.depth.dtype} {tuple(self.depth.shape)}"
            )
        for name in _OPTIONAL:
            value = getattr(self, name)
            if value is not None and value.shape != self.depth.shape:
                raise ValueError(
                    f"{name} must have the depth's shape {tuple(self.depth.shape)}, got {tuple(value.shape)}"
                )

    def to(self, to: torch.device | torch.dtype) -> DepthPrediction:
        """The prediction with the maps on a device, or of a dtype; the intrinsics are unchanged."""
        present = (value for name in ("depth", *_OPTIONAL, "informative") if (value := getattr(self, name)) is not None)
        if all(value.device == to for value in present):
            return self
        maps = {name: value.to(to) for name in ("depth", *_OPTIONAL) if (value := getattr(self, name)) is not None}
        informative = self.informative
        if informative is not None and isinstance(to, torch.device):
            informative = informative.to(to)
        return replace(self, **maps, informative=informative)

    @property
    def size(self) -> tuple[int, int]:
        """Height and width [px]."""
        return self.depth.shape[1], self.depth.shape[2]

    @property
    def K(self) -> Tensor:
        """[B, 3, 3] the intrinsics [px], which must not be None."""
        assert self.intrinsics is not None
        return self.intrinsics

    @property
    def variance(self) -> Tensor | None:
        """[B, H, W] the network's total variance A + E [m^2], None if it predicts neither."""
        a, e = self.aleatoric_variance, self.epistemic_variance
        if a is None or e is None:
            return e if a is None else a
        return a + e

    def arguments(self, *, confidence: bool) -> dict[str, Any]:
        """The arguments of ``UfMStar.forward``: depth, A, E, the network's index, whether the image shows something,
        and with ``confidence`` the confidence."""
        maps = {
            "depth": self.depth, "aleatoric": self.aleatoric_variance, "epistemic": self.epistemic_variance,
            "member": self.member, "informative": self.informative,
        }  # fmt: skip
        return maps | ({"confidence": self.confidence} if confidence else {})


def takes_intrinsics(network: Callable[..., Any]) -> bool:
    """True if a network must be called as ``network(x, K)``: it has an attribute ``takes_intrinsics = True``."""
    return bool(getattr(network, "takes_intrinsics", False))


def stated_range(networks: Iterable[Callable[..., Any]]) -> float | None:
    """[m] The largest attribute ``max_depth`` of the networks; None unless it is a positive number in each of them."""
    stated = [getattr(network, "max_depth", None) for network in networks]
    ranges = [float(value) for value in stated if isinstance(value, int | float) and value > 0]
    return max(ranges) if ranges and len(ranges) == len(stated) else None


def states_confidence(networks: Iterable[Callable[..., Any]]) -> bool:
    """True if every network has a true attribute ``states_confidence``: it predicts a confidence."""
    stated = [bool(getattr(network, "states_confidence", False)) for network in networks]
    return bool(stated) and all(stated)


def infer(network: Callable[..., Any], image: Tensor, intrinsics: Tensor | None, *, takes: bool | None = None) -> Any:
    """One inference: ``network(image, K)`` if the network takes intrinsics, else ``network(image)``.

    Args:
        network: see :func:`takes_intrinsics`.
        image: [B, 3, H, W] the network's input.
        intrinsics: [B, 3, 3] or [3, 3] of ``image`` [px], that is of the preprocessed image. The network receives
            [B, 3, 3] on the image's device, in the image's dtype but at least float32.
        takes: whether the network takes intrinsics; None = :func:`takes_intrinsics`.

    Raises:
        ValueError: the network takes intrinsics, but ``intrinsics`` is None.
    """
    if not (takes_intrinsics(network) if takes is None else takes):
        return network(image)
    if intrinsics is None:
        raise ValueError(f"{type(network).__name__} takes intrinsics: call network(x, K), K [B, 3, 3] of its input x")
    dtype = torch.promote_types(image.dtype, torch.float32)
    return network(image, intrinsics.to(image.device, dtype).expand(len(image), 3, 3))


def copied(values: dict[str, Tensor], device: torch.device | None) -> tuple[dict[str, Any], torch.cuda.Event | None]:
    """Copy the values to ``device`` (None: no copy). Copies from CUDA to the CPU are asynchronous, into pinned memory,
    and return an event to wait for."""
    if device is None:
        return values, None
    source = values["depth"].device
    if source.type != "cuda" or device.type != "cpu":
        return {name: value.to(device, non_blocking=True) for name, value in values.items()}, None
    copies = {name: torch.empty(value.shape, dtype=value.dtype, pin_memory=True) for name, value in values.items()}
    for name, value in values.items():
        copies[name].copy_(value.detach(), non_blocking=True)
    ready = torch.cuda.Event()
    ready.record(torch.cuda.current_stream(source))
    return copies, ready

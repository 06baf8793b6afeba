"""Step 1: the prediction of depth networks.

Section "Single DNN inference": one inference per image, by the members of an ensemble in turn, by a stochastic network,
or by a single one; or, for comparison, inference of all members on every image ("Full").
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from inspect import signature
from itertools import chain
from typing import Any, Self

import torch
from torch import Tensor, nn

from ufmstar_torch.frames.arguments import as_tensor
from ufmstar_torch.gaussians.camera import camera_of

_OPTIONAL = ("aleatoric_variance", "epistemic_variance", "confidence")
# Number of indices of random samples: exact in float32.
SAMPLES = 2**20
# image [B, 3, H, W], intrinsics [B, 3, 3] -> network image and the intrinsics of that image
Preprocess = Callable[[Tensor, Tensor], tuple[Tensor, Tensor]]


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


class NetworksInTurn(nn.Module):
    """Depth networks with the same input: one of them per image, in turn, or all of them on every image.

    The module stores nothing between images: the caller counts them and calls :meth:`turn`. The networks stay in eval
    mode, whatever the caller's training flag is.

    Args:
        networks: one network or a sequence of them. Each maps an image [B, 3, H, W] to a :class:`DepthPrediction`. A
            network with an attribute ``takes_intrinsics = True`` is also passed the intrinsics of that image. One with
            an attribute ``stochastic = True`` predicts a random sample, another one for every image.
        samples: number of passes of a single stochastic network that :meth:`every` combines; None: one pass of each
            network.
        preprocess: maps image and intrinsics to the networks' input; None = no preprocessing.

    Raises:
        TypeError: a network is no ``nn.Module``, or its ``train`` is not PyTorch's (``require_switchable``).
        ValueError: no network.
    """

    def __init__(
        self,
        networks: nn.Module | Sequence[nn.Module] | None,
        *,
        samples: int | None = None,
        preprocess: Preprocess | None = None,
    ) -> None:
        super().__init__()
        members = [] if networks is None else modules_of(networks)
        if preprocess is not None and not callable(preprocess):
            raise TypeError(f"preprocess must be a Preprocess, a function or None, got {preprocess!r}")
        self.networks = nn.ModuleList(members).eval()
        self.samples = samples
        self.preprocess = preprocess

    @property
    def max_depth(self) -> float | None:
        """[m] The largest depth that the networks can predict; None unless each network states one."""
        return stated_range(self.networks)

    @property
    def states_confidence(self) -> bool:
        """True if every network predicts a confidence."""
        return states_confidence(self.networks)

    @property
    def passes(self) -> int:
        """Number of inferences in :meth:`every`."""
        return len(self.networks) if self.samples is None else self.samples

    @property
    def stochastic(self) -> bool:
        """True for a single network that predicts random samples."""
        return len(self.networks) == 1 and bool(getattr(self.networks[0], "stochastic", False))

    @property
    def device(self) -> torch.device | None:
        """The networks' device; None if they have no tensors."""
        return next((tensor.device for tensor in self._tensors()), None)

    def _tensors(self) -> Iterator[Tensor]:
        """The networks' parameters and buffers. A ``LazyMember`` has a buffer alone, on its device."""
        return chain(self.networks.parameters(), self.networks.buffers())

    def turn(self, images: int) -> int:
        """Index of the member that runs after ``images`` images; both start at 0."""
        return images % len(self.networks)

    def prepare(self, image: Tensor, intrinsics: Tensor) -> tuple[Tensor, Tensor]:
        """The networks' input [B, 3, h, w] and its intrinsics [B, 3, 3] [px]."""
        return (image, intrinsics) if self.preprocess is None else self.preprocess(image, intrinsics)

    def member(self, x: Tensor, intrinsics: Tensor, n: int) -> DepthPrediction:
        """One inference of member ``n``, or sample ``n`` of a single network, on the output of :meth:`prepare`; the
        prediction includes the intrinsics.

        Raises:
            TypeError: the network does not accept uint8, or as :meth:`as_prediction`.
        """
        try:
            result = infer(self.networks[n % len(self.networks)], x, intrinsics)
        except RuntimeError as error:
            if x.is_floating_point():
                raise
            raise TypeError(f"network {n} does not take an image of {x.dtype}: pass floats in [0, 1]") from error
        return replace(self.as_prediction(result, x), intrinsics=intrinsics)

    def as_prediction(self, result: Any, x: Tensor) -> DepthPrediction:
        """Convert a network's result for ``x`` [B, 3, H, W] to a prediction; a subclass may accept more types.

        Raises:
            TypeError: the result is no :class:`DepthPrediction`.
        """
        if not isinstance(result, DepthPrediction):
            raise TypeError(
                f"a network must return a DepthPrediction, got {type(result).__name__}: wrap it with "
                "ufmstar_torch.models.wrap_network(network), which declares the meaning of its output"
            )
        return result

    def every(self, x: Tensor, intrinsics: Tensor) -> DepthPrediction:
        """All members, or samples, on the output of :meth:`prepare`, combined (:func:`combine`)."""
        return combine([self.member(x, intrinsics, n) for n in range(self.passes)])

    def run_on_noise(self, size: tuple[int, int], streams: int) -> tuple[int, int]:
        """Run every network twice on noise in images of ``size`` (H, W); the size of their depth maps. The generators
        of random numbers are restored."""
        device = self.device or torch.device("cpu")
        floats = (t.dtype for t in self._tensors() if t.is_floating_point() and t.element_size() > 1)
        with torch.no_grad(), torch.random.fork_rng([device] if device.type == "cuda" else []):
            noise = torch.randint(0, 256, (streams, 3, *size), dtype=torch.uint8, device=device)
            image = (noise / 255).to(next(floats, torch.float32)) if self.preprocess is None else noise
            x, K = self.prepare(image, camera_of(size).to(torch.float64).expand(streams, 3, 3))
            for _ in range(2):
                maps = [self.member(x, K, n) for n in range(len(self.networks))]
        height, width = maps[0].depth.shape[1:]
        return height, width

    def train(self, mode: bool = True) -> Self:
        """Leaves the networks in eval mode: a prediction must not depend on the caller's training flag."""
        super().train(mode)
        self.networks.eval()
        return self


def modules_of(networks: object) -> list[nn.Module]:
    """Convert one network or a sequence of networks to a list.

    Raises:
        TypeError: another type.
        ValueError: an empty sequence.
    """
    members = list(networks) if isinstance(networks, Iterable) and not isinstance(networks, nn.Module) else [networks]
    if not members:
        raise ValueError("networks must hold at least one network")
    if wrong := [member for member in members if not isinstance(member, nn.Module)]:
        raise TypeError(
            f"networks must be an nn.Module or a sequence of them, got a {type(wrong[0]).__name__}; wrap other "
            "networks with ufmstar_torch.models.wrap_network(network)"
        )
    modules = [member for member in members if isinstance(member, nn.Module)]
    for module in modules:
        require_switchable(module)
    return modules


def require_switchable(network: nn.Module) -> None:
    """Raise a TypeError unless ``train`` of a network and of its parts has PyTorch's form ``train(mode)``, which
    ``eval()`` calls; in other libraries a method of this name starts a training."""
    for name, part in network.named_modules():
        if type(part).train is nn.Module.train and "train" not in vars(part):
            continue
        first = next(iter(signature(part.train).parameters), None)
        if first != "mode":
            where = f"{name}, a {type(part).__name__}," if name else f"a {type(part).__name__}"
            inner = isinstance(getattr(part, "model", None), nn.Module)
            remedy = "pass its module, NETWORK.model" if inner else "pass the nn.Module that it runs"
            raise TypeError(
                f"network is {where} whose train({first or ''}) is not PyTorch's train(mode): eval() would start it; "
                f"{remedy}, wrapped by ufmstar_torch.models.wrap_network"
            )


def shared_preprocess(networks: Sequence[nn.Module]) -> Preprocess:
    """The networks' attribute ``preprocess``, or :func:`in_unit_range` if no network has one.

    Raises:
        ValueError: the networks' attributes differ.
    """
    attributes = [p for network in networks if callable(p := getattr(network, "preprocess", None))]
    if any(other != attributes[0] for other in attributes):
        raise ValueError(
            f"networks must have the same preprocess, got {attributes}: pass one to UncertainDepth(preprocess=...)"
        )
    return attributes[0] if attributes else in_unit_range


def in_unit_range(image: Tensor, intrinsics: Tensor) -> tuple[Tensor, Tensor]:
    """Convert bytes to floats in [0, 1]; return other images, and the intrinsics, unchanged."""
    return (image.to(torch.get_default_dtype()) / 255 if image.dtype == torch.uint8 else image), intrinsics


def combine(predictions: Sequence[DepthPrediction]) -> DepthPrediction:
    """The mixture of an ensemble's predictions (Lakshminarayanan et al. 2017).

    depth = mean d_n; A = mean A_n; E = the variance of d_n between the members, 1/N sum d_n^2 - (mean d_n)^2, plus the
    mean E_n; the mean confidence; the first member's intrinsics; the sum of the times. A mean or the sum is omitted
    unless every member has a value.

    Raises:
        ValueError: no prediction.
    """
    if not predictions:
        raise ValueError("predictions must not be empty")
    depth = torch.stack([p.depth for p in predictions])
    between, stated = depth.var(0, correction=0), _mean([p.epistemic_variance for p in predictions])
    times = [p.ms for p in predictions if p.ms is not None]
    return DepthPrediction(
        depth.mean(0),
        _mean([p.aleatoric_variance for p in predictions]),
        between if stated is None else between + stated,
        _mean([p.confidence for p in predictions]),
        predictions[0].intrinsics,
        sum(times) if len(times) == len(predictions) else None,
    )


def _mean(maps: Sequence[Tensor | None]) -> Tensor | None:
    present = [value for value in maps if value is not None]
    return torch.stack(present).mean(0) if len(present) == len(maps) else None

"""Step 1: inference of the depth networks.

Section "Single DNN inference": one inference per image, by the members of an ensemble in turn, by a stochastic network,
or by a single one; or, for comparison, inference of all members on every image ("Full").
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace
from inspect import signature
from pathlib import Path
from typing import Any, Self
from zlib import crc32

import torch
from torch import Tensor, nn

from ufmstar_torch.frames.prediction import DepthPrediction, infer, stated_range, states_confidence

# Number of indices of random samples: exact in float32.
SAMPLES = 2**20
_PART = 2**16  # [bytes] of a file's beginning and end
# image [B, 3, H, W], intrinsics [B, 3, 3] -> network image and the intrinsics of that image
Preprocess = Callable[[Tensor, Tensor], tuple[Tensor, Tensor]]


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
        ValueError: no network, or ``samples`` with several networks.
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
        if samples is not None and (samples < 1 or len(members) > 1):
            raise ValueError(f"samples must be at least 1 and goes with one network, got {samples} of {len(members)}")
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


def weights_mark(networks: nn.Module) -> int:
    """A checksum that changes with the weights: of 16 entries of every dense tensor of the state, and of the first and
    last 64 kB of files that networks run (their attribute ``path``)."""
    mark = 0
    for module in networks.modules():
        path = getattr(module, "path", None)
        if isinstance(path, str) and Path(path).is_file():
            with Path(path).open("rb") as file:
                mark = crc32(file.read(_PART), mark)
                file.seek(max(Path(path).stat().st_size - _PART, 0))
                mark = crc32(file.read(), mark)
    for value in networks.state_dict().values():
        # Quantised layers also hold other values, and offloaded layers hold tensors without entries.
        dense = type(value) in (Tensor, nn.Parameter) and value.layout == torch.strided and not value.is_quantized
        if dense and not value.is_meta and value.numel():
            index = [n * (value.numel() - 1) // 15 for n in range(16)]
            stored = value.detach() if value.element_size() > 1 else value.detach().view(torch.uint8)
            entries = stored.take(torch.tensor(index, device=value.device))
            mark = crc32(entries.cpu().view(torch.uint8).numpy().tobytes(), mark)
    return mark


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

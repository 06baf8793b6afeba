"""Step 1: depth networks in turn, or all of them on every image.

Section "Single DNN inference": one inference per image, by the members of an ensemble in turn, by a
stochastic network, or by a single one; or, for comparison, by all of them at once ("Full").
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace
from typing import Any, Self

import torch
from torch import Tensor, nn

from ufmstar_torch.prediction import DepthPrediction, infer, stated_range, states_confidence

# image [B, 3, H, W], intrinsics [B, 3, 3] -> network image and the intrinsics of that image
Preprocess = Callable[[Tensor, Tensor], tuple[Tensor, Tensor]]


class NetworksInTurn(nn.Module):
    """Depth networks that take the same input: one of them per image, in turn, or all of them on every image.

    Nothing is stored between images: the caller counts them and calls :meth:`turn`. The networks stay in eval mode,
    whatever the caller's training flag is.

    Args:
        networks: one network or a sequence of them. Each maps an image [B, 3, H, W] to a :class:`DepthPrediction`; one
            with an attribute ``takes_intrinsics = True`` is called with the intrinsics of that image as well.
        samples: passes of a single stochastic network that :meth:`every` combines; None: one pass of each network.
        preprocess: maps image and intrinsics to the networks' input; None passes both through.

    Raises:
        TypeError: something that is no ``nn.Module``.
        ValueError: no network, or ``samples`` of several.
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
        """[m] The largest depth that the networks can predict, where each of them states one."""
        return stated_range(self.networks)

    @property
    def states_confidence(self) -> bool:
        """True if each of the networks states a confidence."""
        return states_confidence(self.networks)

    @property
    def passes(self) -> int:
        """Inferences that :meth:`every` takes."""
        return len(self.networks) if self.samples is None else self.samples

    def turn(self, images: int) -> int:
        """The member whose turn it is after ``images`` images, both counted from 0."""
        return images % len(self.networks)

    def prepare(self, image: Tensor, intrinsics: Tensor) -> tuple[Tensor, Tensor]:
        """The networks' input [B, 3, h, w] and its intrinsics [B, 3, 3] [px]."""
        return (image, intrinsics) if self.preprocess is None else self.preprocess(image, intrinsics)

    def member(self, x: Tensor, intrinsics: Tensor, n: int) -> DepthPrediction:
        """One inference of member ``n``, or sample ``n`` of a single network, on what :meth:`prepare` returned; the
        prediction has its intrinsics.

        Raises:
            TypeError: the network takes no uint8, or as :meth:`as_prediction`.
        """
        try:
            result = infer(self.networks[n % len(self.networks)], x, intrinsics)
        except RuntimeError as error:
            if x.is_floating_point():
                raise
            raise TypeError(f"network {n} does not take an image of {x.dtype}: give floats in [0, 1]") from error
        return replace(self.as_prediction(result, x), intrinsics=intrinsics)

    def as_prediction(self, result: Any, x: Tensor) -> DepthPrediction:
        """The prediction in a network's result for ``x`` [B, 3, H, W]; a class may accept more networks.

        Raises:
            TypeError: it is no :class:`DepthPrediction`.
        """
        if not isinstance(result, DepthPrediction):
            raise TypeError(
                f"a network must return a DepthPrediction, got {type(result).__name__}: wrap it with "
                "ufmstar_torch.models.wrap_network(network), which declares what its output means"
            )
        return result

    def every(self, x: Tensor, intrinsics: Tensor) -> DepthPrediction:
        """All members, or samples, on what :meth:`prepare` returned, combined (:func:`combine`)."""
        return combine([self.member(x, intrinsics, n) for n in range(self.passes)])

    def train(self, mode: bool = True) -> Self:
        """The networks stay in eval mode: a prediction must not depend on the caller's training flag."""
        super().train(mode)
        self.networks.eval()
        return self


def modules_of(networks: object) -> list[nn.Module]:
    """One network or a sequence of them as a list.

    Raises:
        TypeError: something else.
        ValueError: an empty sequence.
    """
    members = list(networks) if isinstance(networks, Iterable) and not isinstance(networks, nn.Module) else [networks]
    if not members:
        raise ValueError("networks must hold at least one network")
    if wrong := [member for member in members if not isinstance(member, nn.Module)]:
        raise TypeError(
            f"networks must be an nn.Module or a sequence of them, got a {type(wrong[0]).__name__}; wrap another "
            "kind with ufmstar_torch.models.wrap_network(network)"
        )
    return [member for member in members if isinstance(member, nn.Module)]


def own_preprocess(networks: Sequence[nn.Module]) -> Preprocess:
    """The networks' attribute ``preprocess``, or :func:`in_unit_range` where none has one.

    Raises:
        ValueError: they have different ones.
    """
    stated = [
        stated_preprocess for network in networks if callable(stated_preprocess := getattr(network, "preprocess", None))
    ]
    if any(other != stated[0] for other in stated):
        raise ValueError(f"networks must have the same preprocess, or UncertainDepth be given one, got {stated}")
    return stated[0] if stated else in_unit_range


def in_unit_range(image: Tensor, intrinsics: Tensor) -> tuple[Tensor, Tensor]:
    """Bytes as floats in [0, 1]; other images and the intrinsics as they are."""
    return (image.to(torch.get_default_dtype()) / 255 if image.dtype == torch.uint8 else image), intrinsics


def combine(predictions: Sequence[DepthPrediction]) -> DepthPrediction:
    """The mixture of an ensemble's predictions (Lakshminarayanan et al. 2017).

    depth = mean d_n; A = mean A_n (None unless every member has one); E = the variance of d_n between
    the members, 1/N sum d_n^2 - (mean d_n)^2, plus the mean of their own E_n where every member has one; the mean
    confidence where every member has one; the first member's intrinsics, and the sum of the times if all are known.

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
    stated = [value for value in maps if value is not None]
    return torch.stack(stated).mean(0) if len(stated) == len(maps) else None

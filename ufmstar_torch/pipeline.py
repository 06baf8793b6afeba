"""Step 1 and the rest together: network(s), their alternation and UfM* on one device.

Section "Single DNN inference": one inference per image, by the members of an ensemble in turn, by a
stochastic network, or by a single one; or, for comparison, by all of them at once ("Full").
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any, Self

import torch
from torch import Tensor, nn

from ufmstar_torch.anchors.anchors import Anchors, require_anchors
from ufmstar_torch.anchors.streams import Given, StreamLandmarks
from ufmstar_torch.config import AnchorConfig, PosteriorConfig, UfMStarConfig
from ufmstar_torch.output import FrameStatistics, MeanUncertainty, UfMStarOutput
from ufmstar_torch.prediction import DepthPrediction, infer, stated_range
from ufmstar_torch.recalibrate import Recalibration
from ufmstar_torch.stateful import outliving
from ufmstar_torch.ufmstar import UfMStar

# image [B, 3, H, W], intrinsics [B, 3, 3] -> network image and the intrinsics of that image
Preprocess = Callable[[Tensor, Tensor], tuple[Tensor, Tensor]]


@dataclass(frozen=True)
class UncertainPrediction:
    """A depth prediction with its total variance.

    Attributes:
        prediction: the network's output (for "full": the predictive mean, mean A and E over the members).
        ufm: the output of UfM*; ``ufm.variance`` [m^2] is the answer.
        intrinsics: [B, 3, 3] of the predicted depth map [px].
        member: index of the network that was run, or None if all were.
    """

    prediction: DepthPrediction
    ufm: UfMStarOutput
    intrinsics: Tensor
    member: int | None

    @property
    def depth(self) -> Tensor:
        """[B, H, W] [m]."""
        return self.prediction.depth

    @property
    def variance(self) -> Tensor:
        """[B, H, W] V [m^2]."""
        return self.ufm.variance

    @property
    def std(self) -> Tensor:
        """[B, H, W] sqrt(V) [m]."""
        return self.ufm.std

    @property
    def disagreement(self) -> Tensor:
        """[B, H, W] M [m^2]."""
        return self.ufm.disagreement


@dataclass(frozen=True)
class _Predicted:
    """A prediction on its way to UfM*'s device.

    Attributes:
        prediction, intrinsics, member: as in :class:`UncertainPrediction`.
        features: [B, F, H, W] for UfM*, or None.
        ready: when the values have arrived; None = they are there for whatever is queued on their device.
    """

    prediction: DepthPrediction
    intrinsics: Tensor
    member: int | None
    features: Tensor | None
    ready: torch.cuda.Event | None

    def arrived(self) -> DepthPrediction:
        """The prediction; waits for copies to the host."""
        if self.ready is not None:
            self.ready.synchronize()
        return self.prediction


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
        members = [] if networks is None else _modules(networks)
        if samples is not None and (samples < 1 or len(members) > 1):
            raise ValueError(f"samples must be at least 1 and goes with one network, got {samples} of {len(members)}")
        self.networks = nn.ModuleList(members).eval()
        self.samples = samples
        self.preprocess = preprocess

    @property
    def max_depth(self) -> float | None:
        """[m] The largest depth that the networks can predict, where each of them states one."""
        return stated_range(self.networks)

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
        """One inference of member ``n``, or sample ``n`` of a single network, on what :meth:`prepare` returned.

        Raises:
            TypeError: the network returns something else than a :class:`DepthPrediction`.
        """
        prediction = infer(self.networks[n % len(self.networks)], x, intrinsics)
        if not isinstance(prediction, DepthPrediction):
            raise TypeError(
                f"network {n} must return a DepthPrediction, got {type(prediction).__name__}: wrap it with "
                "ufmstar_torch.models.wrap_network(network), which declares what its output means"
            )
        return prediction

    def every(self, x: Tensor, intrinsics: Tensor) -> DepthPrediction:
        """All members, or samples, on what :meth:`prepare` returned, combined (:func:`combine`)."""
        return combine([self.member(x, intrinsics, n) for n in range(self.passes)])

    def train(self, mode: bool = True) -> Self:
        """The networks stay in eval mode: a prediction must not depend on the caller's training flag."""
        super().train(mode)
        self.networks.eval()
        return self


class UncertainDepth(NetworksInTurn):
    """Depth with a variance from any pretrained network(s): image, pose and intrinsics in.

    Args:
        networks: one network or a sequence of them (an ensemble's members; BatchEnsemble members as
            separate callables); None: predictions are given to :meth:`update`. Each maps an image [B, 3, H, W] to a
            :class:`DepthPrediction`; one with an attribute ``takes_intrinsics = True`` is called as
            ``network(x, K)`` with K [B, 3, 3] [px] of ``x``.
        config: of UfM*; where ``segment.max_depth`` is None, it becomes the networks' (:attr:`max_depth`). With
            ``features=1`` the network's aleatoric variance is averaged per Gaussian and regressed
            as the second entry of H (``ufm.features``), unless other features are given.
        mode: "alternate" runs member n = i mod N (counted from 0) on image i; with one network this is the
            single-model mode, and with ``samples`` it is the sampling-based mode. "full" runs every member
            (or ``samples`` passes of a stochastic network) per image and takes the predictive mean, the mean
            aleatoric variance and the variance between the members as epistemic variance.
        posterior: also a corrected depth and its variance, ``out.ufm.posterior()``: ``config`` with the sections
            ``anchors`` and ``posterior``.
        samples: number of stochastic passes per image in mode "full" with one network (MC-Dropout; the
            network must sample by itself in eval mode). None: the network is deterministic.
        preprocess: maps image and intrinsics to the network's input; None passes both through.
        anchors: what yields the anchors of every image, with ``config.anchors``: "corners" (tracked in the image),
            "dense" (searched in earlier images), a file of landmarks, or a
            :class:`~ufmstar_torch.anchors.landmarks.LandmarkSource`; of several streams, a list with one for
            each. Saved and reset with the state. None: those given with an image, if any.
        recalibration: a map of V, after everything else (``Recalibration.from_json(FILE)``); None = V as it is.
        multiview_device: of UfM* and of the results, whatever the networks' is: "cpu" for the paper's split. None = the
            networks'. :meth:`stream` runs both at the same time.

    The networks are put into eval mode here and run without gradients. A stochastic network decides itself
    to sample in eval mode, as decoder dropout at test time does.

    Raises:
        TypeError: something that is no ``nn.Module``: a function needs ``ufmstar_torch.models.wrap_network``.
        ValueError: no network, an unknown mode, ``samples`` that fit neither, or anchors without ``config.anchors``.

    Example::

        model = UncertainDepth(network, UfMStarConfig(anchors=AnchorConfig()), anchors="corners")
        for image, pose, intrinsics in video:  # [1, 3, H, W] uint8, [4, 4], [3, 3]
            out = model(image, pose, intrinsics)
            out.variance  # M + A + E + B
    """

    image_index: Tensor

    def __init__(
        self,
        networks: nn.Module | Sequence[nn.Module] | None,
        config: UfMStarConfig | None = None,
        *,
        mode: str = "alternate",
        posterior: bool = False,
        samples: int | None = None,
        preprocess: Preprocess | None = None,
        anchors: Given | list[Given] | tuple[Given, ...] | None = None,
        recalibration: Recalibration | None = None,
        multiview_device: torch.device | str | None = None,
    ) -> None:
        single = networks is not None and len(_modules(networks)) == 1
        if mode not in ("alternate", "full"):
            raise ValueError(f"mode must be 'alternate' or 'full', got {mode!r}")
        if samples is not None and (samples < 2 or not single or mode != "full"):
            raise ValueError("samples must be at least 2 and goes with one network in mode 'full'")
        if mode == "full" and single and samples is None:
            raise ValueError("mode 'full' needs several networks, or samples for a stochastic one")
        super().__init__(networks, samples=samples, preprocess=preprocess)
        if posterior:
            config = config or UfMStarConfig()
            config = config.replace(
                anchors=config.anchors or AnchorConfig(), posterior=config.posterior or PosteriorConfig()
            )
        mapped = () if recalibration is None else (recalibration,)
        self.ufm = UfMStar((config or UfMStarConfig()).within(self.max_depth), extensions=mapped)
        if anchors is not None and self.ufm.config.anchors is None:
            raise ValueError("anchors go with UfMStarConfig(anchors=AnchorConfig())")
        self.landmarks = None if anchors is None else StreamLandmarks(anchors)
        self.mode = mode
        self.multiview_device = None if multiview_device is None else torch.device(multiview_device)
        self.register_buffer("image_index", torch.zeros((), dtype=torch.int64))
        self._next = 0

    def forward(
        self,
        image: Tensor,
        pose: Tensor,
        intrinsics: Tensor,
        valid: Tensor | None = None,
        *,
        features: Tensor | None = None,
        anchors: Anchors | None = None,
    ) -> UncertainPrediction:
        """Predict depth and its variance for the next image of every stream.

        Args:
            image: [B, 3, H, W] as the preprocessing (or the network) expects it.
            pose: [B, 4, 4] or [4, 4] camera-to-world [m].
            intrinsics: [B, 3, 3] or [3, 3] of ``image`` [px].
            valid: [B, h, w] bool at the depth map's size, True = use.
            features: [B, F, h, w] likewise, F = ``config.features``; None with F = 1: the aleatoric variance [m^2].
            anchors: sparse depths of this frame, [B, N] padded and masked, with ``config.anchors``; their pixels are
                those of ``image`` and ``intrinsics``, whatever the preprocessing makes of them. None = those of the
                constructor's source, or none.

        Raises:
            ValueError, TypeError: as :meth:`UfMStar.forward`; neither alternation nor landmarks have advanced then.
        """
        return self._fused(self._predicted(image, intrinsics, features), image, pose, intrinsics, valid, anchors)

    def stream(self, frames: Iterable[tuple[Tensor, Tensor, Tensor]]) -> Iterator[UncertainPrediction]:
        """The predictions of a video, in order, with the networks one image ahead of UfM*.

        With networks on a GPU and ``multiview_device="cpu"`` the two run at the same time, so each result comes when
        the next image has been given.

        Args:
            frames: image, pose and intrinsics of each, as :meth:`forward` takes them.

        Raises:
            ValueError, TypeError: as :meth:`forward`.
        """
        waiting: tuple[_Predicted, tuple[Tensor, Tensor, Tensor]] | None = None
        for image, pose, intrinsics in frames:
            ahead = self._predicted(image, intrinsics, None, ahead=waiting is not None)
            if waiting is not None:
                yield self._fused(waiting[0], *waiting[1], None, None)
            waiting = ahead, (image, pose, intrinsics)
        if waiting is not None:
            yield self._fused(waiting[0], *waiting[1], None, None)

    def _fused(
        self,
        given: _Predicted,
        image: Tensor,
        pose: Tensor,
        intrinsics: Tensor,
        valid: Tensor | None,
        anchors: Anchors | None,
    ) -> UncertainPrediction:
        K, prediction = given.intrinsics, given.arrived()
        with self._anchored(image, pose, intrinsics, K, anchors) as own:
            ufm = self.update(prediction, pose, K, valid, features=given.features, anchors=own)
        self._undo(ufm.statistics)
        return UncertainPrediction(prediction, ufm, K, given.member)

    def update(
        self,
        prediction: DepthPrediction,
        pose: Tensor,
        intrinsics: Tensor,
        valid: Tensor | None = None,
        *,
        features: Tensor | None = None,
        anchors: Anchors | None = None,
    ) -> UfMStarOutput:
        """Process a prediction that is there already (cached, or from elsewhere), as :meth:`forward` does after its
        networks.

        Args:
            prediction: [B, h, w].
            pose: [B, 4, 4] or [4, 4] camera-to-world [m].
            intrinsics: [B, 3, 3] or [3, 3] of the depth map [px].
            valid, features: as in :meth:`forward`.
            anchors: [B, N] in the pixels of the depth map; None = none, also with a source of anchors.

        Raises:
            ValueError, TypeError: as :meth:`UfMStar.forward`; the images are not counted then.
        """
        a, e = prediction.aleatoric_variance, prediction.epistemic_variance
        out: UfMStarOutput = self.ufm(
            prediction.depth, pose, intrinsics, a, e, valid, anchors=anchors, features=features
        )
        self._count(self._next + 1)
        return out

    def mean_uncertainty(
        self,
        image: Tensor,
        pose: Tensor,
        intrinsics: Tensor,
        valid: Tensor | None = None,
        *,
        features: Tensor | None = None,
        anchors: Anchors | None = None,
        pixels: int | None = None,
        fraction: float | None = None,
        seed: int = 0,
        average: bool = False,
    ) -> MeanUncertainty:
        """Like :meth:`forward`, but an average variance per image, for active learning.

        Args:
            image, pose, intrinsics, valid, features, anchors: as in :meth:`forward`.
            pixels, fraction, seed, average: as in :meth:`UfMStar.mean_uncertainty`.

        Raises:
            ValueError, TypeError: as :meth:`UfMStar.mean_uncertainty`; neither alternation nor landmarks have advanced
                then.
        """
        given = self._predicted(image, intrinsics, features)
        prediction, K = given.arrived(), given.intrinsics
        sample: dict[str, Any] = {"pixels": pixels, "fraction": fraction, "seed": seed, "average": average}
        with self._anchored(image, pose, intrinsics, K, anchors) as own:
            a, e = prediction.aleatoric_variance, prediction.epistemic_variance
            mean = self.ufm.mean_uncertainty(
                prediction.depth, pose, K, a, e, valid, anchors=own, features=given.features, **sample
            )
        self._undo(mean.statistics)
        self._count(self._next + 1)
        return mean

    @contextmanager
    def _anchored(
        self, image: Tensor, pose: Tensor, intrinsics: Tensor, K: Tensor, anchors: Anchors | None
    ) -> Iterator[Anchors | None]:
        """The image's anchors, given or from the source, in the pixels of K [B, 3, 3]; an error inside undoes them.

        Raises:
            ValueError: both, or as :meth:`StreamLandmarks.update`.
        """
        if self.landmarks is not None:
            if anchors is not None:
                raise ValueError("anchors come from the source that UncertainDepth was made with: give none")
            config = self.ufm.config
            tolerance = config.rotation_tolerance if config.on_bad_frame == "skip" else None
            anchors = self.landmarks.update(image, pose, intrinsics, tolerance)
        try:
            moved = anchors is not None and self.preprocess is not None
            yield require_anchors(anchors).moved(intrinsics, K) if moved else anchors
        except BaseException:
            if self.landmarks is not None:
                self.landmarks.undo()
            raise

    def _undo(self, statistics: FrameStatistics) -> None:
        """The landmarks of streams that skipped an image forget it."""
        if self.landmarks is not None:
            self.landmarks.undo(statistics.fault.nonzero().flatten().tolist())

    def _predicted(
        self, image: Tensor, intrinsics: Tensor, features: Tensor | None, *, ahead: bool = False
    ) -> _Predicted:
        """The prediction for the next image, or, with ``ahead``, for the one after that."""
        if not self.networks:
            raise ValueError("UncertainDepth(None) has no networks: give the predictions to update")
        if image.dim() != 4 or image.shape[1] != 3:
            raise ValueError(f"image must be [B, 3, H, W], got {tuple(image.shape)}")
        member = None if self.mode == "full" else self.turn(self._next + ahead)
        with torch.no_grad():
            x, K = self.prepare(image, intrinsics.expand(image.shape[0], 3, 3))
            prediction = self.every(x, K) if member is None else self.member(x, K, member)
        if features is None and self.ufm.config.features == 1:
            if prediction.aleatoric_variance is None:
                raise ValueError(
                    "config.features=1 regresses the aleatoric variance, but the network predicts none: give features"
                )
            features = prediction.aleatoric_variance[:, None]
        parts = (prediction.depth, prediction.aleatoric_variance, prediction.epistemic_variance, K, features)
        (depth, *own, K_there, features), ready = _copied(parts, self.multiview_device)
        assert depth is not None
        assert K_there is not None
        return _Predicted(DepthPrediction(depth, *own), K_there, member, features, ready)

    def _apply(self, fn: Callable[[Tensor], Tensor], recurse: bool = True) -> Self:
        """The networks move; UfM* stays on its own device, if it has one."""
        super()._apply(fn, recurse)
        if self.multiview_device is not None:
            self.ufm.to(self.multiview_device)
        return self

    def reset(self, streams: Sequence[int] | Tensor | None = None, *, keep_evidence: bool = False) -> None:
        """Forget the views (:meth:`UfMStar.reset`); resetting all streams also restarts the alternation."""
        self.ufm.reset(streams, keep_evidence=keep_evidence)
        if self.landmarks is not None:
            b = self.ufm.mean.shape[0]
            mask = None if streams is None else self.ufm._chosen(streams, b).nonzero().flatten().tolist()
            self.landmarks.reset(mask)
        if streams is None:
            self._count(0)

    def _count(self, images: int) -> None:
        """Images seen, as a number for the alternation and as a buffer for state_dict."""
        self._next = images
        with outliving():  # the buffer must outlive the caller's inference mode
            self.image_index = torch.full_like(self.image_index, images)

    def _save_to_state_dict(self, destination: Any, prefix: str, keep_vars: bool) -> None:
        super()._save_to_state_dict(destination, prefix, keep_vars)
        if self.landmarks is not None:
            destination.update({f"{prefix}landmarks.{n}": value for n, value in self.landmarks.state().items()})

    def _load_from_state_dict(self, state_dict: dict[str, Tensor], prefix: str, *args: Any) -> None:
        own = f"{prefix}landmarks."
        if self.landmarks is not None:
            state = {key[len(own) :]: state_dict.pop(key) for key in list(state_dict) if key.startswith(own)}
            try:
                self.landmarks.load_state(state)
            except ValueError as error:
                args[-1].append(str(error))
                return
        super()._load_from_state_dict(state_dict, prefix, *args)
        self._next = int(self.image_index)


def _copied(
    values: Sequence[Tensor | None], device: torch.device | None
) -> tuple[list[Tensor | None], torch.cuda.Event | None]:
    """The values on ``device`` (None: where they are), and when copies from CUDA into pinned memory will have ended."""

    def copy(value: Tensor | None) -> Tensor | None:
        if value is None or device is None:
            return value
        if device.type != "cpu" or value.device.type != "cuda":
            return value.to(device, non_blocking=True)
        return torch.empty(value.shape, dtype=value.dtype, pin_memory=True).copy_(value.detach(), non_blocking=True)

    copies = [copy(value) for value in values]
    source = values[0]
    if source is None or device is None or device.type != "cpu" or source.device.type != "cuda":
        return copies, None
    ready = torch.cuda.Event()
    ready.record(torch.cuda.current_stream(source.device))
    return copies, ready


def _modules(networks: object) -> list[nn.Module]:
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
            f"networks must be an nn.Module or a sequence of them, got a {type(wrong[0]).__name__}"
            + ("; wrap a function with ufmstar_torch.models.wrap_network(function)" if callable(wrong[0]) else "")
        )
    return [member for member in members if isinstance(member, nn.Module)]


def combine(predictions: Sequence[DepthPrediction]) -> DepthPrediction:
    """The mixture of an ensemble's predictions (Lakshminarayanan et al. 2017).

    depth = mean d_n; A = mean A_n (None unless every member has one); E = the variance of d_n between
    the members, 1/N sum d_n^2 - (mean d_n)^2, plus the mean of their own E_n where every member has one.

    Raises:
        ValueError: no prediction.
    """
    if not predictions:
        raise ValueError("predictions must not be empty")
    depth = torch.stack([p.depth for p in predictions])

    def mean_of(values: list[Tensor | None]) -> Tensor | None:
        present = [v for v in values if v is not None]
        return torch.stack(present).mean(0) if len(present) == len(values) else None

    own = mean_of([p.epistemic_variance for p in predictions])
    between = depth.var(0, correction=0)
    return DepthPrediction(
        depth.mean(0),
        mean_of([p.aleatoric_variance for p in predictions]),
        between if own is None else between + own,
    )

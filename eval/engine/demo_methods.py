"""The rows of the demo's table: one network's own variance, UfM, UfM*, and a whole ensemble, on the same frames.

The members of an ensemble take turns, one inference per image; the first three methods judge that same prediction.
The fourth runs every member on every image, which is what alternation saves.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from statistics import median

import torch
from torch import Tensor

from ufmstar_torch.eval.engine.run_clock import Stopwatch
from ufmstar_torch.eval.methods.ufm import UfM
from ufmstar_torch.eval.metrics import SequenceMetrics
from ufmstar_torch.eval.sequences.frame import Frame
from ufmstar_torch.eval.sequences.images import image_tensor
from ufmstar_torch.models.network import DepthNetwork
from ufmstar_torch.pipeline import combine
from ufmstar_torch.prediction import DepthPrediction
from ufmstar_torch.ufmstar import UfMStar

NETWORK, UFM, UFM_STAR, ENSEMBLE = "network", "ufm", "ufm_star", "ensemble"
METHODS = (NETWORK, UFM, UFM_STAR, ENSEMBLE)


@dataclass(frozen=True)
class Estimate:
    """Depth and its variance by one method, on the CPU.

    Attributes:
        depth: [h, w] [m].
        variance: [h, w] [m^2].
        valid: [h, w] bool, True where both hold.
    """

    depth: Tensor
    variance: Tensor
    valid: Tensor


@dataclass(frozen=True)
class Compared:
    """One frame by all methods.

    Attributes:
        estimates: by method.
        intrinsics: [3, 3] float64 of the maps [px].
        ms: time of the network ("network", "ensemble") and of the uncertainty ("ufm", "ufm_star") [ms].
    """

    estimates: Mapping[str, Estimate]
    intrinsics: Tensor
    ms: Mapping[str, float]

    @property
    def size(self) -> tuple[int, int]:
        """Height and width of the maps [px]."""
        height, width = self.estimates[NETWORK].depth.shape
        return height, width


class Comparison:
    """All methods side by side, frame by frame.

    Args:
        members: at least one network with a variance of its own; all with the same ``preprocess``.
        device: where they run.

    Raises:
        ValueError: no member.
    """

    def __init__(self, members: Sequence[DepthNetwork], device: torch.device) -> None:
        if not members:
            raise ValueError("members must hold at least one network")
        self._members = [member.to(device).eval() for member in members]
        self._device = device
        self._clock = Stopwatch(device)
        self._frames = 0
        self.ufm = UfM().to(device)
        self.ufm_star = UfMStar().to(device)

    @property
    def methods(self) -> tuple[str, ...]:
        """The rows there are; a single network is no ensemble."""
        return METHODS if len(self._members) > 1 else METHODS[:-1]

    def state_bytes(self) -> dict[str, int]:
        """What each method remembers between two images [bytes]."""
        mixture = self.ufm_star.mixture
        stars = int(mixture.components.sum()) * mixture.bytes_per_component()
        points = self.ufm.moments.nbytes + self.ufm.count.nbytes
        return {NETWORK: 0, UFM: points, UFM_STAR: stars, ENSEMBLE: 0}

    def restart(self) -> None:
        """Forget all frames."""
        self._frames = 0
        self.ufm.reset()
        self.ufm_star.reset()

    def take(self, frame: Frame) -> Compared:
        """The next frame by all methods.

        Raises:
            FrameError: it has no image.
            ValueError: a network states no variance of its own.
        """
        image = image_tensor(frame).to(self._device)
        pose, K = torch.from_numpy(frame.T_world_cam)[None], torch.from_numpy(frame.intrinsics)[None]
        turn = self._frames % len(self._members)
        with torch.no_grad():
            x, K = self._members[turn].preprocess(image, K)
            predictions = [self._predict(n, x) for n in range(len(self._members))]
            one = predictions[turn]
            maps = (one.depth, pose, K, one.aleatoric_variance, one.epistemic_variance)
            with self._clock.stage(UFM):
                ufm = self.ufm(*maps)
            with self._clock.stage(UFM_STAR):
                ufm_star = self.ufm_star(*maps)
        self._frames += 1
        estimates = {
            NETWORK: _estimate(one, _own(one), ufm.valid),
            UFM: _estimate(one, ufm.variance, ufm.valid),
            UFM_STAR: _estimate(one, ufm_star.variance, ufm_star.valid),
        }
        if len(predictions) > 1:
            mean = combine(predictions)
            estimates[ENSEMBLE] = _estimate(mean, _own(mean), mean.depth > 0)
        times = self._clock.take()
        inferences = [times[f"member {n}"] for n in range(len(self._members))]
        ms = {NETWORK: inferences[turn], ENSEMBLE: sum(inferences), UFM: times[UFM], UFM_STAR: times[UFM_STAR]}
        return Compared(estimates, K[0].cpu(), ms)

    def _predict(self, n: int, x: Tensor) -> DepthPrediction:
        with self._clock.stage(f"member {n}"):
            prediction: DepthPrediction = self._members[n](x)
        return prediction


def _own(prediction: DepthPrediction) -> Tensor:
    """[1, h, w] the variance that the network itself states.

    Raises:
        ValueError: it states none.
    """
    if prediction.variance is None:
        raise ValueError("the demo needs networks with a variance of their own (an aleatoric or evidential head)")
    return prediction.variance


def _estimate(prediction: DepthPrediction, variance: Tensor, valid: Tensor) -> Estimate:
    return Estimate(prediction.depth[0].cpu(), variance[0].cpu(), valid[0].cpu())


class Tally:
    """Figures against ground truth, by method and by kind of room, and the times.

    Args:
        methods: the rows.
        kinds: of rooms.
    """

    def __init__(self, methods: Sequence[str], kinds: Sequence[str]) -> None:
        self.methods, self.kinds = tuple(methods), tuple(kinds)
        self._metrics = {(method, kind): SequenceMetrics() for method in methods for kind in kinds}
        self._variance = dict.fromkeys(self._metrics, (0.0, 0))
        self._ms: dict[str, list[float]] = {}

    def add(self, compared: Compared, truth: Tensor, kinds: Tensor) -> None:
        """Add a frame.

        Args:
            compared: by all methods.
            truth: [h, w] ground truth [m], 0 = none.
            kinds: [h, w] int64 index of the kind of room that a pixel shows.
        """
        for number, kind in enumerate(self.kinds):
            there = (kinds == number) & (truth > 0)
            if bool(there.any()):
                for method, estimate in compared.estimates.items():
                    self._add(method, kind, estimate, truth, there & estimate.valid)
        for stage, time in compared.ms.items():
            self._ms.setdefault(stage, []).append(time)

    def _add(self, method: str, kind: str, estimate: Estimate, truth: Tensor, use: Tensor) -> None:
        self._metrics[method, kind].update(estimate.depth, estimate.variance, truth, use)
        chosen = estimate.variance[use].double()
        total, pixels = self._variance[method, kind]
        self._variance[method, kind] = (total + float(chosen.sum()), pixels + chosen.numel())

    def overall(self) -> dict[str, SequenceMetrics]:
        """The metrics of all frames, by method."""
        merged = {}
        for method in self.methods:
            merged[method] = SequenceMetrics()
            for kind in self.kinds:
                merged[method].merge_state(self._metrics[method, kind])
        return merged

    def by_kind(self) -> dict[str, dict[str, dict[str, float]]]:
        """By kind and method: "rmse" [m], "rms_sigma" (root of the mean variance) [m] and the other figures."""
        return {
            kind: {
                method: {**self._metrics[method, kind].compute(), "rms_sigma": self._rms_sigma(method, kind)}
                for method in self.methods
            }
            for kind in self.kinds
        }

    def median_ms(self) -> dict[str, float]:
        """Of the typical frame, by stage [ms]."""
        return {stage: median(times) for stage, times in self._ms.items()}

    def _rms_sigma(self, method: str, kind: str) -> float:
        total, pixels = self._variance[method, kind]
        return (total / pixels) ** 0.5 if pixels else float("nan")

"""Dense anchors from the images themselves: in every cell of the image one pixel, measured against earlier keyframes.

Where :class:`~ufmstar_torch.anchors.tracker.LandmarkTracker` follows corners, this searches along epipolar lines: edges
give depths too, on most surfaces, and what has little parallax is kept with a large variance. Cells in which that finds
nothing are searched again by windows of twice the width, which surfaces without fine texture need. Inverse depth is
what is measured, rho = 1/depth with a standard deviation sigma: an anchor has the depth 1/rho and the variance
sigma^2 depth^4. Some corners are followed too. They measure how far poses and images disagree, which a search along
lines of these poses cannot, and are anchors where no other lies near.

Needs OpenCV and numba, on the CPU. One a camera; what it keeps is of fixed size: the keyframes and some numbers.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, ClassVar, NamedTuple

import numpy as np
from numpy.typing import NDArray
from torch import Tensor

from ufmstar_torch.anchors.dense_keyframes import Keyframes
from ufmstar_torch.anchors.dense_memory import Memory
from ufmstar_torch.anchors.dense_poses import Fit, PoseErrors
from ufmstar_torch.anchors.epipolar import median
from ufmstar_torch.anchors.landmarks import REPEATED, Landmarks, OtherCameraError, checked
from ufmstar_torch.anchors.saved_state import SavedState
from ufmstar_torch.anchors.tracker import LandmarkTracker, TrackerConfig
from ufmstar_torch.checked import Checked, number
from ufmstar_torch.optional import optional

if TYPE_CHECKING:
    from ufmstar_torch.kernels.dense_cpu import Search, Views

# Baselines of the keyframes that a frame is compared with, as shares of the median depth.
_BASELINES = (0.04, 0.1, 0.22, 0.45)
# Range of the first search of inverse depth, over 1/median depth.
_NEAREST, _FARTHEST = 6.0, -0.03
# Anchors on which running estimates of noise are based.
_ENOUGH = 10
# Frames in a row that contradict their poses, after which keyframes and landmarks are forgotten: the poses have jumped.
_JUMPED = 3
# Standard deviation of an inverse depth, as a share, by what no image shows: the scale of the poses.
_SCALE = 0.005
# Variance of a match of the wide windows, over that which its residual states; on tours, 2 to 4.
_COARSE_NOISE = 4.0
_CORNERS = "corners_"  # before the names of the tracker's state


@dataclass(frozen=True)
class DenseConfig(Checked):
    """Settings of the search for dense anchors, and of their acceptance.

    Attributes:
        width: largest width of the image that is searched [px]; larger images are reduced to it.
        keyframes: how many are kept.
        landmarks: how many are remembered.
        corners: corners that are followed.
        corner_distance: of a corner that is an anchor from all dense ones, as a share of the width.
        corner_sigma: its largest standard deviation, and the largest one that the distance of corners from their
            epipolar lines makes over their baseline, as shares of its depth. Where errors of the refined poses make a
            larger one at the median depth, nothing is searched.
        start_depth: median depth of the scene before one is known [m]; right to a factor of 5.
        least_score: of a match, zero-mean normalised cross-correlation (ZNCC).
        rival: a match is unique where the best other one has this many times its 1 - ZNCC at least.
        sigmas: standard deviations by which measurements may differ, and half width of the search in them.
        match_noise: variance of a match, over that which its residual would make of independent pixels.
        min_share: least share of the pixels with two matches or more on which all of them agree. Where fewer do, poses
            and images contradict each other, and none is used.
        memory: share of the running estimates that remains after a frame.

    Raises:
        ValueError: an impossible value.
    """

    width: int = number(320, "", "px", 80, 1280)
    keyframes: int = number(50, "", "1", 2)
    landmarks: int = number(2048, "", "1", 100)
    corners: int = number(150, "", "1", 10)
    corner_distance: float = number(0.04, "", "width", 0)
    corner_sigma: float = number(0.1, "", "1", 0)
    start_depth: float = number(2.0, "", "m", 0, open_low=True)
    least_score: float = number(0.85, "", "1", 0, 1)
    rival: float = number(1.5, "", "1", 1)
    sigmas: float = number(3.5, "", "1", 0, open_low=True)
    match_noise: float = number(1.0, "", "1", 0, open_low=True)
    min_share: float = number(0.2, "", "1", 0, 1)
    memory: float = number(0.8, "", "1", 0, 1, open_high=True)


class Depths(NamedTuple):
    """Inverse depths measured at N pixels.

    Attributes:
        pixel: [N, 2] (u, v).
        rho: [N] inverse depth [1/m].
        variance: [N] of ``rho`` [1/m^2].
    """

    pixel: NDArray[np.float64]
    rho: NDArray[np.float64]
    variance: NDArray[np.float64]


class DenseEvidence(SavedState):
    """Measures the depth of a pixel in every cell of the image.

    Args:
        config: see :class:`DenseConfig`; None = its defaults.

    Example::

        evidence = DenseEvidence()
        for image, T_world_cam in video:
            landmarks = evidence.update(image, T_world_cam, K)
            out = ufm(depth, T_world_cam, K_map, anchors=landmarks.anchors(K, K_map))
    """

    needs_image = True
    HELD: ClassVar = {
        "_size": "size",
        "_K": "K",
        "_depth": "depth",
        "_contradicted": "contradicted",
        "_baseline": "baseline",
    }

    def __init__(self, config: DenseConfig | None = None) -> None:
        self.config = config if config is not None else DenseConfig()
        self._keyframes = Keyframes(self.config.keyframes)
        self._memory = Memory(self.config.landmarks, self.config.memory)
        self._errors = PoseErrors(len(_BASELINES), self.config.memory)
        corners = TrackerConfig(max_points=self.config.corners, start_depth=self.config.start_depth)
        self._tracker = LandmarkTracker(corners)
        self.reset()

    @property
    def identity(self) -> dict[str, Any]:
        """Plain values on which the anchors depend."""
        return {"anchors": "dense", "dense": self.config.to_dict()}

    def reset(self) -> None:
        """Forget everything."""
        self._keyframes.reset()
        self._memory.reset()
        self._errors.reset()
        self._tracker.reset()
        self._size, self._K = np.zeros(2, np.int64), np.eye(3)  # of the images; no size before the first
        self._depth, self._contradicted, self._baseline = self.config.start_depth, 0, 0.0

    def state(self) -> dict[str, Tensor]:
        """All that is remembered, for :meth:`load_state`; images are shared and must not be written to."""
        corners = {_CORNERS + name: value for name, value in self._tracker.state().items()}
        return super().state() | self._keyframes.state() | self._memory.state() | self._errors.state() | corners

    def load_state(self, state: Mapping[str, Tensor]) -> None:
        """Continue where :meth:`state` was taken; ValueError: another number of keyframes or landmarks."""
        super().load_state(state)
        for part in (self._keyframes, self._memory, self._errors):
            part.load_state(state)
        corners = {name: value for name, value in state.items() if name.startswith(_CORNERS)}
        self._tracker.load_state({name.removeprefix(_CORNERS): value for name, value in corners.items()})

    def update(
        self, image: NDArray[np.uint8] | None, T_world_cam: NDArray[np.float64], K: NDArray[np.float64]
    ) -> Landmarks:
        """Process the next image.

        Args:
            image: [H, W, 3] RGB or [H, W] gray, uint8, undistorted.
            T_world_cam: [4, 4] camera-to-world [m].
            K: [3, 3] of the image [px]; the same for all images.

        Returns:
            The depths measured in it; none before there is parallax. ``tracked`` counts the pixels that were searched.

        Raises:
            TypeError: ``image`` is no array.
            ValueError: wrong shape or dtype, a pose that is not finite, another size or camera than before (call
                :meth:`reset` first); everything is as it was then.
            ModuleNotFoundError: OpenCV is not installed.
        """
        gray, T, K = checked(image, T_world_cam, K)
        if self._size.any() and (gray.shape != tuple(self._size) or not np.array_equal(K, self._K)):
            raise OtherCameraError
        small, scale = _reduced(gray, self.config.width)
        if self._tracker.repeats(small, T):
            return Landmarks.skipped(REPEATED)
        self._size, self._K = np.array(gray.shape), K
        corners = self._tracker.update(small, T, scale @ K)
        T, (number, poses) = self._tracker.pose, self._tracker.refined
        if self._memory.empty:
            self._depth = self._tracker.depth
        self._keyframes.correct(number, poses)
        if self._tracker.jumped:
            self._forget()
        result = self._measured(small, scale, T, scale @ K, corners)
        if self._contradicted >= _JUMPED:
            self._forget()
        self._keyframes.add(small, T, self._depth, int(number.max()))
        return result

    def _forget(self) -> None:
        """Forget keyframes and landmarks: those of other poses."""
        self._contradicted = 0
        self._keyframes.reset()
        self._memory.forget()

    def _measured(
        self, small: NDArray[np.uint8], scale: NDArray, T: NDArray, K: NDArray, corners: Landmarks
    ) -> Landmarks:
        """The depths of a reduced image, and corners where none is."""
        from ufmstar_torch.kernels.anchor_check_cpu import check_anchors  # kernels compile when they are first needed

        cell, K = _cell(small.shape[1]), self._errors.camera(K)
        trusted = not corners.contradicted
        sure = self._tracker.refined_variance * self._depth**2 <= self.config.corner_sigma**2
        compared = self._compared(T, K, small.shape[1]) if trusted and sure else None
        found, searched, trusted = self._in_cells(small, T, K, cell, compared, trusted)
        self._contradicted = 0 if trusted else self._contradicted + 1
        if compared is not None and trusted:
            coarse = self._coarse(small, found.pixel, compared[0], cell)
            found = Depths(*(np.concatenate(pair) for pair in zip(found, coarse, strict=True)))
        shared = self._tracker.shared(max(self._baseline, self._tracker.baseline))
        stated = found.variance + self._memory.apart * np.square(found.rho) + shared
        surface, alone = check_anchors(small, found.pixel, found.rho, stated, cell)
        far = self._apart(corners, surface, small.shape[1]) if trusted else np.zeros(0, np.int64)
        depth = np.concatenate([1 / found.rho, corners.depth[far]])
        variance = np.concatenate([(stated + alone) * depth[: len(stated)] ** 4, corners.variance[far]])
        position = (np.concatenate([surface, corners.pixel[far]]) - scale[:2, 2]) / scale.diagonal()[:2]
        none = corners.none if corners.contradicted else Landmarks.none
        judged = corners.pose_error, shared, corners.contradicted, self._memory.apart, corners.lag
        return Landmarks(position, depth, variance, searched, none, *judged)

    def _in_cells(
        self,
        small: NDArray[np.uint8],
        T: NDArray,
        K: NDArray,
        cell: int,
        compared: tuple[Views, NDArray] | None,
        trusted: bool,
    ) -> tuple[Depths, int, bool]:
        """Landmarks that the image shows, measured again where the camera has moved, and new ones in the cells between
        them; how many pixels were tried; False where the views contradict each other. The running estimates follow."""
        sighted = self._memory.sighted(small, T, K, cell)
        sighted_count = len(sighted.slot)
        pixel = np.concatenate([sighted.pixel, _pixels(small, cell, sighted.pixel)])
        rho, variance = np.zeros(len(pixel)), np.ones(len(pixel))
        agreed, lasts = np.zeros((2, len(pixel)), np.bool_)
        expected = np.concatenate([np.flatnonzero(sighted.due), np.arange(sighted_count, len(pixel))])
        if compared is not None:
            found, fit, lasting, trusted = self._searched(small, pixel[expected], *compared, K, cell)
            at = expected[found]
            lasts[at] = lasting
            agreed[at], rho[at], variance[at] = True, fit.rho, fit.variance + np.square(_SCALE * fit.rho)
        agreed &= (rho > np.sqrt(variance)) & trusted
        both, fine = self._memory.compare(
            sighted, rho[:sighted_count], variance[:sighted_count], agreed[:sighted_count]
        )
        again, new = (
            np.flatnonzero(agreed[:sighted_count] & fine),
            np.flatnonzero(agreed[sighted_count:]) + sighted_count,
        )
        self._memory.write(both.slot[again], small, both.pixel[again], both.rho[again], both.variance[again], T, K)
        remembered = new[lasts[new]]
        self._memory.write(None, small, pixel[remembered], rho[remembered], variance[remembered], T, K)
        rho[:sighted_count], variance[:sighted_count] = both.rho, both.variance
        matched = np.concatenate([np.flatnonzero(fine), new]) if trusted else new
        if len(matched) >= _ENOUGH:
            self._depth *= float(np.exp((1 - self.config.memory) * np.log(median(1 / rho[matched]) / self._depth)))
        tried = sighted_count + (0 if compared is None else len(expected))
        return Depths(pixel[matched], rho[matched], variance[matched]), tried, trusted

    def _searched(
        self, small: NDArray[np.uint8], pixel: NDArray, views: Views, shares: NDArray, K: NDArray, cell: int
    ) -> tuple[NDArray[np.int64], Fit, NDArray[np.bool_], bool]:
        """Which pixels [N, 2] were measured, their depths without errors of the poses, which of them are remembered (an
        uncertain match of one view is not: the next images measure it better), and whether the views agree."""
        from ufmstar_torch.kernels.anchor_check_cpu import CERTAIN, confirmed
        from ufmstar_torch.kernels.dense_cpu import measure

        self._baseline = float(np.linalg.norm(np.linalg.inv(K) @ views.b[-1]))
        actual = measure(small, pixel, views, self._search())
        accepted = confirmed(pixel, actual, cell)
        agreeing = accepted[actual.agreed + actual.contradicted > 1]
        trusted, found = (
            len(agreeing) < _ENOUGH or bool(agreeing.mean() >= self.config.min_share),
            np.flatnonzero(accepted),
        )
        arguments = actual.only(found), shares, views, K, self._depth, trusted
        fit = self._errors.corrected(pixel[found], *arguments)
        lasting = (actual.agreed[found] > 1) | (fit.variance < np.square(CERTAIN * fit.rho))
        return found, fit, lasting, trusted

    def _coarse(self, small: NDArray[np.uint8], occupied: NDArray[np.float64], views: Views, cell: int) -> Depths:
        """Search the cells without a pixel of ``occupied`` [N, 2] by windows of twice the width: in images of half the
        size."""
        from ufmstar_torch.kernels.anchor_check_cpu import confirmed
        from ufmstar_torch.kernels.dense_cpu import Views, measure

        half = _halved(small)
        S = np.array([[0.5, 0, -0.25], [0, 0.5, -0.25], [0, 0, 1]])
        H, images = S @ views.H @ np.linalg.inv(S), np.stack([_halved(image) for image in views.image])
        reduced = Views(images, np.ascontiguousarray(H), np.ascontiguousarray(views.b @ S.T), views.noise / 4)
        occupied = (occupied - 0.5) / 2
        inside = ((occupied >= 0) & (occupied < half.shape[::-1])).all(1)
        pixel = _pixels(half, cell // 2, occupied[inside])
        found = measure(half, pixel, reduced, self._search())
        variance = _COARSE_NOISE * found.variance + np.square(_SCALE * found.rho)
        fine = confirmed(pixel, found, cell // 2) & (found.rho > np.sqrt(variance))
        return Depths(2 * pixel[fine] + 0.5, found.rho[fine], variance[fine])

    def _apart(self, corners: Landmarks, occupied: NDArray[np.float64], width: int) -> NDArray[np.int64]:
        """Indices of the corners that become anchors: certain ones, away from the ``occupied`` positions [N, 2]."""
        from ufmstar_torch.kernels.anchor_check_cpu import farther

        over = self._tracker.remaining_error / max(self._tracker.baseline, 1e-9) / self._tracker.focal
        sigma = np.maximum(np.sqrt(corners.variance) / corners.depth, over * np.maximum(corners.depth, self._depth))
        fine = np.flatnonzero(sigma <= self.config.corner_sigma)
        return fine[farther(corners.pixel[fine], occupied, self.config.corner_distance * width)]

    def _search(self) -> Search:
        from ufmstar_torch.kernels.dense_cpu import Search

        config, over = self.config, 1 / self._depth
        accepted = config.sigmas, config.least_score, config.rival, config.match_noise
        return Search(over, _FARTHEST * over, _NEAREST * over, *accepted)

    def _compared(self, T: NDArray, K: NDArray, width: int) -> tuple[Views, NDArray[np.int64]] | None:
        """The keyframes to compare a camera T [4, 4] with, how its pixels get into them, and [V] to which baseline each
        belongs; None where there is none."""
        from ufmstar_torch.kernels.dense_cpu import Views

        chosen = self._keyframes.choose(T, K, self._depth, _BASELINES)
        if not chosen:
            return None
        shares, keyframes = (np.array(column) for column in zip(*chosen, strict=True))
        image, pose = self._keyframes.images(keyframes), self._keyframes.poses(keyframes)
        into = pose[:, :3, :3].transpose(0, 2, 1)
        H = K @ into @ T[:3, :3] @ np.linalg.inv(K)
        b = ((T[:3, 3] - pose[:, :3, 3])[:, None] @ pose[:, :3, :3])[:, 0] @ K.T
        noise = self._errors.positions(K, width, self._depth)[shares]
        return Views(image, np.ascontiguousarray(H), np.ascontiguousarray(b), noise), shares


def _reduced(gray: NDArray[np.uint8], width: int) -> tuple[NDArray[np.uint8], NDArray[np.float64]]:
    """An image no wider than ``width``, and [3, 3] its pixels from those of ``gray``."""
    if gray.shape[1] <= width:
        return gray, np.eye(3)
    cv2 = optional("cv2", "landmarks of images need OpenCV", "'ufmstar-torch[eval]'")

    size = (width, max(round(gray.shape[0] * width / gray.shape[1]), 1))
    small = cv2.resize(gray, size, interpolation=cv2.INTER_AREA)
    along, down = size[0] / gray.shape[1], size[1] / gray.shape[0]
    scale = np.array([[along, 0, 0.5 * along - 0.5], [0, down, 0.5 * down - 0.5], [0, 0, 1]])
    return np.asarray(small, dtype=np.uint8), scale


def _halved(image: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Means of two by two pixels; an odd last row or column is left out."""
    cv2 = optional("cv2", "landmarks of images need OpenCV", "'ufmstar-torch[eval]'")
    height, width = image.shape[0] // 2, image.shape[1] // 2
    return np.asarray(cv2.resize(image[: 2 * height, : 2 * width], (width, height), interpolation=cv2.INTER_AREA))


def _cell(width: int) -> int:
    """Side of a cell [px]: 8 in an image 160 wide, 10 in one of 320."""
    return max(round(8 * 1.25 ** np.log2(width / 160)), 4)


def _pixels(small: NDArray[np.uint8], cell: int, occupied: NDArray[np.float64]) -> NDArray[np.float64]:
    """[N, 2] the pixel (u, v) of the largest gradient in every cell that has one, and none of those taken [M, 2]."""
    from ufmstar_torch.kernels.dense_cpu import best_pixels

    shape = (-(-small.shape[0] // cell), -(-small.shape[1] // cell))
    pixel, strength = np.zeros((*shape, 2)), np.zeros(shape)
    column, row = (occupied / cell).astype(np.int64).T
    strength[row, column] = -1
    best_pixels(small, cell, pixel, strength)
    return pixel[strength > 0]

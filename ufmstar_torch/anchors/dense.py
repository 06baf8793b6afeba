"""Dense anchors from images: one pixel in every cell of the image is matched with earlier keyframes.

Instead of tracking corners (:class:`~ufmstar_torch.anchors.tracker.LandmarkTracker`), this searches along epipolar
lines. Therefore edges yield depths too, and most surfaces have them. Pixels with little parallax get a large variance.
Cells without a match are searched again with windows of twice the width, for surfaces without fine texture. The search
measures inverse depth, rho = 1/depth with a standard deviation sigma: an anchor has the depth 1/rho and the variance
sigma^2 depth^4. Some corners are tracked, too. They measure how far poses and images disagree, which a search along the
lines of these poses cannot, and become anchors where no other is near. Where the images show that a surface moves
(``motion``), there is no anchor.

Needs OpenCV and numba, on the CPU. Each camera needs its own object. Its state has a fixed size: keyframes, landmarks
and some numbers.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, ClassVar, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ufmstar_torch.anchors.dense_keyframes import Keyframes, halved
from ufmstar_torch.anchors.dense_memory import Memory
from ufmstar_torch.anchors.dense_poses import PoseErrors
from ufmstar_torch.anchors.kernels.check import check_anchors, confirmed, farther
from ufmstar_torch.anchors.kernels.dense import Search, Views, free_pixels, measure
from ufmstar_torch.anchors.kernels.landmarks import SCALE
from ufmstar_torch.anchors.kernels.reduce import reduce
from ufmstar_torch.anchors.kernels.windows import MARGIN
from ufmstar_torch.anchors.landmarks import REPEATED, Landmarks, OtherCameraError, checked, opencv
from ufmstar_torch.anchors.motion import LANDMARK, LINE, OFF_LINE, SEARCH, MotionTest, MotionTests, located, moves
from ufmstar_torch.anchors.saved_state import POSITIVE, SavedState
from ufmstar_torch.anchors.tracker import LandmarkTracker, TrackerConfig
from ufmstar_torch.runtime.checked import Checked, number
from ufmstar_torch.runtime.kinds import check_kinds

# Baselines of the keyframes with which a frame is compared, as shares of the median depth.
_BASELINES = np.array([0.04, 0.1, 0.22, 0.45])
# Range of the first search of inverse depth, over 1/median depth.
_NEAREST, _FARTHEST = 6.0, -0.03
# Least number of anchors for an update of the running estimates.
_ENOUGH = 10
# Successive frames contradicting their poses after which keyframes and landmarks are deleted: the poses have jumped.
_JUMPED = 3
# Variance of a match of the wide windows over that computed from its residual; 2 to 4 on tours.
_COARSE_NOISE = 4.0


@dataclass(frozen=True)
class DenseConfig(Checked):
    """Settings of the search for dense anchors, and of their acceptance.

    Attributes:
        width: largest width of the searched image [px]; larger images are reduced to it.
        keyframes: number of stored keyframes.
        landmarks: number of stored landmarks.
        corners: number of tracked corners.
        corner_sigma: largest standard deviation of a corner's depth, as a share of it; also the limit of that by the
            distance of corners from their epipolar lines over their baseline. Where errors of the refined poses exceed
            this limit at the median depth, no pixel is searched.
        start_depth: initial median depth of the scene, right to a factor of 5 [m].
        least_score: least zero-mean normalised cross-correlation (ZNCC) of a match.
        rival: least ratio of 1 - ZNCC of the second-best match to that of a unique match.
        sigmas: largest difference of consistent measurements, and half width of the search, in standard deviations.
        memory: share of the running estimates that remains after a frame.

    Raises:
        ValueError: an impossible value.
    """

    width: int = number(320, "", "px", 80, 1280)
    keyframes: int = number(50, "", "1", 2)
    landmarks: int = number(2048, "", "1", 100)
    corners: int = number(150, "", "1", 10)
    corner_sigma: float = number(0.1, "", "1", 0)
    start_depth: float = number(2.0, "", "m", 0, open_low=True)
    least_score: float = number(0.85, "", "1", 0, 1)
    rival: float = number(1.5, "", "1", 1)
    sigmas: float = number(3.5, "", "1", 0, open_low=True)
    memory: float = number(0.8, "", "1", 0, 1, open_high=True)

    # [width]: least distance of a corner from all dense anchors to become an anchor
    corner_distance: ClassVar[float] = 0.04
    # [1]: least share of the pixels with two or more matches whose matches all agree; where it is smaller, poses and
    # images contradict each other, and no match is used
    min_share: ClassVar[float] = 0.2


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
    """Measures the depth of one pixel in every cell of the image.

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
        "_size": "size", "_K": "K", "_depth": "depth", "_contradicted": "contradicted", "_baseline": "baseline",
    }  # fmt: skip
    RANGES: ClassVar = {"_depth": POSITIVE}
    PREFIXES: ClassVar = {"_tracker": "corners_"}

    @check_kinds
    def __init__(self, config: DenseConfig | None = None) -> None:
        self.config = config if config is not None else DenseConfig()
        self._keyframes = Keyframes(self.config.keyframes)
        self._memory = Memory(self.config.landmarks, self.config.memory)
        self._errors = PoseErrors(len(_BASELINES), self.config.memory)
        self._motion = MotionTests(self.config.memory)
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
        self._motion.reset()
        self._tracker.reset()
        self._size, self._K = np.zeros(2, np.int64), np.eye(3)  # of the images; no size before the first
        self._depth, self._contradicted, self._baseline = self.config.start_depth, 0, 0.0

    def update(
        self, image: NDArray[np.uint8] | None, T_world_cam: NDArray[np.float64], K: NDArray[np.float64]
    ) -> Landmarks:
        """Process the next image.

        Args:
            image: [H, W, 3] RGB or [H, W] gray, uint8, undistorted.
            T_world_cam: [4, 4] camera-to-world [m].
            K: [3, 3] of the image [px]; the same for all images.

        Returns:
            The measured depths; none before there is parallax. ``tracked`` is the number of searched pixels.

        Raises:
            TypeError: ``image`` is no array.
            ValueError: wrong shape or dtype, a pose that is not finite, another size or camera than before (call
                :meth:`reset` first); the state stays unchanged.
            ModuleNotFoundError: OpenCV is not installed.
        """
        gray, T, K = checked(image, T_world_cam, K)
        if self._size.any() and (gray.shape != tuple(self._size) or not np.array_equal(K, self._K)):
            raise OtherCameraError
        small, scale = _reduced(gray, self.config.width)
        corners = self._tracker.track(small, T, scale @ K)
        if corners.none == REPEATED:
            return corners
        self._size, self._K = np.array(gray.shape), K
        T, (number, poses) = self._tracker.pose, self._tracker.refined
        if self._memory.empty:
            self._depth = self._tracker.depth
        self._keyframes.correct(number, poses)
        if self._tracker.jumped:
            self._forget()
        half = halved(small)
        result = self._measured(small, half, scale, T, scale @ K, corners)
        if self._contradicted >= _JUMPED:
            self._forget()
        self._keyframes.add(small, half, T, self._depth, int(number.max()))
        return result

    def _forget(self) -> None:
        """Delete keyframes and landmarks, which belong to other poses."""
        self._contradicted = 0
        self._keyframes.reset()
        self._memory.forget()

    def _measured(
        self, small: NDArray[np.uint8], half: NDArray[np.uint8], scale: NDArray, T: NDArray, K: NDArray,
        corners: Landmarks,
    ) -> Landmarks:  # fmt: skip
        """Measure the depths in a reduced image, and add corners where there are none. ``half`` is the image at half
        the size."""
        cell, K = _cell(small.shape[1]), self._errors.camera(K)
        trusted = not corners.contradicted
        precise = self._tracker.refined_variance * self._depth**2 <= self.config.corner_sigma**2
        compared = self._compared(T, K, small.shape[1]) if trusted and precise else None
        found, searched, trusted, tested, disagree = self._in_cells(small, T, K, cell, compared, trusted)
        self._contradicted = 0 if trusted else self._contradicted + 1
        if compared is not None and trusted:
            coarse = self._coarse(small, half, found.pixel, compared[1], cell)
            found = Depths(*(np.concatenate(pair) for pair in zip(found, coarse, strict=True)))
        ratios = self._motion.log_ratios(tested, small.shape, cell) if trusted else None
        moving = np.zeros(len(found.pixel), np.bool_) if ratios is None else moves(ratios, found.pixel, cell)
        found = Depths(*(column[~moving] for column in found))
        shared = self._tracker.shared(max(self._baseline, self._tracker.baseline))
        total = found.variance + self._memory.apart * np.square(found.rho) + shared
        surface, outlier_variance = check_anchors(small, found.pixel, found.rho, total, cell)
        far = self._apart(corners, surface, small.shape[1]) if trusted else np.zeros(0, np.int64)
        far = far if ratios is None else far[~moves(ratios, corners.pixel[far], cell)]
        depth = np.concatenate([1 / found.rho, corners.depth[far]])
        variance = np.concatenate([(total + outlier_variance) * depth[: len(total)] ** 4, corners.variance[far]])
        position = (np.concatenate([surface, corners.pixel[far]]) - scale[:2, 2]) / scale.diagonal()[:2]
        none = corners.none if corners.contradicted else Landmarks.none
        judged = corners.pose_error, shared, corners.contradicted, self._memory.apart, corners.lag
        motion = None if ratios is None else located(ratios, cell)
        if motion is not None:
            motion[:, :2] = (motion[:, :2] - scale[:2, 2]) / scale.diagonal()[:2]
        withheld = int(moving.sum()) + disagree
        return Landmarks(position, depth, variance, searched, none, *judged, motion=motion, moving=withheld)

    def _in_cells(
        self, small: NDArray[np.uint8], T: NDArray, K: NDArray, cell: int, compared: tuple[Views, Views] | None,
        trusted: bool,
    ) -> tuple[Depths, int, bool, list[MotionTest], int]:  # fmt: skip
        """Measure visible landmarks again where the camera has moved, and new pixels in the cells without a landmark.

        Also updates the running estimates.

        Returns:
            The depths; the number of searched pixels; False if the views contradict each other; tests of whether
            surfaces stand still; the number of pixels where views, or old and new measurements, disagree.
        """
        sighted = self._memory.sighted(small, T, K, cell)
        count, searched = len(sighted.slot), len(sighted.searched)
        tests = [MotionTest(LANDMARK, sighted.compared, sighted.hidden, np.ones(len(sighted.hidden), np.bool_))]
        if compared is None:
            measured = np.zeros(searched, np.int64), np.zeros(searched, np.bool_), *np.zeros((2, searched))
            searched = disagree = 0
        else:
            pixel = sighted.pixel[sighted.searched]
            matches = measure(small, pixel, compared[0], self._search())
            accepted, (several, reliable, disagree) = confirmed(pixel, matches, cell)
            trusted = several < _ENOUGH or reliable >= self.config.min_share * several
            arguments = matches, compared[0], K, self._depth, trusted
            rho, variance, off_line = self._errors.corrected(pixel, accepted, *arguments)
            measured = matches.agreed, accepted, rho, variance
            tests.append(MotionTest(SEARCH, pixel, ~accepted, matches.shown > 1))
            tests.append(MotionTest(LINE, pixel, off_line > OFF_LINE, np.isfinite(off_line)))
        found, refuted, self._depth = self._memory.settle(sighted, small, T, K, self._depth, measured, trusted)
        depths = Depths(sighted.pixel[:found], sighted.rho[:found], sighted.variance[:found])
        return depths, count + searched, trusted, tests, disagree + refuted

    def _coarse(
        self, small: NDArray[np.uint8], half: NDArray[np.uint8], occupied: NDArray[np.float64], views: Views,
        cell: int,
    ) -> Depths:  # fmt: skip
        """Search the cells without a pixel of ``occupied`` [N, 2] with windows of twice the width, in images of half
        the size.

        On a blank surface beside an edge, such a window measures the edge. The anchor is moved to the texture that was
        matched.
        """
        pixel = free_pixels(half, cell // 2, (occupied - 0.5) / 2)
        found = measure(half, pixel, views, self._search())
        variance = _COARSE_NOISE * found.variance + np.square(SCALE * found.rho)
        fine = confirmed(pixel, found, cell // 2)[0] & (found.rho > np.sqrt(variance))
        matched = 2 * (pixel[fine] + found.centre[fine]) + 0.5
        matched = matched.clip(MARGIN, np.array(small.shape[::-1]) - 1.0 - MARGIN)
        return Depths(matched, found.rho[fine], variance[fine])

    def _apart(self, corners: Landmarks, occupied: NDArray[np.float64], width: int) -> NDArray[np.int64]:
        """Indices of the corners that become anchors: precise ones, away from the ``occupied`` positions [N, 2]."""
        line_error = self._tracker.remaining_error / max(self._tracker.baseline, 1e-9) / self._tracker.focal
        stated = np.sqrt(corners.variance) / corners.depth
        sigma = np.maximum(stated, line_error * np.maximum(corners.depth, self._depth))
        precise = np.flatnonzero(sigma <= self.config.corner_sigma)
        return precise[farther(corners.pixel[precise], occupied, self.config.corner_distance * width)]

    def _search(self) -> Search:
        config, rho = self.config, 1 / self._depth
        return Search(rho, _FARTHEST * rho, _NEAREST * rho, config.sigmas, config.least_score, config.rival)

    def _compared(self, T: NDArray, K: NDArray, width: int) -> tuple[Views, Views] | None:
        """Choose keyframes to compare with a camera T [4, 4]: at the full and at half the size; None if there is no
        suitable one."""
        views, half, longest = self._keyframes.compared(T, K, self._depth, _BASELINES)
        if not len(views.slot):
            return None
        self._baseline = longest
        views.noise[:] = self._errors.positions(K, width, self._depth)[views.share]
        half.noise[:] = views.noise / 4
        return views, half


def _reduced(gray: NDArray[np.uint8], width: int) -> tuple[NDArray[np.uint8], NDArray[np.float64]]:
    """Reduce an image to at most ``width``; return [3, 3] the mapping of the pixels of ``gray`` to its pixels, too."""
    if gray.shape[1] <= width:
        return gray, np.eye(3)
    size = (width, max(round(gray.shape[0] * width / gray.shape[1]), 1))
    if gray.shape[0] % size[1] == 0 and gray.shape[1] % size[0] == 0:
        cv2 = opencv()
        small = cv2.resize(gray, size, interpolation=cv2.INTER_AREA)
    else:
        small = np.empty(size[::-1], np.uint8)
        reduce(gray, small)
    along, down = size[0] / gray.shape[1], size[1] / gray.shape[0]
    scale = np.array([[along, 0, 0.5 * along - 0.5], [0, down, 0.5 * down - 0.5], [0, 0, 1]])
    return np.asarray(small, dtype=np.uint8), scale


def _cell(width: int) -> int:
    """Side of a cell [px]: 8 in an image 160 px wide, 10 in one 320 px wide."""
    return max(round(8 * 1.25 ** np.log2(width / 160)), 4)

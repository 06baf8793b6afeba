"""Corners of images: found where none is followed yet, and followed from one image to the next.

OpenCV on the CPU, imported when it is first needed.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from ufmstar_torch.anchors.epipolar import median
from ufmstar_torch.optional import optional

# Lucas-Kanade on patches 8 px wide and 16 high over four octaves, at most ten iterations each. OpenCV computes eight
# pixels of a row at once and the rest one by one: a patch of 11 x 11, no larger, takes longer by a third. On six
# rendered tours this one followed as many corners, and their depths erred no more on average.
_PATCH, _LEVELS, _ITERATIONS, _CONVERGED = (8, 16), 3, 10, 0.03
# Octaves where a position is expected. With one less, a wrong one confirms itself more often: on one of four tours
# twice as many depths lie beyond 5 sigma.
_EXPECTED_LEVELS = 2
# [px] Width from which corners are looked for at half the size.
_HALVED_FROM = 480
# Harris' response, det - k trace^2, and not the smaller eigenvalue alone: where an edge is strong and the image else is
# plain, that is large all along the edge, and a corner on an edge slides, to a depth far off, and returns. k asks for a
# ratio of the eigenvalues of some 1 to 20. The response is of fourth order in contrast: the weakest corner has a
# hundredth of the strongest one's eigenvalue.
_HARRIS, _WEAKEST = 0.04, 1e-4

# Logarithm of the ratio of brightness from which images are made alike, in at most so many rounds; share of the corners
# that must be followed for the ratio to be measured at them; windows of which the means count [px], and which means
# [gray levels].
_BRIGHTER, _ROUNDS, _SHARE, _AROUND, _COUNTED = 0.03, 3, 0.15, (17, 17), (8, 240)


def follow(
    before: NDArray[np.uint8],
    after: NDArray[np.uint8],
    position: NDArray[np.float64],
    back_tolerance: float,
    expected: NDArray[np.float64] | None = None,
) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
    """Follow corners of one gray image into the next, and check that following them back returns to the start. Where
    the second image is brighter or darker, the first one is made alike.

    Args:
        before, after: [H, W] gray.
        position: [N, 2] (u, v) in ``before``, N at least 1 [px].
        back_tolerance: a corner followed there and back must return this near [px].
        expected: [N, 2] where they should be in ``after`` [px]; None = unknown. Where most of them are lost, it is
            wrong, and those are searched without.

    Returns:
        Positions [N, 2] in ``after`` [px], and which are reliable [N]: found both ways and inside the image.
    """
    found, fine = _followed(before, after, position, back_tolerance, expected)
    gain = 1.0
    for _ in range(_ROUNDS):
        few = np.count_nonzero(fine) < _SHARE * len(fine)
        now = _ratio(before, after) if few else _ratio_at(before, after, position[fine], found[fine])
        if abs(np.log(now / gain)) <= _BRIGHTER:
            break
        gain = now
        brightened = np.clip(before * gain, 0, 255).astype(np.uint8)
        again, better = _followed(brightened, after, position, back_tolerance, expected)
        if np.count_nonzero(better) <= np.count_nonzero(fine):
            break
        found, fine = again, better
    return found, fine


def _ratio(before: NDArray[np.uint8], after: NDArray[np.uint8]) -> float:
    """By how much brighter the second image is, from all of both: a guess where they show different things."""
    return float(max(np.median(after), 1) / max(np.median(before), 1))


def _ratio_at(
    before: NDArray[np.uint8], after: NDArray[np.uint8], position: NDArray[np.float64], found: NDArray[np.float64]
) -> float:
    """The same, the median over corners that were followed."""
    cv2 = optional("cv2", "landmarks of images need OpenCV", "'ufmstar-torch[eval]'")

    means = []
    for image, corners in ((before, position), (after, found)):
        u, v = np.rint(corners).astype(np.int64).T
        means.append(cv2.blur(image, _AROUND)[v, u].astype(np.float64))
    one, other = means
    counted = (np.minimum(one, other) > _COUNTED[0]) & (np.maximum(one, other) < _COUNTED[1])
    return median(other[counted] / one[counted]) if counted.any() else 1.0


def _followed(
    before: NDArray[np.uint8], after: NDArray[np.uint8], position: NDArray[np.float64], back_tolerance: float,
    expected: NDArray[np.float64] | None,
) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:  # fmt: skip
    """As :func:`follow`, of images that are alike bright."""
    if expected is None:
        return _there_and_back(before, after, position, position, _LEVELS, back_tolerance)
    found, fine = _there_and_back(before, after, position, expected, _EXPECTED_LEVELS, back_tolerance)
    if 2 * np.count_nonzero(fine) < len(fine):
        lost = ~fine
        found[lost], fine[lost] = _followed(before, after, position[lost], back_tolerance, None)
    return found, fine


def _there_and_back(
    before: NDArray[np.uint8], after: NDArray[np.uint8], position: NDArray[np.float64], first: NDArray[np.float64],
    levels: int, back_tolerance: float,
) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:  # fmt: skip
    """As :func:`follow`, from a first guess of the positions over so many octaves beyond the first."""
    cv2 = optional("cv2", "landmarks of images need OpenCV", "'ufmstar-torch[eval]'")

    # The first flag asks for the patch's eigenvalue in place of the difference of the patches, which would be computed
    # in a pass of its own; neither is used.
    flags = cv2.OPTFLOW_LK_GET_MIN_EIGENVALS | cv2.OPTFLOW_USE_INITIAL_FLOW
    options: dict[str, Any] = {"winSize": _PATCH, "criteria": (3, _ITERATIONS, _CONVERGED), "flags": flags}
    start, guess = (np.array(value, np.float32, order="C").reshape(-1, 1, 2) for value in (position, first))
    forward, result, _ = cv2.calcOpticalFlowPyrLK(before, after, start, guess, maxLevel=levels, **options)
    # Back from where it came to, starting where it should arrive: the finest level decides.
    back, returned, _ = cv2.calcOpticalFlowPyrLK(after, before, forward, start.copy(), maxLevel=0, **options)
    gap = np.linalg.norm(back - start, axis=-1)[:, 0]
    height, width = after.shape
    u, v = forward[:, 0, 0], forward[:, 0, 1]
    inside = (u >= 0) & (v >= 0) & (u <= width - 1) & (v <= height - 1)
    fine = (result[:, 0] == 1) & (returned[:, 0] == 1) & (gap < back_tolerance) & inside
    return forward[:, 0].astype(np.float64), fine


def find(gray: NDArray[np.uint8], count: int, spacing: float, followed: NDArray[np.float64]) -> NDArray[np.float64]:
    """New corners, away from those that are followed.

    Args:
        gray: [H, W].
        count: how many at most.
        spacing: least distance between two of them, and to one that is followed [px].
        followed: [N, 2] (u, v) inside the image [px].

    Returns:
        [n, 2] positions (u, v), the best first [px].
    """
    cv2 = optional("cv2", "landmarks of images need OpenCV", "'ufmstar-torch[eval]'")

    # A large image is searched at half its size: a tenth of the time, and a corner need not be met exactly, only be the
    # same from frame to frame.
    factor = 2 if gray.shape[1] >= _HALVED_FROM else 1
    searched = gray if factor == 1 else cv2.resize(gray, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA)
    free = np.full(searched.shape, 255, np.uint8)
    for u, v in np.rint((followed + 0.5) / factor - 0.5).astype(int).tolist():
        cv2.circle(free, (u, v), round(spacing / factor), 0, -1)
    corners = cv2.goodFeaturesToTrack(
        searched, count, _WEAKEST, spacing / factor, mask=free, useHarrisDetector=True, k=_HARRIS
    )
    return np.zeros((0, 2)) if corners is None else (corners[:, 0].astype(np.float64) + 0.5) * factor - 0.5

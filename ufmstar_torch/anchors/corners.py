"""Detection of corners in images, and their tracking from one image to the next.

Uses OpenCV on the CPU, imported at the first call.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from ufmstar_torch.anchors.kernels.tracks import brightness_ratio, cover, returned
from ufmstar_torch.anchors.landmarks import opencv

# Lucas-Kanade on patches 8 px wide and 16 px high, over four octaves of at most ten iterations. OpenCV processes eight
# pixels of a row at once and the rest one by one, so that patches of 11 x 11 px take a third longer. On six rendered
# tours these patches tracked as many corners, with no larger mean error of depth.
_PATCH, _LEVELS, _ITERATIONS, _CONVERGED = (8, 16), 3, 10, 0.03
# Octaves beyond the first where positions are predicted. With one less, wrong predictions pass the check more often: on
# one of four tours, twice as many depths lie beyond 5 sigma.
_EXPECTED_LEVELS = 2
# [px] Width from which an image is searched for corners at half its size.
_HALVED_FROM = 480
# Harris' response, det - k trace^2, instead of the smaller eigenvalue. In an image with one strong edge, the smaller
# eigenvalue is large all along the edge, and a corner on an edge slides to a wrong depth and back. k limits the ratio
# of the eigenvalues to about 20. The response is of fourth order in contrast: the weakest corner has a hundredth of the
# strongest one's eigenvalue.
_HARRIS, _WEAKEST = 0.04, 1e-4

# Adaptation to another exposure: logarithm of the ratio of brightness from which the first image is adapted; most
# rounds; share of corners that must be tracked to measure the ratio at them.
_LOG_RATIO, _ROUNDS, _SHARE = 0.03, 3, 0.15


def follow(
    before: NDArray[np.uint8], after: NDArray[np.uint8], position: NDArray[np.float64], back_tolerance: float,
    expected: NDArray[np.float64] | None = None,
) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:  # fmt: skip
    """Track corners from one gray image to the next, and check that tracking them back returns to the start.

    If the second image is brighter or darker, the brightness of the first is adapted.

    Args:
        before, after: [H, W] gray.
        position: [N, 2] (u, v) in ``before``, N at least 1 [px].
        back_tolerance: largest distance of a corner tracked there and back from its start [px].
        expected: [N, 2] predicted positions in ``after`` [px]; None = unknown. If most corners are lost, these are
            tracked again without predictions.

    Returns:
        Positions [N, 2] in ``after`` [px], and [N] True where reliable: tracked both ways and inside the image.
    """
    found, fine = _followed(before, after, position, back_tolerance, expected)
    gain = 1.0
    for _ in range(_ROUNDS):
        few = np.count_nonzero(fine) < _SHARE * len(fine)
        ratio = _ratio(before, after) if few else brightness_ratio(before, after, position, found, fine)
        if abs(np.log(ratio / gain)) <= _LOG_RATIO:
            break
        gain = ratio
        brightened = np.clip(before * gain, 0, 255).astype(np.uint8)
        retracked, retracked_fine = _followed(brightened, after, position, back_tolerance, expected)
        if np.count_nonzero(retracked_fine) <= np.count_nonzero(fine):
            break
        found, fine = retracked, retracked_fine
    return found, fine


def _ratio(before: NDArray[np.uint8], after: NDArray[np.uint8]) -> float:
    """Ratio of the median brightness of the images: a rough estimate if they show different things."""
    return float(max(np.median(after), 1) / max(np.median(before), 1))


def _followed(
    before: NDArray[np.uint8], after: NDArray[np.uint8], position: NDArray[np.float64], back_tolerance: float,
    expected: NDArray[np.float64] | None,
) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:  # fmt: skip
    """As :func:`follow`, for images of the same brightness."""
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
    """As :func:`follow`, from a ``first`` guess of the positions, over ``levels`` octaves beyond the first."""
    cv2 = opencv()
    # The first flag replaces the difference of the patches, which takes a separate pass, by the patch's eigenvalue.
    # Neither is used.
    flags = cv2.OPTFLOW_LK_GET_MIN_EIGENVALS | cv2.OPTFLOW_USE_INITIAL_FLOW
    options: dict[str, Any] = {"winSize": _PATCH, "criteria": (3, _ITERATIONS, _CONVERGED), "flags": flags}
    start, guess = (np.array(value, np.float32, order="C").reshape(-1, 1, 2) for value in (position, first))
    forward, tracked, _ = cv2.calcOpticalFlowPyrLK(before, after, start, guess, maxLevel=levels, **options)
    # Track back with the start as the first guess: the finest level is enough.
    back, tracked_back, _ = cv2.calcOpticalFlowPyrLK(after, before, forward, start.copy(), maxLevel=0, **options)
    found, fine = np.empty((len(position), 2)), np.empty(len(position), np.bool_)
    returned(start, forward, back, tracked, tracked_back, after.shape, back_tolerance, found, fine)
    return found, fine


def find(gray: NDArray[np.uint8], count: int, spacing: float, followed: NDArray[np.float64]) -> NDArray[np.float64]:
    """Detect new corners, away from those already tracked.

    Args:
        gray: [H, W].
        count: most new corners.
        spacing: least distance of a new corner from all others [px].
        followed: [N, 2] (u, v) of the tracked corners, inside the image [px].

    Returns:
        [n, 2] positions (u, v), the strongest first [px].
    """
    cv2 = opencv()
    # Searching a large image at half its size takes a tenth of the time. The position of a corner need not be exact,
    # only the same from frame to frame.
    factor = 2 if gray.shape[1] >= _HALVED_FROM else 1
    searched = gray if factor == 1 else cv2.resize(gray, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA)
    free = np.full(searched.shape, 255, np.uint8)
    radius = round(spacing / factor)
    disc = cv2.circle(np.zeros((2 * radius + 1, 2 * radius + 1), np.uint8), (radius, radius), radius, 1, -1)
    cover(free, disc, followed, factor)
    corners = cv2.goodFeaturesToTrack(
        searched, count, _WEAKEST, spacing / factor, mask=free, useHarrisDetector=True, k=_HARRIS
    )
    return np.zeros((0, 2)) if corners is None else (corners[:, 0].astype(np.float64) + 0.5) * factor - 0.5

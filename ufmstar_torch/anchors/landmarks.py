"""Landmarks of an image, and the interface of landmark sources (``sources``)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any, Protocol

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from ufmstar_torch.anchors.anchors import Anchors
from ufmstar_torch.runtime.optional import optional

# Imports cv2.
opencv = partial(optional, "cv2", "landmarks of images need OpenCV", "'ufmstar-torch[eval]'")
# Why an image has no landmark.
REPEATED = "the image is the one before again, with another pose"


class OtherCameraError(ValueError):
    """An image has another size or camera than the images before."""

    def __init__(self) -> None:
        super().__init__("image and K must be of the size and camera of the images before: call reset() first")


@dataclass(frozen=True, eq=False)
class Landmarks:
    """Landmarks in the current image.

    Attributes:
        pixel: [N, 2] position (u, v) [px].
        depth: [N] along the optical axis [m].
        variance: [N] of ``depth`` [m^2].
        tracked: number of corners tracked into this image, of which N passed all tests; for a map, its landmarks.
        none: why there is no landmark if N = 0.
        pose_error: standard deviation of tracked corners from the epipolar lines of the input poses [px]; NaN = not
            measured.
        shared: variance of the inverse-depth error that wrong poses cause in all landmarks of the image [1/m^2];
            ``variance`` includes it. Infinite where the poses contradict more images than the newest.
        contradicted: the poses contradict the images, and no depth is used.
        scale: variance of the logarithm of a factor that all depths of the image share; ``variance`` includes it.
        lag: delay of the input poses, estimated from corners [images]; negative = early.
        motion: [M, 3] pixels (u, v) all over the image [px], and the log likelihood ratio of motion there
            (``motion``); None = the depths hold for things that move, too.
        moving: number of depths that were not used because the surface moves, or because views disagree.
    """

    pixel: NDArray[np.float64]
    depth: NDArray[np.float64]
    variance: NDArray[np.float64]
    tracked: int
    none: str = "no parallax, or no earlier view that agrees"
    pose_error: float = float("nan")
    shared: float = 0.0
    contradicted: bool = False
    scale: float = 0.0
    lag: float = 0.0
    motion: NDArray[np.float64] | None = None
    moving: int = 0

    @classmethod
    def skipped(cls, fault: str) -> Landmarks:
        """No landmarks: the image was skipped for a ``fault``."""
        return cls(np.zeros((0, 2)), np.zeros(0), np.zeros(0), 0, none=fault)

    def anchors(self, K_camera: NDArray[np.float64], intrinsics: Tensor) -> Anchors:
        """Convert to the anchors of one stream, in the pixels of its depth map.

        Args:
            K_camera: [3, 3] of the images [px].
            intrinsics: [3, 3] or [1, 3, 3] of the depth map [px]: the same camera, resized or cropped.
        """
        result, K = batched([self], intrinsics.device), intrinsics.reshape(3, 3)
        same = K.is_cpu and np.array_equal(K.numpy(), K_camera)
        return result if same else result.moved(torch.as_tensor(K_camera), K)


def batched(landmarks: Sequence[Landmarks], device: torch.device) -> Anchors:
    """The anchors [B, N] of B streams in the pixels of their images, padded and masked, on a device."""
    b, rows = len(landmarks), max(len(one.depth) for one in landmarks)
    # NumPy: each torch operation takes several times as long after a network.
    pixel, (depth, variance), valid = np.zeros((b, rows, 2)), np.zeros((2, b, rows)), np.zeros((b, rows), np.bool_)
    tested = [one.motion for one in landmarks if one.motion is not None]
    motion = np.full((b, max(map(len, tested)), 3), np.nan) if tested else None
    for i, one in enumerate(landmarks):
        n = len(one.depth)
        pixel[i, :n], depth[i, :n], variance[i, :n], valid[i, :n] = one.pixel, one.depth, one.variance, True
        if motion is not None and one.motion is not None:
            motion[i, : len(one.motion)] = one.motion
    error, shared, scale = np.array([(one.pose_error, one.shared, one.scale) for one in landmarks]).T.copy()
    moving = np.array([one.moving for one in landmarks])
    fields = {"pixel": pixel, "depth": depth, "variance": variance, "valid": valid, "pose_error": error,
              "shared": shared, "scale": scale, "motion": motion, "moving": moving}  # fmt: skip
    tensors = {name: torch.from_numpy(value).to(device) for name, value in fields.items() if value is not None}
    return Anchors(**tensors)


class LandmarkSource(Protocol):
    """Landmarks of one camera, image by image: a corner tracker, dense evidence, or a map.

    Attributes:
        needs_image: whether :meth:`update` reads the image and not only its size.
    """

    needs_image: bool

    @property
    def identity(self) -> dict[str, Any]:
        """Plain values on which the landmarks depend; "anchors" names the kind of source."""
        ...

    def update(
        self, image: NDArray[np.uint8] | None, T_world_cam: NDArray[np.float64], K: NDArray[np.float64]
    ) -> Landmarks:
        """Process the next image [H, W, 3] RGB, its pose [4, 4] [m] and its intrinsics [3, 3] [px].

        Raises:
            TypeError: ``image`` is no array, and the source needs one.
            ValueError: a wrong shape or dtype, a pose that is not finite, another size or camera than before (call
                :meth:`reset` first); the source stays unchanged.
        """
        ...

    def reset(self) -> None:
        """Return to the initial state."""
        ...

    def state(self) -> dict[str, Tensor]:
        """Everything on which the next landmarks depend. Images are shared, not copied, and must not be written to."""
        ...

    def load_state(self, state: Mapping[str, Tensor]) -> None:
        """Restore a result of :meth:`state`; ValueError: it belongs to another source."""
        ...


def checked(image: NDArray | None, T_world_cam: NDArray, K: NDArray) -> tuple[NDArray[np.uint8], NDArray, NDArray]:
    """Check the arguments of :meth:`LandmarkSource.update`; return a gray image, the pose and the intrinsics.

    Raises:
        TypeError, ValueError: as :meth:`LandmarkSource.update`.
    """
    if not isinstance(image, np.ndarray):
        raise TypeError(f"image must be a NumPy array [H, W, 3] or [H, W], got {type(image).__name__}")
    if image.dtype != np.uint8 or not (image.ndim == 2 or (image.ndim == 3 and image.shape[2] == 3)):
        raise ValueError(f"image must be uint8 [H, W, 3] or [H, W], got {image.dtype} {image.shape}")
    T, K = np.asarray(T_world_cam, dtype=np.float64), np.asarray(K, dtype=np.float64)
    if T.shape != (4, 4) or not np.isfinite(T).all():
        raise ValueError("T_world_cam must be a finite 4x4 camera-to-world matrix")
    if K.shape != (3, 3) or not np.isfinite(K).all() or K[0, 0] <= 0 or K[1, 1] <= 0:
        raise ValueError("K must be a finite 3x3 matrix with positive focal lengths [px]")
    if image.ndim == 2:
        return np.ascontiguousarray(image), T, K
    cv2 = opencv()
    return np.asarray(cv2.cvtColor(np.ascontiguousarray(image), cv2.COLOR_RGB2GRAY), dtype=np.uint8), T, K

"""Sources of landmarks by name: the corner tracker, dense evidence, or a map of landmarks in a file."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from ufmstar_torch.anchors.anchors import Anchors
from ufmstar_torch.anchors.dense import DenseEvidence
from ufmstar_torch.anchors.landmarks import Landmarks, LandmarkSource
from ufmstar_torch.anchors.names import CORNERS, DENSE, FILE_TYPES
from ufmstar_torch.anchors.tracker import LandmarkTracker
from ufmstar_torch.files.limits import read_text
from ufmstar_torch.files.read import read_npz
from ufmstar_torch.gaussians.camera import invert_rigid
from ufmstar_torch.runtime.kinds import check_kinds

# Largest number of landmarks in one image; a tracker follows 300.
_MAX_VISIBLE = 500


def landmark_source(value: str | Path | LandmarkSource) -> LandmarkSource:
    """Create a landmark source in its initial state.

    Args:
        value: "corners" for tracked corners, "dense" for dense evidence, or the path of a file for
            :meth:`LandmarkMap.read`. A source is returned as it is.

    Raises:
        FileNotFoundError: no such file.
        TypeError: ``value`` is neither a name, nor a path, nor a source.
        ValueError: ``value`` is neither of the two names nor a file of landmarks.
    """
    if not isinstance(value, str | Path):
        if not all(callable(getattr(value, name, None)) for name in ("update", "state")):
            raise TypeError(f"anchors must be 'corners', 'dense', a file's name or a LandmarkSource, got {value!r}")
        return value
    if value == CORNERS:
        return LandmarkTracker()
    if value == DENSE:
        return DenseEvidence()
    return LandmarkMap.read(value)


@dataclass(frozen=True, eq=False)
class LandmarkMap:
    """Landmarks with known world positions, such as a SLAM map or a survey.

    An image's landmarks are those in front of the camera and inside the image (:meth:`Anchors.from_points`), at most
    500, evenly spaced in the map's order. Occlusion is not tested: pass only the part of a large map that the camera
    can see.

    Attributes:
        points_world: [P, 3] [m].
        sigma: [P] standard deviation of a landmark's position, the same in every direction [m].

    Raises:
        TypeError, ValueError: no numbers, wrong shapes, or no landmark with finite values.
    """

    points_world: NDArray[np.float64]
    sigma: NDArray[np.float64]
    needs_image = False

    def __post_init__(self) -> None:
        try:
            points, sigma = (np.array(value, dtype=np.float64) for value in (self.points_world, self.sigma))
        except (TypeError, ValueError, OverflowError) as error:
            raise TypeError(f"points_world and sigma must be arrays of numbers: {error}") from error
        if points.ndim != 2 or points.shape[1] != 3 or sigma.shape != points.shape[:1]:
            raise ValueError(f"points_world must be [P, 3] and sigma [P], got {points.shape} and {sigma.shape}")
        if not (np.isfinite(points).all(axis=1) & np.isfinite(sigma) & (sigma >= 0)).any():
            raise ValueError("points_world and sigma must hold a landmark with finite values and sigma >= 0")
        object.__setattr__(self, "points_world", points)
        object.__setattr__(self, "sigma", sigma)

    @classmethod
    @check_kinds
    def read(cls, path: str | Path) -> LandmarkMap:
        """Read a file of landmarks.

        A ``.csv`` or ``.txt`` file has a line ``x y z sigma`` [m] for each landmark, separated by commas or spaces;
        ``#`` starts a comment, and the first line may name the columns. A ``.npz`` file has ``points`` [P, 3] and
        ``sigma`` [P] [m]. World axes and scale must be those of the poses. Rows that are not finite are ignored.

        Raises:
            FileNotFoundError: no such file.
            ValueError: the file has another format; the message names the file.
        """
        path = Path(path)
        if path.suffix.lower() not in FILE_TYPES:
            raise ValueError(
                f"anchors: {str(path)!r} is neither {CORNERS!r}, {DENSE!r} nor a file {', '.join(FILE_TYPES)}"
            )
        try:
            points, sigma = read_npz(path, ["points", "sigma"]) if path.suffix.lower() == ".npz" else _read_text(path)
            return cls(points, sigma)
        except (ValueError, TypeError) as error:
            raise ValueError(f"{path}: expected landmarks x y z sigma [m]: {error}") from error

    @property
    def identity(self) -> dict[str, Any]:
        """A digest of the values."""
        digest = hashlib.sha256(self.points_world.tobytes() + self.sigma.tobytes()).hexdigest()
        return {"anchors": "landmarks", "landmarks": digest}

    @check_kinds
    def anchors(self, T_world_cam: Tensor, intrinsics: Tensor, size: tuple[int, int]) -> Anchors:
        """All landmarks as anchors of B views; those out of view are not valid.

        Args:
            T_world_cam: [B, 4, 4] camera-to-world [m].
            intrinsics: [B, 3, 3] or [3, 3] [px].
            size: (H, W) [px].

        Returns:
            [B, P].
        """
        T_cam_world = invert_rigid(T_world_cam.double())
        points = torch.from_numpy(self.points_world).to(T_cam_world.device)
        points_cam = points @ T_cam_world[:, :3, :3].mT + T_cam_world[:, None, :3, 3]
        variance = torch.from_numpy(self.sigma).to(points_cam.device).square().expand(len(points_cam), -1)
        return Anchors.from_points(points_cam, variance, intrinsics, size)

    def update(
        self, image: NDArray[np.uint8] | None, T_world_cam: NDArray[np.float64], K: NDArray[np.float64]
    ) -> Landmarks:
        """The landmarks in an image; without an image, those less than 80 degrees off the optical axis. Raises
        ValueError: a pose or intrinsics of another shape, or not finite."""
        T, K = np.asarray(T_world_cam, dtype=np.float64), np.asarray(K, dtype=np.float64)
        if T.shape != (4, 4) or K.shape != (3, 3) or not (np.isfinite(T).all() and np.isfinite(K).all()):
            raise ValueError("T_world_cam must be a finite 4x4 matrix and K a finite 3x3 matrix")
        offset = np.zeros(2)
        if image is None:  # a square about the optical axis
            half = np.tan(np.radians(80)) * np.array([K[0, 0], K[1, 1]])
            offset, size = half - K[:2, 2], (int(2 * half[1]), int(2 * half[0]))
        else:
            size = (image.shape[0], image.shape[1])
        shifted = K.copy()
        shifted[:2, 2] += offset
        result = self.anchors(torch.from_numpy(T)[None], torch.from_numpy(shifted), size)
        assert result.valid is not None
        visible = np.flatnonzero(result.valid[0].numpy())
        visible = visible[:: -(-len(visible) // _MAX_VISIBLE) or 1]
        pixel, depth, variance = (x[0].numpy()[visible] for x in (result.pixel, result.depth, result.variance))
        return Landmarks(pixel - offset, depth, variance, len(self.sigma), none="no landmark of the map is in view")

    def reset(self) -> None:
        """Do nothing: a map has no state."""

    def state(self) -> dict[str, Tensor]:
        """{}: a map has no state."""
        return {}

    def load_state(self, state: Mapping[str, Tensor]) -> None:
        """Do nothing: a map has no state. Raises ValueError: ``state`` is that of another source."""
        if state:
            raise ValueError(f"state must be empty for a map of landmarks, got {sorted(state)}")


def _read_text(path: Path) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    lines = [line.partition("#")[0].replace(",", " ").split() for line in read_text(path).splitlines()]
    named = next((number for number, words in enumerate(lines) if words), None)  # may name the columns
    rows = []
    for number, words in enumerate(lines):
        try:
            x, y, z, sigma = map(float, words)
            rows.append([x, y, z, sigma])
        except ValueError:
            if words and (number != named or words[0][0] in "+-.0123456789"):
                raise ValueError(f"line {number + 1} holds {' '.join(words)!r}") from None
    values = np.array(rows, dtype=np.float64).reshape(-1, 4)
    return values[:, :3], values[:, 3]

"""The options of ``open_sequence`` as one value, so that every reader takes the same argument."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ufmstar_torch.eval.sequences.images import check_scale
from ufmstar_torch.eval.sequences.intrinsics import IntrinsicsLike


@dataclass(frozen=True, eq=False)
class Options:
    """What a user may override; see :func:`~ufmstar_torch.eval.sequences.layout.open_sequence`.

    Raises:
        ValueError: a number is out of its range.
    """

    intrinsics: IntrinsicsLike | None = None
    depth_intrinsics: IntrinsicsLike | None = None
    trajectory: str | Path | None = None
    images: str | Path | None = None
    depth: str | Path | None = None
    depth_scale: float | None = None
    max_time_difference: float = 0.02
    max_pose_gap: float = 0.1
    fps: float | None = None
    time_offset: float = 0.0
    register: bool = True
    T_color_depth: np.ndarray | None = None
    drive: str | int | None = None
    scans: int | None = None

    def __post_init__(self) -> None:
        check_scale(self.depth_scale)
        for name in ("max_time_difference", "max_pose_gap"):
            if not getattr(self, name) >= 0:
                raise ValueError(f"{name} must be a time of at least 0 s, got {getattr(self, name)}")
        if self.fps is not None and not self.fps > 0:
            raise ValueError(f"fps must be positive frames per second, got {self.fps}")
        if self.scans is not None and (self.scans < 0 or self.scans != int(self.scans)):
            raise ValueError(f"scans must be a number of laser scans on either side, at least 0, got {self.scans}")

    def only_attached(self, layout: str) -> None:
        """Raises ValueError where ``fps`` was given and no trajectory, to which it would belong."""
        if self.trajectory is None:
            self.reject(layout, "fps")

    def reject(self, layout: str, *names: str) -> None:
        """Raises ValueError where an option was given that the layout has no use for."""
        for name in names:
            if getattr(self, name) is not None:
                raise ValueError(
                    f"layout {layout!r} takes no {name}: its files hold that; use layout='generic' to combine "
                    "images, depth and a trajectory freely"
                )


def resolve(root: Path, given: str | Path) -> Path:
    """A path as the user gave it: inside the sequence's folder, or else from the working folder.

    Raises:
        FileNotFoundError: it is in neither.
    """
    for path in (root / given, Path(given)):
        if path.exists():
            return path
    raise FileNotFoundError(f"no such file or folder: {given} (neither in {root} nor in the working folder)")

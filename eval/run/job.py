"""A job of ``ufmstar run``, and its identity: the values on which the results depend."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
import torch

from ufmstar_torch.anchors.landmarks import LandmarkSource
from ufmstar_torch.anchors.pose_fit import FollowedCorners, ImageFit
from ufmstar_torch.anchors.sources import landmark_source
from ufmstar_torch.config import UfMStarConfig
from ufmstar_torch.eval.check.image_fit import image_fit, track_corners
from ufmstar_torch.eval.engine.anchors import AnchorSource
from ufmstar_torch.eval.engine.estimators import Gaussians
from ufmstar_torch.eval.engine.judge import UFM
from ufmstar_torch.eval.engine.predictions import DepthSource, content_digest
from ufmstar_torch.eval.engine.rows import RowRunner
from ufmstar_torch.eval.methods.setting import CORNERS
from ufmstar_torch.eval.run.scale import NetworkScale
from ufmstar_torch.eval.sequences.frame import FrameError, FrameSequence
from ufmstar_torch.posterior.recalibrate import Recalibration
from ufmstar_torch.ufmstar import UfMStar


@dataclass(frozen=True, eq=False)
class RunJob:
    """A run: its sequence, network and settings."""

    sequence: FrameSequence  # with poses
    indices: range  # of the frames, in order
    source: DepthSource  # of depth
    config: UfMStarConfig  # of UfM*
    device: torch.device  # of the networks; UfM* runs on the CPU, which for one stream is faster than a GPU
    settings: Mapping[str, Any]  # the user's options, as plain values, for the summary
    recalibration: Recalibration | None = None  # of the variance
    every: bool = False  # True if all members predict on every image, instead of alternating
    video: bool = True  # True to make preview.mp4
    sheet: bool = True  # True to make contact_sheet.png
    landmarks: str | LandmarkSource = CORNERS  # "corners", "dense" or a map of landmarks; for ``config.anchors``
    sensor: str | None = None  # kind of the depth camera whose depth, completed by ``landmarks``, serves as anchors
    scale: NetworkScale | None = None  # of the poses, if it is the network's; anchors then correct shape alone

    @cached_property
    def corners(self) -> list[FollowedCorners]:
        """Corners tracked over some frames."""
        return track_corners(self.sequence, self.indices)

    @cached_property
    def image_fit(self) -> ImageFit | None:
        """The fit of poses and intrinsics to the images; None if no corner could be tracked."""
        return image_fit(self.sequence, self.corners)

    def row(self) -> tuple[RowRunner, UfMStar]:
        """UfM* on the source, in its initial state: as a row, and the module in it."""
        estimator = Gaussians(self.config, torch.device("cpu"), recalibration=self.recalibration)
        anchors = None
        if self.config.anchors is not None:
            anchors = AnchorSource(landmark_source(self.landmarks), self.sensor)
        row = RowRunner(UFM, self.source, estimator, every=self.every, anchors=anchors)
        return row, estimator.ufm

    @property
    def source_identity(self) -> dict[str, Any]:
        """Plain values on which depth and anchors depend."""
        anchors = {} if self.config.anchors is None else landmark_source(self.landmarks).identity
        sensor = {} if self.sensor is None else {"sensor": self.sensor}
        return {**self.source.identity, **anchors, **sensor}

    def identity(self) -> dict[str, Any]:
        """Plain values on which the results depend. A folder takes another run only with equal values."""
        sequence, part = self.sequence, tuple(self.sequence.entries[index] for index in self.indices)
        return {
            "sequence": {
                "name": sequence.name,
                "layout": sequence.layout,
                "frames": len(self.indices),
                "names_and_poses": content_digest(replace(sequence, entries=part)),
                "intrinsics": sequence.intrinsics,
                "depth_intrinsics": sequence.depth_intrinsics,
                "first_frame": self._first_frame(),
            },
            "ufm": self.config.to_dict(),
            "source": self.source_identity,
            "device": self.device.type,
            **({"recalibration": self.recalibration.to_dict()} if self.recalibration else {}),
        }

    def _first_frame(self) -> str | None:
        """A digest of the first frame's pixels, which detects other data with the same names."""
        try:
            frame = self.sequence[self.indices[0]]
        except FrameError:
            return None
        maps = [array for array in (frame.image, frame.depth) if array is not None]
        return hashlib.sha256(b"".join(np.ascontiguousarray(array).tobytes() for array in maps)).hexdigest()

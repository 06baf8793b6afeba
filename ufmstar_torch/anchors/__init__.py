"""Anchors, which ``UncertainDepth`` switches on: sparse depths that reveal errors that all views share."""

from typing import TYPE_CHECKING

from ufmstar_torch.runtime.optional import lazy_names

if TYPE_CHECKING:
    from ufmstar_torch.anchors.anchors import Anchors as Anchors
    from ufmstar_torch.anchors.dense import DenseConfig as DenseConfig
    from ufmstar_torch.anchors.dense import DenseEvidence as DenseEvidence
    from ufmstar_torch.anchors.landmarks import Landmarks as Landmarks
    from ufmstar_torch.anchors.sensor import sensor_landmarks as sensor_landmarks
    from ufmstar_torch.anchors.sources import LandmarkMap as LandmarkMap
    from ufmstar_torch.anchors.sources import landmark_source as landmark_source
    from ufmstar_torch.anchors.tracker import LandmarkTracker as LandmarkTracker
    from ufmstar_torch.anchors.tracker import TrackerConfig as TrackerConfig
else:
    __getattr__, __dir__ = lazy_names(__name__)

__all__ = [
    "Anchors",
    "DenseConfig",
    "DenseEvidence",
    "LandmarkMap",
    "LandmarkTracker",
    "Landmarks",
    "TrackerConfig",
    "landmark_source",
    "sensor_landmarks",
]

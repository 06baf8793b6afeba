"""Evidence from an image besides the networks' prediction: anchors, wrong poses, and whether it shows anything."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager

import torch
from torch import Tensor

from ufmstar_torch.anchors import landmarks
from ufmstar_torch.anchors.anchors import Anchors
from ufmstar_torch.anchors.pose_check import PoseCheck
from ufmstar_torch.anchors.streams import SourceLike, StreamLandmarks, as_bytes
from ufmstar_torch.config import AnchorConfig, PosteriorConfig, UfMStarConfig
from ufmstar_torch.frames.image_check import ImageCheck
from ufmstar_torch.frames.warnings import LOGGER

Source = SourceLike | list[SourceLike] | tuple[SourceLike, ...]
_MISSED = "UfM* alone, without anchors and the depth that the posterior corrects with them: %s"


class ImageEvidence:
    """The memory of a video's images: searched for anchors, and compared with their poses and with each other.

    Args:
        source: of anchors (:class:`StreamLandmarks`), or None.
        by_default: whether the caller named no source: anchors that are passed with an image then replace its search,
            and images that cannot be searched are not.
        check_poses: number of first images that are compared with their poses and intrinsics.
        rotation_tolerance: of the poses.

    Attributes:
        landmarks: the sources of all streams, or None.
        images: the comparison of each image with the one before, which no saved state has.
    """

    def __init__(self, source: Source | None, *, by_default: bool, check_poses: int, rotation_tolerance: float) -> None:
        self.landmarks = None if source is None else StreamLandmarks(source)
        self.by_default, self._rotation_tolerance = by_default and source is not None, rotation_tolerance
        self._unsearchable = False  # whether an image could not be searched
        self._searched = False  # whether the source has processed the current image
        # A source that searches the images compares their poses itself, but does not name the mistake.
        searching = self.landmarks is not None and self.landmarks.searching and not self.by_default
        self._poses = PoseCheck(0 if searching else check_poses, rotation_tolerance)
        self.images = ImageCheck()

    @contextmanager
    def next_image(
        self, image: Tensor, pose: Tensor, K: Tensor, anchors: Anchors | None, device: torch.device, *,
        search: bool, skip: bool,
    ) -> Iterator[tuple[Anchors | None, Tensor | None]]:  # fmt: skip
        """Process the next image of every stream. An error in the context undoes this.

        Args:
            image: [B, 3, H, W].
            pose: [B, 4, 4] or [4, 4] camera-to-world [m].
            K: [B, 3, 3] or [3, 3] of the image [px].
            anchors: the caller's, or None.
            device: of anchors that are found.
            search: whether to search the image for anchors.
            skip: whether a stream with a faulty camera skips the image, instead of an error.

        Yields:
            The anchors at pixels of the image, or None; and [B] whether the image shows something, None = unknown.

        Raises:
            ValueError: anchors from both the caller and a source, or as :meth:`StreamLandmarks.update`.
        """
        self._poses.compare(image, pose, K)
        if anchors is not None and self.landmarks is not None and not self.by_default:
            raise ValueError("anchors come from the source that UncertainDepth was made with: pass none")
        self._searched = search and anchors is None and self._searchable(image)
        if self._searched and self.landmarks is not None:
            anchors = self.landmarks.update(image, pose, K, self._rotation_tolerance, skip=skip).to(device)
        try:
            yield anchors, self.images.informative(image, pose)
        except BaseException:
            self.undo()
            raise

    def _searchable(self, image: Tensor) -> bool:
        """False where the default source cannot search the image: it is neither of bytes nor of floats in [0, 1]."""
        if not self.by_default or image.is_meta:
            return not image.is_meta
        try:
            as_bytes(image)
        except ValueError:
            if not self._unsearchable:
                LOGGER.warning(_MISSED, "the images must be bytes, or floats in [0, 1] (logged once)")
            self._unsearchable = True
            return False
        return True

    def undo(self, streams: Sequence[int] | None = None) -> None:
        """Undo the updates by the last image, for some streams (None = all)."""
        self.images.undo(streams)
        if self.landmarks is not None and self._searched:
            self.landmarks.undo(streams)

    def reset(self, streams: Sequence[int] | None = None) -> None:
        """Forget the images of some streams (None = of all), because other videos begin."""
        if self.landmarks is not None:
            self.landmarks.reset(streams)
        self.images.reset(streams)
        if streams is None or 0 in streams:
            self._poses.reset()


def with_evidence(
    config: UfMStarConfig, networks: object, posterior: bool, anchors: Source | None
) -> tuple[UfMStarConfig, Source | None]:
    """The config with the sections ``anchors`` and ``posterior`` that are used, and the source of anchors, or None.
    Logs a warning if the default source cannot serve."""
    if posterior and anchors is None and (missed := _missed(networks)):
        posterior = config.anchors is not None
        if networks is not None or not posterior:
            LOGGER.warning(_MISSED, missed)
    elif posterior and anchors is None:
        anchors = "dense"
    if posterior or anchors is not None:
        config = config.replace(anchors=config.anchors or AnchorConfig())
    if posterior:
        config = config.replace(posterior=config.posterior or PosteriorConfig())
    return config, anchors


def _missed(networks: object) -> str:
    """Why no image can be searched for anchors; "" if images can be."""
    if networks is None:
        return "UncertainDepth(None) sees no images"
    try:
        landmarks.opencv()
    except ImportError as error:
        return str(error)
    return ""

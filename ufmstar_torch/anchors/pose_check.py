"""Comparison of a video's first images with their poses: corners, tracked in the images, must follow their epipolar
lines.

Wrong axes, the inverse pose, a late trajectory and the intrinsics of another image make UfM*'s disagreement large
without an error. They show within some 40 images, also to a user who asks for no anchors.
"""

from __future__ import annotations

from importlib.util import find_spec

from torch import Tensor

from ufmstar_torch.anchors.streams import StreamLandmarks


class PoseCheck:
    """Compares the first images of a batch's first stream with their poses, and warns once if they contradict.

    Args:
        images: number of images to compare; 0 = none. Without OpenCV, none is compared.

    Attributes:
        left: number of images still to compare. 0 after images that are neither bytes nor floats in [0, 1], or of
            another size.
    """

    def __init__(self, images: int) -> None:
        self._corners, self.left = StreamLandmarks("corners"), images if find_spec("cv2") else 0

    def compare(self, image: Tensor, pose: Tensor, intrinsics: Tensor, rotation_tolerance: float) -> None:
        """Compare the next image [B, 3, H, W] with its pose [B, 4, 4] or [4, 4] and K [B, 3, 3] or [3, 3]."""
        if not self.left:
            return
        self.left -= 1
        T, K = (value if value.dim() == 2 else value[0] for value in (pose, intrinsics))
        try:
            self._corners.update(image[:1], T, K, rotation_tolerance)
        except ValueError:  # no image, or one of another size
            self.left = 0

    def reset(self) -> None:
        """Forget the last image: another video begins."""
        self._corners.reset()

"""Landmarks of several cameras as the anchors of a batch of images."""

from __future__ import annotations

import logging
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from ufmstar_torch.anchors.anchors import Anchors
from ufmstar_torch.anchors.dense import DenseEvidence
from ufmstar_torch.anchors.landmarks import REPEATED, Landmarks, LandmarkSource, OtherCameraError, batched
from ufmstar_torch.anchors.saved_state import SavedState
from ufmstar_torch.anchors.sources import landmark_source
from ufmstar_torch.anchors.tracker import LandmarkTracker
from ufmstar_torch.frames.frame import FRAME_FAULTS
from ufmstar_torch.kernels.cpu.calls import array
from ufmstar_torch.kernels.cpu.check import camera_faults

_LOG = logging.getLogger("ufmstar_torch")
_CAUSES = (
    "Check that the poses are camera-to-world and of the images' times, that the intrinsics are the images', and that "
    "the video is not frozen (logged once)"
)
_TIMES = (
    "Anchors are corrected for this offset, UfM*'s comparison of views is not: check the times of poses and images "
    "(logged once)"
)
# A str may name a file, too. It is not in the type, so that type checkers detect misspelt names of sources.
SourceLike = Literal["corners", "dense"] | Path | LandmarkSource
# Successive images that contradict their poses, or have a time offset, before a warning; a blurred one affects several.
_SUCCESSIVE = 8
_LARGEST_LAG = 0.5  # [images] time offset of the poses up to which there is no warning


class StreamLandmarks:
    """One source of landmarks for each stream of a batch.

    Args:
        sources: a name or a file for :func:`landmark_source`, from which every stream gets a source; or a source; or a
            list of all these, one for each stream.

    Attributes:
        needs_image: whether a source reads the images.
        searching: types of the sources that search the images, and compile kernels for it.
        last: landmarks of the last image of every stream.
        restarts: how often an image of another size or camera restarted a source.

    Raises:
        FileNotFoundError, ValueError: as :func:`landmark_source`.
    """

    def __init__(self, sources: SourceLike | list[SourceLike] | tuple[SourceLike, ...]) -> None:
        listed = sources if isinstance(sources, list | tuple) else [sources]
        self._each = sources if isinstance(sources, str | Path) else None  # of every stream, however many there are
        self._follow([landmark_source(source) for source in listed])
        self.needs_image = any(source.needs_image for source in self._sources)
        kinds = {type(source) for source in self._sources}
        self.searching = tuple(kind for kind in (LandmarkTracker, DenseEvidence) if kind in kinds)
        self.last: list[Landmarks] = []
        self.restarts = 0

    def _follow(self, sources: list[LandmarkSource]) -> None:
        """Use these sources from now on."""
        self._sources = sources
        self._before, self._replaced = self._snapshots(), sources
        self._contradicted = [0] * len(sources)  # successive images; -1 = warned
        self._late = [0] * len(sources)  # likewise, images with a time offset

    def _require(self, streams: int) -> None:
        """Have a source for each of ``streams`` streams. Raises ValueError: another number of sources was listed."""
        if streams == len(self._sources):
            return
        if self._each is None or not streams:
            raise ValueError(f"anchors must name a source for each of the {streams} streams, got {len(self._sources)}")
        self._follow([landmark_source(self._each) for _ in range(streams)])

    def update(
        self, image: Tensor | None, pose: Tensor, intrinsics: Tensor, rotation_tolerance: float | None = None, *,
        skip: bool = True,
    ) -> Anchors:  # fmt: skip
        """Compute the anchors of the next image of every stream, in its pixels. An error leaves all sources unchanged.
        An image of another size or camera than before restarts its stream's source.

        Args:
            image: [B, 3, H, W] RGB, uint8, or floating-point in [0, 1]; None: the sources need none.
            pose: [B, 4, 4] or [4, 4] camera-to-world [m].
            intrinsics: [B, 3, 3] or [3, 3] of ``image`` [px].
            rotation_tolerance: of the poses; None = the sources check the poses.
            skip: a stream whose pose or intrinsics have a fault (``frame.FRAME_FAULTS``) skips the image: it gets no
                anchors, and its source stays unchanged. Without ``skip``, a fault is an error.

        Returns:
            [B, N], padded and masked, on the image's device.

        Raises:
            ValueError: the numbers of streams and sources differ, the image has another dtype or range, there is a
                fault, or as :meth:`LandmarkSource.update`.
        """
        b, replaced = len(self._sources) if image is None else len(image), self._sources
        images = None if image is None else _channels_last(as_bytes(image)).cpu().numpy()
        T, K = (
            np.array(np.broadcast_to(array(x), (b, size, size)), np.float64) for x, size in ((pose, 4), (intrinsics, 3))
        )
        self._require(b)
        before, faults = self._snapshots(), [0] * b
        if rotation_tolerance is not None:
            size = (torch.inf, torch.inf) if images is None else images.shape[1:3]
            faults = camera_faults(T, K, size, rotation_tolerance)
        if not skip and (faulty := [f"stream {i}: {FRAME_FAULTS[fault]}" for i, fault in enumerate(faults) if fault]):
            raise ValueError("; ".join(faulty))
        try:
            result = [
                Landmarks.skipped(FRAME_FAULTS[fault])
                if fault
                else self._updated(source, None if images is None else images[i], T[i], K[i])
                for i, (source, fault) in enumerate(zip(self._sources, faults, strict=True))
            ]
        except BaseException:
            self._restore(before, range(b))
            if replaced is not self._sources:
                self._follow(replaced)
            raise
        self._before, self._replaced, self.last = before, replaced, result
        for stream, landmarks in enumerate(result):
            self._warn(stream, landmarks)
        return batched(result, pose.device if image is None else image.device)

    def _warn(self, stream: int, landmarks: Landmarks) -> None:
        """Log once that a stream's poses are late, or contradict its images, in several successive images."""
        late = abs(landmarks.lag) > _LARGEST_LAG and not landmarks.contradicted
        self._late[stream] = self._late[stream] + 1 if late and self._late[stream] >= 0 else min(self._late[stream], 0)
        if self._late[stream] == _SUCCESSIVE:
            self._late[stream] = -1
            offset = f"{abs(landmarks.lag):.1f} images {'late' if landmarks.lag > 0 else 'early'}"
            _LOG.warning("stream %d: the poses seem %s. %s", stream, offset, _TIMES)
        if self._contradicted[stream] < 0:
            return
        contradicted = landmarks.contradicted or landmarks.none == REPEATED
        self._contradicted[stream] = self._contradicted[stream] + 1 if contradicted else 0
        if self._contradicted[stream] == _SUCCESSIVE:
            self._contradicted[stream] = -1
            _LOG.warning("stream %d: %s; no depth is used. %s", stream, landmarks.none, _CAUSES)

    def _updated(
        self, source: LandmarkSource, image: NDArray[np.uint8] | None, T: NDArray[np.float64], K: NDArray[np.float64]
    ) -> Landmarks:
        try:
            return source.update(image, T, K)
        except OtherCameraError:
            source.reset()
            self.restarts += 1
            if self.restarts == 1:
                _LOG.warning("an image has another size or camera than before: its evidence starts anew (logged once)")
            return source.update(image, T, K)

    def undo(self, streams: Sequence[int] | None = None) -> None:
        """Restore the state before the last image of these streams (None = of all)."""
        if streams is None and self._replaced is not self._sources:
            self._follow(self._replaced)
        self._restore(self._before, range(len(self._sources)) if streams is None else streams)

    def reset(self, streams: Sequence[int] | None = None) -> None:
        """Reset the sources of these streams (None = of all)."""
        for i, source in enumerate(self._sources):
            if streams is None or i in streams:
                source.reset()

    def state(self) -> dict[str, Tensor]:
        """State of all sources, by names "STREAM.NAME"."""
        states = enumerate(source.state() for source in self._sources)
        return {f"{i}.{name}": value for i, state in states for name, value in state.items()}

    def load_state(self, state: Mapping[str, Tensor]) -> None:
        """Restore a result of :meth:`state`.

        Raises:
            ValueError: the state belongs to other sources; the sources stay unchanged.
        """
        replaced = self._sources
        if self._each is not None:
            self._require(len({key.partition(".")[0] for key in state}) or 1)
        before, parts = self._snapshots(), [dict[str, Tensor]() for _ in self._sources]
        try:
            for key, value in state.items():
                stream, _, name = key.partition(".")
                if not stream.isdigit() or int(stream) >= len(parts):
                    raise ValueError(f"anchors: the state holds {key!r}, but the streams are 0 to {len(parts) - 1}")
                parts[int(stream)][name] = value
            for source, part in zip(self._sources, parts, strict=True):
                if other := part.keys() ^ source.state().keys():
                    names = ", ".join(sorted(other)[:3])
                    raise ValueError(f"anchors: the state must hold the values of this source, other: {names}, ...")
                source.load_state(part)
        except BaseException:
            self._restore(before, range(len(before)))
            if replaced is not self._sources:
                self._follow(replaced)
            raise

    def _snapshots(self) -> list[dict[str, Any]]:
        """The state of each source for :meth:`_restore`. A saved state has tensors, and takes six times as long."""
        return [source.snapshot() if isinstance(source, SavedState) else source.state() for source in self._sources]

    def _restore(self, snapshots: Sequence[Mapping[str, Any]], streams: Sequence[int]) -> None:
        for i in streams:
            source = self._sources[i]
            (source.restore if isinstance(source, SavedState) else source.load_state)(snapshots[i])


def _channels_last(image: Tensor) -> Tensor:
    """[B, H, W, 3] contiguous; torch's own copy takes three times as long."""
    pixels = image.permute(0, 2, 3, 1)
    return pixels if pixels.is_contiguous() else torch.stack(image.unbind(1), -1)


def as_bytes(image: Tensor) -> Tensor:
    """[B, 3, H, W] as uint8.

    Raises:
        ValueError: the image is neither uint8 nor floating-point in [0, 1].
    """
    if image.dtype == torch.uint8:
        return image
    low, high = torch.aminmax(image.detach()) if image.is_floating_point() and image.numel() else (-1.0, -1.0)
    if not (low >= -1e-3 and high <= 1 + 1e-3):
        raise ValueError("image must be uint8, or floating-point in [0, 1], for landmarks to be tracked in it")
    return (image.detach().clamp(0, 1) * 255).round().to(torch.uint8)

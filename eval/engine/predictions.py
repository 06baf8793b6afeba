"""Predictions of depth sources for one frame. Each inference runs once and may be cached on disk: one npz per network,
frame and member, ``NETWORK/SEQUENCE/FRAME@MEMBER.npz``, with the maps in float32.
"""

from __future__ import annotations

import hashlib
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import cached_property
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
import torch
from torch import Tensor

from ufmstar_torch.eval.sequences.frame import Frame, FrameSequence
from ufmstar_torch.eval.sequences.images import image_tensor
from ufmstar_torch.files.read import read_npz_whole
from ufmstar_torch.files.write import write_atomic
from ufmstar_torch.frames.image_check import reduced, shows_something
from ufmstar_torch.frames.prediction import SAMPLES, DepthPrediction, combine
from ufmstar_torch.models.network import DepthNetwork

_SHOWN = 16  # hex digits of a digest in the name of a folder: 64 bits
# Names of the arrays in a file, and of the tensors of a ``DepthPrediction``.
_FIELDS = {
    "depth": "depth",
    "aleatoric": "aleatoric_variance",
    "epistemic": "epistemic_variance",
    "confidence": "confidence",
    "intrinsics": "intrinsics",
}


class DepthSource(ABC):
    """A source of depth: networks, or existing maps.

    Attributes:
        identity: plain values that distinguish this source from others.
        label: for tables.
        digest: hex digest of the identity, the source's name in a store; "" = predictions are not stored.
        networks: () for maps.
        passes: number of inferences of all members (or samples).
        max_depth: [m] the largest depth that its networks can predict; None = unknown.
        states_confidence: True if its networks predict a confidence.
        stochastic: True if it predicts another random sample for every image.
        needs_image: True if it predicts from the image, False if it reads a depth map.
        is_truth: True if it is the sequence's depth, which has no error.
    """

    needs_image = is_truth = states_confidence = stochastic = False
    networks: tuple[DepthNetwork, ...] = ()
    passes = 1
    max_depth: float | None = None

    def __init__(self, identity: Mapping[str, Any], label: str = "", digest: str = "") -> None:
        self.identity, self.label, self.digest = dict(identity), label, digest

    @property
    def cacheable(self) -> bool:
        """True if a store may keep its predictions, which then always are of single precision."""
        return self.needs_image and bool(self.digest)

    @property
    def runtime(self) -> Mapping[str, Any] | None:
        """Name, version, threads and precision of the networks' runtime, for the record; None of maps."""
        return None

    @abstractmethod
    def prepared(self, how: str) -> DepthSource:
        """The same source with images preprocessed by ``Setting.preprocess``. Raises ValueError: it has no images."""

    def turn(self, position: int) -> int:
        """The member for a row's image number ``position``, from 0; 0 for maps."""
        return 0

    def prepare(self, frame: Frame) -> None:
        """Compute the networks' input; called in another thread."""

    @abstractmethod
    def one(self, frame: Frame, n: int) -> DepthPrediction:
        """One timed inference of member (or sample) n: maps [1, h, w], and their intrinsics [1, 3, 3] in float64 on the
        CPU. Raises FrameError: the frame has no image or depth map to predict from."""


class CacheError(Exception):
    """The folder cannot be used; the message names it and the reason."""


class PredictionCache:
    """Predictions by a ``path`` of networks, sequence, frame and member, and a digest of the frame's ``content``.
    Several processes may use one folder: a file is complete or absent, and all processes write the same content.

    Raises:
        CacheError: the folder cannot be made or written.
    """

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        # A test file, because permissions do not show that a file system is mounted read-only.
        self._write(Path(".writable"), lambda opened: opened.write(b""))
        (folder / ".writable").unlink(missing_ok=True)  # several processes may test the folder

    def has(self, path: Path) -> bool:
        """True if the file exists."""
        return (self.folder / path).is_file()

    def load(self, path: Path, content: str, device: torch.device) -> DepthPrediction | None:
        """The prediction as it was stored, bit for bit. None if the file does not exist, belongs to another image of
        that name, is incomplete or changed, or cannot be read."""
        try:
            arrays = read_npz_whole(self.folder / path)
        except (OSError, ValueError):
            return None
        if bytes(arrays.pop("content")).decode() != content:
            return None
        tensors: dict[str, Any] = {_FIELDS[name]: torch.from_numpy(value)[None] for name, value in arrays.items()}
        return DepthPrediction(**tensors).to(device)

    def store(self, path: Path, content: str, prediction: DepthPrediction) -> None:
        """Store a prediction. Raises CacheError: it cannot be written."""
        named = {name: getattr(prediction, field) for name, field in _FIELDS.items()}
        arrays = {name: value[0].cpu().numpy() for name, value in named.items() if value is not None}
        arrays["content"] = np.frombuffer(content.encode(), np.uint8)
        self._write(path, lambda opened: np.savez(opened, allow_pickle=False, **arrays))

    def _write(self, path: Path, write: Callable[[BinaryIO], object]) -> None:
        file = self.folder / path
        try:
            file.parent.mkdir(parents=True, exist_ok=True)
            write_atomic(file, write)
        except OSError as error:
            text = (
                f"the cache of predictions cannot be written to {self.folder} ({error}): choose another folder, or none"
            )
            raise CacheError(text) from error


class FramePredictions:
    """The predictions for one frame, on a device: from memory, else from the store if any, else computed. ``sequence``
    is the digest of the sequence."""

    def __init__(self, frame: Frame, device: torch.device, store: PredictionCache | None, sequence: str) -> None:
        self.frame, self._device, self._store, self._sequence = frame, device, store, sequence
        self._content = "" if store is None else frame_digest(frame)
        # By source: predictions by member ("0", "1", ... or "all"), and single inferences.
        self._cached: dict[tuple[object, str], DepthPrediction] = {}
        self._inferences: dict[tuple[object, int], DepthPrediction] = {}

    def of(self, source: DepthSource, position: int, every: bool) -> DepthPrediction:
        """The prediction for a row's image number ``position``, of ``every`` member or of the next one. Raises
        FrameError: the frame has no image or depth map to predict from."""
        combined = every and source.passes > 1
        member = "all" if combined else str(source.turn(position))
        key = source.digest or source, member
        if key in self._cached:
            return self._cached[key]
        store = self._store if source.cacheable else None
        path = self._path(source, member)
        prediction = None if store is None else store.load(path, self._content, self._device)
        if prediction is None:
            members = range(source.passes) if combined else [int(member)]
            parts = [self._inference(source, n) for n in members]
            prediction = combine(parts) if combined else parts[0]
            if store is not None:
                store.store(path, self._content, prediction)
        index = 0 if combined else self.frame.index % SAMPLES if source.stochastic else int(member)
        prediction = replace(prediction, member=index, informative=self._informative)
        self._cached[key] = prediction
        return prediction

    @cached_property
    def _informative(self) -> Tensor | None:
        """[1] whether the frame's image shows something; None without an image."""
        if self.frame.image is None:
            return None
        return shows_something(reduced(image_tensor(self.frame))).to(self._device)

    def prepare(self, source: DepthSource) -> None:
        """Compute the networks' input in the thread that reads ahead, unless the store has a prediction."""
        members = "all", *map(str, range(source.passes))
        if self._store is None or not any(self._store.has(self._path(source, member)) for member in members):
            source.prepare(self.frame)

    def _path(self, source: DepthSource, member: str) -> Path:
        return Path(source.digest[:_SHOWN], self._sequence[:_SHOWN], f"{self.frame.name}@{member}.npz")

    def _inference(self, source: DepthSource, n: int) -> DepthPrediction:
        """Member (or sample) n, computed once for all rows."""
        key = (source.digest or source, n)
        if key not in self._inferences:
            prediction = source.one(self.frame, n).to(self._device)
            self._inferences[key] = prediction.to(torch.float32) if source.cacheable else prediction
        return self._inferences[key]


def sequence_digest(sequence: FrameSequence) -> str:
    """Hex digest of a sequence's name, layout, camera and frames' names."""
    identity = (sequence.name, sequence.layout, sequence.image_size, sequence.intrinsics.tolist(), sequence.names)
    return hashlib.sha256(repr(identity).encode()).hexdigest()


def content_digest(sequence: FrameSequence) -> str:
    """Hex digest of a sequence without its decoded content: frames, cameras and poses."""
    K = sequence.depth_intrinsics
    digest = hashlib.sha256(sequence_digest(sequence).encode())
    digest.update(repr((None if K is None else K.tolist(), sequence.depth_size)).encode())
    for entry in sequence.entries:
        digest.update(entry.T_world_cam.tobytes() + bytes([entry.load_depth is not None]))
        digest.update(b"" if entry.intrinsics is None else entry.intrinsics.tobytes())
    return digest.hexdigest()


def frame_digest(frame: Frame) -> str:
    """Hex digest of a frame's inputs to a network: pixels, intrinsics, and the index, which seeds samples."""
    digest = hashlib.sha256(repr((frame.index, None if frame.image is None else frame.image.shape)).encode())
    digest.update(np.ascontiguousarray(frame.intrinsics).tobytes())
    if frame.image is not None:
        digest.update(np.ascontiguousarray(frame.image).tobytes())
    return digest.hexdigest()

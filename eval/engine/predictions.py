"""Predictions of depth sources for one frame; each inference runs once and may be cached on disk: in one npz for each
network, frame and member, ``NETWORK/SEQUENCE/FRAME@MEMBER.npz``, with the maps in float32.
"""

from __future__ import annotations

import hashlib
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
import torch

from ufmstar_torch.array_files import read_npz_whole
from ufmstar_torch.atomic import write_atomic
from ufmstar_torch.eval.sequences.frame import Frame, FrameSequence
from ufmstar_torch.models.network import DepthNetwork
from ufmstar_torch.networks_in_turn import combine
from ufmstar_torch.prediction import DepthPrediction

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
    """A source of depth: networks, or maps that exist already.

    Attributes:
        identity: plain values that distinguish this source from another one.
        label: as tables show it.
        digest: of the identity, in hex, the source's name in a store; "" where nothing is stored.
        networks: that it runs; () of maps.
        passes: inferences that all members (or samples) take.
        max_depth: [m] the largest depth that its networks can predict; None where it is not known.
        states_confidence: whether its networks do.
        needs_image: whether it predicts from the image; from the depth map otherwise.
        is_truth: whether it is the sequence's own depth, which has no error.
    """

    needs_image = is_truth = states_confidence = False
    networks: tuple[DepthNetwork, ...] = ()
    passes = 1
    max_depth: float | None = None

    def __init__(self, identity: Mapping[str, Any], label: str = "", digest: str = "") -> None:
        self.identity, self.label, self.digest = dict(identity), label, digest

    @property
    def cacheable(self) -> bool:
        """True if a store may keep its predictions, which are then of single precision, read or computed."""
        return self.needs_image and bool(self.digest)

    @property
    def runtime(self) -> Mapping[str, Any] | None:
        """Name, version, threads and precision of the networks' runtime, for the record; None of maps."""
        return None

    @abstractmethod
    def prepared(self, how: str) -> DepthSource:
        """The same source with its images prepared by ``Setting.preprocess``. Raises ValueError: it has no images."""

    def turn(self, position: int) -> int:
        """The member for the image that a row uses after ``position`` others; 0 for maps."""
        return 0

    def prepare(self, frame: Frame) -> None:
        """In another thread, what can be done before a network runs."""

    @abstractmethod
    def one(self, frame: Frame, n: int) -> DepthPrediction:
        """One timed inference, of member (or sample) n: maps [1, h, w], and their intrinsics [1, 3, 3] in float64 on
        the CPU. Raises FrameError: the frame has nothing to predict from."""


class CacheError(Exception):
    """The folder cannot be used; the message names it and the reason."""


class PredictionCache:
    """Predictions by a ``path`` of networks, sequence, frame and member, and a digest of the frame's ``content``.
    Several processes may use one folder: a file is whole or absent, and all write the same into it.

    Raises:
        CacheError: the folder cannot be made or written.
    """

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        # Tried by writing: permissions say nothing about file systems that are mounted read-only.
        self._write(Path(".writable"), lambda opened: opened.write(b""))

    def load(self, path: Path, content: str, device: torch.device) -> DepthPrediction | None:
        """The prediction bit for bit as it was stored, or None where it has to be made: there is no file, it belongs to
        another image of that name, was cut off or changed, or cannot be read."""
        try:
            arrays = read_npz_whole(self.folder / path)
        except (OSError, ValueError):
            return None
        if bytes(arrays.pop("content")).decode() != content:
            return None
        tensors: dict[str, Any] = {_FIELDS[name]: torch.from_numpy(value)[None] for name, value in arrays.items()}
        return DepthPrediction(**tensors).to(device)

    def store(self, path: Path, content: str, prediction: DepthPrediction) -> None:
        """Keep a prediction. Raises CacheError: it cannot be written."""
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
    """The predictions for one frame, on a device: from memory, else from the store (None = there is none), else
    computed. ``sequence`` is the digest of the sequence."""

    def __init__(self, frame: Frame, device: torch.device, store: PredictionCache | None, sequence: str) -> None:
        self.frame, self._device, self._store, self._sequence = frame, device, store, sequence
        self._content = "" if store is None else frame_digest(frame)
        # By source: predictions by member ("0", "1", ... or "all"), and single inferences.
        self._cached: dict[tuple[object, str], DepthPrediction] = {}
        self._inferences: dict[tuple[object, int], DepthPrediction] = {}

    def of(self, source: DepthSource, position: int, every: bool) -> DepthPrediction:
        """The prediction for a row that has used ``position`` images before: of all members, or of the one in turn.
        Raises FrameError: the frame has nothing to predict from."""
        combined = every and source.passes > 1
        member = "all" if combined else str(source.turn(position))
        key = source.digest or source, member
        if key in self._cached:
            return self._cached[key]
        store = self._store if source.cacheable else None
        path = Path(source.digest[:_SHOWN], self._sequence[:_SHOWN], f"{self.frame.name}@{member}.npz")
        found = None if store is None else store.load(path, self._content, self._device)
        if found is None:
            members = range(source.passes) if combined else [int(member)]
            made = [self._inference(source, n) for n in members]
            found = combine(made) if combined else made[0]
            if store is not None:
                store.store(path, self._content, found)
        self._cached[key] = found
        return found

    def _inference(self, source: DepthSource, n: int) -> DepthPrediction:
        """Member (or sample) n, computed once for all rows."""
        key = (source.digest or source, n)
        if key not in self._inferences:
            made = source.one(self.frame, n).to(self._device)
            self._inferences[key] = made.to(torch.float32) if source.cacheable else made
        return self._inferences[key]


def sequence_digest(sequence: FrameSequence) -> str:
    """Hex digest of a sequence's name, layout, camera and frames' names."""
    identity = (sequence.name, sequence.layout, sequence.image_size, sequence.intrinsics.tolist(), sequence.names)
    return hashlib.sha256(repr(identity).encode()).hexdigest()


def content_digest(sequence: FrameSequence) -> str:
    """Hex digest of what is known of a sequence before it is decoded: frames, cameras and poses."""
    K = sequence.depth_intrinsics
    digest = hashlib.sha256(sequence_digest(sequence).encode())
    digest.update(repr((None if K is None else K.tolist(), sequence.depth_size)).encode())
    for entry in sequence.entries:
        digest.update(entry.T_world_cam.tobytes() + bytes([entry.load_depth is not None]))
        digest.update(b"" if entry.intrinsics is None else entry.intrinsics.tobytes())
    return digest.hexdigest()


def frame_digest(frame: Frame) -> str:
    """Hex digest of what a network sees of a frame: pixels and intrinsics (and the index, which seeds samples)."""
    digest = hashlib.sha256(repr((frame.index, None if frame.image is None else frame.image.shape)).encode())
    digest.update(np.ascontiguousarray(frame.intrinsics).tobytes())
    if frame.image is not None:
        digest.update(np.ascontiguousarray(frame.image).tobytes())
    return digest.hexdigest()

"""The options of ``ufmstar bench``; nothing heavy is imported for them."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

CORNERS = 300  # that are tracked with ``--anchors`` without a number


@dataclass(frozen=True, kw_only=True)
class BenchSettings:
    """Times of the stages and of the whole UfM* step beside the forward passes of two networks.

    Nothing passes or fails: absolute times depend on the machine and on its other load. docs/results/benchmark.md
    explains each figure.

    Attributes:
        sequence: recorded sequence instead of a rendered room
        weights: FastDepth's weights instead of random ones; with --sequence it then predicts the depth
        runtime: of the networks; auto: the one that is faster here
        peer: another program, timed on the same frames: whole processes, and the frames for which it prints
            {"ms": TIME} on a line; they lie in the folder that UFMSTAR_BENCH_FRAMES names
        against: an earlier report of the same machine, with which this one is compared
        sizes: sizes of the square images [px]
        backends: kernels that are timed
        frames: number of timed frames (the torch backend: at most 3)
        in_view: number of components in view from which on frames are timed
        history: number of frames before that at most
        boxes: number of boxes in the rendered room
        threads: number of threads of torch and numba; default: the cores of this process
        seed: of the rendered room
        long: also time this many frames of each world (1000 without a number)
        world: of the long runs: one room (or the sequence); a building of twenty rooms, each seen for 50 frames, then
            again; a drive straight on, 2 m a frame
        merge: limits of merging (UfMStarConfig.merge) of the long runs, which are run with each; 0 = off
        max_components: likewise limits of the components in memory, the others in a temporary folder; 0 = all in memory
        anchors: also time the tracker of this many corners at 640 x 480 and the step with as many anchors, both on one
            thread (300 without a number; needs OpenCV)
        skip_compile: do not time compilation (some tens of seconds)
        device: time steps of 1, 64 and 256 streams on this GPU instead (cuda)
        json: file for the report
    """

    sequence: Path | None = None
    weights: Path | None = None
    runtime: str = field(default="auto", metadata={"choices": ("auto", "torch", "onnx")})
    peer: str | None = None
    against: Path | None = None
    sizes: tuple[int, ...] = (224, 518)
    backends: tuple[str, ...] = field(default=("numba", "torch"), metadata={"choices": ("numba", "torch")})
    frames: int = 40
    in_view: int = 100
    history: int = 400
    boxes: int = 40
    threads: int | None = None
    seed: int = 0
    long: int | None = field(default=None, metadata={"const": 1000})
    world: tuple[str, ...] = field(default=("room",), metadata={"choices": ("room", "building", "drive")})
    merge: tuple[float, ...] = (0.0,)
    max_components: tuple[int, ...] = (0,)
    anchors: int | None = field(default=None, metadata={"const": CORNERS})
    skip_compile: bool = False
    device: str = "cpu"
    json: Path | None = None

    def __post_init__(self) -> None:
        for name in ("frames", "boxes", "history", "in_view", "anchors", "threads"):
            value = getattr(self, name)
            if value is not None and value < 1:
                raise ValueError(f"--{name.replace('_', '-')} must be at least 1, got {value}")
        if not self.merge or min(self.merge) < 0:
            raise ValueError(f"--merge must be limits of at least 0, got {list(self.merge)}")
        if not self.max_components or min(self.max_components) < 0:
            raise ValueError(f"--max-components must be limits of at least 0, got {list(self.max_components)}")
        if min(self.sizes) < 16:
            raise ValueError(f"--sizes must be at least 16 pixels, got {list(self.sizes)}")

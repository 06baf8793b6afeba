"""The options of ``ufmstar bench``; nothing heavy is imported for them."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

TOUR = "tour:1"


@dataclass(frozen=True, kw_only=True)
class BenchSettings:
    """Time UfM* beside a depth network, on the same frames.

    With --weights, the network predicts the depth, at its own resolution. Without, FastDepth and ResNet50-Monodepth2
    are timed with random weights, and UfM* gets the sequence's depth with smooth errors of 3 %. Timings depend on the
    machine and on its other load: compare ratios. docs/results/speed.md explains each figure.

    Attributes:
        sequence: folder of a recording, or tour:SEED; default: a rendered tour
        model: kind of network, as in `ufmstar run`
        weights: its file or directory
        spec: JSON file that declares what the weights do not say, as in `ufmstar run`
        runtime: auto: ONNX Runtime for weights in ONNX files, torch for the rest; or one of the two
        sizes: sides of the square depth maps without --weights [px]; default: 224 518
        backends: implementations of the step that are timed
        frames: number of timed frames (the torch backend: at most 3)
        history: number of frames before them
        threads: number of threads of torch, ONNX Runtime and numba; default: the cores of this process
        skip_compile: do not time compilation (about a minute)
        device: cpu, cuda or cuda:N, for network and UfM*
        json: file for the report
    """

    sequence: str = TOUR
    model: str = "fastdepth"
    weights: Path | None = None
    spec: Path | None = None
    runtime: str = field(default="auto", metadata={"choices": ("auto", "torch", "onnx")})
    sizes: tuple[int, ...] = ()
    backends: tuple[str, ...] = field(
        default=("auto", "torch"), metadata={"choices": ("auto", "numba", "triton", "torch")}
    )
    frames: int = 40
    history: int = 60
    threads: int | None = None
    skip_compile: bool = False
    device: str = "cpu"
    json: Path | None = None

    def __post_init__(self) -> None:
        for name in ("frames", "history", "threads"):
            value = getattr(self, name)
            if value is not None and value < 1:
                raise ValueError(f"--{name} must be at least 1, got {value}")
        if self.weights is not None and self.sizes:
            raise ValueError("--sizes is for runs without --weights: a network's maps have its own size")
        if self.sizes and min(self.sizes) < 32:
            raise ValueError(f"--sizes must be at least 32 pixels, got {list(self.sizes)}")

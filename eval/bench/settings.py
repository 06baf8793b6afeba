"""The options of ``ufmstar bench``; nothing heavy is imported for them."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

TOUR = "tour:1"
ARCHITECTURES = ("fastdepth", "monodepth2")  # that are timed with random weights


@dataclass(frozen=True, kw_only=True)
class BenchSettings:
    """Measure the time of UfM* (plain, anchored, with the posterior) and of a depth network on the same frames.

    With --weights, the network predicts the depth. Without, it has random weights, and UfM* gets the rendered depth
    with smooth errors of 3 %. Times depend on the machine and on its other load: compare ratios.
    docs/results/speed.md explains each figure.

    Attributes:
        sequence: folder of a recording, or tour:SEED
        model: kind of network, as in `ufmstar run`; without --weights fastdepth or monodepth2
        weights: its file or directory
        spec: JSON file that declares what the weights do not say, as in `ufmstar run`
        runtime: auto: ONNX Runtime for weights in ONNX files, torch for the rest; or one of the two
        sizes: sides of the square images without --weights [px], multiples of 32
        backends: implementations of the step that are timed
        frames: number of timed frames
        history: number of frames before them
        threads: number of CPU threads; default: the cores of this process
        device: cpu, cuda or cuda:N, for network and UfM*
        json: file for the report
    """

    sequence: str = TOUR
    model: str = "fastdepth"
    weights: Path | None = None
    spec: Path | None = None
    runtime: str = field(default="auto", metadata={"choices": ("auto", "torch", "onnx")})
    sizes: tuple[int, ...] = (224, 512)
    backends: tuple[str, ...] = field(default=("auto",), metadata={"choices": ("auto", "numba", "triton", "torch")})
    frames: int = 40
    history: int = 60
    threads: int | None = None
    device: str = "cpu"
    json: Path | None = None

    def __post_init__(self) -> None:
        for name in ("frames", "history", "threads"):
            value = getattr(self, name)
            if value is not None and value < 1:
                raise ValueError(f"--{name} must be at least 1, got {value}")
        if self.weights is None and self.model not in ARCHITECTURES:
            raise ValueError(f"--model {self.model} needs --weights; without, it is one of {', '.join(ARCHITECTURES)}")
        if not self.sizes or any(size < 64 or size % 32 for size in self.sizes):
            raise ValueError(f"--sizes must be multiples of 32 from 64 on [px], got {list(self.sizes)}")

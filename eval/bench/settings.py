"""The options of ``ufmstar bench``."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

TOUR = "tour:1"
ARCHITECTURES = ("fastdepth", "monodepth2")  # can be timed with random weights


@dataclass(frozen=True, kw_only=True)
class BenchSettings:
    """Measure the time of UfM* (plain, anchored, with the posterior) and of a depth network on the same frames.

    With --weights, the network predicts the depth. Without, it has random weights, and UfM* gets the rendered depth
    with smooth errors of 3 %. Times depend on the machine and on its other load: compare ratios.
    docs/results/speed.md explains each figure.

    Attributes:
        sequence: folder of a recording, or tour:SEED
        model: kind of network, as in `ufmstar run`; without --weights fastdepth or monodepth2
        weights: file or directory of the network's weights
        spec: JSON file that declares what the weights do not contain, as in `ufmstar run`
        trust_code: exported, torchscript: let the file run its code; only for files whose origin you trust
        runtime: auto: ONNX Runtime for weights in ONNX files, torch for the rest; or one of the two
        sizes: sides of the square images without --weights [px], multiples of 32
        backends: implementations of the step that are timed
        frames: number of timed frames
        history: number of frames before them
        threads: number of CPU threads; default: the cores of this process
        device: cpu, cuda or cuda:N, for network and UfM*
        streams: numbers of simultaneous streams on which UfM* alone is also timed
        json: file for the report
    """

    sequence: str = TOUR
    model: str = "fastdepth"
    weights: Path | None = None
    spec: Path | None = None
    trust_code: bool = field(default=False, metadata={"typed": True})
    runtime: str = field(default="auto", metadata={"choices": ("auto", "torch", "onnx")})
    sizes: tuple[int, ...] = (224, 512)
    backends: tuple[str, ...] = field(default=("auto",), metadata={"choices": ("auto", "numba", "triton", "torch")})
    frames: int = field(default=40, metadata={"least": 1})
    history: int = field(default=60, metadata={"least": 1})
    threads: int | None = None
    device: str = "cpu"
    streams: tuple[int, ...] = ()
    json: Path | None = None

    def __post_init__(self) -> None:
        if self.weights is None and self.model not in ARCHITECTURES:
            raise ValueError(f"--model {self.model} needs --weights; without, it is one of {', '.join(ARCHITECTURES)}")
        if any(count < 1 for count in self.streams):
            raise ValueError(f"--streams must be positive, got {list(self.streams)}")
        if not self.sizes or any(size < 64 or size % 32 for size in self.sizes):
            raise ValueError(f"--sizes must be multiples of 32 from 64 on [px], got {list(self.sizes)}")

"""The options of ``ufmstar bench``."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

TOUR = "tour:1"
ARCHITECTURES = ("fastdepth", "monodepth2")  # can be timed with random weights


@dataclass(frozen=True, kw_only=True)
class BenchSettings:
    """Measure the time of UfM* (plain, anchored, with the posterior) and of a depth network on the same frames.

    With --weights, the network predicts the depth. Without, it has random weights, and UfM* gets the rendered depth
    with smooth errors of 3 %. Times depend on the machine and on its other load: compare ratios.
    docs/results/speed.md explains each figure.

    Attributes:
        sequence: Measure on the recording in this folder, or on tour:SEED.
        model: The network is of this kind, as for `ufmstar run`; without --weights fastdepth or monodepth2.
        weights: The file or directory of the network's weights.
        spec: This JSON file declares what the weights do not contain, as for `ufmstar run`.
        trust_code: Let an exported or torchscript file run its code; only for files whose origin you trust.
        runtime: Use torch or ONNX Runtime (auto: ONNX Runtime for weights in ONNX files).
        sizes: Without --weights, the images are squares of these sides [px], multiples of 32.
        backends: Time these implementations of the step.
        frames: Time this many frames.
        history: Pass this many frames before them.
        threads: Use this many CPU threads (default: the cores of this process).
        clock: Measure wall time, or cpu: the processor time of one thread, on a machine with other load.
        device: Run network and UfM* on cpu, cuda or cuda:N.
        json: Write the report to this file.
    """

    sequence: str = TOUR
    model: str = "fastdepth"
    weights: Path | None = None
    spec: Path | None = None
    trust_code: bool = False
    runtime: Literal["auto", "torch", "onnx"] = "auto"
    sizes: tuple[int, ...] = (224, 512)
    backends: tuple[Literal["auto", "numba", "triton", "torch"], ...] = ("auto",)
    frames: int = 40
    history: int = 60
    threads: int | None = None
    clock: Literal["wall", "cpu"] = "wall"
    device: str = "cpu"
    json: Path | None = None

    def __post_init__(self) -> None:
        if self.weights is None and self.model not in ARCHITECTURES:
            raise ValueError(f"--model {self.model} needs --weights; without, it is one of {', '.join(ARCHITECTURES)}")
        if self.clock == "cpu" and (self.device != "cpu" or self.threads != 1):
            raise ValueError("--clock cpu needs --threads 1 on the CPU: it is the time of all threads together")
        for name in ("frames", "history"):
            if getattr(self, name) < 1:
                raise ValueError(f"--{name} must be at least 1, got {getattr(self, name)}")
        if not self.sizes or any(size < 64 or size % 32 for size in self.sizes):
            raise ValueError(f"--sizes must be multiples of 32 from 64 on [px], got {list(self.sizes)}")

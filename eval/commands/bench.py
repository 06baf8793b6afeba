"""``ufmstar bench``: its options, and the printed table."""

from __future__ import annotations

import sys
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from typing import ClassVar, Literal

from ufmstar_torch.eval.commands.depth import NetworkOptions
from ufmstar_torch.eval.commands.options import File, MachineOptions, as_dict, reader, require_least
from ufmstar_torch.eval.commands.terminal import usage_errors


@dataclass(frozen=True, kw_only=True)
class BenchOptions(MachineOptions):
    """Measure the times of a network and of UfM* (alone, with corners, with the posterior) on the same frames.

    Times depend on the machine and on its other load: compare ratios. docs/results/speed.md explains each figure.

    Attributes:
        device: Run network and UfM* on cpu, cuda or cuda:N.
        threads: Use this many CPU threads (default: the cores of this process).
        sequence: Measure on the recording in this folder, or on tour:SEED.
        frames: Time this many frames.
        history: Pass this many frames before them.
        clock: Measure wall time, or cpu: the processor time of one thread, on a machine with other load.
        json: Write the results to this file.
    """

    USAGE: ClassVar[str] = "ufmstar bench --model NAME --weights FILE... [options]"

    sequence: str = "tour:1"
    frames: int = 40
    history: int = 60
    clock: Literal["wall", "cpu"] = "wall"
    json: File = None
    network: NetworkOptions

    def __post_init__(self) -> None:
        require_least(self, frames=1, history=1)
        if self.clock == "cpu" and (self.device != "cpu" or self.threads != 1):
            raise ValueError("--clock cpu needs --threads 1 on the CPU: it is the time of all threads together")
        if self.network.model is None:
            raise ValueError("the network is missing: give --model NAME --weights FILE")


read = reader(BenchOptions, "ufmstar bench")


def main(options: BenchOptions) -> int:
    """Run the benchmark, print its table and write its JSON; the exit code."""
    import torch

    from ufmstar_torch.eval.bench.benchmark import format_report, run_benchmark
    from ufmstar_torch.eval.bench.measure import Plan
    from ufmstar_torch.eval.bench.timing import most_threads
    from ufmstar_torch.eval.engine.files import write_json_atomic
    from ufmstar_torch.eval.run.machine import require_device
    from ufmstar_torch.eval.sequences import open_sequence

    options = replace(options, threads=options.threads or most_threads())
    plan = Plan(options.frames, options.history, options.threads, windows=1, clock=options.clock, samples=True)
    with usage_errors(ValueError, FileNotFoundError, ModuleNotFoundError):
        device, sequence = torch.device(require_device(options.device)), open_sequence(options.sequence)
        source = options.network.load(options)
        print(f"{source.label}, {options.history + options.frames} frames", file=sys.stderr, flush=True)
        result = run_benchmark(source, sequence, device, plan)
    print(format_report(result))
    if options.json is not None:
        about = {"schema": 3, "date": datetime.now(UTC).isoformat(timespec="seconds"), "options": as_dict(options)}
        write_json_atomic(options.json, about | result)
    return 0

"""What ``ufmstar eval --streams N`` brings: frames per second of one and of several sequences at once, in turns.

python docs/measure_streams.py --network depth_only=fastdepth:WEIGHTS --streams 1 2 4
"""

from __future__ import annotations

import argparse
import statistics
import sys
import time
from dataclasses import replace

import torch

from ufmstar_torch.eval.engine.evaluate import Judge, RowResult, SequenceTask, evaluate_sequences
from ufmstar_torch.eval.engine.load import NetworkChoice
from ufmstar_torch.eval.methods.method import Method
from ufmstar_torch.eval.methods.row import Row
from ufmstar_torch.eval.sequences.frame import FrameSequence
from ufmstar_torch.eval.tour.sequence import open_tour


def in_memory(seed: int, frames: int) -> FrameSequence:
    """A rendered tour, decoded once."""
    rendered = open_tour(f"tour:{seed}?frames={frames}")
    every = [rendered[i] for i in range(frames)]
    entries = tuple(
        replace(entry, load_image=lambda f=f: f.image, load_depth=lambda f=f: f.depth)
        for entry, f in zip(rendered.entries, every, strict=True)
    )
    return replace(rendered, entries=entries)


def main() -> int:
    """Measure, and print a table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--network", required=True, help="BASE=MODEL:FILE, as ufmstar eval")
    parser.add_argument("--row", default="UfM*-DepthOnly")
    parser.add_argument("--streams", type=int, nargs="+", default=[1, 2, 4])
    parser.add_argument("--tours", type=int, default=4)
    parser.add_argument("--frames", type=int, default=12)
    parser.add_argument("--turns", type=int, default=5)
    parser.add_argument("--device", default="cpu")
    given = parser.parse_args()
    device, choice = torch.device(given.device), NetworkChoice.parse(given.network)
    networks, rows = {choice.base: choice.load(device)}, [Row(Method.parse(given.row))]
    sequences = [in_memory(20 + n, given.frames) for n in range(given.tours)]

    def once(streams: int) -> tuple[float, float, list[RowResult]]:
        outcomes: list[RowResult] = []

        def done(_: SequenceTask, outcome: list[RowResult] | Exception) -> None:
            if isinstance(outcome, Exception):
                raise outcome
            outcomes.extend(outcome)

        wall, cpu = time.perf_counter(), time.process_time()
        tasks = [SequenceTask(sequence, rows) for sequence in sequences]
        evaluate_sequences(iter(tasks), Judge(networks, device, streams=streams), done)
        return time.perf_counter() - wall, time.process_time() - cpu, outcomes

    times: dict[int, list[tuple[float, float]]] = {n: [] for n in given.streams}
    figures: dict[int, list[dict[str, float]]] = {}
    for turn in range(given.turns + 1):
        for n in given.streams:
            wall, cpu, outcomes = once(n)
            if turn:  # the first compiles
                times[n].append((wall, cpu))
            figures[n] = [one.figures for one in outcomes]
    frames, first = given.tours * given.frames, given.streams[0]
    print("| streams | frames/s, median | most | CPU ms a frame, median | least | times as fast | RMSE [m] |")
    print("|---|---|---|---|---|---|---|")
    for n in given.streams:
        wall, cpu = zip(*times[n], strict=True)
        ratio = statistics.median(one[0] / other[0] for one, other in zip(times[first], times[n], strict=True))
        rmse = statistics.mean(sequence["rmse"] for sequence in figures[n])
        print(
            f"| {n} | {frames / statistics.median(wall):.1f} | {frames / min(wall):.1f} "
            f"| {1e3 * statistics.median(cpu) / frames:.1f} | {1e3 * min(cpu) / frames:.1f} "
            f"| {ratio:.2f} | {rmse:.4f} |"
        )
    return 0


if __name__ == "__main__":
    sys.exit(main())

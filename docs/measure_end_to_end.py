"""Frames per second and processor time from image to files: live, and ``ufmstar run`` with ground truth and without.

python docs/measure_end_to_end.py SEQUENCE WEIGHTS --threads 1
"""

from __future__ import annotations

import argparse
import tempfile
import time
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import torch

from ufmstar_torch import UncertainDepth
from ufmstar_torch.eval.commands.run import job_from, read
from ufmstar_torch.eval.engine.progress import Progress
from ufmstar_torch.eval.run.job import RunJob
from ufmstar_torch.eval.run.run import run
from ufmstar_torch.eval.sequences.images import image_tensor
from ufmstar_torch.models import Preprocess

WARM = 8  # frames before the clock counts


class Clock:
    """Wall-clock and processor time (all threads) of every frame, from its predecessor's end."""

    def __init__(self) -> None:
        self.at: list[tuple[float, float]] = []

    def tick(self) -> None:
        """A frame has ended."""
        self.at.append((time.perf_counter(), time.process_time()))

    def __str__(self) -> str:
        """Cells of a table."""
        at = np.array(self.at[WARM:])
        steps, (wall, processor) = 1000 * np.diff(at, axis=0), 1000 * (at[-1] - at[0]) / (len(at) - 1)
        return f"{1000 / wall:.1f} | {1000 / np.median(steps[:, 0]):.1f} | {processor:.1f}"


def live(job: RunJob) -> Clock:
    """``UncertainDepth`` on decoded images: network and step, nothing written."""
    preprocess = Preprocess.nyu()
    model = UncertainDepth(job.source.networks, job.config, preprocess=preprocess)
    frames, clock = [job.sequence[i] for i in job.indices], Clock()
    for frame in frames:
        model(image_tensor(frame), torch.from_numpy(frame.T_world_cam), torch.from_numpy(frame.intrinsics))
        clock.tick()
    return clock


def written(job: RunJob) -> Clock:
    """``ufmstar run`` without pictures; its last frames are through the files when the run returns."""
    clock = Clock()

    def progress(now: Progress) -> None:
        if now.stage == "frames" and now.done:
            clock.tick()

    with tempfile.TemporaryDirectory() as out:
        run(job, out, overwrite=True, progress=progress)
    return clock


def main() -> int:
    """Measure in turns, and print a table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("sequence")
    parser.add_argument("weights", help="of FastDepth")
    parser.add_argument("--threads", type=int, default=1, help="of network and step")
    parser.add_argument("--turns", type=int, default=3)
    given = parser.parse_args()
    torch.set_num_threads(given.threads)
    words = [given.sequence, "--model", "fastdepth", "--weights", given.weights, "--out", "out"]
    job = job_from(read([*words, "--no-video", "--no-sheet", "--threads", str(given.threads)]))
    blind = replace(job.sequence, entries=tuple(replace(e, load_depth=None) for e in job.sequence.entries))
    cases: dict[str, Callable[[], Clock]] = {
        "live, decoded images": lambda: live(job),
        "run, without ground truth": lambda: written(replace(job, sequence=blind)),
        "run, with ground truth": lambda: written(job),
    }
    print("| | frames/s, mean | of the median frame | processor ms a frame |")
    print("|---|---|---|---|")
    for turn in range(given.turns + 1):
        for name, measure in cases.items():
            clock = measure()
            if turn:  # the first compiles
                print(f"| {name} | {clock} |", flush=True)
    return 0


if __name__ == "__main__":
    raise SystemExit(main())

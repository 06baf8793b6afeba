"""The time of UfM* on batches of streams, as a step and as a CUDA graph: the table of docs/results/speed.md.

python docs/measure_streams.py --device cuda 1 16 256
"""

from __future__ import annotations

import argparse
import time

import numpy as np
import torch
from torch import Tensor, nn

from ufmstar_torch import UfMStar, UfMStarConfig
from ufmstar_torch.eval.engine.progress import synchronize
from ufmstar_torch.eval.sequences import open_sequence
from ufmstar_torch.runtime.capture import Captured

_SLOTS = 1024  # a CUDA graph needs a fixed capacity


def inputs(frames: int, device: torch.device) -> list[tuple[Tensor, Tensor, Tensor]]:
    """Depth [1, H, W] with smooth errors of 3 %, pose and intrinsics of each frame of a tour; cameras on the CPU."""
    rows = []
    for frame in open_sequence(f"tour:1?frames={frames}&size=224x224"):
        noise = torch.randn(1, 1, 4, 4, generator=torch.Generator().manual_seed(frame.index))
        error = nn.functional.interpolate(0.03 * noise, (224, 224), mode="bicubic", align_corners=True)[0]
        depth = (torch.from_numpy(frame.depth)[None] * (1 + error)).to(device)
        rows.append((depth, torch.from_numpy(frame.T_world_cam)[None], torch.from_numpy(frame.intrinsics)[None]))
    return rows


def copies(row: tuple[Tensor, ...], count: int) -> list[Tensor]:
    return [value.expand(count, *value.shape[1:]).contiguous() for value in row]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("streams", type=int, nargs="+", help="numbers of simultaneous streams")
    parser.add_argument("--device", type=torch.device, default=torch.device("cpu"))
    parser.add_argument("--frames", type=int, default=30, help="timed, after as many others")
    chosen = parser.parse_args()
    config = UfMStarConfig(on_bad_frame="skip", initial_capacity=_SLOTS, max_components=_SLOTS)
    rows = inputs(2 * chosen.frames, chosen.device)
    for count in chosen.streams:
        steps = {"step": UfMStar(config)}
        if chosen.device.type == "cuda":
            steps["graph"] = Captured(UfMStar(config), *copies(rows[0], count))
        times: dict[str, list[float]] = {name: [] for name in steps}
        for row in rows:
            batch = copies(row, count)
            for name, step in steps.items():
                synchronize(chosen.device)
                started = time.perf_counter()
                step(*batch)
                synchronize(chosen.device)
                times[name].append(1e3 * (time.perf_counter() - started))
        shown = ", ".join(f"{name} {np.median(ms[chosen.frames :]):.2f} ms" for name, ms in times.items())
        print(f"{count} streams at once: {shown}")


if __name__ == "__main__":
    main()

"""How long the first steps of a fresh process take, with and without compiled kernels on disk."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
import time
from typing import Any

_STEPS = 3  # the kernels of the fusion meet a mixture from the second on


def measure_compilation(size: int = 64) -> dict[str, float]:
    """Seconds of the first step in a new process: "cold_s" compiles, "warm_s" finds the compiled code on disk.

    "cold_s" and "warm_s" include the first use of torch, which "steady_s", the last step, does not.

    Raises:
        subprocess.CalledProcessError: the process failed; its messages are on standard error.
    """
    with tempfile.TemporaryDirectory() as folder:
        cold, warm = _fresh_process(size, folder), _fresh_process(size, folder)
    return {"cold_s": sum(cold[:-1]), "warm_s": sum(warm[:-1]), "steady_s": warm[-1]}


def _fresh_process(size: int, cache: str) -> list[float]:
    environment = os.environ | {"NUMBA_CACHE_DIR": cache}
    command = [sys.executable, "-m", "ufmstar_torch.eval.bench.benchmark_compile", str(size)]
    done = subprocess.run(command, env=environment, stdout=subprocess.PIPE, text=True, check=True)
    return json.loads(done.stdout)


def _first_steps(size: int) -> list[float]:
    from ufmstar_torch import UfMStar
    from ufmstar_torch.eval.bench.benchmark_frames import RenderedRoom

    ufm = UfMStar()
    seconds: list[float] = []
    for frame in RenderedRoom().frames(size, _STEPS):
        start = time.perf_counter()
        ufm(frame.depth, frame.T_world_cam, frame.intrinsics)
        seconds.append(time.perf_counter() - start)
    return seconds


def _main(arguments: list[str]) -> Any:
    print(json.dumps(_first_steps(int(arguments[0]))))


if __name__ == "__main__":
    _main(sys.argv[1:])

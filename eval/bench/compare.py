"""A benchmark beside something else: another program on the same frames, or an earlier report of the same machine."""

from __future__ import annotations

import json
import os
import resource
import shlex
import subprocess
import tempfile
import time
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from ufmstar_torch.eval.bench.frames import PosedDepth
from ufmstar_torch.eval.engine.clock import spread

FRAMES = "UFMSTAR_BENCH_FRAMES"
_RUNS = 3


def measure_peer(command: str, frames: Iterable[PosedDepth]) -> dict[str, Any]:
    """Time another program: whole processes, and, where it prints them, its frames.

    The program finds the folder of the timed frames in the environment variable ``UFMSTAR_BENCH_FRAMES``: 0000.npz,
    0001.npz, ... with depth [H, W] float32 [m], T_world_cam [4, 4] (camera-to-world) and K [3, 3] [px]. A line
    ``{"ms": 12.3}`` on its standard output is one frame's time.

    Args:
        command: with its arguments, as in a shell; no shell runs it.
        frames: what it gets.

    Returns:
        "command", "process": spread of three runs [ms] and "cpu_median_ms"; "frame": spread of the printed times [ms],
        or None.

    Raises:
        ValueError: the program failed, or cannot be started.
    """
    walls, processor, printed = [], [], []
    with tempfile.TemporaryDirectory() as folder:
        for number, frame in enumerate(frames):
            arrays = {"depth": frame.depth[0], "T_world_cam": frame.T_world_cam, "K": frame.intrinsics}
            np.savez(Path(folder, f"{number:04}.npz"), allow_pickle=False, **{k: v.numpy() for k, v in arrays.items()})
        for _ in range(_RUNS):
            before, started = resource.getrusage(resource.RUSAGE_CHILDREN), time.perf_counter()
            environment = os.environ | {FRAMES: folder}
            try:
                done = subprocess.run(
                    shlex.split(command), env=environment, stdout=subprocess.PIPE, text=True, check=True
                )
            except (OSError, ValueError, subprocess.CalledProcessError) as error:
                raise ValueError(f"--peer {command!r} failed: {error}") from error
            walls.append(1000 * (time.perf_counter() - started))
            after = resource.getrusage(resource.RUSAGE_CHILDREN)
            processor.append(1000 * (after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime))
            printed += [float(line["ms"]) for line in _json_lines(done.stdout) if "ms" in line]
    process = {**spread(walls), "cpu_median_ms": float(np.median(processor))}
    return {"command": command, "process": process, "frame": spread(printed) if printed else None}


def compare(report: Mapping[str, Any], path: Path) -> dict[str, Any]:
    """The report's times over those of an earlier one, by size, backend and name.

    The two runs were not taken in turns: a machine whose pace varies shows in "step/NETWORK" less than in times.

    Returns:
        "file", "date", and "ratios": {"224 numba": {"step": .8, "segment": ..., "step/fastdepth": ...}}.

    Raises:
        FileNotFoundError: there is no such file.
        ValueError: it is no report of the same schema, processor, number of cores and threads.
    """
    try:
        earlier = json.loads(path.read_text(encoding="utf-8"))
    except ValueError as error:
        raise ValueError(f"--against {path} is not JSON: {error}") from error
    if not isinstance(earlier, dict) or earlier.get("schema") != report["schema"]:
        raise ValueError(f"--against {path} is no report of ufmstar bench with schema {report['schema']}")
    here, there = _place(report), _place(earlier)
    if apart := [f"{name} {there[name]!r}, here {here[name]!r}" for name in here if here[name] != there[name]]:
        raise ValueError(f"--against {path} was measured on other hardware: {'; '.join(apart)}")
    now, before = (
        {f"{result['size']} {result['backend']}": _figures(result) for result in one["results"]}
        for one in (report, earlier)
    )
    ratios = {
        label: {name: value / before[label][name] for name, value in figures.items() if before[label].get(name)}
        for label, figures in now.items()
        if label in before
    }
    return {"file": path.name, "date": earlier["date"], "ratios": ratios}


def _place(report: Mapping[str, Any]) -> dict[str, Any]:
    """On what a report was measured."""
    of_machine = {name: report["hardware"][name] for name in ("cpu", "cores", "machine")}
    return {**of_machine, "threads": report["settings"]["threads"]}


def _figures(result: Mapping[str, Any]) -> dict[str, float]:
    """Medians by name: the step, its stages, and its ratios to networks."""
    stages = {name: times["median_ms"] for name, times in result["stages"].items()}
    ratios = {name: ratio["median"] for name, ratio in result["ratios"].items()}
    return {"step": result["step"]["median_ms"], **stages, **ratios}


def _json_lines(text: str) -> Iterable[dict[str, Any]]:
    for line in text.splitlines():
        if line.startswith("{"):
            try:
                value = json.loads(line)
            except ValueError:
                continue
            yield value

"""The measurement behind the paper's table of latency, power, energy and memory.

Per row: what the network spends on depth alone, what uncertainty adds to the network (a head, further members or
samples), and the multiview step. Times come from a race over the frames of one sequence (``race``), energies from
windows of the machine's own counters (``windows``), memory from the tensors that are kept (``memory``).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from functools import partial
from itertools import islice
from typing import Any

import torch

from ufmstar_torch.eval.bench.benchmark_timing import pinned_threads
from ufmstar_torch.eval.bench.contender import Contender
from ufmstar_torch.eval.bench.lines import NETWORK, network_line, row_line
from ufmstar_torch.eval.bench.multiview import Multiview, synchronize
from ufmstar_torch.eval.bench.power import CPU, GPU, PowerMeter
from ufmstar_torch.eval.bench.race import DEPTH, EVERY, MULTIVIEW, Prepared, Race, inference_of, parts_of, run_race
from ufmstar_torch.eval.bench.windows import Work, repeated, run_windows
from ufmstar_torch.eval.methods.method import ALONE
from ufmstar_torch.eval.methods.row import Row
from ufmstar_torch.eval.results.machine import available_cores, hardware, load_average, versions
from ufmstar_torch.eval.sequences.frame import Frame, FrameError, FrameSequence

FORMAT = 1


@dataclass(frozen=True)
class Plan:
    """How much is measured.

    Attributes:
        frames: of the sequence that are timed, after ``warm_up``.
        warm_up: frames before them, which are run but not counted.
        threads: of torch and numba on the CPU; None = all cores that this process may use.
        seconds: a window of energy lasts at least so long [s].
        windows: of energy per part.
        idle: for so long nothing is done, for the idle power [s].

    Raises:
        ValueError: a number out of range.
    """

    frames: int = 40
    warm_up: int = 5
    threads: int | None = None
    seconds: float = 3.0
    windows: int = 3
    idle: float = 10.0

    def __post_init__(self) -> None:
        for name, least in (("frames", 1), ("warm_up", 0), ("windows", 1)):
            value = getattr(self, name)
            if isinstance(value, bool) or not isinstance(value, int) or value < least:
                raise ValueError(f"{name} must be a whole number of at least {least}, got {value!r}")
        if self.threads is not None and (not isinstance(self.threads, int) or self.threads < 1):
            raise ValueError(f"threads must be None or at least 1, got {self.threads!r}")
        if not (self.seconds > 0 and self.idle > 0):
            raise ValueError(f"seconds and idle must be positive, got {self.seconds} and {self.idle}")


def measure(
    rows: Sequence[Row],
    networks: Mapping[str, Contender],
    sequence: FrameSequence,
    *,
    device: torch.device | str = "cpu",
    multiview_device: torch.device | str = "cpu",
    plan: Plan | None = None,
    meter: PowerMeter | None = None,
) -> dict[str, Any]:
    """Measure every row on the first frames of a sequence.

    Args:
        rows: different ones.
        networks: by base. A row whose base is missing, or has one member where it needs several, is left out and
            named in the result.
        sequence: with images.
        device: of the networks, on which they lie.
        multiview_device: of UfM and UfM*; the paper runs them on the CPU.
        plan: how much; None = the defaults.
        meter: of energy; None = what this machine has.

    Returns:
        Plain values for JSON, described in the docs. What could not be measured has the reason in place of numbers.

    Raises:
        ValueError: no row can be measured, or too few frames can be read.
    """
    plan = plan or Plan()
    device, multiview_device = torch.device(device), torch.device(multiview_device)
    left_out = {row.label: why for row in rows if (why := _obstacle(row, networks)) is not None}
    chosen = [row for row in rows if row.label not in left_out]
    if not chosen:
        raise ValueError(f"rows must hold one that can be measured: {left_out or 'none was given'}")
    frames, unreadable = _frames(sequence, plan)
    on_gpu = next((d for d in (device, multiview_device) if d.type == "cuda"), None)
    meter = meter or PowerMeter.open(None if on_gpu is None else on_gpu.index or 0)
    with pinned_threads(plan.threads or available_cores()):
        idle = meter.idle(plan.idle)
        race = run_race(
            chosen, networks, frames, warm_up=plan.warm_up, device=device, multiview_device=multiview_device
        )
        units = {DEPTH: _unit(device), NETWORK: _unit(device), MULTIVIEW: _unit(multiview_device)}
        work = _work(chosen, networks, race, device, multiview_device)
        energy = run_windows(meter, work, idle, seconds=plan.seconds, windows=plan.windows)
    used = [base for base in networks if any(row.method.base == base for row in chosen)]
    return {
        "format": FORMAT,
        "machine": {"hardware": hardware(), "versions": versions(), "load": load_average(), "gpu": _gpu(on_gpu)},
        "devices": {"networks": str(device), "multiview": str(multiview_device), "units": units},
        "plan": {**asdict(plan), "threads": plan.threads or available_cores()},
        "sequence": {"name": sequence.name, "layout": sequence.layout, "unreadable": unreadable},
        "power": {"rails": [asdict(rail) for rail in meter.rails], "missing": meter.missing, "idle_watts": idle},
        "networks": {base: network_line(networks[base], race, energy) for base in used},
        "rows": [row_line(row, networks[row.method.base], race, energy) for row in chosen],
        "left_out": left_out,
    }


def _obstacle(row: Row, networks: Mapping[str, Contender]) -> str | None:
    """Why a row cannot be measured."""
    base, setting = row.method.base, row.setting
    if base not in networks:
        return f"no network for {base}"
    if row.method.every_member and not networks[base].several:
        return f"it runs several members, {networks[base].label} has one"
    if setting.skip or setting.pose_noise:
        return "left out frames and noise on poses are no matter of efficiency"
    if setting.anchors:
        return (
            "anchors are not measured here: the benchmark times the tracker, `ufmstar eval` what UfM* takes with them"
        )
    return None


def _frames(sequence: FrameSequence, plan: Plan) -> tuple[list[Frame], int]:
    """The first frames that can be read, and how many could not.

    Raises:
        ValueError: there are too few.
    """
    broken: list[FrameError] = []
    wanted = plan.warm_up + plan.frames
    frames = list(islice(sequence.readable(broken.append), wanted))
    if len(frames) < wanted:
        raise ValueError(f"{sequence.name} has {len(frames)} readable frames, the plan needs {wanted}")
    return frames, len(broken)


def _unit(device: torch.device) -> str:
    return CPU if device.type == "cpu" else GPU


def _gpu(device: torch.device | None) -> str | None:
    return None if device is None else torch.cuda.get_device_name(device)


# ---- energy ----


def _work(
    rows: Sequence[Row],
    networks: Mapping[str, Contender],
    race: Race,
    device: torch.device,
    multiview_device: torch.device,
) -> dict[tuple[str, str], tuple[str, Work]]:
    """What a window repeats, by owner and part, on the very inputs of the race."""
    work: dict[tuple[str, str], tuple[str, Work]] = {}
    for base, prepared in race.prepared.items():
        one = networks[base]
        for part in parts_of(base, rows):
            calls = [partial(_infer, one, part, p, n) for n, p in enumerate(prepared)]
            work[base, part] = (_unit(device), repeated(calls, partial(synchronize, device)))
    for row in rows:
        if row.method.fusion != ALONE:
            inputs, judge = race.inputs[row.method.base, inference_of(row)], Multiview(row, multiview_device)
            steps = [partial(_advance, judge, n, given) for n, given in enumerate(inputs)]
            repeat = repeated(steps, partial(synchronize, multiview_device))
            work[row.label, MULTIVIEW] = (_unit(multiview_device), repeat)
    return work


def _infer(network: Contender, part: str, given: Prepared, turn: int) -> None:
    if part == DEPTH:
        network.alone(given.x, given.intrinsics)
    elif part == EVERY:
        network.every(given.x, given.intrinsics)
    else:
        network.once(given.x, turn, given.intrinsics)


def _advance(row: Multiview, number: int, given: Any) -> None:
    """A step; the first frame of the sequence begins with nothing, as it did in the race."""
    if number == 0:
        row.module.reset()
    row(given)

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

from ufmstar_torch.eval.benchmark_machine import available_cores, hardware, load_average, versions
from ufmstar_torch.eval.benchmark_timing import paired_ratio, pinned_threads, spread
from ufmstar_torch.eval.efficiency.contender import Contender
from ufmstar_torch.eval.efficiency.memory import overhead_percent
from ufmstar_torch.eval.efficiency.multiview import Multiview, synchronize
from ufmstar_torch.eval.efficiency.power import CPU, GPU, PowerMeter
from ufmstar_torch.eval.efficiency.race import DEPTH, EVERY, MULTIVIEW, ONCE, Race, parts_of, run_race
from ufmstar_torch.eval.efficiency.windows import PartEnergy, Work, repeated, run_windows
from ufmstar_torch.eval.sequences.frame import Frame, FrameError
from ufmstar_torch.eval.sequences.frame import Sequence as PosedSequence
from ufmstar_torch.eval.suite.method import ALONE, Method

FORMAT = 1
NOT_NEEDED = "the method asks nothing of the network but depth"
NETWORK = "network_uncertainty"


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
    rows: Sequence[Method],
    networks: Mapping[str, Contender],
    sequence: PosedSequence,
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
    left_out = {row.name: why for row in rows if (why := _obstacle(row, networks)) is not None}
    chosen = [row for row in rows if row.name not in left_out]
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
    used = [base for base in networks if any(row.base == base for row in chosen)]
    return {
        "format": FORMAT,
        "machine": {"hardware": hardware(), "versions": versions(), "load": load_average(), "gpu": _gpu(on_gpu)},
        "devices": {"networks": str(device), "multiview": str(multiview_device), "units": units},
        "plan": {**asdict(plan), "threads": plan.threads or available_cores()},
        "sequence": {"name": sequence.name, "layout": sequence.layout, "unreadable": unreadable},
        "power": {"rails": [asdict(rail) for rail in meter.rails], "missing": meter.missing, "idle_watts": idle},
        "networks": {base: _network(networks[base], race, energy) for base in used},
        "rows": [_row(row, networks[row.base], race, energy) for row in chosen],
        "left_out": left_out,
    }


def _obstacle(row: Method, networks: Mapping[str, Contender]) -> str | None:
    """Why a row cannot be measured."""
    if row.base not in networks:
        return f"no network for {row.base}"
    if row.every_member and not networks[row.base].several:
        return f"it runs several members, {networks[row.base].label} has one"
    return None


def _frames(sequence: PosedSequence, plan: Plan) -> tuple[list[Frame], int]:
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
    rows: Sequence[Method],
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
            calls = [partial(_infer, one, part, p.x, n) for n, p in enumerate(prepared)]
            work[base, part] = (_unit(device), repeated(calls, partial(synchronize, device)))
    for row in rows:
        if row.fusion != ALONE:
            inputs = race.inputs[row.base, EVERY if row.every_member else ONCE]
            one_row = Multiview(row, multiview_device)
            steps = [partial(_advance, one_row, n, given) for n, given in enumerate(inputs)]
            work[row.name, MULTIVIEW] = (_unit(multiview_device), repeated(steps, partial(synchronize, multiview_device)))
    return work


def _infer(network: Contender, part: str, x: torch.Tensor, turn: int) -> None:
    if part == DEPTH:
        network.alone(x)
    elif part == EVERY:
        network.every(x)
    else:
        network.once(x, turn)


def _advance(row: Multiview, number: int, given: Any) -> None:
    """A step; the first frame of the sequence begins with nothing, as it did in the race."""
    if number == 0:
        row.module.reset()
    row(given)


# ---- what is told ----

Energies = Mapping[tuple[str, str], PartEnergy]


def _network(network: Contender, race: Race, energy: Energies) -> dict[str, Any]:
    """A base's networks: what they are, and what depth alone and each form of inference take."""
    memory = network.memory()
    parts = [part for part in (DEPTH, ONCE, EVERY) if race.ms(network.base, part)]
    return {
        "label": network.label,
        "members": len(network.members),
        "passes": network.passes,
        "whole": network.why_whole,
        "memory": None if memory is None else asdict(memory),
        "latency": {part: spread(race.ms(network.base, part)) for part in parts},
        "energy": {part: energy[network.base, part].to_dict() for part in parts},
    }


def _row(row: Method, network: Contender, race: Race, energy: Energies) -> dict[str, Any]:
    """One line of the table."""
    part = EVERY if row.every_member else ONCE
    depth_ms, name = race.ms(row.base, DEPTH), row.name
    missing = _no_network_part(row, network)
    latency: dict[str, Any] = {DEPTH: spread(depth_ms)}
    ratios: dict[str, Any] = {}
    spent: dict[str, PartEnergy] = {DEPTH: energy[row.base, DEPTH]}
    if missing is None:
        added = race.added_ms(row.base, part)
        latency[NETWORK], ratios[NETWORK] = spread(added), paired_ratio(added, depth_ms)
        spent[NETWORK] = energy[row.base, part].minus(energy[row.base, DEPTH])
    else:
        latency[NETWORK] = missing
    if row.fusion != ALONE:
        own = race.ms(name, MULTIVIEW)
        latency[MULTIVIEW], ratios[MULTIVIEW] = spread(own), paired_ratio(own, depth_ms)
        spent[MULTIVIEW] = energy[name, MULTIVIEW]
    return {
        "method": name,
        "base": row.base,
        "label": network.label,
        "latency": latency,
        "ratios_to_depth": ratios,
        "stages": race.staged[name].clock.summary() if name in race.staged else None,
        "energy": {key: value.to_dict() for key, value in spent.items()} | ({} if missing is None else {NETWORK: missing}),
        "energy_overhead_percent": _energy_overhead(spent, missing),
        "memory": _memory(row, network, race),
    }


def _no_network_part(row: Method, network: Contender) -> dict[str, str] | None:
    """None, or why the network's share for uncertainty is nothing or unknown."""
    if row.base == "depth_only":
        return {"none": NOT_NEEDED}
    if network.why_whole is not None and not row.every_member:
        return {"not_separable": network.why_whole}
    return None


def _energy_overhead(spent: Mapping[str, PartEnergy], missing: Mapping[str, str] | None) -> dict[str, float] | None:
    """Share of uncertainty in all energy [%], gross and net; None unless all of it was measured."""
    if any(part.reason is not None for part in spent.values()) or (missing is not None and "none" not in missing):
        return None
    overhead: dict[str, float] = {}
    for kind, field in (("gross", "joules"), ("net", "net")):
        middle = {key: float(torch.tensor(getattr(part, field)).double().median()) for key, part in spent.items()}
        depth = middle.pop(DEPTH)
        if depth > 0 and sum(middle.values()) >= 0:
            overhead[kind] = overhead_percent(sum(middle.values()), depth)
    return overhead or None


def _memory(row: Method, network: Contender, race: Race) -> dict[str, Any]:
    """Bytes of the network for depth, of what uncertainty adds to it, and of the multiview state; the share."""
    memory = network.memory()
    state = race.multiview[row.name].memory() if row.fusion != ALONE else None
    if memory is None:
        return {"multiview": state, "not_measurable": "the weights are not torch's tensors"}
    uncertainty = memory.uncertainty + (0 if state is None else state["bytes_end"])
    return {
        "depth_bytes": memory.depth,
        "network_uncertainty_bytes": memory.uncertainty,
        "multiview": state,
        "overhead_percent": overhead_percent(uncertainty, memory.depth),
    }

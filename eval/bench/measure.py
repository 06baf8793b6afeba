"""The measurement behind the paper's table of latency, power, energy and memory.

Per row: what the network spends on depth alone, what uncertainty adds to the network (a head, further members or
samples), and the multiview step. Times come from a race over the frames of one sequence (``race``), energies from
windows of the machine's own counters (``energy``), memory from the tensors that are kept (``memory``).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from functools import partial
from itertools import islice
from typing import Any

import numpy as np
import torch

from ufmstar_torch.checked import Checked, number
from ufmstar_torch.eval.bench.energy import CPU, GPU, PartEnergy, PowerMeter, repeated, run_windows
from ufmstar_torch.eval.bench.memory import overhead_percent
from ufmstar_torch.eval.bench.networks import DEPTH, EVERY, ONCE, TimedNetwork, timed_networks
from ufmstar_torch.eval.bench.race import MULTIVIEW, PROCESSOR, WALL, Part, Race, inference_of, run_race
from ufmstar_torch.eval.bench.timing import pinned_threads
from ufmstar_torch.eval.engine.clock import paired_ratio, spread, synchronize
from ufmstar_torch.eval.methods.method import ALONE
from ufmstar_torch.eval.methods.row import Row
from ufmstar_torch.eval.run.files import write_json_atomic
from ufmstar_torch.eval.run.machine import available_cores, device_of, hardware, load_average, versions
from ufmstar_torch.eval.sequences.frame import FrameError, FrameSequence
from ufmstar_torch.eval.suite.job import EvalJob

EFFICIENCY = "efficiency.json"
FORMAT = 1
NETWORK = "network_uncertainty"
NOT_NEEDED = "the method needs only depth of the network"

Energies = Mapping[Part, PartEnergy]


@dataclass(frozen=True)
class Plan(Checked):
    """How much is measured.

    Attributes:
        frames: of the sequence that are timed, after ``warm_up``.
        warm_up: frames before them, which are run but not counted.
        threads: of torch and numba on the CPU; None = all cores that this process may use.
        seconds: a window of energy lasts at least so long [s].
        windows: of energy per part.
        idle: for so long nothing is done, for the idle power [s].
        sequences: of an evaluation that are measured, the first ones; None = all.

    Raises:
        ValueError: a number out of range.
    """

    frames: int = number(40, "", "1", 1)
    warm_up: int = number(5, "", "1", 0)
    threads: int | None = number(None, "", "1", 1)
    seconds: float = number(3.0, "", "s", 0.0, open_low=True)
    windows: int = number(3, "", "1", 1)
    idle: float = number(10.0, "", "s", 0.0, open_low=True)
    sequences: int | None = number(None, "", "1", 1)


def measure(
    rows: Sequence[Row],
    networks: Mapping[str, TimedNetwork],
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
    broken: list[FrameError] = []
    wanted = plan.warm_up + plan.frames
    frames = list(islice(sequence.readable(broken.append), wanted))
    if len(frames) < wanted:
        raise ValueError(f"{sequence.name} has {len(frames)} readable frames, the plan needs {wanted}")
    on_gpu = next((d for d in (device, multiview_device) if d.type == "cuda"), None)
    meter = meter or PowerMeter.open(None if on_gpu is None else on_gpu.index or 0)
    threads = plan.threads or available_cores()
    with pinned_threads(threads):
        idle = meter.idle(plan.idle)
        race = run_race(
            chosen, networks, frames, warm_up=plan.warm_up, device=device, multiview_device=multiview_device
        )
        work = {}
        for (owner, part), calls in race.calls.items():
            where = multiview_device if part == MULTIVIEW else device
            work[owner, part] = (_unit(where), repeated(calls, partial(synchronize, where)))
        energy = run_windows(meter, work, idle, seconds=plan.seconds, windows=plan.windows)
    units = {DEPTH: _unit(device), NETWORK: _unit(device), MULTIVIEW: _unit(multiview_device)}
    used = [base for base in networks if (base, DEPTH) in race.calls]
    gpu = None if on_gpu is None else torch.cuda.get_device_name(on_gpu)
    return {
        "format": FORMAT,
        "machine": {"hardware": hardware(), "versions": versions(), "load": load_average(), "gpu": gpu},
        "devices": {"networks": str(device), "multiview": str(multiview_device), "units": units},
        "plan": {**asdict(plan), "threads": threads},
        "sequence": {"name": sequence.name, "layout": sequence.layout, "unreadable": len(broken)},
        "power": {"rails": [asdict(rail) for rail in meter.rails], "missing": meter.missing, "idle_watts": idle},
        "networks": {base: _network_line(networks[base], race, energy) for base in used},
        "rows": [_row_line(row, networks[row.method.base], race, energy) for row in chosen],
        "left_out": left_out,
    }


def measure_job(job: EvalJob, plan: Plan | None = None) -> None:
    """Measure the rows on the sequences of an evaluation, and write their means to OUT/efficiency.json.

    UfM and UfM* run on the CPU, as the paper's do, the networks on the job's device. Of sequences with fewer frames
    than the plan has, all are taken; windows of energy are divided among the sequences, at least one for each.

    Raises:
        ValueError: no sequence can be opened, none has frames enough, or no row can be measured.
        OSError: the file cannot be written.
    """
    plan = plan or Plan()
    device = device_of(job.device, 0)
    rows, items = job.suite.rows, job.items[: plan.sequences]
    plan = replace(plan, windows=-(-plan.windows // max(1, len(items))))
    networks = timed_networks(job.load(torch.device(device)), rows)
    measured: dict[tuple[str, str], dict[str, Any]] = {}
    failed = []
    for item in items:
        try:
            sequence = item.open()
            frames = max(1, min(plan.frames, len(sequence) - plan.warm_up))
            result = measure(rows, networks, sequence, device=device, plan=replace(plan, frames=frames))
            measured[item.dataset, item.sequence] = result
        except (OSError, ValueError) as error:
            failed.append(f"{item.label}: {error}")
    if not measured:
        raise ValueError(f"no sequence can be measured: {'; '.join(failed[:3])}")
    write_json_atomic(job.out / EFFICIENCY, over_sequences(measured))


def over_sequences(measured: Mapping[tuple[str, str], Mapping[str, Any]]) -> dict[str, Any]:
    """What :func:`measure` returned for every (data set, sequence) as one: every number is the mean over the sequences,
    and "sequences" has what uncertainty costs on each of them, for intervals.

    Of each sequence and row: "energy_mj", gross, of uncertainty in the network and of the multiview step [mJ]; None
    where a part was not measured.
    """
    runs = list(measured.values())
    single = [
        {"dataset": d, "sequence": s, "energy_mj": {row["row"]: _uncertainty_mj(row["energy"]) for row in run["rows"]}}
        for (d, s), run in measured.items()
    ]
    mean: dict[str, Any] = _mean(runs)
    if len(runs) > 1:
        mean["sequence"] |= {"name": f"{len(runs)} sequences"}
    return mean | {"sequences": single}


def _uncertainty_mj(energy: Mapping[str, Mapping[str, Any]]) -> float | None:
    parts = [part for name, part in energy.items() if name != DEPTH and "none" not in part]
    if not all("gross" in part for part in parts):
        return None
    return sum(max(0.0, part["gross"]["millijoules"]) for part in parts)


def _mean(values: Sequence[Any]) -> Any:
    """The mean of equal structures of plain values; where they differ, or are no numbers, the first."""
    first = values[0]
    if isinstance(first, Mapping) and all(isinstance(v, Mapping) and v.keys() == first.keys() for v in values):
        return {name: _mean([value[name] for value in values]) for name in first}
    if isinstance(first, list) and all(isinstance(v, list) and len(v) == len(first) for v in values):
        return [_mean(parts) for parts in zip(*values, strict=True)]
    numbers = all(isinstance(v, int | float) and not isinstance(v, bool) for v in values)
    return sum(values) / len(values) if numbers and any(v != first for v in values) else first


def _obstacle(row: Row, networks: Mapping[str, TimedNetwork]) -> str | None:
    """Why a row cannot be measured."""
    base, setting = row.method.base, row.setting
    if base not in networks:
        return f"no network for {base}"
    if row.method.every_member and networks[base].passes == 1:
        return f"it runs several members, {networks[base].label} has one"
    if setting.skip or setting.pose_noise:
        return "left out frames and noise on poses are no matter of efficiency"
    if setting.anchors:
        return "anchors are not measured here: `ufmstar bench` times the tracker, `ufmstar eval` UfM* with them"
    return None


def _unit(device: torch.device) -> str:
    return CPU if device.type == "cpu" else GPU


# ---- the lines of the result ----


def _network_line(network: TimedNetwork, race: Race, energy: Energies) -> dict[str, Any]:
    """A base's networks: what they are, and what depth alone and each form of inference take."""
    parts = [part for part in (DEPTH, ONCE, EVERY) if race.ms(network.base, part)]
    return {
        "label": network.label,
        "members": len(network.members),
        "passes": network.passes,
        "whole": network.why_whole,
        "memory": network.memory(),
        "latency": {part: spread(race.ms(network.base, part)) for part in parts},
        "energy": {part: energy[network.base, part].to_dict() for part in parts},
    }


def _row_line(row: Row, network: TimedNetwork, race: Race, energy: Energies) -> dict[str, Any]:
    """One line of the table."""
    base, part, name = row.method.base, inference_of(row), row.label
    missing = _no_network_part(row, network)
    clocks = (WALL, PROCESSOR)
    depth = {clock: race.ms(base, DEPTH, clock) for clock in clocks}
    times: dict[str, dict[str, list[float]]] = {}
    energies: dict[str, PartEnergy] = {DEPTH: energy[base, DEPTH]}
    if missing is None:
        times[NETWORK] = {clock: race.added_ms(base, part, clock) for clock in clocks}
        energies[NETWORK] = energy[base, part].minus(energy[base, DEPTH])
    if row.method.fusion != ALONE:
        times[MULTIVIEW] = {clock: race.ms(name, MULTIVIEW, clock) for clock in clocks}
        energies[MULTIVIEW] = energy[name, MULTIVIEW]
    unmeasured = {} if missing is None else {NETWORK: missing}
    latency = {key: spread(ms[WALL]) for key, ms in ({DEPTH: depth} | times).items()}
    ratios = {key: {clock: paired_ratio(ms[clock], depth[clock]) for clock in clocks} for key, ms in times.items()}
    return {
        "method": row.method.name,
        "setting": row.setting.to_dict(),
        "row": name,
        "base": base,
        "network": network.label,
        "latency": latency | unmeasured,
        "ratios_to_depth": ratios,
        "stages": race.staged[name].summary(warm_up=race.warm_up) if name in race.staged else None,
        "energy": {key: value.to_dict() for key, value in energies.items()} | unmeasured,
        "energy_overhead_percent": _energy_overhead(energies, missing),
        "memory": _memory(row, network, race),
    }


def _no_network_part(row: Row, network: TimedNetwork) -> dict[str, str] | None:
    """None, or why the network's share for uncertainty is nothing or unknown."""
    if row.method.base == "depth_only":
        return {"none": NOT_NEEDED}
    if network.why_whole is not None and not row.method.every_member:
        return {"not_separable": network.why_whole}
    return None


def _energy_overhead(energies: Mapping[str, PartEnergy], missing: Mapping[str, str] | None) -> dict[str, float] | None:
    """Share of uncertainty in all energy [%], gross and net; None unless all of it was measured.

    A difference that the noise makes negative counts as nothing.
    """
    if any(part.reason is not None for part in energies.values()) or (missing is not None and "none" not in missing):
        return None
    overhead: dict[str, float] = {}
    for column, kind in enumerate(("gross", "net")):
        middle = {key: float(np.median(part.windows[:, column])) for key, part in energies.items()}
        depth = middle.pop(DEPTH)
        if depth > 0:
            overhead[kind] = overhead_percent(sum(max(0.0, value) for value in middle.values()), depth)
    return overhead or None


def _memory(row: Row, network: TimedNetwork, race: Race) -> dict[str, Any]:
    """Bytes of the network for depth, of what uncertainty adds to it, and of the multiview state; the share."""
    memory = network.memory()
    state = race.steps[row.label].memory() if row.method.fusion != ALONE else None
    if memory is None:
        return {"multiview": state, "not_measurable": "the weights are not torch's tensors"}
    uncertainty = memory["uncertainty"] + (0 if state is None else state["bytes_end"])
    return {
        "depth_bytes": memory["depth"],
        "network_uncertainty_bytes": memory["uncertainty"],
        "multiview": state,
        "overhead_percent": overhead_percent(uncertainty, memory["depth"]),
    }

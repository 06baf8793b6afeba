"""The measurement behind the paper's table 2 (latency, power, energy, memory) and its figure of the stages' shares.

Each row has three costs: the network's depth alone, the network's uncertainty (a head, further members or samples),
and the multiview step. Times come from the frames of one sequence (``parts``), energies from zeus (``energy``), memory
from the stored tensors: parameters, without buffers, and the multiview state after the last frame and in the mean.
A megabyte is 10^6 bytes, as in the paper: 100,000 points of 40 bytes are its 4.0 MB.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from itertools import chain, islice
from typing import Any

import numpy as np
import torch

from ufmstar_torch.eval.bench.energy import CPU, GPU, Energy, EnergyMeter, difference, measure_energy, summary
from ufmstar_torch.eval.bench.networks import DEPTH, EVERY, ONCE, TimedNetwork, timed_networks
from ufmstar_torch.eval.bench.parts import ANCHORS, MULTIVIEW, SAMPLE, Part, TimedParts, inference_of, time_parts
from ufmstar_torch.eval.bench.timing import CLOCKS, most_threads, paired_ratio, pinned_threads, spread
from ufmstar_torch.eval.engine.files import write_json_atomic
from ufmstar_torch.eval.engine.stream import require_camera
from ufmstar_torch.eval.methods.method import ALONE
from ufmstar_torch.eval.methods.row import Row
from ufmstar_torch.eval.run.machine import device_of, hardware, load_average, versions
from ufmstar_torch.eval.sequences.frame import Frame, FrameError, FrameSequence
from ufmstar_torch.eval.suite.job import EvalJob

EFFICIENCY = "efficiency.json"
NETWORK = "network_uncertainty"
Energies = Mapping[Part, Energy]


@dataclass(frozen=True)
class Plan:
    """The amount of measurements."""

    frames: int | None = None  # number of timed frames, after ``warm_up``; None = all that are selected
    # Number of frames before them, which are run but not counted. If all frames are timed, these are the first ones,
    # and the sequence begins again after them.
    warm_up: int = 5
    threads: int | None = None  # of torch and numba on the CPU; None = all cores that this process may use
    seconds: float = 3.0  # shortest energy window [s]
    windows: int = 3  # energy windows per part
    clock: str = "wall"  # of ``timing.CLOCKS``
    samples: bool = False  # time means over a sample of pixels, too


def measure(
    rows: Sequence[Row],
    networks: Mapping[str, TimedNetwork],
    sequence: FrameSequence,
    *,
    device: torch.device | str = "cpu",
    multiview_device: torch.device | str = "cpu",
    plan: Plan | None = None,
    meter: EnergyMeter | None = None,
    selected: slice = slice(None),
) -> dict[str, Any]:
    """Measure every row on the selected frames of a sequence with images; plain values for JSON. Unusable frames are
    left out, as in an evaluation. A row whose base has no network, or has one member where it needs several, is left
    out and named in the result.

    Args:
        rows: without duplicates.
        networks: by base.
        sequence: with images.
        device: on which the networks are.
        multiview_device: of UfM and UfM*; the paper runs them on the CPU.
        plan: amount of measurements; None = the defaults.
        meter: of energy; None = this machine's meters.
        selected: which frames of the sequence.

    Raises:
        ValueError: no row can be measured, or too few frames can be used.
    """
    plan = plan or Plan()
    plan = replace(plan, threads=plan.threads or most_threads())
    device, multiview_device = torch.device(device), torch.device(multiview_device)
    left_out = {row.label: why for row in rows if (why := _obstacle(row, networks)) is not None}
    chosen = [row for row in rows if row.label not in left_out]
    if not chosen:
        raise ValueError(f"rows must hold one that can be measured: {left_out or 'none was given'}")
    on_gpu = next((d for d in (device, multiview_device) if d.type == "cuda"), None)
    meter = meter or EnergyMeter(None if on_gpu is None else on_gpu.index or 0)
    with pinned_threads(plan.threads or 1):
        units = dict.fromkeys((DEPTH, NETWORK), _unit(device)) | dict.fromkeys(
            (MULTIVIEW, SAMPLE), _unit(multiview_device)
        )
        how: dict[str, Any] = {"device": device, "multiview_device": multiview_device, "samples": plan.samples}
        parts_measured = (DEPTH, ONCE, EVERY, MULTIVIEW, SAMPLE)
        how["metered"] = {part for part in parts_measured if units.get(part, units[NETWORK]) not in meter.missing}
        how["clock"] = CLOCKS[plan.clock]
        parts = _timed(chosen, networks, sequence, range(len(sequence))[selected], plan, how)
        work = {part: (units.get(part[1], units[NETWORK]), calls) for part, calls in parts.calls.items()}
        energy = measure_energy(meter, work, seconds=plan.seconds, windows=plan.windows)
    gpu = None if on_gpu is None else torch.cuda.get_device_name(on_gpu)
    return {
        "format": 1,
        "machine": {"hardware": hardware(), "versions": versions(), "load": load_average(), "gpu": gpu},
        "devices": {"networks": str(device), "multiview": str(multiview_device), "units": units},
        "plan": asdict(plan) | {"frames": parts.frames, "whole": plan.frames is None},
        "sequence": {"name": sequence.name, "layout": sequence.layout},
        "power": {"missing": meter.missing},
        "map": parts.size,
        "networks": {b: _network_line(networks[b], parts, energy) for b in networks if parts.ms(b, DEPTH)},
        "rows": [_row_line(row, networks[row.method.base], parts, energy) for row in chosen],
        "left_out": left_out,
    }


def _timed(
    rows: Sequence[Row],
    networks: Mapping[str, TimedNetwork],
    sequence: FrameSequence,
    indices: range,
    plan: Plan,
    how: Mapping[str, Any],
) -> TimedParts:
    """Time the parts of the rows on the frames of a plan. Raises ValueError: too few frames can be used."""

    def usable() -> Iterator[Frame]:
        return filter(_usable, sequence.readable(lambda error: None, indices))

    needed = plan.warm_up + (plan.frames or 0)
    if plan.frames is None:
        first = list(islice(usable(), plan.warm_up))
        parts = time_parts(rows, networks, chain(first, usable()), warm_up=len(first), restart=True, **how)
        needed = 1
    else:
        parts = time_parts(rows, networks, islice(usable(), needed), warm_up=plan.warm_up, **how)
        needed = plan.frames
    if parts.frames < needed:
        missing = f"{parts.frames + parts.warm_up} usable frames, the plan needs {plan.warm_up + needed}"
        raise ValueError(f"{sequence.name} has {missing}")
    return parts


def _usable(frame: Frame) -> bool:
    """True if the frame has an image, and a pose and intrinsics that UfM* can use."""
    if frame.image is None:
        return False
    try:
        require_camera(frame, frame.intrinsics, (frame.image.shape[0], frame.image.shape[1]))
    except FrameError:
        return False
    return True


def measure_job(job: EvalJob, plan: Plan | None = None) -> None:
    """Measure time, energy and memory of the rows, and write their means to OUT/efficiency.json.

    All selected frames of an evaluation's sequences are processed a second time, after the metrics. UfM and UfM* run on
    the CPU, as in the paper. The energy windows are divided among the sequences.

    Raises:
        ValueError: no sequence can be opened, none has a usable frame, or no row can be measured.
        OSError: the file cannot be written.
    """
    plan = plan or Plan()
    device, windows = device_of(job.device, 0), -(-plan.windows // max(1, len(job.items)))
    how: dict[str, Any] = {"device": device, "plan": replace(plan, windows=windows), "selected": job.frames}
    networks = timed_networks(job.load(torch.device(device)), job.suite.rows)
    measured: dict[tuple[str, str], dict[str, Any]] = {}
    failed = []
    for item in job.items:
        try:
            measured[item.dataset, item.sequence] = measure(job.suite.rows, networks, item.open(), **how)
        except (OSError, ValueError) as error:
            failed.append(f"{item.label}: {error}")
    if not measured:
        raise ValueError(f"no sequence can be measured: {'; '.join(failed[:3])}")
    write_json_atomic(job.out / EFFICIENCY, over_sequences(measured))


def over_sequences(measured: Mapping[tuple[str, str], Mapping[str, Any]]) -> dict[str, Any]:
    """Average every number of the results of :func:`measure` over sequences, by (data set, sequence), but the plan's
    frames, which are added. "sequences" has each sequence's gross energy [mJ] and memory [B], at the end, of
    uncertainty by row; None if a part was not measured."""
    runs = list(measured.values())
    single = []
    for (dataset, name), run in measured.items():
        energy, memory = {}, {}
        for row in run["rows"]:
            network, state = row["memory"].get("network_uncertainty_bytes"), row["memory"]["multiview"]
            memory[row["row"]] = None if network is None else network + (0 if state is None else state["bytes_end"])
            parts = [part for key, part in row["energy"].items() if key != DEPTH and "none" not in part]
            complete = all("gross" in part for part in parts)
            energy[row["row"]] = sum(max(0.0, p["gross"]["millijoules"]) for p in parts) if complete else None
        single.append({"dataset": dataset, "sequence": name, "energy_mj": energy, "memory_bytes": memory})
    mean: dict[str, Any] = _mean(runs)
    mean["plan"] |= {"frames": sum(run["plan"]["frames"] for run in runs)}
    if len(runs) > 1:
        mean["sequence"] |= {"name": f"{len(runs)} sequences"}
    return mean | {"sequences": single}


def _mean(values: Sequence[Any]) -> Any:
    """The mean of plain values of equal structure; the first where structures differ or values are not numbers."""
    first = values[0]
    if isinstance(first, Mapping) and all(isinstance(v, Mapping) and v.keys() == first.keys() for v in values):
        return {name: _mean([value[name] for value in values]) for name in first}
    if isinstance(first, list) and all(isinstance(v, list) and len(v) == len(first) for v in values):
        return [_mean(each) for each in zip(*values, strict=True)]
    numbers = all(isinstance(v, int | float) and not isinstance(v, bool) for v in values)
    return sum(values) / len(values) if numbers and any(v != first for v in values) else first


def _obstacle(row: Row, networks: Mapping[str, TimedNetwork]) -> str | None:
    """The reason why a row cannot be measured, or None."""
    base, setting = row.method.base, row.setting
    if base not in networks:
        return f"no network for {base}"
    if row.method.every_member and networks[base].passes == 1:
        return f"it runs several members, {networks[base].label} has one"
    if setting.skip or setting.pose_noise:
        return "skipped frames and noise on poses do not affect efficiency"
    return None if setting.anchors in ANCHORS else f"anchors of {setting.anchors!r} have no cost to measure"


def _unit(device: torch.device) -> str:
    return CPU if device.type == "cpu" else GPU


# ---- the lines of the result ----


def _network_line(network: TimedNetwork, parts: TimedParts, energy: Energies) -> dict[str, Any]:
    """A base's networks: label and members, and the cost of depth alone and of each form of inference."""
    forms = [form for form in (DEPTH, ONCE, EVERY) if parts.ms(network.base, form)]
    return {
        "label": network.label,
        "members": len(network.members),
        "passes": network.passes,
        "whole": network.why_whole,
        "memory": network.memory(),
        "latency": {form: spread(parts.ms(network.base, form)) for form in forms},
        "energy": {form: summary(energy[network.base, form]) for form in forms},
    }


def _row_line(row: Row, network: TimedNetwork, parts: TimedParts, energy: Energies) -> dict[str, Any]:
    """One line of the table."""
    base, form, name = row.method.base, inference_of(row), row.label
    unknown: dict[str, str] | None = None  # why the network's cost of uncertainty is zero or unknown
    if base == "depth_only":
        unknown = {"none": "the method needs only depth of the network"}
    elif network.why_whole is not None and not row.method.every_member:
        unknown = {"not_separable": network.why_whole}
    depth = parts.ms(base, DEPTH)
    times: dict[str, list[float]] = {}
    energies = {DEPTH: energy[base, DEPTH]}
    if unknown is None:
        times[NETWORK] = [a - b for a, b in zip(parts.ms(base, form), depth, strict=True)]
        energies[NETWORK] = difference(energy[base, form], energy[base, DEPTH])
    if row.method.fusion != ALONE:
        times[MULTIVIEW], energies[MULTIVIEW] = parts.ms(name, MULTIVIEW), energy[name, MULTIVIEW]
    words = {} if unknown is None else {NETWORK: unknown}
    return {
        "method": row.method.name,
        "setting": row.setting.to_dict(),
        "row": name,
        "base": base,
        "network": network.label,
        "latency": {part: spread(ms) for part, ms in ({DEPTH: depth} | times).items()} | words,
        "ratios_to_depth": {part: paired_ratio(ms, depth) for part, ms in times.items()},
        "stages": parts.staged[name].summary(warm_up=parts.warm_up) if name in parts.staged else None,
        "sample": _sample(parts.ms(name, SAMPLE), parts.ms(name, MULTIVIEW)),
        "energy": {part: summary(value) for part, value in energies.items()} | words,
        "energy_overhead_percent": None if "not_separable" in (unknown or {}) else _energy_overhead(energies),
        "memory": _memory(network.memory(), parts.memory.get(name)),
    }


def _sample(sample: Sequence[float], step: Sequence[float]) -> dict[str, Any] | None:
    """The time of a mean over a sample of pixels, and its ratio to a step's; None if it was not measured."""
    return {"latency": spread(sample), "ratio_to_step": paired_ratio(sample, step)} if sample else None


def overhead_percent(uncertainty: float, depth: float) -> float:
    """Share of uncertainty in the whole [%]: 100 u / (u + d), of bytes or of joules."""
    return 100 * uncertainty / (uncertainty + depth)


def _energy_overhead(energies: Mapping[str, Energy]) -> dict[str, float] | None:
    """Share of uncertainty in all energy [%], negative differences as 0; None unless every part was measured."""
    joules = {key: max(0.0, float(np.median(e[:, 0]))) for key, e in energies.items() if not isinstance(e, str)}
    depth = joules.pop(DEPTH, 0.0)
    measured = depth and len(joules) + 1 == len(energies)
    return {"gross": overhead_percent(sum(joules.values()), depth)} if measured else None


def _memory(memory: Mapping[str, int] | None, state: Mapping[str, float] | None) -> dict[str, Any]:
    """Bytes of the network's parameters for depth and for its uncertainty, of its buffers, and of the multiview state;
    the share of uncertainty, without buffers."""
    if memory is None:
        return {"multiview": state, "not_measurable": "the weights are not torch's tensors"}
    uncertainty = memory["uncertainty"] + (0 if state is None else state["bytes_end"])
    return {
        "depth_bytes": memory["depth"],
        "network_uncertainty_bytes": memory["uncertainty"],
        "buffers_bytes": memory["buffers"],
        "multiview": state,
        "overhead_percent": overhead_percent(uncertainty, memory["depth"]),
    }

"""Lines of the result: what was measured of a network and of a row, as plain values for JSON."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict
from statistics import median
from typing import Any

from ufmstar_torch.eval.bench.contender import Contender
from ufmstar_torch.eval.bench.memory import overhead_percent
from ufmstar_torch.eval.bench.race import DEPTH, EVERY, MULTIVIEW, ONCE, PROCESSOR, WALL, Race, inference_of
from ufmstar_torch.eval.bench.windows import PartEnergy
from ufmstar_torch.eval.engine.clock import paired_ratio, spread
from ufmstar_torch.eval.methods.method import ALONE
from ufmstar_torch.eval.methods.row import Row

NOT_NEEDED = "the method asks nothing of the network but depth"
NETWORK = "network_uncertainty"
CLOCKS = (WALL, PROCESSOR)

Energies = Mapping[tuple[str, str], PartEnergy]


def network_line(network: Contender, race: Race, energy: Energies) -> dict[str, Any]:
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


def row_line(row: Row, network: Contender, race: Race, energy: Energies) -> dict[str, Any]:
    """One line of the table."""
    base, part, name = row.method.base, inference_of(row), row.label
    missing = _no_network_part(row, network)
    latency: dict[str, Any] = {DEPTH: spread(race.ms(base, DEPTH))}
    ratios: dict[str, Any] = {}
    spent: dict[str, PartEnergy] = {DEPTH: energy[base, DEPTH]}
    if missing is None:
        latency[NETWORK] = spread(race.added_ms(base, part))
        ratios[NETWORK] = {c: paired_ratio(race.added_ms(base, part, c), race.ms(base, DEPTH, c)) for c in CLOCKS}
        spent[NETWORK] = energy[base, part].minus(energy[base, DEPTH])
    else:
        latency[NETWORK] = missing
    if row.method.fusion != ALONE:
        latency[MULTIVIEW] = spread(race.ms(name, MULTIVIEW))
        ratios[MULTIVIEW] = {c: paired_ratio(race.ms(name, MULTIVIEW, c), race.ms(base, DEPTH, c)) for c in CLOCKS}
        spent[MULTIVIEW] = energy[name, MULTIVIEW]
    told = {key: value.to_dict() for key, value in spent.items()} | ({} if missing is None else {NETWORK: missing})
    return {
        "method": row.method.name,
        "setting": row.setting.to_dict(),
        "row": name,
        "base": base,
        "network": network.label,
        "latency": latency,
        "ratios_to_depth": ratios,
        "stages": race.staged[name].clock.summary() if name in race.staged else None,
        "energy": told,
        "energy_overhead_percent": _energy_overhead(spent, missing),
        "memory": _memory(row, network, race),
    }


def _no_network_part(row: Row, network: Contender) -> dict[str, str] | None:
    """None, or why the network's share for uncertainty is nothing or unknown."""
    if row.method.base == "depth_only":
        return {"none": NOT_NEEDED}
    if network.why_whole is not None and not row.method.every_member:
        return {"not_separable": network.why_whole}
    return None


def _energy_overhead(spent: Mapping[str, PartEnergy], missing: Mapping[str, str] | None) -> dict[str, float] | None:
    """Share of uncertainty in all energy [%], gross and net; None unless all of it was measured.

    A difference that the noise makes negative counts as nothing.
    """
    if any(part.reason is not None for part in spent.values()) or (missing is not None and "none" not in missing):
        return None
    overhead: dict[str, float] = {}
    for kind, field in (("gross", "joules"), ("net", "net")):
        middle = {key: median(getattr(part, field)) for key, part in spent.items()}
        depth = middle.pop(DEPTH)
        if depth > 0:
            overhead[kind] = overhead_percent(sum(max(0.0, value) for value in middle.values()), depth)
    return overhead or None


def _memory(row: Row, network: Contender, race: Race) -> dict[str, Any]:
    """Bytes of the network for depth, of what uncertainty adds to it, and of the multiview state; the share."""
    memory = network.memory()
    state = race.multiview[row.label].memory() if row.method.fusion != ALONE else None
    if memory is None:
        return {"multiview": state, "not_measurable": "the weights are not torch's tensors"}
    uncertainty = memory.uncertainty + (0 if state is None else state["bytes_end"])
    return {
        "depth_bytes": memory.depth,
        "network_uncertainty_bytes": memory.uncertainty,
        "multiview": state,
        "overhead_percent": overhead_percent(uncertainty, memory.depth),
    }

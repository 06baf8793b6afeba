"""``ufmstar bench``: times UfM*, plain, anchored and with the posterior, and a network on the same frames."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import torch

from ufmstar_torch.eval.bench.measure import Plan, measure
from ufmstar_torch.eval.bench.networks import ONCE, TimedNetwork
from ufmstar_torch.eval.bench.overlap import time_overlap
from ufmstar_torch.eval.bench.parts import MULTIVIEW
from ufmstar_torch.eval.engine.predictions import DepthSource
from ufmstar_torch.eval.methods.method import BASES, Method
from ufmstar_torch.eval.methods.row import Row
from ufmstar_torch.eval.methods.setting import Setting
from ufmstar_torch.eval.sequences.frame import FrameSequence


def run_benchmark(source: DepthSource, sequence: FrameSequence, device: torch.device, plan: Plan) -> dict[str, Any]:
    """The results of ``measure`` for UfM, UfM*, UfM* with corners and the posterior with dense anchors behind the
    networks of a ``source``; with them "overlapped" (``time_overlap``), and "ratios" to compare between machines and
    versions. Raises ValueError: the sequence has too few frames."""
    base = "ensemble" if len(source.networks) > 1 else "depth_only"
    network = TimedNetwork(base, source.networks, source.label, source.passes)
    kinds: tuple[dict[str, Any], ...] = ({}, {"anchors": "corners"}, {"anchors": "dense", "posterior": True})
    rows = [Row(Method.parse(f"UfM-{BASES[base][1]}-100K"))]
    rows += [Row(Method.parse(f"UfM*-{BASES[base][1]}"), Setting(**kind)) for kind in kinds]
    result = measure(rows, {base: network}, sequence, device=device, multiview_device=device, plan=plan)
    result["overlapped"] = time_overlap(network, sequence, device=device, plan=plan)
    return result | {"ratios": _ratios(result)}


def _ratios(result: Mapping[str, Any]) -> dict[str, float]:
    """Medians of ratios within one frame."""
    ratios = {}
    for row in result["rows"][1:]:  # of UfM*
        kind = {"": "step", "corners": "step with corners", "dense": "default"}[row["setting"].get("anchors", "")]
        ratios[f"{kind} / network"] = row["ratios_to_depth"][MULTIVIEW]["median"]
        if row["sample"] is not None:
            ratios["mean of 1,000 pixels / step"] = row["sample"]["ratio_to_step"]["median"]
            ratios["check and average / step"] = row["stages"]["beyond_the_paper"]["median"]
    if result["overlapped"] is not None:
        name = "default, network and UfM* in two threads (wall time) / network"
        ratios[name] = result["overlapped"]["ratio_to_network"]["median"]
    return ratios


def format_report(result: Mapping[str, Any]) -> str:
    """The machine, and the table of the times."""
    machine, ((base, network),) = result["machine"], result["networks"].items()
    hardware, load = machine["hardware"], machine["load"]
    processor = hardware["cpu"] if machine["gpu"] is None else machine["gpu"]
    versions = ", ".join(f"{name} {value}" for name, value in machine["versions"].items() if value)
    lines = [
        f"{processor}, {hardware['cores']} cores, {result['plan']['threads']} threads; {versions}",
        f"{result['sequence']['name']}, {result['plan']['frames']} frames of {result['map']}"
        + (f"; load average {load:.1f}" if load else ""),
        f"{'[ms]':52}{'median':>9}{'IQR':>8}{'minimum':>9}{'x network':>11}{'state':>11}",
    ]
    rows = [(f"{network['label']} ({base})", network["latency"][ONCE], None, None)]
    for row in result["rows"]:
        ratio, state_bytes = row["ratios_to_depth"][MULTIVIEW]["median"], row["memory"]["multiview"]["bytes_end"]
        rows.append((row["row"], row["latency"][MULTIVIEW], ratio, state_bytes))
    for name, times, ratio, state_bytes in rows:
        tail = "" if ratio is None else f"{ratio:11.3f}{state_bytes / 1e3:8.1f} kB"
        lines.append(f"{name:52}{times['median_ms']:9.2f}{times['iqr_ms']:8.2f}{times['min_ms']:9.2f}{tail}")
    for row in result["rows"]:
        if row["stages"] is not None:
            stages = row["stages"]["stages"].items()
            lines.append(f"stages of {row['row']}: " + ", ".join(f"{n} {t['median_ms']:.2f}" for n, t in stages))
    lines.append("medians of ratios within one frame; step: UfM* alone, default: with dense anchors and the posterior")
    lines += [f"{name}: {ratio:.3f}" for name, ratio in result["ratios"].items()]
    return "\n".join(lines + [f"no energy of the {unit}: {why}" for unit, why in result["power"]["missing"].items()])

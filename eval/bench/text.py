"""The benchmark's report as text."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

_COLUMNS = ("median_ms", "iqr_ms", "min_ms", "cpu_median_ms")


def format_report(report: Mapping[str, Any]) -> str:
    """The machine, and a table per size and backend."""
    return "\n\n".join("\n".join(part) for part in (_machine(report), *map(_result, report["results"])))


def _machine(report: Mapping[str, Any]) -> list[str]:
    machine, load, compiled = report["hardware"], report["load_average"], report["compilation"]
    gpu = "" if machine["gpu"] is None else f", {machine['gpu']}"
    lines = [
        f"{machine['cpu']}{gpu}, {machine['cores']} cores, {report['settings']['threads']} threads, {machine['platform']}",
        ", ".join(f"{name} {value}" for name, value in report["versions"].items() if value),
        "load average " + ", ".join(f"{when} {x:.1f}" for when, x in load.items() if x is not None),
    ]
    if load["before"] is not None and load["before"] > machine["cores"] / 2:
        lines.append("the machine was busy: compare ratios, minima and processor times, not medians")
    if compiled is not None:
        lines.append(f"warm_up of a process: {compiled['cold_s']:.1f} s compiling, {compiled['warm_s']:.1f} s later")
    return lines


def _result(result: Mapping[str, Any]) -> list[str]:
    height, width = result["size"]
    state = next(iter(result["memory"].values()))
    anchors = "" if result["anchors"] is None else f", {result['anchors']} anchors"
    lines = [
        f"{width} x {height}, backend {result['backend']}, {result['frames']} frames: {state['components']} components, "
        f"{result['segments']} segments{anchors}",
        f"  {'[ms]':24}{'median':>9}{'IQR':>9}{'minimum':>9}{'CPU':>9}{'x network':>11}",
    ]
    for name, times in result["rows"].items():
        ratio = result["ratios"].get(name)
        cells = "".join(f"{times[column]:9.2f}" for column in _COLUMNS)
        lines.append(f"  {name:24}{cells}" + ("" if ratio is None else f"{ratio['median']:11.3f}"))
    stages = ", ".join(f"{name} {times['median_ms']:.2f}" for name, times in result["stages"].items())
    lines.append(f"  stages of UfM* [ms]: {stages}")
    lines += [
        f"  state of {name}: {memory['components']} components of {memory['bytes_per_component']} B = "
        f"{memory['in_use'] / 1e3:.1f} kB, moving average {memory['moving_average'] / 1e3:.1f} kB"
        for name, memory in result["memory"].items()
    ]
    return lines

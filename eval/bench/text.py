"""The benchmark's report as text."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from ufmstar_torch.eval.bench.device import device_text
from ufmstar_torch.eval.bench.timing import STAGES

_SPREAD = ("median_ms", "iqr_ms", "min_ms", "cpu_median_ms")
_FIGURES = ("median_ms", "p90_ms", "mean_ms", "min_ms")
_CPU = tuple(f"cpu_{name}" for name in _FIGURES)


def format_report(report: Mapping[str, Any]) -> str:
    """A table per size and backend, the long run, and the targets."""
    parts = [_machine(report), *map(_result, report["results"]), *map(_long_run, report["growth"])]
    single = {"anchors": _anchors, "device": device_text, "peer": _peer, "against": _against, "rates": _rates}
    parts += [lines(report[name]) for name, lines in single.items() if report[name] is not None]
    if report["device"] is None:
        parts.append(_targets(report["targets"]))
    return "\n\n".join(map("\n".join, parts))


def _machine(report: Mapping[str, Any]) -> list[str]:
    machine, load, c = report["hardware"], report["load_average"], report["compilation"]
    lines = [
        f"{machine['cpu']}, {machine['cores']} cores, {report['settings']['threads']} threads, {machine['platform']}",
        ", ".join(f"{name} {value}" for name, value in report["versions"].items() if value),
        f"load average {_number(load['before'])} before, {_number(load['after'])} after",
    ]
    if load["before"] is not None and load["before"] > machine["cores"] / 2:
        lines.append("the machine was busy: compare ratios, minima and processor times, not medians")
    if c is not None:
        lines.append(f"first steps of a process: {c['cold_s']:.1f} s compiling, {c['warm_s']:.1f} s with compiled code")
    return lines


def _result(result: Mapping[str, Any]) -> list[str]:
    counts, memory = result["counts"], result["memory"]
    lines = [
        f"{result['size']} x {result['size']}, backend {result['backend']}, {result['frames']['timed']} frames: "
        f"{counts['in_view']['median']:.0f} components in view ({counts['in_view']['min']:.0f} to "
        f"{counts['in_view']['max']:.0f}), {counts['components']['max']:.0f} in total, "
        f"{counts['segments']['median']:.0f} segments per frame",
        f"  {'[ms]':24}{'median':>9}{'IQR':>9}{'minimum':>9}{'CPU':>9}",
        _row("whole step", result["step"]),
        *(_row(f"  {n}", result["stages"][n]) + f"   floor {result['floors'][n]['ms']:.3f}" for n in STAGES),
        _row("  sum of stages", result["stages_total"]),
        *(_row(f"  kernel {name}", times) for name, times in result["kernels"].items()),
        _row(f"mean of {result['mean_uncertainty']['pixels']} pixels", result["mean_uncertainty"]),
        *([] if result["ufm"] is None else [_row(f"UfM, {result['ufm']['points']} points", result["ufm"])]),
        *(_row(f"{name} forward", t) + _runtime(result, name) for name, t in result["networks"].items()),
    ]
    ratios = (
        f"{name} {r['median']:.3f} ({r['q1']:.3f} to {r['q3']:.3f}; CPU {r['cpu_median']:.3f})"
        for name, r in result["ratios"].items()
    )
    lines.append("  ratios, median and quartiles: " + "; ".join(ratios))
    fresh = result["allocations"]
    lines.append(
        f"  fresh memory of a step: {fresh['page_faults']} page faults, "
        f"Python and NumPy {fresh['python_peak'] / 1e3:.0f} kB"
    )
    lines.append(
        f"  memory: {memory['components']} components of {memory['bytes_per_component']} B = "
        f"{memory['in_use'] / 1e3:.1f} kB in use, {memory['allocated'] / 1e3:.1f} kB allocated, "
        f"moving average {memory['moving_average'] / 1e3:.1f} kB"
    )
    return lines


def _runtime(result: Mapping[str, Any], network: str) -> str:
    """Runtime and version of a network, and the least time of the other one."""
    about = result["networks_about"][network]
    others = {"onnx": "onnxruntime", "torch": "torch"}
    slower = [f"{others[n]} {ms:.1f}" for n, ms in about["runtimes"].items() if others[n] != about["runtime"]]
    beside = f" (minimum in {slower[0]})" if slower else ""
    return f"   {about['runtime']} {about['version']}, {about['threads']} threads{beside}"


def _peer(peer: Mapping[str, Any]) -> list[str]:
    frame = peer["frame"]
    own = "it prints no times of frames" if frame is None else f"a frame {frame['median_ms']:.2f} ms ({frame['count']})"
    process = peer["process"]
    return [
        f"peer {peer['command']}: a process {process['median_ms']:.0f} ms (CPU {process['cpu_median_ms']:.0f}), {own}",
    ]


def _against(against: Mapping[str, Any]) -> list[str]:
    lines = [f"times over those of {against['file']} of {against['date']}"]
    for label, ratios in against["ratios"].items():
        lines.append(f"  {label}: " + ", ".join(f"{name} {ratio:.2f}" for name, ratio in ratios.items()))
    return lines


def _long_run(run: Mapping[str, Any]) -> list[str]:
    lines = [
        f"long run, {run['world']}, {run['size']} x {run['size']}, {run['frames']} frames, merge {run['merge']:g}, at "
        f"most {run['max_components'] or 'all'} components in memory: "
        f"last steps / early ones = {run['ratio']:.2f} (CPU {run['cpu_ratio']:.2f}), "
        f"{run['memory']['in_use'] / 1e3:.1f} kB in use, {run['memory']['packed'] / 1e3:.1f} kB packed",
        f"  {'frames':>12}{'step [ms]':>11}{'CPU [ms]':>10}{'memory':>8}{'out':>8}{'read':>6}{'in view':>9}"
        f"{'segments':>10}{'new':>7}",
    ]
    for row in run["rows"]:
        low, high = row["frames"]
        lines.append(
            f"  {f'{low}-{high}':>12}{row['step_median_ms']:11.2f}{row['step_cpu_median_ms']:10.2f}"
            f"{row['components']:8d}{row['out']:8d}{row['pages_read']:6d}{row['in_view_mean']:9.0f}"
            f"{row['segments_mean']:10.1f}{row['new_mean']:7.2f}"
        )
    return lines


def _anchors(measured: Mapping[str, Any]) -> list[str]:
    tracker, step, (height, width) = measured["tracker"], measured["step"], measured["tour"]["size"]
    followed, ratio, extra = tracker["followed"], step["ratio"], step["extra_bytes"]
    rows = {
        "tracker, a frame": tracker["update"],
        **{f"  {name}": times for name, times in tracker["parts"].items()},
        "step without anchors": step["plain"],
        "step with anchors": step["anchored"],
        "  and posterior": step["posterior"],
    }
    return [
        f"anchors, one thread: {followed['mean']:.0f} corners followed at {width} x {height} ({followed['min']:.0f} to "
        f"{followed['max']:.0f}), {tracker['landmarks']['mean']:.0f} of them triangulated, new ones found in "
        f"{tracker['refills']:.0%} of {measured['frames']} frames",
        f"  {'[ms]':24}{'median':>9}{'90 %':>9}{'mean':>9}{'minimum':>9}{'CPU:':>6}{'median':>9}{'90 %':>9}{'mean':>9}"
        f"{'minimum':>9}",
        *(_row(name, times, _FIGURES) + " " * 6 + _cells(times, _CPU) for name, times in rows.items()),
        f"  step of {step['size']} x {step['size']} with {step['anchors']} anchors ({step['used']['mean']:.0f} used) / "
        f"without: {ratio['median']:.2f} ({ratio['q1']:.2f} to {ratio['q3']:.2f}; CPU {ratio['cpu_median']:.2f}); "
        f"{extra['total'] / 1e3:.1f} kB more state ({extra['per_slot']} B a component), "
        f"tracker {tracker['state_bytes'] / 1e3:.0f} kB",
    ]


def _rates(rates: Mapping[str, float]) -> list[str]:
    return [
        f"floors: memory traffic over {rates['bytes_per_second'] / 1e9:.1f} GB/s of a copy, arithmetic over "
        f"{rates['flops_per_second'] / 1e9:.0f} Gflop/s of a matrix product",
    ]


def _targets(targets: Sequence[Mapping[str, Any]]) -> list[str]:
    lines = [f"{'target (for information)':26}{'value':>12}{'target':>12}"]
    for row in targets:
        verdict = {None: "not measured", True: "met", False: "missed"}[row["met"]]
        lines.append(f"{row['name']:26}{_number(row['value']):>12}{_number(row['target']):>12}  {verdict}")
    return lines


def _row(name: str, times: Mapping[str, Any], columns: Sequence[str] = _SPREAD) -> str:
    return f"  {name:24}" + _cells(times, columns)


def _cells(times: Mapping[str, Any], columns: Sequence[str]) -> str:
    return "".join(f"{times[column]:9.2f}" for column in columns if column in times)


def _number(value: float | None) -> str:
    return "-" if value is None else f"{value:.4g}"

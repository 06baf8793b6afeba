"""Text for the terminal: results of a run, an evaluation and a report, and real-time figures."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from ufmstar_torch.eval.engine.judge import POSTERIOR
from ufmstar_torch.eval.report.data import Results
from ufmstar_torch.eval.report.quantities import count
from ufmstar_torch.eval.report.table import aligned
from ufmstar_torch.eval.report.tables import main_table
from ufmstar_torch.eval.report.write import Report
from ufmstar_torch.eval.run.run_folder import NEAR_ZERO

# [nats] A larger mean NLL is dominated by a few pixels: sigma = .25 d in a room gives about 1.
NLL_OF_FEW = 100.0
_RUN_COLUMNS = {
    "delta1": "delta1", "abs_rel": "AbsRel", "rmse": "RMSE [m]", "nll": "NLL", "ece_delta": "ECE_delta",
    "ece_q": "ECE_q", "spearman": "Spearman",
}  # fmt: skip
_OFF = 1.1  # ratio of depths from which an error matters
_CALIBRATED = 4.0  # largest mean z^2 of held-out anchors, and inverse of the smallest: sigma is right within a factor 2
_UNVERIFIED = "mean sigma not shown: nothing here can verify it"
# By source of anchors, the names of the count of anchors with a depth and of the total.
_FOUND = {
    "corners": ("triangulated", "tracked"),
    "landmarks": ("in view", "in the map"),
    "dense": ("with a depth", "searched or seen again"),
}


def summary(results: Results) -> str:
    """The main table of an evaluation, failed and missing sequences, and notes."""
    shown = [None] if None in results.tabulated else results.tabulated
    parts = [main_table(results, dataset).text() for dataset in shown]
    if results.failed:
        parts.append("\n".join(["failed:", *(f"  {', '.join(key)}: {why}" for key, why in results.failed.items())]))
    if results.missing:
        counts = Counter((dataset, sequence) for dataset, sequence, _ in results.missing)
        lines = [f"  {dataset}, {sequence}: {rows} row(s)" for (dataset, sequence), rows in counts.items()]
        title = f"not evaluated yet: {count(len(lines), 'sequence')} (the same command goes on):"
        parts.append("\n".join([title, *lines[:10]]))
    parts += [f"note: {note}" for note in results.notes]
    return "\n".join(parts)


def written(out: Path, report: Report) -> str:
    """The names of files in a folder, the numbers of files in its subfolders, and the figures that failed."""
    folders = Counter(file.parent for file in report.files if file.parent != out)
    names = [file.name for file in report.files if file.parent == out]
    names += [f"{folder.name}/ ({count} files)" for folder, count in folders.items()]
    undrawn = [f"figure not drawn: {name}: {reason}" for name, reason in report.undrawn.items()]
    return "\n".join([*undrawn, f"{out}: {', '.join(names)}"])


def run_table(summary: Mapping[str, Any]) -> str:
    """The table that ``ufmstar run`` prints: methods by metrics, and the figures of the run."""
    uncertainty, mixture, time = summary["uncertainty"], summary["mixture"], summary["time"]
    lines = _metric_lines(summary)
    if uncertainty["unmeasured_share"]:
        lines.append(_unmeasured_line(summary))
    if summary["anchors"] is not None:
        lines += _anchor_lines(summary)
    stages = ", ".join(f"{s} {ms:.1f}" for s, ms in time["median_ms"].items() if ms is not None)
    rate = time["frames_per_second"]
    lines += [
        f"{mixture['components']} components in {mixture['bytes_in_use'] / 1000:.1f} kB "
        f"({mixture['bytes_allocated'] / 1000:.1f} kB allocated), mean disagreement "
        f"{number(uncertainty['mean_disagreement'])} m^2",
        f"{summary['frames']['done']} frames{f' at {rate:.1f} per second' if rate else ''}; median ms: {stages}",
    ]
    lines += [f"skipped {count}: {reason}" for reason, count in summary["frames"]["skipped"].items()]
    lines += [f"left out {count}: {reason}" for reason, count in summary["sequence"]["left_out"].items()]
    if (fit := summary["image_fit"]) is not None and not fit["problem"]:
        lines.append(f"poses disagree with the images by {fit['error']:.1f} px (limit: {fit['limit']:.1f})")
    if (depth := summary["depth_fit"]) is not None and not depth["problem"]:
        lines.append(_depth_line(depth, summary))
    return "\n".join([*lines, *(f"warning: {text}" for text in summary["warnings"])])


def _unmeasured_line(summary: Mapping[str, Any]) -> str:
    """The share of pixels without two views to compare, and what UfM* assumes there."""
    ufm = summary["settings"].get("set", {})
    assumed = {
        "relative": f"is assumed, {ufm.get('unmeasured_relative', math.nan):.0%} of the depth",
        "paper": "is assumed to be 0, as in the paper",
        "nan": "is not known",
    }.get(ufm.get("unmeasured", ""), "is assumed")
    of_ufm = "sigma of UfM*" if "ufm" in summary else "sigma"
    return f"{summary['uncertainty']['unmeasured_share']:.0%} of the pixels were seen once; their {of_ufm} {assumed}"


def _depth_line(depth: Mapping[str, Any], summary: Mapping[str, Any]) -> str:
    """The predicted depth compared with that of tracked corners, and what follows for the run's depth and sigma."""
    line = f"the predicted depth is {depth['ratio']:.2g} times that of tracked corners, rank correlation "
    line += f"{depth['order']:.2f}"
    if max(depth["ratio"], 1 / depth["ratio"]) < _OFF:
        return line
    if summary["result"] == POSTERIOR:
        return f"{line}: the posterior corrects it"
    if summary["anchors"] is not None:
        return f"{line}: --plain adds this error to sigma, and does not correct the depth"
    return f"{line}: sigma lacks this error, which all views share; without --plain, the posterior corrects it"


def _metric_lines(summary: Mapping[str, Any]) -> list[str]:
    """Methods by metrics, or why there are none."""
    uncertainty, metrics, alone = summary["uncertainty"], summary["metrics"], summary["network_alone"]
    if metrics is None:
        remedy = "" if "ufm" in summary else "; leave --plain out"
        sigma = f"mean sigma {number(uncertainty['mean_sigma'])} m" if supported(summary) else _UNVERIFIED + remedy
        return [f"no metrics: {summary['metrics_reason']}; {sigma}"]
    ufm = "UfM*" if summary["anchors"] is None else "UfM*, anchored"
    if "ufm" in summary:
        before = summary["ufm"]
        rows = [("posterior", metrics, uncertainty["mean_sigma"]), (ufm, before["metrics"], before["mean_sigma"])]
    else:
        rows = [(ufm, metrics, uncertainty["mean_sigma"])]
    if alone is not None:
        rows.append(("network alone", alone, uncertainty["mean_network_sigma"]))
    shown = next((figures for _, figures, _ in rows if (figures or {}).get("coverage_90") is not None), None)
    body = [[name, *(number(figures.get(key)) for key in _RUN_COLUMNS), number(sigma)] for name, figures, sigma in rows]
    lines = aligned([["", *_RUN_COLUMNS.values(), "sigma [m]"], *body])
    if alone is None:
        lines.append(f"network alone: no row, {summary['network_alone_reason']}")
    if shown is not None:
        found = ", ".join(f"{shown[f'coverage_{level}']:.0%}" for level in (50, 90, 99))
        lines.append(f"intervals of 50, 90 and 99 % hold {found} of the pixels with truth")
    if (metrics["nll"] or 0) > NLL_OF_FEW:
        lines.append(
            f"NLL: dominated by the {uncertainty['near_zero_share']:.2%} of the pixels with a sigma between "
            f"0 and {1000 * NEAR_ZERO:g} mm; --set variance_floor=1e-4 bounds what they cost"
        )
    return lines


def supported(summary: Mapping[str, Any]) -> bool:
    """True if the errors at held-out anchors agree with the posterior's sigma within a factor of two."""
    calibration = (summary.get("posterior") or {}).get("calibration")
    return calibration is not None and 1 / _CALIBRATED < calibration < _CALIBRATED


def _anchor_lines(summary: Mapping[str, Any]) -> list[str]:
    """A line on the effect of anchors, and one on the frames without anchors."""
    anchors, frames, kind = summary["anchors"], summary["frames"]["done"], summary["source"]["anchors"]
    used, actual, tracked = (anchors[f"{key}_per_frame"] for key in ("used", "found", "tracked"))
    line = f"anchors: {used:.1f} used a frame, of {actual:.1f} {_FOUND[kind][0]} and {tracked:.1f} {_FOUND[kind][1]}"
    if used and anchors["mean_bias"] is not None and supported(summary):
        way = "nearer" if anchors["mean_bias"] < 0 else "farther"
        expected = f"{abs(anchors['mean_bias']):.0%} {way} than predicted"
        line += f"; mean B {number(anchors['mean_anchored'])} m^2, true depth expected {expected}"
    if (confident := anchors.get("frames_with_confidence")) is not None:
        line += f"; confidence: used in {confident} frames, in the others ignored"
    without, before = anchors["frames_without"], anchors["frames_before_the_first"]
    if not without:
        return [line]
    why = "; ".join(f"{count} x {reason}" for reason, count in without.items())
    later = sum(without.values()) - before
    rest = f"without anchors: {before + later} of {frames} frames ({why})"
    first = "the network's depth with a large sigma" if summary.get("result") == "posterior" else "plain UfM*"
    rest += f"; {before} before the first anchors: {first}" if before else ""
    return [line, rest + (f"; {later} later: with what was learnt before" if later else "")]


def realtime_table(summary: Mapping[str, Any]) -> str:
    """Times, drops and memory of ``RealTime.summary``."""

    def ms(name: str) -> list[str]:
        times = summary[name] or {}
        return [number(times.get(quantile)) for quantile in ("p50", "p99", "max")]

    rows = [["[ms]", "p50", "p99", "max"], ["image to variance", *ms("latency_ms")]]
    rows += [["  network, with its input", *ms("network_ms")], ["  UfM*", *ms("ours_ms")]]
    rows += [["processor time of the thread", *ms("processor_ms")]]
    counts = [f"{summary['results']} of {summary['images']} images in {summary['seconds']:.1f} s"]
    counts += [
        f"{count} without a result ({reason})" for reason, count in (summary["dropped"] | summary["skipped"]).items()
    ]
    counts += [f"{summary['restarts']} restarts of the anchors' evidence"] if summary["restarts"] else []
    lost, ours = (None if summary[name] is None else 100 * summary[name] for name in ("lost_share", "ours_share"))
    memory = ("memory", summary["memory_bytes"]), ("growth", summary["memory_growth_bytes"])
    megabytes = [f"{name} {value / 1e6:.1f} MB" for name, value in memory if value is not None]
    return "\n".join(
        [
            *aligned(rows),
            f"{'; '.join(counts)}: {number(lost)} % dropped or skipped, {number(summary['per_second'])} per second",
            "; ".join([f"UfM*'s share of the time: {number(ours)} %", *megabytes]),
        ]
    )


def number(value: float | None) -> str:
    """Three digits, a dash for no value."""
    return "-" if value is None or math.isnan(value) else f"{value:.3g}"

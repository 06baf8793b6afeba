"""Results as text for the terminal: the table of ``ufmstar run``, and what every such table is made of."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

from ufmstar_torch.eval.results.summary import NEAR_ZERO

# [nats] Above it, the mean NLL is decided by a few pixels with almost no variance.
_NLL_DOMINATED = 100.0
_COLUMNS = {
    "delta1": "delta1",
    "abs_rel": "AbsRel",
    "rmse": "RMSE [m]",
    "nll": "NLL",
    "ece_delta": "ECE_delta",
    "ece_q": "ECE_q",
    "spearman": "Spearman",
}


def table(summary: Mapping[str, Any]) -> str:
    """A few lines for the terminal: methods by metrics, and the figures of the run."""
    lines = []
    uncertainty = summary["uncertainty"]
    if summary["metrics"] is not None:
        name = "UfM*" if summary["anchors"] is None else "UfM*, anchored"
        rows = [(name, summary["metrics"], uncertainty["mean_sigma"])]
        if summary["network_alone"] is not None:
            rows.append(("network alone", summary["network_alone"], uncertainty["mean_network_sigma"]))
        head = ["", *_COLUMNS.values(), "sigma [m]"]
        body = [[name, *(number(figures.get(key)) for key in _COLUMNS), number(sigma)] for name, figures, sigma in rows]
        lines += aligned([head, *body])
        if summary["network_alone"] is None:
            lines.append(f"network alone: no row, {summary['network_alone_reason']}")
        if (summary["metrics"]["nll"] or 0) > _NLL_DOMINATED:
            lines.append(
                f"NLL: dominated by the {uncertainty['near_zero_share']:.2%} of the pixels with a sigma between "
                f"0 and {1000 * NEAR_ZERO:g} mm; --ufm.variance_floor 1e-4 bounds what they cost"
            )
    else:
        sigma = number(uncertainty["mean_sigma"])
        lines.append(f"no metrics: {summary['metrics_reason']}; mean sigma {sigma} m")
    mixture, time = summary["mixture"], summary["time"]
    stages = ", ".join(f"{s} {ms:.1f}" for s, ms in time["median_ms"].items() if ms is not None)
    rate = time["frames_per_second"]
    lines += [] if summary["anchors"] is None else _anchor_lines(summary["anchors"], summary["frames"]["done"])
    lines += [
        f"K = {mixture['components']} components in {mixture['bytes_in_use'] / 1000:.1f} kB "
        f"({mixture['bytes_allocated'] / 1000:.1f} kB allocated), mean disagreement "
        f"{number(uncertainty['mean_disagreement'])} m^2",
        f"{summary['frames']['done']} frames{f' at {rate:.1f} per second' if rate else ''}; median ms: {stages}",
    ]
    lines += [f"skipped {count}: {reason}" for reason, count in summary["frames"]["skipped"].items()]
    lines += [f"left out {count}: {reason}" for reason, count in summary["sequence"]["left_out"].items()]
    return "\n".join(lines)


def _anchor_lines(anchors: Mapping[str, Any], frames: int) -> list[str]:
    """A line on the effect of anchors, and one on the frames that had none."""
    used, found, tracked = (anchors[f"{key}_per_frame"] for key in ("used", "found", "tracked"))
    line = f"anchors: {used:.1f} used a frame, of {found:.1f} triangulated and {tracked:.1f} tracked"
    if used and anchors["mean_bias"] is not None:
        way = "nearer" if anchors["mean_bias"] < 0 else "farther"
        expected = f"{abs(anchors['mean_bias']):.0%} {way} than predicted"
        line += f"; mean B {number(anchors['mean_anchored'])} m^2, true depth expected {expected}"
    without, before = anchors["frames_without"], anchors["frames_before_the_first"]
    if not without:
        return [line]
    why = "; ".join(f"{count} x {reason}" for reason, count in without.items())
    later = sum(without.values()) - before
    rest = f"without anchors: {before + later} of {frames} frames ({why})"
    rest += f"; {before} before the first anchors: plain UfM*" if before else ""
    return [line, rest + (f"; {later} later: with what was learnt before" if later else "")]


def number(value: float | None) -> str:
    """Three digits, a dash for no value."""
    return "-" if value is None or math.isnan(value) else f"{value:.3g}"


def aligned(rows: Sequence[Sequence[str]]) -> list[str]:
    """Lines of a table: the first column to the left, the others to the right."""
    widths = [max(len(row[column]) for row in rows) for column in range(len(rows[0]))]
    return [
        "  ".join(cell.rjust(w) if i else cell.ljust(w) for i, (cell, w) in enumerate(zip(row, widths, strict=True)))
        for row in rows
    ]

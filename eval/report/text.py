"""Text for the terminal: what an evaluation, a report and the demo print at their end."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from ufmstar_torch.eval.methods.method import UFM, UFM_STAR
from ufmstar_torch.eval.report.data import Results
from ufmstar_torch.eval.report.outputs import CURVES, ELLIPSOIDS, ENSEMBLE, NETWORK, PLY, SHEET
from ufmstar_torch.eval.report.table import markdown
from ufmstar_torch.eval.report.tables import main_table
from ufmstar_torch.eval.report.write import Report
from ufmstar_torch.eval.results.summary import aligned, number

_DEMO_COLUMNS = {
    "delta1": "delta1",
    "nll": "NLL",
    "ece_delta": "ECE_delta",
    "ece_q": "ECE_q",
    "ause_rmse": "AUSE [m]",
}


def summary(results: Results) -> str:
    """The main table of an evaluation, failed and missing sequences, and notes."""
    parts = [markdown(main_table(results))]
    if results.failed:
        parts.append("failed:\n" + "\n".join(f"  {f.dataset}, {f.sequence}: {f.reason}" for f in results.failed))
    if results.missing:
        counts = Counter((dataset, sequence) for dataset, sequence, _ in results.missing)
        lines = [f"  {dataset}, {sequence}: {rows} row(s)" for (dataset, sequence), rows in counts.items()]
        more = [f"  and {len(lines) - 10} more sequences"] if len(lines) > 10 else []
        parts.append("\n".join(["not evaluated yet (`ufmstar eval ... --resume` goes on):", *lines[:10], *more]))
    parts += [f"note: {note}" for note in results.notes]
    return "\n".join(parts)


def written(out: Path, report: Report) -> str:
    """The files of a folder by name, those of its subfolders by number, and the figures that could not be drawn."""
    folders = Counter(file.parent for file in report.files if file.parent != out)
    names = [file.name for file in report.files if file.parent == out]
    names += [f"{folder.name}/ ({count} files)" for folder, count in folders.items()]
    undrawn = [f"figure not drawn: {name}: {reason}" for name, reason in report.undrawn.items()]
    return "\n".join([*undrawn, f"{out}: {', '.join(names)}"])


def demo_names(members: int) -> dict[str, str]:
    """The names of the demo's methods."""
    alone = "network alone" if members == 1 else f"{members} members in turn, alone"
    inferences = f"all {members} members per image"
    return {NETWORK: alone, UFM: "  with UfM", UFM_STAR: "  with UfM*", ENSEMBLE: inferences}


def demo_table(summary: Mapping[str, Any]) -> str:
    """Methods by metrics, time and memory; below it, RMSE and root mean square sigma by kind of room.

    Where these two are equal, sigma is right on average.
    """
    names, methods, kinds = demo_names(summary["network"]["members"]), summary["methods"], summary["surfaces"]
    body = [
        [
            names[method],
            *(number(row["figures"][key]) for key in _DEMO_COLUMNS),
            f"{row['network_ms']:.1f}",
            f"{row['uncertainty_ms']:.1f}" if row["uncertainty_ms"] is not None else "-",
            f"{row['state_bytes'] / 1000:.1f}",
        ]
        for method, row in methods.items()
    ]
    rooms = [
        [names[method], *(number(kinds[kind][method][key]) for kind in kinds for key in ("rmse", "rms_sigma"))]
        for method in methods
    ]
    room_head = [f"{kind}: {figure}" for kind in kinds for figure in ("RMSE [m]", "sigma [m]")]
    head = ["", *_DEMO_COLUMNS.values(), "network ms", "+ ms", "state kB"]
    return "\n".join([*aligned([head, *body]), "", *aligned([["", *room_head], *rooms])])


def demo_explanation(summary: Mapping[str, Any]) -> str:
    """The demo's output files and how to read them, in a few lines."""
    out, outputs = summary["out"], summary["outputs"]
    seen, unseen = summary["surfaces"]
    lines = [
        f"The networks were trained on rooms like the {seen} ones, never on one like the {unseen} one.",
        "Better: a high delta1, a low NLL, ECE and AUSE, and a sigma that equals the RMSE beside it.",
    ]
    hints = {
        SHEET: f"the last three columns share a scale: does sigma glow where the error does? {unseen} rooms below",
        CURVES: "nearer to the diagonal is better; on the left, below it a method claims too much",
        PLY: f"what UfM* remembers, brighter = views disagree more; for splat viewers ({ELLIPSOIDS}: MeshLab, Blender)",
    }
    lines += [f"{out}/{name}: {hint}" for name, hint in hints.items() if outputs[name] is None]
    lines += [f"no {name}: {reason}" for name, reason in outputs.items() if reason is not None]
    lines.append(f"{out}/summary.json: every figure, per kind of room, with versions and settings")
    return "\n".join(lines)

"""What the demo says: its table, what to look at, and summary.json."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from ufmstar_torch.eval.methods.method import UFM, UFM_STAR
from ufmstar_torch.eval.report.demo_pictures import CURVES, ELLIPSOIDS, ENSEMBLE, NETWORK, PLY, SHEET
from ufmstar_torch.eval.results.summary import aligned, number

_COLUMNS = {
    "delta1": "delta1",
    "nll": "NLL",
    "ece_delta": "ECE_delta",
    "ece_q": "ECE_q",
    "ause_rmse": "AUSE [m]",
}


def names(members: int) -> dict[str, str]:
    """The methods as a reader sees them."""
    alone = "network alone" if members == 1 else f"{members} members in turn, alone"
    inferences = f"all {members} members per image"
    return {NETWORK: alone, UFM: "  with UfM", UFM_STAR: "  with UfM*", ENSEMBLE: inferences}


def table(summary: Mapping[str, Any]) -> str:
    """Methods by metrics, time and memory; below it, error and sigma in both kinds of room."""
    shown, methods = names(summary["network"]["members"]), summary["methods"]
    head = ["", *_COLUMNS.values(), "network ms", "+ ms", "state kB"]
    body = [
        [
            shown[method],
            *(number(row["figures"][key]) for key in _COLUMNS),
            f"{row['network_ms']:.1f}",
            f"{row['uncertainty_ms']:.1f}" if row["uncertainty_ms"] is not None else "-",
            f"{row['state_bytes'] / 1000:.1f}",
        ]
        for method, row in methods.items()
    ]
    return "\n".join([*aligned([head, *body]), "", *_rooms(summary, shown)])


def _rooms(summary: Mapping[str, Any], shown: Mapping[str, str]) -> list[str]:
    """RMSE and root mean square sigma by kind of room: where they are equal, sigma is right on average."""
    kinds = summary["surfaces"]
    head = [""] + [f"{kind}: {what}" for kind in kinds for what in ("RMSE [m]", "sigma [m]")]
    body = [
        [shown[method], *(number(kinds[kind][method][key]) for kind in kinds for key in ("rmse", "rms_sigma"))]
        for method in summary["methods"]
    ]
    return aligned([head, *body])


def explanation(summary: Mapping[str, Any]) -> str:
    """Where the outputs are and what to look at, in a few lines."""
    out, made = summary["out"], summary["outputs"]
    seen, unseen = summary["surfaces"]
    lines = [
        f"The networks were trained on rooms like the {seen} ones, never on one like the {unseen} one.",
        "Better: a high delta1, a low NLL, ECE and AUSE, and a sigma that equals the RMSE beside it.",
    ]
    told = {
        SHEET: f"the last three columns share a scale: does sigma glow where the error does? {unseen} rooms below",
        CURVES: "nearer to the diagonal is better; on the left, below it a method claims too much",
        PLY: f"what UfM* remembers, brighter = views disagree more; for splat viewers ({ELLIPSOIDS}: MeshLab, Blender)",
    }
    lines += [f"{out}/{name}: {text}" for name, text in told.items() if made[name] is None]
    lines += [f"no {name}: {reason}" for name, reason in made.items() if reason is not None]
    lines.append(f"{out}/summary.json: every figure, per kind of room, with versions and settings")
    return "\n".join(lines)

"""Names, units and better direction of quantities, and names of settings, in tables and figures."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any

from ufmstar_torch.eval.methods.row import Row
from ufmstar_torch.eval.methods.setting import PAPER

LOWER, HIGHER = "↓", "↑"  # the better direction


@dataclass(frozen=True)
class Quantity:
    """A figure, its name and unit in tables and figures."""

    key: str  # of ``Record.values``: a figure, or "state.bytes_end", "ms.network", "frames.done"
    name: str
    decimals: int | None  # None = three significant digits
    better: str = ""  # "↓", "↑", or "" for neither
    unit: str = ""
    factor: float = 1.0  # from the recorded value to ``unit``

    @property
    def label(self) -> str:
        """The name with its unit: "RMSE [m]"."""
        return f"{self.name} [{self.unit}]" if self.unit else self.name

    @property
    def heading(self) -> str:
        """The label with an arrow in the better direction: "RMSE [m] ↓"."""
        return f"{self.label} {self.better}".strip()


NLL = Quantity("nll", "NLL", 2, LOWER)
ECE_DELTA = Quantity("ece_delta", "ECE_δ", 3, LOWER)
ECE_Q = Quantity("ece_q", "ECE_q", 3, LOWER)
SPEARMAN = Quantity("spearman", "Spearman", 2, HIGHER)
AUSE = Quantity("ause_rmse", "AUSE", 3, LOWER, "m")

# The cost of uncertainty, if it was measured.
ENERGY = Quantity("energy_mj", "energy", None, LOWER, "mJ")
MEMORY = Quantity("memory_mb", "memory", None, LOWER, "MB")

# The paper's columns, those of other suites' tables, and further columns that are usual in the field.
_STATE = Quantity("state.bytes_end", "state", None, "", "MB", 1e-6)  # after the last frame
PAPERS = (Quantity("delta1", "δ₁", 3, HIGHER), NLL, ECE_DELTA, ECE_Q, _STATE)
MAIN = (*PAPERS[:-1], AUSE, _STATE)
EXTRA = (
    Quantity("delta1_ratio", "δ₁ (ratio)", 3, HIGHER),
    Quantity("abs_rel", "AbsRel", 3, LOWER),
    Quantity("rmse", "RMSE", 3, LOWER, "m"),
    AUSE,
    Quantity("aurg_rmse", "AURG", 3, HIGHER, "m"),
    SPEARMAN,
    Quantity("overconfidence", "overconfidence", 3),
    Quantity("entropy", "entropy", 2, "", "nats"),
    Quantity("left_out_share", "no depth", 1, "", "%", 100.0),
    Quantity("nll_left_out_share", "no NLL", 1, "", "%", 100.0),
    # Shares of UfM*'s frames: without a segment, and (after the first) without a match of a segment with a component.
    Quantity("frames.without_segment", "no segment", 1, "", "%", 100.0),
    Quantity("frames.without_match", "no match", 1, "", "%", 100.0),
    Quantity("state.bytes_mean", "state, mean over frames", None, "", "MB", 1e-6),
    Quantity("ms.network", "network", 1, "", "ms"),
    Quantity("ms.uncertainty", "uncertainty", 1, "", "ms"),
)
# The posterior as a mixture; in the table if a row has a posterior.
MIXTURE = (
    Quantity("mixture_nll", "mixture: NLL", 2, LOWER),
    Quantity("mixture_ece_delta", "mixture: ECE_δ", 3, LOWER),
    Quantity("mixture_ece_q", "mixture: ECE_q", 3, LOWER),
    Quantity("mixture_coverage", "mixture: within 3 σ", 1, "", "%", 100.0),
)
# Share of the pixels with ground truth in central intervals; in the table if a row has intervals.
INTERVALS = (
    Quantity("coverage_50", "in the 50 % interval", 1, "", "%", 100.0),
    Quantity("coverage_90", "in the 90 % interval", 1, "", "%", 100.0),
    Quantity("coverage_99", "in the 99 % interval", 1, "", "%", 100.0),
)
OWN = "own."  # prefix of the figures of a user's metrics
# Figures with a table of differences between rows.
DIFFERENCES = (NLL, ECE_DELTA, ECE_Q, AUSE, SPEARMAN)

# Displayed names of settings, and units of their values.
SETTINGS = {
    "rotation_noise": ("rotation noise", "°"),
    "translation_noise": ("translation noise", "m"),
    "rotation_drift": ("rotation drift", "°/√frame"),
    "translation_drift": ("translation drift", "m/√frame"),
    "skip": ("images skipped", ""),
    "eta": ("overlap threshold η", ""),
    "eta_occlusion": ("occlusion threshold η_occl", ""),
    "ema_alpha": ("smoothing α", ""),
    "prior_weight": ("prior weight π₀", "px/m³"),
    "prior_mean": ("prior mean μ₀", "m²"),
    "anchors": ("anchored by", ""),
    "anchor_count": ("anchors a frame at most", ""),
    "anchors.half_life": ("half-life of evidence", "frames"),
    "anchors.shrinkage": ("shrinkage κ", "anchors"),
    "track_noise": ("track noise", "px"),
    "posterior": ("posterior", ""),
    "overlap_weighted": ("fusion weighted by overlap", ""),
    "disagreement": ("disagreement", ""),
    "regression": ("regression", ""),
    "unmeasured": ("not measured:", ""),
    "unmeasured_relative": ("ρ", "of the depth"),
    "variance_floor": ("variance floor", "m²"),
    "segment.min_pixels": ("smallest segment", "px"),
    "segment.min_rows": ("smallest segment", "rows"),
    "segment.prune": ("pruning rule", ""),
    "segment.line_thresh": ("line threshold", "m"),
    "segment.min_gaussian_length": ("shortest Gaussian", "m"),
    "segment.adaptive_thresh_scale": ("segment threshold a", "px/m"),
}


# Settings that are displayed as one text, without their name.
_WORDS = {
    ("ufm_preset", "paper"): "paper's settings",
    ("preprocess", "resize"): "whole frame",
    ("preprocess", "crop"): "NYU's crop",
    ("variances_in_h", True): "A and E in H",
    ("posterior", True): "posterior",
}
# Displayed values.
_VALUES = {"corners": "tracked corners", "dense": "dense evidence", "truth": "ground truth"}


def own_quantities(figures: Iterable[str]) -> list[Quantity]:
    """The columns of a user's metrics among the names of figures, without duplicates."""
    return [Quantity(key, key.removeprefix(OWN), 3) for key in dict.fromkeys(figures) if key.startswith(OWN)]


def setting_name(name: str) -> str:
    """A setting's displayed name; by default the config field's."""
    return SETTINGS[name][0] if name in SETTINGS else name.rpartition(".")[2].replace("_", " ")


def setting_label(values: Mapping[str, Any]) -> str:
    """The displayed text of a setting, "" for the default: "rotation noise 2°, images skipped 4"."""
    shown = {name: value for name, value in values.items() if name != "seed" or value}
    return ", ".join(
        _WORDS.get((name, value)) or f"{setting_name(name)} {_with_unit(name, value)}" for name, value in shown.items()
    )


def _with_unit(name: str, value: Any) -> str:
    """A setting's value with its unit: "2°", "0.5 m", "on"."""
    if isinstance(value, bool):
        return "on" if value else "off"
    unit = SETTINGS.get(name, ("", ""))[1]
    text = f"{value:g}" if isinstance(value, int | float) else _VALUES.get(str(value), str(value))
    return f"{text}{unit}" if unit == "°" else f"{text} {unit}".strip()


def row_labels(rows: Iterable[Row]) -> dict[Row, str]:
    """The labels of a table's rows: without a preprocessing shared by all rows (:func:`shared_words`), and with "our
    defaults" if the same method also has a row with the paper's settings."""
    listed = list(rows)
    shared = {"preprocess"} if len({row.setting.preprocess for row in listed}) == 1 else set()
    papers = {row.method for row in listed if row.setting.ufm_preset == PAPER}
    labels = {}
    for row in listed:
        ours = "our defaults" if row.method in papers and row.setting.ufm_preset != PAPER else ""
        changed = {name: value for name, value in row.changed.items() if name not in shared}
        labels[row] = row.title or ", ".join(filter(None, (row.name, ours, setting_label(changed))))
    return labels


def shared_words(rows: Iterable[Row]) -> str:
    """The preprocessing shared by all rows, "" if the networks' weights define it or rows differ."""
    prepared = {row.setting.preprocess for row in rows}
    return _WORDS.get(("preprocess", prepared.pop()), "") if len(prepared) == 1 else ""


def count(n: int, noun: str) -> str:
    """ "1 row", "2 rows"."""
    return f"{n} {noun}{'' if n == 1 else 's'}"

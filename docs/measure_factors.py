"""One factor of UfM* at a time around the defaults: by how much the figures change.

    python docs/measure_factors.py --tours 200:206
    python docs/measure_factors.py --root ../shared

print the tables of docs/results/analysis.md: the defaults' figures, and for every other value the mean paired
difference to them over the clips with its 95 % confidence interval. Constants are chosen on tours; the shared sequences
only check.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from clips import Clip, add_sources, clips, estimate, judge, line, shown

from ufmstar_torch import UfMStar, UfMStarConfig
from ufmstar_torch.eval.metrics.sequence import mean_and_ci

SHOWN = ("ece_delta", "ece_q", "spearman", "ause_rmse", "nll")
STRIDE = 3  # [px] every third pixel of every third row is judged
CHANGES: dict[str, Mapping[str, Any]] = {
    "drop < 2000 px or < 32 rows": {"segment": {"min_pixels": 2000, "min_rows": 32, "prune": "either"}},
    "drop < 2000 px and < 32 rows": {"segment": {"min_pixels": 2000, "min_rows": 32}},
    "drop < 200 px or < 16 rows": {"segment": {"prune": "either"}},
    "drop < 33 px and < 7 rows": {"segment": {"min_pixels": 33, "min_rows": 7}},
    "L0 = .25 m": {"segment": {"min_gaussian_length": 0.25}},
    "L0 = 1 m": {"segment": {"min_gaussian_length": 1.0}},
    "noise_floor = .04 m": {"segment": {"noise_floor": 0.04}},
    "noise_floor = .16 m": {"segment": {"noise_floor": 0.16}},
    "f of the camera": {"segment": {"slope_focal": "camera"}},
    "f = 200 px": {"segment": {"slope_focal": "reference"}},
    "alpha = 1 (no average)": {"ema_alpha": 1.0},
    "alpha = .25": {"ema_alpha": 0.25},
    "eta = .3": {"eta": 0.3},
    "eta = .7": {"eta": 0.7},
    "eta_occl = .4": {"eta_occlusion": 0.4},
    "eta_occl = 1 (no filter)": {"eta_occlusion": 1.0},
    "overlap-weighted fusion": {"overlap_weighted": True},
    "neighbourhood regression": {"regression": "neighbourhood"},
    "pi_0 = .01": {"prior_weight": 0.01},
    "pi_0 = 100": {"prior_weight": 100.0},
    "pi_0 = 10000": {"prior_weight": 10000.0},
    "mu_0 = .01 m^2": {"prior_mean": 0.01},
    "mu_0 = .1 m^2": {"prior_mean": 0.1},
}
SCALES = (0.25, 0.5, 2.0, 4.0)  # of M
Figures = dict[str, dict[str, float]]


def figures(clip: Clip, only: Sequence[str] | None = None) -> Figures:
    """The figures of a clip by factor, "default" first; ``only`` names the factors that are tried, None = all."""
    default = estimate(clip, UfMStar())
    result = {"default": judge(clip, default, STRIDE)}
    own = np.zeros_like(default) if clip.aleatoric is None else clip.aleatoric
    for scale in SCALES:
        scaled = np.maximum(own + np.float32(scale) * (default - own), 0)
        result[f"M times {scale:g}"] = judge(clip, scaled, STRIDE)
    for name, change in CHANGES.items() if only is None else ((name, CHANGES[name]) for name in only):
        result[name] = judge(clip, estimate(clip, UfMStar(UfMStarConfig.from_dict(change))), STRIDE)
    return result


def table(title: str, found: list[Figures]) -> None:
    """The defaults' mean figures, and the differences to them with their confidence intervals."""
    print(f"\n{title}, {len(found)} clips\n")
    line("factor", *SHOWN)
    line(*["---"] * (len(SHOWN) + 1))
    line("default", *(shown(mean_and_ci(clip["default"][column] for clip in found)[0]) for column in SHOWN))
    for name in list(found[0])[1:]:
        differences = (mean_and_ci(clip[name][c] - clip["default"][c] for clip in found) for c in SHOWN)
        line(name, *(f"{mean:+.3f} ± {half:.3f}" if abs(mean) < 1000 else f"{mean:+.0e}" for mean, half in differences))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    add_sources(parser)
    parser.add_argument("--save", type=Path, help="file for the figures of every clip, as JSON")
    parser.add_argument("--only", nargs="+", choices=CHANGES, help="factors that are tried; default: all")
    arguments = parser.parse_args()
    groups: dict[str, list[Figures]] = {}
    for clip in clips(arguments):
        title = "Depth only" if clip.aleatoric is None else "Ensemble"
        groups.setdefault(title, []).append(figures(clip, arguments.only))
    for title, result in groups.items():
        table(title, result)
    if arguments.save is not None:
        arguments.save.write_text(json.dumps(groups))


if __name__ == "__main__":
    main()

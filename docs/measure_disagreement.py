"""Compares the variances of UfM and UfM* with constant and random ones, and shows where they miss the error.

    python docs/measure_disagreement.py baselines --root ../shared
    python docs/measure_disagreement.py regions --root ../shared
    python docs/measure_disagreement.py floors --root ../shared

print the tables of docs/results/disagreement.md for FastDepth on the shared sequences; ``--tours 200:206`` instead of
``--root`` takes rendered tours and the networks of the demo.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Iterator

import numpy as np
from clips import Clip, Map, add_sources, clips, estimate, judge, line, shown
from numpy.typing import NDArray

from ufmstar_torch import UfMStar, UfMStarConfig
from ufmstar_torch.eval.methods.ufm import UfM

COLUMNS = ("rms", "delta1", "ece_delta", "overconfidence", "ece_q", "spearman", "ause_rmse", "nll_left_out_share")
PAPERS = UfMStarConfig(unmeasured="paper")  # the disagreement alone, 0 where none was measured
LITERAL = {"unmeasured": "paper", "segment": {"min_pixels": 2000, "min_rows": 32, "prune": "either"}}
PROGRAM = {"unmeasured": "paper", "segment": {"min_pixels": 2000, "min_rows": 32}}
NOISE_FLOOR = 0.08  # [m] of SPGF: segments resolve nothing finer
BORDER = 16  # [px]
EDGE = 0.1  # relative change of depth between neighbouring pixels


def scaled_to(target: float, variance: NDArray[np.floating], has_truth: NDArray[np.bool_]) -> Map:
    """The variance, scaled to the mean ``target`` over the pixels with ground truth."""
    result: Map = (variance * (target / variance[has_truth].mean(dtype=np.float64))).astype(np.float32)
    return result


def shuffled(variance: Map, has_truth: NDArray[np.bool_]) -> Map:
    """The variance, permuted within each frame among the pixels with ground truth."""
    rng, result = np.random.default_rng(0), variance.copy()
    for i in range(len(variance)):
        result[i][has_truth[i]] = rng.permutation(variance[i][has_truth[i]])
    return result


def variances(clip: Clip) -> Iterator[tuple[str, Map]]:
    """UfM, UfM* and uninformative controls. "scaled": multiplied to the mean of UfM*'s variance."""
    has_truth, d2 = clip.has_truth, clip.depth.astype(np.float64) ** 2
    ufm, star = estimate(clip, UfM()), estimate(clip, UfMStar(PAPERS))
    mean = float(star[has_truth].mean(dtype=np.float64))
    yield "UfM-100K", ufm
    yield "UfM-100K, scaled", scaled_to(mean, ufm, has_truth)
    yield "UfM*, < 2000 px or < 32 rows dropped", estimate(clip, UfMStar(UfMStarConfig.from_dict(LITERAL)))
    yield "UfM*, < 2000 px and < 32 rows dropped", estimate(clip, UfMStar(UfMStarConfig.from_dict(PROGRAM)))
    yield "UfM*", star
    yield "UfM*, shuffled within each frame", shuffled(star, has_truth)
    if clip.aleatoric is not None:
        yield "A, the networks' own", clip.aleatoric
        yield "A, scaled", scaled_to(mean, clip.aleatoric, has_truth)
        yield "A + M, M shuffled", clip.aleatoric + shuffled(star - clip.aleatoric, has_truth)
    yield "sigma = c d, scaled", scaled_to(mean, d2, has_truth)
    yield "one variance, scaled", np.full_like(star, mean)
    yield "sigma = .25 d", (0.0625 * d2).astype(np.float32)
    yield "one variance, the true MSE", np.full_like(star, _squared(clip)[has_truth].mean())


def _squared(clip: Clip) -> NDArray[np.float64]:
    return (clip.depth.astype(np.float64) - clip.truth) ** 2


def baselines(clip: Clip, stride: int) -> None:
    """The figures of :func:`variances`."""
    print(f"\n{clip.name}, {len(clip.depth)} frames\n")
    line("variance", *COLUMNS)
    line(*["---"] * (len(COLUMNS) + 1))
    for name, variance in variances(clip):
        result = judge(clip, variance, stride)
        line(name, *(shown(result[column]) for column in COLUMNS))


def places(clip: Clip) -> dict[str, NDArray[np.bool_]]:
    """Masks [N, h, w] over the pixels with ground truth: thirds of depth, border, edges, and the rest."""
    d, has_truth = clip.depth, clip.has_truth
    low, high = np.quantile(d[has_truth], (1 / 3, 2 / 3))
    border = np.ones_like(has_truth)
    border[:, BORDER:-BORDER, BORDER:-BORDER] = False
    down, across = np.zeros_like(d), np.zeros_like(d)
    down[:, 1:], across[:, :, 1:] = np.abs(np.diff(d, axis=1)), np.abs(np.diff(d, axis=2))
    edge = np.maximum(down, across) > EDGE * d
    masks = {
        "all": has_truth,
        "nearest third": d <= low,
        "middle third": (d > low) & (d <= high),
        "farthest third": d > high,
        f"border ({BORDER} px)": border,
        "depth edges": edge & ~border,
        "the rest": ~edge & ~border,
    }
    return {name: mask & has_truth for name, mask in masks.items()}


def regions(clip: Clip, _: int) -> None:
    """By region: share of the pixels, RMSE, and mean squared error over mean variance (1 = calibrated)."""
    squared, ufm, star = _squared(clip), estimate(clip, UfM()), estimate(clip, UfMStar(PAPERS))
    for name, mask in places(clip).items():
        mse = squared[mask].mean()
        ratios = (mse / v[mask].mean(dtype=np.float64) for v in (ufm, star))
        line(clip.name, name, f"{mask.sum() / clip.has_truth.sum():.3f}", f"{mse**0.5:.2f} m", *map(shown, ratios))


def floors(clip: Clip, _: int) -> None:
    """The NLL under different variance floors, over the pixels with a positive variance and over all pixels."""
    has_truth, focal = clip.has_truth, float(min(clip.K[0, 0], clip.K[1, 1]))
    squared, d = _squared(clip)[has_truth], clip.depth[has_truth].astype(np.float64)
    choices = {
        "none": np.zeros_like(d),
        "pixel footprint (d/f)^2/12": (d / focal) ** 2 / 12,
        "1e-4 m^2": np.full_like(d, 1e-4),
        "noise_floor^2/3": np.full_like(d, NOISE_FLOOR**2 / 3),
        "(.1 d)^2": (0.1 * d) ** 2,
    }
    for method, variance in (("UfM-100K", estimate(clip, UfM())), ("UfM*", estimate(clip, UfMStar(PAPERS)))):
        v = variance[has_truth].astype(np.float64)
        for name, floor in choices.items():
            raised = np.maximum(v, floor)
            with np.errstate(divide="ignore", invalid="ignore"):
                nll = squared / (2 * raised) + 0.5 * np.log(2 * np.pi * raised)
            under = float(((v < floor) & (v > 0)).mean())
            line(clip.name, method, name, f"{under:.5f}", shown(nll[v > 0].mean()), shown(nll[raised > 0].mean()))


TABLES: dict[str, Callable[[Clip, int], None]] = {"baselines": baselines, "regions": regions, "floors": floors}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("table", choices=list(TABLES))
    add_sources(parser)
    parser.add_argument("--stride", type=int, default=1, help="judge every so many pixels only [px]")
    arguments = parser.parse_args()
    for clip in clips(arguments):
        TABLES[arguments.table](clip, arguments.stride)


if __name__ == "__main__":
    main()

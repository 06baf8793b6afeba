"""Which images of a pool to label first: every image's mean uncertainty by UfM*, as a CSV.

Sequences are streamed one after another, with a fresh state each: views of different sequences are never compared.

    python examples/pool_to_csv.py SEQUENCE... --model fastdepth --weights fastdepth_nyu.onnx --out pool.csv

The most uncertain image comes first. Images with less than ``--measured`` of their pixels on surfaces seen before come
last, without a rank: the first views of a place have nothing to disagree with, and their low mean is no certainty.
"""

from __future__ import annotations

import argparse
import csv
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import torch

from ufmstar_torch import UfMStarConfig, UncertainDepth
from ufmstar_torch.eval.report.table import csv_text
from ufmstar_torch.eval.sequences import open_sequence
from ufmstar_torch.models.load import load_network

COLUMNS = ("rank", "sequence", "frame", "mean_variance_m2", "standard_error_m2", "measured", "pixels")


def scores(model: UncertainDepth, path: str, pixels: int, seed: int) -> Iterator[dict[str, Any]]:
    """A row of the table for every readable image of a sequence; its poses must be camera-to-world."""
    sequence = open_sequence(path)
    model.reset()
    for frame in sequence.readable(on_error=lambda error: print(f"skipped: {error}")):
        if frame.image is None:
            continue
        image = torch.from_numpy(frame.image).permute(2, 0, 1)[None]
        pose, K = torch.from_numpy(frame.T_world_cam), torch.from_numpy(frame.intrinsics)
        result = model.mean_uncertainty(image, pose, K, pixels=pixels, seed=seed + frame.index)
        yield {
            "sequence": sequence.name,
            "frame": frame.name,
            "mean_variance_m2": float(result.mean),
            "standard_error_m2": float(result.standard_error),
            "measured": float(result.measured),
            "pixels": int(result.pixels),
        }


def ranked(rows: Sequence[dict[str, Any]], measured: float) -> list[dict[str, Any]]:
    """The rows, most uncertain first, with ranks from 1; those that are measured too little, or not at all, last."""
    known = [row for row in rows if row["measured"] >= measured and row["mean_variance_m2"] >= 0]
    known.sort(key=lambda row: -row["mean_variance_m2"])
    rest = [{"rank": "", **row} for row in rows if row not in known]
    return [{"rank": number, **row} for number, row in enumerate(known, start=1)] + rest


def main(words: Sequence[str] | None = None) -> None:
    """Read the options, stream the pool, write the table."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("sequences", nargs="+", help="folders that ufmstar run reads, videos, or tour:SEED")
    parser.add_argument("--model", default="fastdepth", help="kind of network, as of ufmstar run")
    parser.add_argument("--weights", required=True)
    parser.add_argument("--out", type=Path, default=Path("pool.csv"))
    parser.add_argument("--pixels", type=int, default=1000, help="drawn of every image")
    parser.add_argument("--measured", type=float, default=0.5, help="least share of measured pixels to be ranked")
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args(words)
    network = load_network(options.model, options.weights)
    config = UfMStarConfig(unmeasured="nan", on_bad_frame="skip")  # only measured pixels are averaged
    model = UncertainDepth(network, config, preprocess=network.preprocess)
    rows = [row for path in options.sequences for row in scores(model, path, options.pixels, options.seed)]
    with options.out.open("w", newline="", encoding="utf-8") as file:
        table = csv.DictWriter(file, COLUMNS)
        table.writeheader()
        table.writerows(
            {name: csv_text(value) for name, value in row.items()} for row in ranked(rows, options.measured)
        )
    print(f"{options.out}: {len(rows)} images")


if __name__ == "__main__":
    main()

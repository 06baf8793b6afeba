"""Distances between exported clouds and the ground truth's, for docs/results/accuracy.md:
``python docs/measure_clouds.py truth/export/cloud.ply out/export/cloud.ply ...``.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

_KINDS = {"float": "<f4", "double": "<f8", "uchar": "|u1"}


def read_vertices(path: Path) -> NDArray[Any]:
    """[P] the vertices of a cloud of ``ufmstar export``, by the names of their properties."""
    head, body = path.read_bytes().split(b"end_header\n", 1)
    properties = [line.split()[1:] for line in head.decode().splitlines() if line.startswith("property")]
    return np.frombuffer(body, [(name, _KINDS[kind]) for kind, name in properties])


def read_points(path: Path) -> NDArray[np.float64]:
    """[P, 3] the points of a cloud of ``ufmstar export`` [m]."""
    table = read_vertices(path)
    return np.stack([table[axis] for axis in "xyz"], axis=-1).astype(np.float64)


def distances(cloud: NDArray[np.float64], truth: NDArray[np.float64]) -> tuple[float, float, float]:
    """[cm] Median and 90 % quantile of the distances from cloud to truth, and the median from truth to cloud."""
    to_truth, back = cKDTree(truth).query(cloud)[0], cKDTree(cloud).query(truth)[0]
    median, most = np.quantile(to_truth, [0.5, 0.9])
    return 100 * float(median), 100 * float(most), 100 * float(np.median(back))


def main(words: Sequence[str]) -> None:
    truth = read_points(Path(words[0]))
    print("| cloud | points | median [cm] | 90 % [cm] | median from the truth [cm] |\n|---|---|---|---|---|")
    for word in words[1:]:
        cloud = read_points(Path(word))
        median, most, back = distances(cloud, truth)
        print(f"| {word} | {len(cloud):,} | {median:.1f} | {most:.1f} | {back:.1f} |")


if __name__ == "__main__":
    main(sys.argv[1:])

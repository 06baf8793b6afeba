"""The four tables of the paper, number for number, to stand beside ours.

S. Sudhakar, S. Karaman and V. Sze, "UfM*: Uncertainty from Motion* for DNN Depth Estimation Using Gaussians".
Sequences, networks and machines are theirs: 100 ScanNet sequences, networks trained on NYU Depth V2, an Orin AGX for
time and energy. A cell "a ± b" is a mean with its 95 % confidence interval as printed; "-" = none, "<0.01" as printed.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

_QUALITY = ("delta1", "nll", "ece_delta", "ece_q")
# Table 1: uncertainty quality and efficiency, ResNet50-Monodepth2.
_TABLE_1 = """
Ensemble                | 0.70 | 1.33 ± 0.17 | 0.17 ± 0.03 | 0.18 ± 0.02 | 1857 ± 2 | 1245
UfM-Ensemble            | 0.68 | 1.34 ± 0.22 | 0.16 ± 0.02 | 0.16 ± 0.02 | 257 ± 18 | 1319 ± 7
UfM-Ensemble-100K       | 0.68 | 1.51 ± 0.23 | 0.17 ± 0.02 | 0.17 ± 0.02 | 112 ± 2  | 1249
UfM*-Ensemble           | 0.68 | 0.96 ± 0.19 | 0.12 ± 0.02 | 0.13 ± 0.02 | 66 ± 2   | 1245
MC-Dropout              | 0.68 | 3.87 ± 0.47 | 0.24 ± 0.03 | 0.19 ± 0.02 | 1854 ± 2 | 0.01
UfM-MCD                 | 0.68 | 1.95 ± 0.28 | 0.18 ± 0.02 | 0.16 ± 0.02 | 242 ± 16 | 76 ± 7
UfM-MCD-100K            | 0.68 | 2.33 ± 0.31 | 0.20 ± 0.02 | 0.17 ± 0.02 | 111 ± 2  | 4
UfM*-MCD                | 0.68 | 1.12 ± 0.18 | 0.13 ± 0.02 | 0.13 ± 0.02 | 61 ± 2   | 0.03
BatchEnsemble           | 0.68 | 2.15 ± 0.26 | 0.22 ± 0.02 | 0.17 ± 0.02 | 1580 ± 3 | 2
UfM-BatchEnsemble       | 0.67 | 1.48 ± 0.24 | 0.18 ± 0.02 | 0.15 ± 0.02 | 302 ± 16 | 80 ± 7
UfM-BatchEnsemble-100K  | 0.67 | 1.74 ± 0.26 | 0.20 ± 0.02 | 0.16 ± 0.02 | 162 ± 2  | 6
UfM*-BatchEnsemble      | 0.67 | 1.01 ± 0.18 | 0.11 ± 0.02 | 0.12 ± 0.02 | 123 ± 1  | 2
Evidential              | 0.67 | 3.51 ± 0.38 | 0.22 ± 0.02 | 0.16 ± 0.02 | 30 ± 1   | 0.03
UfM-Evidential          | 0.67 | 1.85 ± 0.22 | 0.19 ± 0.02 | 0.14 ± 0.02 | 245 ± 13 | 75 ± 7
UfM-Evidential-100K     | 0.67 | 2.17 ± 0.25 | 0.20 ± 0.02 | 0.15 ± 0.02 | 119 ± 2  | 4
UfM*-Evidential         | 0.67 | 1.12 ± 0.15 | 0.16 ± 0.01 | 0.13 ± 0.02 | 74 ± 2   | 0.05
Aleatoric               | 0.68 | 4.10 ± 0.50 | 0.24 ± 0.03 | 0.19 ± 0.02 | 10 ± 1   | 0.01
UfM-Aleatoric           | 0.68 | 1.99 ± 0.28 | 0.18 ± 0.02 | 0.16 ± 0.02 | 234 ± 13 | 76 ± 7
UfM-Aleatoric-100K      | 0.68 | 2.38 ± 0.31 | 0.20 ± 0.02 | 0.17 ± 0.02 | 109 ± 2  | 4
UfM*-Aleatoric          | 0.68 | 1.11 ± 0.18 | 0.13 ± 0.02 | 0.13 ± 0.02 | 61 ± 2   | 0.04
"""
# Table 2: latency, power, energy and memory on an Orin AGX.
_TABLE_2_RESNET50 = """
Ensemble            | 252 | 7.4 | 1857 | 0   | 0   | 0   | 90 | 1245   | -    | 90.0
UfM-Ensemble        | 2   | 4.4 | 9    | 128 | 1.9 | 248 | 67 | 1245   | 74.6 | 90.5
UfM-Ensemble-100K   | 2   | 4.7 | 10   | 59  | 1.7 | 102 | 47 | 1245   | 4.0  | 90.0
UfM*-Ensemble       | 2   | 5.2 | 13   | 24  | 2.1 | 53  | 32 | 1245   | 0.03 | 90.0
Aleatoric           | 2   | 6.6 | 10   | 0   | 0   | 0   | 6  | 0.01   | -    | 0.01
UfM-Aleatoric       | 2   | 4.5 | 7    | 116 | 1.9 | 226 | 65 | 0.01   | 75.9 | 33.9
UfM-Aleatoric-100K  | 2   | 4.7 | 8    | 58  | 1.7 | 101 | 46 | 0.01   | 4.0  | 2.8
UfM*-Aleatoric      | 2   | 5.3 | 11   | 23  | 2.1 | 50  | 30 | 0.01   | 0.03 | 0.03
"""
_TABLE_2_FASTDEPTH = """
Ensemble            | 112 | 5.4 | 608  | 0   | 0   | 0   | 90 | 142.6  | -    | 90.0
UfM-Ensemble        | <1  | 3.9 | 1    | 113 | 1.9 | 217 | 81 | 142.6  | 75.3 | 93.1
UfM-Ensemble-100K   | <1  | 3.9 | 1    | 61  | 1.6 | 96  | 66 | 142.6  | 4.0  | 90.3
UfM*-Ensemble       | 1   | 4.1 | 3    | 24  | 2.3 | 56  | 53 | 142.6  | 0.03 | 90.0
Aleatoric           | <1  | 4.6 | 2    | 0   | 0   | 0   | 3  | <0.01  | -    | <0.01
UfM-Aleatoric       | <1  | 3.9 | 1    | 114 | 1.9 | 220 | 81 | <0.01  | 77.4 | 80.4
UfM-Aleatoric-100K  | <1  | 3.9 | 1    | 60  | 1.6 | 95  | 66 | <0.01  | 4.0  | 20.2
UfM*-Aleatoric      | 1   | 4.1 | 2    | 23  | 2.3 | 53  | 52 | <0.01  | 0.03 | 0.2
"""
# Table 3: Depth Anything V2 (small), 518 x 518.
_TABLE_3 = """
UfM-DepthOnly-300K        | 0.76 | 0.23 | 0.26 | 12
UfM*-DepthOnly-fixed-param| 0.76 | 0.14 | 0.16 | 0.07
UfM*-DepthOnly            | 0.76 | 0.14 | 0.17 | 0.02
"""
# Table 4: all members (or samples) on every image, ResNet50-Monodepth2.
_TABLE_4 = """
UfM*-FullEnsemble       | 0.70 | 0.72 | 0.12 | 0.15 | 1810
UfM*-FullMCD            | 0.68 | 1.09 | 0.13 | 0.13 | 1815
UfM*-FullBatchEnsemble  | 0.68 | 0.91 | 0.12 | 0.13 | 1478
"""


@dataclass(frozen=True)
class Quoted:
    """A number as the paper prints it.

    Attributes:
        value: as text: "0.17", "<0.01".
        half: half-width of its confidence interval, "" where none is printed.
    """

    value: str
    half: str = ""


@dataclass(frozen=True)
class PaperTable:
    """A table of the paper.

    Attributes:
        number: its number.
        network: the depth network.
        told: on what the numbers were measured.
        columns: keys, those of ``Record.figures`` where they mean the same.
        rows: by method and column; a column in which a dash is printed is missing.
    """

    number: int
    network: str
    told: str
    columns: tuple[str, ...]
    rows: Mapping[str, Mapping[str, Quoted]]


def _table(number: int, network: str, told: str, columns: tuple[str, ...], text: str) -> PaperTable:
    rows: dict[str, dict[str, Quoted]] = {}
    for line in text.strip().splitlines():
        method, *cells = (part.strip() for part in line.split("|"))
        found = zip(columns, cells, strict=True)
        rows[method] = {column: Quoted(*cell.split(" ± ")) for column, cell in found if cell != "-"}
    return PaperTable(number, network, told, columns, rows)


_EFFICIENCY = (
    "gpu_ms", "gpu_w", "gpu_mj", "cpu_ms", "cpu_w", "cpu_mj",
    "energy_overhead", "network_mb", "state_mb", "memory_overhead",
)  # fmt: skip
_SCANNET = "100 ScanNet sequences"
_ORIN = f"{_SCANNET}, Nvidia Orin AGX"
RESNET50, FASTDEPTH, DEPTH_ANYTHING = "ResNet50-Monodepth2", "FastDepth", "Depth Anything V2"
TABLE_1 = _table(1, RESNET50, _SCANNET, (*_QUALITY, "energy_mj", "memory_mb"), _TABLE_1)
TABLE_2 = {
    RESNET50: _table(2, RESNET50, _ORIN, _EFFICIENCY, _TABLE_2_RESNET50),
    FASTDEPTH: _table(2, FASTDEPTH, _ORIN, _EFFICIENCY, _TABLE_2_FASTDEPTH),
}
# Of the network alone: latency [ms] and memory [MB].
TABLE_2_NETWORKS = {RESNET50: (Quoted("27"), Quoted("138.3")), FASTDEPTH: (Quoted("12"), Quoted("15.8"))}
TABLE_3 = _table(3, DEPTH_ANYTHING, _SCANNET, ("delta1", "ece_delta", "ece_q", "memory_mb"), _TABLE_3)
TABLE_4 = _table(4, RESNET50, _SCANNET, (*_QUALITY, "energy_mj"), _TABLE_4)
# By the suite that repeats them.
BY_SUITE = {"paper-table-1": TABLE_1, "paper-table-3": TABLE_3, "paper-table-4": TABLE_4}

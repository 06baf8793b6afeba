"""Writes folders of ``ufmstar eval`` from random numbers: real records and sums, no network."""

from __future__ import annotations

import json
import re
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from ufmstar_torch.eval.engine.files import write_json_atomic
from ufmstar_torch.eval.engine.record import FORMAT, Record
from ufmstar_torch.eval.methods.method import ALONE, UFM, UFM_STAR, Method
from ufmstar_torch.eval.methods.row import Row
from ufmstar_torch.eval.methods.setting import Setting
from ufmstar_torch.eval.metrics import NLLByError, SequenceMetrics
from ufmstar_torch.eval.report.data import Results
from ufmstar_torch.eval.report.table import Table
from ufmstar_torch.eval.suite.work_items import WorkItem

Maps = tuple[Tensor, Tensor | None, Tensor]
# Ratio of the error to sigma: 1 is calibrated.
SHORT = {ALONE: 2.5, UFM: 1.8, UFM_STAR: 1.2}
NETWORK = "FastDepth"


def rows_of(*names: str) -> list[Row]:
    return [Row(Method.parse(name)) for name in names]


# The evaluation of the fixture ``evaluation`` in conftest.py.
ENSEMBLE = rows_of("Ensemble", "UfM-Ensemble", "UfM-Ensemble-100K", "UfM*-Ensemble")
SCENES = [("scannet", f"scene000{i}_00") for i in range(5)]
KITCHEN = ("7-scenes", r"kitchen&_50% $a$ \frac{ ^$ <b>")
LATER = ("scannet", "scene0009_00")
HOSTILE = "<script>alert('x')</script>&\"amp;"
TITLE = f"Title $x$ {HOSTILE}"
SHAPE = (12, 16)


def folder_of(out: Path, dataset: str, sequence: str) -> Path:
    return out / "records" / WorkItem(dataset, sequence, path="").folder


def write_examples(out: Path, dataset: str, sequence: str, rows: Sequence[Row]) -> None:
    """Write an example frame "7" with maps of the rows."""
    folder = folder_of(out, dataset, sequence)
    (folder / "examples").mkdir(parents=True)
    K = np.array([[20.0, 0, 7.5], [0, 20, 5.5], [0, 0, 1]])
    truth = np.full(SHAPE, 3.0, np.float32)
    np.savez(folder / "examples" / "7.npz", image=np.zeros((*SHAPE, 3), np.uint8), truth=truth, K=K)
    for n, row in enumerate(rows):
        maps = {"depth": truth - 1 + 0.1 * np.float32(n), "variance": np.full(SHAPE, 0.1 + n, np.float32)}
        np.savez(folder / "examples" / f"7@{row.slug}.npz", **maps)


def draw_maps(row: Row, sequence: str, pixels: int = 800) -> Maps:
    """Random depth, variance and truth [pixels]. Rows of a sequence share depth and truth; pose noise reduces sigma."""
    rng = np.random.default_rng(sum(map(ord, sequence)))
    truth = rng.uniform(1.0, 6.0, pixels)
    error = rng.uniform(0.05, 0.25) * truth * rng.uniform(0.2, 1.8, pixels)
    depth = truth + error * rng.standard_normal(pixels)
    if row.method.base == "depth_only" and row.method.fusion == ALONE:
        return torch.tensor(depth), None, torch.tensor(truth)
    noise = row.setting.rotation_noise / 10 + row.setting.translation_noise
    short = SHORT[row.method.fusion] * (1 + noise) * (0.9 if row.method.max_points is None else 1.0)
    sigma = error / short * rng.lognormal(0, 0.2, pixels)
    return torch.tensor(depth), torch.tensor(sigma**2), torch.tensor(truth)


def judge(maps: Maps, references: Mapping[str, Tensor]) -> Record:
    """A record with figures, curves and the sums they are computed from."""
    depth, variance, truth = maps
    metrics = SequenceMetrics(with_variance=variance is not None)
    metrics.update(depth, variance, truth)
    curves: dict[str, Any] = metrics.curves()
    sums = {"metrics": dict(metrics.state_dict())}
    for name, confident in references.items() if variance is not None else ():
        by_error = NLLByError()
        by_error.update(depth, variance, truth, confident)
        curves[f"nll_by_error:{name}"] = by_error.compute()["nll_by_error"].tolist()
        sums[f"nll_by_error:{name}"] = dict(by_error.state_dict())
    return Record("", figures=metrics.compute(), curves=curves, sums=sums)


def confident(variance: Tensor) -> Tensor:
    return variance <= variance.quantile(0.5)


def write_sequence(
    out: Path, suite: str, dataset: str, sequence: str, rows: Iterable[Row], network: str = NETWORK
) -> None:
    """Write records and sums of the rows for one sequence."""
    folder = folder_of(out, dataset, sequence)
    folder.mkdir(parents=True, exist_ok=True)
    rows = list(rows)
    references = {
        row.method.name: confident(variance)
        for row in rows
        if row.setting == Setting() and (row.method.fusion == ALONE or row.method.max_points)
        for variance in [draw_maps(row, sequence)[1]]
        if variance is not None
    }
    for row in rows:
        judged = judge(draw_maps(row, sequence), references)
        record_of(suite, dataset, sequence, row, judged, network).save(folder / f"{row.slug}.json")


def record_of(suite: str, dataset: str, sequence: str, row: Row, judged: Record, network: str = NETWORK) -> Record:
    """The whole record of a judged row."""
    size = {ALONE: 0.0, UFM: 40.0 * (row.method.max_points or 1_900_000), UFM_STAR: 64.0 * 400}[row.method.fusion]
    members = 10 if row.method.every_member else 1
    state = {"bytes_mean": size, "bytes_max": 1.2 * size, "bytes_end": size, "count_mean": size / 64}
    return Record(
        suite=suite,
        dataset=dataset,
        sequence=sequence,
        network=network,
        method=row.method.name,
        setting=row.setting.to_dict(),
        frames={"selected": 42, "done": 40, "skipped": 2, "reasons": {"pose is not finite": 2}},
        figures=judged.figures,
        curves=judged.curves,
        sums=judged.sums,
        state=state if size else {},
        ms={"network": 9.0 * members, "uncertainty": {ALONE: 0.2, UFM: 14.0, UFM_STAR: 10.0}[row.method.fusion]},
        provenance={"device": "cpu"},
    )


def in_memory(
    figures: Mapping[tuple[Row, tuple[str, str]], Mapping[str, float]], suite: str = "own", **more: Any
) -> Results:
    """Results without curves. ``figures`` maps row and (data set, sequence), in that order, to figures."""
    records = [
        record_of(suite, *where, row, Record("", figures=dict(values))) for (row, where), values in figures.items()
    ]
    rows = dict.fromkeys(row for row, _ in figures)
    listed = [{"method": row.method.name, "setting": row.setting.to_dict()} for row in rows]
    about = {"format": FORMAT, "suite": suite, "title": "Own suite", "rows": listed}
    return Results(out=Path("nowhere"), about=about, records=tuple(records), **more)


def write_about(out: Path, suite: str, title: str, rows: Sequence[Row], sequences: Sequence[tuple[str, str]]) -> None:
    """``eval.json``."""
    out.mkdir(parents=True, exist_ok=True)
    write_json_atomic(
        out / "eval.json",
        {
            "format": FORMAT,
            "suite": suite,
            "title": title,
            "networks": {row.method.base: {"label": NETWORK} for row in rows},
            "rows": [{"method": row.method.name, "setting": row.setting.to_dict()} for row in rows],
            "datasets": sorted({dataset for dataset, _ in sequences}),
            "sequences": [{"dataset": dataset, "sequence": sequence} for dataset, sequence in sequences],
            "missing_bases": [],
            "settings": {},
            "versions": {},
            "machine": {},
        },
    )


def write_evaluation(
    out: Path,
    rows: Sequence[Row],
    sequences: Sequence[tuple[str, str]],
    *,
    suite: str = "paper-table-1",
    title: str = "Uncertainty quality",
    unfinished: Sequence[tuple[str, str]] = (),
    failed: Mapping[tuple[str, str], str] | None = None,
) -> Path:
    """Write a folder. ``unfinished`` sequences have no record yet; ``failed`` sequences have a reason."""
    failed = failed or {}
    write_about(out, suite, title, rows, [*sequences, *unfinished, *failed])
    for dataset, sequence in sequences:
        write_sequence(out, suite, dataset, sequence, rows)
    for (dataset, sequence), reason in failed.items():
        folder = folder_of(out, dataset, sequence)
        folder.mkdir(parents=True)
        values = {"dataset": dataset, "sequence": sequence, "reason": reason, "rows": [row.slug for row in rows]}
        (folder / "failed.json").write_text(json.dumps(values))
    return out


def parsed(table: Table) -> dict[str, dict[str, str]]:
    """The cells of a table by label and "GROUP: HEADING"."""
    headings = [f"{group}: {name}" if group else name for group, name in table.cells.columns]
    lines = zip(table.cells.index, table.cells.to_numpy(), strict=True)
    return {label: dict(zip(headings, cells, strict=True)) for (_, label), cells in lines}


def check_latex(text: str) -> None:
    """Assert that LaTeX can compile the table: braces, environments, columns and characters."""
    bare = re.sub(r"\\[\\{}$&%#_]", "", text)
    assert bare.count("{") == bare.count("}")
    assert bare.count("$") % 2 == 0
    assert "%" not in bare
    assert re.findall(r"\\begin\{(\w+)\}", text) == ["table", "tabular"]
    assert re.findall(r"\\end\{(\w+)\}", text) == ["tabular", "table"]
    columns = len(re.search(r"\\begin\{tabular\}\{(\w+)\}", text)[1])
    body = text[text.index(r"\toprule") : text.index(r"\bottomrule")]
    rows = [line for line in body.splitlines() if line.endswith(r"\\")]
    for line in rows:
        spans = [int(n) - 1 for n in re.findall(r"\\multicolumn\{(\d+)\}", line)]
        assert len(re.findall(r"(?<!\\)&", line)) + 1 + sum(spans) == columns, line
    assert not re.search(r"[^\x00-\x7f]", text), "pdflatex knows no other characters without packages"

"""Results as lines, one figure each: what any other program wants to read."""

from __future__ import annotations

import csv
import io
import json
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from ufmstar_torch.eval.report.aggregate import mean_over, value_of
from ufmstar_torch.eval.report.load import FORMAT, Results
from ufmstar_torch.eval.results.files import to_json, write_atomic, write_json_atomic
from ufmstar_torch.eval.results.record import Record

HEAD = ("suite", "dataset", "sequence", "network", "method")
TABLE_HEAD = ("suite", "dataset", "network", "method")


def tidy_lines(results: Results) -> list[dict[str, Any]]:
    """One line per (suite, data set, sequence, network, method, setting, figure), with its value."""
    return [
        {
            **{name: getattr(record, name) for name in HEAD},
            "setting": dict(record.setting),
            "figure": key,
            "value": value,
        }
        for record in results.records
        for key, value in _values(record)
    ]


def table_lines(results: Results) -> list[dict[str, Any]]:
    """Means over sequences with the half-width of their 95 % intervals; the data set "*" stands for all together."""
    lines = []
    for dataset in (*results.datasets, *((None,) if len(results.datasets) > 1 else ())):
        for row in results.rows:
            records = results.of(row, dataset)
            for key in dict.fromkeys(key for record in records for key, _ in _values(record)):
                mean = mean_over([value_of(record, key) for record in records])
                first = records[0]
                lines.append(
                    {
                        **{name: getattr(first, name) for name in TABLE_HEAD},
                        "dataset": dataset or "*",
                        "setting": dict(first.setting),
                        "figure": key,
                        "mean": mean.value,
                        "half_width": mean.half,
                        "sequences": mean.sequences,
                    }
                )
    return lines


def write_tidy(results: Results) -> list[Path]:
    """Write ``results.json``, ``results.csv`` (lines) and ``table.csv`` (means) into the folder of the evaluation.

    Returns:
        Their paths.

    Raises:
        OSError: a file cannot be written.
    """
    lines, table = tidy_lines(results), table_lines(results)
    paths = [results.out / name for name in ("results.json", "results.csv", "table.csv")]
    write_json_atomic(
        paths[0],
        {
            "format": FORMAT,
            "suite": results.suite,
            "title": results.title,
            "lines": lines,
            "table": table,
            "failed": list(results.failed),
            "missing": [{"dataset": d, "sequence": s, "row": row.slug} for d, s, row in results.missing],
        },
    )
    _write_csv(paths[1], lines, HEAD, ("figure", "value"))
    _write_csv(paths[2], table, TABLE_HEAD, ("figure", "mean", "half_width", "sequences"))
    return paths


def _values(record: Record) -> Iterator[tuple[str, float | None]]:
    """(figure, value) of all numbers of a record: figures, then counts of frames, state and times."""
    yield from record.figures.items()
    for name in ("frames", "state", "ms"):
        group: Mapping[str, Any] = getattr(record, name)
        yield from ((f"{name}.{key}", value) for key, value in group.items() if isinstance(value, int | float))


def _write_csv(path: Path, lines: Iterable[Mapping[str, Any]], head: Sequence[str], tail: Sequence[str]) -> None:
    """Lines with a column for each setting; numbers in full, nothing for what is not there."""
    found = list(lines)
    settings = sorted({name for line in found for name in line["setting"]})
    text = io.StringIO(newline="")
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow([*head, *settings, *tail])
    for line in found:
        values = [line[h] for h in head] + [line["setting"].get(s) for s in settings] + [line[t] for t in tail]
        writer.writerow([_field(value) for value in values])
    write_atomic(path, lambda file: file.write(text.getvalue().encode()))


def _field(value: Any) -> str:
    plain = to_json(value)
    return "" if plain is None else plain if isinstance(plain, str) else json.dumps(plain)

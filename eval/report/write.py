"""Everything a report consists of, written into the folder of the evaluation."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

from ufmstar_torch.eval.report.latex import latex
from ufmstar_torch.eval.report.data import Results, load_results
from ufmstar_torch.eval.report.markdown import markdown
from ufmstar_torch.eval.report.paper_efficiency import paper_efficiency_tables
from ufmstar_torch.eval.report.table import Table
from ufmstar_torch.eval.report.tables import difference_table, extra_table, is_empty, main_table, sequence_tables
from ufmstar_torch.eval.report.tidy import write_tidy
from ufmstar_torch.eval.results.files import write_atomic


def write_report(out: Path, *, figures: bool = True, pictures: str = "svg") -> list[Path]:
    """Write tables, figures, one page of all and the tidy results of an evaluation, finished or not.

    Args:
        out: the folder of ``ufmstar eval``.
        figures: False = tables and results alone, without a page; needs no matplotlib.
        pictures: kind of the figures, "svg" or "png".

    Returns:
        The files, in the order in which they were written.

    Raises:
        ResultsError: the folder is no evaluation, or its records do not belong together.
        ValueError: another kind of figures, or a file with an example that cannot be read.
        ImportError: matplotlib or Pillow is missing.
        OSError: a file cannot be written.
    """
    results = load_results(out, with_sums=figures)
    files = [*write_tidy(results), *write_tables(results)]
    if figures:
        from ufmstar_torch.eval.report.figures import write_figures
        from ufmstar_torch.eval.report.page import write_page
        from ufmstar_torch.eval.report.pictures import write_pictures

        files += [*write_figures(results, pictures), *write_pictures(results, out)]
        files.append(write_page(results, out, files))
    return files


def write_tables(results: Results) -> list[Path]:
    """Write ``tables/NAME.md`` and ``tables/NAME.tex``: main, extra and differences over all sequences and, where
    there are several data sets, over those of each, ``sequences-DATASET`` for single sequences, and ``efficiency``
    with the paper's table 2 below ours where it was measured.

    Returns:
        Their paths.

    Raises:
        OSError: a file cannot be written.
    """
    folder = results.out / "tables"
    folder.mkdir(exist_ok=True)
    files: dict[str, list[Table]] = {}
    each = list(results.datasets) if len(results.datasets) > 1 else []
    for dataset in (None, *each):
        suffix = "" if dataset is None else f"-{dataset}"
        for make in (main_table, extra_table, difference_table):
            table = make(results, dataset)
            files[f"{table.name}{suffix}"] = [table]
    for dataset in results.datasets:
        files[f"sequences-{dataset}"] = sequence_tables(results, dataset)
    if results.efficiency is not None:
        files["efficiency"] = _efficiency(results.efficiency)
    written = []
    for name, tables in files.items():
        told = [table for table in tables if not is_empty(table)]
        for suffix, render in (("md", markdown), ("tex", latex)):
            if told:
                written.append(_write_text(folder / f"{name}.{suffix}", "\n".join(map(render, told))))
    return written


def _efficiency(measured: Mapping[str, Any]) -> list[Table]:
    """Ours, and the paper's below."""
    from ufmstar_torch.eval.bench.efficiency_table import efficiency_tables

    return [*efficiency_tables(measured), *paper_efficiency_tables(row["network"] for row in measured["rows"])]


def summary(results: Results) -> str:
    """The main table, and what is missing or has failed, for a terminal."""
    parts = [markdown(main_table(results))]
    if results.failed:
        parts.append("failed:\n" + "\n".join(f"  {f.dataset}, {f.sequence}: {f.reason}" for f in results.failed))
    if results.missing:
        parts.append(_missing(results))
    parts += [f"note: {note}" for note in results.notes]
    return "\n".join(parts)


def written(out: Path, files: Iterable[Path]) -> str:
    """A line for a terminal: the folder's files by name, those of its folders by number."""
    listed = list(files)
    folders = Counter(file.parent for file in listed if file.parent != out)
    told = [file.name for file in listed if file.parent == out]
    told += [f"{folder.name}/ ({count} files)" for folder, count in folders.items()]
    return f"{out}: {', '.join(told)}"


def _missing(results: Results) -> str:
    sequences: dict[tuple[str, str], int] = {}
    for dataset, sequence, _ in results.missing:
        sequences[dataset, sequence] = sequences.get((dataset, sequence), 0) + 1
    told = [f"  {dataset}, {sequence}: {count} row(s)" for (dataset, sequence), count in sequences.items()]
    more = [f"  and {len(told) - 10} more sequences"] if len(told) > 10 else []
    return "\n".join(["not evaluated yet (`ufmstar eval ... --resume` goes on):", *told[:10], *more])


def _write_text(path: Path, text: str) -> Path:
    write_atomic(path, lambda file: file.write(text.encode()))
    return path

"""``report.html``: the whole evaluation in one file that needs nothing else."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from pathlib import Path

from ufmstar_torch.eval.report.aggregate import value_of
from ufmstar_torch.eval.report.embed import MOST_BYTES, Embedder
from ufmstar_torch.eval.report.findings import count, join
from ufmstar_torch.eval.report.load import Results
from ufmstar_torch.eval.report.markup import Ids, Markup, tag
from ufmstar_torch.eval.report.page_findings import findings_part
from ufmstar_torch.eval.report.page_part import Part
from ufmstar_torch.eval.report.page_parts import (
    efficiency_part,
    figure_parts,
    glossary_part,
    made_part,
    picture_parts,
    problems_part,
    sequence_part,
    table_parts,
)
from ufmstar_torch.eval.report.page_style import SCRIPT, STYLE
from ufmstar_torch.eval.report.picture import read_index
from ufmstar_torch.eval.results.files import write_atomic

PAGE = "report.html"


def write_page(results: Results, out: Path, files: Iterable[Path], *, most_bytes: int = MOST_BYTES) -> Path:
    """Write the report.

    Args:
        results: of the evaluation.
        out: its folder; the words to the pictures of ``write_pictures`` are found in its ``figures``.
        files: all that was written; figures and pictures among them (SVG or PNG) are shown, the rest is not.
        most_bytes: of all pictures together; those that do not fit are named instead.

    Returns:
        The file.

    Raises:
        ValueError: a picture cannot be read.
        ImportError: Pillow is missing.
        OSError: the file cannot be written.
    """
    path = out / PAGE
    text = page(results, out / "figures", files, Embedder(most_bytes))
    write_atomic(path, lambda file: file.write(text.encode()))
    return path


def page(results: Results, folder: Path, files: Iterable[Path], embedder: Embedder) -> str:
    """The report as text; arguments as of ``write_page``."""
    written = list(files)
    pictures = [picture for picture in read_index(folder) if folder / picture.file in written]
    own = {folder / picture.file for picture in pictures}
    figures = [file for file in written if file.suffix in (".svg", ".png") and file not in own]
    efficiency = efficiency_part(results)
    parts = [
        findings_part(results),
        *table_parts(results),
        *figure_parts(figures, embedder),
        *picture_parts(pictures, folder, embedder),
        *([] if efficiency is None else [efficiency]),
        sequence_part(results),
        problems_part(results),
        made_part(results),
        glossary_part(),
    ]
    return _document(results, parts, embedder)


def _document(results: Results, parts: Sequence[Part], embedder: Embedder) -> str:
    ids = Ids()
    named = [(ids.new(part.title), part) for part in parts]
    contents = tag("ol", [tag("li", tag("a", part.title, href=f"#{name}")) for name, part in named])
    sections = [tag("section", tag("h2", part.title, id=name), part.body, aria_labelledby=name) for name, part in named]
    body = tag(
        "div",
        _head(results),
        tag("nav", tag("h2", "Contents"), contents, aria_label="contents"),
        tag("main", sections, _footer(embedder)),
        class_="frame",
    )
    head = tag(
        "head",
        tag("meta", charset="utf-8"),
        tag("meta", name="viewport", content="width=device-width, initial-scale=1"),
        tag("meta", name="referrer", content="no-referrer"),
        tag("title", f"{results.title} ({results.suite})"),
        tag("style", Markup(STYLE)),
    )
    document = tag("html", head, tag("body", body, tag("script", Markup(SCRIPT))), lang="en")
    return f"<!DOCTYPE html>\n{document}\n"


def _head(results: Results) -> Markup:
    """Title, what was evaluated, and how much of it."""
    sequences = results.sequences()
    frames = {
        (r.dataset, r.sequence): max(0, int(f)) for r in results.records if (f := value_of(r, "frames.done")) == f
    }
    facts = [
        (len(results.rows), "rows"),
        (len(sequences), "sequences" if len(sequences) > 1 else "sequence"),
        (sum(frames.values()), "frames"),
    ]
    told = [tag("li", tag("b", f"{value:,}".replace(",", "\u202f")), word) for value, word in facts if value]
    networks = join(list(dict.fromkeys(record.network for record in results.records)))
    return tag(
        "header",
        tag("h1", results.title),
        tag("p", f"Suite {results.suite}: {networks} on {join(list(results.datasets))}.", class_="lead"),
        tag("ul", told, class_="facts"),
    )


def _footer(embedder: Embedder) -> Markup:
    told = None
    if embedder.left_out:
        names = ", ".join(path.name for path in embedder.left_out)
        told = tag("p", f"{count(len(embedder.left_out), 'picture')} did not fit into this page: {names}.")
    made = tag(
        "p", "Made by ufmstar report. Tables as Markdown and LaTeX, figures and all numbers as CSV lie beside it."
    )
    return tag("footer", told, made)

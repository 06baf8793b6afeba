"""The part of the page that says what was found."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from ufmstar_torch.eval.methods.row import Row
from ufmstar_torch.eval.report.caveats import caveats
from ufmstar_torch.eval.report.findings import (
    ALONE_SEQUENCE,
    BETTER,
    OPEN,
    WORSE,
    Comparison,
    best_rows,
    comparisons,
    count,
    headlines,
)
from ufmstar_torch.eval.report.html_table import framed
from ufmstar_torch.eval.report.load import Results
from ufmstar_torch.eval.report.markup import Markup, tag, typeset
from ufmstar_torch.eval.report.names import DIFFERENCES, row_label
from ufmstar_torch.eval.report.page_part import Part, bullets, folded, paragraph
from ufmstar_torch.eval.report.table import number

# What the reader sees for a verdict, and its class.
_WORDS = {
    BETTER: ("better", "better"),
    WORSE: ("worse", "worse"),
    OPEN: ("open", "open"),
    ALONE_SEQUENCE: ("no verdict", "single"),
}


def findings_part(results: Results) -> Part:
    """Sentences, what to beware of, and a verdict for each comparison."""
    told = headlines(results) or ["No row of UfM* stands beside another row here, so there is nothing to compare."]
    body = [bullets(told, "findings")]
    warned = caveats(results)
    if warned:
        body += [tag("h3", "Before you believe it"), bullets(warned, "caveats")]
    found = comparisons(results)
    if found:
        body += [tag("h3", "UfM* beside the others"), paragraph(_HOW), _board(found, "All sequences")]
    if len(results.datasets) > 1:
        each = {dataset: of_one for dataset in results.datasets if (of_one := comparisons(results, dataset))}
        body += [folded(f"The same on {name} alone", _board(of_one, name)) for name, of_one in each.items()]
    best = best_rows(results)
    if best:
        body += [tag("h3", "Best rows"), bullets(best, "findings")]
    return Part("What was found", body)


_HOW = (
    "Means of the reference → of UfM*, over the sequences that both have. Better and worse are beyond chance: the 95 % "
    "interval of the difference on the same sequences leaves out 0. Open: it does not, or the difference prints as 0. "
    "The intervals stand under Paired differences."
)


def _board(found: Mapping[tuple[Row, Row], Sequence[Comparison]], title: str) -> Markup:
    """A line for each pair of rows, a verdict for each figure."""
    shown = [q for q in DIFFERENCES if any(c.quantity is q for made in found.values() for c in made)]
    heads = ["UfM*, beside", *(q.heading for q in shown)]
    lines = []
    for (row, reference), made in found.items():
        by_figure = {c.quantity.key: c for c in made}
        sequences = count(max(c.difference.sequences for c in made), "sequence")
        beside = tag("span", f"beside {row_label(reference)}, {sequences}", class_="beside")
        name = tag("th", row_label(row), " ", beside, scope="row")
        lines.append(tag("tr", name, [_verdict(by_figure.get(q.key)) for q in shown]))
    head = tag("thead", tag("tr", [tag("th", name, scope="col") for name in heads]))
    return framed(tag("table", tag("caption", title), head, tag("tbody", lines), class_="board"), title, ())


def _verdict(c: Comparison | None) -> Markup:
    if c is None:
        return tag("td", "–")
    word, class_ = _WORDS[c.verdict]
    decimals = c.quantity.decimals
    told = f"{number(c.theirs, decimals)} → {number(c.mine, decimals)}"
    return tag("td", tag("span", word, class_=f"verdict {class_}"), " ", typeset(told), title=c.words)

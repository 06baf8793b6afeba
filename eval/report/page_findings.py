"""The part of the page that says what was found."""

from __future__ import annotations

from collections.abc import Sequence

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
from ufmstar_torch.eval.report.load import Results
from ufmstar_torch.eval.report.markup import Markup, tag, typeset
from ufmstar_torch.eval.report.names import row_label
from ufmstar_torch.eval.report.page_part import Part, bullets, paragraph
from ufmstar_torch.eval.suite.row import Row

# What the reader sees for a verdict, and its class.
_WORDS = {
    BETTER: ("better", "better"),
    WORSE: ("worse", "worse"),
    OPEN: ("open", "open"),
    ALONE_SEQUENCE: ("no verdict", "single"),
}


def findings_part(results: Results) -> Part:
    """Sentences, what to beware of, and a card for each comparison."""
    told = headlines(results) or ["No row of UfM* stands beside another row here, so there is nothing to compare."]
    body = [bullets(told, "findings")]
    warned = caveats(results)
    if warned:
        body += [tag("h3", "Before you believe it"), bullets(warned, "caveats")]
    found = comparisons(results)
    if found:
        body += [tag("h3", "UfM* beside the others"), paragraph(_HOW), _cards(found)]
    if len(results.datasets) > 1:
        for dataset in results.datasets:
            of_one = comparisons(results, dataset)
            body += [tag("h3", f"The same on {dataset} alone"), _cards(of_one)] if of_one else []
    best = best_rows(results)
    if best:
        body += [tag("h3", "Best rows"), bullets(best, "findings")]
    return Part("What was found", body)


_HOW = (
    "Each figure goes from the reference's mean to that of UfM*; in brackets their mean difference on the same "
    "sequences, with its 95 % interval. Better and worse: the interval leaves out 0. Open: it does not."
)


def _cards(found: dict[tuple[Row, Row], list[Comparison]]) -> Markup:
    return tag("div", [_card(row, reference, made) for (row, reference), made in found.items()], class_="cards")


def _card(row: Row, reference: Row, made: Sequence[Comparison]) -> Markup:
    lines = []
    for verdict, (word, class_) in _WORDS.items():
        of_verdict = [c.words for c in made if c.verdict == verdict]
        if of_verdict:
            told = [tag("div", typeset(words)) for words in of_verdict]
            lines.append(tag("li", tag("span", word, class_=f"verdict {class_}"), tag("div", told)))
    sequences = max(c.difference.sequences for c in made)
    return tag(
        "article",
        tag("h3", row_label(row)),
        tag("p", f"beside {row_label(reference)}, {count(sequences, 'sequence')}"),
        tag("ul", lines),
        class_="card",
    )

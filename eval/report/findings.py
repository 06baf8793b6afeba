"""Sentences computed from the numbers of an evaluation: comparisons, best rows, and what limits them."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

from ufmstar_torch.eval.methods.method import ALONE, UFM, UFM_STAR
from ufmstar_torch.eval.methods.row import Row
from ufmstar_torch.eval.report import means, names
from ufmstar_torch.eval.report.data import Results
from ufmstar_torch.eval.report.table import number

BETTER, WORSE, OPEN, UNDECIDED = "better", "worse", "open", "no verdict"
# Where accuracy is below it, calibration means little (the paper's own caveat) [share of pixels].
POOR_ACCURACY = 0.5
# Where more pixels than that have no NLL, its mean is no longer that of the method [share].
MANY_LEFT_OUT = 0.01
# The paper's three: what "uncertainty quality" means there.
QUALITY = (names.NLL, names.ECE_DELTA, names.ECE_Q)


@dataclass(frozen=True)
class PairedComparison:
    """A row against another one in one figure, in pairs on the same sequences: means over the sequences that both have,
    and the mean of mine - theirs with its interval.
    """

    row: Row
    reference: Row
    quantity: names.Quantity
    mine: float
    theirs: float
    difference: means.Mean

    @property
    def verdict(self) -> str:
        """One of "better" and "worse" (beyond the interval), "open" (within it) and "no verdict" (no interval).

        A difference that prints as 0 is open too, however narrow its interval.
        """
        if not self.difference.decidable:
            return UNDECIDED
        if float(number(self.difference.value, self.quantity.decimals)) == 0:
            return OPEN
        verdict = means.better(self.difference, self.quantity)
        return OPEN if verdict is None else BETTER if verdict else WORSE

    @property
    def words(self) -> str:
        """ "NLL 1.33 → 0.96 (-0.37 ± 0.11)"."""
        return f"{self.quantity.name} {self.means}{_unit(self.quantity)} ({change(self.difference, self.quantity)})"

    @property
    def means(self) -> str:
        """ "1.33 → 0.96"."""
        return f"{number(self.theirs, self.quantity.decimals)} → {number(self.mine, self.quantity.decimals)}"


def change(mean: means.Mean, quantity: names.Quantity) -> str:
    """A difference with its interval, where there is one: "-0.37 ± 0.11"."""
    half = "" if math.isnan(mean.half) else f" ± {number(mean.half, quantity.decimals)}"
    return f"{number(mean.value, quantity.decimals, signed=True)}{half}"


def _unit(quantity: names.Quantity) -> str:
    return f" {quantity.unit}" if quantity.unit else ""


def compare(results: Results, row: Row, reference: Row, dataset: str | None = None) -> list[PairedComparison]:
    """A row against a reference in all figures that both have."""
    made = []
    for quantity in names.DIFFERENCES:
        pairs = means.paired(results.of(row, dataset), results.of(reference, dataset), quantity)
        if pairs:
            mine, theirs = (means.mean_over(side).value for side in zip(*pairs, strict=True))
            delta = means.mean_over(one - other for one, other in pairs)
            made.append(PairedComparison(row, reference, quantity, mine, theirs, delta))
    return made


def comparisons(
    results: Results, dataset: str | None = None, rows: Iterable[Row] | None = None
) -> dict[tuple[Row, Row], list[PairedComparison]]:
    """Rows against their references; None: every row of UfM* with its default settings."""
    if rows is None:
        rows = (row for row in results.rows if row.method.fusion == UFM_STAR and row.setting.plain)
    pairs = ((row, reference) for row in rows for reference in means.references(results, row))
    return {pair: made for pair in pairs if (made := compare(results, *pair, dataset))}


def headlines(results: Results) -> list[str]:
    """UfM* against the networks and against UfM, where it does not win, and what an ablation's settings change."""
    against = {
        name: [c for (_, ref), made in comparisons(results).items() if ref.method.fusion == fusion for c in made]
        for name, fusion in (("the network alone", ALONE), ("UfM", UFM))
    }
    sentences = [_tally(name, made) for name, made in against.items() if made]
    sentences += [_losses(c for made in against.values() for c in made)] if any(against.values()) else []
    return [*sentences, *_settings(results)]


def best_rows(results: Results) -> list[str]:
    """Which row has the best mean of each figure, and whether its lead is beyond chance."""
    return [sentence for quantity in (names.DELTA1, *names.DIFFERENCES) if (sentence := _best(results, quantity))]


def caveats(results: Results) -> list[str]:
    """What a reader must know before believing the figures."""
    notes = []
    if results.missing:
        sequences = {(dataset, sequence) for dataset, sequence, _ in results.missing}
        notes.append(f"Not finished: rows of {names.count(len(sequences), 'sequence')} are still to be evaluated.")
    if results.failed:
        notes.append(f"Left out, because of errors: {names.count(len(results.failed), 'sequence')}; see Problems.")
    n = len(results.sequences())
    notes.append(
        f"n = {n}: the figures are means over {names.count(n, 'sequence')}, each counting the same."
        if n >= means.MIN_SEQUENCES
        else f"n = {n}: with fewer than {means.MIN_SEQUENCES} sequences there are no confidence intervals and no "
        "verdicts; the means may be far from those of other sequences."
    )
    for dataset in results.datasets:
        values = [means.mean_of(results.of(row, dataset), names.DELTA1).value for row in results.rows]
        known = [value for value in values if not math.isnan(value)]
        accuracy = math.fsum(known) / len(known) if known else 1.0
        if accuracy < POOR_ACCURACY:
            notes.append(
                f"On {dataset} only {100 * accuracy:.0f} % of the pixels lie within 25 % of the truth (δ₁). Where "
                "accuracy is that poor, calibration means little, as the paper notes; look at the entropy there."
            )
    notes += _left_out(results)
    missing = results.about.get("missing_bases") or []
    if missing:
        notes.append(f"Rows left out because no network was given for them: {', '.join(missing)}.")
    return notes


def _tally(name: str, made: Sequence[PairedComparison]) -> str:
    """How often UfM* is better than one kind of reference, in the paper's figures, and by how much on average."""
    judged = [c for c in made if c.quantity in QUALITY]
    if not judged:
        return f"Against {name} there is no figure of NLL or calibration to compare."
    about = f"UfM* against {name}, {names.count(len(judged), 'comparison')} of NLL, ECE_δ and ECE_q"
    verdicts = [c.verdict for c in judged]
    if UNDECIDED in verdicts:
        lower = sum(
            (c.difference.value < 0) == (c.quantity.better == names.LOWER) for c in judged if c.difference.value
        )
        fewest = min(c.difference.sequences for c in judged)
        on = "a single sequence" if fewest == 1 else f"{fewest} sequences"
        return f"{about}: the better value in {lower}, on {on}, which decides nothing."
    counts = f"better in {verdicts.count(BETTER)}, worse in {verdicts.count(WORSE)}"
    # A mean over networks, as one number.
    changes = [_mean_change(of_figure) for q in QUALITY if (of_figure := [c for c in judged if c.quantity is q])]
    return f"{about}: {counts}, undecided in {verdicts.count(OPEN)}. On average {join(changes)}."


def _mean_change(made: Sequence[PairedComparison]) -> str:
    """How a figure changes on average over the bases: in its own unit where it can be negative, else in percent."""
    quantity = made[0].quantity
    change = math.fsum(c.difference.value for c in made) / len(made)
    before = math.fsum(c.theirs for c in made) / len(made)
    way = "falls" if change < 0 else "rises"
    if quantity is names.NLL or before <= 0:
        return f"{quantity.name} {way} by {number(abs(change), quantity.decimals)}"
    return f"{quantity.name} {way} by {100 * abs(change) / before:.0f} %"


def _losses(made: Iterable[PairedComparison]) -> str:
    """Where UfM* does not win."""
    judged = [c for c in made if c.verdict != UNDECIDED]
    worse = [c for c in judged if c.verdict == WORSE]
    if not judged:
        return f"With fewer than {means.MIN_SEQUENCES} sequences nothing can be said about where UfM* does not win."
    if not worse:
        return (
            f"In none of all {len(judged)} comparisons, ranking (AUSE, Spearman) included, is UfM* worse beyond chance."
        )
    listed = "; ".join(f"{names.row_label(c.row)} against {names.row_label(c.reference)}: {c.words}" for c in worse)
    return f"UfM* is worse beyond chance in {len(worse)} of all {len(judged)} comparisons: {listed}."


def _best(results: Results, quantity: names.Quantity) -> str:
    """Which row has the best mean of a figure, and whether its lead is beyond chance; "" where rows are not alike."""
    rows = [row for row in results.rows if row.setting.plain]
    if quantity is not names.DELTA1:
        rows = [row for row in rows if means.has_variance(results.of(row))]
    on = {frozenset((r.dataset, r.sequence) for r in results.of(row)) for row in rows}
    of = {row: means.mean_of(results.of(row), quantity) for row in rows}
    of = {row: mean for row, mean in of.items() if not math.isnan(mean.value)}
    if len(of) < 2 or len(on) > 1:
        return ""
    order = sorted(of, key=lambda row: of[row].value, reverse=quantity.better != names.LOWER)
    first, second = order[:2]
    value, runner_up = (number(of[row].value, quantity.decimals) for row in (first, second))
    with_unit = f"{value}{_unit(quantity)}"
    alike = [row for row in order[1:] if number(of[row].value, quantity.decimals) == value]
    if alike:
        shared = join([names.row_label(row) for row in (first, *alike)])
        return f"Best {quantity.name}: {with_unit}, shared by {shared}." if len(alike) < 6 else ""
    lead = means.difference(results.of(first), results.of(second), quantity)
    ranking = f"Best {quantity.name}: {names.row_label(first)} with {with_unit}, before {names.row_label(second)}"
    if not lead.decidable:
        return f"{ranking} ({runner_up})."
    beyond = "a lead beyond chance" if means.better(lead, quantity) else "a lead that may be chance"
    return f"{ranking} ({runner_up}; {beyond}, {change(lead, quantity)})."


def _settings(results: Results) -> list[str]:
    """For an ablation: which settings beat the default, figure by figure."""
    sentences = []
    varied = [row for row in results.rows if not row.setting.plain and row.method.fusion == UFM_STAR]
    pairs = [(row, row.base_line) for row in varied if row.base_line in results.rows]
    made = [c for pair in pairs for c in compare(results, *pair)]
    for quantity in names.DIFFERENCES:
        of_figure = [c for c in made if c.quantity is quantity and c.verdict != UNDECIDED]
        if not of_figure:
            continue
        parts = []
        for verdict in (BETTER, WORSE):
            listed = sorted((c for c in of_figure if c.verdict == verdict), key=lambda c: -abs(c.difference.value))
            named = "; ".join(f"{names.row_label(c.row)} {change(c.difference, c.quantity)}" for c in listed[:4])
            more = f"; and {len(listed) - 4} more" if len(listed) > 4 else ""
            parts.append(f"{verdict} with {len(listed)}{f' ({named}{more})' if listed else ''}")
        sentences.append(
            f"{quantity.name}, of {names.count(len(of_figure), 'setting')} beside the default: {', '.join(parts)}, "
            f"undecided with {sum(c.verdict == OPEN for c in of_figure)}."
        )
    return sentences


def join(parts: Sequence[str]) -> str:
    """ "a, b and c"."""
    return parts[0] if len(parts) == 1 else f"{', '.join(parts[:-1])} and {parts[-1]}"


def _left_out(results: Results) -> list[str]:
    shares = {}
    for row in results.rows:
        share = means.mean_over(means.value_of(record, "nll_left_out_share") for record in results.of(row)).value
        if share > MANY_LEFT_OUT:
            shares[row] = share
    if not shares:
        return []
    listed = ", ".join(f"{names.row_label(row)} {100 * share:.0f} %" for row, share in list(shares.items())[:6])
    more = f" and {len(shares) - 6} more rows" if len(shares) > 6 else ""
    return [
        f"NLL is not defined where a variance is 0, and leaves these pixels out: {listed}{more}. Read NLL with care."
    ]

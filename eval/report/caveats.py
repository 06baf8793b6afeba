"""What a reader must know before believing the figures of an evaluation."""

from __future__ import annotations

import math

from ufmstar_torch.eval.report.aggregate import mean_of, mean_over, value_of
from ufmstar_torch.eval.report.findings import count
from ufmstar_torch.eval.report.load import Results
from ufmstar_torch.eval.report.names import DELTA1, row_label

# Of a figure that says nothing where the networks are this bad (the paper's own caveat) [share of pixels].
POOR_ACCURACY = 0.5
# A share of pixels without an NLL from which its mean is no longer that of the method [share].
MANY_LEFT_OUT = 0.01


def caveats(results: Results) -> list[str]:
    """What a reader must know before believing the figures."""
    notes = []
    if results.missing:
        sequences = {(dataset, sequence) for dataset, sequence, _ in results.missing}
        notes.append(f"Not finished: rows of {count(len(sequences), 'sequence')} are still to be evaluated.")
    if results.failed:
        notes.append(f"Left out, because of errors: {count(len(results.failed), 'sequence')}; see Problems.")
    if len(results.sequences()) == 1:
        notes.append("There is one sequence, so there are no confidence intervals and no verdicts.")
    for dataset in results.datasets:
        accuracy = _mean_accuracy(results, dataset)
        if accuracy < POOR_ACCURACY:
            notes.append(
                f"On {dataset} only {100 * accuracy:.0f} % of the pixels lie within 25 % of the truth (δ₁). Where "
                "accuracy is that poor, calibration says little, as the paper notes; look at the entropy there."
            )
    notes += _left_out(results)
    missing = results.about.get("missing_bases") or []
    if missing:
        notes.append(f"Rows left out because no network was given for them: {', '.join(missing)}.")
    return notes


def _mean_accuracy(results: Results, dataset: str) -> float:
    """δ₁ of a data set, mean over all rows; 1 where there is none."""
    values = [mean_of(results.of(row, dataset), DELTA1).value for row in results.rows]
    known = [value for value in values if not math.isnan(value)]
    return math.fsum(known) / len(known) if known else 1.0


def _left_out(results: Results) -> list[str]:
    shares = {}
    for row in results.rows:
        found = mean_over([value_of(record, "nll_left_out_share") for record in results.of(row)]).value
        if found > MANY_LEFT_OUT:
            shares[row] = found
    if not shares:
        return []
    told = ", ".join(f"{row_label(row)} {100 * share:.0f} %" for row, share in list(shares.items())[:6])
    more = f" and {len(shares) - 6} more rows" if len(shares) > 6 else ""
    return [f"NLL is not defined where a variance is 0, and leaves these pixels out: {told}{more}. Read NLL with care."]

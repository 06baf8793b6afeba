"""What ``ufmstar eval`` prints in the end: the table over sequences, and where everything lies."""

from __future__ import annotations

from ufmstar_torch.eval.report.data import ResultsError, load_results
from ufmstar_torch.eval.report.text import summary, written
from ufmstar_torch.eval.report.write import write_report
from ufmstar_torch.eval.results.launch import EvalOutcome


def table(outcome: EvalOutcome) -> str:
    """The suite's table (mean and 95 % confidence interval over sequences), what was left out, and the folder."""
    job = outcome.job
    try:
        lines = [summary(load_results(job.out, with_sums=False))]
    except ResultsError as error:
        lines = [str(error)]
    if job.missing_bases:
        lines.append(f"left out, without a --network: the rows of {', '.join(job.missing_bases)}")
    lines.append(f"{job.out}: eval.json, records/DATASET/SEQUENCE/ with a record for every row")
    return "\n".join(lines)


def measure(outcome: EvalOutcome, threads: int | None = None) -> str | None:
    """Measure what a suite about efficiency needs, unless it exists; a line if it cannot be measured.

    Not while sequences are still to be evaluated: other parts (``--shard``) are at them, and would be timed along.

    Args:
        outcome: the evaluation.
        threads: of the CPU; None = all.

    Raises:
        OSError: the file cannot be written.
    """
    from ufmstar_torch.eval.bench.measure import EFFICIENCY, Plan, measure_job

    if not outcome.job.suite.efficiency or (outcome.job.out / EFFICIENCY).exists():
        return None
    try:
        if load_results(outcome.job.out, with_sums=False).missing:
            return f"no {EFFICIENCY} yet: it is measured when all sequences are evaluated"
        measure_job(outcome.job, Plan(threads=threads))
    except (ResultsError, ValueError) as error:
        return f"no {EFFICIENCY}: {' '.join(str(error).split())}"
    return None


def draw(outcome: EvalOutcome) -> str:
    """Draw tables and figures; a line with their place, or with the reason why there are none. Raises OSError: a file
    cannot be written."""
    try:
        report = write_report(outcome.job.out)
    except (ImportError, ResultsError) as error:
        return f"no report: {' '.join(str(error).split())}"
    return written(outcome.job.out, report)

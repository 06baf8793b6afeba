"""``ufmstar eval``: its options and printed output."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, Literal

from ufmstar_torch.eval.commands.depth import InferenceOptions
from ufmstar_torch.eval.commands.opening import Recording
from ufmstar_torch.eval.commands.options import (
    Count,
    Flag,
    MachineOptions,
    Text,
    Words,
    arg,
    as_dict,
    joined,
    one_of,
    reader,
    require_least,
)
from ufmstar_torch.eval.commands.terminal import Bars, stop_signals, usage_errors
from ufmstar_torch.eval.methods.method import UFM_STAR
from ufmstar_torch.eval.methods.setting import DEFAULTS, started
from ufmstar_torch.eval.methods.suite import listing, suite_named
from ufmstar_torch.eval.sequences.frame import parse_slice

if TYPE_CHECKING:
    from ufmstar_torch.eval.suite.job import EvalJob
    from ufmstar_torch.eval.suite.tasks import EvalOutcome

# Meaning of the options that an evaluation needs and a dry run does not.
_MISSING = {
    "root": "folders with sequences, [DATASET=]DIR, or tour:SEED for rendered rooms",
    "out": "the folder for the results",
}
# Options that are fields of a job with the same name.
_OF_JOB = ("device", "bins", "examples", "samples", "runtime", "precision")


@dataclass(frozen=True, kw_only=True)
class SuiteOptions:
    """Evaluate the rows of a suite on sequences.

    Attributes:
        suite: Evaluate the suite of this name (see --list), or of your own TOML file.
        base: A figure or ablation is about this network instead of the paper's: depth_only, ...
        ufm_preset: All rows of UfM* start from the paper's settings (UfMStarConfig.paper) or ours, not the suite's.
        network: Name a network for every base as BASE=MODEL:FILE[,FILE...]; rows without one are left out; repeatable.
            A FILE.json is its spec, --spec that of all others.
        list: Show the suites and stop.
    """

    suite: Text = None
    base: Text = None
    ufm_preset: Annotated[Literal["paper", "default"] | None, one_of("paper", "default")] = None
    network: Words = ()
    list: Flag = False


@dataclass(frozen=True, kw_only=True)
class DataOptions:
    """The sequences.

    Attributes:
        root: Take the sequences at or below [DATASET=]DIR, or tour:SEED; DATASET is the layout's name by default;
            repeatable.
        sequences: Draw this many sequences of each data set at random (the paper: 100; default: all).
        seed: Draw them with this seed.
        sequence_list: Take the sequences that this file names, one a line.
        frames: Take the frames START:STOP:STEP of each sequence, counted from 0 as Python does.
    """

    root: Words = ()
    sequences: Count = None
    seed: int = 0
    sequence_list: Text = None
    frames: Text = None

    def __post_init__(self) -> None:
        require_least(self, sequences=1, seed=0)


@dataclass(frozen=True, kw_only=True)
class EvalOutputOptions:
    """Output.

    Attributes:
        out: Write everything to this folder; of an evaluation there, compute what is missing, also rows and sequences
            added since.
        overwrite: Replace the evaluation in --out, but for the predictions in its cache.
        cache: Keep the networks' predictions in this folder (default: OUT/cache).
        examples: Keep some frames of this many sequences of each data set for pictures.
        bins: Calibration errors have 10 bins and 10 levels (ours), or 100 bins and 101 levels (authors).
        no_report: Make no tables and figures at the end; ufmstar report OUT makes them.
    """

    out: Text = None
    overwrite: Flag = False
    cache: Text = None
    examples: int = 3
    bins: Literal["ours", "authors"] = "ours"
    no_report: Flag = False

    def __post_init__(self) -> None:
        require_least(self, examples=0)


@dataclass(frozen=True, kw_only=True)
class EvalOptions(MachineOptions):
    """The rows of a table or figure of the paper, on sequences of your own.

    A sequence's rows are written when its last frame is done: whatever ends the program, the same command computes
    what is missing. The sequences can be divided: --processes on one computer, --scheduler on a Dask cluster.

    Attributes:
        device: Run on cpu or cuda; each of several --processes takes the next GPU in turn.
        threads: Each process uses this many CPU threads (default: all cores, divided among --processes).
        processes: Run this many processes on this computer.
        scheduler: Run on the Dask cluster of this scheduler, tcp://HOST:8786, whose workers see the same files.
        dry_run: Show rows, sequences and what is missing, and stop; needs --suite alone.
    """

    USAGE: ClassVar[str] = (
        "ufmstar eval --suite NAME --root [DATASET=]DIR ... --network BASE=MODEL:FILE[,FILE...] ... --out OUT [options]"
    )

    processes: int = 1
    scheduler: Text = None
    dry_run: Flag = False
    what: Annotated[SuiteOptions, arg(name="suite")]
    inference: InferenceOptions
    data: DataOptions
    opening: Recording
    output: EvalOutputOptions

    def __post_init__(self) -> None:
        require_least(self, processes=1)
        if self.what.list:
            return
        values = as_dict(self)
        for name in ("suite",) if self.dry_run else ("suite", "root", "network", "out"):
            if not values[name]:
                raise ValueError(f"--{name} is missing; ufmstar eval --help, and --list for the suites")
        parse_slice(self.data.frames)
        if self.scheduler is not None and self.processes > 1:
            raise ValueError("--processes are of this computer, --scheduler has its own: give one of them")


read = reader(EvalOptions, "ufmstar eval")


def main(options: EvalOptions) -> int:
    """Evaluate, print the results, and draw them; the exit code."""
    if options.what.list:
        print(listing())
        return 0
    with usage_errors(FileNotFoundError, ValueError):
        if not options.dry_run:
            return _evaluate(options)
        print("\n".join(_dry_run(options)))
    return 0


def job_from(options: EvalOptions) -> EvalJob:
    """The job of the options. Opens no sequence. Raises FileNotFoundError, ValueError: a file does not exist, options
    contradict each other, a base is named twice, no row has a network, or there is no sequence."""
    from ufmstar_torch.eval.engine.load import NetworkChoice
    from ufmstar_torch.eval.suite.job import EvalJob, require_methods
    from ufmstar_torch.eval.suite.work_items import find_work, read_names

    what, data, output, values = options.what, options.data, options.output, as_dict(options)
    suite = suite_named(str(what.suite), what.base, what.ufm_preset)
    require_methods(suite, options.opening.plugin)
    networks: dict[str, NetworkChoice] = {}
    for text in joined(what.network):
        choice = replace(NetworkChoice.parse(text).with_spec(values["spec"]), trust_code=values["trust_code"])
        if choice.base in networks:
            raise ValueError(f"--network: every base once, got {choice.base} twice: evaluate each into its own --out")
        networks[choice.base] = choice
    only = None if data.sequence_list is None else read_names(Path(data.sequence_list))
    items = find_work(
        joined(data.root), sample=data.sequences, seed=data.seed, only=only, opening=options.opening.of_reader
    )
    return EvalJob(
        suite=suite.with_bases(networks) if networks else suite,
        networks=networks,
        items=tuple(items),
        out=Path(str(output.out)),
        missing_bases=tuple(base for base in suite.bases if base not in networks),
        frames=parse_slice(data.frames),
        cache=None if output.cache is None else Path(output.cache),
        plugin=options.opening.plugin,
        **{name: values[name] for name in _OF_JOB},
    )


def _evaluate(options: EvalOptions) -> int:
    from ufmstar_torch.eval.engine.progress import warm_up_command
    from ufmstar_torch.eval.suite.tasks import evaluate_suite, executor_of

    how: dict[str, Any] = {"overwrite": options.output.overwrite}
    with Bars() as bars, stop_signals(bars.say) as stop:
        job = job_from(options)
        for base in job.unused:
            bars.say(_unused(base, job))
        if rows := [row for row in job.suite.rows if row.method.fusion == UFM_STAR]:
            anchors = {row.setting.anchors for row in rows}
            posterior = any(row.setting.posterior for row in rows)
            config = started(DEFAULTS, anchors=anchors != {""}, posterior=posterior)
            warm_up_command(config, bars.show, anchors)
        if sys.stderr.isatty():
            how["progress"] = bars.show
        with executor_of(options.processes, options.scheduler, job.device) as executor:
            outcome = evaluate_suite(job, executor, threads=options.threads, **how, stop=stop, report=bars.say)
    return _report(job, outcome, options)


def _report(job: EvalJob, outcome: EvalOutcome, options: EvalOptions) -> int:
    """Print the table, measure, draw the report, print the failures. Returns the exit code."""
    from ufmstar_torch.eval.engine.record import ResultsError
    from ufmstar_torch.eval.report.data import load_results
    from ufmstar_torch.eval.report.text import summary, written
    from ufmstar_torch.eval.report.write import write_report

    try:
        print(summary(load_results(job.out, with_sums=False)))
    except ResultsError as error:
        print(error)
    if job.missing_bases:
        print(f"left out, without a --network: the rows of {', '.join(job.missing_bases)}")
    print(f"{job.out}: eval.json, records/DATASET/SEQUENCE/ with a record for every row", flush=True)
    if outcome.finished and job.suite.efficiency:
        _measure(job, options.threads)
    if outcome.finished and not options.output.no_report:
        try:
            with Bars() as bars:
                report = write_report(job.out, progress=bars.show)
            print(written(job.out, report))
        except (ImportError, ResultsError) as error:
            print(f"no report: {' '.join(str(error).split())}")
    for label, reason in outcome.failed.items():
        print(f"ufmstar eval: {label} failed: {reason}", file=sys.stderr)
    if outcome.stopped:
        print(
            f"ufmstar eval: stopped; finished rows are in {job.out / 'records'}; the same command continues",
            file=sys.stderr,
        )
        return 130
    if outcome.failed or not outcome.finished:
        print("ufmstar eval: not all sequences are complete; the same command tries the rest again", file=sys.stderr)
        return 1
    return 0


def _measure(job: EvalJob, threads: int | None) -> None:
    """Measure time, energy and memory, unless their file exists. If that fails, print the reason."""
    from ufmstar_torch.eval.bench.measure import EFFICIENCY, Plan, measure_job

    if (job.out / EFFICIENCY).exists():
        return
    print("ufmstar eval: measuring time, energy and memory ...", file=sys.stderr)
    try:
        measure_job(job, Plan(threads=threads))
    except ValueError as error:
        print(f"no {EFFICIENCY}: {' '.join(str(error).split())}")


def _dry_run(options: EvalOptions) -> Iterator[str]:
    """Lines of what the evaluation would do and what is missing for it."""
    from ufmstar_torch.eval.suite.dry_run import network_lines, sequence_lines

    job, values = job_from(options), as_dict(options)
    yield from (_unused(base, job) for base in job.unused)
    yield from network_lines(job, suite_named(str(options.what.suite), options.what.base, options.what.ufm_preset))
    yield from (f"no --{name}: {meaning}" for name, meaning in _MISSING.items() if not values[name])
    yield from sequence_lines(job)


def _unused(base: str, job: EvalJob) -> str:
    return f"--network {base}=...: not used, suite {job.suite.name} has no row of it"

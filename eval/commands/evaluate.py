"""``ufmstar eval``: its options and printed output."""

from __future__ import annotations

import sys
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, ClassVar

import torch

from ufmstar_torch.eval.bench.measure import EFFICIENCY, Plan, measure_job
from ufmstar_torch.eval.commands.options import MachineOptions, as_dict, option, reader, usage_errors
from ufmstar_torch.eval.commands.terminal import Bars, stop_signals
from ufmstar_torch.eval.engine.load import NetworkChoice
from ufmstar_torch.eval.engine.warm_up import warm_up_command
from ufmstar_torch.eval.methods.method import NETWORKS, UFM_STAR
from ufmstar_torch.eval.methods.setting import DEFAULTS, PAPER, started
from ufmstar_torch.eval.methods.suite import listing, suite_named
from ufmstar_torch.eval.sequences.frame import parse_slice
from ufmstar_torch.eval.sequences.options import Options
from ufmstar_torch.eval.suite.job import EvalJob, require_methods, with_recalibrations
from ufmstar_torch.eval.suite.record import ResultsError
from ufmstar_torch.eval.suite.shards import EvalOutcome, evaluate_suite
from ufmstar_torch.eval.suite.work_items import ALL, Shard, find_work, read_names

# Options that are fields of a job with the same name.
_OF_JOB = ("device", "bins", "examples", "samples", "runtime", "precision")


@dataclass(frozen=True, kw_only=True)
class SuiteOptions:
    """Evaluate the rows of a suite on sequences.

    Attributes:
        suite: name of a suite (see --list), or a TOML file of your own
        base: the network that a figure or ablation is about, instead of the paper's: depth_only, ...
        ufm_preset: settings of UfM* in all its rows, instead of the suite's: paper (UfMStarConfig.paper) or default
        network: BASE=MODEL:FILE[,FILE...], one for every base; rows without one are left out; repeatable. A FILE.json
            is its spec. With paper-table-1, -2 and -4 a base may have a second one, whose time, energy and memory are
            measured as well
        spec: JSON file that declares what the weights of the networks without one do not say, as of ufmstar run
        trust_code: let files of exported and torchscript run their code; only for files whose origin you trust
        samples: passes of MC-Dropout of a row that needs all of them; default: 10
        runtime: auto: ONNX Runtime for weights in ONNX files, torch for the rest; or one of the two
        precision: of the networks; bf16: torch's autocast
        recalibration: file of `ufmstar recalibrate`: its row is judged under it as well, as a row of its own, on
            sequences other than those that it was fitted to; repeatable
        list: show the suites and stop
    """

    suite: str | None = None
    base: str | None = None
    ufm_preset: str | None = option(None, choices=(PAPER, DEFAULTS))
    network: tuple[str, ...] = option((), repeat=True)
    spec: str | None = None
    trust_code: bool = option(False, typed=True)
    samples: int | None = option(None, least=2)
    runtime: str = option("auto", choices=("auto", "torch", "onnx"))
    precision: str = option("float32", choices=("float32", "bf16"))
    recalibration: tuple[str, ...] = option((), repeat=True)
    list: bool = False


@dataclass(frozen=True, kw_only=True)
class DataOptions:
    """The sequences.

    Attributes:
        root: [DATASET=]DIR with sequences at or below it, or tour:SEED; without DATASET, the layout's name; repeatable
        sequences: number of sequences of each data set that are drawn at random (the paper: 100); default: all
        seed: of the draw
        sequence_list: file with the names of the sequences to take, one a line
        frames: START:STOP:STEP, which frames of a sequence, counted from 0 as Python does
    """

    root: tuple[str, ...] = option((), repeat=True)
    sequences: int | None = option(None, least=1)
    seed: int = option(0, least=0)
    sequence_list: str | None = None
    frames: str | None = None


@dataclass(frozen=True, kw_only=True)
class EvalOutputOptions:
    """Output.

    Attributes:
        out: folder for everything that is written
        resume: continue the evaluation in --out: compute what is missing, rows and sequences added since
        overwrite: replace the evaluation in --out; predictions in its cache are kept
        cache: folder of the networks' predictions; default: OUT/cache
        examples: number of sequences of each data set of which some frames are kept for pictures
        bins: of the calibration errors: ours (10 bins, 10 levels) or authors (100 bins, 101 levels); default: ours
        no_report: no tables and figures at the end; ufmstar report OUT makes them
    """

    out: str | None = None
    resume: bool = False
    overwrite: bool = False
    cache: str | None = None
    examples: int = option(3, least=0)
    bins: str = option("ours", choices=("ours", "authors"))
    no_report: bool = False


@dataclass(frozen=True, kw_only=True)
class EvalOptions(MachineOptions):
    """The rows of a table or figure of the paper, on sequences of your own.

    A sequence's rows are written when its last frame is done: whatever ends the program, --resume computes what is
    missing. The work can be divided: --processes on one computer, --shard in a cluster's job array.

    Attributes:
        device: cpu or cuda; of several --processes, each takes the next GPU in turn
        threads: number of CPU threads of each process; default: all cores, divided among --processes
        processes: number of processes on this computer
        shard: i/n, only the i-th of n parts of the sequences, 1/n to n/n
        dry_run: show rows and sequences, and what is missing, and stop; needs --suite alone
    """

    USAGE: ClassVar[str] = (
        "ufmstar eval --suite NAME --root [DATASET=]DIR ... --network BASE=MODEL:FILE[,FILE...] ... --out OUT [options]"
    )

    processes: int = option(1, least=1)
    shard: str | None = None
    dry_run: bool = False
    what: SuiteOptions
    data: DataOptions
    opening: Options
    output: EvalOutputOptions

    def __post_init__(self) -> None:
        if self.what.list:
            return
        values = as_dict(self)
        for name in ("suite",) if self.dry_run else ("suite", "root", "network", "out"):
            if not values[name]:
                raise ValueError(f"--{name} is missing; ufmstar eval --help, and --list for the suites")
        parse_slice(self.data.frames)
        _ = self.part
        if self.output.resume and self.output.overwrite:
            raise ValueError("--resume and --overwrite contradict each other")
        if self.shard and self.output.overwrite:
            raise ValueError("--overwrite goes without shards: another one may have begun")

    @property
    def part(self) -> Shard:
        """The shard. Raises ValueError: no such part."""
        return ALL if self.shard is None else Shard.parse(self.shard)


read = reader(EvalOptions, "ufmstar eval")


def main(options: EvalOptions) -> int:
    """Evaluate, print the results, and draw them; the exit code."""
    if options.what.list:
        print(listing())
        return 0
    with usage_errors(FileNotFoundError, ValueError):
        return _dry_run(options) if options.dry_run else _evaluate(options)


def job_from(options: EvalOptions) -> EvalJob:
    """The job of the options. Opens no sequence. Raises FileNotFoundError, ValueError: a file does not exist, options
    contradict each other, a base is named twice, no row has a network, or there is no sequence."""
    what, data, output, values = options.what, options.data, options.output, as_dict(options)
    suite = with_recalibrations(suite_named(str(what.suite), what.base, what.ufm_preset), what.recalibration)
    require_methods(suite, options.opening.plugin)
    architectures: list[dict[str, NetworkChoice]] = [{}]
    for text in what.network:  # a base's n-th network belongs to the n-th architecture
        choice = replace(NetworkChoice.parse(text).with_spec(what.spec), trust_code=what.trust_code)
        number = sum(choice.base in architecture for architecture in architectures)
        architectures += [{}] if number == len(architectures) else []
        architectures[number][choice.base] = choice
    networks, *further = architectures
    if further and not suite.efficiency:
        bases = ", ".join(text.partition("=")[0] for text in what.network)
        raise ValueError(f"--network: every base once, but in a suite that measures time and energy, got {bases}")
    only = None if data.sequence_list is None else read_names(Path(data.sequence_list))
    items = find_work(data.root, sample=data.sequences, seed=data.seed, only=only, opening=options.opening)
    return EvalJob(
        suite=suite.with_bases(networks) if networks else suite,
        networks=networks,
        further=tuple(further),
        items=tuple(items),
        out=Path(str(output.out)),
        missing_bases=tuple(base for base in suite.bases if base not in networks),
        frames=parse_slice(data.frames),
        cache=None if output.cache is None else Path(output.cache),
        plugin=options.opening.plugin,
        **{name: values[name] for name in _OF_JOB},
    )


def _evaluate(options: EvalOptions) -> int:
    how: dict[str, Any] = {"resume": options.output.resume, "overwrite": options.output.overwrite}
    how |= {"processes": options.processes, "threads": options.threads}
    with Bars() as bars, stop_signals(bars.say) as stop:
        job = job_from(options)
        for base in job.unused:
            bars.say(f"--network {base}=...: not used, suite {job.suite.name} has no row of it")
        if rows := [row for row in job.suite.rows if row.method.fusion == UFM_STAR]:
            anchors = {row.setting.anchors for row in rows}
            posterior = any(row.setting.posterior for row in rows)
            config = started(DEFAULTS, anchors=anchors != {""}, posterior=posterior)
            warm_up_command(config, bars.show, anchors)
        if sys.stderr.isatty():
            how["progress"] = bars.show
        outcome = evaluate_suite(job, shard=options.part, **how, stop=stop, report=bars.say)
    return _report(job, outcome, options)


def _report(job: EvalJob, outcome: EvalOutcome, options: EvalOptions) -> int:
    """Print the table, measure, draw the report, print the failures. Returns the exit code."""
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
    if outcome.complete and job.suite.efficiency:
        _measure(job, options.threads)
    if outcome.complete and not options.output.no_report:
        try:
            print(written(job.out, write_report(job.out)))
        except (ImportError, ResultsError) as error:
            print(f"no report: {' '.join(str(error).split())}")
    for label, reason in outcome.failed.items():
        print(f"ufmstar eval: {label} failed: {reason}", file=sys.stderr)
    if outcome.stopped:
        print(f"ufmstar eval: stopped; finished rows are in {job.out / 'records'}; --resume continues", file=sys.stderr)
        return 130
    if outcome.failed or not outcome.finished:
        print("ufmstar eval: not all sequences are complete; --resume tries the rest again", file=sys.stderr)
        return 1
    if not outcome.complete:
        print("ufmstar eval: this shard is complete, others are not: the last one makes the report", file=sys.stderr)
    return 0


def _measure(job: EvalJob, threads: int | None) -> None:
    """Measure time, energy and memory, unless their file exists. If that fails, print the reason."""
    if (job.out / EFFICIENCY).exists():
        return
    print("ufmstar eval: measuring time, energy and memory ...", file=sys.stderr)
    try:
        measure_job(job, Plan(threads=threads))
    except ValueError as error:
        print(f"no {EFFICIENCY}: {' '.join(str(error).split())}")


# What an evaluation needs beside its networks, by the option that is missing in a dry run.
_MISSING = {
    "root": "folders with sequences, [DATASET=]DIR, or tour:SEED for rendered rooms",
    "out": "the folder for the results",
}


def _dry_run(options: EvalOptions) -> int:
    """Print the rows with their networks and needs, and the sequences with their number of frames."""
    job, suite = job_from(options), suite_named(str(options.what.suite), options.what.base, options.what.ufm_preset)
    for base in job.unused:
        print(f"--network {base}=...: not used, suite {job.suite.name} has no row of it")
    networks, items = job.load(torch.device("cpu")), options.part.of(job.items)
    rows = [*job.suite.rows, *(row for row in suite.rows if row not in job.suite.rows)]
    print(f"{job.suite.name}: {job.suite.title}\n{len(rows)} rows:")
    for row in rows:
        network = networks.get(row.method.base)
        print(f"  {row.label}  [{'no network' if network is None else network.label}]  needs {row.needs}")
    if job.missing_bases:
        print("left out, without a --network:")
        for base in job.missing_bases:
            print(f"  --network {base}=MODEL:FILE: {NETWORKS[base]}")
    if job.suite.efficiency:
        print("measures time, energy and memory: energy needs zeus and a meter (NVML, AMD SMI, RAPL, Jetson's rails)")
    values = as_dict(options)
    for name, words in _MISSING.items():
        if not values[name]:
            print(f"no --{name}: {words}")
    print(f"{len(items)} of {len(job.items)} sequences:")
    total = 0
    for item in items:
        try:
            frames = len(range(len(item.open()))[job.frames])
        except (OSError, ValueError) as error:
            print(f"  {item.label}: cannot be opened: {' '.join(str(error).split())}")
            continue
        print(f"  {item.label}: {frames} frames")
        total += frames
    print(f"{total} frames, {len(items) * len(job.suite.rows)} records")
    return 0

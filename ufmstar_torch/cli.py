"""The command line, ``ufmstar COMMAND ...``: the roof of the package, imported by nobody.

Each command imports what it needs when it is called, so that help and errors come at once.
"""

from __future__ import annotations

import sys
import traceback
from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from ufmstar_torch.eval.results.launch import Ended

OK, FAILED, USAGE, INTERRUPTED = 0, 1, 2, 130
_HELP = """usage: ufmstar COMMAND ...

Calibrated per-pixel variance for monocular depth, from the disagreement between views (UfM*).

commands:
{commands}

ufmstar COMMAND --help tells a command's options, ufmstar --version the version.
"""


class UsageError(Exception):
    """What the user asked for cannot be done; the message is one line that says why."""


def main(arguments: Sequence[str] | None = None) -> int:
    """Run a command and return its exit code: 0 done, 1 failed, 2 wrong usage, 130 interrupted.

    Args:
        arguments: without the program's name; None = the process's.
    """
    words = list(sys.argv[1:] if arguments is None else arguments)
    if words[:1] in ([], ["-h"], ["--help"]):
        told = "\n".join(f"  {name:8}{(command.__doc__ or '').splitlines()[0]}" for name, command in COMMANDS.items())
        print(_HELP.format(commands=told), end="")
        return OK if words else USAGE
    if words == ["--version"]:
        from ufmstar_torch import __version__

        print(__version__)
        return OK
    if words[0] not in COMMANDS:
        return _told(f"ufmstar: no command {words[0]!r}, there are {', '.join(COMMANDS)}", USAGE)
    try:
        return COMMANDS[words[0]](words[1:])
    except UsageError as error:
        return _told(f"ufmstar {words[0]}: {error}", USAGE)
    except KeyboardInterrupt:
        return _told(f"ufmstar {words[0]}: interrupted", INTERRUPTED)


def run(arguments: Sequence[str]) -> int:
    """depth and variance of a sequence of posed images, onto disk"""
    from jsonargparse import ArgumentError

    from ufmstar_torch.eval.commands.run_options import check_options, parse_run, run_parser

    try:
        options = parse_run(run_parser(), arguments)
        check_options(options)
    except (ArgumentError, ValueError) as error:
        raise UsageError(_one_line(error)) from error
    try:
        summary = _run(options)
    except (ImportError, OSError, RuntimeError, TypeError, ValueError) as error:
        # What a network or a full disk may raise: one line for a user, the traceback on request.
        if options["debug"]:
            traceback.print_exc()
        return _told(f"ufmstar run: failed: {_one_line(error)}", FAILED)
    return _report(summary, options["out"])


def bench(arguments: Sequence[str]) -> int:
    """time per stage and memory, beside the depth network's own"""
    from ufmstar_torch.eval.bench import benchmark

    return int(benchmark.main(list(arguments)) or OK)


def train(arguments: Sequence[str]) -> int:
    """a network with an uncertainty head, or an ensemble of them"""
    from jsonargparse import ArgumentError

    from ufmstar_torch.train.options import job_from, parse_train, train_parser

    try:
        options = parse_train(train_parser(), arguments)
        if options["list"]:
            from ufmstar_torch.train.presets import table

            print(table())
            return OK
        _set_threads(options["threads"])
        job = job_from(options)
    except (ArgumentError, ImportError, OSError, ValueError) as error:
        raise UsageError(_one_line(error)) from error
    from lightning.pytorch.utilities import rank_zero_only

    from ufmstar_torch.eval.commands.terminal import stop_signals
    from ufmstar_torch.train.fit import fit, report
    from ufmstar_torch.train.start import missing_start

    process: Any = rank_zero_only
    remark = missing_start(job.recipe.network, job.settings.init)
    if remark and process.rank == 0:
        print(f"ufmstar train: {remark}", file=sys.stderr)
    how = {"resume": options["resume"], "overwrite": options["overwrite"]}
    try:
        with stop_signals(lambda text: print(text, file=sys.stderr), "step") as stop:
            summary = fit(job, asked=stop, command=["ufmstar", "train", *arguments], **how)
    except (ImportError, OSError, RuntimeError, TypeError, ValueError) as error:
        if options["debug"]:
            traceback.print_exc()
        return _told(f"ufmstar train: failed: {_one_line(error)}", FAILED)
    if "members" not in summary:
        return OK  # a further process of a distributed training: the first one tells
    print(report(summary))
    print(f"{job.settings.out}: trained.safetensors, summary.json, member_*/, tensorboard/")
    if summary["stopped"] is None:
        return OK
    return _told(f"ufmstar train: {summary['stopped']}; --resume goes on", INTERRUPTED)


def evaluate(arguments: Sequence[str]) -> int:
    """the rows of a table or figure of the paper, on your own sequences"""
    from jsonargparse import ArgumentError

    from ufmstar_torch.eval.commands.eval_options import check_options, eval_parser, parse_eval

    try:
        options = parse_eval(eval_parser(), arguments)
        if options["list"]:
            from ufmstar_torch.eval.methods.suites import listing

            print(listing())
            return OK
        check_options(options)
    except (ArgumentError, ValueError) as error:
        raise UsageError(_one_line(error)) from error
    from ufmstar_torch.eval.results.cache import CacheError

    try:
        _set_threads(options["threads"])
        if options["dry_run"]:
            return _dry_run(options)
        return _evaluate(options)
    except (FileNotFoundError, ValueError) as error:
        if options["debug"]:
            traceback.print_exc()
        raise UsageError(_one_line(error)) from error
    except (CacheError, ImportError, OSError, RuntimeError) as error:
        if options["debug"]:
            traceback.print_exc()
        return _told(f"ufmstar eval: failed: {_one_line(error)}", FAILED)


def report(arguments: Sequence[str]) -> int:
    """tables, figures and a page from what eval has left"""
    from ufmstar_torch.eval.commands.report_options import parse_report

    options = parse_report(arguments)
    from ufmstar_torch.eval.report.load import ResultsError, load_results
    from ufmstar_torch.eval.report.write import summary, write_report, written

    try:
        print(summary(load_results(options.out, with_sums=False)))
        files = write_report(options.out, figures=not options.no_figures, pictures=options.format)
    except ResultsError as error:
        raise UsageError(_one_line(error)) from error
    except (ImportError, OSError, ValueError) as error:
        if options.debug:
            traceback.print_exc()
        return _told(f"ufmstar report: failed: {_one_line(error)}", FAILED)
    print(written(options.out, files))
    return OK


def demo(arguments: Sequence[str]) -> int:
    """the main job on rendered rooms, with nothing but this package"""
    from ufmstar_torch.eval.commands.demo_options import parse_demo

    options = parse_demo(arguments)
    try:
        summary = _demo(options)
    except (ImportError, OSError, RuntimeError, TypeError, ValueError) as error:
        if options.debug:
            traceback.print_exc()
        return _told(f"ufmstar demo: failed: {_one_line(error)}", FAILED)
    from ufmstar_torch.eval.report.demo_report import explanation, table

    print(table(summary), explanation(summary), sep="\n\n")
    return OK


def data(arguments: Sequence[str]) -> int:
    """check: whether a sequence's poses, depth and images fit together"""
    from ufmstar_torch.eval.commands.data_command import check
    from ufmstar_torch.eval.commands.data_options import parse_data

    try:
        own, options = parse_data(arguments)
        text, fine = check(own.path, own.pairs, own.json, options)
    except (OSError, ValueError) as error:
        raise UsageError(_one_line(error)) from error
    print(text)
    return OK if fine else FAILED


COMMANDS: dict[str, Callable[[Sequence[str]], int]] = {
    "demo": demo,
    "run": run,
    "eval": evaluate,
    "report": report,
    "bench": bench,
    "train": train,
    "data": data,
}


def _run(options: Mapping[str, Any]) -> dict[str, Any]:
    """Open what the options name, and run it.

    Raises:
        UsageError: it cannot be opened.
    """
    from ufmstar_torch.eval.commands.run import run as run_job
    from ufmstar_torch.eval.commands.run_job import job_from
    from ufmstar_torch.eval.commands.terminal import Bars, stop_signals
    from ufmstar_torch.eval.results.folder import FolderError

    try:
        _set_threads(options["threads"])
        job = job_from(options)
    except (ImportError, OSError, ValueError) as error:
        if options["debug"]:
            traceback.print_exc()
        raise UsageError(_one_line(error)) from error
    try:
        with Bars() as bars, stop_signals(bars.say) as stop:
            return run_job(
                job,
                options["out"],
                resume=options["resume"],
                overwrite=options["overwrite"],
                progress=bars.show,
                stop=stop,
            )
    except FolderError as error:
        raise UsageError(str(error)) from error


def _evaluate(options: Mapping[str, Any]) -> int:
    """Evaluate, tell the results, and draw them; the exit code.

    Raises:
        FileNotFoundError, ValueError: it cannot be begun.
        CacheError, ImportError, OSError, RuntimeError: it cannot be finished.
    """
    from ufmstar_torch.eval.commands.terminal import Bars, stop_signals
    from ufmstar_torch.eval.results.launch import evaluate_suite

    with Bars() as bars, stop_signals(bars.say) as stop:
        ended = evaluate_suite(options, stop=stop, tell=bars.say, progress=bars.frames)
    if ended.tells:
        return _tell(ended, options["threads"], draws=not options["no_report"])
    return OK if ended.finished else INTERRUPTED


def _tell(ended: Ended, threads: int | None, *, draws: bool) -> int:
    """The table, the measurements and pictures that belong to it, and what is broken; the exit code."""
    from ufmstar_torch.eval.commands.outcome import draw, measure, table

    print(table(ended), flush=True)
    if ended.finished:
        if ended.job.suite.efficiency:
            print("ufmstar eval: measuring time, energy and memory ...", file=sys.stderr)
        for told in (measure(ended, threads), draw(ended) if draws else None):
            if told is not None:
                print(told)
    for label, reason in ended.failed.items():
        print(f"ufmstar eval: {label} failed: {reason}", file=sys.stderr)
    if ended.stopped:
        return _told("ufmstar eval: stopped; --resume goes on", INTERRUPTED)
    if ended.failed or not ended.finished:
        return _told("ufmstar eval: not all is there; --resume tries the rest again", FAILED)
    return OK


def _dry_run(options: Mapping[str, Any]) -> int:
    """Show what the options would do.

    Raises:
        FileNotFoundError, ImportError, ValueError: it could not be begun.
    """
    import torch

    from ufmstar_torch.eval.commands.dry_run import dry_run
    from ufmstar_torch.eval.commands.eval_options import job_from
    from ufmstar_torch.eval.results.worklist import Shard

    job = job_from(options)
    print(dry_run(job, job.load(torch.device("cpu")), Shard.parse(options["shard"] or "1/1")))
    return OK


def _demo(options: Any) -> dict[str, Any]:
    """Run the demo.

    Raises:
        UsageError: the options do not fit, or what they name is not there.
    """
    from ufmstar_torch.eval.commands.demo import DemoError, DemoOptions, run_demo
    from ufmstar_torch.eval.commands.terminal import Bars
    from ufmstar_torch.eval.results.folder import FolderError

    try:
        _set_threads(options.threads)
    except ValueError as error:
        raise UsageError(str(error)) from error
    try:
        chosen = DemoOptions(
            out=options.out,
            frames=options.frames,
            seed=options.seed,
            weights=options.weights,
            device=options.device,
            overwrite=options.overwrite,
        )
        with Bars() as bars:
            return run_demo(chosen, bars.show)
    except (DemoError, FolderError, FileNotFoundError) as error:
        raise UsageError(_one_line(error)) from error


def _report(summary: Mapping[str, Any], out: str) -> int:
    """Print the table and where the outputs are; the exit code."""
    from ufmstar_torch.eval.results.summary import FINISHED, table
    from ufmstar_torch.eval.results.summary import INTERRUPTED as STOPPED

    if summary["frames"]["done"]:
        print(table(summary))
    made = [name for name, reason in summary["outputs"].items() if reason is None]
    for name, reason in summary["outputs"].items():
        if reason is not None:
            print(f"no {name}: {reason}")
    print(f"{out}: {', '.join(['summary.json', 'frames.jsonl', 'frames/', 'depth/', 'sigma/', *made])}")
    told = f"ufmstar run: {summary['state']}: {summary['reason']}"
    if summary["state"] == FINISHED:
        print(told)
        return OK
    return _told(told, INTERRUPTED if summary["state"] == STOPPED else FAILED)


def _set_threads(count: int | None) -> None:
    """CPU threads of torch, and with it of the compiled kernels.

    Raises:
        ValueError: not a positive number.
    """
    if count is None:
        return
    if count < 1:
        raise ValueError(f"--threads must be at least 1, got {count}")
    import torch

    torch.set_num_threads(count)


def _one_line(error: BaseException) -> str:
    return " ".join(str(error).split()) or type(error).__name__


def _told(text: str, code: int) -> int:
    print(text, file=sys.stderr)
    return code


if __name__ == "__main__":
    sys.exit(main())

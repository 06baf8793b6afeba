"""``ufmstar train``: trains what its options say, and prints the results."""

from __future__ import annotations

import sys
from collections.abc import Mapping, Sequence
from typing import Any

from ufmstar_torch.eval.commands.options import UsageError


def read(words: Sequence[str]) -> dict[str, Any]:
    """The options of a command line.

    Raises:
        ValueError: an unknown option, or a value of the wrong kind.
        SystemExit: help was asked for.
    """
    from jsonargparse import ArgumentError

    from ufmstar_torch.train.options import parse_train, train_parser

    try:
        return {**parse_train(train_parser(), words), "words": list(words)}
    except ArgumentError as error:
        raise ValueError(error) from error


def main(options: Mapping[str, Any]) -> int:
    """Train, and print the results; the exit code."""
    from ufmstar_torch.train.options import job_from

    if options["list"]:
        from ufmstar_torch.train.presets import table

        print(table())
        return 0
    try:
        job = job_from(options)
    except (ImportError, OSError, ValueError) as error:
        raise UsageError(error) from error
    from lightning.pytorch.utilities import rank_zero_only

    from ufmstar_torch.eval.commands.terminal import stop_signals
    from ufmstar_torch.train.fit import fit, report
    from ufmstar_torch.train.start import missing_start

    process: Any = rank_zero_only
    remark = missing_start(job.recipe.network, job.settings.init)
    if remark and process.rank == 0:
        print(f"ufmstar train: {remark}", file=sys.stderr)
    how = {"resume": options["resume"], "overwrite": options["overwrite"]}
    with stop_signals(lambda text: print(text, file=sys.stderr), "step") as stop:
        summary = fit(job, asked=stop, command=["ufmstar", "train", *options["words"]], **how)
    if "members" not in summary:
        return 0  # a further process of a distributed training: the first one reports
    print(report(summary))
    print(f"{job.settings.out}: trained.safetensors, summary.json, member_*/, tensorboard/")
    if summary["stopped"] is None:
        return 0
    print(f"ufmstar train: {summary['stopped']}; --resume goes on", file=sys.stderr)
    return 130

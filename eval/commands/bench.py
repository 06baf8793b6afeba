"""``ufmstar bench``: its options are ``BenchSettings``; prints the table and writes JSON."""

from __future__ import annotations

import sys

from ufmstar_torch.eval.bench.settings import BenchSettings
from ufmstar_torch.eval.commands.errors import usage_errors
from ufmstar_torch.eval.commands.options import reader

read = reader(BenchSettings, "ufmstar bench")


def main(options: BenchSettings) -> int:
    """Run the benchmark, print its table and write its JSON; the exit code."""
    from ufmstar_torch.eval.bench.benchmark import format_report, run_benchmark
    from ufmstar_torch.eval.engine.files import write_json_atomic

    with usage_errors(ValueError, FileNotFoundError, ModuleNotFoundError):
        report = run_benchmark(options, progress=lambda text: print(text, file=sys.stderr, flush=True))
    print(format_report(report))
    if options.json is not None:
        write_json_atomic(options.json, report)
    return 0

"""The command line, ``ufmstar COMMAND ...``. No other module imports this one.

A command is a module with two functions: ``read(words)`` parses its options, and ``main(options)`` runs it and returns
the exit code. Its module is imported only when the command is called, and imports torch
and the like in its functions, so that help and errors appear at once.
"""

from __future__ import annotations

import os
import sys
import traceback
from collections.abc import Sequence
from importlib import import_module
from io import TextIOWrapper
from typing import Any

from ufmstar_torch.runtime.optional import naming_extra

OK, FAILED, USAGE, INTERRUPTED = 0, 1, 2, 130
CLOSED = 141  # of a program that SIGPIPE ends
# By name: module and purpose.
COMMANDS: dict[str, tuple[str, str]] = {
    "demo": ("eval.commands.demo", "the method on rendered rooms, without data or weights"),
    "run": ("eval.commands.run", "depth and variance of a sequence of posed images, onto disk"),
    "rank": ("eval.commands.rank", "which images of a pool to label, the most uncertain first"),
    "eval": ("eval.commands.evaluate", "the rows of a table or figure of the paper, on your own sequences"),
    "live": ("eval.commands.live", "depth and variance of a camera, or of a recording at its pace"),
    "report": ("eval.commands.report", "tables, figures and a page from the results of eval"),
    "bench": ("eval.commands.bench", "time per stage and memory, beside the depth network's own"),
    "train": ("train.command", "a network with an uncertainty head, or an ensemble of them"),
    "export": ("eval.commands.export", "a run's result as depth maps, a cloud, a trajectory or transforms.json"),
    "poses": ("eval.commands.poses", "poses and landmarks of a video that has none, by structure from motion"),
    "recalibrate": ("eval.commands.recalibrate", "fit a map of the variance to sequences with ground truth"),
    "data": ("eval.commands.data", "data check SEQUENCE: test if its poses, depth and images fit together"),
}
_HELP = """usage: ufmstar COMMAND ...

UfM* corrects the depth of monocular networks and states its standard deviation at every pixel, from a video with poses.
Without the correction (--plain), a constant deviation was better calibrated on each of four recordings (README.md).

commands:
{commands}

ufmstar COMMAND --help shows a command's options, ufmstar --version the version, and
ufmstar --version --system versions and hardware for a report of a problem.
"""
# Errors of a network, a file or a full disk, printed as one line; --debug adds the traceback.
_FAILURES = (ImportError, MemoryError, OSError, RuntimeError, TypeError, ValueError)

# OpenMP starts any number of threads; thousands of them stall the machine and crash torch.
_MOST_THREADS = 64


def main(arguments: Sequence[str] | None = None) -> int:
    """Run a command and return its exit code: 0 done, 1 failed, 2 wrong usage, 130 interrupted, 141
    the reader closed the output.

    Args:
        arguments: without the program's name; None = ``sys.argv[1:]``.
    """
    if isinstance(sys.stdout, TextIOWrapper):  # a terminal may not have the letters of a file's name
        sys.stdout.reconfigure(errors="backslashreplace")
    try:
        try:
            return _main(list(sys.argv[1:] if arguments is None else arguments))
        finally:
            if sys.stdout is not None:  # it is None in a process without an output
                sys.stdout.flush()
    except BrokenPipeError:  # the reader of the output has closed it, as `head` does
        _silence()
        return CLOSED


def _main(words: Sequence[str]) -> int:
    """Run the command of the words and return its exit code. Raises BrokenPipeError: the reader closed the output."""
    if words[:1] in ([], ["-h"], ["--help"]):
        commands = "\n".join(f"  {name:13}{purpose}" for name, (_, purpose) in COMMANDS.items())
        print(_HELP.format(commands=commands), end="")
        return OK if words else USAGE
    if words[0] == "--version" and words[1:] in ([], ["--system"]):
        from ufmstar_torch import __version__

        print(__version__ if words == ["--version"] else _system())
        return OK
    if words[0] not in COMMANDS:
        return _end(f"ufmstar: no command {words[0]!r}, there are {', '.join(COMMANDS)}", USAGE)
    return _run(words[0], words[1:])


def _system() -> str:
    """Versions and hardware, a line each."""
    from ufmstar_torch.eval.run.machine import system

    return "\n".join(f"{name:22} {value}" for name, value in system().items())


def _run(name: str, words: Sequence[str]) -> int:
    """Import the command, parse its options, and run it; convert errors to one line and an exit code."""
    from ufmstar_torch.eval.commands.terminal import UsageError

    debug = "--debug" in words
    try:
        command = import_module(f"ufmstar_torch.{COMMANDS[name][0]}")
        try:
            options = command.read(words)
            _set_up(options)
        except BrokenPipeError:
            raise
        except (OSError, ValueError) as error:
            raise UsageError(error) from error
        return int(command.main(options))
    except UsageError as error:
        if debug:
            traceback.print_exc()
        return _end(f"ufmstar {name}: {_one_line(error)}", USAGE)
    except KeyboardInterrupt:
        return _end(f"ufmstar {name}: interrupted", INTERRUPTED)
    except BrokenPipeError:
        raise
    except _FAILURES as error:
        if debug:
            traceback.print_exc()
        return _end(f"ufmstar {name}: failed: {_one_line(naming_extra(error, 'this command'))}", FAILED)


def _silence() -> None:
    """Send what is still to print nowhere, so that Python does not fail at it when it ends."""
    with open(os.devnull, "w") as nowhere:
        for descriptor in (1, 2):
            os.dup2(nowhere.fileno(), descriptor)


def _set_up(options: Any) -> None:
    """Set torch's CPU threads and check the device. Raises ValueError: an invalid ``threads`` or ``device``."""
    threads, device = getattr(options, "threads", None), getattr(options, "device", None)
    if threads is not None:
        if threads < 1:
            raise ValueError(f"--threads must be at least 1, got {threads}")
        if threads > (most := max(_MOST_THREADS, os.cpu_count() or 1)):
            raise ValueError(f"--threads must be 1 to {most}, got {threads}")
        import torch

        torch.set_num_threads(threads)  # the compiled kernels use the same number
    if device not in (None, "cpu"):  # importing torch takes a second
        from ufmstar_torch.eval.run.machine import require_device

        require_device(device)


def _one_line(error: BaseException) -> str:
    return " ".join(str(error).split()) or type(error).__name__


def _end(text: str, code: int) -> int:
    print(text, file=sys.stderr)
    return code


if __name__ == "__main__":
    sys.exit(main())

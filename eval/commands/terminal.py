"""Commands in a terminal: mistakes of a user in one line, progress bars, Ctrl-C and SIGTERM."""

from __future__ import annotations

import signal
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from time import monotonic
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from ufmstar_torch.eval.engine.progress import Progress

_EVERY = 30.0  # [s] between two lines of a stage
_FIRST_RUN = "loaded, or compiled if this computer has not run them yet, which takes about a minute"


class UsageError(Exception):
    """A mistake of the user; the message is one line with the reason."""


@contextmanager
def usage_errors(*kinds: type[Exception]) -> Iterator[None]:
    """Convert errors of these kinds to :class:`UsageError`."""
    try:
        yield
    except kinds as error:
        raise UsageError(error) from error


class Bars:
    """A progress bar of the current stage of a run, or of the current sequence of an evaluation.

    If standard error is no terminal, it prints a line at the start and the end of each stage instead, and one every
    half minute.
    """

    def __init__(self) -> None:
        self._stage = ""
        self._bar: Any = None
        self._said = 0.0  # [s] when the last line was printed

    def show(self, progress: Progress) -> None:
        """Update the bar of the stage; close that of an earlier stage."""
        from tqdm import tqdm

        stage = progress.stage
        if stage != self._stage:
            self._close()
            first = progress.done if progress.components is None and stage == "frames" else 0
            unit = "frame" if stage == "frames" else "step"
            # None: no bar where standard error is no terminal
            how = {"unit": unit, "dynamic_ncols": True, "leave": False, "disable": None}
            self._stage, self._bar = stage, tqdm(total=progress.total, initial=first, desc=stage, **how)
            if self._bar.disable:
                note = f" ({_FIRST_RUN})" if stage == "kernels" else ""
                self.say(f"{stage}: {progress.done} of {progress.total}{note}")
            elif stage == "kernels":
                self._bar.set_postfix_str(_FIRST_RUN)
        bar = self._bar
        bar.total = progress.total
        if progress.components is not None:
            skipped = {"skipped": progress.skipped} if progress.skipped else {}
            bar.set_postfix(components=progress.components, refresh=False, **skipped)
        bar.update(progress.done - bar.n)
        if bar.disable and progress.done == progress.total:
            self.say(f"{stage}: done, {progress.total} of {progress.total}")
        elif bar.disable and monotonic() - self._said >= _EVERY:
            self.say(f"{stage}: {progress.done} of {progress.total}")

    def say(self, text: str) -> None:
        """Print a line without breaking the bar."""
        from tqdm import tqdm

        self._said = monotonic()
        tqdm.write(text, file=sys.stderr)

    def __enter__(self) -> Bars:
        return self

    def __exit__(self, *_: object) -> None:
        self._close()

    def _close(self) -> None:
        if self._bar is not None:
            self._bar.close()


@contextmanager
def stop_signals(say: Callable[[str], None], what: str = "frame") -> Iterator[Callable[[], bool]]:
    """Ctrl-C or SIGTERM ends the run after the current frame (or step); a second one ends it at once.

    Yields a function that returns True after the first signal."""
    received: list[int] = []

    def handle(number: int, _: object) -> None:
        received.append(number)
        if len(received) > 1:
            raise KeyboardInterrupt
        say(f"stopping after this {what}; once more stops at once")

    previous = {number: signal.signal(number, handle) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        yield lambda: bool(received)
    finally:
        for number, handler in previous.items():
            signal.signal(number, handler)


@contextmanager
def interrupted_by_sigterm() -> Iterator[None]:
    """SIGTERM raises KeyboardInterrupt, as Ctrl-C does."""
    previous = signal.signal(signal.SIGTERM, signal.default_int_handler)
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, previous)

"""What a terminal shows of a long run, and how a user ends one: progress bars, Ctrl-C and SIGTERM."""

from __future__ import annotations

import signal
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import TracebackType
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from ufmstar_torch.eval.engine.progress import Progress


class Bars:
    """A progress bar for each stage of a run."""

    def __init__(self) -> None:
        self._bar: Any = None
        self._stage = ""
        self._sequences: dict[str, Any] = {}

    def show(self, progress: Progress) -> None:
        """Bring the bar of the stage up to date."""
        from tqdm import tqdm

        if progress.stage != self._stage:
            self._close()
            first = progress.done if progress.components is None and progress.stage == "frames" else 0
            unit = "frame" if progress.stage == "frames" else "step"
            self._bar = tqdm(total=progress.total, initial=first, desc=progress.stage, unit=unit, dynamic_ncols=True)
            if progress.stage == "kernels":
                self._bar.set_postfix_str("compiled on the first run")
            self._stage = progress.stage
        self._bar.total = progress.total
        if progress.components is not None:
            skipped = {"skipped": progress.skipped} if progress.skipped else {}
            self._bar.set_postfix(K=progress.components, refresh=False, **skipped)
        self._bar.update(progress.done - self._bar.n)

    def frames(self, label: str, done: int, total: int) -> None:
        """Bring the bar of a sequence's frames up to date; it goes when they are done."""
        from tqdm import tqdm

        if label not in self._sequences:
            new = tqdm(total=total, desc=label, unit="frame", dynamic_ncols=True, leave=False, disable=None)
            self._sequences[label] = new
        bar = self._sequences[label]
        bar.update(done - bar.n)
        if done == total:
            self._sequences.pop(label).close()

    def say(self, text: str) -> None:
        """Print a line without breaking the bar."""
        from tqdm import tqdm

        tqdm.write(text, file=sys.stderr)

    def __enter__(self) -> Bars:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._close()
        for bar in self._sequences.values():
            bar.close()

    def _close(self) -> None:
        if self._bar is not None:
            self._bar.close()


@contextmanager
def stop_signals(say: Callable[[str], None], what: str = "frame") -> Iterator[Callable[[], bool]]:
    """Ctrl-C and SIGTERM end the run after the frame (or step) in hand; a second one ends it at once.

    Yields:
        Whether one has come.
    """
    received: list[int] = []

    def handle(number: int, _: object) -> None:
        received.append(number)
        if len(received) > 1:
            raise KeyboardInterrupt
        say(f"stopping after this {what}; once more stops at once")

    before = {number: signal.signal(number, handle) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        yield lambda: bool(received)
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)

"""``ufmstar demo``: its options, and what is printed."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from ufmstar_torch.eval.commands.options import UsageError, as_dict, parse


@dataclass(frozen=True, kw_only=True)
class DemoOptions:
    """The main job on rendered rooms, with nothing but this package.

    Walks through rendered rooms with small depth networks that come with the package, compares their own variance with
    UfM's and UfM*'s, and saves pictures. Nothing else is needed; a minute on two cores.

    Attributes:
        out: folder for the results
        overwrite: replace an earlier demo there
        frames: number of frames of the walk through the rooms
        seed: of the rooms; the networks were trained on others
        weights: other trained networks (.safetensors of `ufmstar train`)
        device: cpu, cuda or cuda:N
        threads: number of CPU threads; default: all cores
        debug: show tracebacks
    """

    out: Path = Path("ufmstar_demo")
    overwrite: bool = False
    frames: int = 72
    seed: int = 100_003
    weights: Path | None = None
    device: str = "cpu"
    threads: int | None = None
    debug: bool = False

    def __post_init__(self) -> None:
        if self.frames < 2:
            raise ValueError(f"--frames must be at least 2, got {self.frames}: one view has nothing to disagree with")
        if self.seed < 0:
            raise ValueError(f"--seed must be at least 0, got {self.seed}")

    def settings(self) -> dict[str, Any]:
        """What is shown, as plain values: not how it is computed."""
        return {name: value for name, value in as_dict(self).items() if name not in ("threads", "debug")}


def read(words: Sequence[str]) -> DemoOptions:
    """The options of a command line; errors as :func:`parse`."""
    return parse(DemoOptions, words, "ufmstar demo")


def main(options: DemoOptions) -> int:
    """Run the demo, and print its table; the exit code."""
    from ufmstar_torch.eval.commands import demo
    from ufmstar_torch.eval.commands.terminal import Bars
    from ufmstar_torch.eval.report.text import demo_explanation, demo_table
    from ufmstar_torch.eval.run.folder import FolderError

    try:
        with Bars() as bars:
            summary = demo.run_demo(options, bars.show)
    except (FileNotFoundError, FolderError) as error:
        raise UsageError(error) from error
    print(demo_table(summary), demo_explanation(summary), sep="\n\n")
    return 0

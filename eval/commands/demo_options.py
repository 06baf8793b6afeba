"""The options of ``ufmstar demo``; importing this is cheap, so that help comes at once."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path

FRAMES, SEED, OUT = 72, 100_003, Path("ufmstar_demo")
_DESCRIPTION = (
    "Walks through rendered rooms with small depth networks that come with the package, compares their own variance "
    "with UfM's and UfM*'s, and saves pictures. Nothing else is needed; a minute on two cores."
)


def parse_demo(arguments: Sequence[str]) -> argparse.Namespace:
    """The options from arguments without the program's name.

    Raises:
        SystemExit: help was asked for, or an argument does not fit (2).
    """
    parser = argparse.ArgumentParser(prog="ufmstar demo", description=_DESCRIPTION)
    parser.add_argument("--out", type=Path, default=OUT, help=f"folder for the results (default: {OUT})")
    parser.add_argument("--overwrite", action="store_true", help="replace an earlier demo there")
    parser.add_argument("--frames", type=int, default=FRAMES, help=f"of the tour (default: {FRAMES})")
    parser.add_argument(
        "--seed", type=int, default=SEED, help=f"of the rooms; the networks were trained on others (default: {SEED})"
    )
    parser.add_argument("--weights", type=Path, help="other trained networks (.safetensors of `ufmstar train`)")
    parser.add_argument("--device", default="cpu", help="cpu (default) or cuda")
    parser.add_argument("--threads", type=int, help="CPU threads (default: as many as there are)")
    parser.add_argument("--debug", action="store_true", help="show tracebacks")
    return parser.parse_args(list(arguments))

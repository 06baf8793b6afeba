"""The demo's output folder: whose it is."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from ufmstar_torch.eval.report.demo_pictures import FILES
from ufmstar_torch.eval.results.files import write_json_atomic

PROGRAM = "ufmstar demo"
SUMMARY = "summary.json"
UNFINISHED = {"program": PROGRAM, "state": "not finished"}


class DemoError(ValueError):
    """What was asked for cannot be done; the message says what to do."""


def prepare(out: Path, *, overwrite: bool) -> None:
    """Make the folder; files that are not the demo's are never touched.

    Raises:
        DemoError: the folder holds other files, or a finished demo and ``overwrite`` is off.
        OSError: it cannot be made.
    """
    if out.exists() and not out.is_dir():
        raise DemoError(f"--out {out} is a file, expected a folder")
    if out.is_dir() and any(out.iterdir()):
        earlier = _earlier(out)
        if earlier is None:
            raise DemoError(f"--out {out} holds files of someone else: choose an empty or a new folder")
        if earlier != UNFINISHED and not overwrite:
            raise DemoError(f"--out {out} holds an earlier demo: --overwrite replaces it")
        for name in FILES:
            (out / name).unlink(missing_ok=True)
    out.mkdir(parents=True, exist_ok=True)
    # Marks the folder as the demo's until the real summary takes its place.
    write_json_atomic(out / SUMMARY, UNFINISHED)


def _earlier(out: Path) -> Any:
    """The summary of an earlier demo, None if there is none."""
    try:
        found = json.loads((out / SUMMARY).read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return None
    return found if isinstance(found, dict) and found.get("program") == PROGRAM else None

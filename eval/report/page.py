"""``report.html``: the whole evaluation in one self-contained file. ``templates/`` has its markup."""

from __future__ import annotations

import base64
import io
import json
import re
from collections import Counter
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from ufmstar_torch.eval.engine.files import write_bytes_atomic
from ufmstar_torch.eval.report.data import Results
from ufmstar_torch.eval.report.pictures import Picture
from ufmstar_torch.eval.report.quantities import row_labels
from ufmstar_torch.eval.report.table import Table, typeset

PAGE = "report.html"
TEMPLATES = Path(__file__).parent / "templates"
# Quality of WebP; below it, text in pictures has visible rings.
QUALITY = 84
# Kinds of figures (the first words of their files' names) in each section of the page, and what they show.
CURVES = {
    "calibration": "Calibration: how often is the depth right where a row says so? On the diagonal: as often as stated",
    "gates": "Gates: what remains of an image under a limit on σ, and how wrong is it?",
    "error": "Errors: is the likelihood bad only where the error is large?",
    "entropy": "Entropy: how uncertain is each row, by environment?",
    "sweep": "Settings: how do the figures depend on one setting?",
}
COST = {"latency": "Latency: how long does each stage take?"}


def write_page(
    results: Results,
    tables: Mapping[str, Sequence[Table]],
    figures: Sequence[Path],
    pictures: Sequence[Picture],
    undrawn: Mapping[str, str],
) -> Path:
    """Write the report into the folder of the evaluation: tables (of ``tables.all_tables``), figures (SVG, whose names
    begin with their kind), pictures with their captions, and a list of what is missing. Returns its path.

    Raises:
        ValueError: a picture cannot be read.
        ImportError: Pillow or Jinja2 is missing.
    """
    parts: dict[str, list[Table]] = {"main": [], "efficiency": [], "extra": []}
    for name, listed in tables.items():
        parts[name.partition("-")[0]] += listed
    made = {name: results.about.get(name) for name in ("networks", "settings", "versions", "machine")}
    digests = {f"{r.dataset}, {r.sequence}": r.provenance.get("sequence") for r in results.records}
    made["sequences (SHA-256)"] = {name: digest for name, digest in digests.items() if digest}
    text = _template().render(
        results=results,
        networks=", ".join(dict.fromkeys(record.network for record in results.records)),
        tables=parts,
        curves=_figures(figures, CURVES),
        pictures=[(picture, _embedded(results.out / "figures" / picture.file)) for picture in pictures],
        cost_figures=_figures(figures, COST),
        limits=limits(results, undrawn),
        command=command(results.about),
        made=json.dumps(made, indent=1, ensure_ascii=False, default=str),
    )
    path = results.out / PAGE
    write_bytes_atomic(path, text.encode())
    return path


def _template() -> Any:
    from jinja2 import Environment, FileSystemLoader, StrictUndefined
    from markupsafe import Markup

    # All templates are HTML: select_autoescape would ignore ".j2".
    how: dict[str, Any] = {"autoescape": True, "undefined": StrictUndefined, "trim_blocks": True, "lstrip_blocks": True}
    environment = Environment(loader=FileSystemLoader(TEMPLATES), **how)
    environment.filters["typeset"] = lambda text: Markup(typeset(text))
    for name in ("css", "js"):
        environment.globals[name] = Markup((TEMPLATES / f"report.{name}").read_text(encoding="utf-8"))
    return environment.get_template("report.html.j2")


def _figures(paths: Sequence[Path], kinds: Mapping[str, str]) -> list[tuple[str, list[tuple[str, str, bool]]]]:
    """By heading the figures of some kinds: alternative text, data URI, and True for single sequences, which are
    collapsed."""
    sections = []
    for kind, heading in kinds.items():
        shown = [(_words(path.stem), _embedded(path), "-sequences-" in path.stem) for path in paths
                 if path.stem.startswith(kind)]  # fmt: skip
        sections += [(heading, shown)] if shown else []
    return sections


def _words(stem: str) -> str:
    """A figure's name as words: "Calibration of each sequence: tum ensemble"."""
    kind, _, rest = stem.partition("-")
    single = rest.startswith("sequences-")
    rest = re.sub("[_-]+", " ", rest.removeprefix("sequences-"))
    return f"{kind.capitalize()}{' of each sequence' if single else ''}: {rest}"


def _embedded(path: Path) -> str:
    """A data URI of a file; a PNG becomes WebP, which is a fifth of its size."""
    kind, content = "svg+xml", path.read_bytes()
    if path.suffix == ".png":
        from PIL import Image

        buffer = io.BytesIO()
        with Image.open(path) as picture:
            picture.convert("RGB").save(buffer, "WEBP", quality=QUALITY, method=4)
        kind, content = "webp", buffer.getvalue()
    return f"data:image/{kind};base64,{base64.b64encode(content).decode()}"


def limits(results: Results, undrawn: Mapping[str, str]) -> list[tuple[str, tuple[str, ...], list[tuple[str, ...]]]]:
    """(title, headings, rows) of missing sequences, rows, frames, networks and figures."""
    missing = Counter((dataset, sequence) for dataset, sequence, _ in results.missing)
    # Rows with the same selection of frames skip the same frames: one line per sequence and selection.
    skipped: dict[tuple[str, ...], None] = {}
    for record in results.records:
        frames = record.frames
        reasons = {**(frames.get("reasons") or {}), **(frames.get("left_out_on_opening") or {})}
        if reasons or frames.get("skipped"):
            why = "; ".join(f"{n} × {reason}" for reason, n in reasons.items())
            counts = (str(frames.get("selected", "")), str(frames.get("done", "")))
            skipped[record.dataset, record.sequence, *counts, why] = None
    idle = []
    for row, label in row_labels(results.rows).items():
        for dataset in results.datasets:
            frame_counts = [record.frames for record in results.of(row, dataset)]
            counted = [sum(f.get(key, 0) for f in frame_counts) for key in ("done", "without_segment", "without_match")]
            if any(counted[1:]):
                idle.append((dataset, label, *map(str, counted)))
    where, uncompared = ("data set", "sequence"), ("data set", "row", "frames", "without a segment", "without a match")
    tables: list[tuple[str, tuple[str, ...], list[tuple[str, ...]]]] = [
        ("Sequences that failed", (*where, "reason"), [(*key, reason) for key, reason in results.failed.items()]),
        ("Frames in which UfM* compared no views", uncompared, idle),
        ("Frames that were skipped", (*where, "frames", "used", "reasons"), list(skipped)),
        ("Rows not evaluated yet", (*where, "rows"), [(*key, str(n)) for key, n in missing.items()]),
        ("Rows without a network", ("kind of network",), [(b,) for b in results.about.get("missing_bases") or ()]),
        ("Figures that could not be drawn", ("figure", "reason"), list(undrawn.items())),
        ("Further problems", ("problem",), [(note,) for note in results.notes]),
    ]
    return [table for table in tables if table[2]]


def command(about: Mapping[str, Any]) -> str:
    """The command that repeats the evaluation; DIR is a placeholder for the reader's folder."""
    parts = ["ufmstar eval", f"--suite {about['suite']}"]
    parts += [f"--root {dataset}=DIR" for dataset in about.get("datasets") or []]
    for base, network in (about.get("networks") or {}).items():
        listed = [(f["name"], f.get("member")) for f in network.get("files") or [] if f.get("name")]
        # A file can contain several networks: name the member.
        files = ",".join(f"DIR/{name}" if member is None else f"DIR/{name}#{member}" for name, member in listed)
        parts.append(f"--network {base}={network.get('model', 'MODEL')}:{files or 'DIR'}")
    for name, value in (about.get("settings") or {}).items():
        if name == "frames":  # START:STOP:STEP; "::" is all
            value = ":".join("" if limit is None else str(limit) for limit in value)
        if value not in ("::", None):
            parts.append(f"--{name.replace('_', '-')} {value}")
    return " ".join([*parts, "--out OUT"])

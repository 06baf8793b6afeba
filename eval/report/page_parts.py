"""The parts of the page below the findings: tables, figures, pictures, problems, and how it was made."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

from ufmstar_torch.eval.report.embed import Embedder
from ufmstar_torch.eval.report.glossary import GLOSSARY
from ufmstar_torch.eval.report.html_table import html_table, plain_table
from ufmstar_torch.eval.report.load import Results
from ufmstar_torch.eval.report.markup import Markup, tag
from ufmstar_torch.eval.report.page_part import Part, figure, folded, paragraph, values
from ufmstar_torch.eval.report.picture import BREAKDOWN, COMPARE, ROOM, STRIP, Picture
from ufmstar_torch.eval.report.tables import difference_table, extra_table, is_empty, main_table, sequence_tables

# More sequences stand in the tables' folder only.
MOST_SEQUENCES = 24
_PICTURES = {
    STRIP: (
        "Pictures: each method on a frame",
        "Chosen before anything was computed: frames spread over the first sequences, not the ones that look best.",
    ),
    BREAKDOWN: ("Pictures: what the variance is made of", ""),
    COMPARE: ("Pictures: UfM* against UfM", ""),
    ROOM: ("Rooms as Gaussians", ""),
}
# Of a figure by the first word of its file's name: the part's title, and how to read it.
_FIGURES = {
    "calibration": (
        "Calibration curves",
        "On the dashed diagonal a method is exactly right; below it the δ curve is overconfident, above it too modest.",
    ),
    "error": (
        "NLL by size of the error",
        "Over the pixels of which the named method is confident, from a row's smallest errors to its largest. Low at "
        "the right: large errors are noticed. High at the left: good predictions are distrusted.",
    ),
    "entropy": (
        "Entropy by data set",
        "How uncertain each method is, whether or not it should be: for data on which no calibration can be had.",
    ),
    "sweep": (
        "Sweeps and ablations",
        "Figures over the values of a setting, and below them differences at the same value, in pairs; bars and bands "
        "are 95 % intervals.",
    ),
    "tradeoff": ("Calibration against cost", ""),
    "latency": ("Where the time goes", ""),
}


def table_parts(results: Results) -> list[Part]:
    """The main table, paired differences and further figures, over all sequences and by data set."""
    makers = (
        ("The main table", main_table),
        ("Paired differences", difference_table),
        ("Further figures", extra_table),
    )
    parts = []
    for title, make in makers:
        tables = [make(results, None)]
        body = [html_table(table) for table in tables if not is_empty(table)]
        if len(results.datasets) > 1:
            each = [table for dataset in results.datasets if not is_empty(table := make(results, dataset))]
            body += [folded(table.title, html_table(table, caption=False)) for table in each]
        if body:
            parts.append(Part(title, body))
    return parts


def sequence_part(results: Results) -> Part:
    """The main figures of each sequence, folded."""
    tables = [table for dataset in results.datasets for table in sequence_tables(results, dataset)]
    body = [folded(table.title, html_table(table, caption=False)) for table in tables[:MOST_SEQUENCES]]
    if len(tables) > MOST_SEQUENCES:
        body.append(paragraph(f"The other {len(tables) - MOST_SEQUENCES} sequences are in the folder's tables."))
    return Part("Single sequences", body)


def figure_parts(files: Iterable[Path], embedder: Embedder) -> list[Part]:
    """The figures by kind; unknown kinds come last, under their own names.

    Raises:
        ValueError, OSError: see ``Embedder.take``.
    """
    by_kind: dict[str, list[Path]] = {}
    for path in files:
        by_kind.setdefault(_kind(path), []).append(path)
    parts = []
    for kind in [*(k for k in _FIGURES if k in by_kind), *(k for k in by_kind if k not in _FIGURES)]:
        title, words = _FIGURES.get(kind, ("Further diagrams", ""))
        # Single sequences come last, folded: they are many, and tall.
        paths = sorted(by_kind[kind], key=_is_of_sequences)
        drawn = ((path, figure(embedder, path, f"{title}: {_spoken(path)}")) for path in paths)
        body = [
            folded(_spoken(path).removeprefix(kind).strip(), shown) if _is_of_sequences(path) else shown
            for path, shown in drawn
            if shown is not None
        ]
        if body:
            parts.append(Part(title, [paragraph(words), *body] if words else body))
    return parts


def picture_parts(pictures: Sequence[Picture], folder: Path, embedder: Embedder) -> list[Part]:
    """Strips, breakdowns, comparisons and rooms.

    Raises:
        ValueError, OSError: see ``Embedder.take``.
    """
    parts = []
    for kind, (title, words) in _PICTURES.items():
        drawn = (figure(embedder, folder / p.file, p.alt, p.title, p.caption) for p in pictures if p.kind == kind)
        body = [shown for shown in drawn if shown is not None]
        if body:
            parts.append(Part(title, [paragraph(words), *body] if words else body))
    return parts


def efficiency_part(results: Results) -> Part | None:
    """Latency, power, energy and memory, where the suite measured them."""
    if results.efficiency is None:
        return None
    from ufmstar_torch.eval.bench.efficiency_table import efficiency_tables

    tables = efficiency_tables(results.efficiency)
    return Part("Efficiency", [html_table(table) for table in tables]) if tables else None


def problems_part(results: Results) -> Part:
    """Sequences that failed, frames that were skipped, and what is still to be done."""
    body: list[Markup] = []
    if results.failed:
        rows = [(f.dataset, f.sequence, f.reason) for f in results.failed]
        body.append(plain_table("Sequences that could not be evaluated", ("data set", "sequence", "reason"), rows))
    skipped = _skipped(results)
    if skipped:
        heads = ("data set", "sequence", "frames", "used", "why the others were not")
        body.append(plain_table("Frames that were left out", heads, skipped))
    missing = Counter((dataset, sequence) for dataset, sequence, _ in results.missing)
    if missing:
        rows = [(dataset, sequence, str(n)) for (dataset, sequence), n in missing.items()]
        told = ["ufmstar eval ... --resume goes on with them."]
        body.append(plain_table("Not evaluated yet", ("data set", "sequence", "rows"), rows, told))
    body += [paragraph(note) for note in results.notes]
    return Part("Problems", body or [paragraph("Every sequence was evaluated, and every frame was used.")])


def made_part(results: Results) -> Part:
    """What one needs to do it again: command, networks, settings, machine, digests."""
    about = results.about
    shown = {name: about[name] for name in ("networks", "settings", "versions", "machine") if about.get(name)}
    body = [tag("p", tag("code", command(about))), values(shown)]
    digests = {(r.dataset, r.sequence): str(r.provenance.get("sequence") or "") for r in results.records}
    if any(digests.values()):
        rows = [(dataset, sequence, tag("code", digest)) for (dataset, sequence), digest in digests.items()]
        heads = ("data set", "sequence", "SHA-256 of what was read")
        body.append(folded("Digests of the sequences", plain_table("Digests of the sequences", heads, rows)))
    return Part("How it was made", body)


def command(about: Mapping[str, Any]) -> str:
    """The command that repeats the evaluation; DIR stands for what only the reader knows."""
    parts = ["ufmstar eval", f"--suite {about['suite']}"]
    parts += [f"--root {dataset}=DIR" for dataset in about.get("datasets") or []]
    for base, network in (about.get("networks") or {}).items():
        files = ",".join(f"DIR/{_chosen(file)}" for file in network.get("files") or [] if file.get("name"))
        parts.append(f"--network {base}={network.get('model', 'MODEL')}:{files or 'DIR'}")
    for name, value in (about.get("settings") or {}).items():
        told = _slice(value) if name == "frames" else value
        if told not in ("::", None):
            parts.append(f"--{name.replace('_', '-')} {told}")
    return " ".join([*parts, "--out OUT"])


def _chosen(file: Mapping[str, Any]) -> str:
    """A file of weights, and the member of it that was taken."""
    member = file.get("member")
    return str(file["name"]) if member is None else f"{file['name']}#{member}"


def _slice(limits: Sequence[int | None]) -> str:
    """START:STOP:STEP; "::" is all."""
    return ":".join("" if limit is None else str(limit) for limit in limits)


def glossary_part() -> Part:
    """What the words mean."""
    terms = [child for term, meaning in GLOSSARY for child in (tag("dt", term), tag("dd", meaning))]
    return Part("What the words mean", [tag("dl", *terms)])


def _skipped(results: Results) -> list[tuple[str, str, str, str, str]]:
    """Once for each sequence and selection of frames: rows on the same frames skip the same ones."""
    found: dict[tuple[str, str, str, str, str], None] = {}
    for record in results.records:
        frames = record.frames
        reasons = {**(frames.get("reasons") or {}), **(frames.get("left_out_on_opening") or {})}
        if reasons or frames.get("skipped"):
            why = "; ".join(f"{n} × {reason}" for reason, n in reasons.items())
            counts = (str(frames.get("selected", "")), str(frames.get("done", "")))
            found[record.dataset, record.sequence, *counts, why] = None
    return list(found)


def _kind(path: Path) -> str:
    return path.stem.replace("_", "-").split("-")[0]


def _is_of_sequences(path: Path) -> bool:
    return path.stem.replace("_", "-").split("-")[1:2] == ["sequences"]


def _spoken(path: Path) -> str:
    """A figure's file name as words."""
    return path.stem.replace("_", " ").replace("-", " ")

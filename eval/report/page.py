"""``report.html``: the whole evaluation in one file that needs nothing else. ``templates/`` has its markup."""

from __future__ import annotations

import base64
import io
import re
import tomllib
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from html import escape
from pathlib import Path
from typing import Any

from ufmstar_torch.eval.methods.row import Row
from ufmstar_torch.eval.report.data import Results
from ufmstar_torch.eval.report.efficiency import efficiency_tables
from ufmstar_torch.eval.report.findings import PairedComparison, best_rows, caveats, comparisons, headlines, join
from ufmstar_torch.eval.report.means import MIN_SEQUENCES, value_of
from ufmstar_torch.eval.report.names import DIFFERENCES, count, row_label
from ufmstar_torch.eval.report.pictures import Picture
from ufmstar_torch.eval.report.table import Table
from ufmstar_torch.eval.report.tables import overview, sequence_tables
from ufmstar_torch.eval.run.files import write_atomic

PAGE = "report.html"
TEMPLATES = Path(__file__).parent / "templates"
# All pictures together [bytes of the page]; the rest of the page needs well below a megabyte.
MOST_BYTES = 7_000_000
# Of WebP: below it letters in pictures get visible rings.
QUALITY = 84
# Further sequences are only in the tables' folder.
MOST_SEQUENCES = 24


def write_page(
    results: Results,
    figures: Sequence[Path],
    pictures: Sequence[Picture],
    undrawn: Mapping[str, str] | None = None,
    *,
    most_bytes: int = MOST_BYTES,
) -> Path:
    """Write the report into the folder of the evaluation: figures (SVG or PNG), whose names begin with their kind,
    pictures with their words, as far as they fit into ``most_bytes``, and why figures could not be drawn.

    Raises:
        ValueError: a picture cannot be read.
        ImportError: Pillow or Jinja2 is missing.
    """
    shown, left_out = _pictures(results.out / "figures", figures, pictures, most_bytes)
    efficiency = [] if results.efficiency is None else efficiency_tables(results.efficiency)
    sequences = [table for dataset in results.datasets for table in sequence_tables(results, dataset)]
    more = len(sequences) - MOST_SEQUENCES
    words = f"The other {more} sequences are in the folder's tables." if more > 0 else ""
    overviews = [
        _part(title, [t for over, t in tables.items() if not over], [t for over, t in tables.items() if over])
        for title, tables in overview(results).items()
        if tables
    ]
    parts = [
        _findings(results),
        *overviews,
        *shown,
        *([_part("Efficiency", efficiency)] if efficiency else []),
        _part("Single sequences", folded=sequences[:MOST_SEQUENCES], words=words),
        _problems(results, undrawn or {}),
        _made(results),
        {"kind": "glossary", "title": "What the words mean"},
    ]
    frames = {
        (r.dataset, r.sequence): max(0, int(f)) for r in results.records if (f := value_of(r, "frames.done")) == f
    }
    n = len(results.sequences())
    facts = {"rows": len(results.rows), "sequences" if n > 1 else "sequence": n, "frames": sum(frames.values())}
    text = _template().render(
        results=results,
        parts=parts,
        networks=join(list(dict.fromkeys(record.network for record in results.records))),
        datasets=join(list(results.datasets)),
        facts=[(f"{total:,}".replace(",", "\u202f") if total else "", word) for word, total in facts.items()],
        min_sequences=MIN_SEQUENCES,
        left_out=left_out,
    )
    path = results.out / PAGE
    write_atomic(path, lambda file: file.write(text.encode()))
    return path


def _template() -> Any:
    from jinja2 import Environment, FileSystemLoader, StrictUndefined
    from markupsafe import Markup

    # Every template is HTML whatever its file is called: select_autoescape would leave out ".j2".
    environment = Environment(
        loader=FileSystemLoader(TEMPLATES),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.filters |= {"typeset": lambda text: Markup(typeset(text)), "plain": _plain}
    for name in ("css", "js"):
        environment.globals[name] = Markup((TEMPLATES / f"report.{name}").read_text(encoding="utf-8"))
    return environment.get_template("report.html.j2")


def typeset(text: str) -> str:
    """Text as HTML, with a minus for a hyphen before a number, and narrow blanks where a line must not break."""
    text = re.sub(r"(?<![\w.–-])-(?=\d)", "−", escape(text))
    return text.replace(" ± ", "\u202f±\u202f").replace(" %", "\u202f%")


def _plain(value: Any) -> str:
    if isinstance(value, bool):
        return "yes" if value else "no"
    return "–" if value is None else f"{value:.12g}" if isinstance(value, float) else str(value)


# ---- the parts, in the order of the page ----

Part = dict[str, Any]


def _findings(results: Results) -> Part:
    boards = [_board(comparisons(results), "All sequences")]
    if len(results.datasets) > 1:
        boards += [_board(comparisons(results, dataset), dataset) for dataset in results.datasets]
    none = ["No row of UfM* stands beside another row here, so there is nothing to compare."]
    return {
        "kind": "findings",
        "title": "What was found",
        "headlines": headlines(results) or none,
        "caveats": caveats(results),
        "boards": [board for board in boards if board["rows"]],
        "best": best_rows(results),
    }


def _board(pairs: Mapping[tuple[Row, Row], Sequence[PairedComparison]], title: str) -> Part:
    """A line for each pair of rows, with a verdict for each figure."""
    shown = [q for q in DIFFERENCES if any(c.quantity is q for made in pairs.values() for c in made)]
    rows = []
    for (row, reference), made in pairs.items():
        cells = {c.quantity: c for c in made}
        sequences = count(max(c.difference.sequences for c in made), "sequence")
        beside = f"beside {row_label(reference)}, {sequences}"
        rows.append((row_label(row), beside, [cells.get(q) for q in shown]))
    return {"title": title, "heads": ["UfM*, beside", *(q.heading for q in shown)], "rows": rows}


def _part(title: str, tables: Sequence[Table] = (), folded: Sequence[Table] = (), words: str = "") -> Part:
    return {"kind": "tables", "title": title, "tables": tables, "folded": folded, "words": words}


def _pictures(
    folder: Path, figures: Sequence[Path], pictures: Sequence[Picture], room: int
) -> tuple[list[Part], list[str]]:
    """Diagrams by kind, those of single sequences folded and last, then pictures by kind, as long as they fit into
    ``room`` bytes; and the names of those that do not."""
    parts = tomllib.loads((TEMPLATES / "pictures.toml").read_text(encoding="utf-8"))
    todo: list[tuple[str, Path, dict[str, str]]] = []
    for path in figures:
        kind, *words = path.stem.replace("_", "-").split("-")
        alt = f"{parts.get(kind, parts['other'])['title']}: {' '.join([kind, *words])}"
        folded = " ".join(words) if words[:1] == ["sequences"] else ""
        todo.append((kind, path, {"alt": alt, "title": "", "caption": "", "folded": folded}))
    todo.sort(key=lambda entry: bool(entry[2]["folded"]))
    todo += [(picture.kind, folder / picture.file, {**asdict(picture), "folded": ""}) for picture in pictures]
    by_kind: dict[str, list[dict[str, Any]]] = {kind: [] for kind in parts}
    left_out = []
    for kind, path, named in todo:
        uri, width, height = _embedded(path)
        if len(uri) > room:
            left_out.append(path.name)
        else:
            room -= len(uri)
            by_kind.get(kind, by_kind["other"]).append({**named, "uri": uri, "width": width, "height": height})
    shown = {kind: of_kind for kind, of_kind in by_kind.items() if of_kind}
    return [{"kind": "pictures", **parts[kind], "pictures": of_kind} for kind, of_kind in shown.items()], left_out


def _embedded(path: Path) -> tuple[str, int, int]:
    """A data URI, and width and height in pixels of the page; a PNG becomes WebP, which is a fifth of it. Raises
    ValueError: it is neither SVG nor PNG."""
    if path.suffix == ".png":
        from PIL import Image

        with Image.open(path) as picture:
            buffer = io.BytesIO()
            picture.convert("RGB").save(buffer, "WEBP", quality=QUALITY, method=4)
            return f"data:image/webp;base64,{base64.b64encode(buffer.getvalue()).decode()}", *picture.size
    data = path.read_bytes() if path.suffix == ".svg" else b""
    size = []
    for name in ("width", "height"):  # of the outermost element; a point is 4/3 pixels
        length = re.search(rf'<svg\b[^>]*?\b{name}="([0-9.]+)(pt|px)?"', data.decode())
        if length is None:
            raise ValueError(f"a picture must be an SVG with a {name} in points, or a PNG, got {path.name}")
        size.append(round(float(length[1]) * (4 / 3 if length[2] == "pt" else 1)))
    return f"data:image/svg+xml;base64,{base64.b64encode(data).decode()}", size[0], size[1]


def _problems(results: Results, undrawn: Mapping[str, str]) -> Part:
    missing = Counter((dataset, sequence) for dataset, sequence, _ in results.missing)
    # Rows on the same frames skip the same ones: one line for each sequence and selection of frames.
    skipped: dict[tuple[str, ...], None] = {}
    for record in results.records:
        frames = record.frames
        reasons = {**(frames.get("reasons") or {}), **(frames.get("left_out_on_opening") or {})}
        if reasons or frames.get("skipped"):
            why = "; ".join(f"{n} × {reason}" for reason, n in reasons.items())
            counts = (str(frames.get("selected", "")), str(frames.get("done", "")))
            skipped[record.dataset, record.sequence, *counts, why] = None
    return {
        "kind": "problems",
        "title": "Problems",
        "undrawn": list(undrawn.items()),
        "failed": [(f.dataset, f.sequence, f.reason) for f in results.failed],
        "skipped": list(skipped),
        "missing": [(dataset, sequence, str(n)) for (dataset, sequence), n in missing.items()],
    }


def _made(results: Results) -> Part:
    """What one needs to do it again: command, networks, settings, machine, digests."""
    about = results.about
    digests = {(r.dataset, r.sequence): str(r.provenance.get("sequence") or "") for r in results.records}
    return {
        "kind": "made",
        "title": "How it was made",
        "command": command(about),
        "made_with": {name: about[name] for name in ("networks", "settings", "versions", "machine") if about.get(name)},
        "digests": [(*where, digest) for where, digest in digests.items()] if any(digests.values()) else [],
    }


def command(about: Mapping[str, Any]) -> str:
    """The command that repeats the evaluation; DIR stands for a folder of the reader."""
    parts = ["ufmstar eval", f"--suite {about['suite']}"]
    parts += [f"--root {dataset}=DIR" for dataset in about.get("datasets") or []]
    for base, network in (about.get("networks") or {}).items():
        listed = [(f["name"], f.get("member")) for f in network.get("files") or [] if f.get("name")]
        # Of a file with several networks, the member that was taken.
        files = ",".join(f"DIR/{name}" if member is None else f"DIR/{name}#{member}" for name, member in listed)
        parts.append(f"--network {base}={network.get('model', 'MODEL')}:{files or 'DIR'}")
    for name, value in (about.get("settings") or {}).items():
        if name == "frames":  # START:STOP:STEP; "::" is all
            value = ":".join("" if limit is None else str(limit) for limit in value)
        if value not in ("::", None):
            parts.append(f"--{name.replace('_', '-')} {value}")
    return " ".join([*parts, "--out OUT"])

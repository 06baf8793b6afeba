"""``ufmstar rank``: its options, and the table of scores."""

from __future__ import annotations

import math
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, ClassVar, Literal

from ufmstar_torch.config import UfMStarConfig
from ufmstar_torch.eval.commands.depth import OWN_DEPTH
from ufmstar_torch.eval.commands.options import Count, Flag, Positional, Texts, arg, reader, require_least
from ufmstar_torch.eval.commands.run import StreamOptions, job_from
from ufmstar_torch.eval.commands.terminal import Bars, stop_signals, usage_errors

if TYPE_CHECKING:
    from ufmstar_torch.eval.run.rank import ImageScores

SCORES, SETTINGS = "scores.csv", "rank.json"
_SHOWN = 10  # lines of the printed table


@dataclass(frozen=True, kw_only=True)
class RankOptions(StreamOptions):
    """Rank the images of sequences by their uncertainty: the most uncertain ones are to be labelled first.

    Writes scores.csv, a line per image, and a contact sheet of the least and the most certain images. Each sequence
    starts with an empty state. M is the frame's alone, at measured pixels (--set ema_alpha=1, unmeasured=nan).

    Attributes:
        sequences: Folders of sequences, video files, or tour:SEED, as for `ufmstar run`.
        out: Write everything to this folder.
        by: Rank by the mean of V, M, A, E or B (docs/active_learning.md).
        diverse: Rank only one of several images that show the same place from nearly the same side.
        count: Rank this many images (default: all).
        measured: Rank by total or disagreement only images measured at this share of their pixels.
        overwrite: Replace the ranking in --out.
    """

    USAGE: ClassVar[str] = "ufmstar rank SEQUENCE... (--model NAME --weights FILE... | --depth DIR) --out OUT [options]"

    sequences: Annotated[Positional[Texts], arg(metavar="SEQUENCE...")]
    out: str
    by: Literal["total", "disagreement", "aleatoric", "epistemic", "anchored"] = "total"
    diverse: Flag = False
    count: Count = None
    measured: float = 0.5
    overwrite: Flag = False

    def __post_init__(self) -> None:
        super().__post_init__()
        require_least(self, count=1)
        if not self.sequences:
            raise ValueError("a SEQUENCE is missing; ufmstar rank --help")
        if not 0 <= self.measured <= 1:
            raise ValueError(f"--measured must be a share from 0 to 1, got {self.measured}")
        if self.maps.depth not in (None, *OWN_DEPTH) and len(self.sequences) > 1:
            raise ValueError("--depth DIR goes with one sequence: rank each by itself")
        if len(set(self.sequences)) < len(self.sequences):
            raise ValueError(f"the sequences must differ, got one twice: {' '.join(self.sequences)}")

    @property
    def config(self) -> UfMStarConfig:
        """The configuration of UfM*; by default M is the frame's alone, at measured pixels."""
        return self.uncertainty.config(unmeasured="nan", ema_alpha=1.0)


read = reader(RankOptions, "ufmstar rank")


def main(options: RankOptions) -> int:
    """Score the sequences, and write table and pictures; the exit code."""
    from ufmstar_torch.eval.run.folder import FolderError, FolderKind, output_folder
    from ufmstar_torch.eval.run.machine import share_threads
    from ufmstar_torch.eval.run.pictures import SHEET

    if options.threads is None:
        share_threads()
    kind = FolderKind("ufmstar rank", "ranking", SETTINGS, (SCORES, SHEET))
    with usage_errors(FolderError):
        kind.earlier(Path(options.out), overwrite=options.overwrite)
        scores = _scores(options)
        with output_folder(Path(options.out), kind, {}, overwrite=options.overwrite):
            return _write(options, scores)


def _scores(options: RankOptions) -> ImageScores:
    """Stream the sequences."""
    from ufmstar_torch.eval.engine.stream import Stopped, frame_progress, frame_results
    from ufmstar_torch.eval.run.rank import ImageScores, require_part
    from ufmstar_torch.eval.run.run import warm_up_job
    from ufmstar_torch.eval.run.run_folder import FirstMaps, fitted_depth, keep_first_map
    from ufmstar_torch.frames.warnings import LOGGER

    scores, source = ImageScores(options.by, options.measured), None
    with Bars() as bars, stop_signals(bars.say) as stop:
        for path in options.sequences:
            with usage_errors(ImportError, OSError, ValueError):
                job = job_from(options, path, source)
                if source is None:
                    require_part(job, options.by)
            if source is None:
                warm_up_job(job, bars.show)
            source, scores.sequence = job.source, path
            if job.image_fit is not None and job.image_fit.problem:
                LOGGER.warning("%s: %s", path, job.image_fit.problem)
            shown, maps = frame_progress(bars.show, len(job.indices)), FirstMaps()
            try:
                with closing(frame_results(job.sequence, job.indices, [job.row()[0]], stop=stop)) as results:
                    for result in results:
                        scores.add(result)
                        keep_first_map(job, result, maps)
                        shown(result)
            except Stopped:
                raise KeyboardInterrupt from None
            if (fit := fitted_depth(job, maps)) is not None and fit.problem:
                LOGGER.warning("%s: %s", path, fit.problem)
    return scores


def _write(options: RankOptions, scores: ImageScores) -> int:
    """Write scores.csv, the contact sheet and rank.json, and print the first images; the exit code."""
    import pandas as pd

    from ufmstar_torch.eval.engine.files import write_bytes_atomic, write_json_atomic
    from ufmstar_torch.eval.report.table import aligned, csv_text
    from ufmstar_torch.eval.run.panels import contact_sheet
    from ufmstar_torch.eval.run.pictures import SHEET

    out, chosen = Path(options.out), scores.chosen(options.count, diverse=options.diverse)
    rest = sorted(set(range(len(scores.images))) - set(chosen))
    lines = [{"rank": n, **scores.images[i].line} for n, i in enumerate(chosen, start=1)]
    lines += [{"rank": None, **scores.images[i].line} for i in rest]
    table = pd.DataFrame(lines, dtype=object).map(csv_text).to_csv(index=False, lineterminator="\n")
    write_bytes_atomic(out / SCORES, table.encode())
    files = [SCORES]
    if panels := scores.panels():
        contact_sheet(panels, out / SHEET, title=f"the least and the most certain of {len(lines)} images")
        files.append(SHEET)
    write_json_atomic(out / SETTINGS, {"program": "ufmstar rank", "settings": options.settings(), "images": len(lines)})
    shown = [["rank", "sequence", "frame", f"{options.by} [m²]", "measured"]]
    mean, names = f"{options.by}_mean_m2", [Path(path).name for path in options.sequences]
    for line in lines[: min(len(chosen), _SHOWN)]:
        name = Path(line["sequence"]).name  # the whole path if two sequences have the same name
        name = name if names.count(name) == 1 else line["sequence"]
        shown.append([str(line["rank"]), name, line["frame"], *(f"{line[k]:.3g}" for k in (mean, "measured"))])
    print("\n".join(aligned(shown)))
    above = f", the first {_SHOWN} above" if len(chosen) > _SHOWN else ""
    print(f"{out}: {', '.join(files)}; {len(lines)} images, {len(chosen)} with a rank{above}")
    if unmeasured := sum(math.isnan(image.score) for image in scores.images):
        seen = f"less than {options.measured:.0%} of their pixels were seen from two places (--measured)"
        print(f"{unmeasured} of them cannot be ranked: {seen}")
    return 0 if chosen else 1

"""``ufmstar data check``: a sequence's content, its problems, and the options that correct them."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from ufmstar_torch.anchors.pose_fit import UNCHANGED
from ufmstar_torch.eval.check.check import SequenceCheck, check_sequence
from ufmstar_torch.eval.sequences.frame import FrameError, FrameSequence
from ufmstar_torch.eval.sequences.intrinsics import pinhole_values
from ufmstar_torch.eval.sequences.open import open_sequence
from ufmstar_torch.gaussians.conventions import OURS

# Largest number of frames that are decoded (evenly spaced, to take seconds), and of rendered ones.
_DECODED, _RENDERED = 500, 12
_SAMPLED = 4096  # pixels sampled in each frame for the range of depth
_QUANTILES = (0.01, 0.99)
# Customary scales [m per unit], and the factor within which the measured scale is rounded to one.
_CUSTOMARY = (1.0, 0.1, 0.01, 1e-3, 1e-4, 1e-5, 1 / 5000, 1 / 256, 1 / 4000, 1 / 1024)
_CUSTOMARY_WITHIN = 1.1
_REGISTERED = "depth is registered"  # part of check_sequence's undecided questions about registration
_NO_UNIT = "the unit of the poses: their file does not state it, and `run` needs it in metres: --pose-scale M"
_FEW = 0.5  # smallest share of the frames on disk that must be usable; below, the trajectory is another recording's


@dataclass(frozen=True)
class DataReport:
    """Outcome of a check; lengths in metres, sizes (H, W)."""

    name: str
    path: str  # as passed to ``check_data``
    layout: str = ""  # "" if the sequence could not be opened
    frames: int = 0  # number of usable frames
    on_disk: int = 0  # number of frames on disk
    skipped: Mapping[str, int] = field(default_factory=dict)  # number of frames left out, by reason
    without_depth: int = 0  # number of usable frames without depth
    posed: bool = True
    walked: float = 0.0  # length of the path [m]
    image_size: tuple[int, int] | None = None
    depth_size: tuple[int, int] | None = None
    intrinsics: tuple[float, ...] = ()  # fx, fy, cx, cy of the images [px]
    depth_intrinsics: tuple[float, ...] | None = None  # of the depth maps, None if they are the images'
    depth_range: tuple[float, ...] | None = None  # 1 % and 99 % quantiles of the sampled depth [m]
    filled: float = 0.0  # share of valid pixels
    checked: Mapping[str, Any] = field(default_factory=dict)  # measurements of check_sequence; {} if not opened
    problems: tuple[str, ...] = ()
    remedies: tuple[str, ...] = ()  # with options as on the command line
    undecided: tuple[str, ...] = ()  # questions that the data cannot answer

    @property
    def ok(self) -> bool:
        """True if no problem was detected."""
        return not self.problems

    @property
    def compared(self) -> bool:
        """True if depth was compared with other frames, or its edges with the images'."""
        decided = self.checked.get("registration") and not any(_REGISTERED in text for text in self.undecided)
        return bool(self.checked.get("pairs") or decided)


def check_data(path: str | Path, name: str | None = None, pairs: int = 8, **options: Any) -> DataReport:
    """Open a sequence and check it, without a network, on ``pairs`` of frames. ``options`` are those of
    ``open_sequence``. If the sequence cannot be opened, the report has that problem.

    Raises:
        FileNotFoundError: no such path.
        ValueError: ``pairs`` is not positive.
    """
    if not str(path).startswith("tour:") and not Path(path).exists():
        raise FileNotFoundError(f"no such file or folder: {path}")
    try:
        sequence = open_sequence(path, **options)
    except (FrameError, FileNotFoundError, ImportError, ValueError) as error:
        return DataReport(name or Path(path).name, str(path), problems=(f"cannot be opened: {error}",))
    problems: list[str] = []
    remedies: list[str] = []
    if len(sequence) < _FEW * len(sequence.names_on_disk):
        problems.append(f"only {len(sequence)} of {len(sequence.names_on_disk)} frames are usable")
        remedies.append("see why frames are skipped above; if it is poses: --time-offset, --fps, --reader max_pose_gap")
    read, broken, depths = _read_frames(sequence)
    if broken:
        problems.append(f"{len(broken)} of the {read} frames read cannot be decoded, first {broken[0]}")
        remedies.append("they are skipped and counted when the sequence is used; if it is many, copy or convert them")
    outcome = check_sequence(sequence, pairs)
    checked = {**asdict(outcome), "read": read, "unreadable": broken}
    del checked["problems"], checked["undecided"]
    if outcome.images is not None:
        checked["images"]["words"] = outcome.images.words
    positions = np.array([entry.T_world_cam[:3, 3] for entry in sequence.entries])
    K_depth = sequence.depth_intrinsics
    valid = depths[depths > 0]
    return DataReport(
        name=name or sequence.name,
        path=str(path),
        layout=sequence.layout,
        frames=len(sequence),
        on_disk=len(sequence.names_on_disk),
        skipped=dict(Counter(frame.reason for frame in sequence.skipped)),
        without_depth=len(sequence.without_depth),
        posed=sequence.posed,
        walked=float(np.linalg.norm(np.diff(positions, axis=0), axis=1).sum()),
        image_size=sequence.image_size,
        depth_size=sequence.depth_size,
        intrinsics=pinhole_values(sequence.intrinsics),
        depth_intrinsics=None if K_depth is None else pinhole_values(K_depth),
        depth_range=tuple(np.quantile(valid, _QUANTILES).tolist()) if valid.size else None,
        filled=valid.size / max(depths.size, 1),
        checked=checked,
        problems=(*problems, *outcome.problems),
        remedies=(*remedies, *_remedies(outcome, sequence, path, options)),
        undecided=(*outcome.undecided, *([] if sequence.metric else [_NO_UNIT])),
    )


def _remedies(check: SequenceCheck, sequence: FrameSequence, path: str | Path, options: Mapping[str, Any]) -> list[str]:
    remedies = []
    reading = UNCHANGED if check.images is None else check.images.reading
    if (poses := reading.poses if check.poses == OURS else check.poses) != OURS:
        convention = options.get("poses", OURS)
        remedies.append(f"--poses {poses}" if convention == OURS else f"leave --poses {convention} out")
    elif reading.late:
        remedies.append(_time_remedy(reading.late, sequence, options))
    elif reading.factor != 1:
        remedies.append(f"--intrinsics: those of images of this size, about {reading.factor:.2g} times what is given")
    elif any("disagree" in problem or "no two frames overlap" in problem for problem in check.problems):
        remedies.append(
            "the trajectory may be another recording's, or shifted in time: --trajectory, --time-offset; or its "
            "quaternions begin with w: name its columns in a header; or the intrinsics are others: --intrinsics"
        )
    if any("depth looks too" in problem for problem in check.problems):
        remedies.append(_scale_remedy(check.scale, sequence, path, options))
    if any("not registered" in problem for problem in check.problems):
        remedies.append(
            "if the depth camera is another one, say so: --reader depth_intrinsics; if it stands beside the colour "
            "camera, warp its maps into that first (7-Scenes: --reader T_color_depth)"
        )
    return remedies


def _time_remedy(late: int, sequence: FrameSequence, options: Mapping[str, Any]) -> str:
    """The change that assigns to each image the pose of ``late`` frames later."""
    times = [entry.timestamp for entry in sequence.entries]
    stamps = [time for time in times if time is not None]
    by_line = f"give each image the pose {_count(abs(late), 'line')} {'further down' if late > 0 else 'further up'}"
    if len(stamps) < len(times) or (options.get("trajectory") is None and sequence.layout != "tum"):
        return by_line
    return f"--time-offset {options.get('time_offset', 0.0) + late * float(np.median(np.diff(stamps))):.3g}"


def _scale_remedy(factor: float, sequence: FrameSequence, path: str | Path, options: Mapping[str, Any]) -> str:
    """The change that multiplies depth by ``factor``, or divides positions by it."""
    positions = f"divide the positions of the poses by {factor:.4g}"
    if options.get("trajectory") is not None:
        return f"a single camera's trajectory has no scale: {positions}"
    unit = _metres_per_unit(sequence, path, options)
    if not sequence.metric:
        return f"--pose-scale {1 / factor:.4g}"
    if unit is None:
        return positions
    scale = unit * factor
    near = min(_CUSTOMARY, key=lambda customary: abs(math.log(customary / scale)))
    if max(near / scale, scale / near) < _CUSTOMARY_WITHIN:
        scale = near
    if scale > 1 or near == unit:
        return positions
    return f"--truth-scale {scale:.4g}"


def _metres_per_unit(sequence: FrameSequence, path: str | Path, options: Mapping[str, Any]) -> float | None:
    """The present scale of the depth files; None where no scale applies (a laser, a rendered tour)."""
    if sequence.layout == "tour" or (sequence.layout == "kitti360" and options.get("truth") is None):
        return None
    raw = open_sequence(path, **{**options, "truth_scale": 1.0})
    for entry, stored in zip(sequence.entries, raw.entries, strict=True):
        if entry.load_depth is None or stored.load_depth is None:
            continue
        try:
            depth, values = entry.load_depth(), stored.load_depth()
        except FrameError:  # counted by the check
            continue
        valid = (depth > 0) & (values > 0)
        if valid.any():
            return float(np.median(depth[valid].astype(np.float64) / values[valid]))
    return None


def _read_frames(sequence: FrameSequence) -> tuple[int, list[str], np.ndarray]:
    """The number of decoded frames (rendered ones do not count), the decoding errors, and depths [m] sampled from the
    other frames (0 = invalid)."""
    rendered = sequence.layout == "tour"
    most = min(_RENDERED if rendered else _DECODED, len(sequence))
    broken, depths = [], [np.zeros(0, np.float32)]
    chosen = np.unique(np.linspace(0, len(sequence) - 1, most).astype(int)).tolist()
    for index in chosen:
        try:
            depth = sequence[index].depth
        except FrameError as error:
            broken.append(str(error))
        else:
            depths += [] if depth is None else [depth.ravel()[:: max(1, depth.size // _SAMPLED)]]
    return 0 if rendered else len(chosen), broken, np.concatenate(depths)


# ---- text: a page for one sequence, one line each for several ----


def page(report: DataReport) -> str:
    """The report of one sequence as several lines."""
    if not report.layout:
        return "\n".join([f"{report.name}: {report.path}", *_problems(report), _end(report)])
    lines = [
        f"{report.name}: layout {report.layout}, {report.frames} of {report.on_disk} frames usable",
        *(f"  skipped       {n} x {reason}" for reason, n in report.skipped.items()),
        f"  images        {_size(report.image_size)}, {_camera(report.intrinsics)}",
        f"  depth         {_depth(report)}",
        f"  poses         {f'path of {report.walked:.1f} m' if report.posed else 'none: single images'}",
    ]
    if report.checked.get("pairs"):
        pairs, gap, error = (report.checked[key] for key in ("pairs", "gap", "error"))
        fit = f"off by {error:.1%}" if error < float("inf") else "does not overlap"
        lines.append(f"  geometry      depth warped {_count(gap, 'frame')} on {fit} ({_count(pairs, 'pair')})")
    if (images := report.checked.get("images")) is not None:
        lines.append(f"  corners       {images['words']}, {_count(images['pairs'], 'pair')}")
    if (registration := report.checked.get("registration")) is not None:
        lines.append(
            f"  registration  {registration['quality']:.2f} of 1: how well depth edges meet image edges as they are"
        )
    lines += [f"  undecided     {text}" for text in report.undecided]
    return "\n".join([*lines, *_problems(report), _end(report)])


def lines(reports: Sequence[DataReport]) -> str:
    """One line per sequence, and the number of sequences without problems."""
    fine = sum(report.ok and report.compared for report in reports)
    return "\n".join([*map(_line, reports), f"{fine} of {len(reports)} sequences are fine"])


def _line(report: DataReport) -> str:
    if report.ok and not report.compared:
        return f"{_end(report)}  {report.name}: {report.layout}, {report.frames} of {report.on_disk} frames"
    if report.ok:
        error = report.checked.get("error")
        fit = f", depth fits to {error:.1%}" if error is not None and report.posed else ""
        return f"fine     {report.name}: {report.layout}, {report.frames} of {report.on_disk} frames{fit}"
    remedy = f" -> {'; '.join(report.remedies)}" if report.remedies else ""
    return f"PROBLEM  {report.name}: {' '.join('; '.join(report.problems).split())}{remedy}"


def _problems(report: DataReport) -> list[str]:
    return [f"  PROBLEM       {text}" for text in report.problems] + [f"  remedy        {t}" for t in report.remedies]


def _end(report: DataReport) -> str:
    if not report.ok:
        return _count(len(report.problems), "problem")
    if report.compared:
        return "fine"
    if report.depth_range is not None:
        return "not checked: nothing was compared"
    if (report.checked.get("images") or {}).get("pairs"):
        return "poses and images agree; scale cannot be checked without depth"
    return "not checked: without depth, neither poses nor scale can be compared"


def _size(size: tuple[int, int] | None) -> str:
    return "of unknown size" if size is None else f"{size[1]}x{size[0]}"


def _camera(values: tuple[float, ...]) -> str:
    return "fx {:.1f} fy {:.1f} cx {:.1f} cy {:.1f} px".format(*values)


def _depth(report: DataReport) -> str:
    if report.depth_range is None:
        return "none"
    low, high = report.depth_range
    maps = f"{_size(report.depth_size)}, {low:.2f} to {high:.2f} m, {report.filled:.0%} of the pixels"
    camera = "" if report.depth_intrinsics is None else f", a camera of its own: {_camera(report.depth_intrinsics)}"
    missing = f", {_count(report.without_depth, 'frame')} without" if report.without_depth else ""
    return maps + camera + missing


def _count(number: int, what: str) -> str:
    return f"{number} {what}{'' if number == 1 else 's'}"

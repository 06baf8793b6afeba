"""``ufmstar data check`` in words: a page for one sequence, a line each for several."""

from __future__ import annotations

from collections.abc import Sequence

from ufmstar_torch.eval.check.data_check import DataReport


def page(report: DataReport) -> str:
    """Everything about one sequence, several lines."""
    if not report.layout:
        return "\n".join([f"{report.name}: {report.path}", *_problems(report), _end(report)])
    lines = [
        f"{report.name}: layout {report.layout}, {report.frames} of {report.on_disk} frames usable",
        *(f"  skipped       {n} x {reason}" for reason, n in report.skipped.items()),
        f"  images        {_size(report.image_size)}, {_camera(report.intrinsics)}",
        f"  depth         {_depth(report)}",
        f"  poses         {f'path of {report.walked:.1f} m' if report.posed else 'none: single images'}",
    ]
    if report.checked and report.posed:
        pairs, gap, error = (report.checked[key] for key in ("pairs", "gap", "error"))
        fit = f"off by {error:.1%}" if error < float("inf") else "does not overlap"
        lines.append(f"  geometry      depth warped {_count(gap, 'frame')} on {fit} ({_count(pairs, 'pair')})")
    lies = report.checked.get("registration")
    if lies is not None:
        lines.append(f"  registration  {lies['quality']:.2f} of 1: how well depth edges meet image edges as they are")
    lines += [f"  undecided     {text}" for text in report.undecided]
    return "\n".join([*lines, *_problems(report), _end(report)])


def lines(reports: Sequence[DataReport]) -> str:
    """Several sequences, a line each, and how many are fine."""
    fine = sum(report.ok for report in reports)
    return "\n".join([*map(_line, reports), f"{fine} of {len(reports)} sequences are fine"])


def _line(report: DataReport) -> str:
    if report.ok:
        error = report.checked.get("error")
        fit = f", depth fits to {error:.1%}" if error is not None and report.posed else ""
        return f"fine     {report.name}: {report.layout}, {report.frames} of {report.on_disk} frames{fit}"
    remedy = f" -> {'; '.join(report.remedies)}" if report.remedies else ""
    return f"PROBLEM  {report.name}: {' '.join('; '.join(report.problems).split())}{remedy}"


def _problems(report: DataReport) -> list[str]:
    return [f"  PROBLEM       {text}" for text in report.problems] + [f"  remedy        {t}" for t in report.remedies]


def _end(report: DataReport) -> str:
    return "fine" if report.ok else _count(len(report.problems), "problem")


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

"""Poses: reading of trajectories in the common text formats, association by timestamp.

All poses are camera-to-world; numbers have a decimal point, with spaces, commas or semicolons between them. The number
of columns of a line defines the format:

====  ==========================================================
7     ``tx ty tz qx qy qz qw`` (TartanAir)
8     ``timestamp tx ty tz qx qy qz qw`` (TUM, ORB-SLAM3, ...)
12    3x4 rows of a matrix (KITTI)
13    frame number or timestamp, then 3x4 rows
16    4x4 rows of a matrix
17    frame number or timestamp, then 4x4 rows (KITTI-360)
====  ==========================================================

A header, with ``#`` or without, that names a position and a quaternion (``tx``, ``p_RS_R_x [m]``, ``qw``,
``field.pose.orientation.w``) sets their columns and order; other columns are left out.
"""

from __future__ import annotations

import re
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from ufmstar_torch.files.limits import read_text
from ufmstar_torch.frames.arguments import as_path
from ufmstar_torch.gaussians.trajectory import Trajectory

# TUM writes quaternions with four decimals, so the norm is within 2e-4 of 1; an error of a hundred times that means
# another order of columns or another unit.
_QUATERNION_TOLERANCE = 0.02
# Two poses with the same timestamp are equal up to this distance [the poses' unit], or the median step between samples
# if that is larger (rounded timestamps), and this angle [degrees].
_SAME_PLACE, _SAME_DIRECTION = 0.01, 2.0
# printf on Windows writes NaN and infinity as 1.#IND, 1.#QNAN, 1.#INF.
_WINDOWS_NON_FINITE = re.compile(r"[+-]?1\.?#(IND|QNAN|SNAN|INF)\d*", re.IGNORECASE)
# Names of columns, in lower case and without units: of EuRoC, ROS, and people's tables.
_TIME = re.compile(r"t|id|index|sec.*|frame.*|time.*|.*stamp.*")
_NAMES = (
    *(re.compile(rf"(?:|t|p|[tp]_\w*|.*(?:pos|trans)\w*[._]?){axis}") for axis in "xyz"),
    *(re.compile(rf"(?:q|q_\w*|.*(?:quat|orient|rot)\w*[._]?){axis}") for axis in "xyzw"),
)


def in_metres(T_world_cam: np.ndarray, scale: float) -> np.ndarray:
    """A pose [4, 4] with its position, in units of ``scale`` metres, converted to metres."""
    T = T_world_cam.copy()
    T[:3, 3] *= scale
    return T


class PoseColumns:
    """The words of a pose file's lines, in the order of this module's formats. A header before the first pose sets the
    columns."""

    def __init__(self) -> None:
        self._order: list[int] | None = None
        self._started = False

    def words(self, text: str, where: str) -> list[str]:
        """The numbers of a line as words; none for a comment, a header or an empty line. Raises ValueError: the line
        has fewer columns than the header, or the first one has words that name no pose."""
        if not self._started and (order := _named_columns(text)):
            self._order = order
            return []
        words = _tokens(text)
        if words and not self._started and re.match(r"(?!nan|inf)[a-z%]", words[0], re.IGNORECASE):
            expected = "a header that names the columns, such as timestamp tx ty tz qx qy qz qw"
            raise ValueError(f"{where}: expected numbers or {expected}, got {text.strip()!r:.60}")
        self._started |= bool(words)
        if not words or self._order is None:
            return words
        if len(words) <= max(self._order):
            raise ValueError(
                f"{where}: expected {max(self._order) + 1} columns or more, as the header names, got {len(words)}"
            )
        return [words[column] for column in self._order]


def read_trajectory(path: str | Path) -> Trajectory:
    """Read a trajectory in any of the formats of this module; ``#`` starts a comment. Samples are sorted by time; the
    first of equal poses with the same timestamp is used. Raises ValueError: a line (named by file and number) is no
    pose of a known format, or contradicts another one; or there is no pose."""
    rows, lines = _numbers(as_path("path", path), PoseColumns().words)
    for row, where in zip(rows, lines, strict=True):
        if len(row) not in (7, 8, 12, 13, 16, 17):
            raise ValueError(
                f"{where}: expected a pose of 7 or 8 (tx ty tz qx qy qz qw), 12 or 13 (3x4), 16 or 17 (4x4) "
                f"numbers, got {len(row)}"
            )
        if len(row) != len(rows[0]):
            raise ValueError(f"{where}: expected {len(rows[0])} numbers as in the first pose, got {len(row)}")
    if not rows:
        raise ValueError(f"{path}: no pose found, expected lines of 7, 8, 12, 13, 16 or 17 numbers")
    values = np.array(rows, dtype=np.float64)
    timestamps = None
    if values.shape[1] in (8, 13, 17):
        timestamps, values = values[:, 0], values[:, 1:]
        bad = np.flatnonzero(~np.isfinite(timestamps))
        if bad.size:
            raise ValueError(f"{lines[bad[0]]}: the timestamp must be finite, got {timestamps[bad[0]]}")
    T_world_cam = poses_from_columns(values, lines)
    if timestamps is not None:
        stamps, first, same = np.unique(timestamps, return_index=True, return_inverse=True)
        _require_consistent(T_world_cam, first, same, lines)
        timestamps, T_world_cam = stamps, T_world_cam[first]
    return Trajectory(timestamps, T_world_cam)


def parse_pose(text: str, where: str, columns: PoseColumns) -> tuple[float, np.ndarray] | None:
    """Timestamp and pose [4, 4] of one line with 8, 13 or 17 numbers, all NaN if an entry of the pose is not finite;
    None for a line without numbers. Raises ValueError: another form; ``where`` names the line."""
    tokens = columns.words(text, where)
    if not tokens:
        return None
    row = np.array([number(token, where) for token in tokens])
    if len(row) not in (8, 13, 17) or not np.isfinite(row[0]):
        raise ValueError(f"{where}: expected a timestamp and a pose of 7, 12 or 16 numbers, got {text.strip()!r:.60}")
    return float(row[0]), poses_from_columns(row[None, 1:], [where])[0]


def associate(first: np.ndarray, second: np.ndarray, max_difference: float) -> dict[int, int]:
    """One-to-one pairs {i: j} of timestamps [N] and [M] [s] that differ by at most ``max_difference``, like TUM's tool
    for colour and depth: greedy, the closest pair first (ties: the earlier one)."""
    order = np.argsort(second, kind="stable")
    ordered = second[order]
    low = np.searchsorted(ordered, first - max_difference, side="left")
    high = np.searchsorted(ordered, first + max_difference, side="right")
    candidates = [
        (abs(first[i] - ordered[k]), i, int(order[k])) for i in range(len(first)) for k in range(low[i], high[i])
    ]
    pairs: dict[int, int] = {}
    used: set[int] = set()
    for _, i, j in sorted(candidates):
        if i not in pairs and j not in used:
            pairs[i] = j
            used.add(j)
    return pairs


def read_matrix(path: str | Path) -> np.ndarray:
    """The numbers of a small text file, one row per line, [R, C] float64, non-finite ones included. Raises ValueError:
    a line has something other than numbers, or lines differ in length."""
    rows, lines = _numbers(path, lambda text, _: _tokens(text))
    for row, where in zip(rows, lines, strict=True):
        if len(row) != len(rows[0]):
            raise ValueError(f"{where}: expected {len(rows[0])} numbers as in the first line, got {len(row)}")
    return np.array(rows, dtype=np.float64)


def numbers(values: Any, shape: tuple[int, ...], error: str) -> np.ndarray:
    """Nested finite numbers, as of JSON or YAML, as float64 of a shape. Raises ValueError with the text ``error``: they
    have another form."""
    with suppress(TypeError, ValueError, OverflowError):
        array = np.array(values, dtype=np.float64).reshape(shape)
        if np.isfinite(array).all():
            return array
    raise ValueError(error)


def read_pose(path: str | Path) -> np.ndarray:
    """The camera-to-world pose [4, 4] of a file with one 4x4 matrix; all NaN if an entry is not finite. Raises
    ValueError: the file does not have 4x4 numbers with the bottom row 0 0 0 1."""
    T = read_matrix(path)
    if T.shape != (4, 4):
        raise ValueError(f"{path}: expected a 4x4 matrix, got {' x '.join(map(str, T.shape))} numbers")
    return poses_from_columns(T.reshape(1, 16), [str(path)])[0]


def poses_from_quaternions(position: np.ndarray, quaternion_xyzw: np.ndarray) -> np.ndarray:
    """[N, 4, 4] poses from positions [N, 3] [m] and quaternions [N, 4], which need not be normalised; NaN where they
    are not finite."""
    T = np.full((len(position), 4, 4), np.nan)
    finite = np.isfinite(position).all(axis=1) & np.isfinite(quaternion_xyzw).all(axis=1)
    if finite.any():
        T[finite] = np.eye(4)
        T[finite, :3, :3] = Rotation.from_quat(quaternion_xyzw[finite]).as_matrix()
        T[finite, :3, 3] = position[finite]
    return T


def trajectory_of(stamps: np.ndarray, position: np.ndarray, quaternion_xyzw: np.ndarray, source: object) -> Trajectory:
    """Poses as :func:`poses_from_quaternions` in the order of their times [N], one per time. Raises ValueError: the
    ``source`` has no pose."""
    times, first = np.unique(stamps, return_index=True)
    if not times.size:
        raise ValueError(f"{source}: no pose with finite values")
    return Trajectory(times, poses_from_quaternions(position[first], quaternion_xyzw[first]))


def numbered_lines(path: str | Path) -> list[tuple[int, str]]:
    """Line numbers from 1, and the lines of a text file. Raises ValueError: the file is no text (UTF-8)."""
    try:
        return list(enumerate(read_text(path).splitlines(), start=1))
    except UnicodeDecodeError as error:
        raise ValueError(f"{path}: expected a text file in UTF-8 or UTF-16: {error.reason}") from error


def csv_rows(path: str | Path) -> list[tuple[list[str], str]]:
    """The words of each non-empty line of a table with commas, and its FILE:LINE; ``#`` starts a comment line. Raises
    ValueError: the file is no text."""
    lines = ((text.strip(), f"{path}:{line}") for line, text in numbered_lines(path))
    return [
        ([word.strip() for word in text.replace(";", ",").split(",")], where)
        for text, where in lines
        if text and not text.startswith("#")
    ]


def poses_from_columns(values: np.ndarray, lines: list[str]) -> np.ndarray:
    """[N, 4, 4] from rows of 7 (position, quaternion), 12 or 16 numbers; non-finite rows become NaN. Raises ValueError:
    a row is no pose; the message has its FILE:LINE of ``lines``."""
    finite = np.isfinite(values).all(axis=1)
    if values.shape[1] == 7:
        norm = np.linalg.norm(values[:, 3:], axis=1)
        bad = np.flatnonzero(finite & (np.abs(norm - 1) > _QUATERNION_TOLERANCE))
        if bad.size:
            raise ValueError(f"{lines[bad[0]]}: the quaternion's norm is {norm[bad[0]]:.4g}, expected 1")
        return poses_from_quaternions(values[:, :3], values[:, 3:])
    rows = values.reshape(len(values), -1, 4)
    if rows.shape[1] == 4:
        bad = np.flatnonzero(finite & (np.abs(rows[:, 3] - [0, 0, 0, 1]).max(axis=1) > 1e-6))
        if bad.size:
            raise ValueError(f"{lines[bad[0]]}: a pose's bottom row must be 0 0 0 1, got {rows[bad[0], 3]}")
    T = np.full((len(values), 4, 4), np.nan)
    T[finite, :3] = rows[finite, :3]
    T[finite, 3] = [0, 0, 0, 1]
    return T


def _require_consistent(T_world_cam: np.ndarray, first: np.ndarray, same: np.ndarray, lines: list[str]) -> None:
    """Raises ValueError: poses [N, 4, 4] with the same timestamp contradict each other. ``first`` [M] is the index of
    each timestamp's first pose, ``same`` [N] the index of each pose's timestamp, ``lines`` FILE:LINE of each pose."""
    reference = T_world_cam[first]
    step = np.linalg.norm(np.diff(reference[:, :3, 3], axis=0), axis=1)
    step = step[np.isfinite(step)]
    tolerance = max(_SAME_PLACE, float(np.median(step)) if step.size else 0.0)
    distance = np.linalg.norm(T_world_cam[:, :3, 3] - reference[same, :3, 3], axis=1)
    cosine = (np.einsum("nij,nij->n", T_world_cam[:, :3, :3], reference[same, :3, :3]) - 1) / 2
    angle = np.degrees(np.arccos(np.clip(cosine, -1, 1)))
    bad = np.flatnonzero((distance > tolerance) | (angle > _SAME_DIRECTION))
    if bad.size:
        i = bad[0]
        other, far = lines[first[same[i]]].rpartition(":")[2], f"{distance[i]:.3g} and {angle[i]:.3g} degrees from it"
        many = f"({bad.size} such poses); leave one of each out"
        raise ValueError(f"{lines[i]}: the pose has the timestamp of line {other}, but lies {far} {many}")


def _numbers(path: str | Path, words_of: Callable[[str, str], list[str]]) -> tuple[list[list[float]], list[str]]:
    """The numbers of each non-empty line, whose words ``words_of`` its text and FILE:LINE returns, and its
    FILE:LINE. Lines of words before the first number are headers."""
    rows: list[list[float]] = []
    lines: list[str] = []
    for line, text in numbered_lines(path):
        where = f"{path}:{line}"
        tokens = words_of(text, where)
        if tokens and (rows or not is_header(tokens)):
            rows.append([number(token, where) for token in tokens])
            lines.append(where)
    return rows, lines


def _named_columns(text: str) -> list[int] | None:
    """The columns of the timestamp (if it is named), x, y, z, qx, qy, qz and qw in a header; None if it names no
    pose."""
    separator = next((mark for mark in ";," if mark in text), None)
    names = [re.sub(r"\[.*?\]|\(.*?\)|[#%\s]", "", word).lower() for word in text.split(separator)]
    names = [name for name in names if name]
    found = [next((i for i, name in enumerate(names) if form.fullmatch(name)), None) for form in (_TIME, *_NAMES)]
    order = [column for column in found if column is not None]
    return order if None not in found[1:] and len(set(order)) == len(order) else None


def is_header(words: list[str]) -> bool:
    """True if none of the words is a number, as in a line that names columns."""
    return not any(re.match(r"[-+.]?\d|[-+]?(nan|inf)", word, re.IGNORECASE) for word in words)


def _tokens(text: str) -> list[str]:
    """Split a line into words and leave its comment out; a ``#`` inside a word (Windows' 1.#IND) starts none. Where
    spaces or semicolons separate the words, a comma inside a word stays: "0,5 1,5" has two words."""
    words = re.split(r"(?:^|\s)#", text, maxsplit=1)[0].split()
    separator = ";" if any(";" in word for word in words) else ","
    words = [word.strip(separator) for word in words]
    return words[0].split(separator) if len(words) == 1 else [word for word in words if word]


def number(word: str, where: str) -> float:
    """A word as a number, Windows' forms of NaN included. Raises ValueError: no number; ``where`` names the line."""
    if _WINDOWS_NON_FINITE.fullmatch(word):
        return float("nan")
    try:
        return float(word)
    except ValueError:
        point = " with a decimal point" if "," in word else ""
        raise ValueError(f"{where}: expected a number{point}, got {word[:60]!r}") from None

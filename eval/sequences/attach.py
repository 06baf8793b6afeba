"""Poses and depth maps of other programs, attached to the images of a sequence.

A pose (ORB-SLAM3, BundleFusion, COLMAP; TUM or KITTI format) belongs to an image by its time, by its frame number, or,
if the file has neither, by its position in the file. A map belongs to an image by its name. Frames without a partner
are skipped and counted; a pose or map is never shifted to the next image.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np

from ufmstar_torch.eval.sequences.frame import Entry, Loader, Skipped
from ufmstar_torch.eval.sequences.images import read_color
from ufmstar_torch.eval.sequences.options import Options
from ufmstar_torch.eval.sequences.paths import DEPTH_SUFFIXES, is_hidden, list_files
from ufmstar_torch.eval.sequences.poses import read_pose
from ufmstar_torch.frames.warnings import LOGGER
from ufmstar_torch.gaussians.trajectory import Trajectory, interpolate_pose

# Integer timestamps as file names: EuRoC and ROS write nanoseconds, some cameras microseconds [units/s].
_NANOSECONDS_ABOVE, _MICROSECONDS_ABOVE = 1e17, 1e14
# [units/s] Units of a trajectory's times other than seconds, used if the times in seconds do not overlap the images'.
_UNITS = (1e9, 1e6, 1e3)
# [s] Smallest step between two poses of a trajectory.
_MIN_STEP = 1e-3
# [1] Smallest share of images (or poses) with a partner for whole numbers to be frame numbers.
_MOST = 0.5

# [4, 4] placeholder for a frame's pose from a trajectory.
UNKNOWN = np.full((4, 4), np.nan)


def attach(frames: Sequence[Entry | Skipped], trajectory: Trajectory, options: Options) -> list[Entry | Skipped]:
    """All frames on disk, in order, with the poses (camera-to-world) of a trajectory; those without a pose are skipped.

    Without timestamps in the trajectory, pose i belongs to the i-th image. With them, the pose is interpolated at the
    image's time. Whole numbers equal to those in the images' names (``frame-000012``) are frame numbers, unless ``fps``
    is set. Timestamps in nanoseconds (ORB-SLAM3), microseconds or milliseconds are detected if they overlap the images'
    times only in that unit.

    Raises:
        ValueError: more or fewer poses than images; the images' times are unknown; no image has a pose (the message has
            both time ranges).
    """
    if all(isinstance(frame, Skipped) for frame in frames):
        return list(frames)
    stamps = [frame.timestamp if isinstance(frame, Entry) else np.nan for frame in frames]
    times = None if None in stamps else np.array(stamps, np.float64) + options.time_offset
    attached: list[Entry | Skipped] = []
    for i, (frame, T) in enumerate(zip(frames, _poses(frames, times, trajectory, options), strict=True)):
        if isinstance(frame, Skipped):
            attached.append(frame)
        elif T is None:
            attached.append(Skipped(frame.name, f"no pose within {options.max_pose_gap:g} s around the image"))
        else:
            time = frame.timestamp if times is None else float(times[i])
            attached.append(replace(frame, T_world_cam=T, timestamp=time))
    return attached


def number_times(frames: Sequence[Entry | Skipped], fps: float | None) -> Sequence[Entry | Skipped]:
    """The frames with the times number / ``fps``, by the number in the name or else in the sequence; unchanged without
    ``fps``."""
    if fps is None:
        return frames
    numbers = frame_numbers([frame.name for frame in frames])
    times = (np.arange(len(frames)) if numbers is None else numbers) / fps
    return [
        replace(frame, timestamp=float(time)) if isinstance(frame, Entry) else frame
        for frame, time in zip(frames, times, strict=True)
    ]


def frame_of_files(
    name: str, image: Path | None, pose: Path | None, load_depth: Loader | None, options: Options
) -> Entry | Skipped:
    """A frame with a separate pose file, which is not read if ``options.trajectory`` replaces it; skipped if the image
    or the pose is missing (None). Raises ValueError: a malformed pose file."""
    if pose is None and options.trajectory is None:
        return Skipped(name, "missing pose file")
    T_world_cam = UNKNOWN if pose is None or options.trajectory is not None else read_pose(pose)
    return frame_of_image(name, image, load_depth, T_world_cam)


def frame_of_image(
    name: str,
    image: Path | None,
    load_depth: Loader | None = None,
    T_world_cam: np.ndarray = UNKNOWN,
    timestamp: float | None = None,
) -> Entry | Skipped:
    """A frame of an image file; skipped if that is missing."""
    if image is None or not image.is_file():
        return Skipped(name, "missing image file", image)
    return Entry(name, T_world_cam, partial(read_color, image), load_depth, timestamp)


def _poses(
    frames: Sequence[Entry | Skipped], times: np.ndarray | None, trajectory: Trajectory, options: Options
) -> list[np.ndarray | None]:
    """The pose [4, 4] of each image, None if the trajectory has none."""
    if trajectory.timestamps is None:
        if len(trajectory) != len(frames):
            counts = f"{len(trajectory)} poses for {len(frames)} images"
            raise ValueError(f"trajectory has {counts}: without timestamps, there must be one for each")
        return list(trajectory.T_world_cam)
    times, stamps = _in_one_unit([frame.name for frame in frames], times, trajectory.timestamps, options.fps)
    trajectory = replace(trajectory, timestamps=stamps)
    poses = [interpolate_pose(trajectory, float(time), options.max_pose_gap) for time in times]
    if all(T is None for T in poses):
        gap = f", {np.median(np.diff(stamps)):.3g} s apart in the median" if len(stamps) > 1 else ""
        raise ValueError(
            f"no image has a pose: images lie at {np.nanmin(times):.3f} to {np.nanmax(times):.3f} s, the trajectory's "
            f"{len(stamps)} poses at {stamps[0]:.3f} to {stamps[-1]:.3f} s{gap}, used where they lie at most "
            f"{options.max_pose_gap:g} s apart; see --reader max_pose_gap, --time-offset and --fps"
        )
    return poses


def _in_one_unit(
    names: Sequence[str], times: np.ndarray | None, stamps: np.ndarray, fps: float | None
) -> tuple[np.ndarray, np.ndarray]:
    """Times of images and poses in the same unit, seconds or frame numbers.

    ``stamps`` are frame numbers if most timed images have a pose with their number, because 0, 1, 2, ... could also be
    seconds. For images without times, or with times that do not overlap the trajectory's, most images or most poses
    must have a partner.
    """
    numbers = frame_numbers(names) if fps is None and bool((stamps == np.floor(stamps)).all()) else None
    of_images = of_poses = 0.0
    if numbers is not None:
        of_images, of_poses = np.isin(numbers, stamps).mean(), np.isin(stamps, numbers).mean()
        if of_images >= _MOST or (times is None and of_poses >= _MOST):
            return numbers, stamps
    if times is None:
        raise ValueError(
            f"images: the name {names[0]!r} is no timestamp, there is no rgb.txt, and the trajectory's timestamps "
            f"({stamps[0]:g}, ...) are no frame numbers of the images: pass fps (and time_offset)"
        )
    if _meet(stamps, times):
        return times, stamps
    step = float(np.median(np.diff(stamps))) if len(stamps) > 1 else 0.0
    for unit in _UNITS:
        if _meet(stamps / unit, times) and step / unit >= _MIN_STEP:
            return times, stamps / unit
    return (times, stamps) if numbers is None or of_poses < _MOST else (numbers, stamps)


def frame_numbers(names: Sequence[str]) -> np.ndarray | None:
    """[N] the whole number in each name, 12 in ``frame-000012``; None if a name has none or several."""
    result = [re.findall(r"\d+", name) for name in names]
    if not result or any(len(groups) != 1 for groups in result):
        return None
    return np.array([float(groups[0]) for groups in result])


def stem_times(names: Sequence[str]) -> np.ndarray | None:
    """[N] names as timestamps [s], also those in nanoseconds or microseconds; None if a name is no number."""
    try:
        times = np.array([float(name) for name in names])
    except ValueError:
        return None
    if times.size and times.max() > _MICROSECONDS_ABOVE:
        times = times / (1e9 if times.max() > _NANOSECONDS_ABOVE else 1e6)
    return times


def _meet(first: np.ndarray, second: np.ndarray) -> bool:
    return bool(np.nanmin(first) <= np.nanmax(second) and np.nanmin(second) <= np.nanmax(first))


def pair_by_name(names: Sequence[str], files: Iterable[Path]) -> dict[str, Path]:
    """The files by frame name: their stems are equal, or else all numbers in them (``frame-000012.color`` and
    ``000012_depth``; leading zeros are ignored, decimals are not). Numbers that occur twice in the files or in the
    names are not paired."""
    files = list(files)
    by_stem = {file.stem: file for file in files}
    file_of = _unique({file: _numbers(file.stem) for file in files})
    name_of = _unique({name: _numbers(name) for name in names})
    pairs = {name_of[key]: file for key, file in file_of.items() if key in name_of}
    return {name: by_stem.get(name) or pairs[name] for name in names if name in by_stem or name in pairs}


def pair_depth(names: Sequence[str], folder: Path) -> dict[str, Path]:
    """The depth maps of a folder by frame name; one with other files alone is logged. Raises ValueError: no map has a
    partner."""
    files = list_files(folder, DEPTH_SUFFIXES)
    if not files and (other := next((path.name for path in folder.iterdir() if not is_hidden(path)), None)):
        LOGGER.warning("%s holds no depth map (%s), but %s: it is left out", folder, ", ".join(DEPTH_SUFFIXES), other)
    pairs = pair_by_name(names, files)
    if files and not pairs:
        raise ValueError(f"{folder}: no depth map ({files[0].name}, ...) is named like an image ({names[0]}, ...)")
    return pairs


def _numbers(stem: str) -> tuple[int | str, ...]:
    """Digit groups by value; those after a decimal point as text, because 1.05 is not 1.5."""
    groups = re.findall(r"((?<=\d)\.)?(\d+)", stem)
    return tuple(digits if point else int(digits) for point, digits in groups)


def _unique(numbers_of: dict) -> dict:
    """The inverse of a mapping, without the value () and values shared by several items."""
    inverse: dict = {}
    for item, key in numbers_of.items():
        inverse.setdefault(key, []).append(item)
    return {key: items[0] for key, items in inverse.items() if len(items) == 1 and key}

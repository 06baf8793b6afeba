"""The last step of every reader: poses of a trajectory, cameras, undistorted images."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from ufmstar_torch.eval.sequences.attach import attach, number_times
from ufmstar_torch.eval.sequences.frame import Entry, FrameSequence, Size, Skipped, check_intrinsics, make_sequence
from ufmstar_torch.eval.sequences.images import first_depth_size
from ufmstar_torch.eval.sequences.intrinsics import pinhole, read_intrinsics, scale_intrinsics
from ufmstar_torch.eval.sequences.lens import Lens, parse_distortion
from ufmstar_torch.eval.sequences.options import Options, resolve
from ufmstar_torch.eval.sequences.poses import read_trajectory
from ufmstar_torch.gaussians.trajectory import Trajectory


def assemble(
    layout: str,
    path: Path,
    frames: Sequence[Entry | Skipped],
    lenses: Lens | Mapping[str, Lens] | None,
    options: Options,
    *,
    name: str | None = None,
    size: Size | None = None,
    read_poses: Callable[[], Trajectory] | None = None,
    K_depth: np.ndarray | None = None,
    depth_size: Size | None = None,
    posed: bool = True,
    metric: bool = True,
) -> FrameSequence:
    """The sequence of a layout's frames.

    Args:
        layout: name of the layout.
        path: of the sequence; a relative ``options.trajectory`` is searched there first.
        frames: all frames on disk, in order.
        lenses: the camera, or cameras by frame name; None = use ``options.intrinsics`` and ``size``.
        options: ``trajectory``, ``fps``, ``intrinsics``, ``depth_intrinsics`` and ``distortion`` replace the layout's.
        name: of the sequence; None = that of the path.
        size: (H, W) of the images, which may have been resized; None = the lenses'.
        read_poses: reads the layout's trajectory; None = the frames have poses.
        K_depth: [3, 3] intrinsics of the depth maps [px]; None = they have the images' field of view.
        depth_size: (H, W) of the depth maps; None = that of the first readable one.
        posed: True if poses are known.
        metric: True if the layout's poses are in metres; those of ``options.trajectory`` are.

    Raises:
        FileNotFoundError: no such trajectory.
        ValueError: no usable frame, or a trajectory, camera or size that does not fit.
    """
    if options.trajectory is not None:
        root = path if path.is_dir() else path.parent
        frames = attach(number_times(frames, options.fps), read_trajectory(resolve(root, options.trajectory)), options)
    elif read_poses is not None:
        frames = attach(frames, read_poses(), options)
    several = isinstance(lenses, Mapping)
    if isinstance(lenses, Mapping):
        lens_of = {frame.name: _lens(lenses[frame.name], size, options) for frame in frames if isinstance(frame, Entry)}
    else:
        lens_of = dict.fromkeys((frame.name for frame in frames), _lens(lenses, size, options))
    for lens in set(lens_of.values()):
        check_intrinsics("intrinsics", pinhole(*lens.intrinsics), lens.size)
    first = next(iter(lens_of.values()), Lens((1.0, 1.0, 0.0, 0.0), (1, 1)))
    sequence = make_sequence(
        name or (path.resolve().name if path.is_dir() else path.stem),
        layout,
        frames,
        pinhole(*first.intrinsics),
        image_size=first.size,
        depth_intrinsics=K_depth if options.depth_intrinsics is None else read_intrinsics(options.depth_intrinsics),
        depth_size=depth_size or first_depth_size(frames),
        posed=posed,
        metric=metric or options.trajectory is not None,
    )
    return undistort(sequence, lambda entry: lens_of[entry.name], several)


def undistort(sequence: FrameSequence, lens_of: Callable[[Entry], Lens], several: bool) -> FrameSequence:
    """The sequence without the distortion of its lenses (``several``: more than one), also in depth maps without
    separate intrinsics. Raises ValueError: no lens has these coefficients."""
    depth_size, registered = sequence.depth_size, sequence.depth_intrinsics is None

    def K_depth(lens: Lens) -> np.ndarray | None:
        if not registered or depth_size in (None, lens.size):
            return sequence.depth_intrinsics
        return scale_intrinsics(lens.K, lens.size, depth_size)

    def seen(entry: Entry) -> Entry:
        lens = lens_of(entry)
        entry = lens.see(entry, depth_size if registered else None)
        if not several:
            return entry
        return replace(entry, intrinsics=lens.K, image_size=lens.size, depth_intrinsics=K_depth(lens))

    first = lens_of(sequence.entries[0])
    return replace(sequence.changed(seen), intrinsics=first.K, depth_intrinsics=K_depth(first))


def _lens(calibrated: Lens | None, size: Size | None, options: Options) -> Lens:
    """The camera of images of a ``size``; the options override it."""
    if options.intrinsics is None:
        assert calibrated is not None
        lens = calibrated if size is None else calibrated.resized(size)
    else:
        image_size = size if calibrated is None else size or calibrated.size
        assert image_size is not None
        lens = Lens.of(read_intrinsics(options.intrinsics), image_size)
    if options.distortion is None:
        return lens
    coefficients, fisheye = parse_distortion(options.distortion)
    return replace(lens, coefficients=coefficients, fisheye=fisheye)

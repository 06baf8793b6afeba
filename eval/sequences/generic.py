"""Any posed images: a folder or a video, a trajectory, intrinsics, and optionally depth maps.

The reader searches the sequence's folder (options override each): images in one of ``images image rgb color frames`` or
in the folder itself, or one video file; a trajectory ``poses.txt trajectory.txt groundtruth.txt ...``; intrinsics
``K.txt intrinsics.txt ...``, or KITTI's ``calib.txt``; depth maps in ``depth``.
"""

from __future__ import annotations

import re
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np

from ufmstar_torch.eval.sequences.assemble import assemble
from ufmstar_torch.eval.sequences.attach import UNKNOWN, pair_depth, stem_times
from ufmstar_torch.eval.sequences.frame import Entry, FrameSequence, Size, Skipped
from ufmstar_torch.eval.sequences.images import depth_loader, first_image_size, read_color
from ufmstar_torch.eval.sequences.intrinsics import FILES, camera_file, projections, read_intrinsics
from ufmstar_torch.eval.sequences.lens import Lens
from ufmstar_torch.eval.sequences.options import Options, resolve
from ufmstar_torch.eval.sequences.paths import DEPTH_SUFFIXES, IMAGE_SUFFIXES, list_files, on_disk
from ufmstar_torch.eval.sequences.poses import associate, read_trajectory
from ufmstar_torch.eval.sequences.tum import SCALE as TUM_SCALE
from ufmstar_torch.eval.sequences.tum import read_file_list
from ufmstar_torch.eval.sequences.video import VIDEO_SUFFIXES, Video
from ufmstar_torch.frames.warnings import LOGGER
from ufmstar_torch.gaussians.conventions import OURS

IMAGES = ("images", "image", "rgb", "color", "frames", *(f"image_{camera}" for camera in range(4)))  # KITTI's last
DEPTHS = ("depth", "depths")
TRAJECTORIES = (
    *("poses.txt", "pose.txt", "trajectory.txt", "traj.txt", "groundtruth.txt"),
    *("CameraTrajectory.txt", "KeyFrameTrajectory.txt", "cam0_to_world.txt", "poses.csv", "trajectory.csv"),
)
_CAMERA = re.compile(r"image_0?([1-3])")
_KITTI = "calib.txt"  # of KITTI's odometry benchmark; read if there is none of the others
INTRINSICS = (*FILES, _KITTI)
LOOKED_FOR = (
    f"images ({', '.join(IMAGES)}/ or a video), a trajectory ({', '.join(TRAJECTORIES)}; "
    f"`ufmstar poses` computes one from images alone), {INTRINSICS[0]}"
)


def detect(path: Path) -> bool:
    """True if this reader finds images and a trajectory."""
    if path.is_file():
        return path.suffix.lower() in VIDEO_SUFFIXES
    has_trajectory = any(on_disk(path / name).is_file() for name in TRAJECTORIES)
    return has_trajectory and bool(_image_sources(path))


def read(path: Path, options: Options) -> FrameSequence:
    """Open images or a video with a trajectory.

    Without timestamps in the trajectory, pose i belongs to the i-th image (numbers sorted by value). With them, an
    image's time is, in this order: its line in ``rgb.txt`` next to the images or their folder; index / ``fps``; its
    timestamp in a video's container; its name as a number [s, or us or ns if large]; plus ``time_offset``. The pose is
    interpolated as for TUM RGB-D.

    Depth maps belong to the image with the same stem or the same numbers in the name. If there are none and the names
    are timestamps, they belong to the nearest image within ``max_time_difference``, one-to-one.
    """
    root = path if path.is_dir() else path.parent
    images, size = open_images(path, options)
    read_poses = partial(read_trajectory, _named_or_found(root, options.trajectory, TRAJECTORIES, "trajectory"))
    frames = _with_depth(images, root, options, options.truth_scale)
    # In a generic sequence, ``fps`` counts images, not numbers in their names.
    counted = replace(options, trajectory=None)
    lens = _lens(root, options, size)
    sequence = assemble("generic", path, frames, lens, counted, size=size, read_poses=read_poses)
    if (baseline := _baseline(root, options)) is None or options.poses != OURS:
        return sequence
    return sequence.changed(lambda entry: replace(entry, T_world_cam=entry.T_world_cam @ baseline))


def _baseline(root: Path, options: Options) -> np.ndarray | None:
    """[4, 4] the pose of KITTI's camera N in camera 0, whose poses the benchmark publishes, for images ``image_N``
    beside a file of projections P = K [I | t]: the camera lies at -t; None for other images."""
    images = Path(options.images) if options.images is not None else (_image_sources(root) or [root])[0]
    number = _CAMERA.fullmatch(images.name)
    file = Path(options.intrinsics) if isinstance(options.intrinsics, str | Path) else on_disk(root / _KITTI)
    if number is None or not file.is_file() or not {0, int(number[1])} <= (found := projections(file)).keys():
        return None
    T = np.eye(4)
    T[:3, 3] = -np.linalg.solve(found[0][:, :3], found[int(number[1])][:, 3] - found[0][:, 3])
    LOGGER.warning("%s: poses are those of image_0, moved by %.3f m (%s)", images, np.linalg.norm(T[:3, 3]), file.name)
    return T


def has_images_and_depth(path: Path) -> bool:
    """True if :func:`open_unposed` finds a folder of images and one of depth maps."""
    return path.is_dir() and all(any(on_disk(path / name).is_dir() for name in names) for names in (IMAGES, DEPTHS))


def open_unposed(path: Path, options: Options) -> FrameSequence:
    """Open images with depth maps for uses without poses, such as training: a sequence with ``posed`` False. Images
    without a depth map are skipped. Without ``truth_scale``, maps next to TUM's ``depth.txt`` are in 1/5000 m. Raises
    ValueError: images, depth maps or intrinsics are not found, or no depth map fits an image."""
    if options.trajectory is not None or options.T_color_depth is not None:
        raise ValueError("images without poses take no trajectory and no T_color_depth")
    if not has_images_and_depth(path):
        raise ValueError(f"{path} must hold one of {', '.join(IMAGES)} and one of {', '.join(DEPTHS)}")
    images, size = open_images(path, replace(options, images=options.images or _image_sources(path)[0]))
    scale = options.truth_scale
    if scale is None and (path / "depth.txt").is_file():
        scale = TUM_SCALE
    frames = [
        replace(image, T_world_cam=np.eye(4)) if image.load_depth is not None else Skipped(image.name, "no depth map")
        for image in _with_depth(images, path, options, scale)
    ]
    return assemble("unposed", path, frames, _lens(path, options, size), options, size=size, posed=False)


def _lens(root: Path, options: Options, size: Size) -> Lens | None:
    """Read the camera from a file next to the images; None if the options have intrinsics."""
    if options.intrinsics is not None:
        return None
    others = tuple(name for name in INTRINSICS if name != _KITTI)
    names = others if camera_file(root, others) else INTRINSICS
    return Lens.of(read_intrinsics(_named_or_found(root, None, names, "intrinsics")), size)


def open_images(path: Path, options: Options) -> tuple[list[Entry], Size]:
    """The images without poses and depth, with their times if known, and their (H, W). Raises ValueError: no images, or
    none that can be read."""
    source = path
    if options.images is not None:
        source = resolve(path, options.images)
    elif path.is_dir():
        result = _image_sources(path)
        if len(result) != 1:
            listing = f"found {[str(f) for f in result]}" if result else f"looked for {IMAGES} and a video file"
            raise ValueError(f"{path}: pass images, there must be one folder of them or one video ({listing})")
        source = result[0]
    if source.is_file():
        video = Video(source)
        times = video.times() if options.fps is None else np.arange(len(video)) / options.fps
        loaders = [partial(video.read, i) for i in range(len(video))]
        images = [Entry(f"{i:06d}", UNKNOWN, loaders[i], None, time) for i, time in enumerate(times.tolist())]
        return images, video.size
    files = list_files(source)
    size = first_image_size(files)
    if size is None:
        raise ValueError(f"{source} holds no image that can be read ({', '.join(IMAGE_SUFFIXES)})")
    file_times = listed_times(source, files)
    if file_times is None and options.fps is not None:
        file_times = np.arange(len(files)) / options.fps
    elif file_times is None:
        file_times = stem_times([file.stem for file in files])
    stamps = [None] * len(files) if file_times is None else file_times.tolist()
    images = [Entry(f.stem, UNKNOWN, partial(read_color, f), None, t) for f, t in zip(files, stamps, strict=True)]
    return images, size


def _image_sources(path: Path) -> list[Path]:
    """Folders with images, or else the folder itself, or else its video files."""
    folders = [folder for name in IMAGES if (folder := on_disk(path / name)).is_dir()]
    return folders or ([path] if list_files(path) else list_files(path, VIDEO_SUFFIXES))


def listed_times(folder: Path, files: list[Path]) -> np.ndarray | None:
    """Timestamps [N] [s] of images by the ``rgb.txt`` next to them or their folder; None without one. Raises
    ValueError: it has no timestamp of an image."""
    listing = next((f / "rgb.txt" for f in (folder, folder.parent) if (f / "rgb.txt").is_file()), None)
    if listing is None:
        return None
    listed = {Path(name).name: time for time, name in zip(*read_file_list(listing), strict=True)}
    absent = [file.name for file in files if file.name not in listed]
    if absent:
        raise ValueError(f"{listing} has no timestamp for {len(absent)} images: {absent[:3]}")
    return np.array([listed[file.name] for file in files])


def depth_folder(root: Path, inside: Path, options: Options) -> Path | None:
    """The folder of depth maps: ``options.truth``, or else one of ``DEPTHS`` in a folder; None without any."""
    if options.truth is not None:
        return resolve(root, options.truth)
    return next((folder for name in DEPTHS if (folder := on_disk(inside / name)).is_dir()), None)


def _with_depth(images: list[Entry], root: Path, options: Options, scale: float | None) -> list[Entry]:
    """The images with their depth maps, if any, in ``scale`` [m per unit]."""
    folder = depth_folder(root, root, options)
    files = {} if folder is None else _depth_files(folder, images, options)
    return [replace(image, load_depth=depth_loader(files.get(image.name), scale)) for image in images]


def _depth_files(folder: Path, images: list[Entry], options: Options) -> dict[str, Path]:
    names, times = [image.name for image in images], [image.timestamp for image in images]
    try:
        return pair_depth(names, folder)
    except ValueError:
        files = list_files(folder, DEPTH_SUFFIXES)
        depth_times = stem_times([file.stem for file in files])
        if depth_times is None or None in times:
            raise
        pairs = associate(np.array(times), depth_times, options.max_time_difference)
        if not pairs:
            raise
        return {names[i]: files[j] for i, j in pairs.items()}


def _named_or_found(root: Path, override: str | Path | None, names: tuple[str, ...], option: str) -> Path:
    if override is not None:
        return resolve(root, override)
    result = [file for name in names if (file := on_disk(root / name)).is_file()]
    if len(result) != 1:
        listing = f"found {[file.name for file in result]}" if result else f"looked for {', '.join(names)}"
        hint = "; `ufmstar poses` computes poses from images alone" if option == "trajectory" and not result else ""
        count = "several files of" if result else "no file of"
        raise ValueError(f"{root.resolve().name}: {count} {option} ({listing}): pass {option}{hint}")
    return result[0]

"""``open_sequence``: detects a dataset's layout from the files on disk and opens it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np

from ufmstar_torch.eval.sequences import generic, kitti360, nyu, scannet, sens, seven_scenes, tartanair, tum
from ufmstar_torch.eval.sequences.conventions import CONVENTIONS, OURS, convert_poses
from ufmstar_torch.eval.sequences.frame import FrameSequence
from ufmstar_torch.eval.sequences.intrinsics import IntrinsicsLike
from ufmstar_torch.eval.sequences.options import Options

_READERS: dict[str, tuple[Callable[[Path], bool], Callable[[Path, Options], FrameSequence], str]] = {
    "tum": (tum.detect, tum.open_tum, tum.LOOKED_FOR),
    "7scenes": (seven_scenes.detect, seven_scenes.open_seven_scenes, seven_scenes.LOOKED_FOR),
    "scannet": (scannet.detect, scannet.open_scannet, scannet.LOOKED_FOR),
    "sens": (sens.detect, sens.open_sens, sens.LOOKED_FOR),
    "tartanair": (tartanair.detect, tartanair.open_tartanair, tartanair.LOOKED_FOR),
    "kitti360": (kitti360.detect, kitti360.open_kitti360, kitti360.LOOKED_FOR),
    "nyu": (nyu.detect, nyu.open_nyu, nyu.LOOKED_FOR),
    "generic": (generic.detect, generic.open_generic, generic.LOOKED_FOR),
}
LAYOUTS = ("auto", *_READERS)


def open_sequence(
    path: str | Path,
    layout: str = "auto",
    *,
    intrinsics: IntrinsicsLike | None = None,
    depth_intrinsics: IntrinsicsLike | None = None,
    trajectory: str | Path | None = None,
    images: str | Path | None = None,
    depth: str | Path | None = None,
    depth_scale: float | None = None,
    max_time_difference: float = 0.02,
    max_pose_gap: float = 0.1,
    fps: float | None = None,
    time_offset: float = 0.0,
    register: bool = True,
    T_color_depth: np.ndarray | None = None,
    drive: str | int | None = None,
    scans: int | None = None,
    poses: str = OURS,
) -> FrameSequence:
    """Opens a sequence of posed images; nothing but headers and text files is read before it is indexed.

    Args:
        path: the sequence's folder, or a video file (``ufmstar_torch.eval.tour.open`` also takes rendered tours).
        layout: ``auto``, ``tum``, ``7scenes``, ``scannet``, ``sens``, ``tartanair``, ``kitti360``, ``nyu`` or
            ``generic``.
        intrinsics: instead of the layout's own [px]: a file, a 3x3 matrix, or fx, fy, cx, cy.
        depth_intrinsics: the same of the depth maps (7-Scenes, ScanNet, generic).
        trajectory: file in TUM or KITTI format whose camera-to-world poses, with our axes, replace the layout's own:
            those of ORB-SLAM3, BundleFusion, ... Inside the sequence's folder, or else from the working folder.
        images: folder of images or video file (generic).
        depth: folder of depth maps (generic, KITTI-360).
        depth_scale: metres per unit of the depth files, instead of the layout's own.
        max_time_difference: between paired colour and depth images [s] (TUM, generic).
        max_pose_gap: poses are interpolated between samples at most this far apart [s]; at 0.1 s a hand
            that accelerates at 2 m/s^2 departs 2.5 mm from the straight line.
        fps: frames per second of images without timestamps, or instead of the video's own, where a trajectory has
            timestamps. Images of a layout that numbers them are counted by that number.
        time_offset: added to the images' times [s].
        register: warp 7-Scenes' depth into the colour camera.
        T_color_depth: [4, 4] depth to colour camera [m] (7-Scenes).
        drive: name or number of the drive, where ``path`` is KITTI-360's root.
        scans: laser scans of as many frames before and after a frame that are added to its own (KITTI-360); moving
            things smear.
        poses: how they are written: ``camera-to-world`` (x right, y down, z forward), ``world-to-camera``, ``ned``
            (camera-to-world, x forward, y right, z down) or ``opengl`` (x right, y up, z backward); what is
            customary for a layout (TartanAir's NED) is known.

    Returns:
        The frames with a usable pose; ``skipped`` has the others.

    Raises:
        FileNotFoundError: ``path`` does not exist.
        ValueError: unknown or ambiguous layout (with what was looked for), an option out of range or of no
            use for the layout, malformed files (named by file and line), or no usable frame.
    """
    path = Path(path)
    if not path.exists():
        raise FileNotFoundError(f"path: no such file or folder: {path}")
    options = Options(
        intrinsics=intrinsics,
        depth_intrinsics=depth_intrinsics,
        trajectory=trajectory,
        images=images,
        depth=depth,
        depth_scale=depth_scale,
        max_time_difference=max_time_difference,
        max_pose_gap=max_pose_gap,
        fps=fps,
        time_offset=time_offset,
        register=register,
        T_color_depth=T_color_depth,
        drive=drive,
        scans=scans,
    )
    if poses not in CONVENTIONS:
        raise ValueError(f"poses must be one of {', '.join(CONVENTIONS)}, got {poses!r}")
    layout = _chosen(layout, path, explicit=images is not None or trajectory is not None)
    if layout != "kitti360":
        options.reject(layout, "drive", "scans")
    _, open_reader, _ = _READERS[layout]
    sequence = replace(open_reader(path, options), folder=path if path.is_dir() else path.parent)
    return convert_poses(sequence, poses)


def _chosen(layout: str, path: Path, explicit: bool) -> str:
    """The layout by name, or detected for "auto"."""
    if layout == "auto":
        layout = detect_layout(path, explicit=explicit)
    if layout not in _READERS:
        raise ValueError(f"layout must be one of {', '.join(LAYOUTS)}, got {layout!r}")
    detect, _, looked_for = _READERS[layout]
    if layout != "generic" and not detect(path):
        raise ValueError(f"{path} has not the layout {layout!r}: looked for {looked_for}")
    return layout


def detect_layout(path: Path, explicit: bool = False) -> str:
    """The one layout whose files lie in ``path``; ``generic`` only where no other fits.

    Args:
        path: existing folder or video file.
        explicit: the user names the images or the trajectory, so that generic always fits.

    Raises:
        ValueError: none or several fit.
    """
    fitting = layouts_of(path)
    if not fitting and explicit:
        return "generic"
    if len(fitting) == 1:
        return fitting[0]
    if fitting:
        raise ValueError(f"{path} fits the layouts {', '.join(fitting)}: pass layout")
    expected = "\n".join(f"  {name}: {looked_for}" for name, (_, _, looked_for) in _READERS.items())
    inside = sorted(p.name for p in path.iterdir())[:8] if path.is_dir() else [path.name]
    raise ValueError(f"{path} has no known layout. Looked for\n{expected}\nand found {inside}")


def layouts_of(path: Path) -> list[str]:
    """The layouts whose files lie in ``path``, all of them; ``generic`` only where no other fits."""
    fitting = [name for name, (detect, _, _) in _READERS.items() if name != "generic" and detect(path)]
    return fitting or (["generic"] if generic.detect(path) else [])


def parts_of(path: Path, layout: str) -> list[Path]:
    """The single sequences of a path that has this layout: itself, or folders in it that hold one each."""
    holding = {"tartanair": tartanair.trajectory_folders, "kitti360": kitti360.drives, "nyu": nyu.parts}
    return holding[layout](path) if layout in holding else [path]

"""A run's result for other programs: depth and sigma, a cloud of points, the trajectory, or ``transforms.json``.

The files are below OUT/export. Depth and sigma are the run's: the posterior's unless it is plain. Pixels that are not
valid, or whose sigma exceeds a limit, are left out.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ufmstar_torch.eval.engine.files import remove_temporaries, write_bytes_atomic, write_json_atomic
from ufmstar_torch.eval.run.colours import known_where
from ufmstar_torch.eval.run.gaussians import vertex_table, world_offset, write_ply
from ufmstar_torch.eval.run.writers import encode_length_png, fitting_unit, frame_file, read_frame
from ufmstar_torch.eval.sequences.frame import FrameError, FrameSequence
from ufmstar_torch.eval.sequences.ground_truth import points_of, resample_nearest
from ufmstar_torch.eval.sequences.intrinsics import pinhole_values
from ufmstar_torch.eval.sequences.own_output import RECORDS, read_records
from ufmstar_torch.gaussians.conventions import CONVENTIONS

_LEAST_SIGMA = 1e-3  # [m] lower limit of sigma in a point's weight
_HALF = 2**20  # a voxel's number on an axis is within +- this, so that three fit into 64 bits
_FOLD = 4_000_000  # number of points in memory before they are merged


@dataclass(frozen=True, eq=False)
class RunFrame:
    """A frame of a run: its name, camera and maps [h, w]; depth and sigma [m] are NaN where left out."""

    name: str
    index: int  # in the sequence
    timestamp: float | None  # [s]
    T_world_cam: NDArray[np.float64]  # [4, 4] [m]
    intrinsics: NDArray[np.float64]  # [3, 3] of the maps [px]
    depth: NDArray[np.float32]
    sigma: NDArray[np.float32]
    anchors: NDArray[np.float32] | None = None  # [N, 4] u, v [px], depth and its standard deviation [m]
    figures: Mapping[str, Any] = field(default_factory=dict)  # by name, as in frames.jsonl
    image: NDArray[np.uint8] | None = None  # [H, W, 3] RGB of the recording
    image_intrinsics: NDArray[np.float64] | None = None  # [3, 3] of the image [px]

    def at_image(self) -> RunFrame:
        """The frame with maps at the pixels of its image, NaN outside the maps; unchanged without an image."""
        if self.image is None or self.image_intrinsics is None:
            return self
        K, size = self.image_intrinsics, (self.image.shape[0], self.image.shape[1])
        depth, sigma = (resample_nearest(values, self.intrinsics, K, size) for values in (self.depth, self.sigma))
        valid = depth > 0
        return replace(self, intrinsics=K, depth=known_where(valid, depth), sigma=known_where(valid, sigma))

    def points(self) -> tuple[NDArray[np.float64], tuple[NDArray[np.int64], NDArray[np.int64]]]:
        """[P, 3] points in the camera's axes [m] of the pixels with a depth, and these pixels' rows and columns."""
        v, u = np.nonzero(np.isfinite(self.depth))
        return points_of(u, v, self.depth[v, u], self.intrinsics), (v, u)


def gated_frames(
    out: Path, max_sigma: float, max_relative_sigma: float, pixels: Counter[str] | None = None
) -> Iterator[RunFrame]:
    """The finished frames of a run, without pixels whose sigma exceeds ``max_sigma`` [m], or ``max_relative_sigma`` as
    a share of the depth; adds the numbers of pixels with a depth, "all" and "kept", to ``pixels``. Raises ValueError:
    ``out`` is no run's folder, or has no finished frame."""
    pixels = Counter() if pixels is None else pixels
    if not (out / RECORDS).is_file():
        raise ValueError(f"{out} is no output of `ufmstar run`: it has no {RECORDS}")
    records = read_records((out / RECORDS).read_bytes(), out / RECORDS)
    done = [record for record in records if record["state"] == "done"]
    if not done:
        raise ValueError(f"{out} has no finished frame")
    return (_gated(out, record, max_sigma, max_relative_sigma, pixels) for record in done)


def _gated(
    out: Path, record: Mapping[str, Any], max_sigma: float, max_relative_sigma: float, pixels: Counter[str]
) -> RunFrame:
    maps = read_frame(frame_file(out, record["name"]))
    depth, variance = maps["depth"], maps["variance"]
    with np.errstate(invalid="ignore"):
        sigma = np.sqrt(variance)
        has_depth = maps["valid"] & (depth > 0) & np.isfinite(depth)
        mask = has_depth & (sigma <= max_sigma) & (sigma <= max_relative_sigma * depth)
    pixels.update(all=int(has_depth.sum()), kept=int(mask.sum()))
    about = (record["name"], record["index"], record.get("timestamp"), maps["T_world_cam"], maps["intrinsics"])
    shown = known_where(mask, depth), known_where(mask, sigma)
    return RunFrame(*about, *shown, maps.get("anchors"), record)


def with_images(frames: Iterator[RunFrame], sequence: FrameSequence) -> Iterator[RunFrame]:
    """The frames with the images of their recording, if these can be read. Raises ValueError, after the last frame: the
    recording has none of the frames."""
    common = 0
    for frame in frames:
        if frame.index < len(sequence) and sequence.names[frame.index] == frame.name:
            common += 1
            with suppress(FrameError):
                recorded = sequence[frame.index]
                frame = replace(frame, image=recorded.image, image_intrinsics=recorded.intrinsics)
        yield frame
    if not common:
        raise ValueError(
            f"--sequence: {sequence.name!r} has none of the run's frames: open the run's recording as it did"
        )


def export_depth(frames: Iterator[RunFrame], out: Path) -> str:
    """depth/NAME.png and sigma/NAME.png, 16 bits, 0 = left out."""
    folders, unit, count = [export_folder(out, kind) for kind in ("depth", "sigma")], None, 0
    for frame in frames:
        count += 1
        unit = unit or fitting_unit(frame.depth)
        for folder, values, metres in zip(folders, (frame.depth, frame.sigma), (unit, unit / 10), strict=True):
            write_bytes_atomic(folder / f"{frame.name}.png", encode_length_png(values, metres, folder.name))
    return f"{folders[0]}, {folders[1]}: {count} maps each"


def export_trajectory(frames: Iterator[RunFrame], out: Path) -> str:
    """Lines "time tx ty tz qx qy qz qw", with the time [s] or, without one, the frame's index."""
    from scipy.spatial.transform import Rotation

    lines = ["# time tx ty tz qx qy qz qw, camera-to-world [m]"]
    for frame in frames:
        time = float(frame.index) if frame.timestamp is None else frame.timestamp
        quaternion = Rotation.from_matrix(frame.T_world_cam[:3, :3]).as_quat()
        position = (f"{x:.9f}" for x in frame.T_world_cam[:3, 3])  # nm, however far the origin
        lines.append(" ".join([f"{time:.9f}", *position, *(f"{x:.12g}" for x in quaternion)]))
    file = export_folder(out) / "trajectory.txt"
    write_bytes_atomic(file, "\n".join([*lines, ""]).encode())
    return f"{file}: {len(lines) - 1} poses"


def export_cloud(frames: Iterator[RunFrame], out: Path, voxel: float) -> str:
    """cloud.ply: x y z in double precision and sigma [m], and red green blue where images can be read.

    A point is the mean of the pixels in a voxel with side ``voxel`` [m], weighted by 1/sigma^2. Its sigma is
    sqrt(n / sum 1/sigma^2), which does not shrink with the number n of pixels, because their errors are correlated.
    Pixels over 2^20 voxels from the first camera, along an axis, are left out and counted. Raises ValueError: no pixel
    is left.
    """
    origin, far = None, 0
    keys, sums = np.zeros(0, np.int64), np.zeros((0, 8))
    waiting: list[tuple[NDArray[np.int64], NDArray[np.float64]]] = []
    coloured = False
    for frame in frames:
        coloured |= frame.image is not None
        origin = np.floor(frame.T_world_cam[:3, 3] / voxel) if origin is None else origin
        number, values = _voxels(frame, voxel, origin)
        near = (np.abs(number) < _HALF).all(axis=1)
        far += int((~near).sum())
        waiting.append((_keys(number[near]), values[near]))
        if sum(len(part) for part, _ in waiting) > _FOLD:
            keys, sums = _merged([(keys, sums), *waiting])
            waiting = []
    keys, sums = _merged([(keys, sums), *waiting])
    left_out = f"{far} pixels over {_HALF * voxel:.4g} m from the first camera left out (--voxel {voxel:g})" * bool(far)
    if not len(keys):
        reason = left_out or "no pixel has a depth within the limits of sigma: raise these, or run without --plain"
        raise ValueError(f"{out}: the cloud is empty: {reason}")
    weight, count = sums[:, :1], sums[:, 7:]
    position, colour, sigma = sums[:, 1:4] / weight, sums[:, 4:7] / weight, np.sqrt(count / weight)
    kinds, columns = dict.fromkeys(("x", "y", "z"), "<f8") | {"sigma": "<f4"}, [position, sigma]
    if coloured:
        kinds |= dict.fromkeys(("red", "green", "blue"), "|u1")
        columns.append(np.rint(colour))
    file = export_folder(out) / "cloud.ply"
    write_ply(file, vertex_table(kinds, *columns), "x y z sigma [m], world of the poses")
    return f"{file}: {len(keys)} points" + f"; {left_out}" * bool(far)


def export_transforms(frames: Iterator[RunFrame], out: Path) -> str:
    """transforms.json with unchanged images, and depth and sigma at their pixels (16 bits, 0 = left out). Frames whose
    image cannot be read are left out. More than a kilometre from the world's origin, positions are relative to an
    offset, which ``applied_transform`` subtracts, because nerfstudio computes in float32. Raises ValueError: no image
    can be read."""
    import cv2

    folder, unit, listed = export_folder(out, "transforms"), None, list[dict[str, Any]]()
    for name in ("images", "depth", "sigma"):
        export_folder(out, "transforms", name)
    world = np.eye(4)
    for frame in frames:
        if frame.image is None:
            continue
        if not listed:
            world[:3, 3] = -world_offset(frame.T_world_cam[:3, 3])
        seen = frame.at_image()
        unit = unit or fitting_unit(seen.depth)
        entry: dict[str, Any] = {"file_path": f"images/{frame.name}.png"}
        for kind, values in (("depth", seen.depth), ("sigma", seen.sigma)):
            write_bytes_atomic(folder / kind / f"{frame.name}.png", encode_length_png(values, unit, kind))
            entry[f"{kind}_file_path"] = f"{kind}/{frame.name}.png"
        png = cv2.imencode(".png", frame.image[..., ::-1])[1].tobytes()
        write_bytes_atomic(folder / entry["file_path"], png)
        fx, fy, cx, cy = pinhole_values(seen.intrinsics)
        height, width = seen.depth.shape
        camera = {"fl_x": fx, "fl_y": fy, "cx": cx + 0.5, "cy": cy + 0.5, "w": width, "h": height}
        listed.append(entry | camera | {"transform_matrix": CONVENTIONS["opengl"].convert(world @ frame.T_world_cam)})
    if not listed:
        raise ValueError(f"{out}: no image of the recording can be read")
    plain = {
        "camera_model": "OPENCV",
        "depth_unit_scale_factor": unit,
        "applied_transform": world[:3],
        "frames": listed,
    }
    write_json_atomic(folder / "transforms.json", plain)
    return f"{folder / 'transforms.json'}: {len(listed)} frames"


def _voxels(
    frame: RunFrame, voxel: float, origin: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """[P, 3] the number of each pixel's voxel on the axes, from the voxel ``origin`` on, and [P, 8] its weight w, w x,
    w y, w z, w r, w g, w b, and 1."""
    in_camera, (v, u) = frame.points()
    sigma, K, T = np.maximum(frame.sigma[v, u], _LEAST_SIGMA), frame.intrinsics, frame.T_world_cam
    points = in_camera @ T[:3, :3].T + T[:3, 3]
    colour = np.zeros((len(points), 3))
    if frame.image is not None and frame.image_intrinsics is not None:
        seen = resample_nearest(frame.image, frame.image_intrinsics, K, (frame.depth.shape[0], frame.depth.shape[1]))
        colour = seen[v, u].astype(np.float64)
    weight = 1 / np.square(sigma.astype(np.float64))[:, None]
    return np.floor(points / voxel) - origin, np.hstack(
        [weight, weight * points, weight * colour, np.ones_like(weight)]
    )


def _keys(number: NDArray[np.float64]) -> NDArray[np.int64]:
    """[P] one integer for the three numbers of a voxel, each within +- ``_HALF``."""
    x, y, z = (number.astype(np.int64) + _HALF).T
    return (x << 42) | (y << 21) | z


def _merged(
    parts: list[tuple[NDArray[np.int64], NDArray[np.float64]]],
) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    keys, index = np.unique(np.concatenate([part[0] for part in parts]), return_inverse=True)
    columns = np.concatenate([part[1] for part in parts]).T
    return keys, np.stack([np.bincount(index, column, len(keys)) for column in columns], axis=-1)


def export_folder(out: Path, *names: str) -> Path:
    """OUT/export and folders below it, created if missing. Raises ValueError: one of them, or a file in it, is a
    symbolic link, through which nothing is written."""
    for folder in (out.joinpath("export", *names[:length]) for length in range(len(names) + 1)):
        linked = [folder] if folder.is_symlink() else []
        folder.mkdir(exist_ok=True)
        remove_temporaries(folder.iterdir())
        if linked := linked or [path for path in folder.iterdir() if path.is_symlink()]:
            raise ValueError(f"{linked[0]} is a symbolic link, through which nothing is written: remove it")
    return folder

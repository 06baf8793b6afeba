"""A run's result as a rerun recording: ``rerun OUT/export/run.rrd`` (extra ``viz3d``).

In 3D: the camera with its image and depth (16 bits), its points coloured by sigma, and the Gaussians of the end as
ellipsoids coloured by sqrt(disagreement). Beside it the image, sigma, and plots of the frames' records.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import torch

from ufmstar_torch.array_files import read_npz_whole
from ufmstar_torch.eval.run.colours import ERROR_MAP, ColourScale, robust_range
from ufmstar_torch.eval.run.export import Gated, export_folder, image_of, points_in_camera
from ufmstar_torch.eval.run.gaussians import RADIUS, Components
from ufmstar_torch.eval.run.length_png import fitting_unit
from ufmstar_torch.eval.sequences.frame import FrameSequence
from ufmstar_torch.eval.sequences.own_output import RECORDS, read_records
from ufmstar_torch.mixture import GaussianMixture
from ufmstar_torch.optional import optional

_JPEG = 80  # quality
_POINTS = 4000  # of a frame, coloured by sigma
_PLOTS = ("mean_sigma", "mean_disagreement", "mean_network_sigma", "mean_anchored", "mean_bias", "components")
_WORLD, _CAMERA = "world", "world/camera"


def export_rerun(frames: Iterator[Gated], out: Path, sequence: FrameSequence | None) -> str:
    """OUT/export/run.rrd. Raises ModuleNotFoundError: rerun-sdk is not installed."""
    rr = optional("rerun", "a rerun recording needs rerun-sdk", "'ufmstar-torch[viz3d]'")
    file, count = export_folder(out) / "run.rrd", 0
    with rr.RecordingStream("ufmstar") as stream:
        stream.save(file, default_blueprint=_blueprint())
        stream.log(_WORLD, rr.ViewCoordinates.RDF, static=True)
        _log_gaussians(rr, stream, out / "mixture.npz")
        records = {record["name"]: record for record in read_records((out / RECORDS).read_bytes(), out / RECORDS)}
        scale: ColourScale | None = None
        unit = None
        for frame in frames:
            count += 1
            scale = scale or ColourScale(*robust_range([frame.sigma], from_zero=True), ERROR_MAP)
            unit = unit or fitting_unit(frame.depth)
            stream.set_time("frame", sequence=frame.index)
            if frame.timestamp is not None:
                stream.set_time("time", duration=frame.timestamp)
            _log_frame(rr, stream, frame, sequence, scale, unit)
            for name in _PLOTS:
                if isinstance(value := records[frame.name].get(name), int | float):
                    stream.log(f"plots/{name}", rr.Scalars(value))
    return f"{file}: {count} frames; sigma is coloured from 0 to {scale.high if scale else 0:.3g} m"


def _log_frame(
    rr: Any, stream: Any, frame: Gated, sequence: FrameSequence | None, scale: ColourScale, unit: float
) -> None:
    T, image = frame.T_world_cam, image_of(frame, sequence)
    stream.log(_CAMERA, rr.Transform3D(translation=T[:3, 3], mat3x3=T[:3, :3]))
    if image is not None and image.image is not None:
        size = [image.image.shape[1], image.image.shape[0]]
        stream.log(f"{_CAMERA}/image", rr.Pinhole(image_from_camera=image.intrinsics, resolution=size))
        stream.log(f"{_CAMERA}/image/rgb", rr.Image(image.image).compress(jpeg_quality=_JPEG))
    size = [frame.depth.shape[1], frame.depth.shape[0]]
    stream.log(f"{_CAMERA}/maps", rr.Pinhole(image_from_camera=frame.intrinsics, resolution=size))
    counts = np.nan_to_num(np.rint(frame.depth / unit), nan=0).clip(0, 65535).astype(np.uint16)
    stream.log(f"{_CAMERA}/maps/depth", rr.DepthImage(counts, meter=1 / unit))
    stream.log(f"{_CAMERA}/maps/sigma", rr.Image(scale.rgb(frame.sigma)).compress(jpeg_quality=_JPEG))
    points, (v, u) = points_in_camera(frame)
    some = slice(None, None, max(1, len(points) // _POINTS))
    colours = scale.rgb(frame.sigma[v, u][some])
    stream.log(f"{_CAMERA}/points", rr.Points3D(points[some], colors=colours, radii=rr.Radius.ui_points(2)))


def _log_gaussians(rr: Any, stream: Any, file: Path) -> None:
    if not file.is_file():
        return
    stored = {name: torch.from_numpy(values) for name, values in read_npz_whole(file).items()}
    T = stored.pop("T_world_first")[:1]
    parts = Components(GaussianMixture(**stored), T)
    half_sizes = RADIUS * parts.sigma
    shape = {"centers": parts.mean, "half_sizes": half_sizes, "quaternions": _quaternions(parts.axes)}
    solid = rr.components.FillMode.Solid
    stream.log(f"{_WORLD}/gaussians", rr.Ellipsoids3D(**shape, colors=parts.colour, fill_mode=solid), static=True)


def _quaternions(axes: np.ndarray) -> np.ndarray:
    from scipy.spatial.transform import Rotation

    return np.asarray(Rotation.from_matrix(axes).as_quat())


def _blueprint() -> Any:
    rrb = optional("rerun.blueprint", "a rerun recording needs rerun-sdk", "'ufmstar-torch[viz3d]'")
    views = rrb.Vertical(
        rrb.Spatial2DView(origin=f"{_CAMERA}/image", name="image"),
        rrb.Spatial2DView(origin=f"{_CAMERA}/maps", contents=f"{_CAMERA}/maps/sigma", name="sigma"),
        rrb.TimeSeriesView(origin="plots", name="means of a frame"),
    )
    return rrb.Blueprint(
        rrb.Horizontal(rrb.Spatial3DView(origin=_WORLD, name="world"), views, column_shares=[2, 1]),
        collapse_panels=True,
    )

"""Frames in a rerun stream: of a finished run (``export_rerun``) or of a live one (``ufmstar live --view``).

The 3D view has the camera with its depth (16 bits), its points coloured by sigma, and its anchors, each with a line to
the depth of its pixel. Other views have the image, sigma, and plots.
"""

from __future__ import annotations

import os
import socket
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from tempfile import TemporaryDirectory
from time import monotonic, sleep
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from ufmstar_torch.eval.run.colours import ERROR_MAP, ColourScale, robust_range
from ufmstar_torch.eval.run.export import RunFrame, export_folder
from ufmstar_torch.eval.run.gaussians import RADIUS, Components, offset_text, world_offset
from ufmstar_torch.eval.run.writers import fitting_unit
from ufmstar_torch.eval.sequences.ground_truth import nearest_pixels, points_of
from ufmstar_torch.files.read import read_npz_whole
from ufmstar_torch.gaussians.mixture import GaussianMixture
from ufmstar_torch.live import LiveResult
from ufmstar_torch.runtime.optional import optional

WORLD, CAMERA = "world", "world/camera"
# Figures of a finished run and of a live one, by plot.
_PLOTS = {
    "metres": ("mean_sigma", "mean_network_sigma", "mean_bias", "depth_m", "sigma_m"),
    "counts": ("components", "dropped", "skipped"),
    "milliseconds": ("latency_ms",),
}
_JPEG = 80  # quality
_POINTS = 4000  # approximate number of points of a frame
_LOCAL = "127.0.0.1"
_OPENING, _SETTLED = 20.0, 1.0  # [s] time for a viewer to listen; time after which a listening viewer has not failed


def rerun() -> Any:
    """The module. Raises ModuleNotFoundError: rerun-sdk is not installed."""
    return optional("rerun", "a rerun recording needs rerun-sdk", "'ufmstar-torch[viz3d]'")


class RerunLog:
    """Logs frames to a ``rerun.RecordingStream``. The first frame sets the scales of depth and sigma (``scale``), and
    the ``offset`` [3] that is subtracted from positions [m], which rerun stores in float32."""

    def __init__(self, stream: Any) -> None:
        self._rr, self._stream = rerun(), stream
        self.scale: ColourScale | None = None
        self.offset: NDArray[np.float64] = np.zeros(3)
        self._unit: float | None = None
        stream.log(WORLD, self._rr.ViewCoordinates.RDF, static=True)

    def add(self, frame: RunFrame) -> None:
        """Log a frame with its image, and plot its numbers."""
        rr, log, T = self._rr, self._stream.log, frame.T_world_cam
        if self.scale is None:
            self.scale = ColourScale(*robust_range([frame.sigma], from_zero=True), ERROR_MAP)
            self.offset = world_offset(T[:3, 3])
            if text := offset_text(self.offset):
                log("offset", rr.TextDocument(text), static=True)
        self._unit = self._unit or fitting_unit(frame.depth)
        self._stream.set_time("frame", sequence=frame.index)
        if frame.timestamp is not None:
            self._stream.set_time("time", duration=frame.timestamp)
        log(CAMERA, rr.Transform3D(translation=T[:3, 3] - self.offset, mat3x3=T[:3, :3]))
        if frame.image is not None:
            if frame.image_intrinsics is not None:
                size = [frame.image.shape[1], frame.image.shape[0]]
                log(f"{CAMERA}/image", rr.Pinhole(image_from_camera=frame.image_intrinsics, resolution=size))
            log(f"{CAMERA}/image/rgb", rr.Image(frame.image).compress(jpeg_quality=_JPEG))
        size = [frame.depth.shape[1], frame.depth.shape[0]]
        log(f"{CAMERA}/maps", rr.Pinhole(image_from_camera=frame.intrinsics, resolution=size))
        counts = np.nan_to_num(np.rint(frame.depth / self._unit), nan=0).clip(0, 65535).astype(np.uint16)
        log(f"{CAMERA}/maps/depth", rr.DepthImage(counts, meter=1 / self._unit))
        log(f"{CAMERA}/maps/sigma", rr.Image(self.scale.rgb(frame.sigma)).compress(jpeg_quality=_JPEG))
        points, (v, u) = frame.points()
        sample = slice(None, None, max(1, len(points) // _POINTS))
        colours = self.scale.rgb(frame.sigma[v, u][sample])
        log(f"{CAMERA}/points", rr.Points3D(points[sample], colors=colours, radii=rr.Radius.ui_points(2)))
        if frame.anchors is not None:
            self._add_anchors(frame, frame.anchors)
        for plot, names in _PLOTS.items():
            for name in names:
                if isinstance(value := frame.figures.get(name), int | float):
                    log(f"{plot}/{name}", rr.Scalars(value))

    def _add_anchors(self, frame: RunFrame, anchors: NDArray[np.float32]) -> None:
        """Log anchors [N, 4], and lines from them to the depth of their pixels, coloured by length on sigma's scale."""
        rr, K, scale = self._rr, frame.intrinsics, self.scale
        assert scale is not None
        u, v, measured = anchors[:, 0], anchors[:, 1], anchors[:, 2]
        ends = points_of(u, v, measured, K)
        self._stream.log(f"{CAMERA}/anchors", rr.Points3D(ends, radii=rr.Radius.ui_points(3)))
        depth = frame.depth.reshape(-1)[nearest_pixels(u, v, (frame.depth.shape[0], frame.depth.shape[1]))[0]]
        valid = np.isfinite(depth)
        lines = np.stack([ends, points_of(u, v, depth, K)], axis=1)[valid]
        colours = scale.rgb(np.abs(depth - measured)[valid])
        self._stream.log(f"{CAMERA}/residuals", rr.LineStrips3D(lines, colors=colours))


def viewer_frame(result: LiveResult, number: int, figures: dict[str, float]) -> RunFrame:
    """The result of an image of ``ufmstar live``, to be logged."""
    out, valid = result.out, result.out.valid[0]
    depth, sigma = (torch.where(valid, values[0], torch.nan).cpu().float().numpy() for values in (out.depth, out.std))
    about = (f"{result.stamp:.6f}", number, result.stamp, result.T_world_cam)
    K = out.intrinsics[0].cpu().double().numpy()
    return RunFrame(*about, K, depth, sigma, figures=figures, image=np.asarray(result.image))


def blueprint() -> Any:
    """The arrangement of the views."""
    rrb = optional("rerun.blueprint", "a rerun recording needs rerun-sdk", "'ufmstar-torch[viz3d]'")
    views = rrb.Vertical(
        rrb.Spatial2DView(origin=f"{CAMERA}/image", name="image"),
        rrb.Spatial2DView(origin=f"{CAMERA}/maps", contents=f"{CAMERA}/maps/sigma", name="sigma"),
        rrb.Tabs(*(rrb.TimeSeriesView(origin=plot, name=plot) for plot in _PLOTS)),
    )
    return rrb.Blueprint(
        rrb.Horizontal(rrb.Spatial3DView(origin=WORLD, name="world"), views, column_shares=[2, 1]),
        collapse_panels=True,
    )


def open_viewer() -> tuple[Any, subprocess.Popen[bytes]]:
    """A stream to a new viewer that listens on this computer alone (rerun's ``spawn`` listens on every network), and
    the viewer's process, which continues when this one ends. Raises ModuleNotFoundError: rerun-sdk is not installed;
    ConnectionError: the viewer does not start, as without a display."""
    rr = rerun()
    with socket.socket() as free:
        free.bind((_LOCAL, 0))
        port = free.getsockname()[1]
    words = [sys.executable, "-m", "rerun_cli", "--bind", _LOCAL, "--port", str(port), "--hide-welcome-screen"]
    environment = {**os.environ, "RERUN_APP_ONLY": "true"}  # as spawn sets it
    quiet: Any = dict.fromkeys(("stdin", "stdout", "stderr"), subprocess.DEVNULL)  # a pipe would wait for its end
    viewer = subprocess.Popen(words, env=environment, start_new_session=True, **quiet)
    ready, deadline = 0.0, monotonic() + _OPENING
    while monotonic() < ready + _SETTLED or not ready:  # without a display it listens before it fails
        if viewer.poll() is not None or monotonic() > deadline:
            viewer.terminate()
            raise ConnectionError("rerun's viewer does not start: is there a display?")
        ready = ready or (monotonic() if _listens(port) else 0.0)
        sleep(0.1)
    stream = rr.RecordingStream("ufmstar")
    stream.connect_grpc(f"rerun+http://{_LOCAL}:{port}/proxy", default_blueprint=blueprint())
    return stream, viewer


def _listens(port: int) -> bool:
    try:
        socket.create_connection((_LOCAL, port), timeout=1).close()
    except OSError:
        return False
    return True


def export_rerun(frames: Iterator[RunFrame], out: Path) -> str:
    """Write OUT/export/run.rrd. An earlier file is replaced when the new one is complete. Raises ModuleNotFoundError:
    rerun-sdk is not installed."""
    rr, count = rerun(), 0
    file = export_folder(out) / "run.rrd"
    with TemporaryDirectory(dir=file.parent, prefix=".rrd") as new:
        with rr.RecordingStream("ufmstar") as stream:
            stream.save(Path(new) / file.name, default_blueprint=blueprint())
            log = RerunLog(stream)
            for frame in frames:
                count += 1
                log.add(frame)
            _log_gaussians(rr, stream, out / "mixture.npz", log.offset)
            stream.flush()
        (Path(new) / file.name).replace(file)
    return f"{file}: {count} frames; sigma is coloured from 0 to {log.scale.high if log.scale else 0:.3g} m"


def _log_gaussians(rr: Any, stream: Any, file: Path, offset: NDArray[np.float64]) -> None:
    if not file.is_file():
        return
    stored = {name: torch.from_numpy(values) for name, values in read_npz_whole(file).items()}
    T = stored.pop("T_world_first")[:1]
    parts = Components(GaussianMixture(**stored), T)
    quaternions = Rotation.from_matrix(parts.axes).as_quat()
    shape = {"centers": parts.mean - offset, "half_sizes": RADIUS * parts.sigma, "quaternions": quaternions}
    solid = rr.components.FillMode.Solid
    stream.log(f"{WORLD}/gaussians", rr.Ellipsoids3D(**shape, colors=parts.colour, fill_mode=solid), static=True)

"""A run's result as a rerun recording, ``rerun OUT/export/run.rrd`` (extra ``viz3d``): its frames, plots of their
records, and the Gaussians of the end as ellipsoids coloured by sqrt(disagreement).
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
import torch

from ufmstar_torch.array_files import read_npz_whole
from ufmstar_torch.eval.run.export import Gated, export_folder, image_of
from ufmstar_torch.eval.run.gaussians import RADIUS, Components
from ufmstar_torch.eval.run.rerun_log import WORLD, RerunLog, blueprint, rerun
from ufmstar_torch.eval.sequences.frame import FrameSequence
from ufmstar_torch.eval.sequences.own_output import RECORDS, read_records
from ufmstar_torch.mixture import GaussianMixture

_PLOTS = ("mean_sigma", "mean_disagreement", "mean_network_sigma", "mean_anchored", "mean_bias", "components")


def export_rerun(frames: Iterator[Gated], out: Path, sequence: FrameSequence | None) -> str:
    """OUT/export/run.rrd; an earlier one is replaced when the new one is whole. Raises ModuleNotFoundError: rerun-sdk
    is not installed."""
    rr, count = rerun(), 0
    file = export_folder(out) / "run.rrd"
    records = {record["name"]: record for record in read_records((out / RECORDS).read_bytes(), out / RECORDS)}
    with TemporaryDirectory(dir=file.parent, prefix=".rrd") as new:
        with rr.RecordingStream("ufmstar") as stream:
            stream.save(Path(new) / file.name, default_blueprint=blueprint())
            log = RerunLog(stream)
            _log_gaussians(rr, stream, out / "mixture.npz")
            for frame in frames:
                count += 1
                image, record = image_of(frame, sequence), records[frame.name]
                pixels, K = (None, None) if image is None else (image.image, image.intrinsics)
                plots = {name: value for name in _PLOTS if isinstance(value := record.get(name), int | float)}
                log.add(frame, pixels, K, plots)
            stream.flush()
        (Path(new) / file.name).replace(file)
    return f"{file}: {count} frames; sigma is coloured from 0 to {log.scale.high if log.scale else 0:.3g} m"


def _log_gaussians(rr: Any, stream: Any, file: Path) -> None:
    if not file.is_file():
        return
    stored = {name: torch.from_numpy(values) for name, values in read_npz_whole(file).items()}
    T = stored.pop("T_world_first")[:1]
    parts = Components(GaussianMixture(**stored), T)
    half_sizes = RADIUS * parts.sigma
    shape = {"centers": parts.mean, "half_sizes": half_sizes, "quaternions": _quaternions(parts.axes)}
    solid = rr.components.FillMode.Solid
    stream.log(f"{WORLD}/gaussians", rr.Ellipsoids3D(**shape, colors=parts.colour, fill_mode=solid), static=True)


def _quaternions(axes: np.ndarray) -> np.ndarray:
    from scipy.spatial.transform import Rotation

    return np.asarray(Rotation.from_matrix(axes).as_quat())

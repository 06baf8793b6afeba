"""The mixture as files: splat attributes (binary PLY) for viewers, npz for programs.

Positions are in the frame of the mixture (the first camera: x right, y down, z forward), or in the world with
``T_world_first``. Lengths are in metres. PLY stores float32, as viewers expect, relative to an offset in its header if
the world's origin is far away, as UTM's (``world_offset``).
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.lib.recfunctions import unstructured_to_structured
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation
from torch import Tensor

from ufmstar_torch.eval.engine.files import write_atomic, write_bytes_atomic
from ufmstar_torch.eval.run.colours import ERROR_MAP, ColourScale, robust_range
from ufmstar_torch.gaussians.mixture import GaussianMixture

# Lower limit of the standard deviation of an axis [m], because files store its logarithm and viewers divide by it.
SIGMA_FLOOR = 1e-6
# The constant spherical harmonic: viewers show the colour 1/2 + SH_DC f_dc.
SH_DC = 0.5 / np.sqrt(np.pi)
OPACITY = 0.8
RADIUS = 2.0  # of the ellipsoids of a rerun recording
# Largest coordinate without an offset [m]; float32 has steps of .06 mm there. Offsets are multiples of it.
_NEAR = 1000.0
_TYPES = {"<f4": "float", "<f8": "double", "<i4": "int", "|u1": "uchar"}


def write_mixture_ply(path: str | Path, mixture: GaussianMixture, *, T_world_first: Tensor | None = None) -> int:
    """Write the occupied components of the first stream as Gaussian splats, atomically. Returns their number.

    The first attributes are those of 3D Gaussian splatting viewers: x y z [m], nx ny nz (the shortest axis), f_dc_0..2
    (colour), opacity (logit), scale_0..2 = ln sigma [ln m], rot_0..3 = unit quaternion w x y z, so that
    Sigma = R diag(exp(scale))^2 R^T. The last ones are weight [px], disagreement [m^2] and views (n). The
    colour is sqrt(disagreement) in magma from 0 to its 99th percentile, which the header states; components seen from
    one view are grey. ``T_world_first`` [4, 4] or [1, 4, 4] maps the mixture's frame to the world; None = keep the
    frame. More than a kilometre from the world's origin, the header has a comment "offset X Y Z m", to be added to
    positions.
    """
    parts = Components(mixture, T_world_first)
    quaternion = Rotation.from_matrix(parts.axes).as_quat(canonical=True, scalar_first=True)
    opacity = np.full(len(parts.mean), np.log(OPACITY / (1 - OPACITY)))
    offset = world_offset(parts.origin)
    columns = (
        parts.mean - offset,
        parts.axes[:, :, 0],
        (parts.colour / 255 - 0.5) / SH_DC,
        opacity,
        np.log(parts.sigma),
    )
    names = "x y z nx ny nz f_dc_0 f_dc_1 f_dc_2 opacity scale_0 scale_1 scale_2 rot_0 rot_1 rot_2 rot_3"
    kinds = dict.fromkeys((*names.split(), "weight", "disagreement", "views"), "<f4")
    table = vertex_table(kinds, *columns, quaternion, parts.weight, parts.disagreement, parts.views)
    write_ply(Path(path), table, parts.legend, offset_text(offset))
    return len(table)


def write_mixture_npz(path: str | Path, mixture: GaussianMixture, *, T_world_first: Tensor | None = None) -> None:
    """Write all streams without loss, atomically: the fields of ``GaussianMixture``, and ``T_world_first`` ([B, 4, 4]
    or [4, 4]) in float64. Slots after the last occupied one are omitted."""
    used = int(mixture.valid.any(0).nonzero().max()) + 1 if bool(mixture.valid.any()) else 0
    fields = {name: value[:, :used].detach().cpu().numpy() for name, value in mixture.tensors().items()}
    if T_world_first is not None:
        fields["T_world_first"] = T_world_first.detach().cpu().double().numpy()
    write_atomic(Path(path), lambda file: np.savez(file, allow_pickle=False, **fields))


class Components:
    """The occupied components of the first stream in float64, in the world or in the mixture's frame (without
    ``T_world_first``): mean [K, 3] [m]; origin [3], of the mixture's frame [m]; axes [K, 3, 3], rotations whose columns
    are the principal axes, shortest first; sigma [K, 3], standard deviations along them [m]; weight, disagreement,
    views [K]; colour [K, 3] uint8 and its legend."""

    def __init__(self, mixture: GaussianMixture, T_world_first: Tensor | None) -> None:
        used = mixture.valid[0]
        mean, covariance, self.weight, self.disagreement, self.views = (
            value[0][used].detach().cpu().to(torch.float64).numpy()
            for value in (mixture.mean, mixture.covariance, mixture.weight, mixture.disagreement, mixture.views)
        )
        variance, axes = np.linalg.eigh((covariance + covariance.transpose(0, 2, 1)) / 2)
        axes[np.linalg.det(axes) < 0, :, 2] *= -1
        T = np.eye(4) if T_world_first is None else T_world_first.detach().cpu().double().numpy().reshape(4, 4)
        R, t = T[:3, :3], T[:3, 3]
        self.mean: NDArray[np.float64] = mean @ R.T + t
        self.origin: NDArray[np.float64] = t
        self.axes: NDArray[np.float64] = R @ axes
        self.sigma: NDArray[np.float64] = np.sqrt(np.maximum(variance, SIGMA_FLOOR**2))
        root = np.sqrt(np.maximum(self.disagreement, 0))
        root[self.views <= 0] = np.nan
        scale = ColourScale(*robust_range([root], from_zero=True), ERROR_MAP)
        self.colour = scale.rgb(root)
        self.legend = f"colour: sqrt(disagreement), {ERROR_MAP} from 0 to {scale.high:.4g} m; grey: seen from one view"


def world_offset(position: NDArray[np.float64]) -> NDArray[np.float64]:
    """[3] whole kilometres near a ``position`` [3] [m], which are subtracted from all positions of a file and written
    into it; 0 within a kilometre of the origin."""
    if not (np.abs(position) > _NEAR).any():
        return np.zeros(3)
    return np.asarray(np.round(position / _NEAR) * _NEAR)


def offset_text(offset: NDArray[np.float64]) -> str:
    """The sentence that a file states; "" for 0."""
    if not offset.any():
        return ""
    return f"offset {' '.join(f'{x:.0f}' for x in offset)} m: add it to positions for the world of the poses"


def vertex_table(kinds: Mapping[str, str], *columns: NDArray[Any]) -> NDArray[Any]:
    """A structured array of columns [N] or [N, c] side by side, with the types by name."""
    return unstructured_to_structured(np.column_stack(columns), np.dtype(list(kinds.items())))


def write_ply(path: Path, vertices: NDArray[Any], *comments: str) -> None:
    """Write the structured array ``vertices`` as binary little-endian PLY; empty comments are left out."""
    lines = ["ply", "format binary_little_endian 1.0", *(f"comment {comment}" for comment in comments if comment)]
    lines.append(f"element vertex {len(vertices)}")
    lines += [f"property {_TYPES[vertices.dtype[name].str]} {name}" for name in vertices.dtype.names or ()]
    content = "\n".join([*lines, "end_header", ""]).encode("ascii")
    write_bytes_atomic(path, content + vertices.tobytes())

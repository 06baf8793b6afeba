"""Depth maps for the tests of SPGF, and the oracle run on them with our config's thresholds."""

from __future__ import annotations

import json
from dataclasses import dataclass, replace

import numpy as np
import oracle_spgf
import torch
from numpy.typing import NDArray
from shared_data import require_shared
from torch import Tensor
from walks import oracle_settings

from ufmstar_torch.config import SPGFConfig

REFERENCES = ("spgf_224_tum", "spgf_224_tartanair_indoor", "spgf_vga_tum")


def camera(fx: float, fy: float, cx: float, cy: float) -> Tensor:
    """[1, 3, 3] float64."""
    return torch.tensor([[[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]]], dtype=torch.float64)


@dataclass(frozen=True)
class Reference:
    """One file of the authors' partitions; per frame a dict with the keys of the file."""

    depth: Tensor  # [B, H, W] float64 holding float32 values
    intrinsics: Tensor  # [B, 3, 3]
    config: SPGFConfig
    frames: list[dict[str, NDArray]]


def reference(name: str) -> Reference:
    with np.load(require_shared(f"reference/{name}.npz")) as file:
        data = {key: file[key] for key in file.files}
    meta = json.loads(str(data["meta"]))
    keys = ("labels", "n_pixels", "n_segments", "ray_weight", "mean", "cov")
    frames = [{key: data[f"{key}_{i}"] for key in keys} for i in meta["frames"]]
    depth = np.stack([data[f"depth_mm_{i}"].astype(np.float32) / np.float32(1000) for i in meta["frames"]])
    K = camera(*(meta[key] for key in ("fx", "fy", "cx", "cy"))).expand(len(frames), 3, 3)
    return Reference(torch.from_numpy(depth).double(), K, upstream_config(meta["params"]), frames)


def upstream_config(p: dict[str, float]) -> SPGFConfig:
    """Config from upstream's names; upstream's thresholds apply at the image's resolution."""
    return SPGFConfig(
        adaptive_thresh_scale=p["adaptive_thresh_scale"],
        noise_floor=p["noise_floor"],
        noise_thresh=p["noise_thresh"],
        line_thresh=p["line_t"],
        occlusion_gap=int(p["occ_x_t"]),
        n_check=int(p["ncheck_t"]),
        max_open=int(p["max_incomplete_clusters"]),
        angle_cosine=p["angle_t"],
        sparse=int(p["sparse_t"]),
        min_rows=int(p["num_line_t"]),
        min_pixels=int(p["num_pixels_t"]),
        min_gaussian_length=p["min_gau_len"],
        frame_max_scale=p["frame_max_scale"],
        max_depth=p["max_depth"],
        scale_with_image=False,
    )


def run_oracle(depth: Tensor, K: Tensor, config: SPGFConfig) -> tuple[list[oracle_spgf.Piece], NDArray[np.int64]]:
    """The oracle on depth [H, W] with K [3, 3]."""
    c = config.scaled_to(*depth.shape)
    fx, fy, cx, cy = (float(K[i, j]) for i, j in ((0, 0), (1, 1), (0, 2), (1, 2)))
    f = min(fx, fy)
    limits = replace(oracle_settings(c).settings, a=c.slope(f) * f)
    return oracle_spgf.segment(depth.numpy(), oracle_spgf.Camera(fx, fy, cx, cy), limits)


def clutter(seed: int, height: int, width: int) -> tuple[Tensor, Tensor]:
    """Depth [1, H, W] and camera of a random scene: a slanted background, boxes and slanted plates in front
    of it, noise, dropouts (NaN, 0, infinity) and a far corner beyond max_depth. The noise keeps every decision away
    from rounding."""
    rng = np.random.default_rng(seed)
    v, u = np.meshgrid(np.linspace(-1, 1, height), np.linspace(-1, 1, width), indexing="ij")
    z = rng.uniform(1, 6) * (1 + rng.uniform(-0.4, 0.4) * u + rng.uniform(-0.4, 0.4) * v)
    for _ in range(rng.integers(0, 6)):
        top, left = rng.integers(0, height), rng.integers(0, width)
        box = (slice(top, top + rng.integers(1, height + 1)), slice(left, left + rng.integers(1, width + 1)))
        z[box] = rng.uniform(0.5, 6) * (1 + rng.uniform(-0.3, 0.3) * u[box] + rng.uniform(-0.3, 0.3) * v[box])
    z = z * (1 + rng.uniform(1e-4, 0.03) * rng.standard_normal(z.shape))
    holes = rng.random(z.shape) < rng.choice([0.0, 0.02, 0.3])
    z[holes] = rng.choice([np.nan, 0.0, np.inf, -1.0], holes.sum())
    if rng.random() < 0.3:
        z[: rng.integers(1, height + 1), : rng.integers(1, width + 1)] *= 8
    K = camera(*(rng.uniform(0.7, 1.6, 2) * width), *(rng.uniform(0.3, 0.7, 2) * (width, height)))
    return torch.from_numpy(z)[None], K

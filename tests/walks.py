"""Small rendered walks for several tests, and the oracle's result on one of them."""

from __future__ import annotations

import numpy as np
import oracle_spgf
import torch

import oracle
import scenes
from ufmstar_torch import SPGFConfig, UfMStar
from ufmstar_torch.anchors.anchors import Anchors

HEIGHT, WIDTH = 30, 40
SPGF = SPGFConfig(
    adaptive_thresh_scale=0.13, occlusion_gap=2, n_check=4, sparse=1, min_pixels=14, min_rows=5, scale_with_image=False
)  # fmt: skip


def oracle_settings(config: SPGFConfig) -> oracle.Segmentation:
    settings = oracle_spgf.Settings(
        a=config.adaptive_thresh_scale,
        noise_floor=config.noise_floor,
        noise_thresh=config.noise_thresh,
        line_t=config.line_thresh,
        occ_x=config.occlusion_gap,
        n_check=config.n_check,
        max_open=config.max_open,
        angle=config.angle_cosine,
        sparse=config.sparse,
        min_gaussian_length=config.min_gaussian_length,
        frame_max_scale=config.frame_max_scale,
        max_depth=config.depth_limit,
    )
    return oracle.Segmentation(settings, config.min_pixels, config.min_rows, config.prune)


def walks(streams, frames=8, size=(HEIGHT, WIDTH)):
    """Rendered sequences of ``streams`` cameras with anchors: the arguments of every frame, batched."""
    rng = np.random.default_rng(0)
    data = [scenes.sequence(frames, *size, 0.03 * (s + 1), seed=s) for s in range(streams)]
    K = torch.tensor(np.stack([scenes.intrinsics(*size, 60 + 5 * s) for s in range(streams)]))
    for i in range(frames):
        depth = torch.tensor(np.stack([d[i] for d, _, _ in data]))
        pose = torch.tensor(np.stack([p[i] for _, p, _ in data]))
        pixel = torch.tensor(rng.uniform(0, 1, (streams, 40, 2))) * torch.tensor([size[1] - 1.0, size[0] - 1.0])
        at = (pixel[..., 1].round() * size[1] + pixel[..., 0].round()).long()
        sparse = depth.flatten(1).gather(1, at) * torch.tensor(rng.normal(1.1, 0.02, (streams, 40)))
        yield depth, pose, K, Anchors(pixel, sparse, torch.full_like(sparse, 1e-3))


def walk(config, frames, streams=slice(None)):
    """Run a walk for a subset of the streams: the outputs and the module."""
    ufm, outputs = UfMStar(config), []
    for depth, pose, K, anchors in frames:
        parts = [anchors.pixel, anchors.depth, anchors.variance]
        options = {"anchors": Anchors(*(x[streams] for x in parts))} if config.anchors is not None else {}
        aleatoric = (depth / 100).nan_to_num()[streams]
        outputs.append(ufm(depth[streams], pose[streams], K[streams], aleatoric, **options))
    return outputs, ufm


def run(config, depths, poses, K, dtype=torch.float64):
    ufm = UfMStar(config, dtype=dtype)
    outputs = [
        ufm(torch.as_tensor(d).view(-1, *d.shape[-2:]), torch.as_tensor(T), torch.as_tensor(K))
        for d, T in zip(depths, poses, strict=True)
    ]
    return ufm, outputs

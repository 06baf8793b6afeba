"""Step 5 of one frame: the dense map from the mixture, its moving average, and what anchors add to it."""

from __future__ import annotations

from dataclasses import replace

import torch
from torch import Tensor

from ufmstar_torch.anchors.evidence import Evidence, means, observe
from ufmstar_torch.anchors.given import AnchorInput
from ufmstar_torch.backend import Backend
from ufmstar_torch.camera import focal_and_centre, unproject
from ufmstar_torch.config import UfMStarConfig
from ufmstar_torch.frame import FrameInput
from ufmstar_torch.mixture import GaussianMixture
from ufmstar_torch.regress import Regression


def learn(
    evidence: Evidence | None,
    mixture_cam: GaussianMixture,
    frame: FrameInput,
    anchors: AnchorInput | None,
    config: UfMStarConfig,
    backend: Backend,
) -> tuple[Evidence | None, Tensor]:
    """What anchors have taught, this frame's included, and how many of it were used [B]."""
    none = torch.zeros_like(frame.fault)
    if evidence is None:
        return None, none
    evidence = evidence.padded(mixture_cam.capacity)
    if anchors is None:
        return evidence, none
    points = _predicted_points(anchors, frame)

    def distribute(rows: Tensor) -> Tensor:
        return backend.distribute(mixture_cam, points, rows, config)

    gamma = 0.5 ** (1 / config.anchor_half_life)
    evidence, used = observe(evidence, anchors, distribute, gamma)  # a faulty frame's anchors are not valid
    return evidence, used.sum(1)


def anchored_term(depth: Tensor, excess: Tensor, disagreement: Tensor) -> Tensor:
    """B = max(0, d^2 e - M) [m^2], what anchors found beyond the disagreement M; NaN where that is.

    Args:
        depth: d, any shape [m].
        excess: e, likewise, the relative mean square error that the network does not state (``evidence``).
        disagreement: M, likewise [m^2].
    """
    return (depth.square() * excess - disagreement).clamp_min(0)


def _predicted_points(anchors: AnchorInput, frame: FrameInput) -> Tensor:
    """[B, N, 3] where the prediction has the anchors' pixels, in the camera frame [m]."""
    width, d = frame.size[1], anchors.predicted
    fx, fy, cx, cy = (value.double()[:, None] for value in focal_and_centre(frame.intrinsics))
    u, v = anchors.index % width, anchors.index.div(width, rounding_mode="floor")
    return torch.stack([(u - cx) / fx * d, (v - cy) / fy * d, d], dim=-1)


def _points(frame: FrameInput) -> Tensor:
    """[B, H W, 3] the predicted points in the camera frame [m]."""
    return unproject(frame.depth, frame.intrinsics).flatten(1, 2)


def read_out(
    mixture_cam: GaussianMixture,
    evidence: Evidence | None,
    frame: FrameInput,
    config: UfMStarConfig,
    backend: Backend,
    pixels: Tensor | None,
) -> tuple[Regression, Tensor | None]:
    """Step 5, and where there is evidence, the residual to expect, at every pixel or at some."""
    if evidence is None:
        return _regressed(mixture_cam, frame, config, backend, pixels), None
    beyond, stream = means(evidence, config.anchor_shrinkage)
    own = mixture_cam.features.shape[-1]
    together = mixture_cam.replace(features=torch.cat([mixture_cam.features, beyond], dim=-1))
    result = _regressed(together, frame, config, backend, pixels)
    residual = result.features[..., own:]
    residual = residual + stream.to(residual.dtype).view(-1, *[1] * (residual.dim() - 2), stream.shape[-1])
    return replace(result, features=result.features[..., :own]), residual


def _regressed(
    mixture_cam: GaussianMixture, frame: FrameInput, config: UfMStarConfig, backend: Backend, pixels: Tensor | None
) -> Regression:
    """Step 5 at every pixel, or at some; NaN where not valid, which is where the checked depth is 0."""
    if pixels is None:
        return backend.regress_image(mixture_cam, frame.depth, frame.intrinsics, config)
    points = _points(frame)
    chosen = torch.gather(points, 1, pixels[..., None].expand(*pixels.shape, 3))
    result = backend.regress(mixture_cam, chosen, config)
    valid = torch.gather(frame.valid.flatten(1), 1, pixels)
    features = torch.where(valid[..., None], result.features, torch.nan)
    return replace(result, disagreement=torch.where(valid, result.disagreement, torch.nan), features=features)


def average(
    memory: Tensor | None,
    dtype: torch.dtype,
    disagreement: Tensor,
    frame: FrameInput,
    config: UfMStarConfig,
    backend: Backend,
    pixels: Tensor | None,
) -> tuple[Tensor, Tensor]:
    """The moving average for output (NaN where not valid now) and for the state.

    It is kept in the state's dtype, so that a saved run goes on as it was, and restarts when the image size
    changes. On a subset the dense map serves as memory at those pixels.
    """
    if memory is None or memory.shape[1:] != frame.size:
        memory = torch.full(frame.depth.shape, torch.nan, dtype=dtype, device=frame.depth.device)
    if pixels is None:
        memory, shown = backend.smooth(memory, disagreement, config.ema_alpha)
        return shown, memory
    flat = memory.flatten(1)
    mixed, shown = backend.smooth(torch.gather(flat, 1, pixels), disagreement, config.ema_alpha)
    return shown, flat.scatter(1, pixels, mixed).view(memory.shape)

"""The grid of nodes on which the error of a depth map is estimated: cells of the image, and links between neighbours.

The image has at most 28 x 28 cells (the compiled field allows 31 in a row). A link is weaker, the more the predicted
depths of its two nodes differ: across a depth edge, the network may err by another factor.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn.functional import adaptive_avg_pool2d, pad

from ufmstar_torch.frame import FrameInput
from ufmstar_torch.posterior.config import PosteriorConfig

SIDE = 28


@dataclass(frozen=True)
class Grid:
    """R x C nodes of B depth maps.

    Attributes:
        size: (R, C).
        log_depth: [B, R C] mean of log d over the cell's valid pixels; the mean of all other cells if it has none.
        mean: [B] m_0, mean of ``log_depth``.
        right, down: [B, R C] variance of the difference of y to the next node in the row, in the column; infinite at
            the border.
        far_right, far_down: [B, R C] lengths of the same links: size of a cell plus difference of log d.
    """

    size: tuple[int, int]
    log_depth: Tensor
    mean: Tensor
    right: Tensor
    down: Tensor
    far_right: Tensor
    far_down: Tensor

    @classmethod
    def of(cls, frame: FrameInput, config: PosteriorConfig) -> Grid:
        """The nodes of a frame, float64."""
        rows, cols = (min(SIDE, n) for n in frame.size)
        valid = frame.valid.double()[:, None]
        logs = torch.where(frame.valid, frame.depth, torch.ones_like(frame.depth)).log().double()[:, None] * valid
        covered = adaptive_avg_pool2d(valid, (rows, cols)).flatten(1)
        cell_mean = adaptive_avg_pool2d(logs, (rows, cols)).flatten(1) / covered.clamp_min(1e-9)
        has_pixels = (covered > 0).double()
        map_mean = (cell_mean * has_pixels).sum(1, keepdim=True) / has_pixels.sum(1, keepdim=True).clamp_min(1)
        log_depth = torch.where(covered > 0, cell_mean, map_mean)
        by_cell = log_depth.view(-1, rows, cols)
        across = pad(by_cell[:, :, 1:] - by_cell[:, :, :-1], (0, 1), value=torch.inf).flatten(1)
        along = pad(by_cell[:, 1:] - by_cell[:, :-1], (0, 0, 0, 1), value=torch.inf).flatten(1)
        return cls(
            (rows, cols), log_depth, log_depth.mean(1),
            config.link_variance + config.edge_variance * across.square(),
            config.link_variance + config.edge_variance * along.square(),
            1 / cols + across.abs(), 1 / rows + along.abs(),
        )  # fmt: skip

    def node(self, pixel: Tensor, size: tuple[int, int]) -> Tensor:
        """[B, N] index of the cell in which a position [B, N, 2] of an image of ``size`` (H, W) lies."""
        rows, cols = self.size
        u, v = _relative(pixel, size)
        column = (u * cols).long().clamp(0, cols - 1)
        return (v * rows).long().clamp(0, rows - 1) * cols + column

    def features_at(self, pixel: Tensor, log_depth: Tensor, size: tuple[int, int]) -> Tensor:
        """[B, N, F] the features at positions [B, N, 2] of an image of ``size`` (H, W) with ``log_depth`` [B, N]."""
        return _features(log_depth - self.mean[:, None], *_relative(pixel, size))

    def features(self) -> Tensor:
        """[B, R C, F] the features at the nodes: 1, log d - m_0, u and v from -1 to 1."""
        rows, cols = self.size
        v, u = torch.meshgrid(_centres(rows, self.mean), _centres(cols, self.mean), indexing="ij")
        shape = self.log_depth.shape
        return _features(self.log_depth - self.mean[:, None], u.flatten().expand(shape), v.flatten().expand(shape))


def _centres(count: int, like: Tensor) -> Tensor:
    return (torch.arange(count, dtype=like.dtype, device=like.device) + 0.5) / count


def _relative(pixel: Tensor, size: tuple[int, int]) -> tuple[Tensor, Tensor]:
    """Positions as fractions of the image's width and height."""
    u, v = pixel.unbind(-1)
    return (u + 0.5) / size[1], (v + 0.5) / size[0]


def _features(log_depth: Tensor, u: Tensor, v: Tensor) -> Tensor:
    return torch.stack([torch.ones_like(log_depth), log_depth, 2 * u - 1, 2 * v - 1], -1)

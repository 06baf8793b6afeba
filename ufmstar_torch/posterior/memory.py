"""The state's tensors of evidence, confidence and posterior: their initial values, and checks."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import torch
from torch import Tensor

from ufmstar_torch.anchors import confidence
from ufmstar_torch.anchors.evidence import SUMS
from ufmstar_torch.config import UfMStarConfig
from ufmstar_torch.frames.frame import LARGEST, FrameInput
from ufmstar_torch.gaussians.state import UfMStarState
from ufmstar_torch.posterior import conformal, running

# Tensors that stay float64 when the module is converted.
ALWAYS_FLOAT64 = ("posterior", "intervals")


def initial(streams: int, config: UfMStarConfig, dtype: torch.dtype, device: torch.device | str) -> UfMStarState:
    """The empty state of ``streams`` independent streams.

    With ``config.anchors``: ``evidence`` [B, K, 3] and ``overall_evidence`` [B, 3], sums over anchors by component and
    of the stream. With ``config.confidence``: ``confidence`` [B, S]. With ``config.posterior``, in float64:
    ``posterior`` [B, S], the memory of a stream (``running``), and ``intervals`` [B, 4] (``conformal``).
    """
    state = UfMStarState.initial(streams, config, dtype, device)
    by_component, by_stream = dict[str, Tensor](), dict[str, Tensor]()
    if config.anchors is not None:
        by_component["evidence"] = torch.zeros(*state.weight.shape, SUMS, dtype=dtype, device=device)
        by_stream["overall_evidence"] = torch.zeros(streams, SUMS, dtype=dtype, device=device)
    if config.confidence is not None:
        size = confidence.size(config.confidence)
        by_stream["confidence"] = torch.zeros(streams, size, dtype=dtype, device=device)
    if config.posterior is not None:
        for name, size in (("posterior", running.SIZE), ("intervals", conformal.SIZE)):
            by_stream[name] = torch.zeros(streams, size, dtype=torch.float64, device=device)
    return replace(state, by_component=by_component, by_stream=by_stream)


def for_frame(state: UfMStarState, frame: FrameInput, config: UfMStarConfig) -> UfMStarState:
    """The state for a frame: the empty one of its streams before the first frame.

    Raises:
        ValueError: the frame has another number of streams, or lies on another device.
    """
    streams, device, mean = len(frame.depth), frame.depth.device, state.mean
    if len(mean) == 0:
        return initial(streams, config, mean.dtype, device)
    if len(mean) != streams:
        raise ValueError(f"depth has {streams} streams but the state holds {len(mean)}: call reset() first")
    if mean.device != device:
        raise ValueError(f"depth lies on {device} but the state on {mean.device}: move one with .to()")
    return state


def require(tensors: Mapping[str, Tensor], config: UfMStarConfig) -> None:
    """Raise a ValueError unless a run could have led to the tensors, whose shapes are right and whose values are
    finite."""
    for name in ("evidence", "overall_evidence") if config.anchors is not None else ():
        if bool((tensors[name][..., 0] < 0).any()) or bool((tensors[name].abs() > LARGEST).any()):
            raise ValueError(f"{name} holds negative weights or values beyond {LARGEST:g}")
    if config.confidence is not None:
        confidence.require(tensors["confidence"], config.confidence)
    if config.posterior is not None:
        running.require(tensors["posterior"])
        conformal.require(tensors["intervals"])

"""UfM* as a CUDA graph: one launch checks a frame, runs the step and adds the variances."""

from __future__ import annotations

import copy
from collections.abc import Callable

import torch
from torch import Tensor

from ufmstar_torch.frames.output import UncertaintyOutput
from ufmstar_torch.ufmstar import UfMStar

_WARM_UP = 3  # frames before the capture, which compile the kernels


class Captured:
    """A module's step for frames of one shape, recorded once and replayed.

    The state stays in the module, where it can be read, saved and reset as usual. Each call overwrites the output of
    the previous one.

    Args:
        ufm: with the frame's dtype and number of streams, or without a state.
        depth, pose, intrinsics, aleatoric, epistemic, valid: a frame as in :meth:`UfMStar.forward`. All frames must
            have its shapes; its values are ignored.
        record: converts a function to a recording. None = a CUDA graph.

    Raises:
        ValueError: a tensor is not on CUDA (without ``record``), or the config makes a step read from the device or
            change its shapes.
    """

    def __init__(
        self,
        ufm: UfMStar,
        depth: Tensor,
        pose: Tensor,
        intrinsics: Tensor,
        aleatoric: Tensor | None = None,
        epistemic: Tensor | None = None,
        valid: Tensor | None = None,
        *,
        record: Callable[[Callable[[], None]], Callable[[], None]] | None = None,
    ) -> None:
        _require_fixed(ufm, depth.device.type)
        if record is None and depth.device.type != "cuda":
            raise ValueError(f"depth must lie on a CUDA device to be captured, got {depth.device}")
        frame = (depth, pose, intrinsics, aleatoric, epistemic, valid)
        self._inputs = tuple(None if v is None else v.detach().to(depth.device, copy=True) for v in frame)
        self._ufm = ufm
        shape = (depth.shape[0], *depth.shape[-2:])
        with torch.no_grad():
            warm = copy.deepcopy(ufm)
            for _ in range(_WARM_UP):
                self._run(warm)
            state = {n: v.clone() for n, v in (ufm if ufm.mean.shape[0] else warm).state.tensors().items()}
            if state["smoothed"].shape != shape:
                state["smoothed"] = state["smoothed"].new_full(shape, torch.nan)
            self._state = state
            if not ufm.mean.shape[0]:
                self._restart()
            ufm._store(state)
            self._replay = (record or _as_graph)(self._frame)
            ufm._store(state)

    def __call__(self, *frame: Tensor | None) -> UncertaintyOutput:
        """Process the next frame; arguments as at the capture.

        Raises:
            ValueError: another number of arguments, or a shape or dtype other than at the capture.
        """
        absent = (None,) * (len(self._inputs) - len(frame))
        for name, buffer, new in zip(_NAMES, self._inputs, (*frame, *absent), strict=True):
            if (buffer is None) != (new is None) or (
                buffer is not None and new is not None and buffer.shape != new.shape
            ):
                raise ValueError(f"{name} must be as at the capture, {_shape(buffer)}, got {_shape(new)}")
        if self._ufm.mean is not self._state["mean"]:
            self._take_over()
        for buffer, new in zip(self._inputs, frame, strict=False):
            if buffer is not None and new is not None:
                buffer.copy_(new, non_blocking=True)
        self._replay()
        return self._out

    def _run(self, ufm: UfMStar) -> UncertaintyOutput:
        depth, pose, intrinsics, *optional = self._inputs
        assert depth is not None
        assert pose is not None
        assert intrinsics is not None
        return ufm(depth, pose, intrinsics, *optional)

    def _frame(self) -> None:
        """The recorded function: a step that updates the state in place."""
        self._out = self._run(self._ufm)
        for name, value in self._ufm._stored().tensors().items():
            self._state[name].copy_(value)
        self._ufm._store(self._state)

    def _take_over(self) -> None:
        """Copy the state of a module that was reset or loaded since the last call. Raises ValueError: another shape."""
        if not self._ufm.mean.shape[0]:
            self._restart()
        else:
            new = self._ufm.state.tensors()
            if any(new[n].shape != buffer.shape for n, buffer in self._state.items()):
                raise ValueError("the module's state has another shape than at the capture: capture again")
            for name, value in new.items():
                self._state[name].copy_(value)
        self._ufm._store(self._state)

    def _restart(self) -> None:
        """Set the state to that before the first frame."""
        for name, value in self._state.items():
            value.fill_(torch.nan if name == "smoothed" else 0)
        self._state["T_world_first"].copy_(torch.eye(4, dtype=torch.float64))


_NAMES = ("depth", "pose", "intrinsics", "aleatoric", "epistemic", "valid")


def _shape(value: Tensor | None) -> str:
    return "None" if value is None else str(tuple(value.shape))


def _require_fixed(ufm: UfMStar, device_type: str) -> None:
    """Raise a ValueError unless a step has constant shapes and reads nothing from the device."""
    config = ufm.config
    limit = config.max_components
    slots = ufm.mean.shape[1] if ufm.mean.shape[0] else config.initial_capacity
    wrong = {
        "on_bad_frame='skip', since 'raise' reads from the device": config.on_bad_frame != "skip",
        "max_components of at most initial_capacity, since a growing mixture changes its shape": (
            limit is None or slots < limit
        ),
        "no anchors, overlap weights or merging": (
            config.anchors is not None or config.overlap_weighted or config.merges_on(device_type)
        ),
        "no features": bool(config.entries),
    }
    if missing := [text for text, bad in wrong.items() if bad]:
        raise ValueError(f"a capture needs {'; '.join(missing)}")


def _as_graph(run: Callable[[], None]) -> Callable[[], None]:
    graph = torch.cuda.CUDAGraph()
    with torch.cuda.graph(graph):
        run()
    return graph.replay

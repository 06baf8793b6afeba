"""Memory as the paper splits it: the network that predicts depth, what uncertainty adds to it, and the multiview state.

A megabyte is 10^6 bytes, as in the paper: 100,000 points of 40 bytes are its 4.0 MB.
"""

from __future__ import annotations

import resource
import tracemalloc
from collections.abc import Callable, Iterable
from pathlib import Path

from torch import Tensor, nn

from ufmstar_torch import UfMStar
from ufmstar_torch.models.onnx_network import OnnxNetwork


def tensor_bytes(tensors: Iterable[Tensor]) -> int:
    """Bytes of tensors; what several of them share counts once."""
    return sum({(t.data_ptr(), t.nbytes): t.nbytes for t in tensors if t.numel()}.values())


def weight_bytes(*modules: nn.Module) -> int:
    """Bytes of the parameters and buffers of modules, and of files that ONNX Runtime runs; what several share counts
    once."""
    graphs = {m.path for module in modules for m in module.modules() if isinstance(m, OnnxNetwork)}
    tensors = (t for module in modules for t in (*module.parameters(), *module.buffers()))
    return tensor_bytes(tensors) + sum(Path(path).stat().st_size for path in graphs)


def state_memory(ufm: UfMStar) -> dict[str, int]:
    """Bytes of the components in use, of the slots allocated, and of the moving average's map; "packed" is what the
    components in use take as the paper counts them."""
    mixture = ufm.mixture
    each, components = mixture.bytes_per_component(), int(mixture.components.sum())
    return {
        "bytes_per_component": each,
        "packed_bytes_per_component": mixture.packed_bytes_per_component(),
        "packed": mixture.packed_bytes_per_component() * components,
        "components": components,
        "in_use": each * components,
        "allocated": each * mixture.streams * mixture.capacity,
        "moving_average": ufm.smoothed.nbytes,
    }


def overhead_percent(uncertainty: float, depth: float) -> float:
    """Share of uncertainty in the whole [%]: 100 u / (u + d), of bytes or of joules."""
    return 100 * uncertainty / (uncertainty + depth)


def step_allocations(step: Callable[[], object]) -> dict[str, int]:
    """What one call takes of fresh memory: "page_faults" of the process, and "python_peak" [bytes] of Python and NumPy.

    Tensors are not among the latter: torch does not report them; what they take anew shows in the page faults.
    """
    before = resource.getrusage(resource.RUSAGE_SELF).ru_minflt
    step()
    faults = resource.getrusage(resource.RUSAGE_SELF).ru_minflt - before
    tracemalloc.start()
    try:
        step()
        peak = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
    return {"page_faults": faults, "python_peak": peak}

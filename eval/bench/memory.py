"""Memory as the paper splits it: the network that predicts depth, what uncertainty adds to it, and the multiview state.

A megabyte is 10^6 bytes, as in the paper: 100,000 points of 40 bytes are its 4.0 MB.
"""

from __future__ import annotations

from pathlib import Path

from torch import nn

from ufmstar_torch.models.onnx_network import OnnxNetwork


def weight_bytes(*modules: nn.Module) -> int:
    """Bytes of the parameters and buffers of modules, and of files that ONNX Runtime runs; what several share counts
    once."""
    graphs = {m.path for module in modules for m in module.modules() if isinstance(m, OnnxNetwork)}
    tensors = (t for module in modules for t in (*module.parameters(), *module.buffers()) if t.numel())
    return sum({(t.data_ptr(), t.nbytes): t.nbytes for t in tensors}.values()) + sum(
        Path(path).stat().st_size for path in graphs
    )


def overhead_percent(uncertainty: float, depth: float) -> float:
    """Share of uncertainty in the whole [%]: 100 u / (u + d), of bytes or of joules."""
    return 100 * uncertainty / (uncertainty + depth)

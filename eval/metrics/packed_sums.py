"""The stored form of metrics' sums: large ones by their non-zero entries.

Spearman's 514 x 514 counts are mostly 0, and every row has a file on every sequence.
"""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

_DENSE_ENTRIES = 4096  # largest tensor that is stored unpacked


def pack(value: Tensor) -> Tensor | dict[str, Any]:
    """Tensors and plain values for ``torch.save``, equal to ``value`` after :func:`unpack`."""
    if value.numel() <= _DENSE_ENTRIES:
        # A view would be saved with its whole storage.
        return value.clone()
    flat = value.flatten()
    index = flat.nonzero()[:, 0]
    return {"shape": list(value.shape), "index": index.to(torch.int32), "values": flat[index]}


def unpack(stored: Tensor | dict[str, Any]) -> Tensor:
    """The packed tensor, bit for bit; tensors are returned unchanged."""
    if isinstance(stored, Tensor):
        return stored
    flat = stored["values"].new_zeros(stored["shape"]).flatten()
    return flat.index_put((stored["index"].long(),), stored["values"]).reshape(stored["shape"])

"""The compiled pass over the pixels against the metrics in torch."""

from __future__ import annotations

import math

import pytest
import torch
from metric_maps import maps
from torch import Tensor

from ufmstar_torch.eval.metrics import (
    SequenceMetrics,
)


def hostile(dtype: torch.dtype) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Maps with everything that is left out, or stands at the end of a range; and a mask."""
    d, v, g = maps(60, 80, scale=1.5)
    for value, at in ((d, 0), (v, 1), (g, 2)):
        for row, special in enumerate((math.nan, math.inf, -math.inf, 0.0, -1.0, 1e-9, 1e-8, 1e4, 1e30)):
            value[3 * row + at, ::7] = special
    g[40] = d[40]
    v[41], v[40, ::2] = (g[41] - d[41]).square(), 0
    return d.to(dtype), v.to(dtype), g.to(dtype), torch.rand(60, 80, generator=torch.Generator().manual_seed(0)) > 0.2


class TestOnePass:
    """The compiled pass adds up what the metrics add up one by one."""

    @pytest.mark.parametrize("masked", [False, True])
    @pytest.mark.parametrize(("dtype", "bins"), [(torch.float32, "ours"), (torch.float64, "authors")])
    def test_sums(self, dtype: torch.dtype, bins: str, masked: bool) -> None:
        *values, valid = hostile(dtype)
        given = (*values, valid if masked else None)
        fast, slow = SequenceMetrics(bins=bins), SequenceMetrics(bins=bins)
        for _ in range(2):
            fast.update(*given)
            for metric in slow.metrics.values():
                metric.update(*given)
        expected, before = slow.state_dict(), fast.sums()
        assert before.keys() == expected.keys()
        for name, value in before.items():
            # A sum without an end (1e30 squared) is infinite in both.
            torch.testing.assert_close(value, expected[name], rtol=1e-12, atol=0)
            assert value.is_floating_point() or torch.equal(value, expected[name])
        copies = {name: value.clone() for name, value in before.items()}
        fast.update(*given)
        assert all(torch.equal(value, copies[name]) for name, value in before.items()), "sums are changed in place"

    def test_depth_alone(self) -> None:
        d, _, g, valid = hostile(torch.float32)
        fast, slow = SequenceMetrics(with_variance=False), SequenceMetrics(with_variance=False)
        fast.update(d, None, g, valid)
        for metric in slow.metrics.values():
            metric.update(d, None, g, valid)
        assert fast.compute() == pytest.approx(slow.compute(), rel=1e-12)

"""``ufmstar bench --device``: what can be checked without a GPU."""

from __future__ import annotations

import pytest
import torch
from walks import SPGF, walks

from ufmstar_torch import UfMStar, UfMStarConfig
from ufmstar_torch.eval.bench.benchmark import run_benchmark
from ufmstar_torch.eval.bench.device import device_text, touched_bytes
from ufmstar_torch.eval.bench.settings import BenchSettings


@pytest.mark.skipif(torch.cuda.is_available(), reason="there is a CUDA device")
def test_without_a_device_it_says_so():
    with pytest.raises(ValueError, match="--device cuda needs a CUDA device, torch sees none"):
        run_benchmark(BenchSettings(device="cuda"))


def test_the_floor_counts_maps_once_and_the_state_twice():
    depth, pose, K, _ = next(walks(2))
    ufm = UfMStar(UfMStarConfig(segment=SPGF, initial_capacity=8, max_components=8))
    out = ufm(depth.float(), pose, K)
    maps = depth.numel() * 4 * 4  # depth, V, M and s in float32
    mixture = 2 * 8 * (4 * (3 + 9 + 1 + 1) + 8)
    rest = 2 * 16 * 8 + 2 * (1 + 8 + 8) + depth.numel() * 4 + 2 * 3 * 4  # pose, counters, moving average, evidence
    assert touched_bytes(depth.float(), out, ufm) == maps + 2 * (mixture + rest)


def test_text():
    row = {"size": 224, "streams": 64, "step_ms": 1.5, "graph_ms": 1.25, "frames_per_second": 51200.0}
    row |= {"launches": 60, "floor_ms": 0.02, "state_bytes": 65536.0}
    report = {"name": "GPU", "bandwidth": 3e12, "networks": {"224": {"FastDepth": 0.5}}, "results": [row]}
    lines = device_text(report)
    assert lines[0] == "GPU, copies move 3.00 TB/s"
    assert lines[1] == "224 x 224: FastDepth 0.50 ms"
    assert lines[3].split() == ["224", "64", "1.5", "1.25", "51200", "60", "0.02", "65536"]

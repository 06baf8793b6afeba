"""Metrics that every process of a group feeds with its own frames give each of them the figures of all."""

from __future__ import annotations

import json
import os
import socket
import subprocess
import sys
import textwrap

import pytest
import torch

from ufmstar_torch.eval.metrics import NLLByError, SequenceMetrics

PROGRAM = """
import json, os, sys
import torch
import torch.distributed as dist
torch.set_num_threads(1)
from ufmstar_torch.eval.metrics import NLLByError, SequenceMetrics
dist.init_process_group("gloo")
metrics, by_error = SequenceMetrics(sync_on_compute=True), NLLByError(sync_on_compute=True)
frames = torch.load(sys.argv[1], weights_only=True)
for frame in frames[dist.get_rank()::dist.get_world_size()]:
    metrics.update(*frame)
    by_error.update(*frame)
curves = {name: value.tolist() for name, value in by_error.compute().items()}
with open(f"{sys.argv[1]}.{dist.get_rank()}", "w") as file:
    json.dump([metrics.compute(), metrics.curves(), curves], file)
dist.destroy_process_group()
"""


def frames(count=5):
    generator = torch.Generator().manual_seed(0)
    drawn = []
    for _ in range(count):
        depth, variance, noise = (torch.rand(12, 16, generator=generator, dtype=torch.float64) for _ in range(3))
        drawn.append((1 + depth, 0.01 + variance, 1 + depth + 0.5 * (noise - 0.5)))
    return drawn


@pytest.mark.slow
def test_two_processes_reduce_to_what_one_computes(tmp_path):
    path, alone, by_error = tmp_path / "frames.pt", SequenceMetrics(), NLLByError()
    torch.save(frames(), path)
    for frame in frames():
        alone.update(*frame)
        by_error.update(*frame)
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    shared = {**os.environ, "MASTER_ADDR": "127.0.0.1", "MASTER_PORT": str(port), "WORLD_SIZE": "2"}
    program = [sys.executable, "-P", "-c", textwrap.dedent(PROGRAM), str(path)]
    running = [subprocess.Popen(program, env={**shared, "RANK": str(rank)}) for rank in range(2)]
    assert [process.wait(timeout=120) for process in running] == [0, 0]
    for rank in range(2):
        figures, curves, binned = json.loads((tmp_path / f"frames.pt.{rank}").read_text())
        expected = alone.compute()
        assert figures.keys() == expected.keys()
        for name, value in expected.items():
            torch.testing.assert_close(torch.tensor(figures[name]), torch.tensor(value), rtol=1e-12, atol=1e-12)
        for name, value in {**alone.curves(), **{k: v.tolist() for k, v in by_error.compute().items()}}.items():
            got = torch.tensor({**curves, **binned}[name], dtype=torch.float64)
            want = torch.tensor(value, dtype=torch.float64)
            torch.testing.assert_close(got, want, rtol=1e-12, atol=1e-12, equal_nan=True)

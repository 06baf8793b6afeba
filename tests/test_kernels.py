"""The selection of kernels, and properties of all kernels: threads, registers."""

from __future__ import annotations

import os
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from modules import frame as input_frame
from modules import same

from ufmstar_torch import SPGFConfig, UfMStar
from ufmstar_torch.frames import frame
from ufmstar_torch.kernels import select
from ufmstar_torch.kernels.cpu import check as check_cpu
from ufmstar_torch.kernels.cpu import segment as segment_cpu
from ufmstar_torch.kernels.cpu import step as step_cpu
from ufmstar_torch.steps.step import REFERENCE

pytestmark = pytest.mark.numerics

KERNELS = (
    "_regress", "_prepare", "_project", "_match", "_fuse", "_floor", "_bins", "_scanline", "_join", "_label",
    "_feature_means", "_cameras",
    "_append", "_camera", "_maps",
)  # fmt: skip


def test_seam():
    compiled = select.select_step("numba", "cpu")
    assert select.select_step("auto", "cpu") is compiled is step_cpu.step
    assert select.select_frame("auto", "cpu").check is check_cpu.check_values
    for device in ("cpu", "cuda"):
        assert select.select_kernels("torch", device) is select.select_step("torch", device).keywords["kernels"]
        assert select.select_kernels("torch", device) is REFERENCE
        assert select.select_frame("torch", device).check is frame.check_values
    mixed = select.select_kernels("auto", "mps")
    assert mixed.spgf is not REFERENCE.spgf, "on the host"
    assert replace(mixed, spgf=REFERENCE.spgf) == REFERENCE
    with pytest.raises(ValueError, match="needs CPU tensors"):
        select.select_step("numba", "cuda")


def test_seam_of_the_gpu_kernels(monkeypatch):
    pytest.importorskip("triton", reason="needs triton, which torch brings along on Linux")
    compiled = select.select_kernels("triton", "cuda")
    assert select.select_kernels("auto", "cuda") is select.select_kernels("auto", "xpu") is compiled is not REFERENCE
    monkeypatch.delenv("TRITON_INTERPRET", raising=False)
    with pytest.raises(ValueError, match="'triton' needs tensors of a GPU, got device type 'cpu'"):
        select.select_step("triton", "cpu")
    monkeypatch.setitem(sys.modules, "triton", None)
    select._has_triton.cache_clear()
    try:
        with pytest.warns(UserWarning, match="triton cannot be imported .* torch reference serves") as caught:
            chosen = [select.select_kernels("auto", "cuda") for _ in range(2)]
        assert len(caught) == 1
        assert all(kernels.fuse is REFERENCE.fuse for kernels in chosen)
        monkeypatch.undo()
        monkeypatch.setattr(torch.cuda, "is_initialized", lambda: True)
        monkeypatch.setattr(torch.cuda, "get_device_capability", lambda: (7, 5))
        select._has_triton.cache_clear()
        with pytest.warns(UserWarning, match=r"triton needs compute capability 8.0"):
            assert select.select_kernels("auto", "cuda").fuse is REFERENCE.fuse
    finally:
        select._has_triton.cache_clear()


def test_several_threads_at_once():
    """Streams in several Python threads give the same result as a single thread."""

    def run(_: int) -> list[torch.Tensor]:
        ufm = UfMStar()
        return [ufm(*input_frame(i)).variance for i in range(6)]

    alone = run(0)
    with ThreadPoolExecutor(3) as pool:
        for out in pool.map(run, range(3)):
            assert all(same(mine, theirs) for mine, theirs in zip(out, alone, strict=True))


def test_the_segmentation_on_the_host_is_that_of_the_cpu():
    depth, _, K = input_frame(0)
    limits = SPGFConfig().scaled_to(*depth.shape[1:])
    features = depth[:, None] / 2
    (mixture, labels), (expected, expected_labels) = (
        segment(depth, K.expand(len(depth), 3, 3).double(), limits, features)
        for segment in (select.select_kernels("auto", "mps").spgf, segment_cpu.segment)
    )
    assert mixture.components.min() > 0
    assert torch.equal(labels, expected_labels)
    assert all(torch.equal(value, expected.tensors()[name]) for name, value in mixture.tensors().items())


@pytest.mark.slow
def test_every_kernel_compiles_for_hopper():
    pytest.importorskip("triton", reason="needs triton, which torch brings along on Linux")
    folder = Path(__file__).parent
    environment = {**os.environ, "PYTHONPATH": str(folder)} | {"TRITON_INTERPRET": "0"}
    command = [sys.executable, str(folder / "triton_compile.py"), "-v"]
    done = subprocess.run(command, capture_output=True, text=True, env=environment)
    assert done.returncode == 0, done.stderr[-3000:]
    for name in KERNELS:
        lines = [line for line in done.stdout.splitlines() if line.startswith(f"compiled {name} ")]
        assert lines, f"{name} was not compiled"
        assert all("STACK:0 " in line for line in lines), f"{name} spills registers: {lines}"

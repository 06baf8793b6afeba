"""Every Triton kernel compiles to machine code of an H100, which needs no GPU."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

KERNELS = (
    "_regress", "_prepare", "_project", "_match", "_fuse", "_floor", "_bins", "_scanline", "_join", "_label",
    "_feature_means", "_smooth", "_evidence", "_sums", "_cameras",
    "_append", "_camera", "_maps",
)  # fmt: skip


@pytest.mark.slow
def test_every_kernel_compiles_for_hopper():
    pytest.importorskip("triton", reason="needs triton, which torch brings along on Linux")
    here = Path(__file__).parent
    environment = {**os.environ, "PYTHONPATH": str(here)} | {"TRITON_INTERPRET": "0"}
    command = [sys.executable, str(here / "triton_compile.py"), "-v"]
    done = subprocess.run(command, capture_output=True, text=True, env=environment, timeout=280)
    assert done.returncode == 0, done.stderr[-3000:]
    for name in KERNELS:
        lines = [line for line in done.stdout.splitlines() if line.startswith(f"compiled {name} ")]
        assert lines, f"{name} was not compiled"
        assert all("STACK:0 " in line for line in lines), f"{name} spills registers: {lines}"

"""Compiles every Triton kernel for an H100, without a GPU. tests/test_kernels.py runs this program.

The Python functions run on CPU tensors, with launches replaced by compilation for the launch's arguments. No kernel
runs, so the results are undefined."""

from __future__ import annotations

import re
import subprocess
import sys
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import torch
import triton
from random_gaussians import mixture
from triton.backends.compiler import GPUTarget
from triton.compiler import ASTSource
from triton.runtime.jit import KernelInterface

import scenes
from ufmstar_torch import UfMStarConfig
from ufmstar_torch.frames.frame import check_frame
from ufmstar_torch.gaussians.state import UfMStarState
from ufmstar_torch.kernels.select import select_kernels
from ufmstar_torch.steps.correspond import Correspondence

TARGET = GPUTarget("cuda", 90, 32)
TYPES = {
    torch.float32: "*fp32", torch.float64: "*fp64", torch.int32: "*i32", torch.int64: "*i64", torch.bool: "*i1",
    torch.uint8: "*u8", torch.int16: "*i16",
}  # fmt: skip
OPTIONS = ("num_warps", "enable_fp_fusion")


def compiled(kernel: Any, arguments: tuple[Any, ...], constants: dict[str, Any]) -> Any:
    """Compile a kernel for a launch with these arguments."""
    options = {name: constants.pop(name) for name in OPTIONS if name in constants}
    names = [p.name for p in kernel.params]
    by_name = dict(zip(names, arguments, strict=False))
    signature = {n: TYPES[v.dtype] if isinstance(v, torch.Tensor) else "i32" for n, v in by_name.items()}
    assert all(isinstance(v, torch.Tensor | int) for v in by_name.values()), "a float would arrive as float32"
    constants |= {n: 1 for n, v in by_name.items() if isinstance(v, int) and v == 1}  # as a launch does
    signature |= dict.fromkeys(constants, "constexpr")
    source = ASTSource(fn=kernel, signature={n: signature[n] for n in names}, constexprs=constants)
    return triton.compile(source, target=TARGET, options=options)


def usage(cubin: bytes) -> str:
    """Registers and stack of a kernel [bytes]; a stack means that registers were spilled."""
    tool = Path(triton.__file__).parent / "backends" / "nvidia" / "bin" / "cuobjdump"
    with tempfile.NamedTemporaryFile(suffix=".cubin") as file:
        file.write(cubin)
        file.flush()
        command = [str(tool), "-res-usage", file.name]
        output = subprocess.run(command, capture_output=True, text=True, check=True).stdout
    return " ".join(re.findall(r"(?:REG|STACK|SHARED):\d+", output))


SIZE = (37, 52)
K = torch.tensor(scenes.intrinsics(*SIZE)).expand(2, 3, 3)


def cases() -> dict[str, Callable[[], object]]:
    """Calls that launch every kernel once, on small inputs."""
    from ufmstar_torch.kernels.triton import check, correspond, fuse, regress, segment
    from ufmstar_torch.kernels.triton import step as step_device

    m = mixture(2, 40, 3, features=1)
    current = mixture(2, 20, 4, features=1)
    depth = torch.full((2, *SIZE), 2.0)
    config, view = UfMStarConfig(), torch.zeros(2, 4, dtype=torch.float64)
    still = torch.eye(3, dtype=torch.float64).repeat(2, 1, 1), torch.zeros(2, 3, dtype=torch.float64)
    pairs = Correspondence(torch.zeros(2, 20, 40, dtype=torch.bool), torch.zeros(2, 20, 40, dtype=torch.float64))

    def bits() -> None:
        previous, new = correspond.candidates(m.to(torch.float32), still, current, K.contiguous(), SIZE, config)
        words, _ = correspond.match_bits(previous, new, config, torch.zeros(2, dtype=torch.int64))
        matches = words, new.index, previous.position, new.count
        fuse.fuse_bits(m.to(torch.float32), current, still, matches, view, config)

    def device(streams: int = 2, **settings: Any) -> None:
        depth = torch.full((streams, *(SIZE if streams > 1 else (1, 1))), 2.0)
        kernels = select_kernels("triton", "cuda")
        chosen = UfMStarConfig(variances_in_h=True, merge=None, **settings)
        frame = check_frame(
            depth, torch.eye(4), K[:streams], depth, None, None, variances_in_h=True, rotation_tolerance=0.01
        )
        state = UfMStarState.initial(streams, chosen, torch.float32, "cpu")
        step_device.DeviceStep(kernels)(state, frame, chosen)

    values = depth, torch.eye(4).double().expand(2, 4, 4), K, depth, depth, depth > 0
    limits = config.segment.scaled_to(*SIZE)
    return {
        "regress": lambda: regress.regress_image(m, depth, K, depth > 0, config),
        "regress_subset": lambda: regress.regress_image(
            m, depth, K, depth > 0, config, torch.zeros(2, 300, dtype=torch.int64)
        ),
        "correspond": lambda: correspond.correspond(m, current, K, SIZE, config),
        "bits": bits,
        "fuse": lambda: fuse.fuse(m, current, pairs, view, config.replace(overlap_weighted=True)),
        "check": lambda: check.check_values(*values, rotation_tolerance=0.01, max_depth=20.0),
        "floor": lambda: fuse.floor_covariance(m.covariance, m.weight),
        "segment": lambda: segment.segment(depth, K, limits, depth[:, None]),
        "device": device,
        "device_one": lambda: device(1),
        "device_relative": lambda: device(unmeasured="relative"),
        "fit": lambda: segment.fit(depth, K, limits, floor=segment.Floor(0.05, 1e-6)),
    }


def main() -> None:
    seen = {}

    def compile_instead(kernel: Any, grid: tuple[int, ...]) -> Any:
        def launch(*arguments: Any, **constants: Any) -> None:
            dtypes = tuple(a.dtype if isinstance(a, torch.Tensor) else int for a in arguments)
            key = (kernel.__name__, dtypes, tuple(sorted(constants.items())))
            if key not in seen:
                seen[key] = compiled(kernel, arguments, constants)
                note = usage(seen[key].asm["cubin"]) if "-v" in sys.argv else ""
                print("compiled", kernel.__name__, note, flush=True)

        return launch

    KernelInterface.__getitem__ = compile_instead
    chosen = [a for a in sys.argv[1:] if a != "-v"]
    for name, case in cases().items():
        if not chosen or name in chosen:
            case()


if __name__ == "__main__":
    main()

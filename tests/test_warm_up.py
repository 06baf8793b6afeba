"""Compilation before the first frame, cached on disk, with numba's private API."""

from __future__ import annotations

import errno
import gc
import importlib
import itertools
import json
import os
import pkgutil
import runpy
import subprocess
import sys
from typing import ClassVar

import numpy as np
import pytest
import torch
from modules import same
from numba.core import caching, codegen
from numba.core.dispatcher import Dispatcher

import ufmstar_torch
from ufmstar_torch import DepthPrediction, UfMStar, UncertainDepth
from ufmstar_torch.anchors.tracker import LandmarkTracker
from ufmstar_torch.kernels import compile_cpu
from ufmstar_torch.kernels.compile_cpu import empty, kernel, leaf, part
from ufmstar_torch.kernels.cpu.vectors import vectors
from ufmstar_torch.runtime import warm_up as module
from ufmstar_torch.runtime.warm_up import warm_up

COLD = """
import json, torch
from numba.core import event
from ufmstar_torch import UfMStar
from ufmstar_torch.runtime.warm_up import warm_up
steps = []
with event.install_recorder("numba:compile") as compiled:
    warm_up(UfMStar(), (64, 64), 1, lambda done, total: steps.append((done, total)))
names = {one.data["dispatcher"].py_func.__name__ for _, one in compiled.buffer}
ufm, pose = UfMStar(), torch.eye(4)
depth = 2 + torch.rand(1, 48, 64, generator=torch.Generator().manual_seed(0)).cumsum(2) / 10
with event.install_recorder("numba:compile") as late:
    for _ in range(2):
        out = ufm(depth, pose, torch.tensor([[60.0, 0, 32], [0, 60, 24], [0, 0, 1]]))
print(json.dumps({"names": sorted(names), "late": len(late.buffer), "steps": steps, "sum": out.variance.sum().item()}))
"""

LATE = """
import json, os
from numba.core.dispatcher import Dispatcher
from ufmstar_torch.anchors.sources import landmark_source
from ufmstar_torch.eval.sequences import open_sequence
from ufmstar_torch.runtime.warm_up import along_wall
used, compiled = [], Dispatcher.compile
Dispatcher.compile = lambda self, types: used.append(self.py_func.__name__) or compiled(self, types)
frames = list(open_sequence("tour:3?frames=12&size=96x128"))
for kind in ("corners", "dense"):
    if os.fork() == 0:
        source = landmark_source(kind)
        used.clear()
        along_wall(landmark_source(kind))
        wall = len(used)
        found = [len(source.update(f.image, f.T_world_cam, f.intrinsics).pixel) for f in frames]
        print(json.dumps([kind, sum(found) > 100, wall > 0, used[wall:]]), flush=True)
        os._exit(0)
    os.wait()
"""


@part
def shifted(n, more):
    """Numbers from ``more`` on."""
    out = empty((2, n), np.float32)
    for i in range(n):
        out[0, i] = out[1, i] = i + more
    return out


@leaf
def summed(values):
    """The sum of a row."""
    total = 0.0
    for i in range(values.size):
        total += values[i]
    return total


def compiled_function():
    """A new, uncached kernel that calls a function, which calls another."""
    names: dict = {"shifted": shifted, "summed": summed}
    exec("def both(n):\n    rows = shifted(n, 1)\n    return summed(rows[0]), rows", names)
    return kernel(names["both"])


def test_a_kernel_without_a_folder_to_be_kept_in_is_compiled_in_memory():
    both = compiled_function()
    assert both.stats.cache_path is None
    total, rows = both(4)
    assert total == 10.0
    assert rows.dtype == np.float32
    assert rows.tolist() == [[1.0, 2.0, 3.0, 4.0]] * 2


def test_a_part_becomes_machine_code_in_its_kernel_alone(monkeypatch):
    optimised = []
    once = compile_cpu._Library._optimize_final_module
    monkeypatch.setattr(
        compile_cpu._Library, "_optimize_final_module", lambda self: (optimised.append(self.name), once(self))
    )
    assert compiled_function()(3)[0] == 6.0
    assert optimised == ["both"]


@pytest.mark.parametrize(
    ("owner", "names"),
    [
        (codegen.JITCodeLibrary, "_optimize_functions _optimize_final_module _finalize_final_module"),
        (codegen.JITCodeLibrary, "get_pointer_to_function codegen"),
        (codegen.JITCPUCodegen, "set_env"),
        (caching.IndexDataCacheFile, "_load_index _save_index _load_data _save_data"),
    ],
)
def test_numba_has_the_methods_that_are_replaced(owner, names):
    """A method that numba has renamed would be replaced no longer, without an error."""
    missing = [name for name in names.split() if not hasattr(owner, name)]
    assert not missing, f"numba changed: {owner.__name__} has no {missing}; mend ufmstar_torch/kernels/compile_cpu.py"


def test_no_garbage_is_collected_while_kernels_are_compiled():
    during: list[bool] = []
    for enabled in (True, False):
        (gc.enable if enabled else gc.disable)()
        warm_up(UfMStar(), (16, 16), 1, lambda *_: during.append(gc.isenabled()))
        assert gc.isenabled() == enabled
        gc.enable()
    assert len(during) > 20
    assert not any(during)


def test_a_source_of_landmarks_needs_no_kernel_after_the_wall():
    """On images of a room, with rotation, another focal length and depth edges; in processes without kernels."""
    done = subprocess.run([sys.executable, "-c", LATE], capture_output=True, text=True, check=True)
    assert [json.loads(line) for line in done.stdout.splitlines()] == [
        ["corners", True, True, []], ["dense", True, True, []]
    ]  # fmt: skip


@pytest.mark.parametrize(
    ("code", "step"), [(None, 1000), ("raise SystemExit(7)", 1000), ("import time; time.sleep(1000)", 0.5)]
)
def test_a_second_process_calls_the_kernels_of_the_search_and_may_fail(monkeypatch, code, step):
    """If the second process exits or hangs, the first one compiles the missing kernels."""
    started: list[subprocess.Popen] = []
    monkeypatch.setattr(
        subprocess, "Popen", lambda *a, _new=subprocess.Popen, **k: started.append(_new(*a, **k)) or started[-1]
    )
    monkeypatch.setattr(module, "_SECOND", code or module._SECOND)
    monkeypatch.setattr(os, "sched_getaffinity", lambda _: {0, 1}, raising=False)
    warm_up(UfMStar(), (16, 16), 1, sources=[LandmarkTracker])
    assert not started, "kernels are in memory"
    monkeypatch.setattr(module, "on_disk", lambda _: False)
    monkeypatch.setattr(module.time, "monotonic", itertools.count(0, step).__next__)
    warm_up(UfMStar(), (16, 16), 1, sources=[LandmarkTracker])
    assert [process.returncode == 0 for process in started] == [code is None]


def test_warm_up_leaves_networks_images_and_state_as_they_are():
    class Noisy(torch.nn.Module):
        sizes: ClassVar = []

        def forward(self, image):
            self.sizes.append(tuple(image.shape))
            return DepthPrediction(2 + torch.rand_like(image[:, 0]))

    model = UncertainDepth([Noisy(), Noisy()], posterior=True)
    before, random = {k: v.clone() for k, v in model.stream_state().items()}, torch.get_rng_state()
    done = []
    model.warm_up((32, 48), streams=2, progress=lambda *counts: done.append(counts))
    assert Noisy.sizes == [(2, 3, 32, 48)] * 4  # every member twice
    assert done[-1] == (22, 22)  # two frames, a mean and the search
    assert torch.equal(torch.get_rng_state(), random)
    assert all(same(v, before[k]) for k, v in model.stream_state().items())
    UncertainDepth(None).warm_up((32, 48))
    with pytest.raises(TypeError, match=r"size must be \(H, W\), positive whole numbers, got int"):
        model.warm_up(224)


@pytest.mark.parametrize("dtype", [torch.bfloat16, torch.float64])
def test_warm_up_of_a_network_of_another_dtype(dtype):
    """Without preprocessing, a network's images have the dtype that it needs."""

    class Network(torch.nn.Module):
        def __init__(self):
            super().__init__()
            self.layer = torch.nn.Conv2d(3, 1, 1).to(dtype)

        def forward(self, image):
            return DepthPrediction(2 + self.layer(image)[:, 0].sigmoid().float())

    UncertainDepth(Network(), preprocess=None).warm_up((32, 48))


@pytest.mark.slow
def test_a_cold_start_compiles_all_and_a_warm_one_nothing(tmp_path):
    def run() -> dict:
        environment = {**os.environ, "NUMBA_CACHE_DIR": str(tmp_path), "OMP_NUM_THREADS": "1"}
        done = subprocess.run([sys.executable, "-c", COLD], env=environment, capture_output=True, text=True, check=True)
        return json.loads(done.stdout)

    cold, warm = run(), run()
    assert {"fit", "exact"} <= set(cold["names"])
    assert not warm["names"]
    assert cold["sum"] == warm["sum"]
    for result in (cold, warm):
        assert not result["late"]
        assert result["steps"] == [[done, 21] for done in range(22)]


@pytest.mark.slow
def test_a_cold_start_of_a_search_compiles_it_elsewhere(tmp_path):
    code = COLD.replace("lambda done, total: steps.append((done, total))", "None, [LandmarkTracker]")
    code = code.replace("import warm_up", "import LandmarkTracker, os, warm_up")
    code = code.replace("steps = []", "steps = []\nos.sched_getaffinity = lambda _: {0, 1}")
    environment = {**os.environ, "NUMBA_CACHE_DIR": str(tmp_path), "OMP_NUM_THREADS": "1"}
    done = subprocess.run([sys.executable, "-c", code], env=environment, capture_output=True, text=True, check=True)
    assert not {"refine", "compare", "accept"} & set(json.loads(done.stdout)["names"])
    assert list(tmp_path.rglob("bundle.refine*.nbc"))


KERNEL = """
from ufmstar_torch.kernels.compile_cpu import kernel, leaf, reordered_leaf

ONE = 1


@leaf
def more(x):
    return x + ONE


@kernel
def plus_one(x):
    return more(x)
"""


@pytest.fixture
def hits(tmp_path):
    """Define a kernel again, from other text or other code, and call it; return the number of cache hits."""
    path = tmp_path / "one_kernel.py"

    def call(old: str = "", new: str = "", result: int = 2) -> int:
        path.write_text(KERNEL.replace(old, new, 1))
        names = runpy.run_path(str(path))
        assert names["plus_one"](1) == result
        return sum(names["plus_one"].stats.cache_hits.values())

    return call


@pytest.mark.parametrize(
    ("old", "new", "result"),
    [
        ("ONE = 1", "ONE = 3", 4),  # a constant
        ("x + ONE", "x + ONE + ONE", 3),  # code of a part
        ("@leaf", "@reordered_leaf", 2),  # how a part is compiled
    ],
)
def test_a_kernel_on_disk_is_outdated_when_what_is_compiled_into_it_changes(hits, old, new, result):
    assert [hits(), hits()] == [0, 1]
    assert [hits(old, new, result), hits(old, new, result)] == [0, 1]


@pytest.mark.parametrize(
    ("old", "new"),
    [
        ("ONE = 1", "# A comment, which moves each line\nONE = 1"),
        ("return x", '"""More."""\n    return x'),
        ("@leaf", "@leaf\ndef other(x):\n    return -x\n\n@leaf"),
    ],
)
def test_a_kernel_on_disk_stays_valid_when_only_text_around_it_changes(hits, old, new):
    assert [hits(), hits()] == [0, 1]
    assert hits(old, new) == 1


def test_every_kernel_has_a_stamp_of_its_own():
    """No kernel uses a global variable that a stamp does not cover."""
    modules = [importlib.import_module(m.name) for m in pkgutil.walk_packages(ufmstar_torch.__path__, "ufmstar_torch.")
               if m.name.split(".")[1] in ("kernels", "anchors", "posterior") and "triton" not in m.name]  # fmt: skip
    kernels = {one.py_func for m in modules for one in vars(m).values() if isinstance(one, Dispatcher)}
    assert len(kernels) > 30
    assert len({compile_cpu.code_stamp(one) for one in kernels}) == len(kernels)


def test_a_stamp_covers_vector_instructions():
    """Which a writer, and a function that it calls, make."""

    def kernel_of(factor, extra):
        def more(value):
            return value * extra

        @vectors
        def write(code, values):
            values.store(more(values.load(0) * factor), 0)

        def kernel(values):
            write(values)

        return kernel

    stamps = [
        compile_cpu.code_stamp(kernel_of(*factors)) for factors in ((2.0, 3.0), (2.0, 3.0), (5.0, 3.0), (2.0, 5.0))
    ]
    assert stamps[0] == stamps[1]
    assert len(set(stamps)) == 3


@pytest.mark.parametrize("ending", ["nbi", "nbc"])
@pytest.mark.parametrize("length", [0, 10, 50, None])
def test_a_damaged_file_is_replaced_and_said_once(hits, tmp_path, caplog, ending, length):
    assert [hits(), hits()] == [0, 1]
    (file,) = tmp_path.rglob(f"*.{ending}")
    content = bytearray(file.read_bytes())
    content[-20] ^= 1
    file.write_bytes(content[:length])
    assert [hits(), hits()] == [0, 1]
    assert [record.name for record in caplog.records] == ["ufmstar_torch"]
    assert f"{file.parent} is damaged and is replaced" in caplog.text


def test_a_full_disk_leaves_kernels_in_memory_and_is_said_once(hits, monkeypatch, caplog):
    def full(self, path):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(compile_cpu._CacheFiles, "_open_for_write", full)
    assert [hits(), hits()] == [0, 0]
    assert [record.name for record in caplog.records] == ["ufmstar_torch"]
    assert "cannot be written to (No space left on device)" in caplog.text

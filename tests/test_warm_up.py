"""Compilation before the first frame, and in two processes."""

from __future__ import annotations

import gc
import importlib.util
import json
import os
import subprocess
import sys
from types import SimpleNamespace

import pytest
from numba.core import event

from ufmstar_torch.eval.engine import warm_up as commands
from ufmstar_torch.kernels import compile_beside, compile_cpu
from ufmstar_torch.kernels.compile_beside import compiling_beside
from ufmstar_torch.kernels.compile_cpu import kernel
from ufmstar_torch.kernels.regress_tiles_cpu import exact

JOB = ("ufmstar_torch.warm_up", "regression", {"kind": "exact"})
COLD = """
import json, sys
import torch
from numba.core import event
from ufmstar_torch import UfMStar
from ufmstar_torch.eval.engine.warm_up import metrics, preprocessing
from ufmstar_torch.warm_up import warm_up
steps = []
with event.install_recorder("numba:compile") as compiled:
    warm_up(UfMStar(), (64, 64), 1, lambda done, total: steps.append((done, total)), [preprocessing, metrics])
names = {one.data["dispatcher"].py_func.__name__ for _, one in compiled.buffer}
ufm, pose = UfMStar(), torch.eye(4)
depth = 2 + torch.rand(1, 48, 64, generator=torch.Generator().manual_seed(0)).cumsum(2) / 10
for _ in range(2):
    out = ufm(depth, pose, torch.tensor([[60.0, 0, 32], [0, 60, 24], [0, 0, 1]]))
print(json.dumps({"names": sorted(names), "steps": steps, "variance": out.variance.sum().item()}))
"""


def compiled_function():
    """A new function of which no cache has a copy."""
    names: dict = {}
    exec("def plus_one(x):\n    return x + 1", names)
    return kernel(names["plus_one"])


@pytest.fixture
def started(monkeypatch: pytest.MonkeyPatch) -> list[list[str]]:
    """Commands of the processes that were started, which do nothing."""
    commands: list[list[str]] = []

    def popen(command, **_):
        commands.append(command)
        return process(["true"])

    process = subprocess.Popen
    monkeypatch.setattr(compile_beside.subprocess, "Popen", popen)
    monkeypatch.setattr(compile_beside.os, "sched_getaffinity", lambda _: {0, 1}, raising=False)
    return commands


def begin(dispatcher) -> event.Event:
    return event.Event("numba:compile", event.EventStatus.START, {"dispatcher": dispatcher})


def test_a_kernel_without_a_folder_to_be_kept_in_is_compiled_in_memory(started):
    plus_one = compiled_function()
    assert plus_one.stats.cache_path is None
    with compiling_beside([JOB]) as compiler:
        assert plus_one(1) == 2
        compiler.wait()
    assert not started


def test_the_first_compilation_starts_one_process(started):
    with compiling_beside([JOB]) as compiler:
        compiler.wait()
        assert not started
        for _ in range(2):
            compiler.on_start(begin(exact))
        compiler.wait()
    assert [json.loads(command[-1]) for command in started] == [[list(JOB)]]


def test_garbage_is_collected_as_before(started):
    for enabled in (True, False):
        (gc.enable if enabled else gc.disable)()
        with compiling_beside([]) as compiler:
            compiler.on_start(begin(exact))
            assert not gc.isenabled()
        assert gc.isenabled() == enabled
        gc.enable()
    with compiling_beside([JOB]):
        assert gc.isenabled()


def test_one_core_a_frozen_program_or_a_full_system_compile_in_one_process(started, monkeypatch):
    def refused(*_, **__):
        raise BlockingIOError("Resource temporarily unavailable")

    for target, name, value in (
        (compile_beside.os, "sched_getaffinity", lambda _: {0}),
        (compile_beside.sys, "frozen", True),
        (compile_beside.sys, "executable", ""),
        (compile_beside.sys, "executable", "/opt/robot/bin/robot"),
        (compile_beside.subprocess, "Popen", refused),
    ):
        with monkeypatch.context() as patch, compiling_beside([JOB]) as compiler:
            patch.setattr(target, name, value, raising=False)
            compiler.on_start(begin(exact))
            compiler.wait()
    assert not started


def test_jobs_end_with_the_process_that_started_them(monkeypatch):
    parents = iter([7, 7, 1])  # the parent is gone before the second job
    monkeypatch.setattr(compile_beside.os, "getppid", lambda: next(parents))
    done = []
    monkeypatch.setattr(
        compile_beside.importlib, "import_module", lambda name: SimpleNamespace(job=lambda: done.append(name))
    )
    compile_beside.main(json.dumps([("first", "job", {}), ("second", "job", {})]))
    assert done == ["first"]


def test_the_jobs_of_a_command_compile_all_in_one_pass():
    names = ("metrics", "preprocessing", "dense_anchors")
    jobs = json.dumps([JOB, *((commands.__name__, name, {}) for name in names)])
    compile_beside.main(jobs)
    with event.install_recorder("numba:compile") as compiled:
        compile_beside.main(jobs)
    assert not compiled.buffer


@pytest.mark.slow
def test_a_cold_start_compiles_the_regression_beside_and_gives_the_same(tmp_path):
    def run(folder) -> dict:
        environment = {**os.environ, "NUMBA_CACHE_DIR": str(folder), "OMP_NUM_THREADS": "1"}
        done = subprocess.run([sys.executable, "-c", COLD], env=environment, capture_output=True, text=True, check=True)
        return json.loads(done.stdout)

    cold, warm = run(tmp_path), run(tmp_path)
    assert "scan_rows" in cold["names"]
    if len(os.sched_getaffinity(0)) > 1:
        assert not {
            "describe",
            "exact",
            "exact_at",
            "in_view",
            "_choose",
            "_mean",
            "uncertainty_sums",
            "_resized",
        } & set(cold["names"])
    assert not warm["names"]
    assert cold["variance"] == warm["variance"]
    for result in (cold, warm):
        assert result["steps"] == [[done, 23] for done in range(24)]


def test_a_kernel_on_disk_is_outdated_when_another_file_of_the_kernels_changes(tmp_path, monkeypatch):
    path = tmp_path / "one_kernel.py"
    path.write_text(
        "from ufmstar_torch.kernels.compile_cpu import kernel\n\n\n@kernel\ndef plus_one(x):\n    return x + 1\n"
    )

    def hits() -> int:
        spec = importlib.util.spec_from_file_location("one_kernel", path)
        module = importlib.util.module_from_spec(spec)
        spec.loader.exec_module(module)
        assert module.plus_one(1) == 2
        return sum(module.plus_one.stats.cache_hits.values())

    assert [hits(), hits()] == [0, 1]
    monkeypatch.setattr(compile_cpu, "_SOURCES", "of other files")
    assert [hits(), hits()] == [0, 1]

"""What all tests share: one thread a process, kernels that are compiled once, Hypothesis's profiles."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest
from hypothesis import settings

# One thread per worker, set before torch is imported; .ci/run sets another number for the numerical tests.
THREADS = int(os.environ.setdefault("OMP_NUM_THREADS", "1"))

KERNELS = Path(__file__).resolve().parents[1] / "ufmstar_torch" / "kernels"
MAX_WORKERS = 4  # each takes up to 3 GB
COMPILE = """
import gc, sys
import torch
from ufmstar_torch import UfMStar, UfMStarConfig
from ufmstar_torch.eval.engine.warm_up import metrics, preprocessing
from ufmstar_torch.eval.metrics import SequenceMetrics
gc.disable()
dtype = getattr(torch, sys.argv[1])
depth, pose = torch.full((1, 24, 32), 2.0, dtype=dtype), torch.eye(4)
K = torch.tensor([[30.0, 0.0, 16.0], [0.0, 30.0, 12.0], [0.0, 0.0, 1.0]])
ufm = UfMStar(UfMStarConfig(backend="numba", merge=1.0, merge_every=1))
for _ in range(2):
    ufm(depth, pose, K)
preprocessing()
SequenceMetrics().update(depth, depth, depth)
"""


COMPILERS: pytest.StashKey[list[subprocess.Popen[bytes]]] = pytest.StashKey()

settings.register_profile("fast", deadline=None, max_examples=25)
settings.register_profile("thorough", deadline=None, max_examples=150, print_blob=True)
settings.load_profile("fast")  # --hypothesis-profile=thorough loads the other one


def pytest_configure(config: pytest.Config) -> None:
    """Start to compile the kernels while the workers of pytest-xdist collect the tests."""
    if config.getoption("tx", None) and not config.option.collectonly and not _compiled():
        dtypes = ("float32", "float64")
        config.stash[COMPILERS] = [subprocess.Popen([sys.executable, "-c", COMPILE, dtype]) for dtype in dtypes]


def pytest_xdist_node_collection_finished(node) -> None:
    """No test starts before the kernels are compiled: numba's cache is shared by the workers."""
    for compiler in node.config.stash.get(COMPILERS, []):
        compiler.wait()


@pytest.hookimpl(tryfirst=True)
def pytest_xdist_auto_num_workers(config: pytest.Config) -> int:
    """A worker for each core, but none where files or tests are named on the command line."""
    return 0 if _names_files(config) else min(len(os.sched_getaffinity(0)), MAX_WORKERS)


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """Leave out what is marked slow or needs a device, unless files or tests are named or ``-m`` selects by marker."""
    if config.option.markexpr or _names_files(config):
        return
    left_out = [item for item in items if any(map(item.get_closest_marker, ("slow", "interpreter", "gpu")))]
    config.hook.pytest_deselected(items=left_out)
    items[:] = [item for item in items if item not in set(left_out)]


def pytest_runtest_setup(item: pytest.Item) -> None:
    """Take back what the test before did to torch's threads; numba changes their number when its own threads start."""
    torch = sys.modules.get("torch")
    if torch is not None and torch.get_num_threads() != THREADS:
        torch.set_num_threads(THREADS)


def _names_files(config: pytest.Config) -> bool:
    return any(Path(argument.split("::")[0]).is_file() for argument in config.args)


def _compiled() -> bool:
    """Whether numba's cache is younger than the kernels' sources."""
    cached = [path.stat().st_mtime for path in KERNELS.glob("__pycache__/*.nbi")]
    return bool(cached) and max(cached) > max(path.stat().st_mtime for path in KERNELS.glob("*.py"))


@pytest.fixture(scope="session")
def evaluation(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """An evaluation with a failed, an unfinished and a hostile sequence, example frames and a room, and its report."""
    from evaluations import ENSEMBLE, HOSTILE, KITCHEN, LATER, SCENES, TITLE, write_evaluation, write_examples

    from ufmstar_torch.eval.report.write import write_report

    out = tmp_path_factory.mktemp("evaluation") / "out"
    failed = {("tum", "fr1_xyz"): HOSTILE}
    write_evaluation(out, ENSEMBLE, [*SCENES, KITCHEN], title=TITLE, unfinished=[LATER], failed=failed)
    write_examples(out, *KITCHEN, ENSEMBLE)
    assert write_report(out).undrawn == {}
    return out


@pytest.fixture(scope="session")
def results(evaluation: Path):
    """The results of :func:`evaluation`, with sums."""
    from ufmstar_torch.eval.report.data import load_results

    return load_results(evaluation)


@pytest.fixture
def ufmstar(capfd: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch):
    """Calls the program: (exit code, stdout, stderr)."""
    from ufmstar_torch import cli

    for name in ("RANK", "WORLD_SIZE", "LOCAL_RANK"):
        monkeypatch.delenv(name, raising=False)

    def call(*words):
        capfd.readouterr()
        code = cli.main([str(word) for word in words])
        printed = capfd.readouterr()
        return code, printed.out, printed.err

    return call


@pytest.fixture(scope="session")
def rooms(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Three sequences of 4 frames. Nobody may change them."""
    from suite_runs import write_rooms

    return write_rooms(tmp_path_factory.mktemp("rooms"))

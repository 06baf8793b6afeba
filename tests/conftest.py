"""Sets one thread per process, compiles the kernels once, and defines Hypothesis's profiles and the shared fixtures."""

from __future__ import annotations

import gc
import os
import resource
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest
from hypothesis import settings

# One thread per worker, set before torch is imported; .ci/run sets another number for the numerical tests.
THREADS = int(os.environ.setdefault("OMP_NUM_THREADS", "1"))

CORE = Path(__file__).resolve().parents[1] / "ufmstar_torch"
PROCESSOR, MOST_SECONDS = "processor_seconds", 20
MAX_WORKERS = 4  # each takes up to 3 GB
COMPILE = Path(__file__).with_name("compile_kernels.py")
COMPILERS: pytest.StashKey[list[subprocess.Popen[bytes]]] = pytest.StashKey()
MODULES: pytest.StashKey[int] = pytest.StashKey()  # number of imported modules

settings.register_profile("fast", deadline=None, max_examples=10)
settings.register_profile("thorough", deadline=None, max_examples=50, print_blob=True)
settings.register_profile("few", deadline=None, max_examples=3)
# --hypothesis-profile=thorough loads another one.
settings.load_profile("few" if os.environ.get("TRITON_INTERPRET") == "1" else "fast")


def pytest_configure(config: pytest.Config) -> None:
    """Compile the kernels in the background while the workers of pytest-xdist collect the tests."""
    if config.getoption("tx", None) and not config.option.collectonly:
        dtypes = [dtype for dtype in ("float32", "float64") if not _compiled(dtype)]
        config.stash[COMPILERS] = [subprocess.Popen([sys.executable, COMPILE, dtype]) for dtype in dtypes]


def pytest_xdist_node_collection_finished(node) -> None:
    """Wait for the compiled kernels before the first test: the workers share numba's cache."""
    for compiler in node.config.stash.get(COMPILERS, []):
        compiler.wait()


@pytest.hookimpl(tryfirst=True)
def pytest_xdist_auto_num_workers(config: pytest.Config) -> int:
    """Start one worker per core, or none if the command line names files or tests."""
    return 0 if _names_files(config) else min(len(os.sched_getaffinity(0)), MAX_WORKERS)


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """Without ``-m``, deselect tests that need a GPU, and slow tests unless the command line names files or tests."""
    if config.option.markexpr:
        return
    markers = ("interpreter", "gpu") if _names_files(config) else ("slow", "interpreter", "gpu")
    left_out = [item for item in items if any(map(item.get_closest_marker, markers))]
    config.hook.pytest_deselected(items=left_out)
    items[:] = [item for item in items if item not in set(left_out)]


@pytest.hookimpl(wrapper=True)
def pytest_collection() -> Iterator[None]:
    """Collect no garbage while the tests are collected, since that takes a quarter of the time, and leave all imported
    modules out of later garbage collections, which take a second with them: each warm-up collects once."""
    gc.disable()
    try:
        return (yield)
    finally:
        gc.freeze()
        gc.enable()


@pytest.hookimpl(wrapper=True)
def pytest_runtest_teardown(item: pytest.Item) -> Iterator[None]:
    """Do likewise after a test that has imported further packages."""
    try:
        return (yield)
    finally:
        if len(sys.modules) > item.config.stash.get(MODULES, 0):
            item.config.stash[MODULES] = len(sys.modules)
            gc.collect()
            gc.freeze()


def pytest_sessionfinish() -> None:
    """Modules that count their objects at the end find them collected."""
    gc.unfreeze()


def pytest_runtest_setup(item: pytest.Item) -> None:
    """Reset torch's number of threads: numba changes it when it starts its threads."""
    torch = sys.modules.get("torch")
    if torch is not None and torch.get_num_threads() != THREADS:
        torch.set_num_threads(THREADS)


@pytest.hookimpl(wrapper=True)
def pytest_runtest_call(item: pytest.Item) -> Iterator[None]:
    """Note the processor time of a test and of the processes that it starts, which other load hardly changes."""
    before = _processor_seconds()
    try:
        return (yield)
    finally:
        item.user_properties.append((PROCESSOR, _processor_seconds() - before))


def pytest_terminal_summary(terminalreporter: pytest.TerminalReporter) -> None:
    """List the tests that need more processor time than a test should."""
    reports = [report for outcome in ("passed", "failed") for report in terminalreporter.stats.get(outcome, [])]
    seconds = {report.nodeid: dict(report.user_properties).get(PROCESSOR, 0.0) for report in reports}
    for name, value in sorted(seconds.items(), key=lambda item: -item[1]):
        if value > MOST_SECONDS:
            terminalreporter.write_line(f"{value:.0f} s of processor time, more than {MOST_SECONDS}: {name}")


def _processor_seconds() -> float:
    used = [resource.getrusage(who) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)]
    return sum(one.ru_utime + one.ru_stime for one in used)


def _names_files(config: pytest.Config) -> bool:
    return any(Path(argument.split("::")[0]).is_file() for argument in config.args)


def _compiled(dtype: str) -> bool:
    """Return True if the kernels on disk were compiled after the last change of a file that they depend on."""
    done = CORE / "kernels" / "__pycache__" / f"{dtype}.compiled"
    return done.is_file() and done.stat().st_mtime > max(path.stat().st_mtime for path in CORE.rglob("*.py"))


TRITON = (
    pytest.mark.interpreter, pytest.mark.gpu,
    pytest.mark.filterwarnings("ignore::RuntimeWarning:triton"),  # NumPy on inf and NaN; a GPU is silent
)  # fmt: skip


COMPILED = ("numba", pytest.param("triton", marks=TRITON))


def _backend(request: pytest.FixtureRequest):
    from backends import make_backend

    return make_backend(request.param)


# Every backend of ``backends.py``, and every backend but the reference.
backend = pytest.fixture(scope="session", params=["torch", *COMPILED])(_backend)
compiled_backend = pytest.fixture(scope="session", params=COMPILED)(_backend)


@pytest.fixture(scope="session")
def evaluation(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of an evaluation and its report: a failed, an unfinished and a hostile sequence, example frames and a
    room."""
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
    """Run the command line in this process: (exit code, stdout, stderr)."""
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
def scene(tmp_path_factory: pytest.TempPathFactory):
    """A generic sequence of 6 frames, 48x64, and its rendered scene. Tests must not change it."""
    from layouts import write_generic

    return write_generic(tmp_path_factory.mktemp("scene"))


@pytest.fixture(scope="session")
def rendered_walk(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of an exported tour: 12 frames, 120x160, whose images show the motion. Tests must not change it."""
    from ufmstar_torch.eval.sequences import open_sequence
    from ufmstar_torch.eval.tour import export_tour

    return export_tour(open_sequence("tour:41?frames=12&size=120x160"), tmp_path_factory.mktemp("rendered") / "walk")


@pytest.fixture(scope="session")
def finished_run(scene, tmp_path_factory: pytest.TempPathFactory):
    """A run of :func:`scene` with exact depth, the recording and its scene; the variance is replaced by (2 % of the
    depth)^2, and above the horizon by 1 m^2. Tests may export it."""
    import numpy as np
    from runs import own_depth_job

    from ufmstar_torch.eval.run.run import run
    from ufmstar_torch.eval.run.writers import read_frame

    out = tmp_path_factory.mktemp("run") / "out"
    run(own_depth_job(scene[0]), out)
    for file in (out / "frames").iterdir():
        maps = read_frame(file)
        maps["variance"] = np.square(0.02 * maps["depth"])
        maps["variance"][:20] = 1
        np.savez(file, **maps)
    return out, *scene


@pytest.fixture(scope="session")
def path(scene) -> Path:
    """The folder of :func:`scene`."""
    return scene[0]


@pytest.fixture(scope="session")
def sequence(path: Path):
    """The opened sequence of :func:`scene`."""
    from ufmstar_torch.eval.sequences import open_sequence

    return open_sequence(path)


@pytest.fixture(scope="session")
def rooms(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Three sequences of 4 frames. Tests must not change them."""
    from tiny_suite import write_rooms

    return write_rooms(tmp_path_factory.mktemp("rooms"))


@pytest.fixture(scope="session")
def network_files(tmp_path_factory: pytest.TempPathFactory) -> dict[str, str]:
    """A file of tiny networks for every base: {base: "BASE=trained:FILE"}. Tests must not change them."""
    from tiny_suite import write_networks

    return write_networks(tmp_path_factory.mktemp("networks"))


@pytest.fixture(scope="session")
def networks(network_files):
    """The loaded networks of :func:`network_files`, 3 samples each."""
    from tiny_suite import base_network

    return {base: base_network(text, samples=3) for base, text in network_files.items()}


@pytest.fixture(scope="session")
def frames(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A sequence to train on. Tests must not change it."""
    from trainings import write_frames

    return write_frames(tmp_path_factory.mktemp("frames") / "walk")


@pytest.fixture(scope="module")
def one_thread():
    """Set torch to one thread during a module's tests."""
    import torch

    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(threads)

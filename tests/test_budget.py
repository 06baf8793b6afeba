"""The number of classes and files that a frame passes through, counted while it does."""

from __future__ import annotations

import sys
import threading
from contextlib import contextmanager
from pathlib import Path

import pytest
from runs import Brightness, job_of, networks
from tiny_suite import evaluate, row

import ufmstar_torch
from ufmstar_torch import AnchorConfig, PosteriorConfig, UfMStarConfig, UncertainDepth
from ufmstar_torch.eval.run.run import run
from ufmstar_torch.eval.sequences.frame import in_memory
from ufmstar_torch.eval.tour.sequence import open_tour

CORE, EVAL = Path(ufmstar_torch.__file__).parent, Path(ufmstar_torch.eval.__file__).parent
FIRST, LAST = 8, 10  # the frames between which calls are counted
CONFIG = UfMStarConfig(anchors=AnchorConfig(), posterior=PosteriorConfig(), on_bad_frame="skip")


class Passed:
    """The package's classes whose methods are called, and the files whose functions are called, in all threads."""

    def __init__(self):
        self.classes, self.files, self.calls, self.counts = set(), set(), 0, False

    def note(self, frame, event, _):
        if event != "call" or not self.counts:
            return
        code = frame.f_code
        if Path(code.co_filename).is_relative_to(CORE) or Path(code.co_filename).is_relative_to(EVAL):
            self.files.add(code.co_filename)
            self.calls += not code.co_name.startswith("<")  # a comprehension or generator is no call
        if code.co_argcount and code.co_varnames[0] == "self":
            kind = type(frame.f_locals["self"])
            if kind.__module__.startswith("ufmstar_torch"):
                self.classes.add(f"{kind.__module__}.{kind.__qualname__}")

    def at(self, progress):
        """Count between two frames."""
        if progress.stage == "frames" or "/" in progress.stage:
            self.counts = FIRST <= progress.done < LAST

    @contextmanager
    def watching(self):
        threading.setprofile(self.note)
        sys.setprofile(self.note)
        try:
            yield
        finally:
            sys.setprofile(None)
            threading.setprofile(None)


@pytest.fixture(scope="module")
def tour():
    return in_memory(open_tour("tour:5?frames=12&size=96x128"))


def count(passed):
    """(classes, files) of the core and of eval; classes by the package that defines them."""
    ours = [sum(name.startswith("ufmstar_torch.eval") for name in passed.classes)]
    ours.append(sum(Path(path).is_relative_to(EVAL) for path in passed.files))
    return (len(passed.classes) - ours[0], len(passed.files) - ours[1]), tuple(ours)


def assert_within(passed, core, own):
    """Neither more classes nor more files than stated; a failure lists them."""
    counted = count(passed)
    listed = "\n".join([*sorted(passed.classes), *sorted(passed.files)])
    for most, (classes, files) in zip((core, own), counted, strict=True):
        assert (classes <= most[0], files <= most[1]) == (True, True), f"{counted}\n{listed}"


def run_counted(tour, out, config, landmarks):
    passed, source = Passed(), networks(Brightness(1.0, spread=0.02))
    source.digest = "0" * 64
    with passed.watching():
        run(job_of(tour, source, config=config, landmarks=landmarks), out, progress=passed.at)
    assert len(list((out / "frames").iterdir())) == len(tour)
    return passed


# (classes, files) of the core, then of eval; half of eval's classes are metrics. The aim is 40 classes in 28 files in
# all, so that a reader can hold a frame's road in mind. A plain run has 22 files too many, the default with anchors and
# posterior 16 classes and 54 files, a row of UfM* alone in an evaluation 18 files.


def test_a_frame_of_a_plain_run(tour, tmp_path):
    plain = CONFIG.replace(anchors=None, posterior=None)
    assert_within(run_counted(tour, tmp_path / "out", plain, "corners"), (14, 28), (21, 22))


def test_a_frame_of_a_run(tour, tmp_path):
    assert_within(run_counted(tour, tmp_path / "out", CONFIG, "dense"), (32, 57), (24, 25))


def test_a_frame_of_eval(tour):
    passed, source = Passed(), {"aleatoric": networks(Brightness(1.0, spread=0.02))}
    with passed.watching():
        evaluate(tour, [row("UfM*-Aleatoric")], source, progress=passed.at)
    assert_within(passed, (15, 27), (21, 19))


def test_a_call_of_the_default(tour):
    """(classes, files) and calls of Python functions in one call of ``UncertainDepth`` with anchors and posterior."""
    passed, model, last = Passed(), UncertainDepth(Brightness(1.0, spread=0.02)), len(tour) - 1
    with passed.watching():
        for i, frame in enumerate(tour):
            passed.counts = i == last
            model(frame.image, frame.T_world_cam, frame.intrinsics)
            passed.counts = False
    assert_within(passed, (35, 57), (0, 0))
    assert passed.calls <= 495, passed.calls

"""Pictures of a report: strips, breakdowns and comparisons show the right numbers."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from evaluations import KITCHEN, SHAPE, rows_of, write_evaluation, write_examples
from PIL import Image

from ufmstar_torch.eval.methods.setting import Setting
from ufmstar_torch.eval.metrics import NLL
from ufmstar_torch.eval.report.data import load_results
from ufmstar_torch.eval.report.examples import Example, RowMaps, find_examples
from ufmstar_torch.eval.report.pictures import (
    BREAKDOWN,
    COMPARE,
    NLL_SCALE,
    OVERVIEW,
    STRIP,
    draw_comparison,
    draw_overview,
    draw_strip,
    fit_strip_scales,
    pictures_of,
)
from ufmstar_torch.eval.run.colours import INVALID_GREY
from ufmstar_torch.eval.run.panels import break_name

K = np.array([[20.0, 0, 7.5], [0, 20, 5.5], [0, 0, 1]])


def full(value: float) -> np.ndarray[Any, Any]:
    return np.full(SHAPE, value, np.float32)


def halves(left: float, right: float) -> np.ndarray[Any, Any]:
    values = full(left)
    values[:, SHAPE[1] // 2 :] = right
    return values


def example(rows: dict[str, tuple[Any, Any]], truth: Any = None) -> Example:
    """A frame with the depth and the variance of some rows."""
    truth, image = full(3.0) if truth is None else truth, np.zeros((*SHAPE, 3), np.uint8)
    maps = {name: RowMaps.of({"depth": depth, "variance": v}, truth) for name, (depth, v) in rows.items()}
    shown = np.where(truth > 0, truth, np.nan).astype(np.float32)
    return Example("d", "s", "f", image, shown, SHAPE[0] / SHAPE[1], maps, {name: name for name in rows})


def pixels(path: Path, colour: np.ndarray[Any, Any]) -> int:
    """Count the pixels of a colour in a picture."""
    with Image.open(path) as picture:
        return int((np.asarray(picture.convert("RGB")) == colour.astype(np.uint8)).all(-1).sum())


CELL = (1.95 * 110) ** 2 * SHAPE[0] / SHAPE[1]  # pixels of a picture in a strip


class TestExample:
    def test_nll_is_that_of_the_metric(self) -> None:
        rng = np.random.default_rng(0)
        truth = np.where(rng.random(SHAPE) < 0.2, 0, rng.uniform(1, 5, SHAPE)).astype(np.float32)
        variance = rng.uniform(0.01, 1, SHAPE).astype(np.float32)
        variance[0, 0], variance[1, 1], variance[2, 2] = 0, np.nan, -1
        depth = rng.uniform(1, 5, SHAPE).astype(np.float32)
        one = example({"a": (depth, variance)}, truth).rows["a"]
        metric = NLL()
        metric.update(*(torch.from_numpy(value) for value in (depth, variance, truth)))
        assert one.mean_nll == pytest.approx(float(metric.compute()["nll"]), rel=1e-9)
        judged = (truth > 0) & (variance > 0)
        np.testing.assert_array_equal(np.isfinite(one.nll), judged)
        np.testing.assert_array_equal(np.isfinite(one.error), (truth > 0) & (variance >= 0))

    def test_a_posteriors_sigma_is_striped_where_it_has_no_evidence(self, tmp_path: Path) -> None:
        stored = {"depth": full(2.0), "variance": full(0.1), "measured": full(0.0)}
        evidence, none = {"posterior_outlier": halves(np.nan, 0.1)}, {"posterior_outlier": full(np.nan)}
        rows = {"plain": stored, "half": stored | evidence, "none": stored | none}
        one = replace(example({}), rows={name: RowMaps.of(maps, full(3.0)) for name, maps in rows.items()})
        assert (one.rows["half"].assumed == (halves(1, 0) > 0)).all()
        assert one.rows["half"].unmeasured is not None
        assert one.rows["half"].unmeasured.all()
        grey = np.full(3, INVALID_GREY)
        half, whole = (
            pixels(tmp_path / draw_overview(tmp_path, one, "plain", row).file, grey) for row in ("half", "none")
        )
        assert whole - half == pytest.approx(CELL / 6, rel=0.1)


class TestFindExamples:
    def write(self, folder: Path, name: str, **arrays: Any) -> None:
        (folder / "examples").mkdir(parents=True, exist_ok=True)
        np.savez(folder / "examples" / f"{name}.npz", **arrays)

    def frame(self, folder: Path, name: str) -> None:
        self.write(folder, name, image=np.zeros((*SHAPE, 3), np.uint8), truth=full(3.0), K=K, index=0)

    def test_frames_rows_and_cameras(self, tmp_path: Path) -> None:
        folder = tmp_path / "tum" / "desk"
        for name in ("f@1", "f@2"):  # names with the character that separates frames from rows
            self.frame(folder, name)
        self.write(folder, "f@1@Ensemble", depth=full(2.0), variance=full(0.1), aleatoric=full(0.1))
        self.write(folder, "f@1@UfMstar-Ensemble@0a1b", depth=full(2.0), variance=full(0.2))
        self.write(folder, "f@1@DepthOnly", depth=full(2.0))
        big = np.full((24, 32), 2.0, np.float32)
        scene = {"image": np.ones((24, 32, 3), np.uint8), "truth": big, "K": 2 * K}
        self.write(folder, "f@1@UfMstar-DepthOnly", depth=big, variance=big, **scene)
        result = find_examples(folder, "tum", "desk", {})
        assert [e.title for e in result] == ["desk, frame f@1"] * 2
        assert set(result[0].rows) == {"Ensemble", "UfMstar-Ensemble@0a1b"}
        assert set(result[1].rows) == {"UfMstar-DepthOnly"}
        assert result[1].truth.shape == (24, 32)

    def test_bad_files_are_named(self, tmp_path: Path) -> None:
        folder = tmp_path / "tum" / "desk"
        self.frame(folder, "a")
        self.write(folder, "a@Ensemble", depth=full(2.0)[:3], variance=full(2.0))
        with pytest.raises(ValueError, match=r"a@Ensemble\.npz: depth must have the truth's shape"):
            find_examples(folder, "tum", "desk", {})
        self.write(folder, "a@Ensemble", variance=full(2.0))
        with pytest.raises(ValueError, match=r"a@Ensemble\.npz must hold depth"):
            find_examples(folder, "tum", "desk", {})
        (folder / "examples" / "a@Ensemble.npz").write_bytes(b"nothing")
        with pytest.raises(ValueError, match=r"a@Ensemble\.npz is no readable \.npz"):
            find_examples(folder, "tum", "desk", {})


class TestStrips:
    def test_pixels_have_the_colours_of_the_numbers(self, tmp_path: Path) -> None:
        rows = {"alone": (full(2.0), halves(0.04, 0.64)), "star": (full(2.5), full(0.25))}
        one = example(rows, halves(3.0, 0.0))
        path = tmp_path / draw_strip(tmp_path, one, list(rows), "ensemble").file
        _, length = fit_strip_scales(one, list(rows))
        # Errors 1 and .5 where there is truth; sigmas .2 | .8 and .5. Error and sigma share a scale, so both .5 have
        # one colour.
        for value, area in ((0.2, 0.5), (0.8, 0.5), (1.0, 0.5), (0.5, 1.5)):
            result = pixels(path, length.rgb(np.array(value)))
            assert result == pytest.approx(area * CELL, rel=0.12), value
        nll = one.rows["star"].nll[0, 0]
        assert pixels(path, NLL_SCALE.rgb(np.array(nll))) == pytest.approx(0.5 * CELL, rel=0.12)
        # No truth on the right half: grey in the truth, two errors and two NLLs.
        assert pixels(path, np.full(3, INVALID_GREY)) == pytest.approx(2.5 * CELL, rel=0.12)


class TestCompare:
    def test_red_marks_the_pixels_where_ufm_star_is_larger(self, tmp_path: Path) -> None:
        new = full(0.01)
        new[8:, 11:] = 1.0
        one = example({"ufm": (full(2.0), full(0.01)), "star": (full(2.0), new)})
        with Image.open(tmp_path / draw_comparison(tmp_path, one, ["ufm", "star"], "ensemble").file) as picture:
            colours = np.asarray(picture.convert("RGB")).astype(int)
        # RdBu_r: red where UfM*'s value is larger; it is nowhere smaller.
        assert ((colours[..., 0] > 80) & (colours[..., 1] < 20) & (colours[..., 2] < 50)).sum() > 500

    def test_long_labels_of_rows_do_not_run_over_the_panels(self, tmp_path: Path) -> None:
        one = example({"ufm": (full(2.0), full(0.01)), "star": (full(2.0), full(0.02))})
        long = replace(one, labels={name: f"networks in turn, with {name} (100,000 points)" for name in one.rows})
        drawn = [draw_comparison(tmp_path, e, ["ufm", "star"], base) for e, base in ((one, "a"), (long, "b"))]
        assert (tmp_path / drawn[0].file).read_bytes() == (tmp_path / drawn[1].file).read_bytes()
        assert drawn[1].title.endswith(f"{long.labels['star']} against {long.labels['ufm']}")


class TestWritePictures:
    def test_all_kinds_with_their_words(self, evaluation: Path, tmp_path: Path) -> None:
        sequence = KITCHEN[1]  # not a valid folder name
        pictures = [draw() for _, draw in pictures_of(load_results(evaluation, with_sums=False), tmp_path)]
        assert [p.file.partition("-")[0] for p in pictures] == [STRIP, BREAKDOWN, COMPARE]
        assert all((evaluation / "figures" / p.file).is_file() for p in pictures)
        assert all(p.title.startswith(sequence) for p in pictures)

    def test_the_first_picture_has_ufm_star_alone_beside_the_posterior(self, tmp_path: Path) -> None:
        (alone,) = rows_of("UfM*-DepthOnly")
        rows = [alone, replace(alone, setting=Setting(posterior=True, anchors="dense"))]
        write_evaluation(tmp_path / "out", rows, [KITCHEN])
        write_examples(tmp_path / "out", *KITCHEN, rows)
        first = next(pictures_of(load_results(tmp_path / "out", with_sums=False), tmp_path))[1]()
        assert first.file.startswith(OVERVIEW)
        assert first.title.endswith("UfM* alone and with the posterior")
        assert (tmp_path / first.file).is_file()


@pytest.mark.parametrize(
    ("name", "lines"),
    [
        ("1305031105.043373", ["1305031105.", "043373"]),
        ("a_long-name.of a room", ["a_long-", "name.of a", "room"]),
        ("abcdefghijklmnop", ["abcdefghijkl", "mnop"]),
        ("short", ["short"]),
    ],
)
def test_names_break_at_marks_and_timestamps_at_the_point(name: str, lines: list[str]) -> None:
    assert break_name(name, 12).split("\n") == lines

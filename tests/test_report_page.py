"""The page: well-formed, self-contained, with the results' numbers and the missing parts."""

from __future__ import annotations

import math
import re
from dataclasses import replace
from html.parser import HTMLParser
from pathlib import Path

import pytest
from evaluations import HOSTILE, KITCHEN, TITLE, in_memory, rows_of, write_evaluation

from ufmstar_torch import cli
from ufmstar_torch.eval.metrics import mean_and_ci
from ufmstar_torch.eval.report.data import Results
from ufmstar_torch.eval.report.page import command, limits

VOID = {"br", "hr", "img", "meta", "input"}


class Page(HTMLParser):
    """Parses a page, and records elements that do not close in order."""

    def __init__(self, text: str) -> None:
        super().__init__(convert_charrefs=True)
        self.open: list[str] = []
        self.elements: list[tuple[str, dict[str, str | None]]] = []
        self.words: list[str] = []
        self.tables: list[list[list[str]]] = []
        self.feed(text)
        self.close()
        assert self.open == []

    def handle_starttag(self, name: str, attributes: list[tuple[str, str | None]]) -> None:
        assert len(dict(attributes)) == len(attributes)
        self.elements.append((name, dict(attributes)))
        if name not in VOID:
            self.open.append(name)
        if name == "table":
            self.tables.append([])
        elif name == "tr":
            self.tables[-1].append([])
        elif name in ("td", "th"):
            self.tables[-1][-1].append("")

    def handle_endtag(self, name: str) -> None:
        assert name not in VOID
        assert self.open.pop() == name

    def handle_data(self, data: str) -> None:
        if self.open and self.open[-1] in ("style", "script"):
            return
        self.words.append(data)
        if "td" in self.open or ("th" in self.open and "table" in self.open):
            self.tables[-1][-1][-1] += data

    def all(self, name: str) -> list[dict[str, str | None]]:
        return [attributes for result, attributes in self.elements if result == name]

    @property
    def text(self) -> str:
        return re.sub(r"[\s\u202f]+", " ", " ".join(self.words))


@pytest.fixture(scope="module")
def page(evaluation: Path) -> Page:
    return Page((evaluation / "report.html").read_text(encoding="utf-8"))


def test_it_needs_nothing_else(page: Page, evaluation: Path) -> None:
    for _, attributes in page.elements:
        for name in ("src", "href", "srcset", "action", "poster", "data"):
            value = attributes.get(name)
            assert value is None or value.startswith(("data:image/", "#")), value
    assert not {"link", "iframe"} & {name for name, _ in page.elements}
    text = (evaluation / "report.html").read_text(encoding="utf-8")
    style = re.search(r"<style>(.*?)</style>", text, re.DOTALL)
    assert style
    assert "prefers-color-scheme: dark" in style[1]
    assert not re.search(r"url\(|@import", style[1])
    assert not re.search(r"https?://", re.sub(r'src="data:[^"]*"', "", text))


def test_every_picture_is_there_with_words(page: Page, evaluation: Path) -> None:
    images = page.all("img")
    kinds = [(i["src"] or "").split(";")[0] for i in images]
    files = [path.suffix for path in (evaluation / "figures").iterdir()]
    assert kinds.count("data:image/svg+xml") == files.count(".svg") >= 6
    assert kinds.count("data:image/webp") == files.count(".png") == 3  # strip, breakdown, comparison
    assert all(i["alt"] for i in images)
    assert any(KITCHEN[1] in (i["alt"] or "") for i in images)


def test_hostile_names_stay_text(page: Page) -> None:
    assert len(page.all("script")) == 1
    assert TITLE in page.text
    failed = next(t for t in page.tables if t and t[0] == ["data set", "sequence", "reason"])
    assert failed[1] == ["tum", "fr1_xyz", HOSTILE]
    assert f"{KITCHEN[1]}, frame 7" in page.text


def test_numbers_are_the_results_with_the_papers_beside(page: Page, results: Results) -> None:
    main = page.tables[0]
    assert main[0][1:] == ["Ours", "Paper"]
    assert main[1][1:5] == ["δ₁ ↑", "NLL ↓", "ECE_δ ↓", "ECE_q ↓"]
    assert main[1][6:9] == ["δ₁", "NLL", "ECE_δ"]
    rows = {row[0]: row for row in main}
    for row in results.rows:
        for column, (key, decimals) in enumerate({"delta1": 3, "nll": 2, "ece_delta": 3, "ece_q": 3}.items(), 1):
            mean, half = mean_and_ci([float(r.figures[key] or math.nan) for r in results.of(row)])
            cell = rows[row.method.name][column].replace("\u202f", "").replace("−", "-")
            value, _, interval = cell.partition("±")
            assert value == f"{mean:.{decimals}f}"
            assert interval in ("", f"{half:.{decimals}f}")
            assert bool(interval) == (half >= 0.01)
    paper = [cell.replace("\u202f", " ") for cell in rows["UfM*-Ensemble"][6:10]]
    assert paper == ["0.68", "0.96 ± 0.19", "0.12 ± 0.02", "0.13 ± 0.02"]


def test_everything_that_is_missing_is_a_limit() -> None:
    (row,) = rows_of("Ensemble")
    results = in_memory({(row, ("d", "s")): {"nll": 1.0}}, failed={("d", "x"): "broken"})
    results = replace(results, missing=(("d", "y", row),), notes=("a note",))
    frames = {**results.records[0].frames, "without_segment": 39, "without_match": 40}
    results = replace(results, records=(replace(results.records[0], frames=frames),))
    results = replace(results, about={**results.about, "missing_bases": ["evidential"]})
    assert {title: rows for title, _, rows in limits(results, {"latency": "no glyph"})} == {
        "Sequences that failed": [("d", "x", "broken")],
        "Frames in which UfM* compared no views": [("d", "Ensemble", "40", "39", "40")],
        "Frames that were skipped": [("d", "s", "42", "40", "2 × pose is not finite")],
        "Rows not evaluated yet": [("d", "y", "1")],
        "Rows without a network": [("evidential",)],
        "Figures that could not be drawn": [("latency", "no glyph")],
        "Further problems": [("a note",)],
    }


def test_a_figure_that_fails_does_not_lose_the_page(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    out = write_evaluation(tmp_path / "o", rows_of("Ensemble", "UfM*-Ensemble"), [("rooms", "a")], suite="own")

    def broken(*_: object) -> None:
        raise ValueError("no <b>such</b> glyph")

    monkeypatch.setattr("ufmstar_torch.eval.report.figures_error.draw_entropy", broken)
    assert cli.main(["report", str(out)]) == 0
    printed = capsys.readouterr()
    assert "figure not drawn: entropy ensemble: no <b>such</b> glyph\n" in printed.out
    assert printed.err.startswith("figures: 0 of ")
    assert "figures: done, " in printed.err
    page = Page((out / "report.html").read_text(encoding="utf-8"))
    undrawn = next(t for t in page.tables if t and t[0] == ["figure", "reason"])
    assert undrawn[1] == ["entropy ensemble", "no <b>such</b> glyph"]
    assert len(page.all("img")) >= 3


def test_the_command_has_networks_and_what_was_chosen() -> None:
    files = [{"name": "m0.safetensors"}, {"name": "m.safetensors", "member": 0}]
    networks = {"aleatoric": {"model": "trained", "files": files}}
    about = {"suite": "depth-only", "datasets": ["tum"], "networks": networks}
    begin = "ufmstar eval --suite depth-only --root tum=DIR "
    begin += "--network aleatoric=trained:DIR/m0.safetensors,DIR/m.safetensors#0"
    for settings, words in (
        ({}, ""),
        ({"frames": [None, None, None], "bins": "authors"}, " --bins authors"),
        ({"frames": [0, 8, None], "trajectory": "slam.txt", "truth_scale": 0.001},
         " --frames 0:8: --trajectory slam.txt --truth-scale 0.001"),
    ):  # fmt: skip
        assert command({**about, "settings": settings}) == f"{begin}{words} --out OUT"

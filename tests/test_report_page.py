"""The page: well-formed, alone in the world, with the results' numbers, and sentences that say what they say."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import replace
from html.parser import HTMLParser
from itertools import pairwise
from pathlib import Path
from typing import Any

import pytest
from evaluations import HOSTILE, KITCHEN, LATER, TITLE, in_memory, rows_of, write_evaluation

from ufmstar_torch import cli
from ufmstar_torch.eval.metrics import mean_and_ci
from ufmstar_torch.eval.report.data import Failed, Results
from ufmstar_torch.eval.report.findings import best_rows, caveats, compare, comparisons, headlines
from ufmstar_torch.eval.report.page import command, write_page

VOID = {"br", "hr", "img", "meta", "input"}


class Page(HTMLParser):
    """Reads a page, and complains where elements do not close in order."""

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

    def row(self, label: str, table: int) -> list[str]:
        return next(row for row in self.tables[table] if row and row[0] == label)


def results_of(
    values: Mapping[str, Sequence[Mapping[str, float]]], *, datasets: Sequence[str] | None = None, **changes: Any
) -> Results:
    """Figures of methods, sequence by sequence."""
    of = {
        (*rows_of(method), (datasets[n] if datasets else "d", f"s{n}")): figures
        for n in range(max(map(len, values.values())))
        for method, listed in values.items()
        for figures in listed[n : n + 1]
    }
    return in_memory(of, **changes)


def figures(nll: float, ece: float = 0.2, spearman: float = 0.5, delta1: float = 0.8) -> dict[str, float]:
    return {"nll": nll, "ece_delta": ece, "ece_q": ece, "ause_rmse": 0.3, "spearman": spearman, "delta1": delta1}


ALONE = [figures(2.0), figures(2.5), figures(3.0), figures(3.5), figures(4.0)]


class TestFindings:
    def test_wins_beyond_chance(self) -> None:
        gains = [1.0, 0.9, 1.0, 1.0, 1.1]
        star = [figures(f["nll"] - g, 0.1 + (1 - g) / 10) for f, g in zip(ALONE, gains, strict=True)]
        results = results_of({"Ensemble": ALONE, "UfM*-Ensemble": star})
        mean, half = mean_and_ci([-gain for gain in gains])
        (made,) = comparisons(results).values()
        assert {c.quantity.key: c.verdict for c in made} == {
            "nll": "better", "ece_delta": "better", "ece_q": "better", "ause_rmse": "open", "spearman": "open",
        }  # fmt: skip
        assert made[0].words == f"NLL 3.00 → 2.00 ({mean:.2f} ± {half:.2f})"
        first, losses = headlines(results)
        assert first.startswith("UfM* against the network alone, 3 comparisons of NLL, ECE_δ and ECE_q: ")
        assert "better in 3, worse in 0, undecided in 0" in first
        assert first.endswith("On average NLL falls by 1.00, ECE_δ falls by 50 % and ECE_q falls by 50 %.")
        assert losses.startswith("In none of all 5 comparisons")
        (best,) = (s for s in best_rows(results) if s.startswith("Best NLL"))
        assert (
            best
            == f"Best NLL: UfM*-Ensemble with 2.00, before Ensemble (3.00; a lead beyond chance, -1.00 ± {half:.2f})."
        )

    def test_losses_are_told(self) -> None:
        rises = [1.0, 1.1, 1.0, 1.0, 0.9]
        star = [figures(f["nll"] + r, spearman=0.2 + r / 10) for f, r in zip(ALONE, rises, strict=True)]
        results = results_of({"Ensemble": ALONE, "UfM*-Ensemble": star})
        first, losses = headlines(results)
        assert "better in 0, worse in 1, undecided in 2" in first
        assert "NLL rises by 1.00" in first
        assert losses.startswith(
            "UfM* is worse beyond chance in 2 of all 5 comparisons: UfM*-Ensemble against Ensemble: NLL"
        )
        assert "Spearman 0.50 → 0.30 (-0.20 ±" in losses
        assert any(s.startswith("Best Spearman: Ensemble with 0.50") for s in best_rows(results))

    def test_ties_within_the_interval(self) -> None:
        star = [figures(1.0), figures(4.0), figures(3.7), figures(2.0), figures(3.9)]
        results = results_of({"Ensemble": ALONE, "UfM*-Ensemble": star})
        first, losses = headlines(results)
        assert "better in 0, worse in 0, undecided in 3" in first
        assert losses.startswith("In none of all 5")
        assert any("a lead that may be chance" in s for s in best_rows(results) if s.startswith("Best NLL"))
        assert "Best AUSE: 0.300 m, shared by Ensemble and UfM*-Ensemble." in best_rows(results)

    def test_a_difference_that_prints_as_zero_is_open(self) -> None:
        star = [figures(f["nll"] - 1e-4) for f in ALONE]
        (made,) = comparisons(results_of({"Ensemble": ALONE, "UfM*-Ensemble": star})).values()
        assert made[0].difference.beyond
        assert made[0].verdict == "open"

    @pytest.mark.parametrize(("n", "words"), [(1, "a single sequence"), (4, "4 sequences")])
    def test_fewer_than_five_sequences_decide_nothing(self, n: int, words: str) -> None:
        results = results_of({"Ensemble": ALONE[:n], "UfM*-Ensemble": [figures(1.0)] * n})
        first, losses = headlines(results)
        assert f"the better value in 1, on {words}, which decides nothing" in first
        assert losses.startswith("With fewer than 5 sequences nothing can be said")
        assert caveats(results)[0].startswith(f"n = {n}: with fewer than 5 sequences there are no confidence intervals")
        assert {c.verdict for made in comparisons(results).values() for c in made} == {"no verdict"}

    def test_means_are_over_the_sequences_that_both_have(self) -> None:
        results = results_of({"Ensemble": ALONE, "UfM*-Ensemble": [figures(1.0), figures(2.0)]})
        rows = results.rows
        c = compare(results, rows[1], rows[0])[0]
        assert (c.mine, c.theirs, c.difference.value, c.difference.sequences) == (1.5, 2.25, -0.75, 2)
        assert best_rows(results) == []  # means over different sequences are not compared

    def test_against_ufm_and_only_where_there_is_a_variance(self) -> None:
        values = {"DepthOnly": [{"delta1": 0.8}] * 5, "UfM-DepthOnly-100K": ALONE, "UfM*-DepthOnly": ALONE}
        sentences = headlines(results_of(values))
        assert sentences[0].startswith("UfM* against UfM, 3 comparisons")
        assert not any("network alone" in s for s in sentences)

    def test_settings_of_an_ablation(self) -> None:
        results = results_of({"UfM*-Ensemble": ALONE})
        changed = tuple(
            replace(record, setting={"ema_alpha": 1.0}, figures=figures(0.51 * n + 1.0))
            for n, record in enumerate(results.records)
        )
        both = Results(results.out, results.about, (*results.records, *changed))
        (nll, *_) = (s for s in headlines(both) if s.startswith("NLL"))
        assert nll.startswith(
            "NLL, of 1 setting beside the default: better with 1 (UfM*-Ensemble, smoothing α 1 -0.98 ±"
        )
        assert nll.endswith("worse with 0, undecided with 0.")

    def test_caveats(self) -> None:
        poor = {"Ensemble": [figures(2.0, delta1=0.2) | {"nll_left_out_share": 0.25}] * 2}
        failed = (Failed("d", "x", "broken"),)
        results = results_of(poor, failed=failed, missing=(("d", "y", rows_of("Ensemble")[0]),))
        message = " ".join(caveats(results))
        for words in ("Left out, because of errors: 1 sequence;", "rows of 1 sequence are still", "On d only 20 %"):
            assert words in message
        assert "Ensemble 25 %" in message
        assert caveats(results_of({"Ensemble": [figures(2.0)] * 5})) == [
            "n = 5: the figures are means over 5 sequences, each counting the same."
        ]


@pytest.fixture(scope="module")
def page(evaluation: Path) -> Page:
    return Page((evaluation / "report.html").read_text(encoding="utf-8"))


class TestPage:
    def test_it_needs_nothing_else(self, page: Page, evaluation: Path) -> None:
        for _, attributes in page.elements:
            for name in ("src", "href", "srcset", "action", "poster", "data"):
                value = attributes.get(name)
                assert value is None or value.startswith(("data:image/", "#")), value
        names = [name for name, _ in page.elements]
        assert "link" not in names
        assert "iframe" not in names
        text = (evaluation / "report.html").read_text(encoding="utf-8")
        style = re.search(r"<style>(.*?)</style>", text, re.DOTALL)
        assert style
        assert "prefers-color-scheme: dark" in style[1]
        assert "url(" not in style[1]
        assert "@import" not in style[1]
        assert not re.search(r"https?://", re.sub(r'src="data:[^"]*"', "", text))

    def test_pictures_have_words_and_their_size(self, page: Page, evaluation: Path) -> None:
        images = page.all("img")
        kinds = [(i["src"] or "").split(";")[0] for i in images]
        files = [path.suffix for path in (evaluation / "figures").iterdir()]
        assert kinds.count("data:image/svg+xml") == files.count(".svg") >= 8
        assert kinds.count("data:image/webp") == files.count(".png") == 4  # strip, breakdown, comparison, room
        assert all(i["alt"] and int(i["width"] or 0) > 50 and int(i["height"] or 0) > 50 for i in images)
        first = (evaluation / "figures" / "calibration-7-scenes.svg").read_text()
        points = re.search(r'<svg[^>]* width="([0-9.]+)pt"', first)
        assert points
        assert images[0]["width"] == str(round(float(points[1]) * 4 / 3))

    def test_headings_ids_and_contents(self, page: Page) -> None:
        ids = [a["id"] for _, a in page.elements if "id" in a]
        assert len(set(ids)) == len(ids)
        links = [a["href"] for a in page.all("a")]
        assert links == [f"#{name}" for name in ids]
        assert len(links) >= 8
        levels = [int(name[1]) for name, _ in page.elements if re.fullmatch(r"h[1-6]", name)]
        assert levels.count(1) == 1
        in_main = levels[levels.index(1) :]
        assert all(b <= a + 1 for a, b in pairwise(in_main))
        assert page.all("html") == [{"lang": "en"}]
        assert any(a.get("name") == "viewport" for a in page.all("meta"))

    def test_hostile_names_stay_text(self, page: Page) -> None:
        assert len(page.all("script")) == 1
        assert "b" not in {name for name, a in page.elements if name == "b" and a}
        assert TITLE in page.text
        problems = next(t for t in page.tables if t and t[0] == ["data set", "sequence", "reason"])
        assert problems[1] == ["tum", "fr1_xyz", HOSTILE]
        assert f"{KITCHEN[1]}, frame 7" in page.text
        assert any(KITCHEN[1] in (i["alt"] or "") for i in page.all("img"))

    def test_numbers_are_the_results(self, page: Page, results: Results) -> None:
        main = next(n for n, t in enumerate(page.tables) if t and t[-1][0] == "UfM*-Ensemble" and t[0][0] == "")
        heads = page.tables[main][1]
        assert heads[:5] == ["Method", "δ₁ ↑", "NLL ↓", "ECE_δ ↓", "ECE_q ↓"]
        assert heads[6:9] == ["paper: δ₁", "paper: NLL", "paper: ECE_δ"]  # for who scrolls to them
        for row in results.rows:
            cells = page.row(row.method.name, main)
            for column, (key, decimals) in enumerate({"delta1": 3, "nll": 2, "ece_delta": 3, "ece_q": 3}.items(), 1):
                mean, half = mean_and_ci([float(r.figures[key] or math.nan) for r in results.of(row)])
                value, _, interval = cells[column].replace("\u202f", "").replace("−", "-").partition("±")
                assert value == f"{mean:.{decimals}f}"
                assert interval in ("", f"{half:.{decimals}f}")
        # The paper's own row of table 1 stands beside ours.
        paper = [cell.replace("\u202f", " ") for cell in page.row("UfM*-Ensemble", main)[6:10]]
        assert paper == ["0.68", "0.96 ± 0.19", "0.12 ± 0.02", "0.13 ± 0.02"]

    def test_sentences_problems_and_how_it_was_made(self, page: Page, results: Results) -> None:
        for sentence in [*headlines(results), *caveats(results)]:
            assert re.sub(r"(?<![\w.–-])-(?=\d)", "−", sentence) in page.text
        assert "n = 6: the figures are means over 6 sequences" in page.text
        board = next(t for t in page.tables if t and t[0][0] == "UfM*, beside")
        assert [row[0] for row in board[1:]] == [
            "UfM*-Ensemble beside Ensemble, 6 sequences",
            "UfM*-Ensemble beside UfM-Ensemble-100K, 6 sequences",
        ]
        verdicts = [c.verdict for c in next(iter(comparisons(results).values()))]
        assert [cell.split(" ")[0] for cell in board[1][1:]] == verdicts
        assert "2 × pose is not finite" in page.text
        assert LATER[1] in page.text
        assert "ufmstar eval --suite paper-table-1 --root 7-scenes=DIR --root scannet=DIR --root tum=DIR" in page.text

    def test_a_figure_that_fails_does_not_lose_the_page(
        self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
    ) -> None:
        out = write_evaluation(tmp_path / "o", rows_of("Ensemble", "UfM*-Ensemble"), [("rooms", "a")], suite="own")

        def broken(*_: object) -> None:
            raise ValueError("no <b>such</b> glyph")

        monkeypatch.setattr("ufmstar_torch.eval.report.figures_curves.draw_entropy", broken)
        assert cli.main(["report", str(out)]) == 0
        assert "figure not drawn: entropy ensemble: no <b>such</b> glyph\n" in capsys.readouterr().out
        page = Page((out / "report.html").read_text(encoding="utf-8"))
        undrawn = next(t for t in page.tables if t and t[0] == ["figure", "reason"])
        assert undrawn[1] == ["entropy ensemble", "no <b>such</b> glyph"]
        assert len(page.all("img")) >= 4

    def test_the_command_has_networks_and_what_was_chosen(self) -> None:
        files = [{"name": "m0.safetensors"}, {"name": "m.safetensors", "member": 0}]
        networks = {"aleatoric": {"model": "trained", "files": files}}
        about = {"suite": "depth-only", "datasets": ["tum"], "networks": networks}
        begin = "ufmstar eval --suite depth-only --root tum=DIR "
        begin += "--network aleatoric=trained:DIR/m0.safetensors,DIR/m.safetensors#0"
        for settings, words in (
            ({}, ""),
            ({"frames": [None, None, None], "confident": 0.5}, " --confident 0.5"),
            ({"frames": [0, 8, None], "trajectory": "slam.txt", "depth_scale": 0.001},
             " --frames 0:8: --trajectory slam.txt --depth-scale 0.001"),
        ):  # fmt: skip
            assert command({**about, "settings": settings}) == f"{begin}{words} --out OUT"

    def test_pictures_that_do_not_fit_are_named(self, tmp_path: Path) -> None:
        results = replace(results_of({"Ensemble": ALONE}), out=tmp_path)
        figures_ = [tmp_path / "calibration-x.svg", tmp_path / "unknown-y.svg"]
        for path in figures_:
            path.write_text('<svg width="90pt" height="45.0pt" xmlns="x"><g/></svg>')
        small = Page(write_page(results, figures_, [], most_bytes=10).read_text(encoding="utf-8"))
        assert small.all("img") == []
        assert "2 pictures did not fit into this page: calibration-x.svg, unknown-y.svg." in small.text
        assert "Further diagrams" in Page(write_page(results, figures_, []).read_text(encoding="utf-8")).text

    @pytest.mark.parametrize("name", ["a.svg", "a.gif"])
    def test_embedding_refuses_other_files(self, tmp_path: Path, name: str) -> None:
        (tmp_path / name).write_text("<svg/>")
        with pytest.raises(ValueError, match="a picture must be an SVG"):
            write_page(replace(results_of({"Ensemble": ALONE}), out=tmp_path), [tmp_path / name], [])

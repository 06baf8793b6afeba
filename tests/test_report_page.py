"""The page: well-formed, alone in the world, with the results' numbers, and sentences that say what they say."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping, Sequence
from html.parser import HTMLParser
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from evaluations import rows_of, write_evaluation
from PIL import Image

from ufmstar_torch.eval.metrics import mean_and_ci
from ufmstar_torch.eval.report.caveats import caveats
from ufmstar_torch.eval.report.embed import Embedder
from ufmstar_torch.eval.report.findings import best_rows, compare, comparisons, headlines
from ufmstar_torch.eval.report.load import Failed, Results, load_results
from ufmstar_torch.eval.report.markup import Ids, Markup, join, tag, typeset
from ufmstar_torch.eval.report.page import write_page
from ufmstar_torch.eval.report.page_parts import command
from ufmstar_torch.eval.report.picture import STRIP, Picture, write_index
from ufmstar_torch.eval.results.record import Record

VOID = {"br", "hr", "img", "meta", "input"}
HOSTILE = "<script>alert('x')</script>&\"amp;"


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
        return [attributes for found, attributes in self.elements if found == name]

    @property
    def text(self) -> str:
        return re.sub(r"[\s\u202f]+", " ", " ".join(self.words))

    def row(self, label: str, table: int) -> list[str]:
        return next(row for row in self.tables[table] if row and row[0] == label)


def results_of(
    values: Mapping[str, Sequence[Mapping[str, float]]], *, datasets: Sequence[str] | None = None, **changes: Any
) -> Results:
    """Figures of methods, sequence by sequence."""
    records = tuple(
        Record("own", datasets[n] if datasets else "d", f"s{n}", "FastDepth", method, figures=dict(figures))
        for n in range(max(map(len, values.values())))
        for method, found in values.items()
        for figures in found[n : n + 1]
    )
    rows = [{"method": method, "setting": {}} for method in values]
    return Results(Path("nowhere"), {"suite": "own", "title": "T", "rows": rows}, records, **changes)


def figures(nll: float, ece: float = 0.2, spearman: float = 0.5, delta1: float = 0.8) -> dict[str, float]:
    return {"nll": nll, "ece_delta": ece, "ece_q": ece, "ause_rmse": 0.3, "spearman": spearman, "delta1": delta1}


ALONE = [figures(2.0), figures(3.0), figures(4.0)]


class TestFindings:
    def test_wins_beyond_chance(self) -> None:
        star = [figures(1.0, 0.1), figures(2.1, 0.11), figures(2.9, 0.09)]
        results = results_of({"Ensemble": ALONE, "UfM*-Ensemble": star})
        mean, half = mean_and_ci([-1.0, -0.9, -1.1])
        (made,) = comparisons(results).values()
        assert {c.quantity.key: c.verdict for c in made} == {
            "nll": "better", "ece_delta": "better", "ece_q": "better", "ause_rmse": "open", "spearman": "open",
        }  # fmt: skip
        assert made[0].words == f"NLL 3.00 → 2.00 ({mean:.2f} ± {half:.2f})"
        first, losses = headlines(results)
        assert first.startswith("UfM* against the network alone, 3 comparisons of NLL, ECE_δ and ECE_q: ")
        assert "better in 3, worse in 0, not to be told apart in 0" in first
        assert first.endswith("On average NLL falls by 1.00, ECE_δ falls by 50 % and ECE_q falls by 50 %.")
        assert losses.startswith("In none of all 5 comparisons")
        (best,) = (s for s in best_rows(results) if s.startswith("Best NLL"))
        assert (
            best
            == f"Best NLL: UfM*-Ensemble with 2.00, before Ensemble (3.00; a lead beyond chance, -1.00 ± {half:.2f})."
        )

    def test_losses_are_told(self) -> None:
        star = [figures(3.0, spearman=0.3), figures(4.1, spearman=0.31), figures(4.9, spearman=0.29)]
        results = results_of({"Ensemble": ALONE, "UfM*-Ensemble": star})
        first, losses = headlines(results)
        assert "better in 0, worse in 1, not to be told apart in 2" in first
        assert "NLL rises by 1.00" in first
        assert losses.startswith(
            "UfM* is worse beyond chance in 2 of all 5 comparisons: UfM*-Ensemble against Ensemble: NLL"
        )
        assert "Spearman 0.50 → 0.30 (-0.20 ±" in losses
        assert any(s.startswith("Best Spearman: Ensemble with 0.50") for s in best_rows(results))

    def test_ties_within_the_interval(self) -> None:
        star = [figures(1.0), figures(4.0), figures(3.7)]
        results = results_of({"Ensemble": ALONE, "UfM*-Ensemble": star})
        first, losses = headlines(results)
        assert "better in 0, worse in 0, not to be told apart in 3" in first
        assert losses.startswith("In none of all 5")
        assert any("a lead that may be chance" in s for s in best_rows(results) if s.startswith("Best NLL"))
        assert "Best AUSE: 0.300 m, shared by Ensemble and UfM*-Ensemble." in best_rows(results)

    def test_a_difference_that_prints_as_zero_is_open(self) -> None:
        star = [figures(f["nll"] - 1e-4) for f in ALONE]
        (made,) = comparisons(results_of({"Ensemble": ALONE, "UfM*-Ensemble": star})).values()
        assert made[0].difference.beyond
        assert made[0].verdict == "open"

    def test_one_sequence_decides_nothing(self) -> None:
        results = results_of({"Ensemble": ALONE[:1], "UfM*-Ensemble": [figures(1.0)]})
        first, losses = headlines(results)
        assert "the better value in 1, on a single sequence, which decides nothing" in first
        assert losses.startswith("With one sequence nothing can be said")
        assert any("one sequence" in c for c in caveats(results))

    def test_means_are_over_the_sequences_that_both_have(self) -> None:
        results = results_of({"Ensemble": ALONE, "UfM*-Ensemble": [figures(1.0), figures(2.0)]})
        rows = results.rows
        c = compare(results, rows[1], rows[0])[0]
        assert (c.mine, c.theirs, c.difference.value, c.difference.sequences) == (1.5, 2.5, -1.0, 2)
        assert best_rows(results) == []  # means over different sequences are not compared

    def test_against_ufm_and_only_where_there_is_a_variance(self) -> None:
        values = {"DepthOnly": [{"delta1": 0.8}] * 3, "UfM-DepthOnly-100K": ALONE, "UfM*-DepthOnly": ALONE}
        sentences = headlines(results_of(values))
        assert sentences[0].startswith("UfM* against UfM, 3 comparisons")
        assert not any("network alone" in s for s in sentences)

    def test_settings_of_an_ablation(self) -> None:
        results = results_of({"UfM*-Ensemble": ALONE})
        changed = tuple(
            Record(
                "own",
                "d",
                f"s{n}",
                "FastDepth",
                "UfM*-Ensemble",
                {"ema_alpha": 1.0},
                figures=figures(n + 1.0 + 0.01 * n),
            )
            for n in range(3)
        )
        both = Results(results.out, results.about, (*results.records, *changed))
        (nll, *_) = (s for s in headlines(both) if s.startswith("NLL"))
        assert nll.startswith(
            "NLL, of 1 setting beside the default: better with 1 (UfM*-Ensemble, smoothing α 1 -0.99 ±"
        )
        assert nll.endswith("worse with 0, not to be told apart with 0.")

    def test_caveats(self) -> None:
        poor = {"Ensemble": [figures(2.0, delta1=0.2) | {"nll_left_out_share": 0.25}] * 2}
        failed = (Failed("d", "x", "broken"),)
        results = results_of(poor, failed=failed, missing=(("d", "y", rows_of("Ensemble")[0]),))
        told = " ".join(caveats(results))
        for words in ("Left out, because of errors: 1 sequence;", "rows of 1 sequence are still", "On d only 20 %"):
            assert words in told
        assert "Ensemble 25 %" in told
        assert caveats(results_of({"Ensemble": [figures(2.0)] * 2})) == []


class TestMarkup:
    def test_text_is_escaped_and_markup_is_not(self) -> None:
        inner = tag("b", "<i>")
        assert tag("p", inner, " & ", class_="x", title='"<') == (
            '<p class="x" title="&quot;&lt;"><b>&lt;i&gt;</b> &amp; </p>'
        )
        assert join("<", inner) == "&lt;<b>&lt;i&gt;</b>"
        assert tag("img", src="data:", hidden=True, alt=None) == '<img src="data:" hidden>'

    def test_minus_signs(self) -> None:
        assert typeset("a -0.5, UfM-100K, 3-4, <") == "a −0.5, UfM-100K, 3-4, &lt;"
        assert isinstance(typeset("x"), Markup)

    def test_ids_are_unique(self) -> None:
        ids = Ids()
        assert [ids.new("A b"), ids.new("a, b"), ids.new("δ")] == ["a-b", "a-b-2", "part"]


@pytest.fixture(scope="module")
def evaluation(tmp_path_factory: pytest.TempPathFactory) -> tuple[Results, list[Path], Path]:
    """An evaluation with a failure, an unfinished and a hostile sequence, two figures and a picture."""
    out = tmp_path_factory.mktemp("page") / "out"
    rows = rows_of("Ensemble", "UfM-Ensemble-100K", "UfM*-Ensemble")
    sequences = [("scannet", "a"), ("scannet", "b"), ("tum", "c")]
    write_evaluation(
        out, rows, sequences, title=f"Title {HOSTILE}", unfinished=[("tum", "later")], failed={("tum", "bad"): HOSTILE}
    )
    folder = out / "figures"
    folder.mkdir()
    (folder / "calibration-scannet.svg").write_text('<svg width="90pt" height="45.0pt" xmlns="x"><g/></svg>')
    (folder / "calibration-sequences-tum-x.svg").write_text('<svg width="8pt" height="8pt" xmlns="x"><g/></svg>')
    for name in ("strip.png", "stale.png"):
        Image.fromarray(np.zeros((20, 30, 3), np.uint8)).save(folder / name)
    index = [
        Picture(name, STRIP, f"{HOSTILE} {name}", "caption", f"alt {HOSTILE}") for name in ("strip.png", "stale.png")
    ]
    index_file = write_index(folder, index)
    drawn = [folder / name for name in ("calibration-sequences-tum-x.svg", "calibration-scannet.svg", "strip.png")]
    files = [out / "results.csv", *drawn, index_file]
    results = load_results(out, with_sums=False)
    return results, files, write_page(results, out, files)


@pytest.fixture(scope="module")
def page(evaluation: tuple[Results, list[Path], Path]) -> Page:
    return Page(evaluation[2].read_text(encoding="utf-8"))


class TestPage:
    def test_it_needs_nothing_else(self, page: Page, evaluation: tuple[Results, list[Path], Path]) -> None:
        for _, attributes in page.elements:
            for name in ("src", "href", "srcset", "action", "poster", "data"):
                value = attributes.get(name)
                assert value is None or value.startswith(("data:image/", "#")), value
        names = [name for name, _ in page.elements]
        assert "link" not in names
        assert "iframe" not in names
        text = evaluation[2].read_text(encoding="utf-8")
        style = re.search(r"<style>(.*?)</style>", text, re.DOTALL)
        assert style
        assert "url(" not in style[1]
        assert "@import" not in style[1]
        assert not re.search(r"https?://", re.sub(r'src="data:[^"]*"', "", text))
        assert evaluation[2].stat().st_size < 200_000

    def test_pictures_have_words_and_only_what_was_written_is_shown(self, page: Page) -> None:
        images = page.all("img")
        assert [i["src"].split(";")[0] for i in images if i["src"]] == [*["data:image/svg+xml"] * 2, "data:image/webp"]
        assert all(i["alt"] for i in images)
        assert (images[0]["width"], images[0]["height"]) == ("120", "60")  # 90 x 45 points
        assert (images[2]["width"], images[2]["height"]) == ("30", "20")
        assert images[2]["alt"] == f"alt {HOSTILE}"

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
        assert f"Title {HOSTILE}" in page.text
        problems = next(t for t in page.tables if t and t[0] == ["data set", "sequence", "reason"])
        assert problems[1] == ["tum", "bad", HOSTILE]

    def test_numbers_are_the_results(self, page: Page, evaluation: tuple[Results, list[Path], Path]) -> None:
        results = evaluation[0]
        main = next(n for n, t in enumerate(page.tables) if t and t[-1][0] == "UfM*-Ensemble" and t[0][0] == "")
        heads = page.tables[main][1]
        assert heads[:5] == ["Method", "δ₁ ↑", "NLL ↓", "ECE_δ ↓", "ECE_q ↓"]
        for row in results.rows:
            told = page.row(row.method.name, main)
            for column, (key, decimals) in enumerate({"delta1": 3, "nll": 2, "ece_delta": 3, "ece_q": 3}.items(), 1):
                mean, half = mean_and_ci([float(r.figures[key] or math.nan) for r in results.of(row)])
                value, _, interval = told[column].replace("\u202f", "").replace("−", "-").partition("±")
                assert value == f"{mean:.{decimals}f}"
                assert interval in ("", f"{half:.{decimals}f}")
        # The paper's own row of table 1 stands beside ours.
        assert page.row("UfM*-Ensemble", main)[6:10] == [
            "0.68",
            "0.96\u202f±\u202f0.19",
            "0.12\u202f±\u202f0.02",
            "0.13\u202f±\u202f0.02",
        ]

    def test_sentences_problems_and_how_it_was_made(
        self, page: Page, evaluation: tuple[Results, list[Path], Path]
    ) -> None:
        results = evaluation[0]
        for sentence in [*headlines(results), *caveats(results)]:
            plain = re.sub(r"(?<![\w.–-])-(?=\d)", "−", sentence)
            assert plain in page.text
        board = next(t for t in page.tables if t and t[0][0] == "UfM*, beside")
        assert [row[0] for row in board[1:]] == [
            "UfM*-Ensemble beside Ensemble, 3 sequences",
            "UfM*-Ensemble beside UfM-Ensemble-100K, 3 sequences",
        ]
        verdicts = [c.verdict for c in next(iter(comparisons(results).values()))]
        assert [cell.split(" ")[0] for cell in board[1][1:]] == verdicts
        assert "2 × pose is not finite" in page.text
        assert "later" in page.text
        assert "ufmstar eval --suite paper-table-1 --root scannet=DIR --root tum=DIR" in page.text
        assert "stale" not in page.text

    def test_the_command_names_networks(self) -> None:
        network = {"model": "trained", "files": [{"name": "m0.safetensors"}, {"name": "m1.safetensors"}]}
        about = {"suite": "depth-only", "datasets": ["tum"], "networks": {"ensemble": network}}
        wanted = "--network ensemble=trained:DIR/m0.safetensors,DIR/m1.safetensors --out OUT"
        assert command(about) == f"ufmstar eval --suite depth-only --root tum=DIR {wanted}"

    def test_the_command_has_what_was_chosen(self) -> None:
        network = {"model": "trained", "files": [{"name": "m.safetensors", "member": 0}]}
        about = {"suite": "depth-only", "datasets": ["tum"], "networks": {"aleatoric": network}}
        begin = "ufmstar eval --suite depth-only --root tum=DIR --network aleatoric=trained:DIR/m.safetensors#0"
        for settings, words in (
            ({"frames": [None, None, None], "confident": 0.5}, "--confident 0.5"),
            ({"frames": [0, 8, None], "trajectory": "slam.txt", "depth_scale": 0.001},
             "--frames 0:8: --trajectory slam.txt --depth-scale 0.001"),
        ):  # fmt: skip
            assert command({**about, "settings": settings}) == f"{begin} {words} --out OUT"

    def test_pictures_that_do_not_fit_are_named(
        self, evaluation: tuple[Results, list[Path], Path], tmp_path: Path
    ) -> None:
        results, files, _ = evaluation
        (tmp_path / "figures").mkdir()
        small = Page(write_page(results, tmp_path, files, most_bytes=10).read_text(encoding="utf-8"))
        assert small.all("img") == []
        assert "3 pictures did not fit into this page: calibration-scannet.svg, calibration-seq" in small.text

    def test_embedding_refuses_other_files(self, tmp_path: Path) -> None:
        (tmp_path / "a.svg").write_text("<svg/>")
        (tmp_path / "a.gif").write_bytes(b"GIF")
        for name in ("a.svg", "a.gif"):
            with pytest.raises(ValueError, match="a picture must be an SVG"):
                Embedder().take(tmp_path / name)

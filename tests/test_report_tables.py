"""Tables and tidy results of a report, against numbers computed by hand or from the paper."""

from __future__ import annotations

import csv
import json
import re

import numpy as np
import pytest
import torch
from evaluations import (
    ENSEMBLE,
    HOSTILE,
    KITCHEN,
    LATER,
    NETWORK,
    SCENES,
    TITLE,
    check_latex,
    draw_maps,
    in_memory,
    parsed,
    rows_of,
    write_evaluation,
    write_sequence,
)
from shared_data import require_shared
from test_efficiency_table import line as measured_line

from ufmstar_torch import cli
from ufmstar_torch.eval.bench.measure import over_sequences
from ufmstar_torch.eval.engine.record import ResultsError
from ufmstar_torch.eval.methods.method import Method
from ufmstar_torch.eval.methods.row import Row
from ufmstar_torch.eval.methods.setting import setting_from
from ufmstar_torch.eval.methods.suite import names, suite_named
from ufmstar_torch.eval.metrics import SequenceMetrics, mean_and_ci
from ufmstar_torch.eval.report.data import load_results
from ufmstar_torch.eval.report.paper import paper_tables
from ufmstar_torch.eval.report.quantities import row_labels
from ufmstar_torch.eval.report.table import Table, csv_text, number, significant, typeset
from ufmstar_torch.eval.report.tables import all_tables, extra_table, main_table, write_tables
from ufmstar_torch.eval.report.text import summary
from ufmstar_torch.eval.report.write import write_report

ALONE, UFM, _, UFM_STAR = ENSEMBLE
SECOND = "records/scannet/x/Ensemble.json"


def test_a_mixture_and_intervals_have_columns_where_a_row_states_them():
    plain = {(row, ("d", "s")): {"rmse": 0.5} for row in (ALONE, UFM_STAR)}
    stated = {"mixture_nll": 0.25, "mixture_coverage": 0.99, "coverage_50": 0.52, "coverage_90": 0.905}
    extended = extra_table(in_memory(plain | {(UFM_STAR, ("d", "s")): {"rmse": 0.5, **stated}}))
    before = extra_table(in_memory(plain)).cells.columns
    new = [heading for _, heading in extended.cells.columns if ("", heading) not in before]
    shares = ["mixture: within 3 σ [%]", "in the 50 % interval [%]", "in the 90 % interval [%]"]
    assert new == ["mixture: NLL ↓", *shares]
    assert list(extended.cells.iloc[1][-4:]) == ["0.25", "99.0", "52.0", "90.5"]


class TestMainTable:
    def test_intervals_begin_with_two_sequences(self, results):
        assert main_table(results, "7-scenes").notes[1] == "One sequence: no confidence intervals."
        four = in_memory({(row, ("d", s)): {"nll": ord(s) / 9} for row in (ALONE, UFM_STAR) for s in "abcd"})
        assert "Student's interval of 4 sequences is wide and rests on normality" in main_table(four).notes[1]
        mean, half = mean_and_ci([ord(s) / 9 for s in "abcd"])
        assert list(main_table(four).cells["", "NLL ↓"]) == [f"{mean:.2f} ± {half:.2f}"] * 2
        assert f"{mean:.2f} ± {half:.2f}" in main_table(four).text()
        five = in_memory({(row, ("d", s)): {"nll": ord(s) / 9} for row in (ALONE, UFM_STAR) for s in "abcde"})
        assert "normality" not in main_table(five).notes[1]

    def test_the_best_of_each_base_is_bold(self):
        values = {"Ensemble": 2.0, "UfM*-Ensemble": 1.0, "Aleatoric": 0.5, "UfM*-Aleatoric": 0.7}
        figures = {(Row(Method.parse(n)), ("d", "s")): {"nll": v, "delta1": 0.7} for n, v in values.items()}
        table = main_table(in_memory(figures))
        assert list(table.best["", "NLL ↓"]) == [False, True, True, False]
        assert [block for block, _ in table.cells.index] == [0, 0, 1, 1]
        assert not any(table.best["", "δ₁ ↑"])  # all alike
        assert table.latex().count(r"\bfseries 1.00") == table.latex().count(r"\bfseries 0.50") == 1
        assert table.html().count("font-weight: bold") == 2

    def test_rows_over_different_sequences_are_not_compared(self):
        figures = {(row, ("d", s)): {"nll": v} for row, s, v in ((ALONE, "a", 1.0), (ALONE, "b", 3.0), (UFM, "a", 1.5))}
        table = main_table(in_memory(figures))
        assert list(table.cells["", "sequences"]) == ["2", "1"]
        assert table.best is None
        assert any("different sequences" in note for note in table.notes)
        assert not any(group == "Paper" for group, _ in table.cells.columns), "a user's suite"

    def test_a_network_of_depth_alone_has_dashes(self, tmp_path):
        rows = rows_of("DepthOnly", "UfM*-DepthOnly")
        result = load_results(write_evaluation(tmp_path / "o", rows, SCENES[:1], suite="depth-only"))
        cells = parsed(main_table(result))
        assert cells["DepthOnly"]["NLL ↓"] == cells["DepthOnly"]["ECE_q ↓"] == ""
        assert cells["DepthOnly"]["δ₁ ↑"] == cells["UfM*-DepthOnly"]["δ₁ ↑"] != ""
        assert " – " in main_table(result).text()


def test_significant_digits():
    values = (0.0256, 4.0, 76.04, 1319.4, 0.0)
    assert [number(v, significant(v)) for v in values] == ["0.0256", "4.00", "76.0", "1319", "0"]


class TestLatex:
    def test_structure(self, evaluation):
        for path in sorted((evaluation / "tables").glob("*.tex")):
            for text in path.read_text().split("% needs")[1:]:
                check_latex(text)

    def test_cells_as_the_paper_sets_them(self):
        columns = [("Ours", "NLL ↓"), ("Ours", "ECE_δ"), ("Paper", "ECE_q")]
        lines = [(block, "UfM*-MCD", ("0.96 ± 0.19", "0.12", "")) for block in (0, 1)]
        text = Table.of("t", "A & B", lines, columns).latex()
        assert r"UfM$^*$-MCD & 0.96 $\pm$ 0.19 & 0.12 & -- \\" in text
        assert r" & \multicolumn{2}{c}{Ours} & Paper \\" in text
        assert r" & NLL $\downarrow$ & ECE$_{\delta}$ & ECE$_{q}$ \\" in text
        assert text.count(r"\addlinespace") == 1
        assert r"\caption{A \& B.}" in text


class TestTextOfUsers:
    """Folder names and suite titles never become markup, links or formulas."""

    def test_html(self):
        assert typeset("a <b> & -1 ± 2 %") == "a &lt;b&gt; &amp; −1\u202f±\u202f2\u202f%"
        page = Table.of("<n>", "<t>", [(0, "<l>", ("<c>",))], [("<g>", "<h>")]).html()
        assert not re.search("<[ntlcgh]>", page)

    @pytest.mark.parametrize("text", ["=1+1", "+cmd|' /C calc'!A0", "-a", "@SUM(A1)", "\tx"])
    def test_csv(self, text):
        assert csv_text(text) == f"'{text}"
        assert [csv_text(plain) for plain in ("-1.5", "+3", "a=b", "", None)] == ["-1.5", "+3", "a=b", "", ""]

    def test_in_the_files(self, tmp_path):
        sequences = [("d", "=HYPERLINK(1)"), ("d", "[x](https://y)")]
        out = write_evaluation(tmp_path / "o", ENSEMBLE[:1], sequences, title="[t](http://u)")
        write_report(out, figures=False)
        with (out / "results.csv").open() as file:
            assert {line["sequence"] for line in csv.DictReader(file)} == {"'=HYPERLINK(1)", "[x](https://y)"}


class TestSums:
    def test_merged_sums_are_the_metrics_of_all_pixels_together(self, results):
        maps = [draw_maps(UFM_STAR, sequence) for _, sequence in SCENES]
        together = SequenceMetrics()
        together.update(*(torch.cat(parts) for parts in zip(*maps, strict=True)))
        merged = results.merged["scannet", UFM_STAR]
        for name, curve in together.curves().items():
            assert merged[name] == pytest.approx(curve, rel=1e-12, nan_ok=True), name
        references = {name for name in merged if name.startswith("nll_by_error")}
        names = ("Ensemble", "UfM-Ensemble-100K")
        assert references == {f"nll_by_error:{name}" for name in names}

    def test_the_same_bits_whoever_wrote_what(self, results, evaluation, tmp_path):
        other = write_evaluation(tmp_path / "o", ENSEMBLE, [], title=TITLE, unfinished=[*SCENES, KITCHEN, LATER])
        for dataset, sequence in [KITCHEN, *reversed(SCENES)]:
            write_sequence(other, "paper-table-1", dataset, sequence, ENSEMBLE[::-1])
        again = load_results(other)
        assert again.records == results.records
        assert again.merged.keys() == results.merged.keys()
        for key, merged in again.merged.items():
            # As text, since the NaN of an empty bin is unequal to itself.
            assert repr(sorted(merged.items())) == repr(sorted(results.merged[key].items()))
        write_report(other, figures=False)
        assert (other / "results.csv").read_bytes() == (evaluation / "results.csv").read_bytes()
        assert (other / "tables" / "main.tex").read_bytes() == (evaluation / "tables" / "main.tex").read_bytes()


class TestTidy:
    def test_a_line_for_each_figure(self, results, evaluation):
        with (evaluation / "results.csv").open() as file:
            lines = list(csv.DictReader(file))
        for record in results.records:
            mine = [line for line in lines if (line["method"], line["sequence"]) == (record.method, record.sequence)]
            result = {line["figure"]: float(line["value"]) for line in mine}
            assert {name: result[name] for name in record.figures} == record.figures  # bit for bit
            assert result["frames.skipped"] == 2
            assert result["ms.network"] == record.ms["network"]
            assert {line["network"] for line in mine} == {NETWORK}


class TestLoading:
    def test_unfinished_and_failed(self, results):
        assert {(dataset, sequence) for dataset, sequence, _ in results.missing} == {("scannet", "scene0009_00")}
        message = summary(results)
        assert f"tum, fr1_xyz: {HOSTILE}" in message
        assert "scannet, scene0009_00: 4 row(s)" in message
        assert results.datasets == ("7-scenes", "scannet")
        assert results.rows == tuple(ENSEMBLE)

    @pytest.mark.parametrize("name", names())
    def test_settings_survive_their_dict(self, name):
        for row, label in row_labels(suite_named(name).rows).items():
            assert setting_from(json.loads(json.dumps(row.setting.to_dict()))) == row.setting
            assert label == row.title if row.title else label.startswith(row.method.name)

    @pytest.mark.parametrize(
        ("file", "change", "match"),
        [
            ("eval.json", {"format": 99}, r"eval\.json is not the description"),
            ("eval.json", {"rows": [{"method": "Oracle"}]}, "no method is called 'Oracle'"),
            (SECOND, {"sequence": "x", "network": "Other"}, "mixed networks.*FastDepth in .*Other in "),
            (SECOND, {"format": 1}, r"Ensemble\.json is not a record of format 2"),
            (SECOND, {"method": "Oracle"}, r"Ensemble\.json: no method is called 'Oracle'"),
            (SECOND, {"setting": {"skip": -1}}, r"Ensemble\.json: Setting\.skip must lie"),
        ],
    )
    def test_what_does_not_belong_together_is_refused(self, tmp_path, file, change, match):
        write_evaluation(tmp_path, [ALONE], SCENES[:1])
        first = tmp_path / ("eval.json" if file == "eval.json" else f"records/scannet/{SCENES[0][1]}/Ensemble.json")
        (tmp_path / file).parent.mkdir(exist_ok=True)
        (tmp_path / file).write_text(json.dumps({**json.loads(first.read_text()), **change}))
        with pytest.raises(ResultsError, match=match):
            load_results(tmp_path)

    def test_an_evaluation_without_a_record_is_refused(self, tmp_path):
        write_evaluation(tmp_path, ENSEMBLE, [], unfinished=SCENES)
        with pytest.raises(ResultsError, match="no finished sequence"):
            load_results(tmp_path)

    def test_sums_that_are_gone_or_broken(self, tmp_path):
        write_evaluation(tmp_path, ENSEMBLE[:2], SCENES[:2])
        sums = tmp_path / "records" / "scannet" / SCENES[1][1] / "Ensemble.npz"
        content = sums.read_bytes()
        sums.unlink()
        result = load_results(tmp_path)
        assert set(result.merged) == {("scannet", UFM)}
        assert len(result.notes) == 1
        assert "Ensemble.npz is not there" in result.notes[0]
        sums.write_bytes(content[:100])
        with pytest.raises(ResultsError, match=r"Ensemble\.npz does not hold the sums"):
            load_results(tmp_path)
        np.savez(sums, **{"metrics/metrics.NLL.total": np.zeros(7)})
        with pytest.raises(ResultsError, match=r"Ensemble\.npz holds sums of other metrics"):
            load_results(tmp_path)
        assert load_results(tmp_path, with_sums=False).merged == {}


class TestCommand:
    def test_prints_the_main_table(self, evaluation, capsys):
        assert cli.main(["report", str(evaluation), "--no-figures"]) == 0
        (line,) = (line for line in capsys.readouterr().out.splitlines() if line.startswith("UfM*-Ensemble"))
        assert "0.96 ± 0.19" in line
        assert (evaluation / "tables" / "main-scannet.tex").is_file()

    def test_what_a_killed_report_left_is_removed(self, tmp_path):
        out = write_evaluation(tmp_path, ENSEMBLE[:1], SCENES[:1])
        temporary, of_eval = out / ".results.csv.0123456789ab.tmp", out / ".eval.json.0123456789ab.tmp"
        for path in (temporary, of_eval):
            path.write_text("half")
        write_report(out, figures=False)
        assert (temporary.exists(), of_eval.exists()) == (False, True)

    def test_wrong_usage(self, tmp_path, capsys):
        assert cli.main(["report", str(tmp_path)]) == 2
        assert "no folder of `ufmstar eval`: it has no eval.json" in capsys.readouterr().err
        assert cli.main(["report", str(tmp_path), "--format", "jpg"]) == 2


PAPER_2 = [table for table in paper_tables() if table.number == 2]


class TestThePapersNumbers:
    """Every number of the four tables, against an independent parser of the paper's LaTeX source."""

    @staticmethod
    def cells(label: str) -> list[tuple[str, list[str | None]]]:
        source = require_shared("paper/ufmstar.tex").read_text()
        body = source[source.index(rf"\label{{{label}}}") :]
        body = body[body.index(r"\midrule") : body.index(r"\bottomrule")]
        body = re.sub(r"\\(mathbf|textbf|mbox)\{([^{}]*)\}", r"\2", re.sub(r"~?\\cite\{[^}]*\}", "", body))
        rows = []
        for line in body.replace("\\midrule", "").replace("\\addlinespace", "").split("\\\\"):
            cells = [cell.replace("$", "").replace("^*", "*").strip() for cell in line.split("&")]
            if len(cells) > 1:
                values = [None if c == "--" else " ± ".join(p.strip() for p in c.split("\\pm")) for c in cells]
                rows.append((cells, values))
        return [(cells[0], values[1:]) for cells, values in rows]

    @pytest.mark.parametrize(
        ("label", "table"),
        [
            ("tab:benchmarks_uq_and_eff", 0),
            ("tab:depth_anything_v2", 3),
            ("tab:full_ufmstar_summary", 4),
        ],
    )
    def test_tables_1_3_and_4(self, label, table):
        theirs, table = self.cells(label), paper_tables()[table]
        assert [method for method, _ in theirs] == list(table.rows)
        for method, values in theirs:
            assert dict(zip(table.columns, values, strict=True)) == table.rows[method]

    def test_table_2(self):
        rows = []
        for _, values in self.cells("tab:efficiency_in_detail"):
            method = re.sub(r"\\MethodOneLine\{|\}|\\textbf\{", "", values[0])
            numbers = [None if v is None else v.replace("< ", "<") for v in values[1:]]
            rows.append((method.strip(), numbers))
        ours = [(method, row, table) for table in PAPER_2 for method, row in table.rows.items()]
        assert len(rows) == len(ours) == 16
        for (theirs, values), (method, row, table) in zip(rows, ours, strict=True):
            assert theirs == method
            assert {c: v for c, v in zip(table.columns, values, strict=True) if v is not None} == row

    def test_energy_and_memory_stand_in_the_main_table(self):
        runs = {("d", f"s{n}"): measured_line(mvd=(24.0, 50.0 + 10 * n), memory={"mvd": 1}) for n in range(5)}
        figures = {(UFM_STAR, where): {"nll": 1.0} for where in runs}
        result = in_memory({**figures, (UFM_STAR, ("d", "later")): {"nll": 1.0}}, efficiency=over_sequences(runs))
        table = main_table(result)
        cells = parsed(table)["UfM*-Ensemble"]
        half = 2.776 * 250**0.5 / 5**0.5  # Student's t of four degrees of freedom, variance of 0, 10, ..., 40
        assert cells["energy [mJ] ↓"] == f"1927 ± {half:.0f}"  # 1857 of the network, 50 to 90 of the step
        assert cells["memory [MB] ↓"] == "1245"
        assert "on all selected frames of 5 sequences" in table.notes[-1]
        assert result.efficiency["plan"]["frames"] == 500
        assert result.efficiency["rows"][0]["latency"]["multiview"]["median_ms"] == 24.0
        assert result.efficiency["sequence"]["name"] == "5 sequences"
        without = over_sequences({("d", "s"): measured_line(mvd=(24.0, None), dnn=(252.0, None))})
        assert without["sequences"][0]["energy_mj"] == {"UfM*-Ensemble": None}

    def test_memory_is_one_number_in_all_tables(self):
        """The main table adds the network's and the state's columns of the table of efficiency, whatever the records
        have, because both are measured over the same frames."""
        sizes = {("d", "a"): 10e6, ("d", "b"): 30e6}
        networks = {"network_uncertainty_bytes": 5e6}
        runs = {
            where: measured_line(mvd=(24.0, 50.0), memory={"mvd": size, **networks}) for where, size in sizes.items()
        }
        result = in_memory({(UFM_STAR, where): {"nll": 1.0} for where in runs}, efficiency=over_sequences(runs))
        main = parsed(main_table(result))["UfM*-Ensemble"]
        costs = parsed(all_tables(result)["efficiency"][0])["UfM*-Ensemble"]
        assert (costs["Memory: DNN unc. [MB]"], costs["Memory: MVD [MB]"]) == ("5.0", "20.0")
        assert (costs["Memory: MVD, mean [MB]"], costs["Memory: DNN buffers [MB]"]) == ("10.0", "1.0")
        assert main["memory [MB] ↓"].split(" ±")[0] == "25.0"

    def test_table_2_stands_below_what_was_measured(self, tmp_path):
        result = in_memory({(ALONE, ("d", "s")): {"nll": 1.0}}, efficiency=measured_line())
        written = write_tables(tmp_path, all_tables(result))
        assert tmp_path / "efficiency.tex" in written
        ours, theirs = all_tables(result)["efficiency"]
        assert ours.title.startswith("Efficiency of uncertainty, ResNet50-Monodepth2")
        assert theirs.title.startswith("The paper's table 2, ResNet50-Monodepth2")
        assert list(parsed(ours)["Ensemble"]) == list(parsed(theirs)["Ensemble"])  # column below column
        assert parsed(theirs)["Ensemble"]["GPU: Energy [mJ]"] == "1857"

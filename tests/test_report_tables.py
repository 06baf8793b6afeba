"""Tables, paired differences and tidy results of a report, against numbers worked out by hand or from the paper."""

from __future__ import annotations

import csv
import json
import math
from pathlib import Path

import pytest
import torch
from evaluations import NETWORK, check_latex, draw_maps, in_memory, parsed, rows_of, write_evaluation, write_sequence
from hypothesis import given
from hypothesis import strategies as st

from ufmstar_torch import cli
from ufmstar_torch.eval.methods.method import Method
from ufmstar_torch.eval.methods.row import Row
from ufmstar_torch.eval.methods.setting import Setting
from ufmstar_torch.eval.methods.suite import names, suite_named
from ufmstar_torch.eval.metrics import SequenceMetrics
from ufmstar_torch.eval.report.aggregate import better, difference, has_variance, mean_of, references
from ufmstar_torch.eval.report.latex import escape, latex
from ufmstar_torch.eval.report.load import Results, ResultsError, load_results, setting_of
from ufmstar_torch.eval.report.markdown import markdown
from ufmstar_torch.eval.report.names import ECE_DELTA, NLL, SPEARMAN, row_label
from ufmstar_torch.eval.report.table import Cell, Column, Line, Table, mark_best, number
from ufmstar_torch.eval.report.tables import difference_table, extra_table, main_table, sequence_tables
from ufmstar_torch.eval.report.write import summary, write_report

ENSEMBLE = rows_of("Ensemble", "UfM-Ensemble", "UfM-Ensemble-100K", "UfM*-Ensemble")
ALONE, UFM, UFM_100K, UFM_STAR = ENSEMBLE
SCENES = [("scannet", f"scene000{i}_00") for i in range(3)]
KITCHEN = ("7-scenes", "kitchen&_50%")
T_2 = 4.302652729749464  # 97.5 % quantile of Student's t with 2 degrees of freedom, from a table


@pytest.fixture(scope="module")
def out(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("report") / "out"
    failed = {("tum", "fr1_xyz"): "no ground truth"}
    write_evaluation(folder, ENSEMBLE, [*SCENES, KITCHEN], unfinished=[("scannet", "scene0009_00")], failed=failed)
    write_report(folder, figures=False)
    return folder


@pytest.fixture(scope="module")
def results(out: Path) -> Results:
    return load_results(out)


class TestMainTable:
    def test_mean_and_interval_are_those_of_the_records(self, results):
        cells = parsed(markdown(main_table(results, "scannet")))
        for row in ENSEMBLE:
            values = [float(r.figures["nll"]) for r in results.of(row, "scannet")]
            mean = sum(values) / 3
            half = T_2 * math.sqrt(sum((v - mean) ** 2 for v in values) / 2) / math.sqrt(3)
            assert cells[row.method.name]["NLL ↓"] == f"{mean:.2f} ± {half:.2f}"
        assert len({row["NLL ↓"] for row in cells.values()}) == 4

    def test_narrow_intervals_are_left_out_as_in_the_paper(self):
        figures = {(ALONE, ("d", str(i))): {"nll": 1.0, "ece_delta": 0.1 + spread} for i, spread in enumerate((0, 0.1))}
        table = main_table(in_memory(figures))
        assert table.lines[0].cells[1] == Cell("1.00")
        assert table.lines[0].cells[2] == Cell("0.150", "0.635")  # 12.7062 * .0707107 / sqrt(2)

    def test_one_sequence_has_no_interval(self, results):
        table = main_table(results, "7-scenes")
        assert all(cell.half == "" for line in table.lines for cell in line.cells[:5])
        assert "no confidence intervals" in table.notes[1]

    def test_the_papers_figures_stand_beside_ours(self, results):
        cells = parsed(markdown(main_table(results)))["UfM*-Ensemble"]
        assert [cells[f"paper: {n}"] for n in ("δ₁", "NLL", "ECE_δ", "ECE_q", "energy [mJ]", "memory [MB]")] == [
            "0.68", "0.96 ± 0.19", "0.12 ± 0.02", "0.13 ± 0.02", "66 ± 2", "1245",
        ]  # fmt: skip
        assert float(cells["state [MB]"]) == 64 * 400 / 1e6

    def test_no_paper_beside_a_suite_of_ones_own(self):
        table = main_table(in_memory({(ALONE, ("d", "s")): {"nll": 1.0}}))
        assert not any("paper" in column.name for column in table.columns)

    def test_the_best_of_each_base_is_bold(self):
        values = {"Ensemble": 2.0, "UfM*-Ensemble": 1.0, "Aleatoric": 0.5, "UfM*-Aleatoric": 0.7}
        figures = {(Row(Method.parse(n)), ("d", "s")): {"nll": v, "delta1": 0.7} for n, v in values.items()}
        table = main_table(in_memory(figures))
        assert [line.cells[1].bold for line in table.lines] == [False, True, True, False]
        assert [len(block) for block in table.blocks] == [2, 2]
        assert not any(line.cells[0].bold for line in table.lines)  # all alike
        assert [line.bold for line in table.lines] == [False, True, False, True]  # UfM*, as in the paper

    def test_rows_over_different_sequences_are_not_compared(self):
        figures = {(row, ("d", s)): {"nll": v} for row, s, v in ((ALONE, "a", 1.0), (ALONE, "b", 3.0), (UFM, "a", 1.5))}
        table = main_table(in_memory(figures))
        assert table.columns[0].name == "sequences"
        assert [line.cells[0].value for line in table.lines] == ["2", "1"]
        assert not any(cell.bold for line in table.lines for cell in line.cells)
        assert any("different sequences" in note for note in table.notes)

    def test_a_network_of_depth_alone_has_dashes(self, tmp_path):
        rows = rows_of("DepthOnly", "UfM*-DepthOnly")
        found = load_results(write_evaluation(tmp_path / "o", rows, SCENES[:1], suite="depth-only"))
        cells = parsed(markdown(main_table(found)))
        assert cells["DepthOnly"]["NLL ↓"] == cells["DepthOnly"]["ECE_q ↓"] == "–"
        assert cells["DepthOnly"]["δ₁ ↑"] == cells["UfM*-DepthOnly"]["δ₁ ↑"] != "–"
        assert not has_variance(found, rows[0])
        assert list(references(found, rows[1])) == []
        assert difference_table(found).lines == ()

    def test_further_figures_and_single_sequences(self, results):
        record = results.of(UFM_STAR, "7-scenes")[0]
        cells = parsed(markdown(extra_table(results, "7-scenes")))["UfM*-Ensemble"]
        assert cells["AUSE [m] ↓"] == f"{record.figures['ause_rmse']:.3f}"
        assert cells["Spearman ↑"] == f"{record.figures['spearman']:.2f}"
        assert cells["uncertainty [ms]"] == "10.0"
        tables = sequence_tables(results, "scannet")
        assert [t.title for t in tables] == [f"scannet, {sequence}: 40 frames" for _, sequence in SCENES]
        first = results.of(ALONE, "scannet")[0]
        assert tables[0].lines[0].cells[3].value == f"{first.figures['ece_q']:.3f}"


class TestMarks:
    def test_ties_in_print_are_both_best(self):
        cells = mark_best([Cell("0.10"), Cell("0.10"), Cell("0.20"), Cell()], ECE_DELTA)
        assert [cell.bold for cell in cells] == [True, True, False, False]
        assert [c.bold for c in mark_best([Cell("0.10"), Cell("0.30")], SPEARMAN)] == [False, True]

    @given(st.floats(-1e9, 1e9), st.integers(0, 4))
    def test_a_number_reads_as_what_it_is(self, value, decimals):
        text = number(value, decimals)
        assert abs(float(text) - value) <= 0.51 * 10**-decimals + 0.006 * abs(value) * (abs(value) >= 1e6)
        assert not (text.startswith("-") and float(text) == 0)

    def test_significant_digits(self):
        assert [number(v, None) for v in (0.0256, 4.0, 76.04, 1319.4, 0.0)] == ["0.0256", "4.00", "76.0", "1319", "0"]

    def test_a_table_with_a_cell_too_few_is_refused(self):
        with pytest.raises(ValueError, match="1 cells for 2 columns"):
            Table("t", "", "", (Column("a", "a"), Column("b", "b")), ((Line("x", (Cell("1"),)),),))


class TestLatex:
    def test_structure(self, out):
        for path in sorted((out / "tables").glob("*.tex")):
            for text in path.read_text().split("% needs")[1:]:
                check_latex(text)

    def test_cells_as_the_paper_sets_them(self):
        line = Line("UfM*-MCD", (Cell("0.96", "0.19", bold=True), Cell("0.12"), Cell()), bold=True)
        columns = (Column("NLL", "NLL", "Ours"), Column("E", "E", "Ours"), Column("P", "P", "Paper"))
        text = latex(Table("t", "A & B", "Method", columns, ((line,), (line,))))
        assert r"\textbf{UfM$^*$-MCD} & $\mathbf{0.96} \pm 0.19$ & $0.12$ & -- \\" in text
        assert r" & \multicolumn{2}{c}{Ours} & \multicolumn{1}{c}{Paper} \\" in text
        assert r"\cmidrule(lr){2-3}\cmidrule(lr){4-4}" in text
        assert text.count(r"\addlinespace") == 1
        assert r"\caption{A \& B.}" in text

    def test_escapes(self):
        assert escape("kitchen&_50% #{~^\\") == (
            r"kitchen\&\_50\% \#\{\textasciitilde{}\textasciicircum{}\textbackslash{}"
        )


class TestDifferences:
    def test_closed_form(self):
        # Sequences differ by far more than methods: the levels' interval is wide, the differences' narrow.
        levels, gains = {"a": 1.0, "b": 5.0, "c": 9.0}, {"a": -0.4, "b": -0.5, "c": -0.6}
        figures = {(ALONE, ("d", s)): {"nll": v, "ece_delta": 0.2} for s, v in levels.items()}
        figures |= {(UFM_STAR, ("d", s)): {"nll": v + gains[s]} for s, v in levels.items()}
        found = in_memory(figures)
        mean = difference(found, UFM_STAR, ALONE, NLL)
        assert (mean.value, mean.sequences) == (pytest.approx(-0.5), 3)
        assert mean.half == pytest.approx(T_2 * 0.1 / math.sqrt(3))
        assert mean_of(found.of(ALONE), NLL).half == pytest.approx(T_2 * 4 / math.sqrt(3))
        assert better(mean, NLL) is True
        assert better(mean, SPEARMAN) is False  # there, more is better
        assert better(difference(found, ALONE, UFM_STAR, NLL), NLL) is False

    def test_on_common_sequences_only(self):
        figures = {(ALONE, ("d", s)): {"nll": 1.0} for s in "ab"} | {(UFM, ("d", s)): {"nll": 3.0} for s in "bc"}
        mean = difference(in_memory(figures), UFM, ALONE, NLL)
        assert (mean.value, mean.sequences) == (2.0, 1)
        assert math.isnan(mean.half)
        assert better(mean, NLL) is None  # one sequence says nothing about others

    def test_within_the_interval_is_neither_better_nor_worse(self):
        figures = {(ALONE, ("d", s)): {"nll": 1.0} for s in "abc"}
        figures |= {(UFM, ("d", s)): {"nll": v} for s, v in zip("abc", (0.0, 2.0, 1.3), strict=True)}
        assert better(difference(in_memory(figures), UFM, ALONE, NLL), NLL) is None

    def test_the_table(self):
        figures = {(ALONE, ("d", s)): {"nll": v, "ece_delta": 0.1} for s, v in zip("abc", (1, 2, 3), strict=True)}
        figures |= {
            (UFM_STAR, ("d", s)): {"nll": v, "ece_delta": 0.3 + v / 1000}
            for s, v in zip("abc", (0.5, 1.5, 2.45), strict=True)
        }
        cells = parsed(markdown(difference_table(in_memory(figures))))
        assert list(cells) == ["UfM*-Ensemble – Ensemble"]
        row = cells["UfM*-Ensemble – Ensemble"]
        assert row["sequences"] == "3"
        assert row["Δ NLL ↓"] == "-0.52 ± 0.07"
        assert row["Δ ECE_δ ↓"] == "+0.201 ± 0.002 (worse)"  # narrow intervals are told here
        assert row["Δ Spearman ↑"] == "–"
        assert "**-0.52** ± 0.07" in markdown(difference_table(in_memory(figures)))

    def test_references(self):
        skipped, noisy = Setting(skip=4), Setting(rotation_noise=2.0)
        full, fixed = rows_of("UfM*-FullEnsemble", "UfM*-Ensemble-fixed-param")
        method = UFM_STAR.method
        rows = [*ENSEMBLE, full, fixed, Row(ALONE.method, skipped), Row(method, skipped), Row(method, noisy)]
        found = in_memory({(row, ("d", "s")): {"ece_delta": 0.1} for row in [*rows, *rows_of("Aleatoric")]})
        told = {row: list(references(found, row)) for row in rows}
        assert told[ALONE] == []
        assert told[UFM] == told[UFM_100K] == [ALONE]
        assert told[UFM_STAR] == [ALONE, UFM_100K]
        assert told[full] == told[fixed] == [ALONE, UFM_100K, UFM_STAR]
        assert told[Row(method, skipped)] == [Row(ALONE.method, skipped), UFM_STAR]  # alone on the same images
        assert told[Row(method, noisy)] == [ALONE, UFM_STAR]


class TestSums:
    def test_merged_sums_are_the_metrics_of_all_pixels_together(self, results):
        maps = [draw_maps(UFM_STAR, sequence) for _, sequence in SCENES]
        together = SequenceMetrics()
        together.update(*(torch.cat(parts) for parts in zip(*maps, strict=True)))
        merged = results.merged["scannet", UFM_STAR]
        assert merged.sequences == 3
        assert merged.figures == pytest.approx(together.compute(), rel=1e-12)
        for name, curve in together.curves().items():
            assert merged.curves[name] == pytest.approx(curve, rel=1e-12, nan_ok=True), name
        references = {name for name in merged.curves if name.startswith("nll_by_error")}
        assert references == {"nll_by_error:Ensemble", "nll_by_error:UfM-Ensemble-100K"}

    def test_the_same_bits_whoever_wrote_what(self, results, out, tmp_path):
        all_of_them = [*SCENES, KITCHEN, ("scannet", "scene0009_00")]
        other = write_evaluation(tmp_path / "o", ENSEMBLE, [], unfinished=all_of_them)
        for dataset, sequence in [KITCHEN, *reversed(SCENES)]:
            write_sequence(other, "paper-table-1", dataset, sequence, ENSEMBLE[::-1])
        again = load_results(other)
        assert again.records == results.records
        assert again.merged.keys() == results.merged.keys()
        for key, merged in again.merged.items():
            assert merged.figures == results.merged[key].figures
            # As text, since the NaN of an empty bin equals nothing.
            assert repr(sorted(merged.curves.items())) == repr(sorted(results.merged[key].curves.items()))
        write_report(other, figures=False)
        assert (other / "results.csv").read_bytes() == (out / "results.csv").read_bytes()
        assert (other / "tables" / "main.md").read_bytes() == (out / "tables" / "main.md").read_bytes()


class TestTidy:
    def test_a_line_for_each_figure(self, results, out):
        with (out / "results.csv").open() as file:
            lines = list(csv.DictReader(file))
        stored = json.loads((out / "results.json").read_text())
        assert len(lines) == len(stored["lines"])
        for record in results.records:
            mine = [line for line in lines if (line["method"], line["sequence"]) == (record.method, record.sequence)]
            found = {line["figure"]: float(line["value"]) for line in mine}
            assert {name: found[name] for name in record.figures} == record.figures  # to the last bit
            assert found["frames.skipped"] == 2
            assert found["ms.network"] == record.ms["network"]
            assert {line["network"] for line in mine} == {NETWORK}
        assert stored["failed"] == [
            {"dataset": "tum", "sequence": "fr1_xyz", "reason": "no ground truth", "rows": [r.slug for r in ENSEMBLE]}
        ]
        assert len(stored["missing"]) == 4

    def test_means_and_settings(self, tmp_path):
        rows = [Row(UFM_STAR.method, s) for s in (Setting(), Setting(rotation_noise=2.0, seed=7))]
        write_report(write_evaluation(tmp_path / "o", rows, SCENES, suite="noise"), figures=False)
        with (tmp_path / "o" / "table.csv").open() as file:
            lines = [line for line in csv.DictReader(file) if line["figure"] == "nll"]
        assert [(line["rotation_noise"], line["seed"], line["sequences"]) for line in lines] == [
            ("", "", "3"), ("2.0", "7", "3"),
        ]  # fmt: skip
        table = json.loads((tmp_path / "o" / "results.json").read_text())["table"]
        assert [line["mean"] for line in table if line["figure"] == "nll"] == [float(line["mean"]) for line in lines]


class TestLoading:
    def test_unfinished_and_failed(self, results):
        assert {(dataset, sequence) for dataset, sequence, _ in results.missing} == {("scannet", "scene0009_00")}
        told = summary(results)
        assert "tum, fr1_xyz: no ground truth" in told
        assert "scannet, scene0009_00: 4 row(s)" in told
        assert results.datasets == ("7-scenes", "scannet")
        assert results.rows == tuple(ENSEMBLE)

    @pytest.mark.parametrize("name", names())
    def test_settings_survive_their_dict(self, name):
        for row in suite_named(name).rows:
            assert setting_of(json.loads(json.dumps(row.setting.to_dict()))) == row.setting
            assert row_label(row).startswith(row.name)
            assert row.name.replace("-Anchored", "") == row.method.name

    def test_what_is_no_evaluation(self, tmp_path):
        with pytest.raises(ResultsError, match=r"no folder of `ufmstar eval`: it has no eval\.json"):
            load_results(tmp_path)
        write_evaluation(tmp_path, ENSEMBLE, [], unfinished=SCENES)
        with pytest.raises(ResultsError, match="no finished sequence"):
            load_results(tmp_path)
        (tmp_path / "eval.json").write_text('{"format": 99, "suite": "x"}')
        with pytest.raises(ResultsError, match=r"eval\.json is not the description"):
            load_results(tmp_path)
        (tmp_path / "eval.json").write_text('{"format": 1, "suite": "x", "rows": [{"method": "Oracle"}]}')
        with pytest.raises(ResultsError, match="lists a row that cannot be: no method is called 'Oracle'"):
            load_results(tmp_path)

    def test_records_that_do_not_belong_together(self, tmp_path):
        write_evaluation(tmp_path, [ALONE], SCENES[:1])
        record = tmp_path / "records" / "scannet" / SCENES[0][1] / "Ensemble.json"
        good = json.loads(record.read_text())

        def refused(change: dict[str, object], match: str, name: str = "scene0001_00") -> None:
            path = tmp_path / "records" / "scannet" / name / "Ensemble.json"
            path.parent.mkdir(exist_ok=True)
            path.write_text(json.dumps({**good, **change}))
            with pytest.raises(ResultsError, match=match):
                load_results(tmp_path)

        refused({"sequence": "scene0001_00", "network": "Other"}, "mixed networks.*FastDepth in .*Other in ")
        refused({"sequence": "scene0001_00", "suite": "ablations"}, "of the suite 'ablations', not of 'paper-table-1'")
        refused({}, "of the same row on the same sequence")
        refused({"format": 2}, r"Ensemble\.json is not a record of format 1")
        refused({"method": "Oracle"}, r"Ensemble\.json: no method is called 'Oracle'")
        refused({"setting": {"skip": -1}}, r"Ensemble\.json: skip must be")

    def test_sums_that_are_gone_or_broken(self, tmp_path):
        write_evaluation(tmp_path, ENSEMBLE[:2], SCENES[:2])
        sums = tmp_path / "records" / "scannet" / SCENES[1][1] / "Ensemble.pt"
        kept = sums.read_bytes()
        sums.unlink()
        found = load_results(tmp_path)
        assert set(found.merged) == {("scannet", UFM)}
        assert len(found.notes) == 1
        assert "Ensemble.pt is not there" in found.notes[0]
        sums.write_bytes(kept[:100])
        with pytest.raises(ResultsError, match=r"Ensemble\.pt does not hold the sums"):
            load_results(tmp_path)
        torch.save({"metrics": {"metrics.NLL.total": torch.zeros(7)}}, sums)
        with pytest.raises(ResultsError, match=r"Ensemble\.pt holds sums of other metrics"):
            load_results(tmp_path)
        assert load_results(tmp_path, with_sums=False).merged == {}


class TestCommand:
    def test_prints_the_main_table_and_what_it_wrote(self, out, capsys):
        assert cli.main(["report", str(out), "--no-figures"]) == 0
        told = capsys.readouterr().out
        assert parsed(told)["UfM*-Ensemble"]["paper: NLL"] == "0.96 ± 0.19"
        assert "tum, fr1_xyz: no ground truth" in told
        files = len(list((out / "tables").iterdir()))
        assert told.endswith(f"{out}: results.json, results.csv, table.csv, tables/ ({files} files)\n")
        assert (out / "tables" / "main-scannet.tex").is_file()
        assert not (out / "figures").exists()

    def test_wrong_usage(self, tmp_path, capsys):
        assert cli.main(["report", str(tmp_path)]) == 2
        assert "no folder of `ufmstar eval`" in capsys.readouterr().err
        assert cli.main(["report", str(tmp_path), "--format", "jpg"]) == 2

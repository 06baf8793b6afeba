"""The paper's own numbers beside and below ours: every one of them against the source of the paper."""

from __future__ import annotations

import re
from dataclasses import replace

import pytest
from evaluations import check_latex, in_memory, parsed, rows_of
from shared_data import require_shared
from test_efficiency_table import line as measured_line

from ufmstar_torch.eval.methods.method import Method
from ufmstar_torch.eval.report.latex import latex
from ufmstar_torch.eval.report.markdown import markdown
from ufmstar_torch.eval.report.paper import BY_SUITE, TABLE_1, TABLE_2, TABLE_2_NETWORKS, TABLE_3, TABLE_4, Quoted
from ufmstar_torch.eval.report.paper_efficiency import paper_efficiency_tables
from ufmstar_torch.eval.report.write import write_tables

ALONE = rows_of("Ensemble")[0]


class TestThePapersNumbers:
    """Every number of the four tables, against the LaTeX source of the paper, read by other code."""

    @staticmethod
    def cells(label: str) -> list[tuple[str, list[Quoted | None]]]:
        source = require_shared("paper/ufmstar.tex").read_text()
        body = source[source.index(rf"\label{{{label}}}") :]
        body = body[body.index(r"\midrule") : body.index(r"\bottomrule")]
        body = re.sub(r"\\(mathbf|textbf|mbox)\{([^{}]*)\}", r"\2", re.sub(r"~?\\cite\{[^}]*\}", "", body))
        rows = []
        for line in body.replace("\\midrule", "").replace("\\addlinespace", "").split("\\\\"):
            cells = [cell.replace("$", "").replace("^*", "*").strip() for cell in line.split("&")]
            if len(cells) > 1:
                values = [None if c == "--" else Quoted(*(p.strip() for p in c.split("\\pm"))) for c in cells]
                rows.append((cells, values))
        return [(cells[0], values[1:]) for cells, values in rows]

    @pytest.mark.parametrize(
        ("label", "table"),
        [
            ("tab:benchmarks_uq_and_eff", TABLE_1),
            ("tab:depth_anything_v2", TABLE_3),
            ("tab:full_ufmstar_summary", TABLE_4),
        ],
    )
    def test_tables_1_3_and_4(self, label, table):
        theirs = self.cells(label)
        assert [method for method, _ in theirs] == list(table.rows)
        for method, values in theirs:
            assert dict(zip(table.columns, values, strict=True)) == table.rows[method]

    def test_table_2(self):
        rows = []
        for _, values in self.cells("tab:efficiency_in_detail"):
            method = re.sub(r"\\MethodOneLine\{|\}|\\textbf\{", "", values[0].value)
            numbers = [None if v is None else Quoted(v.value.replace("< ", "<")) for v in values[1:]]
            rows.append((method.strip(), numbers))
        ours = [(method, row, table) for table in TABLE_2.values() for method, row in table.rows.items()]
        assert len(rows) == len(ours) == 16
        for (theirs, values), (method, row, table) in zip(rows, ours, strict=True):
            assert theirs == method
            assert {c: v for c, v in zip(table.columns, values, strict=True) if v is not None} == row

    def test_the_networks_of_table_2(self):
        source = require_shared("paper/ufmstar.tex").read_text()
        told = re.findall(r"Lat\.: (\S+) ms.*?Mem\.: (\S+) MB", source, re.DOTALL)
        assert told == [(ms.value, mb.value) for ms, mb in TABLE_2_NETWORKS.values()]

    def test_table_2_in_print(self):
        ours = paper_efficiency_tables(["FastDepth (8 bit)"])
        assert [table.title for table in ours] == ["The paper's table 2, FastDepth"]
        cells = parsed(markdown(ours[0]))["UfM-Aleatoric-100K"]
        assert list(cells.values()) == ["&lt;1", "3.9", "1", "60", "1.6", "95", "66", "&lt;0.01", "4.0", "20.2"]
        assert parsed(markdown(ours[0]))["Ensemble"]["MVD mem. [MB]"] == "–"
        assert len(paper_efficiency_tables(["Depth Anything V2"])) == 2  # none of its two: both
        for table in paper_efficiency_tables(TABLE_2):
            check_latex(latex(table).removeprefix("%"))

    def test_table_2_stands_below_what_was_measured(self, tmp_path):
        found = in_memory({(ALONE, ("d", "s")): {"nll": 1.0}}, efficiency=measured_line())
        written = write_tables(replace(found, out=tmp_path))
        assert {tmp_path / "tables" / "efficiency.md", tmp_path / "tables" / "efficiency.tex"} <= set(written)
        text = (tmp_path / "tables" / "efficiency.md").read_text()
        ours, theirs = text.split("### ")[1:]
        assert ours.startswith("Efficiency of uncertainty, ResNet50-Monodepth2")
        assert theirs.startswith("The paper's table 2, ResNet50-Monodepth2")
        assert list(parsed(ours)["Ensemble"]) == list(parsed(theirs)["Ensemble"])  # column below column
        assert parsed(theirs)["Ensemble"]["GPU Energy [mJ]"] == "1857"

    def test_every_method_of_theirs_is_one_of_ours(self):
        for table in (*BY_SUITE.values(), *TABLE_2.values()):
            assert [Method.parse(name).name for name in table.rows] == list(table.rows)

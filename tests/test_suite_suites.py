"""Suites of ``ufmstar eval``: the paper's tables and figures, ablations, and a user's own."""

from __future__ import annotations

import pickle
from dataclasses import replace

import pytest
from tiny_suite import rows_of

from ufmstar_torch import UfMStarConfig
from ufmstar_torch.eval.engine.estimators import ufm_star_config
from ufmstar_torch.eval.methods.method import BASES, MANY, UFM_STAR
from ufmstar_torch.eval.methods.row import Row, plain_rows
from ufmstar_torch.eval.methods.setting import configured, default_of
from ufmstar_torch.eval.methods.suite import names, suite_named
from ufmstar_torch.eval.report.data import listed_rows
from ufmstar_torch.eval.report.quantities import row_labels

# The rows of the paper's tables, copied.
TABLE_1 = """
Ensemble UfM-Ensemble UfM-Ensemble-100K UfM*-Ensemble
MC-Dropout UfM-MCD UfM-MCD-100K UfM*-MCD
BatchEnsemble UfM-BatchEnsemble UfM-BatchEnsemble-100K UfM*-BatchEnsemble
Evidential UfM-Evidential UfM-Evidential-100K UfM*-Evidential
Aleatoric UfM-Aleatoric UfM-Aleatoric-100K UfM*-Aleatoric"""
TABLE_2 = """Ensemble UfM-Ensemble UfM-Ensemble-100K UfM*-Ensemble
Aleatoric UfM-Aleatoric UfM-Aleatoric-100K UfM*-Aleatoric"""
TABLE_3 = "UfM-DepthOnly-300K UfM*-DepthOnly-fixed-param UfM*-DepthOnly"


def value_of(row, name):
    """Return a row's value of a setting, or UfM*'s default."""
    changed = row.setting.to_dict()
    return changed[name] if name in changed else default_of(name, row.setting.ufm_preset)


def methods(name, base=None):
    return [row.method.name for row in suite_named(name, base).rows]


@pytest.mark.parametrize(("number", "rows"), [(1, TABLE_1), (2, TABLE_2), (3, TABLE_3)])
def test_tables_have_the_papers_rows_in_its_order(number, rows):
    suite = suite_named(f"paper-table-{number}")
    assert [row.method.name for row in plain_rows(suite.rows)] == rows.split()
    assert {row.setting.preprocess for row in suite.rows} == {"resize"}
    assert suite.efficiency == (number in (1, 2))


def test_table_4_has_the_full_rows_and_the_alternating_ones_beside_them():
    result = list(dict.fromkeys(methods("paper-table-4")))
    assert [name for name in result if "Full" in name] == [
        "UfM*-FullEnsemble", "UfM*-FullMCD", "UfM*-FullBatchEnsemble"
    ]  # fmt: skip
    assert [name.replace("Full", "") for name in result[::2]] == result[1::2]


@pytest.mark.parametrize("name", [n for n in names() if n.startswith("paper-")])
def test_the_papers_suites_run_the_papers_settings_with_ours_beside_them(name):
    rows = [row for row in suite_named(name).rows if row.method.fusion == UFM_STAR]
    papers, ours = rows_with(rows, "paper"), rows_with(rows, "default")
    assert [(row.method, row.setting.skip, row.setting.pose_noise) for row in papers] == [
        (row.method, row.setting.skip, row.setting.pose_noise) for row in ours
    ]
    assert {row.setting.preprocess for row in suite_named(name).rows} == {"resize"}
    for row, expected in [*zip(papers, [UfMStarConfig.paper()] * len(rows), strict=False), (ours[0], UfMStarConfig())]:
        scaled = not row.method.fixed_param
        segment = replace(expected.segment, scale_with_image=scaled)
        assert ufm_star_config(row) == expected.replace(segment=segment, on_bad_frame="skip")


def rows_with(rows, preset):
    return [row for row in rows if row.setting.ufm_preset == preset]


def test_one_preset_for_all_rows():
    for preset in ("paper", "default"):
        suite = suite_named("paper-table-1", preset=preset)
        assert [row.method.name for row in suite.rows] == TABLE_1.split()
        assert all(row.setting.ufm_preset == preset for row in suite.rows if row.method.fusion == UFM_STAR)
    # A value equal to the preset's is no change; an ablation's varied value stays.
    rows = suite_named("ablation-segmentation", preset="paper").rows
    limits = {value_of(row, "segment.min_pixels") for row in rows[1:] if row.setting.plain}
    assert limits == {2000}
    assert {"none", "both", "either"} == {configured(r.setting).segment.prune for r in rows[1:]}
    tried = {configured(r.setting).regression for r in suite_named("ablation-regression", preset="paper").rows[1:]}
    assert tried == {"exact", "neighbourhood"}


def test_every_suite_can_be_made_for_every_base():
    for name in names():
        assert suite_named(name).name == name
        if name == "anchors" or name.startswith(("ablation", "paper-figure")):
            for base in MANY if name == "ablation-no-alternating" else BASES:
                assert suite_named(name, base).bases == (base,)


def test_figures_vary_what_the_paper_varies():
    noise = suite_named("paper-figure-pose-noise")
    assert [row.method.name for row in noise.rows] == ["Ensemble"] + ["UfM*-Ensemble"] * 22
    assert [r.setting.rotation_noise for r in noise.rows[1:13]] == [0.0, 0.5, 1.0, 2.0, 5.0, 10.0] * 2
    assert [r.setting.translation_noise for r in noise.rows[13:]] == [0.01, 0.02, 0.05, 0.1, 0.2] * 2
    overlap = suite_named("paper-figure-overlap")
    # Both are judged on the same frames: the figure shows their difference.
    assert [(r.setting.skip, r.method.name) for r in overlap.rows] == [
        (skip, name) for name in ("Aleatoric", *["UfM*-Aleatoric"] * 2) for skip in (0, 1, 2, 4, 8, 16, 32)
    ]


@pytest.mark.parametrize(
    ("name", "field"),
    [
        ("eta", "eta"),
        ("eta-occlusion", "eta_occlusion"),
        ("ema-alpha", "ema_alpha"),
        ("overlap-weighted", "overlap_weighted"),
        ("regression", "regression"),
    ],
)
def test_an_ablation_tries_the_default_and_others_against_the_base_alone(name, field):
    suite = suite_named(f"ablation-{name}", "depth_only")
    assert suite.rows[:2] == rows_of("DepthOnly", "UfM*-DepthOnly")
    tried = {value_of(row, field) for row in suite.rows[1:]}
    assert len(tried) > 1
    assert getattr(UfMStarConfig(), field) in tried


def test_rows_without_a_network_are_left_out():
    remaining = suite_named("paper-table-1").with_bases(["aleatoric", "depth_only"])
    assert remaining.bases == ("aleatoric",)
    assert len(remaining.rows) == 5


# ---- TOML ----

TOML = """
title = "Smoothing"
[[rows]]
methods = ["Ensemble", "UfM*-Ensemble"]
[[rows]]
methods = ["UfM*-Ensemble"]
setting = { "segment.min_pixels" = 2000 }
each = { ema_alpha = [0.1, 1.0], skip = [0, 2] }
"""


def test_rows_have_labels_of_their_own(tmp_path):
    rows = """
[[rows]]
methods = ["UfM*-Ensemble", "UfM-Ensemble-100K"]
label = "{method}, as we deploy it"
[[rows]]
methods = ["UfM*-Ensemble"]
setting = { eta = 0.3 }
label = "loose"
[[rows]]
methods = ["Ensemble"]
"""
    (tmp_path / "own.toml").write_text(rows)
    suite = suite_named(str(tmp_path / "own.toml"))
    expected = ["UfM*-Ensemble, as we deploy it", "UfM-Ensemble-100K, as we deploy it", "loose", "Ensemble"]
    assert list(row_labels(suite.rows).values()) == expected
    again = pickle.loads(pickle.dumps(suite))
    assert [row.title for row in again.rows] == [*expected[:3], ""]
    listed = listed_rows({"rows": [row.to_dict() for row in suite.rows]})
    assert list(row_labels(listed).values()) == expected
    assert listed[2] == Row(suite.rows[2].method, suite.rows[2].setting), "a label does not distinguish rows"
    for wrong in ("each = { eta = [0.1, 0.2] }\nlabel = 'x'", "label = 'x'"):
        (tmp_path / "own.toml").write_text(f"[[rows]]\nmethods = ['UfM*-Ensemble', 'Ensemble']\n{wrong}")
        with pytest.raises(ValueError, match="label 'x' names one row"):
            suite_named(str(tmp_path / "own.toml"))


def test_a_suite_from_a_file(tmp_path):
    (tmp_path / "my-own.toml").write_text(TOML)
    suite = suite_named(str(tmp_path / "my-own.toml"))
    assert (suite.name, suite.title) == ("my-own", "Smoothing")
    assert suite.rows[:2] == rows_of("Ensemble", "UfM*-Ensemble")
    assert [row.setting.to_dict() for row in suite.rows[2:]] == [
        {"ema_alpha": alpha, "segment.min_pixels": 2000, **({"skip": skip} if skip else {})}
        for alpha in (0.1, 1.0)
        for skip in (0, 2)
    ]


def test_a_file_names_bases_and_other_suites(tmp_path):
    (tmp_path / "mine.toml").write_text("""
base = "ensemble"
include = ["ablation-eta", "ablation-no-alternating"]
[[rows]]
bases = ["aleatoric"]
methods = ["{alone}", "UfM*-{behind}"]
[[rows]]
methods = ["UfM*-{behind}", "UfM*-{behind}"]
each = { "segment.line_thresh" = [0.3, 0.6] }
""")
    suite = suite_named(str(tmp_path / "mine.toml"), "aleatoric")
    twice = {"segment.line_thresh": 2 * UfMStarConfig().segment.line_thresh}
    assert suite.rows[:3] == (*rows_of("Aleatoric", "UfM*-Aleatoric"), *rows_of("UfM*-Aleatoric", overrides=twice))
    assert set(suite.rows[3:]) == set(suite_named("ablation-eta", "aleatoric").rows[2:])
    mine = suite_named(str(tmp_path / "mine.toml"))
    assert [row.method.name for row in mine.rows[:2]] == ["UfM*-Ensemble"] * 2
    assert "UfM*-FullEnsemble" in {row.method.name for row in mine.rows}


ROW = "[[rows]]\nmethods = ['UfM*-MCD']\n"


@pytest.mark.parametrize(
    ("text", "told"),
    [
        ("titel = 'x'", "unknown key 'titel', expected name, title"),
        ("[[rows]]\nmethods = ['Ensemble']\nsettings = {}", "rows 1: unknown key 'settings', expected methods"),
        ("[[rows]]\nmethods = ['Ensembel']", "rows 1: no method is called 'Ensembel'"),
        ("[[rows]]\nmethods = 'Ensemble'", "rows 1: methods must be a list"),
        ("[[rows]]\nmethods = []", "rows 1: methods must name at least one"),
        ("[[rows]]\nmethods = [1]", "methods must be a list of words"),
        ("[[rows]]\nmethods = ['UfM*-MCD']\nsetting = {alpha = 1}", "rows 1: no setting is called 'alpha'"),
        ("[[rows]]\nmethods = ['UfM*-MCD']\neach = {eta = 0.5}", "each.eta must be a list of values"),
        ("rows = [1]", "rows 1 must be a table"),
        ("base = 'resnet'", "base must be one of ensemble"),
        ("bases = [1]", "bases must be a list of words"),
        ("include = ['eta']", "include: no suite of the package is called 'eta'"),
        ("include = ['../other.toml']", "include: no suite of the package is called '../other.toml'"),
        ("include = ['bad.toml']", "include: no suite of the package is called"),
        (f"{ROW}each = {{seed = {[*range(40)]}, skip = {[*range(40)]}}}", "the suite has more than 1000 rows"),
        (f"{ROW}setting = {{anchors = '/etc/hosts.txt'}}", "anchors must be a file in the folder of each sequence"),
        (f"{ROW}each = {{anchors = ['../hosts.txt']}}", "anchors must be a file in the folder of each sequence"),
        (f"title = '{1_000_000 * 'x'}'", "larger than 1,000,000 bytes"),
        ("title = 'x'", "needs at least one row"),
        ("name = ", "Invalid value"),
        ("name = " + "[" * 200_000, "recursion"),
    ],
)
def test_mistakes_in_a_file_are_told_with_its_name(tmp_path, text, told):
    (tmp_path / "bad.toml").write_text(text)
    with pytest.raises(ValueError, match=told) as raised:
        suite_named(str(tmp_path / "bad.toml"))
    assert "bad.toml" in str(raised.value)

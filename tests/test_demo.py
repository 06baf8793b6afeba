"""``ufmstar demo``: an evaluation of the package's networks on two kinds of rooms; its outputs and refusals."""

from __future__ import annotations

import io
import json
import re
from contextlib import redirect_stdout
from dataclasses import replace
from importlib.resources import files
from pathlib import Path

import pytest
from demo_networks import SPEC, members, write_members

from ufmstar_torch import cli
from ufmstar_torch.eval.commands import demo, evaluate
from ufmstar_torch.eval.report.data import load_results
from ufmstar_torch.eval.report.tables import main_table
from ufmstar_torch.models import save_trained

FRAMES, SEED = 2, 5
SHIPPED = Path(str(files("ufmstar_torch.models").joinpath("weights", "demo.safetensors")))
ROWS = ["Aleatoric", "Ensemble", "UfM-Ensemble-100K", "UfM*-Ensemble", "UfM*-Ensemble (anchors dense, posterior)"]
README = Path(__file__).parent.parent / "README.md"


@pytest.fixture(scope="module")
def weights(tmp_path_factory):
    return write_members(tmp_path_factory.mktemp("weights") / "three.safetensors")


@pytest.fixture(scope="module")
def done(weights, tmp_path_factory):
    """One demo through the command line: (folder, words, exit code, stdout). No test may change the folder."""
    out = tmp_path_factory.mktemp("demo") / "out"
    words = [*map(str, ("demo", "--weights", weights, "--out", out, "--frames", FRAMES, "--seed", SEED))]
    with redirect_stdout(io.StringIO()) as message:
        code = cli.main(words)
    return out, words, code, message.getvalue()


def test_every_row_is_judged_in_both_kinds_of_rooms(done):
    out, _, code, message = done
    assert code == 0
    results = load_results(out, with_sums=False)
    assert [row.label for row in results.rows] == ROWS
    assert results.datasets == ("unfamiliar", "familiar")
    assert {(r.dataset, r.frames["done"]) for r in results.records} == {("familiar", FRAMES), ("unfamiliar", FRAMES)}
    assert len(results.records) == 2 * len(ROWS)
    assert message.endswith(f"\nopen {out / 'report.html'} in a browser\n")
    for file in ("report.html", "results.csv", "tables/main-unfamiliar.tex", "figures/calibration-unfamiliar.svg"):
        assert (out / file).is_file()
    assert list((out / "figures").glob("strip-unfamiliar-*-ensemble_*.png"))


def test_its_table_is_the_readmes(done):
    out, _, _, message = done
    text = README.read_text(encoding="utf-8")
    table = text[text.index("| 36 frames of an unfamiliar hall") :].partition("\n\n")[0]
    head, _, *lines = [[cell.strip() for cell in line.split("|")[1:-1]] for line in table.splitlines()]
    cells = main_table(load_results(out, with_sums=False), "unfamiliar").cells
    assert [heading.split()[0] for _, heading in cells.columns] == head[1:]
    assert [label for _, label in cells.index] == [line[0].replace("\\", "") for line in lines]
    assert message.index("of unfamiliar") < message.index("of familiar")
    assert not (out / "tables" / "main.tex").exists()  # no mean over both rooms


def test_its_page_shows_a_frame_then_the_table_then_curves(done):
    out, *_ = done
    page = (out / "report.html").read_text(encoding="utf-8")
    parts = [page.index(f'id="{name}"') for name in ("look", "table", "curves", "pictures", "cost", "limits")]
    assert parts == sorted(parts)
    look, table, curves, further = (page[a:b] for a, b in zip(parts, [*parts[1:4], None], strict=False))
    assert look.count("<img") == 1
    assert "style=hall" in look
    assert "UfM* alone and with the posterior" in look
    assert "1 sequence of unfamiliar" in table.partition("<details>")[0]
    assert all(len(heading.split()) > 6 for heading in re.findall("<h3>(.*?)</h3>", curves))
    assert "calibration sequences" not in further.lower()  # each data set has one
    drawn = (out / "figures" / "calibration-unfamiliar.svg").read_text(encoding="utf-8")
    assert "posterior" in drawn


def test_a_second_demo_computes_nothing(done, monkeypatch, capsys):
    out, words, *_ = done
    before = {path: path.stat().st_mtime_ns for path in out.glob("records/*/*/*.npz")}
    monkeypatch.setattr(evaluate, "_report", lambda *_: 0)  # takes most of the time
    assert cli.main(words) == 0
    assert {path: path.stat().st_mtime_ns for path in out.glob("records/*/*/*.npz")} == before
    assert "the evaluation in" not in capsys.readouterr().err


# ---- refusals ----

REFUSED = {
    "no weights": (("--weights", "none.safetensors"), "no such file: none.safetensors"),
    "no networks": (("--weights", "{tmp}/bad.safetensors"), "bad.safetensors"),
    "no variance": (
        ("--weights", "{tmp}/plain.safetensors"),
        "with an aleatoric variance and no epistemic one, got none",
    ),
    "a file": (("--out", "{tmp}/bad.safetensors"), "is a file"),
    "other files": (("--out", "{tmp}/other", "--overwrite"), "holds files of someone else"),
}


@pytest.mark.parametrize("case", REFUSED)
def test_refusals(ufmstar, tmp_path, weights, case):
    (tmp_path / "bad.safetensors").write_bytes(b"not this")
    plain = replace(SPEC, method="depth")
    save_trained(tmp_path / "plain.safetensors", members(2, plain), plain)
    (tmp_path / "other").mkdir()
    (tmp_path / "other" / "contact_sheet.png").write_text("mine")
    words, reason = REFUSED[case]
    words = [str(word).format(tmp=tmp_path) for word in words]
    code, _, err = ufmstar("demo", "--out", tmp_path / "out", "--weights", weights, "--seed", SEED, *words)
    assert code == 2
    assert reason in err.splitlines()[-1]
    assert (tmp_path / "other" / "contact_sheet.png").read_text() == "mine"


def test_a_package_without_weights(ufmstar, tmp_path, monkeypatch):
    monkeypatch.setattr(demo, "_WEIGHTS", ("weights", "gone.safetensors"))
    code, _, err = ufmstar("demo", "--out", tmp_path / "out")
    assert (code, "weights/gone.safetensors; --weights FILE" in err) == (2, True)
    assert not (tmp_path / "out").exists()


def test_ctrl_c(monkeypatch, ufmstar):
    def interrupted(*_):
        raise KeyboardInterrupt

    monkeypatch.setattr(evaluate, "main", interrupted)
    assert ufmstar("demo") == (130, "", "ufmstar demo: interrupted\n")


# ---- the networks of the package ----


@pytest.mark.slow
def test_the_shipped_networks_are_small_and_several(tmp_path, monkeypatch):
    from ufmstar_torch.models.trained import read_info

    assert SHIPPED.stat().st_size <= 6_000_000
    info = read_info(SHIPPED)
    assert info.members >= 3
    assert "command" in json.dumps(info.info), "a checkpoint says which command trained it"
    monkeypatch.setattr(evaluate, "_report", lambda *_: 0)
    assert cli.main(["demo", "--frames", "10", "--out", str(tmp_path / "out")]) == 0
    results = load_results(tmp_path / "out", with_sums=False)
    alone, *_, star, posterior = results.rows
    figures = {(row, r.dataset): r.figures for row in results.rows for r in results.of(row)}
    assert figures[star, "familiar"]["rmse"] < figures[star, "unfamiliar"]["rmse"]
    assert figures[star, "familiar"]["entropy"] < figures[star, "unfamiliar"]["entropy"]
    assert figures[alone, "unfamiliar"]["entropy"] < figures[star, "unfamiliar"]["entropy"]
    assert figures[posterior, "unfamiliar"]["rmse"] < figures[star, "unfamiliar"]["rmse"]

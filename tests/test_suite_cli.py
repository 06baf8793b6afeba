"""The command ``ufmstar eval``: help, mistakes, dry run, tables, exit codes."""

from __future__ import annotations

import json
import logging
import signal

import pytest
from tiny_suite import TRUTH, Stub

from ufmstar_torch.eval.bench import measure as measurement
from ufmstar_torch.eval.commands.evaluate import job_from, read
from ufmstar_torch.eval.commands.options import joined
from ufmstar_torch.eval.methods.suite import names, suite_named
from ufmstar_torch.eval.report import write
from ufmstar_torch.eval.suite.tasks import warned_once


@pytest.fixture
def stubbed(monkeypatch):
    """Replace the evaluation of a sequence by a :class:`Stub`, and return the stub."""
    stub = Stub()
    monkeypatch.setattr("ufmstar_torch.eval.suite.evaluate.evaluate_sequence", stub)
    return stub


def words_for(rooms, out, *more, suite="depth-only"):
    return ["eval", "--suite", suite, "--network", TRUTH, "--root", f"rooms={rooms}", "--out", out, *more]


def test_list_names_every_suite(ufmstar):
    code, out, _ = ufmstar("eval", "--list")
    assert code == 0
    assert [line.split()[0] for line in out.splitlines()] == list(names())
    assert "Table 4: every member on every image" in out


def test_an_evaluation_ends_with_its_table_and_report(ufmstar, rooms, tmp_path, monkeypatch):
    monkeypatch.setattr(write, "_draw", lambda *_: ([], []))  # takes most of the time
    out = tmp_path / "out"
    code, text, err = ufmstar(*words_for(rooms, out, "--frames", "0:2", "--examples", "1"))
    assert code == 0, err
    assert all(name in text for name in ("DepthOnly", "UfM-DepthOnly-100K", "UfM*-DepthOnly"))
    assert (out / "tables" / "main.tex").is_file()
    assert (out / "report.html").is_file()
    assert err.count("rooms/") == 3
    about = json.loads((out / "eval.json").read_text())
    assert about["settings"] == {"frames": [0, 2, None]}
    code, again, err = ufmstar(*words_for(rooms, out, "--frames", "0:2", "--no-report"))
    assert (code, "rooms/" in err) == (0, False), "the same command computes nothing again"
    assert text.startswith(again)
    code, _, err = ufmstar(*words_for(rooms, out))
    assert code == 2
    assert "settings.frames was [0, 2, null], now [null, null, null]" in err


@pytest.mark.usefixtures("stubbed")
def test_a_network_of_no_row_is_named(ufmstar, rooms, tmp_path):
    words = words_for(rooms, tmp_path / "out", "--network", "ensemble=trained:none.safetensors", "--no-report")
    for more in ([], ["--dry-run"]):
        code, out, err = ufmstar(*words, *more)
        assert code == 0
        assert "--network ensemble=...: not used, suite depth-only has no row of it" in out + err


def test_a_signal_stops_in_good_order_and_the_same_command_goes_on(ufmstar, rooms, tmp_path, stubbed):
    raised = []

    def before(name, done):
        if (name, done) == ("birch", 1) and not raised:
            raised.append(signal.raise_signal(signal.SIGTERM))

    stubbed.before = before
    code, text, err = ufmstar(*words_for(rooms, tmp_path / "out"))
    assert code == 130
    assert "1 sequence" in text
    assert "stopped; finished rows are in " in err
    assert "records; the same command continues" in err
    assert ufmstar(*words_for(rooms, tmp_path / "out", "--no-report"))[0] == 0
    assert [name for name, _ in stubbed.asked] == ["ash", "birch", "birch", "cedar"]


def test_a_dry_run_counts_and_writes_nothing(ufmstar, rooms, tmp_path):
    words = words_for(rooms, tmp_path / "out", "--dry-run", "--frames", "1:")
    code, text, _ = ufmstar(*words)
    assert code == 0
    assert "6 rows:" in text
    lines = "".join(f"  rooms/{name}: 3 frames\n" for name in ("ash", "birch", "cedar"))
    assert f"3 sequences:\n{lines}9 frames, 18 records" in text
    assert not (tmp_path / "out").exists()


def test_several_roots_and_networks_and_a_file_of_options(rooms, tmp_path):
    words = words_for(rooms, "out", "--root", "tour:1?frames=2&size=32x48", "a=tour:2?frames=2", "--sequences", "1")
    job = job_from(read(list(map(str, words[1:]))))
    assert [item.dataset for item in job.items] == ["rooms", "tour", "a"]
    in_file = {"suite": "depth-only", "root": [f"rooms={rooms}"], "network": [TRUTH], "out": "out", "seed": 3}
    (tmp_path / "eval.json").write_text(json.dumps(in_file))
    options = read(["--config", str(tmp_path / "eval.json"), "--seed", "4"])
    assert (joined(options.data.root), options.data.seed) == (tuple(in_file["root"]), 4)
    assert len(job_from(options).items) == 3


@pytest.mark.usefixtures("stubbed")
def test_a_suite_about_efficiency_measures_once(ufmstar, rooms, tmp_path, monkeypatch):
    measured = []

    def measure(rows, networks, sequence, **how):
        measured.append(([row.method.name for row in rows], sequence.name, how["plan"].frames, how["plan"].threads))
        counted = {"rows": [], "plan": {"frames": 3}, "count": len(measured)}
        return {**counted, "sequence": {"name": sequence.name}}

    monkeypatch.setattr(measurement, "measure", measure)
    monkeypatch.setattr(measurement, "timed_networks", lambda networks, rows: networks)
    rows = ["DepthOnly", "UfM-DepthOnly", "UfM-DepthOnly-100K", "UfM*-DepthOnly"]
    (tmp_path / "timed.toml").write_text(f"efficiency = true\n[[rows]]\nmethods = {rows}\n")
    words = words_for(rooms, tmp_path / "out", "--no-report", "--threads", "1", suite=tmp_path / "timed.toml")
    code, _, err = ufmstar(*words)
    assert (code, "measuring time, energy and memory" in err) == (0, True)
    written = json.loads((tmp_path / "out" / "efficiency.json").read_text())
    assert (written["sequence"], written["count"]) == ({"name": "3 sequences"}, 2.0), "means over the sequences"
    assert [one["sequence"] for one in written["sequences"]] == ["ash", "birch", "cedar"]
    assert measured == [(rows, name, None, 1) for name in ("ash", "birch", "cedar")]
    assert written["plan"]["frames"] == 9
    assert ufmstar(*words)[0] == 0
    assert len(measured) == 3
    code, _, err = ufmstar(*words, "--network", "depth_only=ground-truth:8x8")
    assert (code, "every base once, got depth_only twice" in err) == (2, True)


def test_a_warning_of_many_streams_is_logged_once(caplog):
    logger = logging.getLogger("ufmstar_torch")
    for _ in range(2):
        with warned_once():
            for stream, text in ((0, "a frame has no segment"), (1, "a frame has no segment"), (1, "other")):
                logger.warning("stream %d: %s", stream, text)
    assert caplog.messages == 2 * ["stream 0: a frame has no segment", "stream 1: other"]


def test_a_dry_run_needs_nothing_and_states_what_is_missing(ufmstar):
    """Every row of the paper's table with its needs, without a network, a sequence or a folder."""
    code, text, err = ufmstar("eval", "--suite", "paper-table-1", "--dry-run")
    assert code == 0, err
    assert "25 rows:" in text
    lines = {line.split()[0]: line for line in text.splitlines() if "[no network]" in line}
    assert lines["Ensemble"].endswith(
        "needs several networks that predict an aleatoric variance (ensemble), ground truth"
    )
    dropout = "needs a network with dropout in its decoder that predicts an aleatoric variance (mc_dropout), poses"
    assert dropout in lines["UfM-MCD-100K"]
    assert all(f"  --network {base}=MODEL:FILE: " in text for base in suite_named("paper-table-1").bases)
    assert "no --root: folders with sequences" in text
    assert "no --out: " in text
    assert "\n0 sequences:" in text
    assert ufmstar("eval", "--dry-run")[0] == 2, "the suite is needed"


def test_a_dry_run_with_one_network_lists_the_other_rows_too(ufmstar, rooms):
    words = ("--network", TRUTH, "--root", f"rooms={rooms}", "--dry-run")
    code, text, err = ufmstar("eval", "--suite", "ablation-anchors", "--base", "depth_only", *words)
    assert code == 0, err
    assert "poses, OpenCV, ground truth" in text

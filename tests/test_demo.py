"""``ufmstar demo``: its rows against the pipeline and independent sums, its outputs, and refusals."""

from __future__ import annotations

import json
import sys
from dataclasses import replace
from importlib.resources import files
from pathlib import Path

import numpy as np
import pytest
import torch
from demo_networks import SIZE, SPEC, members, write_members
from runs import Recorder, read_summary

from ufmstar_torch import cli
from ufmstar_torch.eval.commands import demo
from ufmstar_torch.eval.commands.demo import DemoOptions
from ufmstar_torch.eval.engine.evaluate import Judge, evaluate_sequence
from ufmstar_torch.eval.engine.networks import NetworkSource
from ufmstar_torch.eval.engine.stream import FrameSink
from ufmstar_torch.eval.methods.method import UFM, UFM_STAR
from ufmstar_torch.eval.methods.suite import suite_named
from ufmstar_torch.eval.report.demo import (
    DEMO_FILES,
    ENSEMBLE,
    NETWORK,
    POSTERIOR,
    ROWS,
    DemoFrames,
    sheet_rows,
    surface_kinds,
)
from ufmstar_torch.eval.report.text import demo_explanation, demo_table
from ufmstar_torch.eval.run.colours import colour_table
from ufmstar_torch.eval.sequences.frame import Frame
from ufmstar_torch.eval.tour import make_tour, render, tour_sequence
from ufmstar_torch.models import NetworkSpec, save_trained
from ufmstar_torch.networks_in_turn import NetworksInTurn

CPU = torch.device("cpu")
FRAMES, SEED = 7, 5
SHIPPED = Path(str(files("ufmstar_torch.models").joinpath("weights", "demo.safetensors")))
NAMES = dict(zip((row.slug for row in suite_named("demo").rows), ROWS, strict=True))


@pytest.fixture(scope="module")
def weights(tmp_path_factory):
    return write_members(tmp_path_factory.mktemp("weights") / "three.safetensors")


@pytest.fixture(scope="module")
def sequence():
    """A long tour, whose first frames overlap."""
    return tour_sequence(SEED, frames=80, size=SIZE, style="mixed")


@pytest.fixture(scope="module")
def done(weights, tmp_path_factory):
    """One demo through the command line: (folder, exit code, stdout, stderr). No test may change the folder."""
    out = tmp_path_factory.mktemp("demo") / "out"
    words = ["--weights", weights, "--out", out, "--frames", FRAMES, "--seed", SEED]
    with pytest.MonkeyPatch.context() as patch:
        message = {"out": [], "err": []}
        patch.setattr("sys.stdout", Recorder(message["out"]))
        patch.setattr("sys.stderr", Recorder(message["err"]))
        code = cli.main(["demo", *map(str, words)])
    return out, code, "".join(message["out"]), "".join(message["err"])


# ---- the command ----


def test_the_command_prints_its_tables_and_where_everything_is(done):
    out, code, message, progress = done
    assert code == 0
    summary = read_summary(out)
    assert message == f"{demo_table(summary)}\n\n{demo_explanation(summary)}\n"
    for line, method in zip(message.splitlines()[1:6], ROWS, strict=True):
        figures = summary["methods"][method]["figures"]
        assert line[26:].split()[:5] == [
            f"{figures[key]:.3g}" for key in ("delta1", "nll", "ece_delta", "ece_q", "ause_rmse")
        ]
    assert "frames: done, " in progress


def test_files_and_summary(done, weights):
    out, *_ = done
    assert sorted(p.name for p in out.iterdir()) == sorted([*DEMO_FILES, "summary.json"])
    summary = read_summary(out)
    assert summary["outputs"] == dict.fromkeys(DEMO_FILES)
    for picture in ("contact_sheet.png", "calibration.png"):
        assert (out / picture).read_bytes()[:8] == b"\x89PNG\r\n\x1a\n"
    header = (out / "mixture.ply").read_bytes().split(b"end_header")[0].decode()
    assert f"element vertex {summary['components']}\n" in header
    curves = json.loads((out / "curves.json").read_text())
    assert [len(values["ece_q_observed"]) for values in curves.values()] == [10] * 5
    assert summary["program"] == "ufmstar demo"
    assert summary["tour"] == {"seed": SEED, "style": "mixed", "frames": FRAMES, "size": list(SIZE)}
    network = summary["network"]
    assert (network["file"], network["members"], len(network["sha256"])) == (weights.name, 3, 64)
    assert NetworkSpec.from_dict(network["spec"]) == SPEC


def test_times_and_memory_of_every_row(done):
    summary = read_summary(done[0])
    rows = summary["methods"]
    assert list(rows) == list(ROWS)
    assert all(rows[m]["network_ms"] == rows[NETWORK]["network_ms"] > 0 for m in (UFM, UFM_STAR, POSTERIOR))
    assert rows[ENSEMBLE]["network_ms"] > rows[NETWORK]["network_ms"], "three inferences take longer than one"
    assert rows[POSTERIOR]["uncertainty_ms"] > rows[UFM_STAR]["uncertainty_ms"] > 0 < rows[UFM]["uncertainty_ms"]
    assert rows[NETWORK]["uncertainty_ms"] is rows[ENSEMBLE]["uncertainty_ms"] is None
    assert rows[UFM]["state_bytes"] == 40 * summary["points"] > 0
    assert rows[UFM_STAR]["state_bytes"] == 64 * summary["components"] > 0
    assert rows[POSTERIOR]["state_bytes"] > rows[UFM_STAR]["state_bytes"], "with the evidence"
    assert rows[NETWORK]["state_bytes"] == rows[ENSEMBLE]["state_bytes"] == 0


# ---- the rows ----


class Collected(FrameSink):
    """Keeps every result."""

    def __init__(self):
        self.results = []

    def take(self, result):
        self.results.append(result)


def walked(networks, frames, count=FRAMES, sinks=(), names=ROWS):
    """The first frames through rows of the suite: (frame, results by the row's name) of each."""
    source = NetworkSource(NetworksInTurn(networks, preprocess=networks[0].preprocess), CPU, {})
    rows = [row for row in suite_named("demo").rows if NAMES[row.slug] in names]
    collected = Collected()
    judge = Judge({"aleatoric": source, "ensemble": source}, CPU, limit=slice(count))
    evaluate_sequence(frames, rows, judge, sinks=[collected, *sinks])
    return [(r.frame, {NAMES[slug]: row for slug, row in r.rows.items()}) for r in collected.results]


# ---- the figures by kind of room ----


def test_pixels_belong_to_the_room_they_show():
    """Against the renderer, which knows the primitive behind every pixel and its room."""
    tour = make_tour(SEED, "mixed")
    frames = tour_sequence(SEED, frames=30, size=SIZE, style="mixed")
    both = 0
    for entry in frames.entries[::3]:
        view = render(tour, torch.from_numpy(entry.T_world_cam), torch.from_numpy(frames.intrinsics), *SIZE)
        frame = Frame(0, "", None, view.depth.float().numpy(), entry.T_world_cam, frames.intrinsics)
        result = surface_kinds(tour, frame)
        rooms = tour.surfaces.rooms[view.surface].numpy()
        only = rooms[..., 1] < 0  # not the frame of a door, which belongs to two rooms
        hall = np.array([style == "hall" for style in tour.room_styles])
        assert (result[only] == hall[rooms[..., 0]][only]).mean() > 0.995
        both += 0.05 < result.mean() < 0.95
    assert both >= 2, "some frames must show both kinds through a door"


def test_figures_by_kind(sequence):
    kinds = [np.zeros(SIZE, np.int64) for _ in range(FRAMES)]
    for kind in kinds:
        kind[:, : SIZE[1] // 3] = 1
    frames = DemoFrames(NAMES, kinds)
    squares, spread = ([], []), ([], [])
    for (frame, rows), kind in zip(walked(members(), sequence, sinks=[frames]), kinds, strict=True):
        row = rows[UFM_STAR]
        for number in (0, 1):
            use = (kind == number) & (frame.depth > 0) & row.valid.numpy()
            squares[number].append((row.depth.numpy()[use].astype(float) - frame.depth[use]) ** 2)
            spread[number].append(row.variance.numpy()[use].astype(float))
    for number, figures in enumerate(frames.by_kind().values()):
        assert figures[UFM_STAR]["rmse"] == pytest.approx(np.concatenate(squares[number]).mean() ** 0.5, rel=1e-6)
        assert figures[UFM_STAR]["rms_sigma"] == pytest.approx(np.concatenate(spread[number]).mean() ** 0.5, rel=1e-6)
    assert len(frames.panels) == len(sheet_rows([False] * FRAMES))


@pytest.mark.parametrize(
    ("unfamiliar", "expected"),
    [
        ([False] * 10 + [True] * 10, [3, 6, 9, 13, 16, 19]),
        ([False] * 20, [4, 7, 10, 13, 16, 19]),
        ([True, True], [1]),
        ([False, True], [1]),
        ([False, False, True], [1, 2]),
    ],
    ids=["both", "familiar only", "two frames", "one of each", "three frames"],
)
def test_rows_of_the_sheet(unfamiliar, expected):
    rows = sheet_rows(unfamiliar)
    assert len(rows) == len(expected) == len(set(rows))
    assert all(abs(a - b) <= 1 for a, b in zip(rows, expected, strict=True))
    assert 0 not in rows
    assert rows == sorted(rows, key=lambda row: (unfamiliar[row], row))


# ---- refusals ----

REFUSED = {
    "frames": (("--frames", 1), 2, "--frames must be at least 2"),
    "seed": (("--seed", -1), 2, "--seed must be at least 0"),
    "no weights": (("--weights", "none.safetensors"), 2, "no such file: none.safetensors"),
    "no networks": (("--weights", "{tmp}/bad.safetensors"), 1, "bad.safetensors"),
    "no variance": (("--weights", "{tmp}/plain.safetensors", "--frames", 2), 1, "a variance of their own"),
    "a file": (("--out", "{tmp}/bad.safetensors"), 2, "is a file"),
    "other files": (("--out", "{tmp}/other", "--overwrite"), 2, "holds files of someone else"),
    "earlier": (("--out", "{tmp}/earlier"), 2, "holds an earlier demo: --overwrite replaces it"),
}


@pytest.mark.parametrize("case", REFUSED)
def test_refusals(ufmstar, tmp_path, weights, case):
    (tmp_path / "bad.safetensors").write_bytes(b"not this")
    plain = replace(SPEC, method="depth")
    save_trained(tmp_path / "plain.safetensors", members(1, plain), plain)
    for name, program in (("other", "ufmstar run"), ("earlier", "ufmstar demo")):
        (tmp_path / name).mkdir()
        (tmp_path / name / "summary.json").write_text(json.dumps({"program": program}))
        (tmp_path / name / "contact_sheet.png").write_text("mine")
    words, code, reason = REFUSED[case]
    words = [str(word).format(tmp=tmp_path) for word in words]
    got, _, err = ufmstar("demo", "--out", tmp_path / "out", "--weights", weights, "--seed", SEED, *words)
    assert got == code
    assert reason in err.splitlines()[-1]
    assert (tmp_path / "other" / "contact_sheet.png").read_text() == "mine"


def test_a_package_without_weights(ufmstar, tmp_path, monkeypatch):
    monkeypatch.setattr(demo, "_WEIGHTS", ("weights", "gone.safetensors"))
    code, _, err = ufmstar("demo", "--out", tmp_path / "out")
    assert (code, "weights/gone.safetensors; --weights FILE" in err) == (2, True)
    assert not (tmp_path / "out").exists()


def test_an_earlier_demo_is_replaced_and_without_matplotlib_the_figures_are_the_same(
    weights, tmp_path, monkeypatch, ufmstar, done
):
    monkeypatch.setitem(sys.modules, "matplotlib", None)
    colour_table.cache_clear()
    for name, text in (("summary.json", '{"program": "ufmstar demo"}'), ("notes.txt", "mine"), ("mixture.npz", "old")):
        (tmp_path / name).write_text(text)
    words = ("--weights", weights, "--frames", FRAMES, "--seed", SEED, "--overwrite")
    code, message, _ = ufmstar("demo", "--out", tmp_path, *words)
    assert code == 0
    again, before = (read_summary(folder)["methods"] for folder in (tmp_path, done[0]))
    assert all(again[method]["figures"] == before[method]["figures"] for method in ROWS)
    assert "no contact_sheet.png: pictures need matplotlib" in message
    assert (tmp_path / "mixture.npz").read_bytes() == (done[0] / "mixture.npz").read_bytes()
    assert (tmp_path / "notes.txt").read_text() == "mine"
    assert not (tmp_path / "contact_sheet.png").exists()


def test_ctrl_c(monkeypatch, ufmstar):
    def interrupted(*_):
        raise KeyboardInterrupt

    monkeypatch.setattr(demo, "run_demo", interrupted)
    assert ufmstar("demo") == (130, "", "ufmstar demo: interrupted\n")


# ---- the networks of the package ----


@pytest.mark.slow
def test_the_shipped_networks_are_small_and_several():
    from ufmstar_torch.models.trained import load_trained, read_info

    assert SHIPPED.stat().st_size <= 6_000_000
    info = read_info(SHIPPED)
    assert info.members >= 3
    assert "command" in json.dumps(info.info), "a checkpoint says which command trained it"
    seed = DemoOptions().seed
    frames = tour_sequence(seed, frames=40, size=info.spec.size, style="mixed")
    tour = make_tour(seed, "mixed")
    every_other = replace(frames, entries=frames.entries[::2])
    by_kind = DemoFrames(NAMES, [surface_kinds(tour, frame) for frame in every_other])
    walked(load_trained(SHIPPED), every_other, 20, [by_kind], (NETWORK, UFM_STAR, POSTERIOR))
    familiar, unfamiliar = by_kind.by_kind().values()
    assert familiar[UFM_STAR]["rmse"] < unfamiliar[UFM_STAR]["rmse"]
    assert unfamiliar[UFM_STAR]["rms_sigma"] > familiar[UFM_STAR]["rms_sigma"]
    assert unfamiliar[UFM_STAR]["rms_sigma"] > unfamiliar[NETWORK]["rms_sigma"]

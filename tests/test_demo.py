"""``ufmstar demo``: its rows against the pipeline and independent sums, its outputs, and what goes wrong."""

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
from runs import read_summary

from ufmstar_torch import UncertainDepth, cli
from ufmstar_torch.eval.commands import demo
from ufmstar_torch.eval.commands.demo import DEMO, demo_rows, sheet_rows, surface_kinds
from ufmstar_torch.eval.commands.demo_command import DemoOptions
from ufmstar_torch.eval.engine.judge import RegionMetrics
from ufmstar_torch.eval.engine.networks import NetworkSource
from ufmstar_torch.eval.engine.stream import FrameSink, FrameStream
from ufmstar_torch.eval.methods.method import UFM, UFM_STAR
from ufmstar_torch.eval.methods.ufm import UfM
from ufmstar_torch.eval.metrics import SequenceMetrics
from ufmstar_torch.eval.report.figures_curves import write_curves
from ufmstar_torch.eval.report.outputs import DEMO_FILES, ENSEMBLE, NETWORK, POSTERIOR
from ufmstar_torch.eval.report.text import demo_explanation, demo_table
from ufmstar_torch.eval.run.colours import colour_table
from ufmstar_torch.eval.run.folder import FolderError, OutputFolder
from ufmstar_torch.eval.sequences.frame import Frame
from ufmstar_torch.eval.tour import make_tour, render, tour_sequence
from ufmstar_torch.models import NetworkSpec, save_trained
from ufmstar_torch.pipeline import NetworksInTurn

METHODS = (NETWORK, UFM, UFM_STAR, POSTERIOR, ENSEMBLE)
CPU = torch.device("cpu")
FRAMES, SEED = 7, 5
SHIPPED = Path(str(files("ufmstar_torch.models").joinpath("weights", "demo.safetensors")))


@pytest.fixture(scope="module")
def weights(tmp_path_factory):
    return write_members(tmp_path_factory.mktemp("weights") / "three.safetensors")


@pytest.fixture(scope="module")
def sequence():
    """A long tour, whose first frames overlap."""
    return tour_sequence(SEED, frames=80, size=SIZE, style="mixed")


@pytest.fixture(scope="module")
def done(weights, tmp_path_factory):
    """One demo through the command line: (folder, exit code, stdout, stderr). Nobody may change the folder."""
    out = tmp_path_factory.mktemp("demo") / "out"
    words = ["--weights", weights, "--out", out, "--frames", FRAMES, "--seed", SEED]
    with pytest.MonkeyPatch.context() as patch:
        message = {"out": [], "err": []}
        patch.setattr("sys.stdout", Recorder(message["out"]))
        patch.setattr("sys.stderr", Recorder(message["err"]))
        code = cli.main(["demo", *map(str, words)])
    return out, code, "".join(message["out"]), "".join(message["err"])


class Recorder:
    """A stream that remembers; capfd is of function scope."""

    encoding = "utf-8"

    def __init__(self, parts):
        self.parts = parts

    def write(self, text):
        self.parts.append(text)
        return len(text)

    def flush(self):
        pass


# ---- the whole command ----


def test_the_command_prints_one_table_and_says_where_everything_is(done):
    out, code, message, _ = done
    assert code == 0
    lines = message.splitlines()
    for name in ("delta1", "NLL", "ECE_delta", "ECE_q", "AUSE [m]", "network ms", "+ ms", "state kB"):
        assert name in lines[0]
    assert [line[:26].strip() for line in lines[1:6]] == [
        "3 members in turn, alone", "with UfM", "with UfM*", "posterior", "all 3 members per image",
    ]  # fmt: skip
    for name in ("contact_sheet.png", "calibration.png", "mixture.ply", "summary.json"):
        assert f"{out}/{name}: " in message
    assert max(map(len, lines)) <= 130 + len(str(out))


def test_everything_is_there_and_complete(done):
    out, *_ = done
    assert sorted(p.name for p in out.iterdir()) == sorted([*DEMO_FILES, "summary.json"])
    summary = read_summary(out)
    assert summary["outputs"] == dict.fromkeys(DEMO_FILES)
    for picture in ("contact_sheet.png", "calibration.png"):
        assert (out / picture).read_bytes()[:8] == b"\x89PNG\r\n\x1a\n"
    header = (out / "mixture.ply").read_bytes().split(b"end_header")[0].decode()
    assert f"element vertex {summary['components']}\n" in header
    curves = json.loads((out / "curves.json").read_text())
    assert len(curves) == 5
    assert all(len(values["ece_q_observed"]) == 10 for values in curves.values())


def test_the_summary_says_what_made_it(done, weights):
    out, *_ = done
    summary = read_summary(out)
    assert summary["program"] == "ufmstar demo"
    assert summary["tour"] == {"seed": SEED, "style": "mixed", "frames": FRAMES, "size": list(SIZE)}
    network = summary["network"]
    assert (network["file"], network["members"]) == (weights.name, 3)
    assert network["training"] == {"note": "a test"}
    assert NetworkSpec.from_dict(network["spec"]) == SPEC
    assert len(network["sha256"]) == 64
    assert torch.__version__.startswith(summary["versions"]["torch"])
    assert summary["seconds"] > 0


def test_times_and_memory_of_every_row(done):
    summary = read_summary(done[0])
    rows = summary["methods"]
    assert list(rows) == list(METHODS)
    assert all(rows[m]["network_ms"] == rows[NETWORK]["network_ms"] > 0 for m in (UFM, UFM_STAR, POSTERIOR))
    assert rows[ENSEMBLE]["network_ms"] > rows[NETWORK]["network_ms"], "three inferences take longer than one"
    assert rows[UFM]["uncertainty_ms"] > 0
    assert rows[UFM_STAR]["uncertainty_ms"] > 0
    assert rows[POSTERIOR]["uncertainty_ms"] > rows[UFM_STAR]["uncertainty_ms"]
    assert rows[NETWORK]["uncertainty_ms"] is rows[ENSEMBLE]["uncertainty_ms"] is None
    assert rows[UFM]["state_bytes"] == 40 * summary["points"] > 0
    assert rows[UFM_STAR]["state_bytes"] == 64 * summary["components"] > 0
    assert rows[POSTERIOR]["state_bytes"] > rows[UFM_STAR]["state_bytes"], "with the evidence"
    assert rows[NETWORK]["state_bytes"] == rows[ENSEMBLE]["state_bytes"] == 0


def test_progress_goes_to_stderr(done):
    _, _, message, progress = done
    for stage in ("rooms", "kernels", "frames", "pictures"):
        assert f"{stage}: 100%" in progress
        assert f"{stage}: 100%" not in message


# ---- the rows are what they say ----


class Collected(FrameSink):
    """Keeps every result."""

    def __init__(self):
        self.results = []

    def take(self, result):
        self.results.append(result)


def walked(networks, frames, indices=None, sinks=(), keys=METHODS):
    """The frames through the demo's rows: their results."""
    source = NetworkSource(NetworksInTurn(networks, preprocess=networks[0].preprocess), CPU, {}, seeding=None)
    collected = Collected()
    rows = [row for row in demo_rows(source, CPU) if row.key in keys]
    FrameStream(frames, indices or range(FRAMES), rows).drive([collected, *sinks])
    return collected.results


@pytest.fixture(scope="module")
def compared(sequence):
    return walked(members(), sequence)


def inputs(frame):
    image = torch.from_numpy(frame.image).permute(2, 0, 1)[None]
    return image, torch.from_numpy(frame.T_world_cam)[None], torch.from_numpy(frame.intrinsics)[None]


def test_ufm_star_is_the_pipeline_with_members_in_turn(compared):
    networks = members()
    pipeline, added = UncertainDepth(networks, preprocess=networks[0].preprocess), 0.0
    for index, result in enumerate(compared):
        want, got = pipeline(*inputs(result.frame)), result.rows
        assert want.member == index % 3
        for method in (NETWORK, UFM, UFM_STAR):
            assert got[method].member == want.member
            assert torch.equal(got[method].estimate.depth, want.depth[0])
        star, own = got[UFM_STAR].estimate.variance, got[NETWORK].estimate.variance
        assert torch.equal(star.nan_to_num(-1), want.variance[0].nan_to_num(-1))
        assert torch.equal(own, want.prediction.variance[0])
        added += float((star - own).nanmean())
    assert added > 0, "the members disagree"


def test_ufm_judges_the_same_predictions(compared):
    networks, ufm = members(), UfM()
    for index, result in enumerate(compared):
        image, pose, K = inputs(result.frame)
        with torch.no_grad():
            x, K = networks[0].preprocess(image, K)
            prediction = networks[index % 3](x)
        want = ufm(prediction.depth, pose, K, prediction.aleatoric_variance)
        assert torch.equal(result.rows[UFM].estimate.variance, want.variance[0])


def test_the_ensemble_row_is_the_mixture_of_all_members(sequence, compared):
    networks, frame = members(), sequence[3]
    image, _, K = inputs(frame)
    with torch.no_grad():
        predictions = [network(network.preprocess(image, K)[0]) for network in networks]
    d = torch.stack([p.depth[0] for p in predictions]).double()
    a = torch.stack([p.aleatoric_variance[0] for p in predictions]).double()
    got = compared[3].rows[ENSEMBLE].estimate
    assert torch.allclose(got.depth.double(), d.mean(0), atol=1e-6)
    assert torch.allclose(got.variance.double(), a.mean(0) + d.var(0, correction=0), rtol=1e-5)


def test_one_network_is_no_ensemble(sequence):
    [result] = walked(members(1), sequence, range(1))
    assert tuple(result.rows) == (NETWORK, UFM, UFM_STAR, POSTERIOR)


def test_networks_without_a_variance_are_refused(ufmstar, tmp_path):
    save_trained(
        tmp_path / "plain.safetensors", members(1, replace(SPEC, method="depth")), replace(SPEC, method="depth")
    )
    words = ["--weights", tmp_path / "plain.safetensors", "--frames", 2, "--seed", SEED]
    code, _, err = ufmstar("demo", "--out", tmp_path / "out", *words)
    assert code == 1
    assert "a variance of their own" in err


# ---- the figures ----


def test_pixels_belong_to_the_room_they_show():
    """Against the renderer, which knows the primitive behind every pixel and its room."""
    tour = make_tour(SEED, "mixed")
    frames = tour_sequence(SEED, frames=30, size=SIZE, style="mixed")
    both = 0
    for entry in frames.entries[::3]:
        view = render(tour, torch.from_numpy(entry.T_world_cam), torch.from_numpy(frames.intrinsics), *SIZE)
        result = surface_kinds(
            tour, Frame(0, "", None, view.depth.float().numpy(), entry.T_world_cam, frames.intrinsics)
        )
        rooms = tour.surfaces.rooms[view.surface].numpy()
        only = rooms[..., 1] < 0  # not the frame of a door, which belongs to two rooms
        hall = np.array([style == "hall" for style in tour.room_styles])
        assert (result[only] == hall[rooms[..., 0]][only]).mean() > 0.995
        both += 0.05 < result.mean() < 0.95
    assert both >= 2, "some frames must show both kinds through a door"


def test_figures_by_kind_and_overall(sequence):
    tour = make_tour(SEED, "mixed")

    def region_of(result, row):
        kinds = surface_kinds(tour, result.frame)
        kinds[:, : SIZE[1] // 3] = 1  # so that there are both kinds in every frame
        return torch.from_numpy(kinds)

    regions, metrics = RegionMetrics(METHODS, ("a", "b"), region_of), SequenceMetrics()
    squares, spread = {"a": [], "b": []}, {"a": [], "b": []}
    for result in walked(members(), sequence, sinks=[regions]):
        frame, estimate = result.frame, result.rows[UFM_STAR].estimate
        kinds = region_of(result, None).numpy()
        metrics.update(estimate.depth, estimate.variance, torch.from_numpy(frame.depth), estimate.valid)
        for number, kind in enumerate("ab"):
            use = (kinds == number) & (frame.depth > 0) & estimate.valid.numpy()
            squares[kind].append((estimate.depth.numpy()[use].astype(float) - frame.depth[use]) ** 2)
            spread[kind].append(estimate.variance.numpy()[use].astype(float))
    by_kind, whole = regions.by_region(), regions.overall()[UFM_STAR].compute()
    for kind in "ab":
        figures = by_kind[kind][UFM_STAR]
        assert figures["rmse"] == pytest.approx(np.concatenate(squares[kind]).mean() ** 0.5, rel=1e-6)
        assert figures["rms_sigma"] == pytest.approx(np.concatenate(spread[kind]).mean() ** 0.5, rel=1e-6)
    expected = metrics.compute()
    assert whole.keys() == expected.keys()
    for name, value in expected.items():
        assert whole[name] == pytest.approx(value, rel=1e-9, nan_ok=True), name


def test_the_table_shows_the_figures_of_the_summary(done):
    summary = read_summary(done[0])
    text = demo_table(summary)
    for method in METHODS:
        for key in ("delta1", "nll", "ece_delta", "ece_q", "ause_rmse"):
            assert f"{summary['methods'][method]['figures'][key]:.3g}" in text
        for kind in ("familiar", "unfamiliar"):
            assert f"{summary['surfaces'][kind][method]['rms_sigma']:.3g}" in text
    assert done[2].startswith(text)
    assert demo_explanation(summary) in done[2]


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


# ---- what goes wrong ----


def test_a_folder_of_someone_else_is_left_alone(ufmstar, weights, tmp_path):
    (tmp_path / "summary.json").write_text('{"program": "ufmstar run"}')
    (tmp_path / "contact_sheet.png").write_text("mine")
    code, _, err = ufmstar("demo", "--out", tmp_path, "--weights", weights, "--overwrite")
    assert code == 2
    assert "holds files of someone else" in err
    assert (tmp_path / "contact_sheet.png").read_text() == "mine"
    (tmp_path / "file").write_text("")
    assert "is a file" in ufmstar("demo", "--out", tmp_path / "file", "--weights", weights)[2]


def test_an_earlier_demo_is_replaced_only_when_asked(done, tmp_path):
    for name in ("summary.json", "mixture.ply"):
        (tmp_path / name).write_bytes((done[0] / name).read_bytes())
    (tmp_path / "notes.txt").write_text("mine")
    with pytest.raises(FolderError, match="--overwrite replaces it"):
        OutputFolder.open(tmp_path, DEMO, {})
    assert (tmp_path / "mixture.ply").exists()
    OutputFolder.open(tmp_path, DEMO, {}, overwrite=True)
    assert sorted(p.name for p in tmp_path.iterdir()) == ["notes.txt", "summary.json"]
    OutputFolder.open(tmp_path, DEMO, {})  # one that was interrupted needs no permission


def test_missing_weights_are_named(ufmstar, tmp_path, monkeypatch):
    code, _, err = ufmstar("demo", "--out", tmp_path / "out", "--weights", tmp_path / "none.safetensors")
    assert (code, "no such file" in err, "none.safetensors" in err) == (2, True, True)
    monkeypatch.setattr(demo, "_WEIGHTS", ("weights", "gone.safetensors"))
    code, _, err = ufmstar("demo", "--out", tmp_path / "out")
    assert code == 2
    assert "weights/gone.safetensors" in err
    assert "--weights FILE" in err
    assert not (tmp_path / "out").exists()


def test_a_file_that_holds_no_networks_is_named(ufmstar, tmp_path):
    bad = tmp_path / "bad.safetensors"
    bad.write_bytes(b"not this")
    code, _, err = ufmstar("demo", "--out", tmp_path / "out", "--weights", bad)
    assert code != 0
    assert "bad.safetensors" in err
    assert len(err.strip().splitlines()) == 1


@pytest.mark.parametrize(
    ("words", "told"),
    [
        (("--frames", 1), "--frames must be at least 2"),
        (("--seed", -1), "--seed must be at least 0"),
        (("--device", "cuda:99"), "--device cuda:99 is not available"),
        (("--threads", 0), "--threads must be at least 1"),
    ],
    ids=str,
)
def test_impossible_options_are_named(ufmstar, weights, tmp_path, words, told):
    code, _, err = ufmstar("demo", "--out", tmp_path / "out", "--weights", weights, *words)
    assert code == 2
    assert told in err


def test_an_unknown_option_is_refused(capfd):
    assert cli.main(["demo", "--frame-rate", "3"]) == 2
    assert "--frame-rate" in capfd.readouterr().err


def test_without_matplotlib_there_is_still_the_same_table(weights, tmp_path, monkeypatch, ufmstar, done):
    monkeypatch.setitem(sys.modules, "matplotlib", None)
    colour_table.cache_clear()
    out = tmp_path / "out"
    code, message, _ = ufmstar("demo", "--out", out, "--weights", weights, "--frames", FRAMES, "--seed", SEED)
    assert code == 0
    again, before = (read_summary(folder)["methods"] for folder in (out, done[0]))
    assert all(again[method]["figures"] == before[method]["figures"] for method in METHODS)
    assert message.splitlines()[3].startswith("  with UfM*")
    assert "no contact_sheet.png: pictures need matplotlib" in message
    assert (out / "mixture.npz").exists()
    assert not (out / "contact_sheet.png").exists()
    assert read_summary(out)["outputs"]["curves.json"] is None


def test_ctrl_c_is_told_as_such(monkeypatch, ufmstar):
    def interrupted(*_):
        raise KeyboardInterrupt

    monkeypatch.setattr(demo, "run_demo", interrupted)
    assert ufmstar("demo") == (130, "", "ufmstar demo: interrupted\n")


# ---- the calibration picture ----


def test_the_calibration_picture_needs_something_to_draw(tmp_path):
    with pytest.raises(ValueError, match="1 to 6 methods"):
        write_curves(tmp_path / "x.png", {})
    assert not (tmp_path / "x.png").exists()


# ---- what the package brings ----


@pytest.mark.slow
@pytest.mark.skipif(not SHIPPED.is_file(), reason="the checkpoint has not been trained yet")
def test_the_shipped_networks_are_small_and_several():
    from ufmstar_torch.models.trained import load_trained, read_info

    assert SHIPPED.stat().st_size <= 6_000_000
    info = read_info(SHIPPED)
    assert info.members >= 3
    assert "command" in json.dumps(info.info), "a checkpoint says which command trained it"
    frames = tour_sequence(DemoOptions().seed, frames=40, size=info.spec.size, style="mixed")
    tour = make_tour(DemoOptions().seed, "mixed")
    kinds = ("familiar", "unfamiliar")
    shown = (NETWORK, UFM_STAR)
    regions = RegionMetrics(shown, kinds, lambda result, _: torch.from_numpy(surface_kinds(tour, result.frame)))
    walked(load_trained(SHIPPED), frames, range(0, 40, 2), [regions], shown)
    outcome = regions.by_region()
    assert outcome["familiar"][UFM_STAR]["delta1"] > 0.6
    assert outcome["unfamiliar"][UFM_STAR]["rms_sigma"] > outcome["familiar"][UFM_STAR]["rms_sigma"]
    assert outcome["unfamiliar"][UFM_STAR]["nll"] < outcome["unfamiliar"][NETWORK]["nll"]

"""The command line: messages, exit codes, options and configuration files, and the installed command."""

from __future__ import annotations

import io
import json
import os
import shutil
import signal
import subprocess
import sys
import types

import numpy as np
import pytest
from layouts import write_generic
from runs import Brightness, outputs, read_summary
from shared_data import require_shared

from ufmstar_torch import SPGFConfig, UfMStarConfig, cli
from ufmstar_torch.eval.commands.run import read
from ufmstar_torch.eval.engine import load as sources
from ufmstar_torch.models import Preprocess


@pytest.fixture
def brightness(monkeypatch, tmp_path):
    """Make ``--model any --weights FILE`` load a :class:`Brightness` whose gain is the file's content.

    Returns the files and settings: the action of a network at a call, and the width of its images.
    """
    fake = types.SimpleNamespace(
        files=[tmp_path / "first.pt", tmp_path / "second.pt"], at=None, then=None, width=lambda: 32
    )
    for file, gain in zip(fake.files, ("1.0", "1.1"), strict=True):
        file.write_text(gain)

    def load(name, weights, **options):
        assert (name, options) == ("any", {})
        network = Brightness(float(weights.read_text()), spread=0.02, at=fake.at, then=fake.then)
        network.preprocess = Preprocess(size=(24, fake.width()))
        return network

    monkeypatch.setattr(sources, "load_network", load)
    return fake


QUICK = ("--no-video", "--no-sheet")


# ---- help and mistakes ----


def test_help_lists_the_commands(ufmstar):
    code, out, err = ufmstar("--help")
    assert (code, err) == (0, "")
    assert "\n  bench        " in out
    assert ufmstar()[0] == 2
    assert ufmstar("--version")[:2] == (0, "0.1.0\n")


HEAVY = ("torch", "numba", "scipy", "cv2", "PIL", "pandas", "matplotlib", "onnx", "transformers", "lightning")


def test_help_imports_no_heavy_package():
    """All commands run in one process; train is the last, since its options contain settings from modules that import
    torch."""
    commands = [*sorted(cli.COMMANDS, key="train".__eq__), None]
    words = [["eval", "--list"], *([name, "--help"] for name in commands[:-1])]
    program = (
        "import contextlib, io, sys; import ufmstar_torch; before = set(sys.modules)\n"
        "from ufmstar_torch.cli import main\n"
        f"for words in {[['--help'], *words]!r}:\n"
        "    with contextlib.redirect_stdout(io.StringIO()) as out, contextlib.suppress(SystemExit): main(words)\n"
        "    new = {name.partition('.')[0] for name in set(sys.modules) - before}\n"
        "    new -= {'ufmstar_torch', *sys.stdlib_module_names}\n"
        f"    print(*words, len(out.getvalue()) > 200, *(new if words == ['--help'] else new & {set(HEAVY)!r}))\n"
    )
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    *others, train = done.stdout.splitlines()
    assert (others, done.stderr) == ([" ".join(one) + " True" for one in [["--help"], *words[:-1]]], "")
    assert train in ("train --help True", "train --help True torch")


NETWORK = "--model fastdepth --weights {path}/K.txt"
EVAL = "ufmstar eval --suite depth-only --network depth_only=ground-truth:24x32 --root d={path} --out {out}"
# Options of ``ufmstar run SEQUENCE --out OUT``, or a whole command line; and part of the message.
MISTAKES = {
    "unknown command": ("ufmstar walk", "no command 'walk', there are demo, run, rank, eval,"),
    "no sequence": ("ufmstar run", "sequence"),
    "no out": ("ufmstar run {path} --depth self", "out"),
    "no such sequence": ("ufmstar run /nowhere --depth self --out {out}", "no such file or folder: /nowhere"),
    "someone else's folder": ("ufmstar run {path} --depth self --out {path}", "files of someone else"),
    "no depth": ("", "--model NAME --weights FILE"),
    "two depths": ("--depth self --model x --weights y", "not both"),
    "no weights": ("--model fastdepth", "needs --weights FILE"),
    "missing weights": ("--model fastdepth --weights /nowhere/w.onnx", "no such file: /nowhere/w.onnx"),
    "wrong model": ("--model fastdeth --weights {path}/K.txt", "unknown network 'fastdeth', expected one of"),
    "broken weights": ("--model onnx --weights {path}/K.txt", "needs a spec"),
    "spec": ("--model fastdepth --weights {path}/K.txt --spec {path}/K.txt", "does not take ['spec']"),
    "no maps": ("--depth /nowhere", "no such folder: /nowhere"),
    "variance": ("--depth self --variance x", "--variance goes with --depth DIR only"),
    "size without maps": ("--model x --weights y --size 2x2", "--size goes with --depth only"),
    "full with one": ("--model x --weights y --mode full", "--mode full needs several --weights"),
    "unknown option": ("--depth self --eta 1", "--eta"),
    "out of range": ("--depth self --set eta=3", "UfMStarConfig.eta must lie in (0.0, 1.0], got 3"),
    "frames": ("ufmstar run /nowhere --depth self --out {out} --frames 3", "START:STOP"),
    "no frames": ("--depth self --frames 9:", "selects none of the 6"),
    "size": ("--depth self --size 24", "--size must be HxW"),
    "plug-in in a configuration": (
        "--depth self --config {plugin}",
        "plugin allows code to run: type it on the command line",
    ),
    "trust in a configuration": (
        "--depth self --config {trust}",
        "trust_code allows code to run: type it on the command line",
    ),
    "trust without a program": (
        "--model fastdepth --weights a --trust-code",
        "--trust-code goes with --model exported",
    ),
    "size beyond memory": (
        "--depth self --size 99999999x99999999",
        "--size would have 99999999 x 99999999 pixels, more than the limit of 89,478,485 pixels",
    ),
    "intrinsics": ("ufmstar run /nowhere --depth self --out {out} --intrinsics 1 2", "fx fy cx cy"),
    "layout": ("--depth self --layout tum", "looked for rgb.txt"),
    "no poses": ("ufmstar run {path}/images --depth self --layout generic --out {out}", "pass trajectory"),
    "device": ("--depth self --device abacus", "--device abacus"),
    "no data": ("--depth self --device meta", "--device meta is not"),
    "threads": ("--depth self --threads 0", "--threads"),
    "threads without measure": ("--depth self --threads 10000", "--threads must be 1 to"),
    "report": ("ufmstar report", "Missing from ufmstar report: OUT The folder of `ufmstar eval`. (required)"),
    "bench: kind": ("ufmstar bench --frames x", "frames"),
    "bench: frames": ("ufmstar bench --frames 0", "--frames must be at least 1"),
    "bench: history": ("ufmstar bench --history 0", "--history must be at least 1"),
    "bench: network": ("ufmstar bench", "the network is missing: give --model NAME --weights FILE"),
    "bench: device": (f"ufmstar bench --device cuda:99 {NETWORK}", "--device cuda:99 is not available"),
    "live: network": ("ufmstar live tour:3", "live needs a network"),
    "live: camera": (f"ufmstar live 0 {NETWORK}", "0 needs --trajectory FILE"),
    "live: folder": (f"ufmstar live images --follow --intrinsics 1 1 1 1 {NETWORK}", "images needs --trajectory FILE"),
    "live: overwrite": (f"ufmstar live - --overwrite {NETWORK}", "--overwrite goes with --out"),
    "live: trajectory": (f"ufmstar live - --trajectory t.txt {NETWORK}", "--trajectory does not go with -: each line"),
    "live: drive": (f"ufmstar live - --reader drive=3 {NETWORK}", "--reader drive goes with recordings, not with -"),
    "live: fps": (f"ufmstar live - --fps 3 {NETWORK}", "--fps goes with recordings, not with -"),
    "live: speed": (f"ufmstar live tour:3 --speed 0 {NETWORK}", "--speed must be positive"),
    "live: intrinsics": (f"ufmstar live /nowhere --intrinsics 1 2 {NETWORK}", "--intrinsics must be a file"),
    "live: scale": (f"ufmstar live tour:3 --scale-from network {NETWORK}", "--scale-from goes with ufmstar run"),
    "live: anchors": (f"ufmstar live tour:3 --plain --set anchors.half_life=5 {NETWORK}", "needs --anchors"),
    "live: layout": (f"ufmstar live {{path}}/images {NETWORK}", "has no known layout"),
    "data: no command": ("ufmstar data", "PATH A sequence, or a folder below which there are sequences. (required)"),
    "data: another command": ("ufmstar data mend x", "mend"),
    "data: no folder": ("ufmstar data check /nowhere", "no such file or folder"),
    "data: layout": ("ufmstar data check {path}/images", "has no known layout: expected images"),
    "data: poses": ("ufmstar data check {path} --poses upside-down", "Expected one of ('camera-to-world'"),
    "data: pairs": ("ufmstar data check {path} --pairs 0", "pairs must be at least 1"),
    "data: intrinsics": (
        "ufmstar data check {path} --intrinsics 1 2 3",
        "--intrinsics must be a file, or the four numb",
    ),
    "data: reader": (
        "ufmstar data check {path} --reader depth_intrinsics=1,2",
        "--reader depth_intrinsics must be a file",
    ),
    "rank: part": ("ufmstar rank {tour} --depth self --by epistemic --out {out}", "comes with no epistemic variance"),
    "rank: anchors": ("ufmstar rank {tour} --depth self --by anchored --out {out}", "--by anchored needs --anchors"),
    "rank: count": ("ufmstar rank {tour} --depth self --count 0 --out {out}", "--count must be at least 1"),
    "rank: measured": ("ufmstar rank {tour} --depth self --measured 2 --out {out}", "--measured must be a share"),
    "rank: depth": ("ufmstar rank {tour} {path} --depth a --out {out}", "--depth DIR goes with one sequence"),
    "eval: nothing": ("ufmstar eval", "--suite is missing"),
    "eval: no network": ("ufmstar eval --suite depth-only --root x --out o", "--network is missing"),
    "eval: no file": (f"{EVAL} --suite /nowhere/mine.toml", "/nowhere/mine.toml"),
    "eval: base twice": (f"{EVAL} --network depth_only=ground-truth", "every base once, got depth_only twice"),
    "eval: spec": (f"{EVAL} --network depth_only=torchscript:n.ts --spec s", "--spec must be a file *.json"),
    "eval: no root": (f"{EVAL} --root /nowhere", "no such file or folder: /nowhere"),
    "eval: frames": (f"{EVAL} --root /nowhere --frames 5", "--frames must be START:STOP"),
    "eval: two kinds of processes": (f"{EVAL} --processes 2 --scheduler tcp://h:1", "give one of them"),
    "eval: processes": (f"{EVAL} --processes 0", "--processes must be at least 1"),
    "eval: sequences": (f"{EVAL} --sequences 0", "--sequences must be at least 1"),
    "eval: list": (f"{EVAL} --sequence-list /nowhere.txt", "/nowhere.txt"),
    "demo: frames": ("ufmstar demo --frames 1 --out {out}", "--frames must be 2 to 150"),
    "demo: seed": ("ufmstar demo --seed -1 --out {out}", "--seed must be at least 0"),
    "anchors": ("--depth self --plain --set anchors.half_life=10", "--set anchors.* needs --anchors"),
    "posterior": ("--depth self --plain --set posterior.half_life=9", "--set posterior.* needs the posterior"),
    "export": ("ufmstar export {path} --to depth", "no output of `ufmstar run`"),
}


@pytest.mark.parametrize("mistake", MISTAKES)
def test_a_mistake_is_reported_in_one_line(ufmstar, path, tmp_path, mistake):
    line, expected = MISTAKES[mistake]
    line = line if line.startswith("ufmstar") else f"ufmstar run {{path}} {line} --out {{out}}"
    (tmp_path / "plugin.json").write_text('{"plugin": ["a.py"]}')
    (tmp_path / "trust.json").write_text('{"trust_code": true}')
    files = {"plugin": tmp_path / "plugin.json", "trust": tmp_path / "trust.json"}
    names = {**files, "path": path, "out": tmp_path / "out", "tour": "tour:5?frames=3&size=64x96"}
    code, out, err = ufmstar(*line.format(**names).split()[1:])
    assert (code, out) == (2, "")
    assert err.startswith("ufmstar")
    assert expected in err
    assert err.count("\n") == 1, err
    assert not (tmp_path / "out").exists()


def test_debug_shows_the_traceback(ufmstar, tmp_path):
    code, _, err = ufmstar("run", "/nowhere", "--depth", "self", "--out", tmp_path / "out", "--debug")
    assert code == 2
    assert "Traceback" in err


@pytest.mark.parametrize(
    ("words", "unbuffered"),
    [(["--help"], ""), (["--help"], "1"), (["run", "--help"], "1"), (["eval", "--list"], ""),
     pytest.param(["data", "check", "{path}"], "", marks=pytest.mark.slow)],
)  # fmt: skip
def test_a_reader_that_closes_the_output_ends_the_command_quietly(words, unbuffered, path):
    """As ``ufmstar eval --list | head -1`` does."""
    command = [sys.executable, "-m", "ufmstar_torch.cli", *(word.format(path=path) for word in words)]
    closed, output = os.pipe()
    os.close(closed)
    environment = {**os.environ, "PYTHONUNBUFFERED": unbuffered}
    ended = subprocess.run(command, stdout=output, stderr=subprocess.PIPE, text=True, env=environment, check=False)
    os.close(output)
    assert ended.returncode == cli.CLOSED
    assert not [text for text in ("failed", "Broken pipe", "Traceback", "Exception") if text in ended.stderr]


def test_a_process_without_an_output_runs_a_command():
    """As ``ufmstar --version >&-`` does."""
    code = "import sys; sys.stdout = None; from ufmstar_torch.cli import main; sys.exit(main(['--version']))"
    ended = subprocess.run([sys.executable, "-c", code], stderr=subprocess.PIPE, text=True, check=False)
    assert (ended.returncode, ended.stderr) == (0, "")


@pytest.mark.parametrize(
    ("words", "expected"),
    [(["run", "x", "--poses", "foo"], "invalid choice 'foo' for argument '--poses'"),
     (["data", "check", "grün \udcff"], "gr\\xfcn \\udcff")],
)  # fmt: skip
def test_messages_do_not_depend_on_the_encoding_of_the_terminal(words, expected, tmp_path, path, monkeypatch):
    """Also an option's error, which tyro frames in other letters; a file's name that it cannot show is escaped."""
    shutil.copytree(path, tmp_path / "grün \udcff")
    monkeypatch.chdir(tmp_path)
    output = io.BytesIO()
    for name, errors in (("stdout", "strict"), ("stderr", "backslashreplace")):  # as Python opens them
        stream = io.TextIOWrapper(output, "ascii", errors, write_through=True)
        monkeypatch.setattr(sys, name, stream)
    assert cli.main(words) in (cli.OK, cli.FAILED, cli.USAGE)
    text = output.getvalue().decode("ascii")
    assert expected in text
    assert "Error:" not in text


# ---- options ----


def test_settings_come_from_a_file_and_options(ufmstar, path, tmp_path):
    (tmp_path / "c.toml").write_text("frames = '1:5:2'\n[set]\neta = 0.4\nema_alpha = 1\nsegment.min_rows = 2\n")
    words = ("--config", tmp_path / "c.toml", "--set", "eta=0.3", "--preset", "tartanair_indoor")
    assert ufmstar("run", path, "--depth", "self", *words, *QUICK, "--out", tmp_path / "out")[0] == 0
    settings = read_summary(tmp_path / "out")["settings"]
    assert settings["set"]["eta"] == 0.3
    assert settings["set"]["ema_alpha"] == 1
    assert settings["set"]["on_bad_frame"] == "skip"
    expected = {**SPGFConfig.preset("tartanair_indoor").to_dict(), "min_rows": 2}
    assert settings["set"]["segment"] == expected
    lines = [json.loads(line) for line in (tmp_path / "out" / "frames.jsonl").read_text().splitlines()]
    assert [line["index"] for line in lines] == [1, 3]


def test_the_papers_settings_by_name():
    words = ["walk", "--depth", "self", "--out", "out", "--plain", "--ufm-preset", "paper", "--set", "eta=0.4"]
    assert read(words).config == UfMStarConfig.paper().replace(eta=0.4, on_bad_frame="skip")
    assert read([*words, "--set", "segment.min_rows=8"]).config.segment.min_rows == 8
    mixed = read([*words, "--preset", "tum"]).config
    assert (mixed.segment, mixed.regression) == (SPGFConfig.preset("tum"), "neighbourhood")


def test_the_settings_in_a_summary_are_a_configuration_file(ufmstar, path, tmp_path):
    words = ("run", path, "--depth", "self", "--set", "eta=0.3", "--frames", ":2", *QUICK)
    ufmstar(*words, "--out", tmp_path / "a")
    (tmp_path / "c.json").write_text(json.dumps(read_summary(tmp_path / "a")["settings"]))
    code, _, err = ufmstar("run", path, "--config", tmp_path / "c.json", "--out", tmp_path / "b")
    assert code == 0, err
    settings = read_summary(tmp_path / "b")["settings"]
    assert settings["set"]["eta"] == 0.3
    assert settings["frames"] == ":2"
    assert (tmp_path / "a" / "frames" / "8.npz").read_bytes() == (tmp_path / "b" / "frames" / "8.npz").read_bytes()


def test_options_of_the_sequence_arrive(ufmstar, tmp_path):
    path, truth = write_generic(tmp_path, frames=3)
    (path / "poses.txt").rename(tmp_path / "elsewhere.txt")
    (path / "K.txt").unlink()
    (path / "depth").rename(tmp_path / "measured")
    K = [truth.K[0, 0], truth.K[1, 1], truth.K[0, 2], truth.K[1, 2]]
    words = ("--trajectory", tmp_path / "elsewhere.txt", "--intrinsics", *K, "--truth", tmp_path / "measured")
    code, _, err = ufmstar(
        "run", path, *words, "--truth-scale", "0.002", "--depth", "self", "--size", "24x32", *QUICK,
        "--out", tmp_path / "out",
    )  # fmt: skip
    assert code == 0, err
    with np.load(tmp_path / "out" / "frames" / "7.npz") as stored:
        np.testing.assert_allclose(stored["depth"], 2 * truth.depths[0][1::2, 1::2], atol=2e-3)
    summary = read_summary(tmp_path / "out")
    assert summary["prediction"]["intrinsics"][0] == pytest.approx(K[0] / 2)


# ---- runs ----


def test_a_run_prints_its_table_and_outputs(ufmstar, path, tmp_path, brightness):
    code, out, err = ufmstar(
        "run", path, "--model", "any", "--weights", *brightness.files, *QUICK, "--out", tmp_path / "out"
    )
    assert code == 0
    summary = read_summary(tmp_path / "out")
    lines = out.splitlines()
    assert lines[1].split()[:2] == ["posterior", f"{summary['metrics']['delta1']:.3g}"]
    assert lines[2].split()[:3] == ["UfM*,", "anchored", f"{summary['ufm']['metrics']['delta1']:.3g}"]
    assert lines[3].split()[5] == f"{summary['network_alone']['nll']:.3g}"
    assert f"{summary['mixture']['components']} components in " in out
    assert lines[-1] == "ufmstar run: finished: 6 of 6 frames"
    first, *_, last = (line for line in err.splitlines() if "frames" in line)
    assert (first, last) == ("frames: 0 of 6", "frames: done, 6 of 6")
    assert "%" not in err
    assert [file["name"] for file in summary["source"]["files"]] == ["first.pt", "second.pt"]


def test_other_weights_under_the_same_name_do_not_go_on(ufmstar, path, tmp_path, brightness):
    words = ("run", path, "--model", "any", "--weights", *brightness.files, *QUICK, "--out", tmp_path / "out")
    assert ufmstar(*words)[0] == 0
    brightness.files[1].write_text("1.2")
    code, _, err = ufmstar(*words)
    assert code == 2
    assert "source.files.1.sha256 was" in err
    assert ufmstar(*words, "--overwrite")[0] == 0


def test_members_must_want_the_same_input(ufmstar, path, tmp_path, brightness):
    brightness.width = iter((32, 33)).__next__
    code, _, err = ufmstar("run", path, "--model", "any", "--weights", *brightness.files, "--out", tmp_path / "out")
    assert code == 2
    assert "same input" in err


def test_a_signal_ends_the_run_after_the_frame_in_hand(ufmstar, path, tmp_path, brightness):
    words = ("run", path, "--model", "any", "--weights", *brightness.files, *QUICK)
    assert ufmstar(*words, "--out", tmp_path / "whole")[0] == 0
    before = signal.getsignal(signal.SIGINT)
    brightness.at, brightness.then = 1, lambda: os.kill(os.getpid(), signal.SIGINT)
    code, _, err = ufmstar(*words, "--out", tmp_path / "out")
    assert code == 130
    assert "stopping after this frame" in err
    assert "interrupted: stopped by the user after 3 of 6 frames; the same command" in err
    assert signal.getsignal(signal.SIGINT) is before
    assert read_summary(tmp_path / "out")["state"] == "interrupted"
    brightness.at = None
    assert ufmstar(*words, "--out", tmp_path / "out")[0] == 0
    whole, again = outputs(tmp_path / "whole"), outputs(tmp_path / "out")
    for result in (whole, again):
        del result["summary.json"]["settings"]["out"]
    assert whole == again


def test_a_second_signal_ends_it_at_once(ufmstar, path, tmp_path, brightness):
    def twice():
        os.kill(os.getpid(), signal.SIGINT)
        os.kill(os.getpid(), signal.SIGINT)

    brightness.at, brightness.then = 1, twice
    words = ("run", path, "--model", "any", "--weights", *brightness.files, *QUICK, "--out", tmp_path / "out")
    assert ufmstar(*words)[0] == 130
    assert read_summary(tmp_path / "out")["frames"]["done"] == 2


def test_an_error_inside_a_network(ufmstar, path, tmp_path, brightness):
    def fail():
        raise RuntimeError("two\nlines")

    brightness.at, brightness.then = 0, fail
    words = ("run", path, "--model", "any", "--weights", brightness.files[0], *QUICK, "--out", tmp_path / "out")
    code, _, err = ufmstar(*words)
    assert code == 1
    assert err.splitlines()[-1] == "ufmstar run: failed: two lines"
    assert "Traceback" not in err


# ---- the real thing ----


@pytest.mark.slow
def test_fastdepth_on_a_real_sequence(ufmstar, tmp_path):
    sequence = require_shared("data/rgbd_dataset_freiburg1_xyz")
    weights = require_shared("weights/fastdepth_nyu.onnx")
    words = ("--plain", "--frames", "0:3", "--distortion", "none", "--threads", "1", "--out", tmp_path / "out")
    code, _, err = ufmstar("run", sequence, "--model", "fastdepth", "--weights", weights, *words)
    assert code == 0, err
    assert "Warning" not in err
    summary = read_summary(tmp_path / "out")
    assert summary["frames"]["done"] == summary["frames"]["with_ground_truth"] == 3
    assert summary["prediction"]["size"] == [224, 224]
    # Reference values from ONNX Runtime, Pillow and NumPy alone, except the pixel of the ground truth.
    assert summary["metrics"]["abs_rel"] == pytest.approx(0.3756, abs=0.003)
    assert summary["metrics"]["delta1_ratio"] == pytest.approx(0.4987, abs=0.003)
    assert 20 < summary["mixture"]["components"] < 100
    assert 0 < summary["uncertainty"]["mean_sigma"] < 1
    made = ["mixture.ply", "mixture.npz", "contact_sheet.png", "preview.mp4"]
    assert all((tmp_path / "out" / name).stat().st_size > 500 for name in made)


def test_the_progress_of_kernels_states_why_they_take_long(capsys, monkeypatch):
    """Progress is printed every half minute if standard error is a file."""
    from ufmstar_torch.eval.commands.terminal import Bars
    from ufmstar_torch.eval.engine.progress import Progress

    clock = iter(range(0, 1000, 16))
    monkeypatch.setattr("ufmstar_torch.eval.commands.terminal.monotonic", lambda: next(clock))
    with Bars() as bars:
        for done in range(5):
            bars.show(Progress("kernels", done, 5))
        bars.show(Progress("kernels", 5, 5))
    first, *between, last = capsys.readouterr().err.splitlines()
    assert first.startswith("kernels: 0 of 5 (loaded, or compiled if this computer has not run them yet")
    assert between == ["kernels: 1 of 5", "kernels: 3 of 5"]
    assert last == "kernels: done, 5 of 5"

"""The plug-in example own_method.py: a method, a metric and a reader, in eval, report, run and data check."""

from __future__ import annotations

import json
import shutil
from importlib.metadata import EntryPoint
from pathlib import Path

import layouts
import numpy as np
import own_method as example
import pytest

from ufmstar_torch import cli
from ufmstar_torch.eval.methods.method import Method
from ufmstar_torch.eval.report import write
from ufmstar_torch.eval.sequences import find_sequences, open_sequence, plugins
from ufmstar_torch.eval.sequences.lens import Lens

FOLDER = Path(example.__file__).parent
PLUGIN = str(FOLDER / "own_method.py")
SUITE = str(FOLDER / "own_method.toml")
NETWORK = "depth_only=ground-truth"


@pytest.fixture(scope="module")
def walk(tmp_path_factory):
    """A sequence in the example's layout, whose images encode the depth."""
    scene = layouts.truth(layouts.resized(500, 510, 310, 245, (480, 640)))
    path = tmp_path_factory.mktemp("data") / "walk.npz"
    depths, poses = np.float32(scene.depths), np.array(scene.T_world_cam)
    np.savez(path, images=np.array(scene.images), depths=depths, poses=poses, K=scene.K)
    return path, scene


def evaluate(path, out, *words):
    rest = ("--plugin", PLUGIN, "--network", NETWORK, "--root", str(path), "--out", str(out), *words)
    return cli.main(["eval", "--suite", SUITE, *rest])


def test_eval_and_report_show_them(walk, tmp_path, capfd, monkeypatch):
    path, _ = walk
    assert evaluate(path, tmp_path / "out", "--no-report") == 0
    table = capfd.readouterr().out
    assert "tenth-DepthOnly" in table
    assert "within_2_sigma" in table
    record = json.loads((tmp_path / "out/records/npz/walk/tenth-DepthOnly.json").read_text())
    assert record["figures"]["own.within_2_sigma"] == 1  # perfect depth
    assert record["figures"]["rmse"] == 0
    shutil.rmtree(tmp_path / "out" / "cache", ignore_errors=True)
    monkeypatch.setattr(write, "_draw", lambda *_: ([], []))  # takes most of the time
    assert cli.main(["report", str(tmp_path / "out")]) == 0  # without the plug-in
    assert "within_2_sigma" in (tmp_path / "out" / "report.html").read_text()
    settings = json.loads((tmp_path / "out" / "eval.json").read_text())["settings"]
    assert settings["plugin"] == [PLUGIN]
    assert evaluate("tour:1?frames=3&size=48x64", tmp_path / "tour", "--no-report") == 0


def test_the_reader_is_everywhere(walk, tmp_path):
    path, scene = walk
    sequence = open_sequence(path, plugin=[PLUGIN])
    assert sequence.layout == "npz"
    np.testing.assert_array_equal(sequence[3].image, scene.images[3])
    lens = Lens.of(scene.K, layouts.SIZE, (0.2, -0.3, 0.0, 0.0))
    undistorted = open_sequence(path, plugin=[PLUGIN], distortion=(0.2, -0.3, 0, 0))[3]
    np.testing.assert_allclose(undistorted.intrinsics, lens.K, atol=1e-12)
    assert (undistorted.image != scene.images[3]).any()
    np.testing.assert_allclose(sequence[3].depth, scene.depths[3], rtol=1e-6)
    assert [one.layout for one in find_sequences(path.parent, plugin=[PLUGIN])] == []  # skips files
    assert [one.layout for one in find_sequences(path, plugin=[PLUGIN])] == ["npz"]
    assert cli.main(["data", "check", str(path), "--plugin", PLUGIN]) == 0
    out = tmp_path / "out"
    words = ["run", str(path), "--plugin", PLUGIN, "--depth", "self", "--no-video", "--no-sheet", "--out", str(out)]
    assert cli.main(words) == 0
    assert "own.within_2_sigma" in json.loads((out / "summary.json").read_text())["metrics"]
    words = ["--sequence", str(path), "--plugin", PLUGIN]
    assert cli.main(["export", str(out), "--to", "transforms", *words]) == 0
    assert len(open_sequence(out / "export" / "transforms")) == 6
    with pytest.raises(ValueError, match="has no known layout"):
        open_sequence(path)


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ("x = 1", "has none of READERS, METHODS, METRICS"),
        ("READERS = {'mine': 3}", "readers: 'mine' lacks detect"),
        ("READERS = ['mine']", "READERS must be a dict by name"),
        ("METHODS = {3: print}", "METHODS must be a dict by name"),
        ("METRICS = {'Mine': 3}", "metrics: 'Mine' lacks add"),
        ("METHODS = {'My-one': print}", "methods: 'My-one' needs small letters"),
    ],
)
def test_what_is_no_plugin_is_named(walk, tmp_path, content, message):
    file = tmp_path / "mine.py"
    file.write_text(content)
    with pytest.raises(ValueError, match=message):
        open_sequence(walk[0], plugin=[str(file)])
    with pytest.raises(FileNotFoundError, match="--plugin: no such file"):
        open_sequence(walk[0], plugin=[str(tmp_path / "absent.py")])


def test_names_that_are_taken_or_unknown(walk, tmp_path, capfd):
    file = tmp_path / "taken.py"
    file.write_text("class R:\n    detect = read = LOOKED_FOR = None\nREADERS = {'tum': R}")
    with pytest.raises(ValueError, match="there is a reader 'tum' already"):
        open_sequence(walk[0], plugin=[str(file)])
    words = ["eval", "--suite", SUITE, "--network", NETWORK, "--root", "tour:5", "--out", str(tmp_path / "out")]
    assert cli.main(words) == 2
    assert "row tenth-DepthOnly: --plugin FILE.py adds yours" in capfd.readouterr().err
    for name in ("Mine-Ensemble", "alone-Ensemble", "mine-Network", "ufm-Ensemble"):
        with pytest.raises(ValueError, match="no method is called"):
            Method.parse(name)
    assert Method.parse("mine-FullEnsemble").name == "mine-FullEnsemble"


def test_installed_packages_have_entry_points(monkeypatch):
    points = {"ufmstar.methods": [EntryPoint("share", "own_method:ShareOfDepth", "ufmstar.methods")]}
    monkeypatch.setattr(plugins, "entry_points", lambda group: points.get(group, []))
    plugins._load.cache_clear()
    assert plugins.load_plugins().methods == {"share": example.ShareOfDepth}
    plugins._load.cache_clear()

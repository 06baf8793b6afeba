"""The folder that ``ufmstar export`` reads: damaged, hostile, or with links to other files."""

from __future__ import annotations

import json
import shutil

import numpy as np
import pytest
from test_export import read_ply

from ufmstar_torch import cli
from ufmstar_torch.eval.run.writers import read_frame

# A file, changes of its values (None removes an array), and part of the message.
DAMAGE = [
    ("summary.json", {"sequence": {"layout": "generic"}}, "(its sequence.name)"),
    ("summary.json", {"sequence": [1]}, "(its sequence.name)"),
    ("summary.json", {"program": "x"}, "(its program)"),
    ("summary.json", {"posterior": "x"}, "(its posterior)"),
    ("summary.json", {"posterior": {"calibration": np.nan}}, "calibration)"),
    ("frames.jsonl", {"name": 5}, "(its name)"),
    ("frames.jsonl", {"name": "../../x"}, "(its name)"),
    ("frames.jsonl", {"state": "begun"}, "(its state)"),
    ("frames.jsonl", {"index": -1}, "(its index)"),
    ("frames.jsonl", {"index": 1e300}, "(its index)"),
    ("frames.jsonl", {"timestamp": [1]}, "(its timestamp)"),
    ("frames.jsonl", {"intrinsics": [1, 2, 3, None]}, "(its intrinsics)"),
    ("frames.jsonl", {"state": "skipped", "reason": None}, "(its reason)"),
    ("frames/9.npz", {"variance": None}, "it has no array variance"),
    (
        "frames/9.npz",
        {"posterior_outlier": np.ones((48, 64), np.float32), "network_depth": None},
        "array network_depth",
    ),
    ("frames/9.npz", {"variance": np.ones((3, 3), np.float32)}, r"array variance is float32 [3, 3]"),
    ("frames/9.npz", {"T_world_cam": np.eye(3)}, "array T_world_cam is float64 [3, 3]"),
    ("frames/9.npz", {"T_world_cam": np.full((4, 4), np.nan)}, "its pose or intrinsics are not finite"),
    ("frames/9.npz", {"valid": np.ones((48, 64), np.float32)}, "array valid is float32"),
    ("frames/9.npz", {"anchors": np.ones((5, 3), np.float32)}, "array anchors is float32 [5, 3]"),
]
WHICH = {
    "summary.json": "summary.json is not that of a run",
    "frames.jsonl": "frames.jsonl, line 2 is not the record of a frame",
    "frames/9.npz": "9.npz is no frame of `ufmstar run`",
}


@pytest.mark.parametrize(("name", "changes", "said"), DAMAGE, ids=range(len(DAMAGE)))
def test_a_damaged_file_is_named_by_line_field_or_array(finished_run, tmp_path, name, changes, said, capfd):
    out = shutil.copytree(finished_run[0], tmp_path / "out", ignore=shutil.ignore_patterns("export"))
    file = out / name
    if name == "frames/9.npz":
        np.savez(file, **{key: value for key, value in (read_frame(file) | changes).items() if value is not None})
    elif name == "summary.json":
        file.write_text(json.dumps(json.loads(file.read_text()) | changes))
    else:
        first, second, *rest = file.read_text().splitlines()
        file.write_text("\n".join([first, json.dumps(json.loads(second) | changes), *rest]))
    for to in ("depth", "cloud", "tum") if name == "frames.jsonl" else ("cloud",):
        assert cli.main(["export", str(out), "--to", to]) == 2
        error = capfd.readouterr().err
        assert WHICH[name] in error
        assert said in error


@pytest.mark.parametrize("to", ["cloud", "transforms", "mcap", "rrd"])
def test_nothing_in_the_folder_names_code_or_a_recording(finished_run, tmp_path, to, capfd):
    """The summary names a plug-in, a huge tour and another folder; only the command line names the recording."""
    out, trap = tmp_path / "out", tmp_path / "trap"
    shutil.copytree(finished_run[0], out)
    (out / "evil.py").write_text(f"import os; os.mkdir({str(trap)!r})\nREADERS = {{}}\n")
    summary = json.loads((out / "summary.json").read_text())
    for sequence in ("tour:1?frames=1000000000", str(finished_run[1])):
        settings = {
            "sequence": sequence,
            "plugin": [str(out / "evil.py")],
            "images": "/etc",
            "trajectory": "/etc/passwd",
        }
        (out / "summary.json").write_text(json.dumps({**summary, "settings": settings}))
        code = cli.main(["export", str(out), "--to", to])
        said = "".join(capfd.readouterr())
        assert "--sequence SEQUENCE" in said or "rerun-sdk" in said
        assert code == 2 if to == "transforms" else code in (0, 1)
    assert not trap.exists()
    if to == "cloud":
        assert "red" not in read_ply(out / "export" / "cloud.ply").dtype.names


@pytest.mark.parametrize("link", ["export", "export/depth", "export/depth/9.png"])
def test_nothing_is_exported_through_a_link(finished_run, tmp_path, link, capfd):
    """A folder from an archive may contain links to the user's files."""
    out, victim = tmp_path / "out", tmp_path / "victim"
    shutil.copytree(finished_run[0], out, ignore=shutil.ignore_patterns("export"))
    victim.mkdir()
    (victim / "9.png").write_text("precious")
    (out / link).parent.mkdir(parents=True, exist_ok=True)
    (out / link).symlink_to(victim / "9.png" if link.endswith("png") else victim)
    assert cli.main(["export", str(out), "--to", "depth"]) == 2
    assert "is a symbolic link, through which nothing is written" in capfd.readouterr().err
    assert [(path.name, path.read_text()) for path in victim.iterdir()] == [("9.png", "precious")]

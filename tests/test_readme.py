"""The README: its code runs, CI uses its commands, its links exist."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import torch
from pages import blocks
from scipy.spatial.transform import Rotation

import scenes
from ufmstar_torch.gaussians.camera import resize_intrinsics

ROOT = Path(__file__).resolve().parents[1]
README = (ROOT / "README.md").read_text()


def test_the_example_runs(tmp_path, monkeypatch, capsys):
    (code,) = blocks(README)
    assert len([line for line in code.splitlines() if line.strip()]) <= 15
    depths, poses, K = scenes.sequence(3, 48, 64, 0.05)
    pictures = [np.repeat(np.nan_to_num(d * 40).clip(0, 255).astype(np.uint8)[..., None], 3, 2) for d in depths]
    monkeypatch.chdir(tmp_path)
    # A pose every 50 ms, an image at each of them and one 2 s later.
    lines = [[0.05 * i, *T[:3, 3], *Rotation.from_matrix(T[:3, :3]).as_quat()] for i, T in enumerate(poses)]
    np.savetxt("poses.txt", lines, fmt="%.9f")
    video = [(0.05 * i, picture) for i, picture in enumerate(pictures)] + [(2.1, pictures[-1])]
    calibrated = resize_intrinsics(torch.tensor(K), (48, 64), (480, 640)).numpy()
    scope = {"video": video, "K_calibrated": calibrated, "my_network": lambda x: x[:, :1] * 255 / 40}
    exec(compile(code, "README.md", "exec"), scope)
    assert scope["out"].std.shape == (1, 224, 224)
    torch.testing.assert_close(scope["out"].intrinsics[0], resize_intrinsics(torch.tensor(K), (48, 64), (224, 224)))
    assert len(capsys.readouterr().out.splitlines()) == 3
    assert (tmp_path / "state.pt").exists()


def test_both_commands_are_one_line_each():
    main, tests, recording = blocks(README, "bash")
    assert all(len(block.strip().splitlines()) == 1 for block in (main, tests, recording))
    assert main.strip().endswith("ufmstar demo"), "the main job needs no file of the user"
    assert "ufmstar run" in recording
    assert tests.strip().endswith("pytest")
    between = README.split("<!-- test-command -->")[1].split("<!-- end -->")[0]
    assert tests in between, "CI runs the lines between the markers"


def test_links_and_pictures_exist():
    for document in [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *(ROOT / "docs").rglob("*.md")]:
        for target in re.findall(r"\]\(([^)#]+)\)", document.read_text()):
            if not target.startswith("http"):
                assert (document.parent / target).exists(), f"{document.name}: {target}"


def test_nothing_names_a_machine():
    for document in [
        ROOT / "README.md",
        ROOT / "CHANGELOG.md",
        ROOT / "CONTRIBUTING.md",
        *(ROOT / "docs").rglob("*.md"),
    ]:
        text = document.read_text()
        assert not re.search(r"(?<![\w.])/(work|opt|tmp|home|root)/", text), document
        assert not re.search(r"[A-Z]+_TABLE|TODO|FIXME", text), document

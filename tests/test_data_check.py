"""ufmstar data check on good and on spoilt recordings; and the commands of docs/data.md."""

from __future__ import annotations

import json
import re
import shutil
from pathlib import Path

import layouts
import layouts_more
import numpy as np
import pytest
from pages import blocks
from shared_data import require_shared

from ufmstar_torch.cli import main
from ufmstar_torch.eval.check.data_check import check_data, lines
from ufmstar_torch.eval.sequences.ground_truth import register_depth
from ufmstar_torch.eval.tour import export_tour
from ufmstar_torch.eval.tour.sequence import open_tour
from ufmstar_torch.gaussians.conventions import CONVENTIONS

PAGE = Path(__file__).resolve().parents[1] / "docs" / "data.md"
SIZE = (120, 160)


@pytest.fixture(scope="module")
def exported(tmp_path_factory):
    """A tour on disk: float depth [m], KITTI rows."""
    return export_tour(open_tour("tour:7?frames=24&size=120x160&sensor=0"), tmp_path_factory.mktemp("tour") / "home")


@pytest.fixture
def tour(exported, tmp_path):
    """A copy that the test may change."""
    return shutil.copytree(exported, tmp_path / "home")


def spoil_poses(path, convert):
    rows = np.loadtxt(path / "poses.txt").reshape(-1, 3, 4)
    T = np.tile(np.eye(4), (len(rows), 1, 1))
    T[:, :3] = rows
    np.savetxt(path / "poses.txt", convert(T)[:, :3].reshape(-1, 12))


def spoil_depth(path, convert):
    for file in (path / "depth").iterdir():
        np.save(file, convert(np.load(file)).astype(np.float32))


def command(capsys, *words):
    """Exit code and printed text."""
    code = main(["data", "check", *map(str, words)])
    captured = capsys.readouterr()
    return code, captured.out + captured.err


def test_a_good_export_is_fine(exported, capsys):
    code, out = command(capsys, exported, "--pairs", 2)
    assert code == 0
    assert out.splitlines()[0] == "home: layout generic, 24 of 24 frames usable"
    assert re.search(r"images +160x120, fx 114\.3 fy 114\.3 cx 79\.5 cy 59\.5 px", out)
    assert re.search(r"depth +160x120, \d\.\d+ to \d\.\d+ m, 100% of the pixels", out)
    assert re.search(r"geometry +depth warped [1235] frames? on off by 0\.\d% \(2 pairs\)", out)
    assert out.splitlines()[-1] == "fine"


@pytest.mark.parametrize("written", ["world-to-camera", "ned", "opengl"])
def test_other_conventions_are_named_with_their_option(tour, capsys, written):
    """Poses in another program's convention; with the option that the check suggests, it finds no problem."""
    inverse = {
        "world-to-camera": np.linalg.inv,
        "ned": lambda T: T @ np.linalg.inv(layouts.NED_FROM_CAMERA),
        "opengl": lambda T: T @ np.diag([1.0, -1, -1, 1]),
    }
    spoil_poses(tour, inverse[written])
    code, out = command(capsys, tour, "--pairs", 2)
    assert code == 1
    assert f"the poses look {CONVENTIONS[written].description}" in out
    assert re.findall(r"remedy +(.*)", out) == [f"--poses {written}"]
    assert out.splitlines()[-1] == "1 problem"
    code, out = command(capsys, tour, "--pairs", 2, "--poses", written)
    assert (code, out.splitlines()[-1]) == (0, "fine")


def test_depth_ten_times_too_large(tour, capsys):
    spoil_depth(tour, lambda depth: 10 * depth)
    code, out = command(capsys, tour, "--pairs", 2)
    assert code == 1
    assert "depth looks too large: times 0.1 fits" in out or "depth looks too large: times 0.0" in out
    assert re.findall(r"remedy +(.*)", out) == ["--truth-scale 0.1"]
    assert command(capsys, tour, "--pairs", 2, "--truth-scale", 0.1)[0] == 0


def shrink_positions(path):
    spoil_poses(path, lambda T: np.concatenate([T[..., :3], T[..., 3:] * [[0.2], [0.2], [0.2], [1]]], axis=-1))


@pytest.mark.parametrize(
    ("spoil", "options", "remedy", "factor"),
    [
        # Depth a tenth as large would need 10 m per unit; only the positions can be corrected.
        (lambda path: spoil_depth(path, lambda depth: depth / 10), {}, "divide the positions of the poses by ", 10),
        (shrink_positions, {"trajectory": "poses.txt"}, "a single camera's trajectory has no scale: divide the p", 0.2),
    ],
)
def test_positions_that_cannot_be_mended_by_the_depths_scale(tour, spoil, options, remedy, factor):
    spoil(tour)
    result = check_data(tour, pairs=2, **options)
    assert "depth looks too" in result.problems[0]
    assert result.remedies[0].startswith(remedy)
    assert float(result.remedies[0].split()[-1]) == pytest.approx(factor, rel=0.1)


def test_unregistered_depth(tour):
    """The depth camera is mounted 8 cm from the colour camera and has another focal length."""
    K = np.loadtxt(tour / "K.txt")
    K_depth = K.copy()
    K_depth[0, 0], K_depth[1, 1] = 1.12 * K[0, 0], 1.12 * K[1, 1]
    T = np.eye(4)
    T[0, 3] = 0.08
    spoil_depth(tour, lambda depth: register_depth(depth, K, K_depth, T, SIZE))
    result = check_data(tour, pairs=2)
    assert any("not registered to the images" in problem for problem in result.problems)
    assert any("--reader depth_intrinsics" in remedy for remedy in result.remedies)


def test_broken_and_missing_frames_are_reported(tour, capsys):
    layouts.truncate(tour / "images" / "000000.png")
    layouts.truncate(sorted((tour / "depth").iterdir())[13])
    lines = (tour / "poses.txt").read_text().splitlines()
    lines[5] = " ".join(["nan"] * 12)
    (tour / "poses.txt").write_text("\n".join(lines))
    code, out = command(capsys, tour, "--pairs", 3)
    assert code == 1
    assert "23 of 24 frames usable" in out
    assert re.search(r"skipped +1 x non-finite pose", out)
    # Every frame is read, also frames outside the compared pairs.
    assert re.search(r"PROBLEM +2 of the 23 frames read cannot be decoded, first .*000000\.png", out)


def test_a_sequence_that_cannot_be_opened(tour, capsys):
    (tour / "poses.txt").write_text("\n".join((tour / "poses.txt").read_text().splitlines()[:-1]))
    code, out = command(capsys, tour)
    assert code == 1
    assert "cannot be opened: trajectory has 23 poses for 24 images" in out


def test_few_usable_frames(tour):
    T = [np.eye(4)[:3].ravel()] * 8
    np.savetxt(tour / "slam.txt", [[100 + i, *row] for i, row in enumerate(T)])
    result = check_data(tour, trajectory="slam.txt", fps=1, time_offset=100, pairs=1)
    assert result.problems[0] == "only 8 of 24 frames are usable"
    assert result.skipped == {"no pose within 0.1 s around the image": 16}


def test_several_sequences_give_a_line_each(exported, tmp_path, capsys):
    shutil.copytree(exported, tmp_path / "good" / "a")
    shutil.copytree(exported, tmp_path / "bad" / "b")
    spoil_poses(tmp_path / "bad" / "b", np.linalg.inv)
    code, out = command(capsys, tmp_path, "--pairs", 2)
    assert code == 1
    lines = out.splitlines()
    assert lines[0].startswith("PROBLEM  bad__b: the poses look world-to-camera (inverted)")
    assert lines[0].endswith("-> --poses world-to-camera")
    assert re.fullmatch(r"fine     good__a: generic, 24 of 24 frames, depth fits to 0\.\d%", lines[1])
    assert lines[2] == "1 of 2 sequences are fine"
    code, out = command(capsys, tmp_path, "--pairs", 2, "--json")
    reports = json.loads(out)
    assert [(report["name"], report["ok"]) for report in reports] == [("bad__b", False), ("good__a", True)]
    assert reports[1]["checked"]["poses"] == "camera-to-world"


def test_no_depth_and_no_poses(tmp_path, capsys):
    path, _ = layouts.write_generic(tmp_path / "one", frames=3)
    shutil.rmtree(path / "depth")
    code, out = command(capsys, path)
    assert code == 0
    assert re.search(r"undecided +no two readable frames have depth", out)
    assert out.splitlines()[-1] == "not checked: without depth, neither poses nor scale can be compared"
    report = check_data(path)
    assert report.ok
    assert not report.compared
    assert lines([report]).splitlines()[-1] == "0 of 1 sequences are fine"
    assert "fine" not in lines([report]).splitlines()[0]
    root, _ = layouts_more.write_nyu(tmp_path / "nyu")
    code, out = command(capsys, root)
    assert code == 0
    assert re.search(r"poses +none: single images", out)


@pytest.mark.parametrize(
    ("name", "layout", "frames", "worst"),
    [
        pytest.param("hololens_office", "generic", 100, 0.01, marks=pytest.mark.slow),
        ("rgbd_dataset_freiburg1_xyz", "tum", 40, 0.02),
        pytest.param("rgbd_dataset_freiburg3_teddy", "tum", 50, 0.02, marks=pytest.mark.slow),
        ("tartanair_sample", "tartanair", 30, 0.01),
    ],
)
def test_the_shared_recordings_are_right(name, layout, frames, worst):
    result = check_data(require_shared(f"data/{name}"), pairs=1)
    assert (result.layout, result.frames, result.problems, result.undecided) == (layout, frames, (), ())
    assert result.checked["error"] < worst
    assert 0.1 < result.depth_range[0] < result.depth_range[1] < 100


def write_page_files(folder):
    """Write the files that docs/data.md calls walk, scans, slam.txt and KITTI-360."""
    layouts.write_generic(folder, 12, size=SIZE)
    _, _, scannet = layouts.write_scannet(folder / "scans", frames=7)
    lines = [f"{i} {layouts.quaternion_line(T)}" for i, T in enumerate(scannet.T_world_cam)]
    (folder / "slam.txt").write_text("\n".join(lines))
    layouts_more.write_kitti360(folder / "KITTI-360")


def test_every_command_and_piece_of_code_on_the_page_runs(tmp_path, monkeypatch, capsys):
    write_page_files(tmp_path)
    monkeypatch.chdir(tmp_path)
    text = PAGE.read_text()
    commands = re.findall(r"^ufmstar (data .*)$", "\n".join(blocks(text, "bash")), re.M)
    assert len(commands) == 4
    printed = {}
    for words in commands:
        code = main(words.split())
        printed[words] = capsys.readouterr().out
        assert code == (1 if "world-to-camera" in words else 0), printed[words]
    assert re.findall(r"remedy +(.*)", printed["data check walk --truth-scale 0.01 --poses world-to-camera"]) == [
        "leave --poses world-to-camera out",
        "--truth-scale 0.001",
    ]
    for code in blocks(text):
        exec(compile(code, PAGE.name, "exec"), {})
    assert capsys.readouterr().out.splitlines() == ["7 scannet []", "[('scene0000_00', 'scannet')]"]


def test_corners_that_agree_count_as_a_check_without_depth(tour, capsys):
    shutil.rmtree(tour / "depth")
    code, out = command(capsys, tour)
    assert code == 0
    assert re.search(r"corners +.*[1-9]\d* pairs?", out)
    assert out.splitlines()[-1] == "poses and images agree; scale cannot be checked without depth"

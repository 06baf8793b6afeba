"""Image selection: ``ufmstar rank``, the selection order, and the sampler of a training loop."""

from __future__ import annotations

import csv
import errno
import json
import math
import re

import numpy as np
import pytest
import torch

import scenes
from ufmstar_torch import UfMStar, UfMStarConfig
from ufmstar_torch.eval.sequences import open_sequence
from ufmstar_torch.frames.choose import choose
from ufmstar_torch.models import NetworkSpec, build_network, save_trained

SPEC = NetworkSpec(widths=0.1, positive="softplus", size=(64, 96), preprocess="resize")
DEPTHS, POSES, K = scenes.sequence(4, 48, 64, 0.05)
TOURS = ["tour:5?frames=3&size=64x96", "tour:6?frames=3&size=64x96"]


# ---- what an image's mean says ----


def test_parts_have_their_own_statistics():
    ufm, dense = (UfMStar(UfMStarConfig(unmeasured="nan", ema_alpha=1.0)) for _ in range(2))
    for depth, pose in zip(DEPTHS, POSES, strict=True):
        d = torch.tensor(depth)[None]
        frame = d, torch.tensor(pose), torch.tensor(K), 0.01 * d**2, 0.02 * d
        out, mean = dense(*frame), ufm.mean_uncertainty(*frame, fraction=1.0)
    maps = {"total": out.variance, "disagreement": out.disagreement, "aleatoric": frame[3], "epistemic": frame[4]}
    for name, values in (maps | {"depth": d}).items():
        part, pixels = getattr(mean, name), values[out.valid & ~values.isnan()].double()
        assert int(part.pixels) == len(pixels)
        expected = pixels.mean(), pixels.var(), pixels.median(), pixels.max()
        actual = part.mean, part.variance, part.median, part.maximum
        torch.testing.assert_close(torch.cat(actual).double(), torch.stack(expected), rtol=1e-4, atol=0)
    assert mean.anchored is None


# ---- the order of choice ----


def along(positions, angle=0.0):
    poses = torch.eye(4, dtype=torch.float64).repeat(len(positions), 1, 1)
    poses[:, 0, 3] = torch.tensor(positions)
    poses[-1, :3, 2] = torch.tensor([math.sin(angle), 0, math.cos(angle)])
    return poses


def test_the_best_come_first():
    assert choose([1.0, 3.0, math.nan, 3.0, 2.0]) == [1, 3, 4, 0]
    assert choose([1.0, 3.0, math.nan, 3.0, 2.0], 2) == [1, 3]
    assert choose([]) == []
    assert choose([math.nan, -math.inf, 1.0], 3) == [2], "a score of -inf counts as missing"


def test_a_diverse_choice_leaves_out_neighbours():
    scores = [1.0, 0.9, 0.8, 0.5]
    poses = along([0.0, 0.1, 0.2, 3.0])
    assert choose(scores, poses=poses) == [0, 3, 2, 1], ".8 / 5 is less than .5, and more than .9 / 10"
    assert choose(scores, 2, poses=poses, distance=0.1) == [0, 1], "near surfaces are out of view 10 cm to the side"
    assert choose(scores, 2, poses=poses, sequences=["a", "b", "b", "b"]) == [0, 1], "another sequence is elsewhere"
    turned = along([0.0, 0.0, 0.0, 0.0], angle=1.0)
    assert choose(scores, poses=turned)[:2] == [0, 3], "the same place, another direction"
    assert choose([1.0, math.nan, 0.8, 0.5], poses=poses) == [0, 3, 2]
    assert choose([1.0, math.nan], poses=along([0.0, math.nan])) == [0], "a pose without a score does not count"


# ---- the command ----


@pytest.fixture(scope="module")
def weights(tmp_path_factory):
    torch.manual_seed(0)
    file = tmp_path_factory.mktemp("net") / "net.safetensors"
    save_trained(file, build_network(SPEC).eval(), SPEC)
    return file


def test_a_pool_of_two_sequences(ufmstar, tmp_path, weights, caplog):
    words = ("rank", *TOURS, "--model", "trained", "--weights", weights, "--measured", "0.1", "--out", tmp_path / "out")
    code, out, err = ufmstar(*words)
    assert code == 0, err
    assert not [text for text in caplog.messages if "disagree" in text]
    assert "6 images, " in out
    assert re.search(
        r"^[2-4] of them cannot be ranked: less than 10% of their pixels were seen from two places", out, re.M
    )
    assert (tmp_path / "out" / "contact_sheet.png").stat().st_size > 1000
    with (tmp_path / "out" / "scores.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert {row["sequence"] for row in rows} == set(TOURS)
    first = [row for row in rows if row["frame"] == "000000"]
    assert all(row["rank"] == "" and float(row["measured"]) == 0 for row in first), "a new state per sequence"
    ranked = [float(row["total_mean_m2"]) for row in rows if row["rank"]]
    assert ranked == sorted(ranked, reverse=True)
    assert len(ranked) >= 2
    assert json.loads((tmp_path / "out" / "rank.json").read_text())["settings"]["by"] == "total"
    assert np.isfinite([float(row["aleatoric_median_m2"]) for row in rows]).all()
    assert ufmstar(*words)[0] == 2, "an earlier ranking is not overwritten"


def test_a_sequence_twice_is_refused_and_wrong_poses_are_named(ufmstar, tmp_path, caplog, rendered_walk):
    words = ("--depth", "self", "--measured", "0", "--out", tmp_path / "out")
    code, _, err = ufmstar("rank", TOURS[0], TOURS[0], *words)
    assert code == 2
    assert "the sequences must differ" in err
    path = rendered_walk
    assert ufmstar("rank", path, *words, "--poses", "opengl")[0] == 0
    assert any(text.startswith(f"{path}: poses disagree with the images") for text in caplog.messages)
    caplog.clear()
    assert ufmstar("rank", path, *words, "--overwrite", "--pose-scale", "10")[0] == 0
    assert any(
        re.search(r"walk: depth is 1/(9\.\d|10\.\d|10) of that of tracked cor", text) for text in caplog.messages
    )


def test_a_ranking_that_fails_is_no_earlier_one(ufmstar, tmp_path, monkeypatch):
    """A disk that is full at the last file leaves no rank.json with a ranking."""
    words = ("rank", TOURS[0], "--depth", "self", "--measured", "0", "--out", tmp_path / "out")

    def full(*_, **__):
        raise OSError(errno.ENOSPC, "No space left on device", "contact_sheet.png")

    with monkeypatch.context() as patch:
        patch.setattr("ufmstar_torch.eval.run.panels.contact_sheet", full)
        code, _, err = ufmstar(*words)
    assert code == 1
    assert "No space left on device: 'contact_sheet.png'" in err
    assert ufmstar(*words)[0] == 0


def test_scores_are_those_of_mean_uncertainty(ufmstar, tmp_path):
    words = ["--depth", "self", "--by", "disagreement", "--measured", "0", "--diverse", "--count", "1", "--out"]
    assert ufmstar("rank", TOURS[0], *words, tmp_path / "out")[0] == 0
    with (tmp_path / "out" / "scores.csv").open() as file:
        rows = {row["frame"]: row for row in csv.DictReader(file)}
    ufm, best = UfMStar(UfMStarConfig(unmeasured="nan")), {}
    for frame in open_sequence(TOURS[0]):
        depth = torch.from_numpy(frame.depth)[None]
        result = ufm.mean_uncertainty(depth, frame.T_world_cam, frame.intrinsics, fraction=1.0)
        best[frame.name], row = float(result.mean), rows[frame.name]
        if int(result.pixels):
            for key, value in (("mean_m2", result.mean), ("median_m2", result.total.median)):
                assert float(row[f"disagreement_{key}"]) == pytest.approx(float(value), rel=1e-4)
    most = max(best, key=lambda name: np.nan_to_num(best[name]))
    assert [name for name, row in rows.items() if row["rank"] == "1"] == [most]
    assert sum(row["rank"] != "" for row in rows.values()) == 1


def test_a_part_that_the_network_does_not_state_is_refused_before_compiling(ufmstar, tmp_path, weights, monkeypatch):
    monkeypatch.setattr("ufmstar_torch.eval.run.run.warm_up_job", lambda *_: pytest.fail("compiled before"))
    words = ("--model", "trained", "--weights", weights, "--by", "epistemic", "--out", tmp_path / "out")
    code, _, err = ufmstar("rank", TOURS[0], *words)
    assert code == 2
    assert "--by epistemic: the network states no epistemic variance" in err
    assert not (tmp_path / "out").exists()

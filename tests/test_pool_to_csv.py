"""The example that ranks a pool of images, and what an image's mean says of what was measured."""

from __future__ import annotations

import csv
import math

import pool_to_csv as example
import pytest
import torch

import scenes
from ufmstar_torch import UfMStar, UfMStarConfig, UncertainDepth
from ufmstar_torch.eval.sequences import open_sequence
from ufmstar_torch.models import NetworkSpec, build_network, save_trained

SPEC = NetworkSpec(widths=0.1, positive="softplus", size=(64, 96), preprocess="resize")
DEPTHS, POSES, K = scenes.sequence(4, 48, 64, 0.05)


def means(**config):
    ufm, read = UfMStar(UfMStarConfig(**config)), []
    for depth, pose in zip(DEPTHS, POSES, strict=True):
        read.append(ufm.mean_uncertainty(torch.tensor(depth)[None], torch.tensor(pose), torch.tensor(K), pixels=900))
    return read


def test_a_mean_tells_how_much_of_it_was_measured():
    plain, strict = means(unmeasured="paper"), means(unmeasured="nan")
    dense = UfMStar(UfMStarConfig(unmeasured="nan", ema_alpha=1.0))
    assert [float(plain[0].measured), float(strict[0].measured)] == [0, 0]
    assert (float(plain[0].mean), int(plain[0].pixels)) == (0.0, 900)
    assert math.isnan(float(strict[0].mean))
    assert int(strict[0].pixels) == 0
    for i in range(1, 4):
        assert 0.2 < float(plain[i].measured) < 1
        assert int(strict[i].pixels) == round(float(strict[i].measured) * 900) < 900
        assert float(strict[i].mean) > float(plain[i].mean)
        assert int(plain[i].statistics.unmeasured) == 900 - int(strict[i].pixels)
    for depth, pose in zip(DEPTHS, POSES, strict=True):
        out = dense(torch.tensor(depth)[None], torch.tensor(pose), torch.tensor(K))
    whole = float(out.variance.nanmean())
    assert abs(float(strict[3].mean) - whole) < 5 * float(strict[3].standard_error)
    assert "measured=" in repr(plain[1])


def test_rows_without_evidence_come_last():
    rows = [
        {"frame": name, "mean_variance_m2": mean, "measured": share}
        for name, mean, share in (("a", math.nan, 0.0), ("b", 0.1, 0.9), ("c", 0.4, 0.6), ("d", 0.9, 0.2))
    ]
    assert [(row["rank"], row["frame"]) for row in example.ranked(rows, 0.5)] == [
        (1, "c"),
        (2, "b"),
        ("", "a"),
        ("", "d"),
    ]


@pytest.mark.slow
def test_a_pool_of_two_sequences(tmp_path, capsys):
    torch.manual_seed(0)
    network = build_network(SPEC).eval()
    save_trained(tmp_path / "net.safetensors", network, SPEC)
    tours = ["tour:5?frames=3&size=64x96", "tour:6?frames=3&size=64x96"]
    example.main([*tours, "--model", "trained", "--weights", str(tmp_path / "net.safetensors"),
                  "--out", str(tmp_path / "pool.csv"), "--pixels", "500"])  # fmt: skip
    assert capsys.readouterr().out.endswith("pool.csv: 6 images\n")
    with (tmp_path / "pool.csv").open() as file:
        rows = list(csv.DictReader(file))
    first = {row["sequence"]: row for row in rows if row["frame"] == "000000"}
    assert len(first) == 2
    assert all(row["rank"] == "" and float(row["measured"]) == 0 for row in first.values()), "a fresh state each"
    ranked = [float(row["mean_variance_m2"]) for row in rows if row["rank"]]
    assert ranked == sorted(ranked, reverse=True)
    model = UncertainDepth(network, UfMStarConfig(unmeasured="nan", on_bad_frame="skip"), preprocess=network.preprocess)
    for frame in open_sequence(tours[1]):
        image = torch.from_numpy(frame.image).permute(2, 0, 1)[None]
        pose, camera = torch.from_numpy(frame.T_world_cam), torch.from_numpy(frame.intrinsics)
        actual = model.mean_uncertainty(image, pose, camera, pixels=500, seed=frame.index)
        [row] = [row for row in rows if (row["frame"], row["sequence"]) == (frame.name, rows_name(rows, tours[1]))]
        expected = float(actual.mean)
        assert (row["mean_variance_m2"] == "") == math.isnan(expected)
        assert math.isnan(expected) or float(row["mean_variance_m2"]) == pytest.approx(expected)
        assert int(row["pixels"]) == int(actual.pixels)


def rows_name(rows, tour):
    """The name of a tour's sequence, as the table has it."""
    number = tour.split(":")[1].split("?")[0]
    return next(row["sequence"] for row in rows if f"-{number}-" in row["sequence"])

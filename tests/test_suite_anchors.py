"""Rows with anchors: valid settings, and the evaluation against a loop written by hand."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest
import torch
from tiny_suite import Biased, base_network, evaluate, row, unbatched, write_network

from ufmstar_torch import AnchorConfig, UfMStar, UfMStarConfig
from ufmstar_torch.anchors.anchors import Anchors
from ufmstar_torch.anchors.sources import landmark_source
from ufmstar_torch.anchors.tracker import LandmarkTracker
from ufmstar_torch.eval.engine.anchors import TRUTH_SIGMA, AnchorSource
from ufmstar_torch.eval.engine.estimators import ufm_star_config
from ufmstar_torch.eval.methods.perturb import perturbed
from ufmstar_torch.eval.methods.setting import DEFAULT, Setting, configured, default_of, setting_from
from ufmstar_torch.eval.metrics import SequenceMetrics
from ufmstar_torch.eval.sequences.frame import in_memory
from ufmstar_torch.eval.sequences.ground_truth import truth_at
from ufmstar_torch.eval.tour.sequence import open_tour

NAME = "UfM*-DepthOnly"
ON = UfMStarConfig(on_bad_frame="skip", anchors=AnchorConfig())
FIGURES = ("delta1", "rmse", "nll", "ece_delta", "ece_q", "spearman")


@pytest.fixture(scope="module")
def tour():
    """Ten decoded frames, shared because rendering takes most of the time."""
    tour = open_tour("tour:300003?frames=16&size=96x128&sensor=0")
    return in_memory(replace(tour, entries=tour.entries[:10], names_on_disk=tour.names_on_disk[:10]))


@pytest.fixture(scope="module")
def networks(tmp_path_factory):
    file = write_network(tmp_path_factory.mktemp("anchors") / "depth.safetensors", "depth")
    return {"depth_only": base_network(f"depth_only=trained:{file}")}


def by_hand(sequence, network, anchors_of, *, config=ON, setting=DEFAULT):
    """Metrics and the mean number of anchors used: ``anchors_of(frame, T, predicted, truth)``."""
    ufm, metrics, used = UfMStar(config), SequenceMetrics(), []
    for frame in list(sequence)[:: setting.skip + 1]:
        T, p = perturbed(frame.T_world_cam, setting, frame.index), unbatched(network, frame)
        truth = truth_at(frame, p.intrinsics.numpy(), p.size)
        out = ufm(p.depth[None], torch.from_numpy(T)[None], p.intrinsics[None], anchors=anchors_of(frame, T, p, truth))
        metrics.update(out.depth[0], out.variance[0], torch.from_numpy(truth), out.valid[0])
        used.append(int(out.statistics.anchors_used[0]))
    return metrics.compute(), float(np.mean(used))


def tracked_by(tracker):
    return lambda frame, T, p, truth: tracker.update(frame.image, T, frame.intrinsics).anchors(
        frame.intrinsics, p.intrinsics
    )


def assert_agrees(result, expected, used):
    assert [result.figures[f] for f in FIGURES] == pytest.approx([expected[f] for f in FIGURES], rel=1e-9, nan_ok=True)
    assert result.state["anchors_mean"] == pytest.approx(used)


# ---- settings ----


@pytest.mark.parametrize(
    "values",
    [
        {"anchors": "corners"},
        {"anchors": "corners", "posterior": True},
        {"anchors": "corners", "anchor_count": 0, "seed": 0},
        {"anchors": "truth", "seed": 3},
        {"anchors": "corners", "track_noise": 2.0, "rotation_noise": 1.0, "seed": 1},
        {"regression": "neighbourhood", "anchors": "corners", "anchors.half_life": 10.0},
    ],
)
def test_a_setting_survives_its_flat_form_and_json(values):
    setting = setting_from(values)
    assert setting.to_dict() == values
    assert setting_from(json.loads(json.dumps(setting.to_dict()))) == setting
    assert configured(setting).anchors is not None
    assert ufm_star_config(row(NAME, anchors="corners")) == ON


def test_the_seed_matters_only_where_something_is_drawn():
    assert Setting(anchors="corners", seed=4).slug == Setting(anchors="corners").slug != ""
    assert Setting(anchors="truth", seed=4).slug != Setting(anchors="truth").slug
    assert Setting(anchors="corners", anchor_count=0).slug != Setting(anchors="corners").slug
    assert [default_of(n) for n in ("anchors", "anchor_count", "track_noise", "posterior")] == ["", None, 0.0, False]


# ---- against a loop by hand ----


def test_tracked_rows_equal_the_tracker_and_ufm_star_by_hand(tour, networks):
    target = row(NAME, anchors="corners")
    actual = evaluate(tour, [row(NAME), target], networks)[target.slug]
    expected, used = by_hand(tour, networks["depth_only"], tracked_by(LandmarkTracker()))
    assert used > 3
    assert_agrees(actual, expected, used)
    assert actual.ms["anchors"] > 0
    plain = UfMStar(UfMStarConfig(on_bad_frame="skip"))
    assert actual.state["bytes_end"] > actual.state["count_end"] * plain.mixture.bytes_per_component()


def test_the_tracker_sees_the_noisy_poses_and_the_chosen_images(tour, networks):
    noise = {"rotation_noise": 0.3, "translation_noise": 0.01, "seed": 5}
    noisy, sparse = row(NAME, anchors="corners", **noise), row(NAME, anchors="corners", skip=1)
    result = evaluate(tour, [row(NAME, anchors="corners"), noisy, sparse], networks)
    for one in (noisy, sparse):
        by = tracked_by(LandmarkTracker())
        assert_agrees(result[one.slug], *by_hand(tour, networks["depth_only"], by, setting=one.setting))
    # The exact poses give other values.
    tracker = LandmarkTracker()
    _, used = by_hand(
        tour,
        networks["depth_only"],
        lambda frame, T, p, truth: tracked_by(tracker)(frame, frame.T_world_cam, p, truth),
        setting=noisy.setting,
    )
    assert used != pytest.approx(result[noisy.slug].state["anchors_mean"], rel=1e-3)


def test_no_anchors_at_most_is_plain_ufm_star(tour, networks):
    rows = [row(NAME), *(row(NAME, anchors=kind, anchor_count=0) for kind in ("corners", "truth"))]
    plain, *none = evaluate(tour, rows, networks).values()
    for result in none:
        assert result.figures == pytest.approx(plain.figures, rel=0, abs=0, nan_ok=True)
        assert result.state["anchors_mean"] == 0
    assert "anchors_mean" not in plain.state


# ---- what is drawn ----


def test_truth_is_exact_at_random_pixels_and_more_hold_the_fewer(tour):
    frame, p = tour[4], Biased().one(tour[4], 0)
    truth = truth_at(frame, p.intrinsics[0].numpy(), p.size)

    def drawn(count, seed=0):
        setting = Setting(anchors="truth", anchor_count=count, seed=seed)
        _, anchors, ms = AnchorSource(None).of(frame, frame.T_world_cam, p, truth, setting)
        assert ms is None
        return anchors

    few, many, default = drawn(20), drawn(300), drawn(None)
    assert [a.depth.shape[1] for a in (few, many, default)] == [20, 300, 100]
    u, v = many.pixel[0].long().unbind(-1)
    assert torch.equal(many.depth[0].float(), torch.from_numpy(truth)[v, u])
    torch.testing.assert_close(many.variance.sqrt(), TRUTH_SIGMA * many.depth)
    assert torch.equal(few.pixel, many.pixel[:, :20])
    assert not torch.equal(drawn(20, seed=1).pixel, few.pixel)
    # All over the image.
    assert (u.double().std() / p.size[1], v.double().std() / p.size[0]) == pytest.approx((0.289, 0.289), abs=0.04)


def test_track_noise_has_the_size_that_the_tracker_states_for_it(tour):
    frames = list(tour)
    sources, clean, noisy, stated = [AnchorSource(landmark_source("corners")) for _ in range(2)], [], [], []
    for frame in frames:
        p = Biased().one(frame, 0)
        pair = []
        for size, source in zip((0.0, 0.5), sources, strict=True):
            setting = Setting(anchors="corners", track_noise=size)
            _, anchors, ms = source.of(frame, frame.T_world_cam, p, None, setting)
            assert isinstance(anchors, Anchors)
            assert ms > 0
            pair.append(anchors)
        assert torch.equal(pair[0].variance, pair[1].variance), "the tracker does not know the noise"
        clean.append(torch.cat([pair[0].pixel, pair[0].depth[..., None]], -1)[0])
        noisy.append(torch.cat([pair[1].pixel, pair[1].depth[..., None]], -1)[0])
        stated.append(pair[0].variance[0].sqrt())
    change = torch.cat(noisy) - torch.cat(clean)
    assert len(change) > 60
    assert change[:, :2].std() == pytest.approx(0.5, rel=0.2)
    assert (change[:, 2] / torch.cat(stated)).std() == pytest.approx(0.5, rel=0.25)


def test_tracking_needs_images(tour):
    blind = replace(tour, entries=tuple(replace(entry, load_image=None) for entry in tour.entries))
    networks = {"depth_only": Biased()}
    outcome = evaluate(blind, [row(NAME), row(NAME, anchors="truth")], networks)
    assert all(result.frames["judged"] == 10 for result in outcome.values())
    with pytest.raises(Exception, match="no image"):
        evaluate(blind, [row(NAME, anchors="corners")], networks)

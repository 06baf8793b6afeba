"""The evaluation of many rows in one pass equals that of each row by hand, and stores the computed values."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from layouts import truncate, write_generic, write_tum
from tiny_suite import CPU, base_network, evaluate, row, same, unbatched

from ufmstar_torch import UfMStar, UfMStarConfig, UncertainDepth
from ufmstar_torch.eval.engine.judge import SequenceError
from ufmstar_torch.eval.engine.load import NetworkChoice
from ufmstar_torch.eval.methods.ufm import UfM
from ufmstar_torch.eval.metrics import NLLByError, SequenceMetrics
from ufmstar_torch.eval.sequences import FrameError, open_sequence
from ufmstar_torch.eval.sequences.ground_truth import truth_at
from ufmstar_torch.frames.prediction import combine
from ufmstar_torch.models import load_trained
from ufmstar_torch.models.dropout import set_sampling
from ufmstar_torch.models.inference import Inference

SKIP = UfMStarConfig(on_bad_frame="skip")
FRAMES = 5


@pytest.fixture(scope="module")
def sequence(tmp_path_factory):
    return open_sequence(write_generic(tmp_path_factory.mktemp("evaluate"), frames=FRAMES)[0])


def members_of(text):
    """The networks of a base, in the form used by an evaluation."""
    file = text.partition(":")[2]
    return [Inference().ready(member, Path(file), CPU) for member in load_trained(file)]


def frames_of(sequence, indices=None):
    """(frame, image [1, 3, H, W], pose, K) of the frames."""
    for index in range(len(sequence)) if indices is None else indices:
        frame = sequence[index]
        image = torch.from_numpy(frame.image).permute(2, 0, 1)[None]
        yield frame, image, torch.from_numpy(frame.T_world_cam)[None], torch.from_numpy(frame.intrinsics)[None]


def judged(sequence, maps, indices=None):
    """The metrics of (depth, variance, valid, K) by frame, [1, h, w] each."""
    metrics = None
    for (frame, *_), (depth, variance, valid, K) in zip(frames_of(sequence, indices), maps, strict=True):
        truth = torch.from_numpy(truth_at(frame, K[0].numpy(), tuple(depth.shape[-2:])))
        metrics = metrics or SequenceMetrics(with_variance=variance is not None)
        metrics.update(depth[0], None if variance is None else variance[0], truth, valid[0])
    return metrics.compute()


def agrees(figures, expected):
    """Compare all figures except those of left-out pixels, which the loop by hand masks."""
    names = [name for name in expected if "left_out" not in name]
    assert figures.keys() == expected.keys()
    for name in names:
        assert figures[name] == pytest.approx(expected[name], rel=1e-12, abs=1e-12, nan_ok=True), name
    return True


def through(estimator, members, sequence, *, aleatoric=True, poses=None, indices=None):
    """By hand: member n = i mod N for image i, then UfM or UfM*."""
    for i, (frame, image, pose, K) in enumerate(frames_of(sequence, indices)):
        with torch.no_grad():
            x, K = members[0].preprocess(image, K)
            p = members[i % len(members)](x)
        pose = pose if poses is None else torch.from_numpy(poses(frame))[None]
        a, e = (p.aleatoric_variance, p.epistemic_variance) if aleatoric else (None, None)
        view = {"member": i % len(members)} if isinstance(estimator, UfMStar) else {}
        out = estimator(p.depth, pose, K, a, e, **view)
        yield p.depth, out.variance, out.valid, K


@pytest.mark.parametrize("base", ["ensemble", "batch_ensemble", "evidential", "aleatoric", "depth_only"])
def test_a_row_equals_a_loop_by_hand(base, network_files, networks, sequence):
    members = members_of(network_files[base])
    behind = {"ensemble": "Ensemble", "batch_ensemble": "BatchEnsemble", "depth_only": "DepthOnly"}
    name = behind.get(base, base.capitalize())
    rows = [row(f"UfM*-{name}"), row(f"UfM-{name}"), row(f"UfM-{name}-1K")]
    result = evaluate(sequence, rows, networks)
    hands = [UfMStar(SKIP), UfM(None), UfM(1000)]
    for one, estimator in zip(rows, hands, strict=True):
        by_hand = judged(sequence, through(estimator, members, sequence))
        assert agrees(result[one.slug].figures, by_hand)
    ufm, components = hands[2], int(hands[0].mixture.components)
    assert result[rows[2].slug].state["bytes_end"] == 40 * len(ufm.clouds[0].count) == 40_000
    assert result[rows[0].slug].state["count_end"] == components
    assert result[rows[0].slug].state["bytes_end"] == 84 * components
    assert result[rows[0].slug].state["smoothing_bytes"] == 4 * 32 * 64


def test_full_and_alone_put_the_members_together(network_files, networks, sequence):
    members = members_of(network_files["ensemble"])
    rows = [row("Ensemble"), row("UfM*-FullEnsemble"), row("UfM*-Ensemble")]
    result = evaluate(sequence, rows, networks)
    how = {"posterior": False, "preprocess": members[0].preprocess}
    full, alternating = UncertainDepth(members, SKIP, mode="full", **how), UncertainDepth(members, SKIP, **how)

    def piped(pipeline):
        for _, image, pose, K in frames_of(sequence):
            out = pipeline(image, pose, K)
            yield out.depth, out.variance, out.valid, out.intrinsics

    def alone():
        for _, image, _, K in frames_of(sequence):
            with torch.no_grad():
                x, K = members[0].preprocess(image, K)
                depths = torch.stack([member(x).depth for member in members])
                variance = torch.stack([member(x).aleatoric_variance for member in members]).mean(0)
            variance = variance + (depths.square().mean(0) - depths.mean(0).square())
            yield depths.mean(0), variance, torch.ones_like(variance, dtype=torch.bool), K

    assert agrees(result["UfMstar-FullEnsemble"].figures, judged(sequence, piped(full)))
    assert agrees(result["UfMstar-Ensemble"].figures, judged(sequence, piped(alternating)))
    by_hand = judged(sequence, alone())
    for name in ("delta1", "rmse", "nll", "ece_delta", "ece_q"):
        assert result["Ensemble"].figures[name] == pytest.approx(by_hand[name], abs=2e-3)
    assert result["Ensemble"].state == {}
    assert result["Ensemble"].figures["delta1"] == result["UfMstar-FullEnsemble"].figures["delta1"]


def test_depth_only_ignores_variances(network_files, sequence):
    with_head = base_network(network_files["aleatoric"].replace("aleatoric", "depth_only", 1))
    rows = [row("DepthOnly"), row("UfM*-DepthOnly")]
    result = evaluate(sequence, rows, {"depth_only": with_head})
    assert {"delta1", "rmse", "abs_rel"} < result["DepthOnly"].figures.keys()
    assert not {"nll", "ece_delta", "spearman"} & result["DepthOnly"].figures.keys(), "it has no variance"
    assert list(result["DepthOnly"].sums) == ["metrics"]
    members = members_of(network_files["aleatoric"])
    by_hand = judged(sequence, through(UfMStar(SKIP), members, sequence, aleatoric=False))
    assert agrees(result["UfMstar-DepthOnly"].figures, by_hand)


# ---- MC-Dropout ----


def test_samples_depend_on_the_frame_and_their_number_alone(network_files, networks, sequence):
    network = networks["mc_dropout"]
    frames = [sequence[i] for i in range(3)]
    requested = [(2, 1), (0, 0), (1, 2), (0, 1), (2, 0), (2, 1), (0, 0)]
    first = {key: network.one(frames[key[0]], key[1]).depth for key in requested}
    other = base_network(network_files["mc_dropout"], samples=3)
    for key in reversed(requested):
        assert torch.equal(other.one(frames[key[0]], key[1]).depth, first[key])
    assert not torch.equal(first[0, 0], first[0, 1])
    choice = NetworkChoice("", "trained", (network_files["mc_dropout"].partition(":")[2],))
    of_run = choice.load(CPU, mode="full", samples=3)
    assert torch.equal(of_run.one(frames[2], 1).depth, first[2, 1]), "ufmstar run draws the same"
    with pytest.raises(ValueError, match="the members of an ensemble must differ"):
        replace(choice, weights=choice.weights * 2).load(CPU)
    same_image = replace(frames[0], index=1)
    assert not torch.equal(network.one(same_image, 0).depth, first[0, 0]), "each frame has its own draw"


def test_mc_dropout_equals_seeded_passes_by_hand(network_files, networks, sequence):
    result = evaluate(sequence, [row("UfM*-MCD"), row("MC-Dropout"), row("UfM*-FullMCD")], networks)
    [member] = members_of(network_files["mc_dropout"])
    generator = torch.Generator()
    set_sampling(member, True, generator)

    def passes(frame, x, samples):
        for n in range(samples):
            generator.manual_seed(frame.index + 1_000_003 * n)
            yield member(x)

    def by_hand(samples, ufm):
        for frame, image, pose, K in frames_of(sequence):
            with torch.no_grad():
                x, K = member.preprocess(image, K)
                p = combine(list(passes(frame, x, samples))) if samples > 1 else next(passes(frame, x, 1))
            if ufm is None:
                yield p.depth, p.variance, torch.ones_like(p.depth, dtype=torch.bool), K
            else:
                view = {"member": frame.index if samples == 1 else 0}  # each image has its own sample
                out = ufm(p.depth, pose, K, p.aleatoric_variance, p.epistemic_variance, **view)
                yield p.depth, out.variance, out.valid, K

    assert agrees(result["UfMstar-MCD"].figures, judged(sequence, by_hand(1, UfMStar(SKIP))))
    assert agrees(result["MC-Dropout"].figures, judged(sequence, by_hand(3, None)))
    assert agrees(result["UfMstar-FullMCD"].figures, judged(sequence, by_hand(3, UfMStar(SKIP))))


# ---- one pass ----


def test_rows_do_not_depend_on_each_other(networks, sequence):
    rows = [
        row("Ensemble"),
        row("UfM*-Ensemble"),
        row("UfM*-Ensemble", overrides={"ema_alpha": 1.0}),
        row("UfM*-Ensemble", skip=1),
        row("UfM-Ensemble-100K"),
        row("UfM*-MCD", rotation_noise=1.0),
        row("Evidential"),
    ]
    together = evaluate(sequence, rows, networks)
    for one in rows:
        alone = evaluate(sequence, [one], networks)[one.slug]
        assert repr(alone.figures) == repr(together[one.slug].figures)
        assert alone.state == together[one.slug].state
    reversed_ = evaluate(sequence, rows[::-1], networks)
    assert all(same(reversed_[slug], result) for slug, result in together.items())


def test_every_inference_is_made_once(networks, sequence, monkeypatch):
    calls = []

    def counted(base, one):
        def call(frame, n):
            calls.append((base, frame.index, n))
            return one(frame, n)

        return call

    for base, network in networks.items():
        monkeypatch.setattr(network, "one", counted(base, network.one))
    names = ["Ensemble", "UfM*-Ensemble", "UfM-Ensemble", "UfM*-FullEnsemble", "UfM*-MCD", "UfM-MCD", "Aleatoric"]
    evaluate(sequence, [*map(row, names), row("UfM*-Ensemble", skip=1)], networks)
    expected = [("ensemble", i, n) for i in range(FRAMES) for n in range(3)]
    expected += [(base, i, 0) for base in ("mc_dropout", "aleatoric") for i in range(FRAMES)]
    assert sorted(calls) == sorted(expected)


def test_skip_and_limit_choose_frames_and_turns(network_files, networks, sequence):
    members = members_of(network_files["ensemble"])
    one, two = row("UfM*-Ensemble", skip=1), row("UfM*-Ensemble")
    result = evaluate(sequence, [one, two], networks, frames=slice(1, None))
    assert (result[one.slug].frames["done"], result[two.slug].frames["done"]) == (2, 4)
    skipping = judged(sequence, through(UfMStar(SKIP), members, sequence, indices=[1, 3]), [1, 3])
    assert agrees(result[one.slug].figures, skipping)
    every = judged(sequence, through(UfMStar(SKIP), members, sequence, indices=[1, 2, 3, 4]), [1, 2, 3, 4])
    assert agrees(result[two.slug].figures, every)


# ---- confident pixels ----


def binned(*references):
    """The names of the sums of NLL by error."""
    return {f"nll_by_error:{name}" for name in references}


def test_the_nll_by_error_is_over_the_pixels_where_the_reference_is_confident(networks, sequence):
    rows = [row("UfM*-Aleatoric"), row("UfM-Aleatoric"), row("UfM-Aleatoric-1K"), row("Aleatoric"), row("Evidential")]
    actual = evaluate(sequence, rows, networks)
    expected, groups = NLLByError(), {name: [] for name in ("Aleatoric", "UfM-Aleatoric-1K")}
    assert set(actual["UfMstar-Aleatoric"].sums) == {"metrics", *binned(*groups)}
    assert set(actual["Evidential"].sums) == {"metrics", *binned("Evidential")}
    network = networks["aleatoric"]
    for frame, *_ in frames_of(sequence):
        p = unbatched(network, frame)
        truth = torch.from_numpy(truth_at(frame, p.intrinsics.numpy(), p.size))
        judged_here = (truth > 0) & (p.depth > 0)
        order = p.aleatoric[judged_here].sort().values
        mask = judged_here & (p.aleatoric <= order[(len(order) - 1) // 2])
        assert 0.5 <= mask.sum() / judged_here.sum() < 0.51
        expected.update(p.depth, p.aleatoric, truth, mask)
    curves = actual["Aleatoric"].curves
    for name, curve in expected.compute().items():
        assert curves[f"{name}:Aleatoric"] == pytest.approx(curve.tolist(), rel=1e-12, nan_ok=True)
    # All rows use the same pixels: with equal depth their errors are equal.
    key = "nll_by_error:Aleatoric"
    for slug in ("UfMstar-Aleatoric", "UfM-Aleatoric"):
        assert torch.equal(actual[slug].sums[key]["count"], actual["Aleatoric"].sums[key]["count"])
    assert actual["UfMstar-Aleatoric"].curves["nll_by_error:Aleatoric"] != curves["nll_by_error:Aleatoric"]


# ---- what is left out ----


def test_broken_frames_are_left_out_by_all_rows_alike(networks, tmp_path):
    path, _ = write_tum(tmp_path, frames=7)
    truncate(path / "rgb" / f"{10 + 2 / 30:.6f}.png")
    (path / "depth" / f"{10 + 4 / 30 + 0.005:.6f}.png").write_bytes(b"")
    sequence = open_sequence(path)
    names = ["Ensemble", "UfM*-Ensemble", "DepthOnly", "UfM-DepthOnly"]
    outcome = evaluate(sequence, [row(name) for name in names], networks)
    frames = [dict(result.frames) for result in outcome.values()]
    assert [counts.pop("without_segment", None) for counts in frames] == [None, 0, None, None], "of UfM* alone"
    assert [counts.pop("without_match", None) for counts in frames] == [None, 0, None, None]
    assert all(counts == frames[0] for counts in frames)
    assert (frames[0]["selected"], frames[0]["done"], frames[0]["judged"], frames[0]["skipped"]) == (7, 5, 5, 2)
    assert sum(frames[0]["reasons"].values()) == 2
    readable = [0, 1, 3, 5, 6]
    good = replace(sequence, entries=tuple(sequence.entries[i] for i in readable))
    clean = evaluate(good, [row(name) for name in names], networks)
    for slug, result in clean.items():
        assert repr(result.figures) == repr(outcome[slug].figures), "as if they did not exist"


def test_frames_that_compare_nothing_are_counted(networks, sequence):
    """Minimum segments larger than the image give no segment; poses a kilometre apart give no match."""
    entries = [
        replace(entry, T_world_cam=entry.T_world_cam + np.pad([[1e3 * number]] * 3, ((0, 1), (3, 0))))
        for number, entry in enumerate(sequence.entries)
    ]
    rows = [
        row("UfM*-Ensemble"),
        row("UfM*-Ensemble", overrides={"segment.min_pixels": 10**6, "segment.prune": "either"}),
    ]
    result = evaluate(replace(sequence, entries=tuple(entries)), rows, networks)
    counts = [[r.frames[f"without_{name}"] for name in ("segment", "match")] for r in result.values()]
    assert counts == [[0, len(sequence) - 1], [len(sequence), len(sequence) - 1]]


def test_poses_that_are_none_are_left_out(networks, sequence):
    stretched = sequence.entries[2].T_world_cam.copy()
    stretched[:3, :3] *= 1.5
    broken = replace(sequence.entries[2], T_world_cam=stretched)
    bad = replace(sequence, entries=(*sequence.entries[:2], broken, *sequence.entries[3:]))
    outcome = evaluate(bad, [row("Aleatoric"), row("UfM*-Aleatoric"), row("UfM-Aleatoric")], networks)
    for result in outcome.values():
        assert (result.frames["done"], result.frames["skipped"]) == (FRAMES - 1, 1)
        assert "not orthonormal" in next(iter(result.frames["reasons"]))


def test_frames_without_ground_truth_are_used_but_not_judged(networks, sequence):
    entries = tuple(replace(e, load_depth=None) if i in (1, 2) else e for i, e in enumerate(sequence.entries))
    outcome = evaluate(replace(sequence, entries=entries), [row("UfM*-Aleatoric"), row("Aleatoric")], networks)
    counts = outcome["Aleatoric"].frames
    assert (counts["done"], counts["judged"], counts["skipped"]) == (FRAMES, FRAMES - 2, 0)
    both = {"aleatoric": networks["aleatoric"], "depth_only": base_network("depth_only=ground-truth:32x64")}
    rows = [row("Aleatoric"), row("UfM*-DepthOnly")]
    for result in evaluate(replace(sequence, entries=entries), rows, both).values():
        assert result.frames["reasons"] == {"no depth map": 2}


def test_pixels_that_a_row_leaves_out_are_counted(sequence):
    holes = base_network("depth_only=ground-truth:48x64")
    whole = holes.one

    def with_holes(frame, n):
        predicted = whole(frame, n)
        depth = predicted.depth.clone()
        depth[:, :12], depth[:, 12:24] = torch.nan, 0.0
        return replace(predicted, depth=depth)

    holes.one = with_holes
    outcome = evaluate(sequence, [row("DepthOnly"), row("UfM*-DepthOnly")], {"depth_only": holes})
    for result in outcome.values():
        assert result.figures["left_out_share"] == 0.5
        assert result.figures["pixels"] == FRAMES * 24 * 64
    assert outcome["UfMstar-DepthOnly"].figures["nll_left_out_share"] >= 0.5


def test_what_moves_and_what_stands_still_have_figures():
    sequence = open_sequence("tour:62?style=hall&frames=8&size=24x32&movers=2")
    assert any(frame.moving.any() for frame in sequence)
    networks = {"depth_only": base_network("depth_only=ground-truth:24x32")}
    figures = evaluate(sequence, [row("UfM*-DepthOnly")], networks)["UfMstar-DepthOnly"].figures
    parts = [figures[f"{part}.pixels"] for part in ("moving", "still")]
    assert min(parts) > 0
    assert sum(parts) == figures["pixels"]
    weighted = sum(figures[f"{part}.nll"] * figures[f"{part}.pixels"] for part in ("moving", "still"))
    assert figures["nll"] == pytest.approx(weighted / sum(parts))


@pytest.mark.parametrize("trouble", ["nothing readable", "no truth", "no frames"])
def test_a_sequence_that_cannot_be_used(networks, sequence, trouble):
    def fail():
        raise FrameError("x.png", "truncated")

    entries, limit = sequence.entries, slice(None)
    if trouble == "nothing readable":
        entries = tuple(replace(entry, load_image=fail) for entry in entries)
    elif trouble == "no truth":
        entries = tuple(replace(entry, load_depth=None) for entry in entries)
    else:
        limit = slice(40, None)
    message = {
        "nothing readable": "5 x truncated",
        "no truth": "no frame has ground truth",
        "no frames": "selected of 5",
    }
    with pytest.raises(SequenceError, match=message[trouble]):
        evaluate(replace(sequence, entries=entries), [row("Aleatoric")], networks, frames=limit)


def test_sums_hold_all_that_the_figures_are_made_of(networks, sequence):
    result = evaluate(sequence, [row("UfM*-Aleatoric"), row("Aleatoric")], networks)["UfMstar-Aleatoric"]
    again = SequenceMetrics()
    again.load_state_dict(result.sums["metrics"])
    assert repr(again.compute()) == repr(result.figures)
    binned = NLLByError()
    binned.load_state_dict(result.sums["nll_by_error:Aleatoric"])
    assert repr(binned.compute()["nll_by_error"].tolist()) == repr(result.curves["nll_by_error:Aleatoric"])
    assert all(value.device == CPU for sums in result.sums.values() for value in sums.values())

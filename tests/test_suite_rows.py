"""Rows: their names, their settings, the noise on their poses, and the networks behind them."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation
from scipy.stats import kstest
from tiny_suite import CPU, base_network, row, unbatched, write_network
from walks import SPGF, oracle_settings

import oracle
import scenes
from ufmstar_torch import UfMStar, UfMStarConfig
from ufmstar_torch.eval.engine.estimators import Gaussians, make_estimator, ufm_star_config
from ufmstar_torch.eval.engine.load import NetworkChoice
from ufmstar_torch.eval.methods.perturb import perturbed
from ufmstar_torch.eval.methods.setting import Setting
from ufmstar_torch.eval.sequences.frame import Frame
from ufmstar_torch.frames.prediction import DepthPrediction
from ufmstar_torch.models import Preprocess

PICTURE = np.random.default_rng(3).integers(0, 256, (72, 96, 3), dtype=np.uint8)
POSE = np.block([[Rotation.from_rotvec([0.3, -1.0, 0.4]).as_matrix(), np.array([[1.0], [2], [3]])], [np.eye(4)[3:]]])


# ---- names ----


def test_names_for_files_and_for_people():
    assert row("UfM*-Ensemble").slug == "UfMstar-Ensemble"
    assert row("UfM-MCD-100K").slug == "UfM-MCD-100K"
    assert row("UfM*-Ensemble").label == "UfM*-Ensemble"
    changed = row("UfM*-DepthOnly-fixed-param", overrides={"ema_alpha": 1.0}, skip=3)
    assert changed.slug == f"UfMstar-DepthOnly-fixed-param@{changed.setting.slug}"
    assert changed.label == "UfM*-DepthOnly-fixed-param (ema_alpha 1.0, skip 3)"
    assert row("Ensemble", seed=7) != row("Ensemble")
    assert row("Ensemble", seed=7).slug == "Ensemble", "without noise a seed changes nothing"


# ---- settings of UfM* ----


def test_overrides_by_dotted_name():
    expected = {"segment.min_pixels": 2000, "segment.min_rows": 32, "ema_alpha": 1.0, "regression": "neighbourhood"}
    config = ufm_star_config(row("UfM*-MCD", overrides=expected))
    assert (config.segment.min_pixels, config.segment.min_rows) == (2000, 32)
    assert (config.ema_alpha, config.regression) == (1.0, "neighbourhood")
    others = {name: value for name, value in config.to_dict().items() if name not in (*expected, "segment")}
    assert others.items() <= UfMStarConfig(on_bad_frame="skip").to_dict().items()


def test_fixed_param_takes_the_thresholds_as_they_stand_for_224():
    fixed, scaled = ufm_star_config(row("UfM*-DepthOnly-fixed-param")), ufm_star_config(row("UfM*-DepthOnly"))
    pixels = ("min_pixels", "min_rows", "n_check", "occlusion_gap", "sparse")

    def at(config, size):
        segment = config.segment.scaled_to(size, size)
        return [getattr(segment, name) for name in pixels]

    assert at(fixed, 518) == at(fixed, 224) == at(scaled, 224)
    assert at(scaled, 518)[0] == round(200 * (518 / 224) ** 2)
    # a is a setting like the others: a z^2 / f with the image's f; scaling keeps a / f constant.
    assert fixed.segment.slope(462.5) == pytest.approx(2.4 / 462.5)
    assert scaled.segment.slope(462.5) == pytest.approx(2.4 / 200)
    assert fixed == UfMStarConfig(on_bad_frame="skip", segment=fixed.segment)


# ---- noise and overlap ----


def noise(setting, indices):
    """Rotation vectors [rad] about the camera's axes, and translations [m], of the noise on some frames."""
    poses = [perturbed(POSE, setting, index) for index in indices]
    turned = [Rotation.from_matrix(POSE[:3, :3].T @ T[:3, :3]).as_rotvec() for T in poses]
    return np.array(turned), np.array([T[:3, 3] - POSE[:3, 3] for T in poses])


def test_noise_has_the_distribution_that_was_asked_for():
    turned, moved = noise(Setting(rotation_noise=2.0, translation_noise=0.05, seed=3), range(400))
    for values, deviation in ((turned, math.radians(2)), (moved, 0.05)):
        assert kstest(values.ravel() / deviation, "norm").pvalue > 0.01
    together = np.corrcoef(np.hstack([turned, moved]).T) - np.eye(6)
    assert np.abs(together).max() < 0.2, "axes are independent"
    assert np.abs(np.corrcoef(turned[:-1, 0], turned[1:, 0])[0, 1]) < 0.2, "frames are independent"


def test_noise_is_of_the_frame_and_the_seed_alone():
    setting = Setting(rotation_noise=1.0, translation_noise=0.1, seed=3)
    forth, back = noise(setting, range(5)), noise(setting, reversed(range(5)))
    np.testing.assert_array_equal(forth[0], back[0][::-1])
    np.testing.assert_array_equal(forth[1], back[1][::-1])
    other = noise(Setting(rotation_noise=1.0, translation_noise=0.1, seed=4), range(5))
    assert np.abs(other[0] - forth[0]).min() > 1e-6
    assert not np.shares_memory(perturbed(POSE, setting, 0), POSE)


@given(st.floats(0, 30), st.floats(0, 2), st.integers(0, 2**31), st.integers(0, 10**6))
def test_a_noisy_pose_is_a_pose(degrees, metres, seed, index):
    T = perturbed(POSE, Setting(rotation_noise=degrees, translation_noise=metres, seed=seed), index)
    np.testing.assert_allclose(T[:3, :3] @ T[:3, :3].T, np.eye(3), atol=1e-13)
    assert np.linalg.det(T[:3, :3]) > 0
    np.testing.assert_array_equal(T[3], [0, 0, 0, 1])


# ---- networks ----


def test_a_choice_as_it_is_typed():
    choice = NetworkChoice.parse("ensemble=trained:a/m0.safetensors,m1.safetensors#3")
    assert (choice.base, choice.model) == ("ensemble", "trained")
    assert (choice.weights, choice.spec) == (("a/m0.safetensors", "m1.safetensors#3"), None)
    with_spec = NetworkChoice.parse("depth_only=onnx:net.onnx,spec.json")
    assert (with_spec.weights, with_spec.spec) == (("net.onnx",), "spec.json")
    assert NetworkChoice.parse("depth_only=ground-truth:48x64").size == (48, 64)
    assert NetworkChoice.parse("depth_only=ground-truth").size is None


def test_turns_of_members_and_of_samples(networks):
    assert [networks["ensemble"].turn(i) for i in range(5)] == [0, 1, 2, 0, 1]
    assert [networks["batch_ensemble"].turn(i) for i in range(5)] == [0, 1, 2, 0, 1]
    assert [networks["mc_dropout"].turn(i) for i in range(5)] == [0] * 5, "one sample of every image"


@pytest.mark.parametrize(
    ("base", "of", "told"),
    [
        ("ensemble", "aleatoric", "two networks or more .* got 1 of the kind"),
        ("ensemble", "batch_ensemble", "batch_ensemble=.* of the kind BatchEnsembleMember"),
        ("aleatoric", "ensemble", "one network .* got 3 of the kind"),
        ("aleatoric", "depth_only", "an aleatoric variance .* got none"),
        ("aleatoric", "evidential", "no epistemic one, got both"),
        ("evidential", "aleatoric", "an aleatoric and an epistemic variance, got an aleatoric one"),
        ("mc_dropout", "aleatoric", "that samples, .* got one that does not"),
        ("batch_ensemble", "ensemble", "a file with one BatchEnsemble"),
        ("depth_only", "ensemble", "one network"),
    ],
)
def test_a_network_that_is_not_what_its_base_is_about(network_files, base, of, told):
    with pytest.raises(ValueError, match=told):
        base_network(network_files[of].replace(of, base, 1))


def test_members_one_by_one_and_from_several_files(network_files, networks, tmp_path):
    file = network_files["ensemble"].partition(":")[2]
    alone = base_network(f"aleatoric=trained:{file}#2")
    assert alone.identity["files"][0]["member"] == 2
    together, other = networks["ensemble"], base_network(f"ensemble=trained:{file}#2,{file}#0")
    image = torch.rand(1, 3, 32, 64, generator=torch.Generator().manual_seed(1))
    with torch.no_grad():
        depths = [network(image).depth for network in together.networks]
        assert torch.equal(alone.networks[0](image).depth, depths[2])
        assert [torch.equal(n(image).depth, depths[m]) for n, m in zip(other.networks, (2, 0), strict=True)] == [
            True
        ] * 2
    with pytest.raises(ValueError, match="has 3 members, there is no 3"):
        base_network(f"aleatoric=trained:{file}#3")
    named = write_network(tmp_path / "run#1.safetensors")
    assert base_network(f"aleatoric=trained:{named}").identity["files"][0]["member"] is None


def test_digests_tell_networks_apart(network_files, networks):
    file = network_files["mc_dropout"].partition(":")[2]
    file_of_members = network_files["ensemble"].partition(":")[2]
    different = [
        *networks.values(),
        base_network(network_files["mc_dropout"], samples=4),
        base_network(f"aleatoric=trained:{file}"),
        base_network(f"aleatoric=trained:{file_of_members}#1"),
        base_network(f"aleatoric=trained:{file_of_members}#2"),
        base_network("depth_only=ground-truth"),
        base_network("depth_only=ground-truth:32x64"),
    ]
    assert len({network.digest for network in different}) == len(different)
    assert base_network(network_files["evidential"]).digest == networks["evidential"].digest
    as_depth = base_network(network_files["aleatoric"].replace("aleatoric", "depth_only", 1))
    assert as_depth.digest == networks["aleatoric"].digest, "it is the same network"


def test_files_that_are_not_there(tmp_path):
    with pytest.raises(FileNotFoundError, match="nowhere"):
        base_network(f"aleatoric=trained:{tmp_path / 'nowhere.safetensors'}")


# ---- the aleatoric variance in H ----


def test_a_in_h_agrees_with_the_oracle():
    config = UfMStarConfig(segment=SPGF, variances_in_h=True, backend="torch", unmeasured="paper")
    estimator, sampled = Gaussians(config, CPU), UfMStar(config.replace(backend="auto"))
    judge = oracle.Oracle(oracle_settings(SPGF))
    depths, poses, K = scenes.sequence(3, 30, 40, 0.05)
    for i, (depth, T) in enumerate(zip(depths[:2], poses[:2], strict=True)):
        a = 0.01 * (1 + i) * depth**2
        maps = DepthPrediction(torch.tensor(depth)[None], torch.tensor(a)[None], intrinsics=torch.tensor(K)[None])
        answer = estimator.update(maps, torch.tensor(T))
        _, M = judge.step(depth, T, K, features=a[None])
        A = oracle.aleatoric_in_h(judge.mixture_cam, depth, depth > 0, K, a, prior_weight=1.0)
        np.testing.assert_allclose(answer.aleatoric[0].numpy(), A, rtol=1e-5)
        np.testing.assert_allclose(answer.variance[0].numpy(), M + A, rtol=1e-3, atol=1e-5)
        frame = maps.depth, torch.tensor(T), torch.tensor(K), maps.aleatoric_variance
        mean = sampled.mean_uncertainty(*frame, fraction=1.0)
        assert mean.aleatoric.mean.item() == pytest.approx(np.nanmean(A), rel=1e-4), "compiled"
        assert mean.aleatoric.maximum.item() == pytest.approx(np.nanmax(A), rel=1e-4)
    assert sampled.query(torch.zeros(1, 2, 3)).features.shape == (1, 2, 3)
    assert np.nanmax(np.abs(A - a)) > 0.01, "the mixture's average is not the pixel's value"
    with pytest.raises(ValueError, match="aleatoric or epistemic must be given"):
        estimator.update(replace(maps, aleatoric_variance=None), torch.tensor(T))


def test_e_in_h_follows_the_rule_of_a():
    """A and E are averaged independently: with both, each equals its average without the other."""
    config = UfMStarConfig(segment=SPGF, variances_in_h=True, unmeasured="paper")
    both, first, second = UfMStar(config), UfMStar(config), UfMStar(config)
    depths, poses, K = scenes.sequence(2, 30, 40, 0.05)
    for i, (depth, T) in enumerate(zip(depths, poses, strict=True)):
        z, T, camera = torch.tensor(depth)[None], torch.tensor(T)[None], torch.tensor(K)[None]
        a, e = 0.01 * (1 + i) * z**2, 0.02 * (2 - i) * z
        out = both(z, T, camera, aleatoric=a, epistemic=e)
        alone_a, alone_e = first(z, T, camera, aleatoric=a), second(z, T, camera, epistemic=e)
        torch.testing.assert_close(out.aleatoric, alone_a.aleatoric, equal_nan=True)
        torch.testing.assert_close(out.epistemic, alone_e.epistemic, equal_nan=True)
        total = out.disagreement + out.aleatoric + out.epistemic
        torch.testing.assert_close(out.variance, total, equal_nan=True)
    assert alone_a.epistemic is None
    assert alone_e.aleatoric is None
    assert (out.epistemic - e).abs()[out.valid].max() > 0.01, "the mixture's average is not the pixel's value"


def test_a_in_h_is_a_row_of_its_own():
    one = row("UfM*-Aleatoric", overrides={"variances_in_h": True})
    config = ufm_star_config(one)
    assert (config.variances_in_h, config.entries) == (True, 3)
    assert one.label == "UfM*-Aleatoric (variances_in_h)"


# ---- how images come to the networks ----


def test_a_row_prepares_its_images_as_it_says(tmp_path):
    source = base_network(f"aleatoric=trained:{write_network(tmp_path / 'aleatoric.safetensors')}")
    default = source.networks[0].preprocess
    assert source.prepared("network") is source
    assert source.prepared("resize") is source, "the tiny networks resize the whole frame anyway"
    cropped = source.prepared("crop")
    assert cropped.networks == source.networks
    assert len({cropped.digest, source.digest, ""}) == 3
    frame = Frame(0, "0", PICTURE, None, np.eye(4), np.array([[60.0, 0, 47], [0, 60, 35], [0, 0, 1]]))
    image, K = torch.from_numpy(PICTURE).permute(2, 0, 1)[None], torch.from_numpy(frame.intrinsics)[None]
    for one, preprocess in ((source, default), (cropped, Preprocess.nyu(default.size))):
        x, K_x = preprocess(image, K)
        with torch.no_grad():
            expected = source.networks[0](x)
        made = unbatched(one, frame)
        torch.testing.assert_close(made.depth, expected.depth[0], rtol=1e-5, atol=1e-6)
        assert torch.equal(made.intrinsics, K_x[0])
    assert Preprocess.nyu().of_whole_frame() == Preprocess(size=(224, 224))
    vit = Preprocess(size=(518, 518), aspect_multiple=14, cubic=True)
    assert vit.of_whole_frame() == Preprocess(size=(518, 518), cubic=True)
    assert vit.of_nyu_crop() == Preprocess.nyu((518, 518), cubic=True)
    maps = NetworkChoice.parse("depth_only=ground-truth:32x64").load(CPU)
    assert maps.prepared("resize") is maps
    with pytest.raises(ValueError, match="goes with networks: maps exist already"):
        maps.prepared("crop")


def test_the_relative_baseline_compares_no_views():
    one = row("Relative-DepthOnly")
    assert one.method.name == "Relative-DepthOnly"
    estimator = make_estimator(one, torch.device("cpu"))
    depth = torch.tensor([[[1.0, 4.0, 0.0, torch.nan]]])
    prediction = DepthPrediction(depth=depth, aleatoric_variance=torch.full_like(depth, 9.0))
    for _ in range(2):
        answer = estimator.update(prediction, torch.eye(4, dtype=torch.float64))
        torch.testing.assert_close(answer.variance[0, 0, :2], torch.tensor([0.04, 0.64]))
        assert answer.valid.tolist() == [[[True, True, False, False]]]
        assert answer.variance.isnan().tolist() == [[[False, False, True, True]]]
    assert estimator.memory() == {}
    with pytest.raises(ValueError, match="no method is called 'relative-DepthOnly'"):
        row("relative-DepthOnly")

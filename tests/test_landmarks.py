"""Landmarks from a file: reading, visibility in an image, and their use in runs and evaluations."""

from __future__ import annotations

import json

import numpy as np
import pytest
import torch
from runs import Brightness, job_of, read_summary
from tiny_suite import Biased, evaluate, row

from ufmstar_torch import AnchorConfig, UfMStar, UfMStarConfig, UncertainDepth, cli
from ufmstar_torch.anchors import Anchors, LandmarkMap, LandmarkTracker, landmark_source
from ufmstar_torch.anchors.dense import DenseEvidence
from ufmstar_torch.eval.engine.anchors import landmark_digests, landmarks_of
from ufmstar_torch.eval.engine.maps import MapSource
from ufmstar_torch.eval.methods.setting import setting_from
from ufmstar_torch.eval.report.text import run_table
from ufmstar_torch.eval.run.run import run
from ufmstar_torch.eval.sequences.frame import in_memory
from ufmstar_torch.eval.tour.sequence import open_tour
from ufmstar_torch.models import Preprocess

TOUR = "tour:5?frames=6&size=96x128&sensor=0"
ON = UfMStarConfig(on_bad_frame="skip", anchors=AnchorConfig())


@pytest.fixture(scope="module")
def tour():
    return in_memory(open_tour(TOUR))


def survey(sequence, every=7):
    """True surface points [P, 3] of the sequence in the world, computed in loops."""
    points = []
    for frame in list(sequence)[::2]:
        K, T = frame.intrinsics, frame.T_world_cam
        for v in range(3, frame.depth.shape[0], every * 2):
            for u in range(3, frame.depth.shape[1], every * 2):
                z = float(frame.depth[v, u])
                ray = np.array([(u - K[0, 2]) / K[0, 0] * z, (v - K[1, 2]) / K[1, 1] * z, z])
                points += [T[:3, :3] @ ray + T[:3, 3]] if z > 0 else []
    return np.array(points)


@pytest.fixture(scope="module")
def file(tour, tmp_path_factory):
    path = tmp_path_factory.mktemp("landmarks") / "survey.csv"
    points = survey(tour)
    np.savetxt(path, np.c_[points, np.full(len(points), 0.02)], delimiter=",", header="x,y,z,sigma", comments="")
    return path


# ---- files ----


@pytest.mark.parametrize(
    "text",
    ["x,y,z,sigma\n1,2,3,.1\n4,5,6,.2\n", "# a map\n1 2 3 .1  # one\n\n4 5 6 .2\n", "1, 2, 3, 1e-1\n4,5,6,0.2"],
)
def test_text_files(tmp_path, text):
    (tmp_path / "a.csv").write_text(text)
    np.savez(tmp_path / "b.npz", points=[[1.0, 2, 3], [4, 5, 6]], sigma=[0.1, 0.2])
    read, stored = (LandmarkMap.read(tmp_path / name) for name in ("a.csv", "b.npz"))
    for one in (read, stored):
        np.testing.assert_array_equal(one.points_world, [[1, 2, 3], [4, 5, 6]])
        np.testing.assert_array_equal(one.sigma, [0.1, 0.2])
    assert read.identity == stored.identity


@pytest.mark.parametrize(
    ("text", "told"),
    [
        ("1 2 3 .1\n1 2 3\n", "line 2 holds '1 2 3'"),
        ("1 2 3 .1\n1 2 x .1\n", "line 2 holds '1 2 x .1'"),
        ("x y z sigma\n", "finite values"),
        ("", "finite values"),
        ("nan nan nan 1\n1 2 3 -1\n", "finite values"),
        ("\xff\x00", "line 1 holds|expected landmarks"),
    ],
)
def test_what_is_no_file_of_landmarks(tmp_path, text, told):
    (tmp_path / "a.txt").write_bytes(text.encode("latin-1"))
    with pytest.raises(ValueError, match=f"a.txt.*({told})"):
        LandmarkMap.read(tmp_path / "a.txt")


def test_other_files_are_refused(tmp_path):
    np.savez(tmp_path / "a.npz", xyz=np.zeros((3, 3)))
    np.savez(tmp_path / "pickled.npz", points=np.array([[{}, 1, 2]], dtype=object), sigma=np.ones(1))
    np.savez(tmp_path / "flat.npz", points=np.zeros(3), sigma=np.ones(3))
    (tmp_path / "bytes.npz").write_bytes(b"no archive")
    whole = (tmp_path / "flat.npz").read_bytes()
    (tmp_path / "cut.npz").write_bytes(whole[: len(whole) // 2])
    (tmp_path / "negative.npz").write_bytes(whole.replace(b"(3,), }    ", b"(-3, 3), } "))
    for name, message in (
        ("a", "expected the arrays points, sigma, got xyz"),
        ("cut", r"cut\.npz"),
        ("negative", r"negative\.npz"),
        ("pickled", "allow_pickle"),
        ("flat", r"\[P, 3\]"),
        ("bytes", "landmarks"),
    ):
        with pytest.raises(ValueError, match=message):
            LandmarkMap.read(tmp_path / f"{name}.npz")
    with pytest.raises(FileNotFoundError):
        LandmarkMap.read(tmp_path / "none.csv")


def test_words_and_files_become_sources(file):
    assert isinstance(landmark_source("corners"), LandmarkTracker)
    assert isinstance(landmark_source(file), LandmarkMap)
    loaded = LandmarkMap.read(file)
    assert landmark_source(loaded) is loaded
    assert isinstance(landmark_source("dense"), DenseEvidence)
    with pytest.raises(ValueError, match=r"'lidar' is neither 'corners', 'dense' nor a file \.csv"):
        landmark_source("lidar")
    assert isinstance(landmarks_of("corners", None), LandmarkTracker)
    assert landmarks_of(file.name, file.parent).identity == loaded.identity
    with pytest.raises(FileNotFoundError, match=r"none.csv \(neither in .* nor in the working folder\)"):
        landmarks_of("none.csv", file.parent)
    with pytest.raises(ValueError, match="state must be empty"):
        loaded.load_state({"view": torch.zeros(1)})


# ---- projection ----


def test_landmarks_are_where_a_loop_puts_them(tour):
    rng = np.random.default_rng(0)
    points, sigma = rng.normal(size=(300, 3)) * 4, rng.uniform(0.01, 0.3, 300)
    points[5], sigma[9] = np.nan, np.inf
    landmarks = LandmarkMap(points, sigma)
    for frame in tour:
        expected = []
        for point, s in zip(points, sigma, strict=True):
            x, y, z = frame.T_world_cam[:3, :3].T @ (point - frame.T_world_cam[:3, 3])
            if not (np.isfinite(x) and np.isfinite(s) and z > 0):
                continue
            u, v = (frame.intrinsics @ [x / z, y / z, 1])[:2]
            if 0 <= round(u) < frame.image.shape[1] and 0 <= round(v) < frame.image.shape[0]:
                expected.append((u, v, z, s * s))
        actual = landmarks.update(frame.image, frame.T_world_cam, frame.intrinsics)
        values = np.c_[actual.pixel, actual.depth, actual.variance]
        np.testing.assert_allclose(values, np.reshape(expected, (-1, 4)), rtol=1e-9, atol=1e-9)
        assert actual.tracked == 300
        wide = landmarks.update(None, frame.T_world_cam, frame.intrinsics)
        seen = {tuple(row) for row in np.round(np.c_[wide.pixel, wide.depth], 6)}
        assert {tuple(row) for row in np.round(values[:, :3], 6)} <= seen
    assert len(expected) > 5


def test_a_large_map_is_thinned_evenly(tour):
    frame = tour[0]
    z = np.linspace(1, 2, 5000)
    in_view = (frame.T_world_cam @ np.stack([0 * z, 0 * z, z, z**0])).T[:, :3]
    result = LandmarkMap(in_view, np.full(5000, 0.1)).update(frame.image, frame.T_world_cam, frame.intrinsics)
    assert len(result.depth) == 500
    np.testing.assert_allclose(result.depth, z[::10], rtol=1e-9)
    nothing = LandmarkMap(-in_view - 100, np.ones(5000)).update(frame.image, frame.T_world_cam, frame.intrinsics)
    assert len(nothing.depth) == 0
    assert nothing.none == "no landmark of the map is in view"
    with pytest.raises(ValueError, match="finite 4x4"):
        LandmarkMap(in_view, z).update(frame.image, np.full((4, 4), np.nan), frame.intrinsics)


# ---- a run, an evaluation ----


def too_far(frame):
    return 1.3 * frame.depth, None, frame.intrinsics


def test_a_run_with_a_file_equals_a_loop_by_hand(tour, file, tmp_path):
    landmarks = LandmarkMap.read(file)

    def job(frames=slice(None)):
        source = MapSource(too_far, {"maps": "30 % too far"})
        return job_of(tour, source, config=ON, frames=frames, landmarks=landmarks)

    summary = run(job(), tmp_path / "out")
    ufm = UfMStar(ON)
    for frame in tour:
        T, K = torch.from_numpy(frame.T_world_cam)[None], torch.from_numpy(frame.intrinsics)[None]
        seen = landmarks.anchors(T, K, frame.depth.shape)
        assert isinstance(seen, Anchors)
        out = ufm(torch.from_numpy(1.3 * frame.depth)[None], T, K, anchors=seen)
    records = [json.loads(line) for line in (tmp_path / "out" / "frames.jsonl").read_text().splitlines()]
    assert records[-1]["anchors"]["used"] == int(out.statistics.anchors_used[0]) > 20
    with np.load(tmp_path / "out" / "frames" / f"{tour.names[-1]}.npz") as stored:
        np.testing.assert_allclose(stored["anchored"], out.anchored[0].numpy(), rtol=1e-4, atol=1e-6)
    assert summary["anchors"]["mean_bias"] == pytest.approx(1 / 1.3 - 1, abs=0.02)
    assert summary["source"]["anchors"] == "landmarks"
    assert f"in view and {len(landmarks.sigma):.1f} in the map" in run_table(summary)


def test_the_option_takes_a_file(file, tmp_path, capfd):
    words = ["run", TOUR, "--depth", "self", "--frames", ":2", "--no-video", "--no-sheet", "--out"]
    assert cli.main([*words, str(tmp_path / "out"), "--anchors", str(file)]) == 0
    summary = read_summary(tmp_path / "out")
    assert summary["settings"]["anchors"] == str(file)
    assert summary["source"]["anchors"] == "landmarks"
    assert summary["anchors"]["used_per_frame"] > 20
    assert cli.main([*words, str(tmp_path / "other"), "--anchors", "none.csv"]) == 2
    assert "no such file or folder: none.csv" in capfd.readouterr().err


def test_a_row_takes_a_file_of_each_sequence(tour, file, tmp_path):
    assert setting_from({"anchors": file.name}).to_dict() == {"anchors": file.name}
    name, networks = "UfM*-DepthOnly", {"depth_only": Biased()}
    rows = [row(name), row(name, anchors=str(file)), row(name, anchors=str(file), anchor_count=20, seed=1)]
    plain, mapped, few = evaluate(tour, rows, networks).values()
    assert mapped.state["anchors_mean"] > 20
    assert 4 <= few.state["anchors_mean"] <= 20
    assert mapped.figures["ece_delta"] < plain.figures["ece_delta"]
    digests = landmark_digests(rows, tmp_path)
    assert digests == {r.slug: LandmarkMap.read(file).identity["landmarks"] for r in rows[1:]}


# ---- UncertainDepth ----


def pictures(sequence):
    return [
        (torch.from_numpy(f.image).permute(2, 0, 1), torch.from_numpy(f.T_world_cam), torch.from_numpy(f.intrinsics))
        for f in sequence
    ]


def wrapped(source, **config):
    how = {"posterior": False, "preprocess": Preprocess(size=(48, 64)), "anchors": source}
    return UncertainDepth(Brightness(), ON.replace(**config), **how)


def test_a_model_with_a_source_equals_one_that_is_given_its_anchors(tour, file):
    tracker, mapped = LandmarkTracker(), LandmarkMap.read(file)
    by_hand, corners, both = wrapped(None), wrapped("corners"), wrapped(["corners", mapped])
    for i, (image, T, K) in enumerate(pictures(tour)):
        actual = tracker.update(image.permute(1, 2, 0).numpy(), T.numpy(), K.numpy()).anchors(K.numpy(), K)
        shown = image[None] if i % 2 else image[None].float() / 255  # a source reads the same bytes from both
        expected = by_hand(shown, T, K, anchors=actual)
        assert torch.equal(corners(shown, T, K).variance, expected.variance)
        out = both(shown.expand(2, -1, -1, -1), T.expand(2, 4, 4), K.expand(2, 3, 3))
        assert out.statistics.anchors[1] > 0
    torch.testing.assert_close(out.variance[0], expected.variance[0], rtol=1e-4, atol=1e-6)
    assert expected.statistics.anchors_used > 0


def test_its_state_continues_and_errors_change_nothing(tour):
    frames, model = pictures(tour), wrapped("corners", on_bad_frame="raise")
    for image, T, K in frames[:3]:
        model(image[None], T, K)
    saved = {name: value.clone() for name, value in model.stream_state().items()}
    assert "landmarks.0.gray" in saved
    image, T, K = frames[3]
    wrong = [
        {"image": image[None].float()},  # 0 to 255
        {"pose": 1.1 * T},
        {"valid": torch.ones(1, 3, 3, dtype=torch.bool)},
        {"anchors": LandmarkTracker().update(tour[0].image, tour[0].T_world_cam, K.numpy()).anchors(K.numpy(), K)},
        {"image": image[None].expand(2, -1, -1, -1)},
    ]
    for change in wrong:
        with pytest.raises(ValueError, match=r"image must|floating-point image|pose|valid|pass none|2 streams but"):
            model(**{"image": image[None], "pose": T, "intrinsics": K, **change})
        after = model.stream_state()
        assert all(torch.equal(after[name], value) for name, value in saved.items())
    expected = model(image[None], T, K).variance
    again = wrapped("corners", on_bad_frame="raise")
    again.load_stream_state(saved)
    assert torch.equal(again(image[None], T, K).variance, expected)
    with pytest.raises(ValueError, match="landmarks"):
        wrapped(None, on_bad_frame="raise").load_stream_state(saved)
    with pytest.raises(ValueError, match="anchors: the state must hold"):
        again.load_stream_state({name: value for name, value in saved.items() if "gray" not in name})
    again.reset()
    assert int(again.stream_state()["landmarks.0.number"][-1]) == -1


def test_a_skipped_frame_is_forgotten_by_its_source(tour):
    frames, model, clean = pictures(tour), wrapped("corners"), wrapped("corners")
    for i, (image, T, K) in enumerate(frames):
        if i == 3:
            assert model(image[None], 1.1 * T, K).statistics.fault
        out, expected = model(image[None], T, K), clean(image[None], T, K)
    assert torch.equal(out.variance, expected.variance)
    model.reset([0])
    assert int(model.stream_state()["landmarks.0.number"][-1]) == -1


@pytest.mark.parametrize("kind", ["corners", "dense"])
@pytest.mark.parametrize(
    ("argument", "change"), [(1, lambda T: T * torch.nan), (2, lambda K: K * torch.nan), (2, lambda K: -K)]
)
def test_a_bad_frame_of_one_stream_stops_neither_it_nor_the_others(tour, kind, argument, change):
    model, clean = wrapped([kind, kind]), wrapped([kind, kind])
    for i, (image, T, K) in enumerate(pictures(tour)):
        both = [image[None].expand(2, -1, -1, -1), T.expand(2, 4, 4), K.expand(2, 3, 3)]
        expected = clean(*both)
        if i == 3:
            both[argument] = torch.stack([change(both[argument][0]), both[argument][1]])
        out = model(*both)
        assert (out.statistics.fault > 0).tolist() == [i == 3, False]
        torch.testing.assert_close(out.variance[1], expected.variance[1], rtol=1e-6, atol=1e-9)
        assert model.landmarks.last[0].none.startswith(("pose", "intrinsics") if i == 3 else ("no ", "poses"))
    assert bool(out.variance[0].isfinite().all())

"""Hundreds of invalid frames and damaged recordings: the state stays valid, streams independent, errors documented.

``pytest -m slow tests/test_hostile.py`` runs 500 frames, ``UFMSTAR_HOSTILE_FRAMES=10000`` that many. Every session of
20 frames has its number as seed, so that a failure can be repeated. Damaged files: 30 of each layout, also with a seed
each; of the output folder of a run, 60."""

from __future__ import annotations

import json
import os

import layouts
import numpy as np
import pytest
import torch
from modules import same
from recordings import FORMS, LAYOUTS

import scenes
from ufmstar_torch import AnchorConfig, MergeConfig, SPGFConfig, UfMStar, UfMStarConfig, cli
from ufmstar_torch.anchors import Anchors
from ufmstar_torch.eval.sequences import open_sequence

H, W, LENGTH = 24, 32, 20
FRAMES = int(os.environ.get("UFMSTAR_HOSTILE_FRAMES", "500"))
DOCUMENTED = (TypeError, ValueError)  # UfMStar.forward's "Raises"
EXTREME = (0.0, -1.0, np.nan, np.inf, -np.inf, 1e-45, 1e-30, 1e-7, 1e-6, 1e-3, 1e3, 1e6, 1.1e6, 1e12, 1e20, 3e38)
K = scenes.intrinsics(H, W)


def spread(rng, shape):
    """Values from 1e-8 to 1e8, and a few that are extreme."""
    values = 10 ** rng.uniform(-8, 8, shape)
    return np.where(rng.random(shape) < 0.05, rng.choice(EXTREME, shape), values)


def depth_map(rng):
    """[H, W] a scene at any scale, a plane, steps, noise or random values, with holes and extreme pixels."""
    v, u = np.mgrid[:H, :W]
    kind = rng.integers(6)
    if kind == 0:
        depth = scenes.render(scenes.camera_pose(rng.normal(size=3) * 0.2, rng.normal() * 0.3), K, H, W)
    elif kind == 1:
        depth = 1 + rng.normal() * 0.02 * u + rng.normal() * 0.02 * v
    elif kind == 2:
        depth = rng.uniform(0.5, 5) + rng.choice([0.0, 1.0, 50.0]) * ((u // rng.integers(1, 9) + v // 4) % 2)
    elif kind == 3:
        depth = np.full((H, W), rng.choice(EXTREME))
    else:
        depth = spread(rng, (H, W)) if kind == 4 else rng.uniform(0.5, 4) + rng.normal(size=(H, W)) * rng.uniform(0, 1)
    depth = depth * rng.choice([1.0, 1.0, 1.0, 1e-4, 1e3, 1e5])
    at = rng.random((H, W)) < rng.choice([0.0, 0.01, 0.5])
    return np.where(at, rng.choice(EXTREME, (H, W)), depth)


def pose(rng, i):
    """[4, 4] on a path, or far away, randomly rotated, not rigid, not finite."""
    T = scenes.camera_pose([0.02 * i, 0, 0], 0.01 * i)
    kind = rng.integers(12)
    if kind == 0:
        T[:3, 3] = rng.normal(size=3) * 10 ** rng.uniform(0, 11)
    elif kind == 1:
        T = scenes.camera_pose(rng.normal(size=3), rng.uniform(-4, 4), rng.uniform(-4, 4))
    elif kind == 2:
        T[:3, :3] += rng.normal(size=(3, 3)) * 10 ** rng.uniform(-6, 0)
    elif kind == 3:
        T[rng.integers(4), rng.integers(4)] = rng.choice(EXTREME)
    elif kind == 4:
        T[:3, 0] *= -1
    return T


def camera(rng):
    """[3, 3] valid, or wrong in one entry."""
    matrix = K.copy()
    if rng.integers(8) == 0:
        matrix[rng.integers(3), rng.integers(3)] = rng.choice([*EXTREME, 5.0, 31.0, 400.0])
    return matrix


def anchors(rng, count):
    """(pixel, depth, variance, valid) of one stream."""
    pixel = np.stack([rng.uniform(-3, W + 3, count), rng.uniform(-3, H + 3, count)], -1)
    odd = rng.random(count) < 0.1
    pixel[odd] = rng.choice(EXTREME, (int(odd.sum()), 2))
    plain = rng.uniform(0.5, 5, count), rng.uniform(0, 0.01, count)
    depth, variance = (np.where(rng.random(count) < 0.2, spread(rng, count), values) for values in plain)
    return pixel, depth, variance, rng.random(count) < 0.9


def one_stream(rng, i, config, dtype):
    """The arguments of one stream, without a batch dimension."""
    made = {
        "depth": depth_map(rng), "pose": pose(rng, i), "intrinsics": camera(rng),
        "aleatoric": spread(rng, (H, W)), "epistemic": 10 ** rng.uniform(-6, 0, (H, W)),
    }  # fmt: skip
    exact = ("pose", "intrinsics")
    with np.errstate(over="ignore"):
        arguments = {n: torch.tensor(value, dtype=torch.float64 if n in exact else dtype) for n, value in made.items()}
    arguments["valid"] = torch.tensor(rng.random((H, W)) < rng.choice([0.0, 0.5, 1.0]))
    arguments["anchors"] = tuple(torch.tensor(part) for part in anchors(rng, 30))
    return arguments


def batch(streams, names):
    """Arguments of UfMStar for several streams, with the optional arguments ``names``."""
    arguments = {
        n: torch.stack([one[n] for one in streams]) for n in ("depth", "pose", "intrinsics", *names) if n != "anchors"
    }
    if "anchors" in names:
        parts = zip(*(one["anchors"] for one in streams), strict=True)
        arguments["anchors"] = Anchors(*(torch.stack(part) for part in parts))
    return arguments


def configuration(rng):
    """A random configuration over the settings that affect a frame."""
    return UfMStarConfig(
        segment=SPGFConfig(
            min_pixels=int(rng.choice([1, 20])), min_rows=1, prune=str(rng.choice(["both", "none"])),
            scale_with_image=bool(rng.integers(2)),
            **[{}, {"max_depth": 20.0}, {"max_depth": 1e6, "min_gaussian_length": 112.0}][rng.integers(3)],
        ),
        overlap_weighted=bool(rng.integers(2)),
        unmeasured=str(rng.choice(["paper", "relative", "nan"])), prior_mean=0.25,
        regression=str(rng.choice(["exact", "neighbourhood"])),
        variance_floor=float(rng.choice([0.0, 1e-4])),
        ema_alpha=float(rng.choice([0.5, 1.0])),
        anchors=AnchorConfig() if rng.integers(2) else None,
        max_components=[None, 1, 30][rng.integers(3)],
        initial_capacity=int(rng.choice([1, 64])),
        merge=MergeConfig(every=3) if rng.integers(2) else None,
        on_bad_frame=str(rng.choice(["skip", "skip", "raise"])),
        backend="torch" if rng.integers(10) == 0 else "auto",
    )  # fmt: skip


def spoil(rng, arguments):
    """One argument of a wrong kind, size or device."""
    name = str(rng.choice(list(arguments)))
    value = arguments[name]
    wrong = ["a map", 3, None, [1.0], np.ones((2, 3))]
    if isinstance(value, torch.Tensor):
        wrong += [value[:1, 1:], value.flatten(), value.to(torch.complex64), value.to("meta"), value[:0]]
    return arguments | {name: wrong[rng.integers(len(wrong))]}


def assert_in_order(ufm, session):
    """Assert that the state is valid."""
    try:
        ufm.state.require(ufm.config, ufm.state)
    except ValueError as error:
        raise AssertionError(f"session {session}: {error}") from error


def assert_sound(out, arguments, config, session):
    """Assert that exactly the pixels in the accepted ranges are used and all others counted, that used pixels have no
    NaN unless configured, and that no value is negative."""
    depth, fine = arguments["depth"], (out.statistics.fault == 0)[:, None, None]
    depth = depth if depth.dtype == torch.float64 else depth.float()
    mask = arguments.get("valid", torch.ones_like(depth, dtype=torch.bool)) & fine
    use = mask & (depth >= 1e-6) & (depth <= config.segment.depth_limit)
    for name in ("aleatoric", "epistemic"):
        value = arguments.get(name, torch.zeros_like(depth)).to(depth.dtype)
        use &= (value >= 0) & (value <= 1e12)
    counts = out.statistics
    assert torch.equal(out.valid, use), session
    positive = (mask & (depth > 0) & depth.isfinite()).sum((1, 2))
    assert torch.equal(counts.valid_pixels + counts.beyond + counts.out_of_range, positive), session
    values = out.variance[out.valid]
    assert bool(out.variance[~out.valid].isnan().all()), session
    assert not bool(values.isinf().any()), session
    if config.unmeasured != "nan":
        assert not bool(values.isnan().any()), session
    assert not bool((values < 0).any()), session


def run_session(session):
    """Run 20 frames of two streams; a twin's first stream has other frames."""
    rng = np.random.default_rng(session)
    config, dtype = configuration(rng), [torch.float32, torch.float64, torch.float16, torch.bfloat16][rng.integers(4)]
    ufm, twin = UfMStar(config), UfMStar(config)
    accepted, compared = 0, config.on_bad_frame == "skip"
    for i in range(LENGTH):
        hostile, watched, other = (one_stream(rng, i, config, dtype) for _ in range(3))
        names = [n for n in ("aleatoric", "epistemic", "valid", "anchors") if rng.integers(2)]
        names = [n for n in names if n != "anchors" or config.anchors is not None]
        arguments, spoilt = batch([hostile, watched], names), rng.integers(6) == 0
        before = {name: value.clone() for name, value in ufm.state_dict().items()}
        try:
            out = ufm(**(spoil(rng, arguments) if spoilt else arguments))
        except DOCUMENTED:
            after = ufm.state_dict()
            assert all(same(after[name], value) for name, value in before.items()), f"session {session}, {i}"
            continue
        accepted += 1
        assert_in_order(ufm, session)
        if not spoilt:
            assert_sound(out, arguments, config, session)
        compared = compared and not spoilt  # spoiling an absent optional argument adds it to one of the two only
        if compared:
            reference = twin(**batch([other, watched], names))
            for name in ("variance", "disagreement"):
                assert same(*(getattr(one, name)[1] for one in (out, reference))), f"session {session}, {i}: {name}"
    return accepted


@pytest.mark.parametrize("session", range(2))
def test_a_few_hostile_frames(session):
    assert run_session(session) > 0


@pytest.mark.slow
@pytest.mark.timeout(1800)
@pytest.mark.parametrize("part", range(10))
def test_hundreds_of_hostile_frames(part):
    sessions = range(part, max(FRAMES // LENGTH, 10), 10)
    accepted = sum(run_session(session) for session in sessions)
    assert accepted > 0.3 * LENGTH * len(sessions), "most frames must reach the algorithm"


# ---- damaged recordings ----

JUNK = (b"", b"\xff" * 64, b"[" * 100_000, b"nan inf " * 9, b"#ROSBAG V2.0\n", b"\x89MCAP0\r\n" + b"\xff" * 90)


def damage(rng, content):
    """The bytes truncated, doubled, partly changed, or others."""
    kind, data = rng.integers(5), bytearray(content)
    if kind == 0:
        return bytes(data[: rng.integers(len(data))])
    if kind == 1:
        return content + content
    if kind == 4:
        return JUNK[rng.integers(len(JUNK))]
    at = rng.integers(0, max(1, min(len(data), 400) if kind == 2 else len(data)), rng.integers(1, 9))
    for index in at[at < len(data)]:
        data[index] = rng.integers(256)
    return bytes(data)


def read_damaged(layout, folder, seeds):
    """Damage one file of a recording at a time, and read all frames: the number of damaged copies refused, wholly or in
    part. A model of COLMAP that is cut off is never read."""
    path, refused, messages = (LAYOUTS | FORMS)[layout](folder), 0, [""]
    files = [path] if path.is_file() else sorted(file for file in path.rglob("*") if file.is_file())
    for seed in seeds:
        rng = np.random.default_rng(seed)
        file = files[rng.integers(len(files))]
        content = file.read_bytes()
        damaged = damage(rng, content)
        file.write_bytes(damaged)
        try:
            errors = []
            sequence = open_sequence(path, *[layout.split()[0]] * (seed % 2))
            for frame in sequence.readable(errors.append):
                assert np.isfinite(frame.T_world_cam).all(), seed
                assert frame.depth is None or bool((frame.depth >= 0).all()), seed
            assert layout == "sens" or len(sequence) + len(sequence.skipped) <= 6, "a header may state more frames"
            cut = content.startswith(damaged) and file.suffix == ".bin" and not file.name.startswith("points")
            assert not (layout == "colmap" and cut), seed
            refused += bool(errors or sequence.skipped)
        except (ValueError, OSError) as error:
            refused += 1
            messages.append(str(error))
        finally:
            file.write_bytes(content)
    assert max(map(len, messages)) < 3000
    return refused


@pytest.mark.parametrize("layout", [*LAYOUTS, *FORMS])
def test_a_few_damaged_recordings(layout, tmp_path):
    assert read_damaged(layout, tmp_path, range(12)) > 0


@pytest.mark.slow
@pytest.mark.parametrize("layout", [*LAYOUTS, *FORMS])
def test_many_damaged_recordings(layout, tmp_path):
    assert read_damaged(layout, tmp_path, range(100, 130)) > 5


# ---- damaged output folders ----

HOSTILE_VALUES = (None, True, -1, 2**63, 10**30, 1e308, float("nan"), "", "x" * 9999, "../../x", [], [[1e308] * 4], {})


def mutated(rng, content):
    """JSON with a value removed, replaced, repeated or negated; or damaged bytes."""
    values = json.loads(content)
    node, keys = values, list(values)
    while True:
        key = keys[rng.integers(len(keys))]
        keys = list(node[key]) if isinstance(node[key], dict) else list(range(np.size(node[key]))[:4])
        if not isinstance(node[key], dict | list) or not keys or rng.random() < 0.4:
            break
        node = node[key]
    kind = rng.integers(5)
    if kind == 0:
        return damage(rng, content)
    if kind == 1:
        node.pop(key)
    elif kind == 2 and isinstance(node[key], int | float):
        node[key] *= -1e9
    else:
        node[key] = HOSTILE_VALUES[rng.integers(len(HOSTILE_VALUES))]
    return json.dumps(values).encode()


def damaged_folders(folder, seeds):
    """Run the commands that read the folder of a run with one of its files mutated. Each ends with an exit code: the
    number of those that are refused."""
    path, out = layouts.write_generic(folder / "walk", frames=3)[0], folder / "out"
    run = ["run", str(path), "--depth", "self", "--plain", "--threads", "1"]
    assert cli.main([*run, "--out", str(out), "--no-video", "--no-sheet"]) == 0
    commands = {
        "frames.jsonl": [["export", "--to", "cloud"], ["export", "--to", "tum"], ["report"]],
        "summary.json": [["export", "--to", "depth", "--max-sigma", "1"], ["export", "--to", "cloud"]],
        "run.json": [["run", str(path), *run[2:], "--no-video", "--no-sheet", "--out"]],
    }
    refused = 0
    for seed in seeds:
        rng = np.random.default_rng(seed)
        name = sorted(commands)[rng.integers(len(commands))]
        file = out / name
        content = file.read_bytes()
        lines = content.splitlines(keepends=True) if name == "frames.jsonl" else [content]
        lines[-1] = mutated(rng, lines[-1])
        file.write_bytes(b"".join(lines))
        words = commands[name][rng.integers(len(commands[name]))]
        before = {each: each.read_bytes() for each in (out / other for other in commands) if each != file}
        code = cli.main([*words, str(out)] if words[-1] == "--out" else [words[0], str(out), *words[1:]])
        assert code in (0, 1, 2), (seed, words)
        refused += code > 0
        for each, was in (before | {file: content}).items():
            each.write_bytes(was)
    return refused


def test_a_few_damaged_output_folders(tmp_path, capfd):
    assert damaged_folders(tmp_path, range(30)) > 5
    assert "Traceback" not in capfd.readouterr().err


@pytest.mark.slow
def test_many_damaged_output_folders(tmp_path, capfd):
    assert damaged_folders(tmp_path, range(100, 160)) > 10
    assert "Traceback" not in capfd.readouterr().err


@pytest.mark.slow
def test_covariances_are_positive_definite_after_3000_fusions():
    """A camera moves to and fro before noisy boxes."""
    segment = SPGFConfig(min_pixels=10, min_rows=1, prune="none")
    ufm = UfMStar(UfMStarConfig(segment=segment, merge=MergeConfig()))
    rng, fusions = np.random.default_rng(0), 0
    for i in range(400):
        T = scenes.camera_pose([0.3 * np.sin(0.2 * i), 0.02 * np.cos(0.3 * i), 0], 0.1 * np.sin(0.11 * i))
        depth = scenes.render(T, K, H, W) * (1 + 0.02 * rng.normal(size=(H, W)))
        out = ufm(torch.tensor(depth)[None], torch.tensor(T), torch.tensor(K))
        fusions += int(out.statistics.pairs)
        if i % 20 == 0:
            assert_in_order(ufm, i)
    assert_in_order(ufm, "last")
    assert fusions > 3000

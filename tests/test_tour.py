"""Tours: exact depth, collision-free paths, revisited places, separate styles, sequences by name."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from ufmstar_torch.eval.check.check import check_sequence
from ufmstar_torch.eval.sequences.frame import in_memory
from ufmstar_torch.eval.sequences.ground_truth import moving_at, resample_nearest
from ufmstar_torch.eval.sequences.open import open_sequence
from ufmstar_torch.eval.tour import Tour, export_tour, make_movers, make_tour, render, tour_path, tour_sequence
from ufmstar_torch.eval.tour.intersect import entry
from ufmstar_torch.eval.tour.movers import MOTIONS, SHARES, SIZES
from ufmstar_torch.eval.tour.shapes import BOX, ELLIPSOID, FRUSTUM, QUAD, Finish, ball, box, part, surfaces
from ufmstar_torch.eval.tour.style import HALL_TEXTURES, HOME_TEXTURES, STYLES, TEXTURES
from ufmstar_torch.eval.tour.texture import noise_table
from ufmstar_torch.eval.tour.view import cast, intrinsics

K = torch.from_numpy(intrinsics(24, 32))


SEEDS = {"home": 2, "hall": 3, "mixed": 1, "close": 1}


@pytest.fixture(scope="module")
def home() -> Tour:
    return make_tour(SEEDS["home"], "home")


@pytest.fixture(scope="module")
def mixed() -> Tour:
    return make_tour(SEEDS["mixed"], "mixed")


def scene(*parts) -> Tour:
    """Only these primitives, in a room of 40 m."""
    room = torch.tensor([[[-20.0, -20.0, -20.0], [20.0, 20.0, 20.0]]], dtype=torch.float64)
    lights = torch.zeros(1, 1, 7)
    lights[..., 3:] = 1
    return Tour(
        seed=0,
        rooms=room,
        room_styles=("home",),
        doors=torch.zeros(0, 2, 3, dtype=torch.float64),
        surfaces=surfaces(parts, np.random.default_rng(0)),
        lights=lights,
        volumes=torch.ones(1, 1, 2, 2, 2),
        noise=noise_table(),
        ways=(),
        camera_height=1.5,
    )


def depth_of(*parts, pose=None, size=(24, 32)) -> np.ndarray:
    T = torch.eye(4, dtype=torch.float64) if pose is None else torch.from_numpy(pose)
    return cast(scene(*parts), T, torch.from_numpy(intrinsics(*size)), *size)[0].numpy()


def rooms_at(tour: Tour, position: torch.Tensor) -> torch.Tensor:
    """[N] the rooms at positions [N, 3], or the nearest ones."""
    beyond = torch.maximum(tour.rooms[:, 0] - position[:, None], position[:, None] - tour.rooms[:, 1]).clamp_min(0)
    return beyond.pow(2).sum(-1).argmin(-1)


def rays(size=(24, 32)) -> np.ndarray:
    v, u = np.mgrid[: size[0], : size[1]].astype(float)
    return np.stack([u, v, np.ones_like(u)], -1) @ np.linalg.inv(intrinsics(*size)).T


# --- exact depth ---------------------------------------------------------------------------------------------


def test_depth_of_a_sphere_is_the_quadratic_formula():
    centre, r, d = np.array([0.2, -0.1, 4.0]), 0.9, rays()
    a, b, c = (d * d).sum(-1), (d @ centre), centre @ centre - r * r
    root = np.sqrt(np.maximum(b * b - a * c, 0))
    expected = np.where(b * b >= a * c, (b - root) / a, np.inf)
    assert 20 < np.isfinite(expected).sum() < 700
    np.testing.assert_allclose(depth_of(ball(centre, (r, r, r), Finish())), expected, rtol=1e-9)


def test_a_quad_is_seen_from_its_front_only():
    facing = np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])
    d = rays()
    within = (np.abs(d[..., 0]) * 2 <= 0.7) & (np.abs(d[..., 1]) * 2 <= 0.4)
    both = (facing, facing @ np.diag([1.0, -1, -1]))
    fronts = [depth_of(part(QUAD, (0, 0, 2), (0.7, 1, 0.4), Finish(), R)) for R in both]
    visible = [front for front in fronts if np.isfinite(front).any()]
    assert len(visible) == 1
    np.testing.assert_allclose(visible[0], np.where(within, 2.0, np.inf), rtol=1e-9)


@given(st.integers(0, 2**31), st.sampled_from([BOX, ELLIPSOID, FRUSTUM]), st.floats(0.05, 1.4))
def test_entry_is_the_first_point_of_the_solid(seed, kind, taper):
    rng = np.random.default_rng(seed)
    o = rng.normal(size=3)
    o *= rng.uniform(3, 6) / np.linalg.norm(o)
    d = rng.uniform(-1, 1, (40, 3)) - o
    t = entry(kind, tuple(o), tuple(torch.from_numpy(d).unbind(1)), taper).numpy()

    def inside(p):
        if kind == BOX:
            return np.abs(p).max(-1) <= 1
        if kind == ELLIPSOID:
            return (p * p).sum(-1) <= 1
        radius = (1 + taper) / 2 + (1 - taper) / 2 * p[..., 1]
        return (np.abs(p[..., 1]) <= 1) & (np.hypot(p[..., 0], p[..., 2]) <= radius)

    steps = np.linspace(0, 3, 3001)
    result = inside(o + steps[:, None, None] * d)
    hit = result.any(0)
    first = steps[result.argmax(0)]
    assert np.isfinite(t[hit]).all()
    assert ((first[hit] - t[hit] >= -1e-9) & (first[hit] - t[hit] <= 2e-3)).all()
    # The samples may miss a hit where a ray grazes an edge, but the hit is then still on the surface.
    grazing = ~hit & np.isfinite(t)
    assert inside((o + t[grazing, None] * d[grazing]) * (1 - 1e-9)).all()


def test_the_nearer_surface_hides_the_farther_one():
    near, far = box((0.3, 0, 2), (0.2, 0.2, 0.2), Finish()), ball((0, 0, 5), (2, 2, 2), Finish())
    a, b = depth_of(near), depth_of(far)
    assert (np.isfinite(a) & np.isfinite(b)).any()
    for order in ((near, far), (far, near)):
        np.testing.assert_array_equal(depth_of(*order), np.minimum(a, b))
    view = render(scene(near, far), torch.eye(4, dtype=torch.float64), K, 24, 32)
    assert (view.surface.numpy() == np.where(np.isfinite(a), 0, np.where(np.isfinite(b), 1, -1))).all()
    assert (view.depth[view.surface < 0] == 0).all()


# --- tours ---------------------------------------------------------------------------------------------------


def same(a: Tour, b: Tour) -> bool:
    pairs = [(a.rooms, b.rooms), (a.lights, b.lights), (a.volumes, b.volumes)]
    pairs += [(getattr(a.surfaces, n), getattr(b.surfaces, n)) for n in a.surfaces.__dataclass_fields__]
    return all(torch.equal(x, y) for x, y in pairs)


def test_a_seed_makes_the_same_tour_and_pictures_for_any_number_of_threads(home):
    threads, state = torch.get_num_threads(), torch.get_rng_state()
    try:
        torch.set_num_threads(3)
        make_tour.cache_clear()
        again = make_tour(2, "home")
        assert again is not home
        assert same(home, again)
        poses = tour_path(home, 40)
        assert torch.equal(poses, tour_path(again, 40))
        views = []
        for count in (1, 3):
            torch.set_num_threads(count)
            views.append(render(home, poses[7], torch.from_numpy(intrinsics(160, 224)), 160, 224, frame_seed=5))
    finally:
        torch.set_num_threads(threads)
    assert torch.equal(views[0].image, views[1].image)
    assert torch.equal(views[0].depth, views[1].depth)
    assert torch.equal(state, torch.get_rng_state())


def to_surfaces(tour: Tour, points: torch.Tensor) -> torch.Tensor:
    """[N] distance of each primitive's box from the nearest of some points [m]: at most the true distance."""
    s = tour.surfaces
    low, high = s.corners.amin(1), s.corners.amax(1)
    axis_aligned = torch.maximum(torch.maximum(low[:, None] - points, points - high[:, None]), torch.zeros(()))
    return axis_aligned.norm(dim=-1).amin(1)


@pytest.mark.parametrize("style", SEEDS)
def test_every_way_keeps_clear_of_everything(style):
    tour = make_tour(SEEDS[style], style)
    for frames, path_seed in ((100, None), (300, None), (200, 1)):
        points = tour_path(tour, frames, path_seed)[:, :3, 3]
        boxes = torch.cat([tour.rooms, tour.doors])
        assert ((boxes[:, 0] < points[:, None]) & (points[:, None] < boxes[:, 1])).all(-1).any(1).all()
        distance = to_surfaces(tour, points)
        assert distance.min() >= 0.3


def test_poses_are_rigid_level_and_smooth(home):
    poses = tour_path(home, 200)
    R, p = poses[:, :3, :3], poses[:, :3, 3]
    torch.testing.assert_close(R @ R.mT, torch.eye(3, dtype=torch.float64).expand_as(R), atol=1e-12, rtol=0)
    assert (torch.linalg.det(R) > 0.99).all()
    assert (R[:, 1, 1] > 0.9).all()  # the camera's down is the world's
    steps = (p[1:] - p[:-1]).norm(dim=1)
    assert steps.max() < 0.25
    # At reversals the camera stops and turns; everywhere else the speed changes slowly.
    assert ((steps[1:] - steps[:-1]).abs() < 0.06).double().mean() > 0.93
    angle = torch.rad2deg(torch.arccos((((R[1:] * R[:-1]).sum((1, 2)) - 1) / 2).clamp(-1, 1)))
    assert angle.max() < 12
    assert -p[:, 1].max() >= 1.0 - 0.05
    assert -p[:, 1].min() <= 1.6 + 0.05


def seen_from(tour: Tour, points: torch.Tensor, pose: torch.Tensor) -> torch.Tensor:
    """[N] whether points [N, 3] lie on the surface that a camera sees."""
    x, y, z = (points - pose[:3, 3]).matmul(pose[:3, :3]).unbind(1)
    front = z > 0.1
    u, v = (K[0, 0] * x / z + K[0, 2]).round().long(), (K[1, 1] * y / z + K[1, 2]).round().long()
    inside = front & (u >= 0) & (u < 32) & (v >= 0) & (v < 24)
    depth = cast(tour, pose, K, 24, 32)[0][v.clamp(0, 23), u.clamp(0, 31)]
    return inside & ((depth - z).abs() < 0.05 * z)


def world_points(tour: Tour, pose: torch.Tensor) -> torch.Tensor:
    depth = cast(tour, pose, K, 24, 32)[0]
    assert torch.isfinite(depth).all()
    d = torch.from_numpy(rays()) @ pose[:3, :3].T
    return (pose[:3, 3] + depth[..., None] * d).reshape(-1, 3)


def test_neighbouring_frames_overlap_and_places_are_seen_again(home):
    poses = tour_path(home, 150)
    pairs = [(poses[i], poses[i + 1]) for i in range(0, 149, 10)]
    shares = [float(seen_from(home, world_points(home, a), b).double().mean()) for a, b in pairs]
    assert min(shares) > 0.5
    assert np.median(shares) > 0.7
    assert len(set(rooms_at(home, poses[:, :3, 3]).tolist())) > 1, "the path leads through a doorway"
    for i in range(0, 60, 12):
        early = world_points(home, poses[i])
        seen = np.array([float(seen_from(home, early, pose).double().mean()) for pose in poses[i::6]])
        gone = np.flatnonzero(seen < 0.05)
        if len(gone) and (seen[max(gone.min(), 6) :] > 0.3).any():  # 6 x 6 frames later
            return
    pytest.fail("a place must leave the view and come back")


@pytest.mark.parametrize("style", SEEDS)
def test_culling_changes_nothing(style, monkeypatch):
    tour = make_tour(SEEDS[style], style)
    poses = tour_path(tour, 50, 3)[::13]
    images = [cast(tour, pose, K, 24, 32) for pose in poses]
    everything = [(i, (0, 24, 0, 32)) for i in range(len(tour.surfaces.kind))]
    monkeypatch.setattr("ufmstar_torch.eval.tour.view.surface_windows", lambda *_: everything)
    for pose, culled in zip(poses, images, strict=True):
        whole = cast(tour, pose, K, 24, 32)
        assert torch.equal(culled[0], whole[0])
        assert torch.equal(culled[1], whole[1])
        assert (culled[1] >= 0).all(), "rooms are closed"


def test_mixed_tours_begin_at_home_and_end_in_a_hall(mixed):
    assert mixed.room_styles == ("home", "home", "hall")
    rooms = rooms_at(mixed, tour_path(mixed, 150)[:, :3, 3])
    assert rooms[0] == 0
    assert (rooms == 2).sum() > 40
    texture, room = mixed.surfaces.texture, mixed.surfaces.rooms
    of_hall = {TEXTURES[i] for i in texture[(room[:, 0] == 2) & (room[:, 1] < 0)].tolist()}
    of_home = {TEXTURES[i] for i in texture[room[:, 0] < 2].tolist()}
    assert not set(HOME_TEXTURES) & set(HALL_TEXTURES)
    assert of_hall <= set(HALL_TEXTURES)
    assert of_home <= set(HOME_TEXTURES)
    assert len(of_home) > 6
    assert len(of_hall) > 4


# --- sequences -----------------------------------------------------------------------------------------------


def test_a_tour_by_name_is_a_sequence_whose_depth_and_poses_fit():
    sequence = open_sequence("tour:2?frames=60&size=120x160&fov=80")
    assert len(sequence) == 60
    frame = sequence[3]
    assert frame.image.shape == (120, 160, 3)
    assert frame.image.dtype == np.uint8
    assert frame.depth.dtype == np.float32
    assert frame.depth.min() > 0.2
    np.testing.assert_allclose(frame.intrinsics, intrinsics(120, 160, 80.0))
    np.testing.assert_array_equal(frame.image, tour_sequence(2, frames=60, size=(120, 160), fov=80.0)[3].image)
    check = check_sequence(sequence, pairs=3)
    assert check.ok, check.problems
    assert check.error < 0.01


def test_path_seed_and_sensor_are_options_of_the_name():
    plain, other = (
        open_sequence("tour:2?frames=4&size=24x32"),
        open_sequence("tour:2?frames=4&size=24x32&path=3&sensor=0"),
    )
    assert not np.array_equal(plain[0].T_world_cam, other[0].T_world_cam)
    same_seed = open_sequence("tour:2?size=24x32&path=3&frames=4")
    np.testing.assert_array_equal(same_seed[1].depth, other[1].depth)
    assert not np.array_equal(same_seed[1].image, other[1].image)


def test_a_pan_turns_in_place_and_a_blank_home_is_plain():
    poses = np.stack([frame.T_world_cam for frame in open_sequence("tour:2?frames=12&size=16x24&pan=1&style=blank")])
    assert np.ptp(poses[:, :3, 3], axis=0).max() < 2 * 0.04  # the sway of a hand
    turned = poses[0, :3, :3].T @ poses[-1, :3, :3]
    assert np.degrees(np.arccos((np.trace(turned) - 1) / 2)) > 30
    assert set(HOME_TEXTURES) - set(STYLES["blank"].textures) >= {"wood", "tiles", "bricks", "plaster"}


@pytest.mark.parametrize("style", ["corridor", "street"])
@pytest.mark.parametrize("path_seed", [None, 0, 1])
def test_a_drive_follows_the_axis_clear_of_everything(style, path_seed):
    tour = make_tour(4, style)
    poses = tour_path(tour, 60, path_seed)
    motion = poses[1:, :3, 3] - poses[:-1, :3, 3]
    ahead = (motion * poses[:-1, :3, 2]).sum(1) / motion.norm(dim=1)
    assert ahead.min() > np.cos(np.radians(10))
    assert motion[:, 2].abs().sum() > 2
    lower, upper = tour.rooms[0]
    assert ((lower < poses[:, :3, 3]) & (poses[:, :3, 3] < upper)).all()
    assert to_surfaces(tour, poses[:, :3, 3]).min() >= 0.3


def test_a_street_has_a_sky_without_depth_and_a_close_tour_is_near():
    street = open_sequence("tour:1?style=street&frames=3&size=48x64")[1]
    sky = street.depth == 0
    assert 0.02 < sky.mean() < 0.5
    assert street.image[sky].mean() > 120
    assert not sky[-16:].any()
    close = np.stack([frame.depth for frame in open_sequence("tour:1?style=close&frames=8&size=48x64")])
    assert close.min() > 0.2
    assert np.median(close) < 2


def test_an_exported_tour_reads_as_a_generic_sequence(tmp_path):
    sequence = tour_sequence(2, frames=3, size=(24, 32))
    again = open_sequence(export_tour(sequence, tmp_path / "tour"))
    assert again.layout == "generic"
    for a, b in zip(sequence, again, strict=True):
        np.testing.assert_array_equal(a.image, b.image)
        np.testing.assert_array_equal(a.depth, b.depth)
        np.testing.assert_allclose(a.T_world_cam, b.T_world_cam, atol=1e-12)
    with pytest.raises(FileExistsError, match="new or empty"):
        export_tour(sequence, tmp_path / "tour")


# --- things that move ----------------------------------------------------------------------------------------


def things(seed=62, style="hall", frames=60, count=6):
    tour = make_tour(seed, style)
    poses = tour_path(tour, frames)
    return tour, poses, make_movers(tour, poses, torch.from_numpy(intrinsics(48, 64)), (48, 64), count)


def test_movers_have_each_motion_and_size_and_move_as_named():
    _, poses, movers = things()
    assert {m.motion for m in movers} == set(MOTIONS)
    assert sorted(m.size for m in movers) == sorted([*SIZES, *SIZES])
    camera = poses[:, :3, 3].numpy()
    for m in movers:
        moved, (start, end) = m.position - m.position[0], (m.start, m.start + len(m.position))
        assert (m.position[:, 1] == 0).all()
        ground = (camera[start:end] - camera[start]) * [1, 0, 1]
        if m.motion in SHARES:
            np.testing.assert_allclose(moved, SHARES[m.motion] * ground, atol=1e-12)
            continue
        steps = np.diff(m.position, axis=0)
        np.testing.assert_allclose(steps, np.broadcast_to(steps[0], steps.shape), atol=1e-12)
        assert np.linalg.norm(steps[0]) > 0.02


def test_movers_touch_nothing_and_keep_clear_of_the_camera():
    tour, poses, movers = things(2, "home")
    assert len(movers) == 6
    low, high = tour.surfaces.corners.amin(1).numpy(), tour.surfaces.corners.amax(1).numpy()
    for m in movers:
        body = m.surfaces.corners.numpy()
        for n, position in enumerate(m.position):
            corners = body.reshape(-1, 3) + position
            margin = np.array([0.05, 0.0, 0.05])
            a, b = corners.min(0) + margin, np.minimum(corners.max(0) - margin, [9e9, -0.05, 9e9])
            assert not ((a < high) & (b > low)).all(1).any()
            gap = np.maximum(a - poses[m.start + n, :3, 3].numpy(), poses[m.start + n, :3, 3].numpy() - b).clip(0)
            assert np.linalg.norm(gap[::2]) > 0.5


def test_a_tour_with_movers_has_their_mask_and_their_depth_and_is_unchanged_beside_them():
    name = "tour:62?style=hall&frames=30&size=48x64&sensor=0"
    plain, moved = open_sequence(name), open_sequence(f"{name}&movers=4")
    shares = []
    for a, b in ((plain[i], moved[i]) for i in range(1, 30, 4)):
        assert a.moving is None
        np.testing.assert_array_equal(a.T_world_cam, b.T_world_cam)
        np.testing.assert_array_equal(a.depth[~b.moving], b.depth[~b.moving])
        assert (b.depth[b.moving] < a.depth[b.moving]).all()
        shares.append(b.moving.mean())
    assert 0.02 < np.mean(shares) < 0.4
    again = open_sequence(f"{name}&movers=4")
    np.testing.assert_array_equal(again[7].image, moved[7].image)
    assert in_memory(open_sequence("tour:62?style=hall&frames=1&size=24x32&movers=1"))[0].moving.dtype == bool
    with pytest.raises(ValueError, match="movers must be a number of at least 0"):
        open_sequence(f"{name}&movers=-1")


def test_the_mask_of_moving_pixels_follows_the_prediction_s_camera():
    frame = next(f for f in open_sequence("tour:62?style=hall&frames=30&size=48x64&movers=4") if f.moving.mean() > 0.05)
    half = intrinsics(24, 32)
    np.testing.assert_array_equal(
        moving_at(frame, half, (24, 32)),
        resample_nearest(frame.moving.astype(float), frame.intrinsics, half, (24, 32)) > 0,
    )
    assert moving_at(open_sequence("tour:2?frames=1&size=24x32")[0], half, (24, 32)) is None

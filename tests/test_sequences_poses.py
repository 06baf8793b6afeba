"""Trajectories: formats, interpolation, association."""

from __future__ import annotations

import layouts
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from layouts_more import rigid
from scipy.spatial.transform import Rotation, Slerp

from ufmstar_torch.eval.sequences import open_sequence
from ufmstar_torch.eval.sequences.poses import associate, numbers, read_pose, read_trajectory
from ufmstar_torch.gaussians.trajectory import Trajectory, interpolate_pose

QUARTER = np.sqrt(0.5)
# 90 degrees about z: x -> y, y -> -x.
R_QUARTER_Z = np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])


def write(tmp_path, text):
    path = tmp_path / "trajectory.txt"
    path.write_bytes(text if isinstance(text, bytes) else text.encode())
    return path


@pytest.mark.parametrize(
    ("line", "timestamp"),
    [
        (f"1 2 3 0 0 {QUARTER} {QUARTER}", None),
        (f"0.5 1 2 3 0 0 {QUARTER} {QUARTER}", 0.5),
        ("0 -1 0 1  1 0 0 2  0 0 1 3", None),
        ("7 0 -1 0 1  1 0 0 2  0 0 1 3", 7.0),
        ("0 -1 0 1  1 0 0 2  0 0 1 3  0 0 0 1", None),
        ("7 0 -1 0 1  1 0 0 2  0 0 1 3  0 0 0 1", 7.0),
        (f"0.5,1,2,3,0,0,{QUARTER},{QUARTER},", 0.5),
        (f"0.5; 1; 2; 3; 0; 0; {QUARTER}; {QUARTER}", 0.5),
        (f"0.5 ,\t1 ,2, 3, 0, 0, {QUARTER} , {QUARTER}", 0.5),
        (f"timestamp,tx,ty,tz,qx,qy,qz,qw\n0.5,1,2,3,0,0,{QUARTER},{QUARTER}", 0.5),
        (f"x;y;z;qw;qx;qy;qz\n1;2;3;{QUARTER};0;0;{QUARTER}", None),
        (f"# time(s) x(m) y(m) z(m) q_w q_x q_y q_z\n0.5 1 2 3 {QUARTER} 0 0 {QUARTER}", 0.5),
        (  # EuRoC
            "#timestamp, p_RS_R_x [m], p_RS_R_y [m], p_RS_R_z [m], q_RS_w [], q_RS_x [], q_RS_y [], q_RS_z [], "
            f"v_RS_R_x [m s^-1]\n0.5, 1, 2, 3, {QUARTER}, 0, 0, {QUARTER}, 9",
            0.5,
        ),
        (  # rostopic echo -p
            "%time,field.header.frame_id,field.pose.position.x,field.pose.position.y,field.pose.position.z,"
            "field.pose.orientation.x,field.pose.orientation.y,field.pose.orientation.z,field.pose.orientation.w\n"
            f"0.5,map,1,2,3,0,0,{QUARTER},{QUARTER}",
            0.5,
        ),
    ],
)
def test_every_format_gives_the_same_pose(tmp_path, line, timestamp):
    trajectory = read_trajectory(write(tmp_path, f"# a comment\n\n{line}  # and another\n"))
    np.testing.assert_allclose(trajectory.T_world_cam, [rigid(R_QUARTER_Z, [1, 2, 3])], atol=1e-15)
    if timestamp is None:
        assert trajectory.timestamps is None
    else:
        assert trajectory.timestamps.tolist() == [timestamp]


@pytest.mark.parametrize("factor", [2, 0, [1, -1, 1]], ids=str)
def test_a_matrix_that_is_no_rotation_is_no_pose(tmp_path, factor):
    path, truth = layouts.write_generic(tmp_path)
    truth.T_world_cam[2][:3, :3] *= factor
    np.savetxt(path / "poses.txt", [T.ravel() for T in truth.T_world_cam])
    [skipped] = open_sequence(path).skipped
    assert (skipped.name, skipped.reason[:24]) == ("9", "pose that is no rotation")


def test_rounded_quaternions_are_normalised(tmp_path):
    trajectory = read_trajectory(write(tmp_path, "0 0 0 0 0 0 0.7071 0.7071\n"))
    R = trajectory.T_world_cam[0, :3, :3]
    np.testing.assert_allclose(R @ R.T, np.eye(3), atol=1e-14)
    np.testing.assert_allclose(R, R_QUARTER_Z, atol=1e-14)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("0 0 0 0 0 0 0 1\n1 0 0 0 0 0 0.5 0.5\n", r"txt:2: the quaternion's norm is 0\.7071"),
        ("0 0 0 0 0 0 0 1\n# x\n1 0 0 0 0 0 zero 1\n", r"txt:3: expected a number, got 'zero'"),
        ("0 0 0 0 0 0 0 1\n1 0 0 0 0 0 1\n", r"txt:2: expected 8 numbers as in the first pose, got 7"),
        ("1 2 3\n", r"txt:1: expected a pose of .* got 3"),
        ("0,5 0,5 0,5 0 0 0 1\n", r"txt:1: expected a number with a decimal point, got '0,5'"),
        ("0,5;0,5;0,5;0;0;0;1\n", r"txt:1: expected a number with a decimal point, got '0,5'"),
        ("0,5\t0,5\t0,5\t0\t0\t0\t1\n", r"txt:1: expected a number with a decimal point, got '0,5'"),
        ("1 0 0 0 0 1 0 0 0 0 1 0 0 0 0 2\n", r"txt:1: a pose's bottom row must be 0 0 0 1"),
        ("nan 0 0 0 0 0 0 1\n", r"txt:1: the timestamp must be finite"),
        ("# nothing\n", r"no pose found"),
        (
            "a,b,c,d,e,f,g\n0,0,0,0,0,0,1\n",
            r"txt:1: expected numbers or a header .* timestamp tx ty tz qx qy qz qw, got 'a,b",
        ),
        ("x,y,z,qw,qx,qy,qz\n0,0,0,1,0,0,0\n0,0,0,1\n", r"txt:3: expected 7 columns or more, as the header .* got 4"),
        (b"\x89PNG\r\n\x1a\n\0\xff", r"txt: expected a text file"),
    ],
)
def test_a_bad_line_is_named(tmp_path, text, message):
    with pytest.raises(ValueError, match=message):
        read_trajectory(write(tmp_path, text))


def test_samples_are_sorted_and_repeated_times_dropped(tmp_path):
    text = "2 20 0 0 0 0 0 1\n1 10 0 0 0 0 0 1\n2 20.005 0 0 0 0 0 1\n"
    trajectory = read_trajectory(write(tmp_path, text))
    assert trajectory.timestamps.tolist() == [1, 2]
    assert trajectory.T_world_cam[:, 0, 3].tolist() == [10, 20]


@pytest.mark.parametrize(
    "second", ["2 3 0 0 0 0 0 1", f"2 0.02 0 0 0 0 {QUARTER} {QUARTER}", "2 0.02 0 0 0 0 1 0"], ids=str
)
def test_poses_with_one_timestamp_that_contradict_each_other_are_refused(tmp_path, second):
    text = f"1 0 0 0 0 0 0 1\n2 0.02 0 0 0 0 0 1\n{second}\n"
    with pytest.raises(ValueError, match=r"txt:3: the pose has the timestamp of line 2, but lies .* degrees from it"):
        read_trajectory(write(tmp_path, text))
    for equal in ("2 0.02 0 0 0 0 0 1", "2 0.025 0 0 0 0 0.005 0.9999875", "2 0.02 0 0 0 0 0 -1", "2 nan 0 0 0 0 0 1"):
        assert len(read_trajectory(write(tmp_path, f"1 0 0 0 0 0 0 1\n2 0.02 0 0 0 0 0 1\n{equal}\n"))) == 2


@pytest.mark.parametrize("token", ["nan", "-inf", "-1.#IND", "1.#QNAN00", "-1.#INF"])
def test_non_finite_poses_stay_as_nan(tmp_path, token):
    text = f"0 0 0 0 0 0 0 1\n1 {token} 0 0 0 0 0 1\n2 0 0 0 0 0 0 1\n"
    trajectory = read_trajectory(write(tmp_path, text))
    assert np.isfinite(trajectory.T_world_cam).all(axis=(1, 2)).tolist() == [True, False, True]
    assert np.isnan(interpolate_pose(trajectory, 0.5, max_gap=2)).all()
    assert np.isnan(interpolate_pose(trajectory, 1.0, max_gap=2)).all()
    assert np.isfinite(interpolate_pose(trajectory, 2.0, max_gap=2)).all()


def test_pose_file_of_another_shape(tmp_path):
    with pytest.raises(ValueError, match="expected a 4x4 matrix, got 3 x 4"):
        read_pose(write(tmp_path, "1 0 0 0\n0 1 0 0\n0 0 1 0\n"))
    with pytest.raises(ValueError, match=r"txt:2: expected 4 numbers"):
        read_pose(write(tmp_path, "1 0 0 0\n0 1 0\n0 0 1 0\n0 0 0 1\n"))


def test_interpolation_is_linear_and_turns_evenly(tmp_path):
    trajectory = read_trajectory(write(tmp_path, f"0 8 0 -4 0 0 0 1\n0.1 0 2 4 0 0 {QUARTER} {QUARTER}\n"))
    T = interpolate_pose(trajectory, 0.025, max_gap=0.1)
    np.testing.assert_allclose(T[:3, 3], [6.0, 0.5, -2.0], rtol=1e-12)
    np.testing.assert_allclose(T[:3, :3], Rotation.from_euler("z", 22.5, degrees=True).as_matrix(), atol=1e-12)
    np.testing.assert_array_equal(T[3], [0, 0, 0, 1])


def test_interpolated_rotations_are_slerp():
    rng = np.random.default_rng(0)
    turns = [np.zeros(3), 1e-9 * rng.normal(size=3), *rng.normal(size=(50, 3)), np.array([0, np.pi - 1e-7, 0])]
    for turn in turns:
        first = Rotation.random(random_state=1)
        samples = Rotation.concatenate([first, first * Rotation.from_rotvec(turn)])
        poses = np.tile(np.eye(4), (2, 1, 1))
        poses[:, :3, :3] = samples.as_matrix()
        for share in (0.1, 0.5, 0.8):
            found = interpolate_pose(Trajectory(np.array([0.0, 1.0]), poses), share, 1.0)
            np.testing.assert_allclose(found[:3, :3], Slerp([0, 1], samples)(share).as_matrix(), atol=1e-9)
    assert interpolate_pose(Trajectory(np.zeros(0), np.zeros((0, 4, 4))), 0.0) is None


def test_interpolation_needs_samples_around(tmp_path):
    trajectory = read_trajectory(write(tmp_path, "0 0 0 0 0 0 0 1\n0.2 1 0 0 0 0 0 1\n"))
    assert interpolate_pose(trajectory, 0.1, max_gap=0.1) is None
    assert interpolate_pose(trajectory, 0.1, max_gap=0.2)[0, 3] == pytest.approx(0.5)
    assert interpolate_pose(trajectory, -0.006, max_gap=0.2) is None
    assert interpolate_pose(trajectory, 0.206, max_gap=0.2) is None
    # outside, or in a gap, a sample within 5 ms is used unchanged
    assert [interpolate_pose(trajectory, t, max_gap=0.1)[0, 3] for t in (-0.0048, 0.0048, 0.196, 0.204)] == [0, 0, 1, 1]
    # a sample at the image's time needs no neighbour
    assert interpolate_pose(trajectory, 0.2005, max_gap=0.1)[0, 3] == 1
    without_times = read_trajectory(write(tmp_path, "0 0 0 0 0 0 1\n"))
    with pytest.raises(ValueError, match="no timestamps"):
        interpolate_pose(without_times, 0.0, 1.0)


def brute_force_association(first, second, limit):
    """Associate all pairs within the limit, closest first, each index once."""
    pairs, used = {}, set()
    for _, i, j in sorted((abs(a - b), i, j) for i, a in enumerate(first) for j, b in enumerate(second)):
        if abs(first[i] - second[j]) <= limit and i not in pairs and j not in used:
            pairs[i] = j
            used.add(j)
    return pairs


@given(st.lists(st.integers(0, 60), max_size=12), st.lists(st.integers(0, 60), max_size=12), st.integers(0, 9))
def test_association_equals_brute_force(first, second, limit):
    # integers: no difference lies within rounding of the limit
    a, b = np.array(first, dtype=float), np.array(second, dtype=float)
    assert associate(a, b, limit) == brute_force_association(a, b, limit)


@pytest.mark.parametrize(
    "values", [[1, 2, np.nan], [1, np.inf, 2], ["a", 1, 2], [1, 2], [[1], [2, 3]], [10**400, 1, 1], None]
)
def test_numbers_of_another_form_are_refused_with_the_callers_text(values):
    with pytest.raises(ValueError, match="expected three"):
        numbers(values, (3,), "expected three")
    assert numbers([[1, 2, 3]], (3,), "").tolist() == [1.0, 2.0, 3.0]

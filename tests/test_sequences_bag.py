"""ROS bags: the read data equals the written data; choice of topics; truncated and hostile files."""

from __future__ import annotations

import pickle
from io import BytesIO
from pathlib import Path
from types import SimpleNamespace

import layouts
import layouts_bag as written
import numpy as np
import pytest
from PIL import Image

from ufmstar_torch import cli
from ufmstar_torch.eval.sequences import FrameError, bag, open_sequence, ros_messages
from ufmstar_torch.eval.sequences.lens import Lens

KINDS = ("ros1", "db3", "mcap")


def require_same(sequence, truth, atol=2e-4):
    """Poses must be equal: both samples around an image are its pose, so interpolation has no error."""
    assert len(sequence) == 6
    for i, frame in enumerate(sequence):
        np.testing.assert_allclose(frame.T_world_cam, truth.T_world_cam[i], atol=1e-9)
        np.testing.assert_array_equal(frame.image, truth.images[i])
        np.testing.assert_allclose(frame.intrinsics, truth.K, atol=1e-9)
        np.testing.assert_allclose(frame.depth, truth.depths[i], atol=atol)
        assert frame.timestamp == pytest.approx((written.START + i * written.STEP) * 1e-9, abs=1e-6)


@pytest.mark.parametrize("poses", ["odometry", "tf", "pose", "covariance"])
@pytest.mark.parametrize("kind", KINDS)
def test_what_is_read_is_what_was_written(tmp_path, kind, poses):
    path, truth = written.write_bag(tmp_path, kind, poses)
    sequence = pickle.loads(pickle.dumps(open_sequence(path)))
    assert (sequence.layout, sequence.name, sequence.skipped) == ("bag", "walk", ())
    require_same(sequence, truth, atol=5e-4 + 1e-6)


@pytest.mark.parametrize(
    ("how", "atol"),
    [
        ({"compressed": True, "depth": "32FC1"}, 1e-6),
        ({"depth": "16UC1; compressedDepth png"}, 5e-4 + 1e-6),
        ({"depth": "32FC1; compressedDepth"}, 8e-3),  # half a step of 2000 / depth at 4 m
    ],
)
def test_compressed_images_and_depth(tmp_path, how, atol):
    path, truth = written.write_bag(tmp_path, **how)
    require_same(open_sequence(path), truth, atol)


GREY, RGB = 90, (200, 100, 50)
BAYER = {"rggb": [[200, 100], [100, 50]], "bggr": [[50, 100], [100, 200]], "gbrg": [[100, 50], [200, 100]]}


def encoded(encoding, full=255):
    """[4, 6, ...] values of a uniform image in an encoding, and its colour (8 bits)."""
    one = np.ones((4, 6, 1))
    colours = {"rgb": RGB, "bgr": RGB[::-1], "rgba": (*RGB, 7), "bgra": (*RGB[::-1], 7)}
    name = encoding.removesuffix("16").removesuffix("8")
    if name in colours:
        values = one * colours[name]
    elif name.startswith("bayer_"):
        values = np.tile([[100, 200], [50, 100]] if name.endswith("grbg") else BAYER[name[6:]], (2, 3))
    elif name in ("uyvy", "yuv422"):
        values = one * (128, GREY)
    elif name in ("yuyv", "yuv422_yuy2"):
        values = one * (GREY, 128)
    elif name in ("nv12", "nv21"):
        values = np.concatenate([np.full((4, 6), GREY), np.full((2, 6), 128)])
    else:
        values = GREY * one[..., 0]
    kind = np.uint16 if encoding.endswith("16") else np.uint8
    return np.rint(values * full / 255).astype(kind), RGB if name[:3] in ("rgb", "bgr", "bay") else (GREY,) * 3


def image_message(encoding, values, height=None, *, big=False, pad=3):
    rows = np.ascontiguousarray(values.astype(values.dtype.newbyteorder(">")) if big else values)
    rows = np.pad(rows.view(np.uint8).reshape(len(values), -1), ((0, 0), (0, pad)))
    size = {"height": height or len(values), "width": values.shape[1], "step": rows.shape[1]}
    return SimpleNamespace(encoding=encoding, is_bigendian=int(big), data=rows.ravel(), **size)


EIGHT_BITS = (
    *("rgb8", "bgr8", "rgba8", "bgra8", "mono8", "uyvy", "yuv422", "yuyv", "yuv422_yuy2", "nv12", "nv21"),
    *("bayer_rggb8", "bayer_bggr8", "bayer_gbrg8", "bayer_grbg8"),
)
SIXTEEN_BITS = ("mono16", "rgb16", "bgr16", "rgba16", "bgra16", "bayer_rggb16", "bayer_grbg16")


@pytest.mark.parametrize("encoding", EIGHT_BITS)
def test_encodings(encoding):
    values, expected = encoded(encoding)
    message = image_message(encoding, values, 4)
    found = ros_messages.colour(message, None, Path("a.bag"))
    assert (found.shape, found.dtype) == ((4, 6, 3), np.uint8)
    np.testing.assert_allclose(found.astype(int), np.broadcast_to(expected, (4, 6, 3)), atol=4)
    assert not ros_messages.is_depth(message)
    assert ros_messages.full_scale_of(message, Path("a.bag")) is None


@pytest.mark.parametrize("big", [False, True])
@pytest.mark.parametrize("full", [1023, 4095, 65535])
@pytest.mark.parametrize("encoding", SIXTEEN_BITS)
def test_images_of_more_than_8_bits_are_scaled_by_their_range(encoding, full, big):
    values, expected = encoded(encoding, full)
    message = image_message(encoding, values, big=big)
    assert ros_messages.full_scale_of(message, Path("a.bag")) == full
    for scale in (None, full):
        found = ros_messages.colour(message, scale, Path("a.bag"))
        np.testing.assert_allclose(found.astype(int), np.broadcast_to(expected, (4, 6, 3)), atol=4)
    darker = ros_messages.colour(image_message(encoding, values // 16, big=big), full, Path("a.bag"))
    np.testing.assert_allclose(darker.astype(int), np.broadcast_to(expected, (4, 6, 3)) // 16, atol=4)


@pytest.mark.parametrize(
    ("encoding", "meaning"), [("8UC1", "mono8"), ("8UC3", "bgr8"), ("8UC4", "bgra8"), ("16UC3", "bgr16")]
)
def test_types_without_a_colour_order_are_opencvs(encoding, meaning):
    values, expected = encoded(meaning, 255 if meaning.endswith("8") else 65535)
    found = ros_messages.colour(image_message(encoding, values), None, Path("a.bag"))
    np.testing.assert_allclose(found.astype(int), np.broadcast_to(expected, (4, 6, 3)), atol=4)


def test_images_that_cannot_be_decoded_are_named():
    message = image_message("rgb8", encoded("rgb8")[0])
    message.data = message.data[:-1]
    with pytest.raises(FrameError, match="an image of 6x4 rgb8 has 83 bytes, 21 a row"):
        ros_messages.colour(message, None, Path("a.bag"))
    odd = image_message("yuv422_yuy2", np.zeros((1, 5, 2), np.uint8), pad=0)
    with pytest.raises(FrameError, match="must have an even width, got 5"):
        ros_messages.colour(odd, None, Path("a.bag"))
    with pytest.raises(FrameError, match="must have an even height, got 3"):
        ros_messages.colour(image_message("nv12", np.zeros((4, 6), np.uint8), 3), None, Path("a.bag"))
    with pytest.raises(FrameError, match="encoding must be one of ROS's, got 'h264'"):
        ros_messages.colour(image_message("h264", np.zeros((4, 6), np.uint8)), None, Path("a.bag"))
    with pytest.raises(FrameError, match="must have colours or grey, got '32SC2'"):
        ros_messages.colour(image_message("32SC2", np.zeros((4, 6, 2), np.int32)), None, Path("a.bag"))


def test_the_camera_info_describes_the_lens(tmp_path):
    distorted = {"coefficients": (-0.05, 0.01, -0.002, 0.0005), "model": "equidistant"}
    path, truth = written.write_bag(tmp_path / "fisheye", camera=distorted)
    sequence = open_sequence(path)
    lens = Lens((truth.K[0, 0], truth.K[1, 1], truth.K[0, 2], truth.K[1, 2]), (48, 64), distorted["coefficients"], True)
    np.testing.assert_allclose(sequence.intrinsics, lens.K)
    assert (sequence[0].image != truth.images[0]).any()
    np.testing.assert_array_equal(open_sequence(path, intrinsics=[50, 50, 31, 23])[0].image, truth.images[0])

    info = SimpleNamespace(height=48, width=64, distortion_model="rational_polynomial", binning_x=0, binning_y=0)
    info.roi, info.D = SimpleNamespace(width=0, height=0), np.zeros(14)
    info.K, info.P = truth.K.ravel(), np.hstack([2 * truth.K, np.ones((3, 1))]).ravel()
    assert ros_messages.lens(info, False, "").coefficients == ()
    assert ros_messages.lens(info, True, "").intrinsics[0] == 2 * truth.K[0, 0]
    info.D[:8] = 0.001
    assert ros_messages.lens(info, False, "").coefficients == (0.001,) * 8
    for name, value, message in (
        ("binning_x", 2, "cropped or binned"),
        ("distortion_model", "omni", "distortion_model 'omni'"),
        ("K", np.zeros(9), "not calibrated"),
    ):
        with pytest.raises(ValueError, match=message):
            ros_messages.lens(SimpleNamespace(**{**vars(info), name: value}), False, "")


def second_camera(bag):
    image = np.zeros((48, 64, 3), np.uint8)
    bag.write("/left/image", written.START, bag.image(written.START, "left", image, "rgb8"))
    bag.write("/left/camera_info", written.START, bag.info(written.START, "left"))
    bag.write("/left/depth", written.START, bag.image(written.START, "left", image[..., 0].astype("<u2"), "16UC1"))
    bag.write("/slam", written.START, bag.pose_stamped(written.START, "map", np.eye(4)))


def test_topics_are_named_where_there_are_several(tmp_path):
    path, truth = written.write_bag(tmp_path, change=second_camera)
    with pytest.raises(ValueError, match=r"image may be /camera/image, /left/image: name one with --reader topics"):
        open_sequence(path)
    with pytest.raises(ValueError, match=r"the pose may be /odom, /slam: name one"):
        open_sequence(path, topics=["/left/image"])
    require_same(open_sequence(path, topics=["/camera/image", "/odom"]), truth, 6e-4)
    left = open_sequence(path, topics=["/left/image", "/slam"])
    assert (len(left), left[0].image.max(), left.depth_size) == (1, 0, (48, 64))
    np.testing.assert_array_equal(left[0].T_world_cam, np.eye(4))
    with pytest.raises(
        ValueError, match=r"topics: '/left/depth' shows another camera's view \('left', not 'optical'\)"
    ):
        open_sequence(path, topics=["/camera/image", "/left/depth", "/odom"])
    with pytest.raises(ValueError, match=r"topics: '/lidar' cannot be used; .* has /camera/camera_info \(sensor_msgs"):
        open_sequence(path, topics=["/lidar"])
    assert cli.main(["data", "check", str(path), "--reader", "topics=/camera/image,/odom"]) == 0


def test_depth_of_another_camera_is_left_out_and_named(tmp_path, caplog):
    def left(bag):
        bag.write("/left/depth", written.START, bag.image(written.START, "left", np.ones((4, 5), "<u2"), "16UC1"))

    path, _ = written.write_bag(tmp_path, depth=None, change=left)
    assert open_sequence(path)[0].depth is None
    assert "no depth: /left/depth is of 'left' and not registered to 'optical'" in caplog.text


def test_the_frame_of_a_pose_can_be_named(tmp_path, capfd):
    """A pose of the body without a frame name, and tf's world frame."""
    path, truth = written.write_bag(tmp_path / "tf", poses="tf")
    in_odom = open_sequence(path, topics=["/tf=odom"])
    for i, frame in enumerate(in_odom):
        expected = np.linalg.inv(written.T_MAP_ODOM) @ truth.T_world_cam[i]
        np.testing.assert_allclose(frame.T_world_cam, expected, atol=1e-9)
    with pytest.raises(
        ValueError, match=r"how the image's frame 'optical' moves in 'base'; it has optical, base, odom, m"
    ):
        open_sequence(path, topics=["/tf=base"])

    def body(bag):
        bag.write("/tf_static", written.START, bag.tf(written.START, ("base", "optical", written.T_BODY_CAMERA)))

    path, truth = written.write_bag(tmp_path / "pose", poses="pose", change=body)
    require_same(open_sequence(path), truth, 6e-4)
    moved = open_sequence(path, topics=["/pose=base"])
    np.testing.assert_allclose(moved[3].T_world_cam, truth.T_world_cam[3] @ written.T_BODY_CAMERA, atol=1e-9)
    with pytest.raises(ValueError, match=r"does not connect 'arm', .* say --reader topics=/pose=optical"):
        open_sequence(path, topics=["/pose=arm"])
    assert cli.main(["data", "check", str(path), "--reader", "topics=/pose=arm"]) == 1
    assert "--reader topics=/pose=optical" in capfd.readouterr().out


def static(parent, child):
    """Write a further static transform."""
    return lambda bag: bag.write("/tf_static", written.START, bag.tf(written.START, (parent, child, np.eye(4))))


@pytest.mark.parametrize(
    ("how", "options", "message"),
    [
        ({"poses": ""}, {}, "has no poses: pass trajectory"),
        ({"poses": "tf", "change": static("optical", "map")}, {}, "are a loop"),
        ({"poses": "tf", "change": static("map", "optical")}, {}, "'optical' has the parents 'base' and 'map'"),
        ({"camera": {"size": (480, 640)}}, {}, "principal point|do not fit"),
        ({}, {"images": "x"}, "layout 'bag' takes no images"),
    ],
)
def test_what_does_not_fit_is_named(tmp_path, how, options, message):
    path, _ = written.write_bag(tmp_path, **how)
    with pytest.raises(ValueError, match=message):
        open_sequence(path, **options)


def test_a_trajectory_replaces_the_poses(tmp_path):
    path, truth = written.write_bag(tmp_path, poses="")
    times = [(written.START + i * written.STEP) * 1e-9 for i in range(6)]
    lines = [f"{t:.9f} {layouts.quaternion_line(T)}" for t, T in zip(times, truth.T_world_cam, strict=True)]
    (tmp_path / "slam.txt").write_text("\n".join(lines))
    require_same(open_sequence(path, trajectory=tmp_path / "slam.txt"), truth, 6e-4)


@pytest.mark.parametrize("mode", ["1", "P", "L", "RGB"])
def test_compressed_depth_of_fewer_bits_is_no_depth(mode):
    content = BytesIO(bytes(12))
    content.seek(12)
    Image.new(mode, (4, 4)).save(content, "png")
    message = SimpleNamespace(data=np.frombuffer(content.getvalue(), np.uint8), format="16UC1; compressedDepth png")
    with pytest.raises(FrameError, match="one channel of 16 bits"):
        ros_messages.depth(message, None, Path("a.bag"))


def test_a_topic_whose_messages_are_missing_is_named(tmp_path, monkeypatch):
    path, _ = written.write_bag(tmp_path)
    monkeypatch.setattr(bag.Bag, "messages", lambda *_: iter(()))
    with pytest.raises(ValueError, match="should have messages, but has none"):
        open_sequence(path)

"""The ROS 2 node on serialised messages, with a stand-in for rclpy; its launch file."""

from __future__ import annotations

import runpy
import sys
from pathlib import Path
from types import ModuleType

import cv2
import layouts_bag as written
import numpy as np
import pytest
import ros_node
import torch
from onnx_files import small_network, write_fastdepth
from ros_stand_in import STORE, Node, received, ros

from ufmstar_torch import DepthPrediction, UncertainDepth
from ufmstar_torch.eval.sequences.bag import Bag
from ufmstar_torch.uncertain_depth import UncertaintyOutput

__all__ = ["ros"]
EXAMPLES = Path(ros_node.__file__).parent


class Seen(torch.nn.Module):
    """Two metres in the upper half and three in the lower; stores the colours of every image."""

    def __init__(self):
        super().__init__()
        self.images = []

    def forward(self, x):
        self.images.append(x[0].detach().clone())
        depth = torch.full(x[:, 0].shape, 2.0)
        depth[:, x.shape[2] // 2 :] = 3.0
        return DepthPrediction(depth)


@pytest.fixture(scope="module")
def model():
    """Compiled once; the module is reset before every test."""
    model = UncertainDepth(Seen(), posterior=False, check_poses=0)
    model(np.zeros((48, 64, 3), np.uint8), np.eye(4), (50.0, 50.0, 31.5, 23.5))
    return model


@pytest.fixture
def make(model, ros):
    """Make a node; its messages are those of the walk."""
    model.reset()
    model.networks[0].images.clear()

    def made(**settings):
        node = Node()
        return node, ros_node.CameraNode(node, model, ros_node.Settings(**settings))

    return made


@pytest.fixture(scope="module")
def messages(tmp_path_factory):
    """Write and read bags of the walk: by kind of poses, the messages in order, by topic."""

    def read(**how):
        path, scene = written.write_bag(tmp_path_factory.mktemp("bag"), **how)
        bag = Bag(path)
        return [(key.topic, message) for key, message in bag.messages(bag.topics)], scene

    return read


TOPICS = {
    "/camera/image": "image", "/camera/image/compressed": "image", "/camera/camera_info": "camera_info",
    "/odom": "odom", "/pose": "pose",
}  # fmt: skip


def play(node, camera, sent):
    """Deliver messages; images wait for their poses, one after the other."""
    infos = [message for topic, message in sent if topic == "/camera/camera_info"]
    node.callbacks["camera_info"](received(infos[0]))
    for topic, message in sent:
        name = TOPICS.get(topic, topic)
        if name in node.callbacks:
            node.callbacks[name](received(message))
        if name in ("/tf", "odom", "pose"):
            assert camera.live.wait_idle(20)


@pytest.mark.parametrize("poses", ["tf", "odometry", "pose"])
def test_the_node_publishes_every_image_at_its_pose(make, messages, poses, monkeypatch):
    sent, scene = messages(poses=poses)
    node, camera = make(poses=poses, world_frame="map", max_relative_sigma=0.5)
    results = []
    monkeypatch.setattr(camera.live, "_on_result", lambda result: results.append(result) or camera._publish(result))
    with camera:
        play(node, camera, sent)
    counts = camera.live.statistics
    # with tf and odometry, the first image's frame is unknown when its first pose arrives
    assert counts.images == 6
    assert counts.results >= 5
    assert len(results) == len(node.published["depth"]) == counts.results
    for result in results:
        index = round((result.stamp - written.START * 1e-9) / (written.STEP * 1e-9))
        np.testing.assert_allclose(result.T_world_cam, scene.T_world_cam[index], atol=1e-6)
    stamps = {topic: [stamp_of(m) for m in node.published[topic]] for topic in node.published if topic != "obstacles"}
    assert {len(set(map(tuple, stamps.values())))} == {1}, "all topics have the stamps of the images, to a nanosecond"
    assert set(stamps["depth"]) <= {written.START + i * written.STEP for i in range(6)}
    depth, sigma, info, cloud = (node.published[topic][-1] for topic in ("depth", "sigma", "depth_info", "points"))
    assert {m.header.frame_id for m in (depth, sigma, info, cloud)} == {"optical"}
    values = depth.data.view("<f4").reshape(depth.height, depth.width)
    assert (depth.encoding, values.shape, set(np.unique(values))) == ("32FC1", (48, 64), {2.0, 3.0})
    spread = sigma.data.view("<f4").reshape(48, 64)
    assert (spread[np.isfinite(values)] > 0).all()
    np.testing.assert_allclose(info.k.reshape(3, 3), scene.K, atol=1e-9)
    assert [field.name for field in cloud.fields] == ["x", "y", "z", "variance"]
    points = cloud.data.view("<f4").reshape(-1, 4)
    assert len(points) == cloud.width == 48 * 64
    np.testing.assert_allclose(points[:, 3], np.square(spread.ravel()), rtol=1e-5)
    u, v, _ = scene.K @ points[:, :3].T / points[:, 2]
    np.testing.assert_allclose([u, v], np.indices((48, 64))[::-1].reshape(2, -1), atol=1e-3)


def stamp_of(message):
    return message.header.stamp.sec * 10**9 + message.header.stamp.nanosec


def test_the_network_gets_the_colours_of_the_image(make, messages):
    """The bag's images are bgr8 with padded rows; compressed ones are PNG."""
    for compressed in (False, True):
        sent, scene = messages(poses="pose", compressed=compressed)
        node, camera = make(poses="pose", compressed=compressed)
        with camera:
            play(node, camera, sent)
        seen = camera.live.model.networks[0].images
        assert len(seen) >= 6
        expected = torch.from_numpy(scene.images[-1]).permute(2, 0, 1) / 255
        torch.testing.assert_close(seen[-1], expected, atol=1e-6, rtol=0)


def test_sensor_topics_have_the_qos_of_sensors(make):
    node, camera = make(poses="odometry")
    camera.live.close()
    assert {topic: node.qos[topic] for topic in ("image", "camera_info", "odom")} == dict.fromkeys(
        ("image", "camera_info", "odom"), "sensor data"
    )
    assert node.qos["/tf_static"].durability == "transient local"
    assert "/tf" not in node.qos


def test_images_that_cannot_be_used_are_named(make, messages):
    sent, _ = messages(poses="pose")
    image = next(message for topic, message in sent if topic == "/camera/image")
    node, camera = make(poses="pose")
    with camera:
        node.callbacks["image"](image)
        info = next(message for topic, message in sent if topic == "/camera/camera_info")
        binned = STORE.types[info.__msgtype__](**{**vars(info), "binning_x": 2})
        node.callbacks["camera_info"](binned)
        node.callbacks["camera_info"](info)
        unknown = STORE.types[image.__msgtype__](**{**vars(image), "encoding": "h264"})
        node.callbacks["image"](unknown)
    assert camera.live.statistics.images == 0
    for text, expected in zip(node.logged, ("before camera_info", "cropped or binned", "got 'h264'"), strict=True):
        assert expected in text


def test_a_distorted_camera_is_undistorted(make, messages):
    sent, scene = messages(poses="pose", camera={"coefficients": (-0.2, 0.05, 0.0, 0.0, 0.0)})
    node, camera = make(poses="pose")
    with camera:
        play(node, camera, sent)
    expected = cv2.undistort(scene.images[-1], scene.K, np.array([-0.2, 0.05, 0, 0, 0]), None, camera._lens.K)
    seen = (255 * camera.live.model.networks[0].images[-1].permute(1, 2, 0)).numpy()
    assert np.abs(seen - expected).mean() < 1
    np.testing.assert_allclose(node.published["depth_info"][-1].k.reshape(3, 3), camera._lens.K)


def test_frames_that_tf_does_not_connect_are_named(make, messages):
    sent, _ = messages(poses="odometry")
    node, camera = make(poses="odometry")
    with camera:
        play(node, camera, [one for one in sent if one[0] != "/tf_static"])
    assert camera.live.statistics.poses == 0
    assert "tf does not connect 'optical' with 'base'" in node.logged


def test_obstacles_are_the_points_that_are_near_with_their_probability(make, messages, monkeypatch):
    """The probability of a Gaussian; the lower half at 3 m is not near 2.5 m, except where it is uncertain."""

    def nearer(out, than):
        return torch.special.ndtr((than - out.depth) / out.std)

    monkeypatch.setattr(UncertaintyOutput, "probability_nearer", nearer, raising=False)
    sent, _ = messages(poses="pose")
    for probability in (0.5, 0.01):
        node, camera = make(poses="pose", obstacle_range=2.5, obstacle_probability=probability)
        with camera:
            play(node, camera, sent)
        points = node.published["obstacles"][-1].data.view("<f4").reshape(-1, 4)
        assert ((points[:, 2] == 2).sum(), (points[:, 2] == 3).any()) == (24 * 64, probability == 0.01)


def test_no_obstacle_before_anything_supports_a_probability(make, messages, monkeypatch):
    def nearer(out, than):
        raise ValueError("no anchors yet")

    monkeypatch.setattr(UncertaintyOutput, "probability_nearer", nearer, raising=False)
    node, camera = make(poses="pose", obstacle_range=2.5)
    with camera:
        play(node, camera, messages(poses="pose")[0])
    assert {cloud.width for cloud in node.published["obstacles"]} == {0}
    assert "no obstacles: no anchors yet" in node.logged


@pytest.mark.slow
def test_the_program(ros, tmp_path, messages):
    weights = write_fastdepth(tmp_path / "net.onnx", small_network(), 224)
    sent, _ = messages(poses="pose")
    ros.node.parameters |= {"weights": str(weights), "poses": "pose", "max_components": 512}

    def drive(node):
        for topic, message in sent:
            if TOPICS.get(topic) in node.callbacks:
                node.callbacks[TOPICS[topic]](message)
        raise KeyboardInterrupt

    ros.drive = drive
    ros_node.main(["ros_node.py"])
    assert "images=5" in ros.node.logged[-1], "one came before camera_info"
    ros.node.parameters["poses"] = "gps"
    with pytest.raises(ValueError, match="poses must be tf, odometry or pose, got 'gps'"):
        ros_node.main([])


def test_the_launch_file_starts_the_node(monkeypatch):
    """With stand-ins for launch; the parameters in the file exist."""
    launch, actions, substitutions = (ModuleType(name) for name in ("launch", "launch.actions", "launch.substitutions"))
    launch.LaunchDescription = list
    actions.DeclareLaunchArgument = lambda name, **how: ("argument", name, how)
    actions.ExecuteProcess = lambda **how: ("process", how)
    substitutions.LaunchConfiguration = lambda name: f"<{name}>"
    for module in (launch, actions, substitutions):
        monkeypatch.setitem(sys.modules, module.__name__, module)
    *arguments, (kind, process) = runpy.run_path(str(EXAMPLES / "ufmstar.launch.py"))["generate_launch_description"]()
    assert kind == "process"
    words = ["".join(word) for word in process["cmd"]]
    assert words[:3] == ["<python>", str(EXAMPLES / "ros_node.py"), "--ros-args"]
    assert "image:=<camera>/<image>" in words
    defaults = {name: how.get("default_value") for _, name, how in arguments}
    assert "weights" in defaults
    assert Path(defaults["parameters"]).is_file()
    import yaml

    stated = yaml.safe_load(Path(defaults["parameters"]).read_text())["ufmstar"]["ros__parameters"]
    ros_node.Settings(**stated)

"""A ROS 2 node: depth with a standard deviation for every pixel of a camera, as images and as points.

    python examples/ros_node.py --ros-args -p weights:=fastdepth_nyu.onnx -r image:=/camera/color/image_raw \\
        -r camera_info:=/camera/color/camera_info

Or with ``ros2 launch examples/ufmstar.launch.py``. All parameters are in :class:`Settings`. With ``poses:=tf``, poses
are those of the image's frame in ``world_frame``; with ``odometry`` those of ``child_frame_id``, which tf connects to
the image's frame; with ``pose`` (PoseStamped) those of the image's frame. Images may be distorted (``camera_info``
describes how) and of any usual encoding; with ``compressed:=true`` the topic ``image`` is a CompressedImage.

Published with the stamp and frame of the image: ``depth``, ``sigma`` (32FC1, m, NaN = none), their ``depth_info``,
``points`` (x y z and variance, m and m^2) and, with ``obstacle_range`` > 0, ``obstacles``: the points nearer than that
range with at least ``obstacle_probability``, which mark cells of Nav2's costmap. ``points`` clear cells; without
``max_relative_sigma`` an uncertain depth beyond an obstacle clears it.
"""

from __future__ import annotations

import sys
from array import array
from collections import OrderedDict
from collections.abc import Sequence
from dataclasses import dataclass, fields
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np
import torch

from ufmstar_torch import LiveDepth, LiveResult, UfMStarConfig, UncertainDepth
from ufmstar_torch.eval.sequences import FrameError
from ufmstar_torch.eval.sequences import ros_messages as ros
from ufmstar_torch.eval.sequences.ground_truth import points_of
from ufmstar_torch.eval.sequences.lens import Lens
from ufmstar_torch.eval.sequences.message_builder import MessageBuilder
from ufmstar_torch.eval.sequences.poses import poses_from_quaternions
from ufmstar_torch.models import load_network

REMEMBERED = 64  # headers of images whose results are not published yet


@dataclass(frozen=True)
class Settings:
    """The node's parameters."""

    model: str = "fastdepth"  # kind of network, as for `ufmstar run --model`
    weights: str = ""  # its file
    spec: str = ""  # its declarations, for ONNX networks
    device: str = "cpu"  # of the network
    posterior: bool = True  # correct the depth with anchors from the images
    max_components: int = 4096  # limit of memory
    poses: str = "tf"  # tf, odometry or pose
    world_frame: str = "odom"  # for tf: a frame in which poses do not jump
    compressed: bool = False  # the topic image is a CompressedImage
    rectified: bool = False  # the images are rectified: use P of camera_info
    max_relative_sigma: float = 0.0  # larger shares of the depth are left out of depth, sigma and points; 0 = keep all
    obstacle_range: float = 0.0  # [m]; 0 = no obstacles
    obstacle_probability: float = 0.5

    @classmethod
    def of(cls, node: Any) -> Settings:
        """Declare the parameters of a node, and read them. Raises ValueError: ``poses`` has another value."""
        values = {f.name: node.declare_parameter(f.name, f.default).value for f in fields(cls)}
        if values["poses"] not in ("tf", "odometry", "pose"):
            raise ValueError(f"poses must be tf, odometry or pose, got {values['poses']!r}")
        return cls(**values)


class LatestFrames:
    """The newest transform of every frame of tf."""

    def __init__(self) -> None:
        self._in_parent: dict[str, tuple[str, np.ndarray]] = {}

    def add(self, transform: Any) -> None:
        """Take a TransformStamped."""
        child, parent = ros.frame_name(transform.child_frame_id), ros.frame_name(transform.header.frame_id)
        motion = transform.transform
        self._in_parent[child] = parent, pose_matrix(motion.translation, motion.rotation)

    def chain(self, frame: str) -> list[str]:
        """The frame, its parent, ... up to the root; each once."""
        listed = [frame]
        while (found := self._in_parent.get(listed[-1])) and found[0] not in listed:
            listed.append(found[0])
        return listed

    def between(self, frame: str, other: str) -> np.ndarray | None:
        """[4, 4] the pose of a frame in another one; None if they are not connected."""
        chains = self.chain(frame), self.chain(other)
        common = next((name for name in chains[0] if name in chains[1]), None)
        if common is None:
            return None
        poses = []
        for chain in chains:
            T = np.eye(4)
            for name in chain[: chain.index(common)]:
                T = self._in_parent[name][1] @ T
            poses.append(T)
        return np.asarray(np.linalg.inv(poses[1]) @ poses[0])


class CameraNode:
    """Subscribes to a camera and its poses, and publishes what ``LiveDepth`` returns; a context manager.

    Args:
        node: of rclpy.
        model: warmed up.
        settings: see :class:`Settings`.
    """

    def __init__(self, node: Any, model: UncertainDepth, settings: Settings) -> None:
        self._node, self._settings, self._frames = node, settings, LatestFrames()
        self._lens: Lens | None = None
        self._camera = ""  # frame of the images
        self._white: int | None = None  # largest value of images of more than 8 bits
        self._headers: OrderedDict[float, Any] = OrderedDict()  # of images by stamp
        self._messages = MessageBuilder(message_of)
        self.live = LiveDepth(model, self._publish)
        qos, kinds = import_module("rclpy.qos"), ("Image", "Image", "CameraInfo", "PointCloud2", "PointCloud2")
        latest = qos.QoSProfile(depth=1, reliability=qos.ReliabilityPolicy.RELIABLE)
        sensor = import_module("sensor_msgs.msg")
        topics = ("depth", "sigma", "depth_info", "points", "obstacles")
        self._topics = {
            topic: node.create_publisher(getattr(sensor, kind), topic, latest)
            for topic, kind in zip(topics, kinds, strict=True)
        }
        image = sensor.CompressedImage if settings.compressed else sensor.Image
        node.create_subscription(sensor.CameraInfo, "camera_info", self._on_info, qos.qos_profile_sensor_data)
        node.create_subscription(image, "image", self._on_image, qos.qos_profile_sensor_data)
        latched = qos.QoSProfile(depth=100, durability=qos.DurabilityPolicy.TRANSIENT_LOCAL)
        tf = import_module("tf2_msgs.msg").TFMessage
        node.create_subscription(tf, "/tf_static", self._on_static, latched)
        if settings.poses == "tf":
            node.create_subscription(tf, "/tf", self._on_tf, qos.QoSProfile(depth=100))
        elif settings.poses == "odometry":
            odometry = import_module("nav_msgs.msg").Odometry
            node.create_subscription(odometry, "odom", self._on_odometry, qos.qos_profile_sensor_data)
        else:
            pose = import_module("geometry_msgs.msg").PoseStamped
            node.create_subscription(pose, "pose", self._on_pose, qos.QoSProfile(depth=100))

    def __enter__(self) -> CameraNode:
        self.live.__enter__()
        return self

    def __exit__(self, *error: Any) -> None:
        self.live.__exit__(*error)

    def _on_info(self, message: Any) -> None:
        try:
            self._lens = ros.lens(message, self._settings.rectified, "camera_info")
        except ValueError as error:
            self._node.get_logger().error(str(error), once=True)

    def _on_image(self, message: Any) -> None:
        self._camera = ros.frame_name(message.header.frame_id)
        if self._lens is None:
            self._node.get_logger().warning("images are ignored before camera_info", once=True)
            return
        try:
            if (white := ros.full_scale_of(message, Path("image"))) is not None:
                self._white = max(white, self._white or 0)
            rgb = ros.colour(message, self._white, Path("image"))
            lens = self._lens.resized((rgb.shape[0], rgb.shape[1]))
            rgb, K = lens.undistorted(rgb), lens.K
        except (FrameError, ValueError) as error:
            self._node.get_logger().error(str(error), once=True)
            return
        stamp = seconds(message)
        self._headers[stamp] = message.header
        if len(self._headers) > REMEMBERED:
            self._headers.popitem(last=False)
        self.live.push_image(stamp, rgb, K)

    def _on_static(self, message: Any) -> None:
        for transform in message.transforms:
            self._frames.add(transform)

    def _on_tf(self, message: Any) -> None:
        self._on_static(message)
        moved = {ros.frame_name(t.child_frame_id): seconds(t) for t in message.transforms}
        world = ros.frame_name(self._settings.world_frame)
        between = set(self._frames.chain(self._camera)) ^ set(self._frames.chain(world))
        stamps = [stamp for child, stamp in moved.items() if child in between]
        T = self._frames.between(self._camera, world) if stamps else None
        if T is not None:
            self.live.push_pose(max(stamps), T)
        elif stamps and self._camera:
            self._node.get_logger().warning(f"tf does not connect {self._camera!r} with {world!r}", once=True)

    def _on_odometry(self, message: Any) -> None:
        body, pose = ros.frame_name(message.child_frame_id), message.pose.pose
        T_body_camera = self._frames.between(self._camera, body)
        if T_body_camera is not None:
            self.live.push_pose(seconds(message), pose_matrix(pose.position, pose.orientation) @ T_body_camera)
        elif self._camera:
            self._node.get_logger().warning(f"tf does not connect {self._camera!r} with {body!r}", once=True)

    def _on_pose(self, message: Any) -> None:
        self.live.push_pose(seconds(message), pose_matrix(message.pose.position, message.pose.orientation))

    def _publish(self, result: LiveResult) -> None:
        """Publish the maps of an image; in the worker's thread."""
        out, settings = result.out, self._settings
        depth, variance = out.depth, out.variance
        sigma = variance.sqrt()
        valid = out.valid & (depth > 0) & sigma.isfinite()
        if settings.max_relative_sigma > 0:
            valid &= sigma <= settings.max_relative_sigma * depth
        z, s = (torch.where(valid, values, torch.nan)[0].cpu().float().numpy() for values in (depth, sigma))
        K = out.intrinsics[0].cpu().double().numpy()
        image = self._headers.get(result.stamp)
        if image is None:
            return
        stamp = image.stamp.sec * 10**9 + image.stamp.nanosec
        header = self._messages.header(stamp, image.frame_id)
        maps = {"depth": (z, "32FC1"), "sigma": (s, "32FC1")}
        for topic, (values, encoding) in maps.items():
            self._topics[topic].publish(self._messages.image(header, values, encoding))
        self._topics["depth_info"].publish(self._messages.info(header, K, z.shape))
        self._topics["points"].publish(self._cloud(header, z, s, K))
        if settings.obstacle_range > 0:
            near = self._near(result)
            whole, spread = (torch.where(out.valid, x, torch.nan)[0].cpu().float().numpy() for x in (depth, sigma))
            mark = near & np.isfinite(whole)
            self._topics["obstacles"].publish(self._cloud(header, np.where(mark, whole, np.nan), spread, K))

    def _near(self, result: LiveResult) -> np.ndarray:
        """[H, W] True where the depth is nearer than the range of obstacles with their probability; before the first
        anchor nowhere."""
        try:
            probability = result.out.probability_nearer(self._settings.obstacle_range)
        except ValueError as error:  # nothing supports a probability yet
            self._node.get_logger().warning(f"no obstacles: {error}", once=True)
            return np.zeros(result.out.depth.shape[1:], dtype=np.bool_)
        return np.asarray(probability[0].cpu().numpy() >= self._settings.obstacle_probability)

    def _cloud(self, header: Any, z: np.ndarray, sigma: np.ndarray, K: np.ndarray) -> Any:
        """The points of the pixels with a depth [m], in the axes of the image."""
        v, u = np.nonzero(np.isfinite(z))
        x, y, depth = points_of(u, v, z[v, u], K).T
        return self._messages.cloud(header, {"x": x, "y": y, "z": depth, "variance": np.square(sigma[v, u])})


def seconds(message: Any) -> float:
    """The stamp of a message's header [s]."""
    return float(message.header.stamp.sec + 1e-9 * message.header.stamp.nanosec)


def pose_matrix(position: Any, rotation: Any) -> np.ndarray:
    """[4, 4] of a message's position and quaternion; NaN if they are not finite."""
    p, q = position, rotation
    return poses_from_quaternions(np.array([[p.x, p.y, p.z]]), np.array([[q.x, q.y, q.z, q.w]]))[0]


def message_of(kind: str, **values: Any) -> Any:
    """A message of rclpy, which takes bytes as an ``array`` and other arrays as lists."""
    package, _, name = kind.split("/")
    plain = {
        key: value
        if not isinstance(value, np.ndarray)
        else array("B", value.tobytes())
        if value.dtype == np.uint8
        else value.tolist()
        for key, value in values.items()
    }
    return getattr(import_module(f"{package}.msg"), name)(**plain)


def load(settings: Settings) -> UncertainDepth:
    """The network with UfM*, warmed up. Errors as ``load_network``."""
    how = {"spec": settings.spec} if settings.spec else {}
    network = load_network(settings.model, settings.weights, **how)
    config = UfMStarConfig(on_bad_frame="skip", max_components=settings.max_components)
    model = UncertainDepth(network, config, posterior=settings.posterior, multiview_device="cpu").to(settings.device)
    model.warm_up()
    return model


def main(words: Sequence[str] | None = None) -> None:
    """Run until the node is shut down."""
    rclpy = import_module("rclpy")
    rclpy.init(args=sys.argv if words is None else list(words))
    node = rclpy.create_node("ufmstar")
    settings = Settings.of(node)
    with CameraNode(node, load(settings), settings) as camera:
        try:
            rclpy.spin(node)
        except KeyboardInterrupt:
            pass
        finally:
            node.get_logger().info(str(camera.live.statistics))


if __name__ == "__main__":
    main()

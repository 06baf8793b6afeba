"""A ROS 2 node on ``LiveDepth``: images and poses in, corrected depth and sigma (32FC1, metres) out.
    python examples/ros_node.py fastdepth_nyu.onnx --ros-args -r image:=/camera/image_raw -r pose:=/slam/pose

Topics: image (rgb8), camera_info, pose (PoseStamped of the camera's optical frame); depth, sigma.
"""

from __future__ import annotations

import sys
from importlib import import_module
from typing import Any

import numpy as np

from ufmstar_torch import LiveDepth, LiveResult, UfMStarConfig, UncertainDepth
from ufmstar_torch.eval.sequences.poses import poses_from_quaternions
from ufmstar_torch.models import load_network


def attach(node: Any, model: UncertainDepth, sensor: Any, geometry: Any) -> LiveDepth:
    """Subscribe and publish with a node; ``sensor`` and ``geometry`` are ROS's ``*_msgs.msg``. The caller closes it."""
    topics = {name: node.create_publisher(sensor.Image, name, 1) for name in ("depth", "sigma")}
    K: dict[str, np.ndarray] = {}

    def seconds(m: Any) -> float:
        return float(m.header.stamp.sec + 1e-9 * m.header.stamp.nanosec)

    def publish(result: LiveResult) -> None:
        for name, value in (("depth", result.out.depth), ("sigma", result.out.std)):
            message = sensor.Image(height=value.shape[1], width=value.shape[2], step=4 * value.shape[2])
            message.encoding, message.data = "32FC1", value[0].cpu().numpy().tobytes()
            stamp = message.header.stamp
            stamp.sec, stamp.nanosec = int(result.stamp), int(1e9 * (result.stamp % 1))
            topics[name].publish(message)

    def on_image(message: Any) -> None:
        rows = np.frombuffer(message.data, np.uint8).reshape(message.height, message.step)
        if K:
            live.push_image(seconds(message), rows[:, : 3 * message.width].reshape(len(rows), -1, 3), K["of"])

    def on_pose(message: Any) -> None:
        p, q = message.pose.position, message.pose.orientation
        T = poses_from_quaternions(np.array([[p.x, p.y, p.z]]), np.array([[q.x, q.y, q.z, q.w]]))[0]
        live.push_pose(seconds(message), T)

    live = LiveDepth(model, publish)
    node.create_subscription(sensor.CameraInfo, "camera_info", lambda m: K.update(of=m.k.reshape(3, 3)), 1)
    node.create_subscription(sensor.Image, "image", on_image, 1)
    node.create_subscription(geometry.PoseStamped, "pose", on_pose, 100)
    return live


if __name__ == "__main__":
    net = load_network("fastdepth", sys.argv[1])
    model = UncertainDepth(net, UfMStarConfig(on_bad_frame="skip"))
    (rclpy := import_module("rclpy")).init(args=sys.argv)
    node = rclpy.create_node("ufmstar")
    with attach(node, model, import_module("sensor_msgs.msg"), import_module("geometry_msgs.msg")):
        rclpy.spin(node)

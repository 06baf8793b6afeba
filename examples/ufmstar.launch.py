"""Starts ``ros_node.py``: ``ros2 launch examples/ufmstar.launch.py weights:=fastdepth_nyu.onnx camera:=/camera/color``.

``python`` is the interpreter of the environment in which ``ufmstar_torch`` is installed and ROS 2 is sourced. Further
parameters are in a YAML file, ``parameters:=FILE``.
"""

from pathlib import Path

from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument, ExecuteProcess
from launch.substitutions import LaunchConfiguration

ARGUMENTS = {
    "python": ("python3", "interpreter with ufmstar_torch"),
    "weights": (None, "file of the network"),
    "camera": ("/camera/color", "namespace of the images and camera_info"),
    "image": ("image_raw", "topic of the images below camera; image_raw/compressed with compressed: true"),
    "poses": ("tf", "tf, odometry or pose"),
    "world_frame": ("odom", "frame of the poses of tf"),
    "parameters": (str(Path(__file__).with_name("ufmstar.yaml")), "YAML file with further parameters"),
}


def generate_launch_description() -> LaunchDescription:
    """The arguments and the process of the node."""
    value = {name: LaunchConfiguration(name) for name in ARGUMENTS}
    camera = value["camera"]
    command = [
        value["python"], str(Path(__file__).with_name("ros_node.py")), "--ros-args",
        "--params-file", value["parameters"],
        "-p", ["weights:=", value["weights"]],
        "-p", ["poses:=", value["poses"]],
        "-p", ["world_frame:=", value["world_frame"]],
        "-r", ["image:=", camera, "/", value["image"]],
        "-r", ["camera_info:=", camera, "/camera_info"],
    ]  # fmt: skip
    declared = [
        DeclareLaunchArgument(name, default_value=default, description=text)
        for name, (default, text) in ARGUMENTS.items()
    ]
    return LaunchDescription([*declared, ExecuteProcess(cmd=command, output="screen")])

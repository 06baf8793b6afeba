"""ROS 2 messages from arrays, for a bag (rosbags) or a node (rclpy): images, camera info, point clouds, tf."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

_FLOAT32 = 7  # of sensor_msgs/PointField


class MessageBuilder:
    """Makes messages of one camera.

    Args:
        make: returns the message of a type ("sensor_msgs/msg/Image") with the values of its fields by name; arrays of
            bytes are NumPy arrays, as rosbags takes them.
    """

    def __init__(self, make: Callable[..., Any]) -> None:
        self._make = make

    def header(self, stamp: int, frame: str) -> Any:
        """The header of a message.

        Args:
            stamp: time [ns].
            frame: name of the frame of its coordinates; of images the optical frame.
        """
        time = self._make("builtin_interfaces/msg/Time", sec=stamp // 10**9, nanosec=stamp % 10**9)
        return self._make("std_msgs/msg/Header", stamp=time, frame_id=frame)

    def image(self, header: Any, values: NDArray[Any], encoding: str) -> Any:
        """An Image of values [H, W] or [H, W, C], whose type is that of the encoding ("rgb8", "32FC1")."""
        data = np.ascontiguousarray(values).view(np.uint8).ravel()
        size = {"height": len(values), "width": values.shape[1], "step": data.size // len(values)}
        return self._make("sensor_msgs/msg/Image", header=header, **size, encoding=encoding, is_bigendian=0, data=data)

    def info(self, header: Any, K: NDArray[np.float64], size: tuple[int, ...]) -> Any:
        """The CameraInfo of images without distortion, of intrinsics [3, 3] [px] and a size (H, W)."""
        region = dict.fromkeys(("x_offset", "y_offset", "height", "width"), 0)
        roi = self._make("sensor_msgs/msg/RegionOfInterest", **region, do_rectify=False)
        P = np.hstack([K, np.zeros((3, 1))]).ravel()
        camera = {"d": np.zeros(5), "k": K.ravel().copy(), "r": np.eye(3).ravel(), "p": P, "roi": roi}
        how = {"height": size[0], "width": size[1], "distortion_model": "plumb_bob", "binning_x": 0, "binning_y": 0}
        return self._make("sensor_msgs/msg/CameraInfo", header=header, **camera, **how)

    def cloud(self, header: Any, columns: Mapping[str, NDArray[Any]]) -> Any:
        """The PointCloud2 of points, with a field of type float32 for every column [P]."""
        data = np.column_stack([np.asarray(values, dtype="<f4") for values in columns.values()])
        data = np.ascontiguousarray(data.reshape(-1, len(columns)), dtype="<f4")
        width, how = data.itemsize * len(columns), {"datatype": _FLOAT32, "count": 1}
        fields = [
            self._make("sensor_msgs/msg/PointField", name=name, offset=data.itemsize * i, **how)
            for i, name in enumerate(columns)
        ]
        size = {"height": 1, "width": len(data), "point_step": width, "row_step": width * len(data)}
        return self._make(
            "sensor_msgs/msg/PointCloud2", header=header, fields=fields, is_bigendian=False, is_dense=True,
            data=data.view(np.uint8).ravel(), **size,
        )  # fmt: skip

    def tf(self, header: Any, child: str, T: NDArray[np.float64]) -> Any:
        """The TFMessage of the pose [4, 4] [m] of a frame ``child`` in the header's frame."""
        quaternion = Rotation.from_matrix(T[:3, :3]).as_quat()
        position = dict(zip("xyz", T[:3, 3].tolist(), strict=True))
        motion = self._make(
            "geometry_msgs/msg/Transform",
            translation=self._make("geometry_msgs/msg/Vector3", **position),
            rotation=self._make("geometry_msgs/msg/Quaternion", **dict(zip("xyzw", quaternion.tolist(), strict=True))),
        )
        how = {"header": header, "child_frame_id": child, "transform": motion}
        return self._make(
            "tf2_msgs/msg/TFMessage", transforms=[self._make("geometry_msgs/msg/TransformStamped", **how)]
        )

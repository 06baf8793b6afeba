"""A run's result as a ROS 2 bag (mcap), written with rosbags, for RViz, a costmap or ``open_sequence``.

Frames: tf has ``camera`` (optical axes) in ``world``. Images, depth and sigma have the pixels of the image, or of the
depth maps without images. A pixel that is left out is NaN (REP 118).
"""

from __future__ import annotations

import shutil
from collections.abc import Iterator
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from ufmstar_torch.eval.run.export import RunFrame, export_folder
from ufmstar_torch.optional import optional

WORLD, CAMERA = "world", "camera"
IMAGE, INFO, DEPTH, SIGMA = "/camera/image", "/camera/camera_info", "/camera/depth", "/camera/sigma"
CLOUD, TF = "/camera/points", "/tf"
_FIELDS = ("x", "y", "z", "variance")
_FILES = {"bag.mcap", "metadata.yaml"}
_LATEST = 2.0**31 - 1  # [s], of builtin_interfaces/Time
_FLOAT32 = 7  # of sensor_msgs/PointField


def export_bag(frames: Iterator[RunFrame], out: Path) -> str:
    """Write OUT/export/bag. Each frame has the image (if the recording can be read), camera info, depth and sigma
    (32FC1, [m]), points in the camera's axes with their variance [m^2], and the camera's pose in tf. An earlier bag is
    replaced when the new one is complete. Raises ModuleNotFoundError: rosbags is not installed; ValueError: a frame's
    time is not within ROS's 0 to 2^31 s, or the bag's path is not a folder."""
    how = ("ROS bags need rosbags", "'ufmstar-torch[recordings]'")
    rosbag2, stores = optional("rosbags.rosbag2", *how), optional("rosbags.typesys", *how)
    folder = export_folder(out) / "bag"
    if folder.exists() and not (folder.is_dir() and {path.name for path in folder.iterdir()} <= _FILES):
        raise ValueError(f"{folder} is no folder of an earlier export, or holds other files: move it away")
    ros = _Messages(stores.get_typestore(stores.Stores.ROS2_HUMBLE))
    with TemporaryDirectory(dir=folder.parent, prefix=".bag") as new:
        count = _write_bag(rosbag2, ros, Path(new) / "bag", frames)
        if folder.exists():
            shutil.rmtree(folder)
        (Path(new) / "bag").rename(folder)
    return f"{folder}: {count} frames"


def _write_bag(rosbag2: Any, ros: _Messages, folder: Path, frames: Iterator[RunFrame]) -> int:
    """Write the bag into a new folder. Returns the number of frames."""
    count = 0
    with rosbag2.Writer(folder, version=9, storage_plugin=rosbag2.StoragePlugin.MCAP) as writer:
        connections: dict[str, Any] = {}
        for frame in frames:
            count += 1
            # without times, frames are a second apart
            seconds = float(frame.index) if frame.timestamp is None else frame.timestamp
            if not seconds < _LATEST:
                raise ValueError(f"{frame.name}: a bag's times are within 0 to 2^31 s, got {seconds}")
            stamp = round(max(0.0, seconds) * 1e9)
            for topic, message in _of_frame(ros, stamp, frame).items():
                if topic not in connections:
                    connections[topic] = writer.add_connection(topic, message.__msgtype__, typestore=ros.store)
                writer.write(connections[topic], stamp, ros.store.serialize_cdr(message, message.__msgtype__))
    return count


def _of_frame(ros: _Messages, stamp: int, frame: RunFrame) -> dict[str, Any]:
    """A frame's messages by topic."""
    seen, (points, (v, u)) = frame.at_image(), frame.points()
    image = {} if frame.image is None else {IMAGE: ros.image(stamp, frame.image, "rgb8")}
    return {
        TF: ros.tf(stamp, frame.T_world_cam),
        **image,
        INFO: ros.info(stamp, seen.intrinsics, seen.depth.shape),
        DEPTH: ros.image(stamp, seen.depth, "32FC1"),
        SIGMA: ros.image(stamp, seen.sigma, "32FC1"),
        CLOUD: ros.cloud(stamp, np.column_stack([points, np.square(frame.sigma[v, u])])),
    }


class _Messages:
    """Makes ROS 2's messages from arrays."""

    def __init__(self, store: Any) -> None:
        self.store = store

    def _make(self, kind: str, /, **values: Any) -> Any:
        return self.store.types[kind](**values)

    def _header(self, stamp: int, frame: str = CAMERA) -> Any:
        time = self._make("builtin_interfaces/msg/Time", sec=stamp // 10**9, nanosec=stamp % 10**9)
        return self._make("std_msgs/msg/Header", stamp=time, frame_id=frame)

    def image(self, stamp: int, values: NDArray[Any], encoding: str) -> Any:
        data = np.ascontiguousarray(values).view(np.uint8).ravel()
        size = {"height": len(values), "width": values.shape[1], "step": data.size // len(values)}
        how = {"encoding": encoding, "is_bigendian": 0, "data": data}
        return self._make("sensor_msgs/msg/Image", header=self._header(stamp), **size, **how)

    def info(self, stamp: int, K: NDArray[np.float64], size: tuple[int, ...]) -> Any:
        region = dict.fromkeys(("x_offset", "y_offset", "height", "width"), 0)
        roi = self._make("sensor_msgs/msg/RegionOfInterest", **region, do_rectify=False)
        P = np.hstack([K, np.zeros((3, 1))]).ravel()
        camera = {"d": np.zeros(5), "k": K.ravel().copy(), "r": np.eye(3).ravel(), "p": P, "roi": roi}
        how = {"height": size[0], "width": size[1], "distortion_model": "plumb_bob", "binning_x": 0, "binning_y": 0}
        return self._make("sensor_msgs/msg/CameraInfo", header=self._header(stamp), **camera, **how)

    def cloud(self, stamp: int, points: NDArray[Any]) -> Any:
        data = np.ascontiguousarray(points, dtype="<f4")
        field, width = "sensor_msgs/msg/PointField", data.itemsize * len(_FIELDS)
        how = {"datatype": _FLOAT32, "count": 1}
        fields = [self._make(field, name=n, offset=data.itemsize * i, **how) for i, n in enumerate(_FIELDS)]
        size = {"height": 1, "width": len(data), "point_step": width, "row_step": width * len(data)}
        return self._make(
            "sensor_msgs/msg/PointCloud2", header=self._header(stamp), fields=fields, is_bigendian=False, is_dense=True,
            data=data.view(np.uint8).ravel(), **size,
        )  # fmt: skip

    def tf(self, stamp: int, T_world_cam: NDArray[np.float64]) -> Any:
        quaternion = Rotation.from_matrix(T_world_cam[:3, :3]).as_quat()
        position = dict(zip("xyz", T_world_cam[:3, 3].tolist(), strict=True))
        motion = self._make(
            "geometry_msgs/msg/Transform",
            translation=self._make("geometry_msgs/msg/Vector3", **position),
            rotation=self._make("geometry_msgs/msg/Quaternion", **dict(zip("xyzw", quaternion.tolist(), strict=True))),
        )
        how = {"header": self._header(stamp, WORLD), "child_frame_id": CAMERA, "transform": motion}
        return self._make(
            "tf2_msgs/msg/TFMessage", transforms=[self._make("geometry_msgs/msg/TransformStamped", **how)]
        )

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

from ufmstar_torch.eval.run.export import RunFrame, export_folder
from ufmstar_torch.eval.sequences.message_builder import MessageBuilder
from ufmstar_torch.runtime.optional import optional

WORLD, CAMERA = "world", "camera"
IMAGE, INFO, DEPTH, SIGMA = "/camera/image", "/camera/camera_info", "/camera/depth", "/camera/sigma"
CLOUD, TF = "/camera/points", "/tf"
_FIELDS = ("x", "y", "z", "variance")
_FILES = {"bag.mcap", "metadata.yaml"}
_LATEST = 2.0**31 - 1  # [s], of builtin_interfaces/Time


def export_bag(frames: Iterator[RunFrame], out: Path) -> str:
    """Write OUT/export/bag. Each frame has the image (if the recording can be read), camera info, depth and sigma
    (32FC1, [m]), points in the camera's axes with their variance [m^2], and the camera's pose in tf. An earlier bag is
    replaced when the new one is complete. Raises ModuleNotFoundError: rosbags is not installed; ValueError: a frame's
    time is not within ROS's 0 to 2^31 s, or the bag's path is not a folder."""
    how = ("ROS bags need rosbags", "'ufmstar-torch[recordings]'")
    rosbag2, stores = optional("rosbags.rosbag2", *how), optional("rosbags.typesys", *how)
    folder = export_folder(out) / "bag"
    foreign = folder.is_symlink() or (folder.exists() and not folder.is_dir())
    if foreign or (folder.exists() and not {path.name for path in folder.iterdir()} <= _FILES):
        raise ValueError(f"{folder} is no folder of an earlier export, or holds other files: move it away")
    store = stores.get_typestore(stores.Stores.ROS2_HUMBLE)
    with TemporaryDirectory(dir=folder.parent, prefix=".bag") as new:
        count = _write_bag(rosbag2, store, Path(new) / "bag", frames)
        if folder.exists():
            shutil.rmtree(folder)
        (Path(new) / "bag").rename(folder)
    return f"{folder}: {count} frames"


def _write_bag(rosbag2: Any, store: Any, folder: Path, frames: Iterator[RunFrame]) -> int:
    """Write the bag into a new folder. Returns the number of frames."""
    count, ros = 0, MessageBuilder(lambda kind, **values: store.types[kind](**values))
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
                    connections[topic] = writer.add_connection(topic, message.__msgtype__, typestore=store)
                writer.write(connections[topic], stamp, store.serialize_cdr(message, message.__msgtype__))
    return count


def _of_frame(ros: MessageBuilder, stamp: int, frame: RunFrame) -> dict[str, Any]:
    """A frame's messages by topic."""
    seen, (points, (v, u)) = frame.at_image(), frame.points()
    header = ros.header(stamp, CAMERA)
    image = {} if frame.image is None else {IMAGE: ros.image(header, frame.image, "rgb8")}
    variance = np.square(frame.sigma[v, u])
    return {
        TF: ros.tf(ros.header(stamp, WORLD), CAMERA, frame.T_world_cam),
        **image,
        INFO: ros.info(header, seen.intrinsics, seen.depth.shape),
        DEPTH: ros.image(header, seen.depth, "32FC1"),
        SIGMA: ros.image(header, seen.sigma, "32FC1"),
        CLOUD: ros.cloud(header, dict(zip(_FIELDS, (*points.T, variance), strict=True))),
    }

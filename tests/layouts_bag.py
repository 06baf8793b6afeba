"""Writes ROS bags of the walk with rosbags: ROS 1, db3 and mcap; poses on a topic or in tf."""

from __future__ import annotations

import cv2
import layouts
import numpy as np
from layouts_calibrated import T_BODY_CAMERA, K
from layouts_more import rigid, turn
from rosbags.rosbag1 import Writer as Writer1
from rosbags.rosbag2 import StoragePlugin
from rosbags.rosbag2 import Writer as Writer2
from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from scipy.spatial.transform import Rotation

H, W = layouts.SIZE
START, STEP = 1403715273262142976, 50_000_000  # [ns]
DELAY = 30_000_000  # [ns] between a header's stamp and the message's receipt
T_MAP_ODOM = rigid(turn(0, 0, 30), (1.0, 2.0, 0.0))


class BagFile:
    """Writes messages by the names of their types and fields, in ROS 1 or 2."""

    def __init__(self, path, kind):
        self.ros1 = kind == "ros1"
        self.store = get_typestore(Stores.ROS1_NOETIC if self.ros1 else Stores.ROS2_HUMBLE)
        if self.ros1:
            fields = "geometry_msgs/TransformStamped[] transforms"
            self.store.register(get_types_from_msg(fields, "tf2_msgs/msg/TFMessage"))
        path.parent.mkdir(parents=True, exist_ok=True)
        if self.ros1:
            self.writer = Writer1(path)
        else:
            self.writer = Writer2(path, version=9, storage_plugin=StoragePlugin[{"db3": "SQLITE3"}.get(kind, "MCAP")])
        self.writer.open()
        self.connections = {}

    def type(self, name, **values):
        return self.store.types[name](**values)

    def header(self, stamp, frame):
        time = self.type("builtin_interfaces/msg/Time", sec=stamp // 10**9, nanosec=stamp % 10**9)
        return self.type("std_msgs/msg/Header", **({"seq": 0} if self.ros1 else {}), stamp=time, frame_id=frame)

    def write(self, topic, received, message):
        name = message.__msgtype__
        if topic not in self.connections:
            self.connections[topic] = self.writer.add_connection(topic, name, typestore=self.store)
        serialize = self.store.serialize_ros1 if self.ros1 else self.store.serialize_cdr
        self.writer.write(self.connections[topic], received, serialize(message, name))

    def image(self, stamp, frame, values, encoding, pad=0):
        rows = np.ascontiguousarray(values).view(np.uint8).reshape(len(values), -1)
        rows = np.pad(rows, ((0, 0), (0, pad)))
        size = {"height": len(values), "width": values.shape[1], "step": rows.shape[1]}
        header = self.header(stamp, frame)
        how = {"encoding": encoding, "is_bigendian": 0}
        return self.type("sensor_msgs/msg/Image", header=header, **size, **how, data=rows.ravel())

    def compressed(self, stamp, frame, data, form):
        header = self.header(stamp, frame)
        data = np.frombuffer(data, np.uint8)
        return self.type("sensor_msgs/msg/CompressedImage", header=header, format=form, data=data)

    def info(self, stamp, frame, coefficients=(0.0,) * 5, model="plumb_bob", size=layouts.SIZE):
        roi = {"x_offset": 0, "y_offset": 0, "height": 0, "width": 0, "do_rectify": False}
        P = np.hstack([K * [[1.1], [1.1], [1]], np.zeros((3, 1))])
        arrays = {"d": np.array(coefficients), "k": K.ravel(), "r": np.eye(3).ravel(), "p": P.ravel()}
        return self.type(
            "sensor_msgs/msg/CameraInfo",
            header=self.header(stamp, frame),
            height=size[0],
            width=size[1],
            distortion_model=model,
            **({key.upper(): value for key, value in arrays.items()} if self.ros1 else arrays),
            binning_x=0,
            binning_y=0,
            roi=self.type("sensor_msgs/msg/RegionOfInterest", **roi),
        )

    def parts(self, T):
        x, y, z, w = Rotation.from_matrix(T[:3, :3]).as_quat()
        xyz = dict(zip("xyz", T[:3, 3], strict=True))
        return xyz, self.type("geometry_msgs/msg/Quaternion", x=x, y=y, z=z, w=w)

    def pose(self, T):
        xyz, rotation = self.parts(T)
        position = self.type("geometry_msgs/msg/Point", **xyz)
        return self.type("geometry_msgs/msg/Pose", position=position, orientation=rotation)

    def pose_stamped(self, stamp, frame, T):
        header = self.header(stamp, frame)
        return self.type("geometry_msgs/msg/PoseStamped", header=header, pose=self.pose(T))

    def with_covariance(self, stamp, frame, T):
        pose = self.type("geometry_msgs/msg/PoseWithCovariance", pose=self.pose(T), covariance=np.zeros(36))
        header = self.header(stamp, frame)
        return self.type("geometry_msgs/msg/PoseWithCovarianceStamped", header=header, pose=pose)

    def odometry(self, stamp, frame, child, T):
        none = self.type("geometry_msgs/msg/Vector3", x=0.0, y=0.0, z=0.0)
        twist = self.type("geometry_msgs/msg/Twist", linear=none, angular=none)
        pose = self.type("geometry_msgs/msg/PoseWithCovariance", pose=self.pose(T), covariance=np.zeros(36))
        twist = self.type("geometry_msgs/msg/TwistWithCovariance", twist=twist, covariance=np.zeros(36))
        how = {"header": self.header(stamp, frame), "child_frame_id": child, "pose": pose, "twist": twist}
        return self.type("nav_msgs/msg/Odometry", **how)

    def tf(self, stamp, *edges):
        listed = []
        for parent, child, T in edges:
            xyz, rotation = self.parts(T)
            motion = self.type(
                "geometry_msgs/msg/Transform",
                translation=self.type("geometry_msgs/msg/Vector3", **xyz),
                rotation=rotation,
            )
            how = {"header": self.header(stamp, parent), "child_frame_id": child, "transform": motion}
            listed.append(self.type("geometry_msgs/msg/TransformStamped", **how))
        return self.type("tf2_msgs/msg/TFMessage", transforms=listed)


def write_bag(root, kind="mcap", poses="odometry", *, compressed=False, depth="16UC1", camera=None, change=None):
    """A robot: ``odom`` -> ``base`` moves, ``base`` -> ``optical`` (``T_BODY_CAMERA``) and ``map`` -> ``odom`` are
    fixed. Poses are 10 ms before and after each image, so that readers interpolate. ``change(bag)`` writes further
    messages."""
    name = "walk.bag" if kind == "ros1" else "walk"
    path, scene = root / name, layouts.truth(K)
    bag = BagFile(path, kind)
    if poses in ("odometry", "tf"):
        received = START - 10**8
        bag.write(
            "/tf_static", received, bag.tf(START, ("base", "optical", T_BODY_CAMERA), ("map", "odom", T_MAP_ODOM))
        )
    for i, T in enumerate(scene.T_world_cam):
        stamp = START + i * STEP
        camera_info = bag.info(stamp, "optical", **(camera or {}))
        for shift in (-10_000_000, 10_000_000):
            at = stamp + shift
            body = T @ np.linalg.inv(T_BODY_CAMERA)
            if poses == "odometry":
                bag.write("/odom", at + DELAY, bag.odometry(at, "odom", "base", body))
            elif poses == "tf":
                bag.write("/tf", at + DELAY, bag.tf(at, ("odom", "base", np.linalg.inv(T_MAP_ODOM) @ body)))
            elif poses == "pose":
                bag.write("/pose", at + DELAY, bag.pose_stamped(at, "map", T))
            elif poses == "covariance":
                bag.write("/pose", at + DELAY, bag.with_covariance(at, "map", T))
        if compressed:
            png = cv2.imencode(".png", scene.images[i][..., ::-1])[1].tobytes()
            message = bag.compressed(stamp, "optical", png, "rgb8; png compressed bgr8")
            bag.write("/camera/image/compressed", stamp + DELAY, message)
        else:
            bgr = np.ascontiguousarray(scene.images[i][..., ::-1])
            bag.write("/camera/image", stamp + DELAY, bag.image(stamp, "optical", bgr, "bgr8", pad=5))
        bag.write("/camera/camera_info", stamp + DELAY, camera_info)
        write_depth(bag, depth, stamp + 4_000_000, scene.depths[i])
    if change is not None:
        change(bag)
    bag.writer.close()
    return path, scene


def write_depth(bag, form, stamp, metres):
    if form in ("16UC1", "32FC1"):
        values = np.rint(metres * 1000).astype("<u2") if form == "16UC1" else metres.astype("<f4")
        bag.write("/camera/depth", stamp + DELAY, bag.image(stamp, "optical", values, form, pad=8))
    elif form:
        head, values = np.array([0, 0, 0], "<f4"), np.rint(metres * 1000)
        if form.startswith("32FC1"):
            head[1:], values = (2000.0, -10.0), np.rint(2000.0 / metres - 10.0)
        png = cv2.imencode(".png", values.astype(np.uint16))[1].tobytes()
        bag.write("/camera/depth", stamp + DELAY, bag.compressed(stamp, "optical", head.tobytes() + png, form))

"""A stand-in for ROS 2: modules that make messages of rosbags, and a node that stores callbacks and messages."""

from __future__ import annotations

import sys
from array import array
from types import ModuleType, SimpleNamespace

import numpy as np
import pytest
from rosbags.typesys import Stores, get_typestore

STORE = get_typestore(Stores.ROS2_HUMBLE)


def message(kind):
    """A class of messages; like rclpy, it refuses NumPy's numbers and arrays of bytes that are no ``array``."""

    def make(**values):
        for name, value in values.items():
            assert not isinstance(value, np.ndarray | np.integer), f"{kind}.{name} must be plain, got {type(value)}"
        plain = {
            name: np.frombuffer(value, np.uint8) if isinstance(value, array) else value
            for name, value in values.items()
        }
        plain |= {name: np.array(value) for name, value in plain.items() if name in ("d", "k", "r", "p")}
        return STORE.types[kind](**plain)

    return make


class Messages(ModuleType):
    def __init__(self, package):
        super().__init__(f"{package}.msg")
        self.package = package

    def __getattr__(self, name):
        if name.startswith("__"):
            raise AttributeError(name)
        return message(f"{self.package}/msg/{name}")


class Node:
    """Stores the callbacks and the serialised messages by topic, the logged lines, and declared parameters."""

    def __init__(self, parameters=()):
        self.callbacks, self.published, self.qos, self.logged = {}, {}, {}, []
        self.parameters = dict(parameters)

    def declare_parameter(self, name, default):
        return SimpleNamespace(value=self.parameters.get(name, default))

    def create_publisher(self, kind, topic, qos):
        sent = self.published.setdefault(topic, [])
        return SimpleNamespace(publish=lambda made: sent.append(received(made)))

    def create_subscription(self, kind, topic, callback, qos):
        self.callbacks[topic], self.qos[topic] = callback, qos

    def get_logger(self):
        def log(text, once=False):
            self.logged.append(text)

        return SimpleNamespace(info=log, warning=log, error=log)


def received(made):
    """A message after it was sent: serialised and read again."""
    return STORE.deserialize_cdr(STORE.serialize_cdr(made, made.__msgtype__), made.__msgtype__)


@pytest.fixture
def ros(monkeypatch):
    """Modules of ROS 2; ``spin`` calls ``ros.drive(node)``."""
    rclpy, qos = ModuleType("rclpy"), ModuleType("rclpy.qos")
    rclpy.node, rclpy.drive = Node(), lambda node: None
    rclpy.init = lambda args: setattr(rclpy, "args", args)
    rclpy.create_node = lambda name: rclpy.node
    rclpy.spin = lambda node: rclpy.drive(node)
    qos.QoSProfile = SimpleNamespace
    qos.ReliabilityPolicy = SimpleNamespace(RELIABLE="reliable")
    qos.DurabilityPolicy = SimpleNamespace(TRANSIENT_LOCAL="transient local")
    qos.qos_profile_sensor_data = "sensor data"
    monkeypatch.setitem(sys.modules, "rclpy", rclpy)
    monkeypatch.setitem(sys.modules, "rclpy.qos", qos)
    for package in ("sensor_msgs", "std_msgs", "geometry_msgs", "nav_msgs", "tf2_msgs", "builtin_interfaces"):
        monkeypatch.setitem(sys.modules, f"{package}.msg", Messages(package))
    return rclpy

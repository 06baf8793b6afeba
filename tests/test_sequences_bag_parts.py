"""ROS bags in several files, of several transports of one topic, and with images of 16 bits."""

from __future__ import annotations

import shutil
import warnings
from importlib import import_module

import cv2
import layouts
import layouts_bag
import numpy as np
import pytest

from ufmstar_torch.eval.sequences import find_sequences, open_sequence
from ufmstar_torch.eval.sequences.images import grey_bytes


def split(path, root, kind):
    """Copy a bag into two files without metadata, each with half of the messages."""
    module = import_module("rosbags.rosbag1" if kind == "ros1" else "rosbags.rosbag2")
    store = layouts_bag.BagFile(root / "scratch.bag" if kind == "ros1" else root / "scratch", kind)
    store.writer.close()
    root.mkdir(parents=True, exist_ok=True)
    with module.Reader(path) as reader:
        stored = list(reader.messages())
        for part in range(2):
            end = {"ros1": ".bag"}.get(kind, "")
            name = f"walk_2024-01-02-03-0{part}-05_{part}" if kind == "ros1" else f"walk_{part}"
            bag = layouts_bag.BagFile(root / f"{name}{end}", kind)
            for connection, received, raw in stored[part::2] if part else stored[::2]:
                if connection.topic not in bag.connections:
                    bag.connections[connection.topic] = bag.writer.add_connection(
                        connection.topic, connection.msgtype, typestore=bag.store
                    )
                bag.writer.write(bag.connections[connection.topic], received, raw)
            bag.writer.close()
            if kind != "ros1":
                (file,) = (root / name).glob(f"*.{kind}")
                file.rename(root / f"{name}.{kind}")
                shutil.rmtree(root / name)
    for scratch in (root / "scratch.bag", root / "scratch"):
        if scratch.is_dir():
            shutil.rmtree(scratch)
        scratch.unlink(missing_ok=True)


@pytest.mark.parametrize("kind", ["ros1", "db3", "mcap"])
def test_a_split_bag_without_metadata(tmp_path, kind):
    path, _ = layouts_bag.write_bag(tmp_path / "whole", kind)
    split(path, tmp_path / "parts", kind)
    whole, parts = open_sequence(path), open_sequence(tmp_path / "parts")
    assert (parts.layout, parts.name, parts.names) == ("bag", "parts", whole.names)
    for a, b in zip(whole, parts, strict=True):
        np.testing.assert_array_equal(a.image, b.image)
        np.testing.assert_array_equal(a.depth, b.depth)
        np.testing.assert_array_equal(a.T_world_cam, b.T_world_cam)
    names = sorted(file.name for file in (tmp_path / "parts").iterdir())
    (tmp_path / "parts" / names[1]).rename(tmp_path / "parts" / f"other{names[1][4:]}")
    assert not find_sequences(tmp_path / "parts"), "two recordings"


def test_a_bag_of_12_bit_images_and_png_depth(tmp_path, caplog):
    """Image transport: depth is a CompressedImage, which only its format tells from a colour image."""
    path, scene = layouts_bag.write_bag(tmp_path / "colour", compressed=True, depth=None)
    bag_path = tmp_path / "walk"
    bag = layouts_bag.BagFile(bag_path, "mcap")
    for i, T in enumerate(scene.T_world_cam):
        stamp = layouts_bag.START + i * layouts_bag.STEP
        grey = np.rint(scene.images[i][..., 0] * (0.05 if i == 1 else 1.0) * 4095 / 255).astype(np.uint16)
        if i % 2:
            grey_message = bag.image(stamp, "optical", grey, "mono16", pad=6)
        else:
            grey_message = bag.image(stamp, "optical", grey, "mono16")
        bag.write("/infra/image", stamp, grey_message)
        bag.write("/infra/camera_info", stamp, bag.info(stamp, "optical"))
        png = cv2.imencode(".png", np.rint(1000 * scene.depths[i]).astype(np.uint16))[1].tobytes()
        bag.write("/aligned/image/compressed", stamp, bag.compressed(stamp, "optical", png, "16UC1; png compressed "))
        bag.write("/pose", stamp, bag.pose_stamped(stamp, "map", T))
    bag.writer.close()
    sequence = open_sequence(bag_path)
    for i, frame in enumerate(sequence):
        expected = scene.images[i][..., :1] * (0.05 if i == 1 else 1.0)
        np.testing.assert_allclose(frame.image, np.repeat(expected, 3, axis=2), atol=0.6)
        np.testing.assert_allclose(frame.depth, scene.depths[i], atol=5e-4 + 1e-6)
    assert "/infra/image: images of 16 bits, read as 0 to 4095 and scaled to bytes" in caplog.text
    assert open_sequence(path)[0].depth is None


def test_a_topic_and_its_transports_are_one(tmp_path):
    """A recording of all topics has the same images several times."""

    def transports(bag):
        for i, image in enumerate(scene.images):
            stamp = layouts_bag.START + i * layouts_bag.STEP
            png = cv2.imencode(".png", image[..., ::-1])[1].tobytes()
            bag.write("/camera/image/compressed", stamp, bag.compressed(stamp, "optical", png, "bgr8; png compressed"))
            png = cv2.imencode(".png", np.rint(1000 * scene.depths[i]).astype(np.uint16))[1].tobytes()
            for name, head, form in (
                ("compressed", 0, "png compressed "),
                ("compressedDepth", 12, "compressedDepth png"),
            ):
                message = bag.compressed(stamp, "optical", bytes(head) + png, f"16UC1; {form}")
                bag.write(f"/aligned/{name}", stamp, message)

    scene = layouts.truth(layouts_bag.K)
    path, _ = layouts_bag.write_bag(tmp_path, depth=None, change=transports)
    sequence = open_sequence(path)
    for frame, image, depth in zip(sequence, scene.images, scene.depths, strict=True):
        np.testing.assert_array_equal(frame.image, image)
        np.testing.assert_allclose(frame.depth, depth, atol=5e-4 + 1e-6)
    for topic in ("/camera/image/compressed", "/aligned/compressed"):
        assert len(open_sequence(path, topics=[topic])) == 6


def test_16_bit_colours_in_png_messages(tmp_path):
    """A CompressedImage of mono16 is a grey image."""
    bag = layouts_bag.BagFile(tmp_path / "walk", "mcap")
    values = np.linspace(0, 65535, 48 * 64).reshape(48, 64).astype(np.uint16)
    stamp = layouts_bag.START
    png = cv2.imencode(".png", values)[1].tobytes()
    bag.write("/camera/image/compressed", stamp, bag.compressed(stamp, "optical", png, "mono16; png compressed "))
    bag.write("/camera/camera_info", stamp, bag.info(stamp, "optical"))
    bag.write("/pose", stamp, bag.pose_stamped(stamp, "map", np.eye(4)))
    bag.writer.close()
    with warnings.catch_warnings():
        image = open_sequence(tmp_path / "walk")[0].image
    np.testing.assert_array_equal(image, np.repeat(grey_bytes(values, 65535)[..., None], 3, axis=2))

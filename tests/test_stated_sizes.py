"""Sizes that small files, names and settings state are refused before memory is allocated."""

from __future__ import annotations

import json
import os
import struct
import zipfile
import zlib
from importlib.resources import files
from pathlib import Path

import numpy as np
import pytest
import torch
from torch import nn

from ufmstar_torch import UfMStarConfig
from ufmstar_torch.anchors.sources import landmark_source
from ufmstar_torch.eval.methods.suite import suite_named
from ufmstar_torch.eval.sequences import open_sequence
from ufmstar_torch.eval.sequences.frame import FrameError, parse_size
from ufmstar_torch.eval.sequences.images import image_size, read_color, read_depth
from ufmstar_torch.eval.sequences.intrinsics import read_intrinsics
from ufmstar_torch.eval.sequences.poses import read_trajectory
from ufmstar_torch.eval.suite.work_items import read_names
from ufmstar_torch.files.limits import MOST_BYTES, MOST_PIXELS
from ufmstar_torch.models import CheckpointError, NetworkSpec, OnnxNetwork, Preprocess, from_hugging_face, load_trained
from ufmstar_torch.models.checkpoints import load_state_dict_file
from ufmstar_torch.models.outputs import ProgramSpec
from ufmstar_torch.posterior.recalibrate import Recalibration

LIMIT = r"more than the limit of [\d,]+"


def png(width: int, height: int, kind: int) -> bytes:
    """A PNG of a few bytes that states a size; ``kind``: 2 RGB, 0 grey of 16 bits."""

    def chunk(name: bytes, data: bytes) -> bytes:
        return struct.pack(">I", len(data)) + name + data + struct.pack(">I", zlib.crc32(name + data))

    header = struct.pack(">IIBBBBB", width, height, 8 if kind == 2 else 16, kind, 0, 0, 0)
    return b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", header) + chunk(b"IDAT", zlib.compress(b"")) + chunk(b"IEND", b"")


@pytest.mark.filterwarnings("ignore::PIL.Image.DecompressionBombWarning")
@pytest.mark.parametrize("size", [(12_000, 12_000), (100_000, 100_000), (MOST_PIXELS + 1, 1)])
def test_an_image(tmp_path, size):
    """Below Pillow's limit, too, which is twice as large."""
    colour, depth = tmp_path / "a.png", tmp_path / "d.png"
    colour.write_bytes(png(*size, 2))
    depth.write_bytes(png(*size, 0))
    for read in (lambda: read_color(colour), lambda: read_color("a", png(*size, 2)), lambda: image_size(colour)):
        with pytest.raises(FrameError, match=f"({LIMIT})|DecompressionBomb|exceeds limit"):
            read()
    with pytest.raises(FrameError, match=f"({LIMIT})|exceeds limit"):
        read_depth(depth)


@pytest.mark.parametrize(
    "name",
    [
        "tour:1?frames=1000000000",
        "tour:1?frames=99999999999999999999",
        "tour:1?size=20000x20000",
        "tour:1?size=8x99999999999",
    ],
)
def test_a_tour(name):
    with pytest.raises(ValueError, match=rf"(frames would .*{LIMIT})|(size must be HxW .* at most [\d,]+ pixels)"):
        open_sequence(name)


def test_sizes_of_networks_and_settings():
    for refused in (
        lambda: Preprocess(size=(10**6, 10**6)),
        lambda: Preprocess(size=(8, 8), crop=(10**6, 10**6)),
        lambda: Preprocess(resize_height=10**6),
        lambda: Preprocess(resize_height=9000)(torch.zeros(1, 3, 2, 1000), torch.eye(3)),
        lambda: NetworkSpec(size=(32 * 10**5, 32 * 10**5)),
        lambda: parse_size("1000000x1000000"),
        lambda: UfMStarConfig(initial_capacity=10**9),
    ):
        with pytest.raises(ValueError, match=LIMIT):
            refused()
    with pytest.raises(ValueError, match="members must lie in"):
        NetworkSpec(method="batch_ensemble", members=1_000_000)
    assert UfMStarConfig(initial_capacity=10**6).initial_capacity == 10**6
    assert 4 * 3 * MOST_PIXELS <= MOST_BYTES


def test_an_onnx_input(tmp_path):
    onnx = pytest.importorskip("onnx")
    from onnx import TensorProto, helper

    image = helper.make_tensor_value_info("image", TensorProto.FLOAT, [1, 3, 10**6, 10**6])
    depth = helper.make_tensor_value_info("depth", TensorProto.FLOAT, [1, 3, 10**6, 10**6])
    graph = helper.make_graph([helper.make_node("Relu", ["image"], ["depth"])], "g", [image], [depth])
    onnx.save(helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)], ir_version=8), tmp_path / "n.onnx")
    with pytest.raises(ValueError, match=LIMIT):
        OnnxNetwork(tmp_path / "n.onnx", {"outputs": {"kind": "metric"}})


@pytest.mark.parametrize("changes", [{"widths": 1000.0}, {"method": "batch_ensemble", "members": 900}])
def test_trained_weights(tmp_path, changes):
    """The shapes in the file are compared with those of the spec without allocating the network."""
    weights = Path(__file__).resolve().parents[1] / "models" / "weights" / "demo.safetensors"
    data = weights.read_bytes()
    length = struct.unpack("<Q", data[:8])[0]
    header = json.loads(data[8 : 8 + length])
    metadata = json.loads(header["__metadata__"]["metadata"])
    metadata["spec"] |= changes
    header["__metadata__"]["metadata"] = json.dumps(metadata)
    text = json.dumps(header).encode()
    (tmp_path / "n.safetensors").write_bytes(struct.pack("<Q", len(text)) + text + data[8 + length :])
    with pytest.raises(CheckpointError, match="member 0, does not fit"):
        load_trained(tmp_path / "n.safetensors")


def test_a_checkpoint_that_expands(tmp_path):
    """A tensor that repeats a stored value, and a compressed archive."""
    torch.save({"w": torch.zeros(1).expand(10**10)}, tmp_path / "a.pth")
    with pytest.raises(CheckpointError, match=f"repeats its stored values would take .*{LIMIT}"):
        load_state_dict_file(tmp_path / "a.pth")
    torch.save(nn.Conv2d(3, 1, 1).state_dict(), tmp_path / "b.pth")
    with (
        zipfile.ZipFile(tmp_path / "b.pth") as source,
        zipfile.ZipFile(tmp_path / "c.pth", "w", zipfile.ZIP_DEFLATED) as target,
    ):
        for entry in source.namelist():
            target.writestr(entry, source.read(entry))
    with pytest.raises(CheckpointError, match="has compressed files"):
        load_state_dict_file(tmp_path / "c.pth")


def test_an_array(tmp_path):
    header = np.lib.format.header_data_from_array_1_0(np.zeros(1)) | {"shape": (10**6, 10**6)}
    with (tmp_path / "d.npy").open("wb") as file:
        np.lib.format.write_array_header_1_0(file, header)
    with pytest.raises(FrameError, match=LIMIT):
        read_depth(tmp_path / "d.npy")


@pytest.mark.parametrize("kind", ["ConstantOfShape", "Expand", "Tile"])
def test_a_tensor_inside_an_onnx_graph(tmp_path, kind):
    """ONNX Runtime would fold the constant when it opens the file."""
    onnx = pytest.importorskip("onnx")
    from onnx import TensorProto, helper, numpy_helper

    image = helper.make_tensor_value_info("image", TensorProto.FLOAT, [1, 3, 8, 8])
    depth = helper.make_tensor_value_info("depth", TensorProto.FLOAT, None)
    large = numpy_helper.from_array(np.array([1, 1, 40_000, 40_000], np.int64), "large")
    one = numpy_helper.from_array(np.ones((1, 1, 1, 1), np.float32), "one")
    inputs = ["large"] if kind == "ConstantOfShape" else ["one", "large"]
    nodes = [
        helper.make_node(kind, inputs, ["huge"]),
        helper.make_node("ReduceMax", ["huge"], ["most"], keepdims=1),
        helper.make_node("Mul", ["image", "most"], ["depth"]),
    ]
    graph = helper.make_graph(nodes, "g", [image], [depth], initializer=[large, one])
    onnx.save(helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)], ir_version=8), tmp_path / "n.onnx")
    with pytest.raises(
        ValueError, match=rf"n\.onnx: the tensor 'huge' of the graph would take 6,400,000,000 .*{LIMIT}"
    ):
        OnnxNetwork(tmp_path / "n.onnx", {"outputs": {"kind": "metric"}})


@pytest.mark.parametrize(
    ("changes", "match"),
    [
        ({"fusion_hidden_size": 40_000}, r"config\.json states a model of [0-9,]+ bytes, its weights have [0-9,]+"),
        ({"backbone_config": {"num_hidden_layers": 10**9}}, "states 1000000000 layers, at most 1000 can be"),
        ({"fusion_hidden_size": -3}, r"cannot be loaded as a depth model"),
    ],
)
def test_a_configuration_of_transformers(tmp_path, changes, match):
    """The weights of the file fill a part of what the configuration states; the rest would be allocated."""
    depth_anything_files = pytest.importorskip("depth_anything_files")
    folder = depth_anything_files.write_depth_anything(tmp_path, "metric")
    config = json.loads((folder / "config.json").read_text())
    for key, value in changes.items():
        config[key] = config[key] | value if isinstance(value, dict) else value
    (folder / "config.json").write_text(json.dumps(config))
    with pytest.raises(CheckpointError, match=match):
        from_hugging_face(folder)


READS = {
    "trajectory": read_trajectory,
    "landmarks": landmark_source,
    "recalibration": Recalibration.from_json,
    "suite": suite_named,
    "settings of a network": ProgramSpec.from_json,
    "list of sequences": read_names,
}


@pytest.mark.skipif(not Path("/dev/zero").exists(), reason="this system has no /dev/zero")
@pytest.mark.parametrize("read", READS.values(), ids=READS)
def test_a_file_without_an_end(read, tmp_path):
    """Each reader refuses a device that never ends and a pipe that has no writer, instead of waiting for them."""
    suffix = "toml" if read is suite_named else "txt"
    endless, pipe = tmp_path / f"endless.{suffix}", tmp_path / f"pipe.{suffix}"
    endless.symlink_to("/dev/zero")
    os.mkfifo(pipe)
    (folder := tmp_path / f"folder.{suffix}").mkdir()
    for path in (endless, pipe, folder):
        with pytest.raises(ValueError, match=r"must be a file, got a (device|folder)"):
            read(str(path))


def test_the_mark_of_editors_on_windows_is_no_content(tmp_path):
    mark = b"\xef\xbb\xbf"
    (tmp_path / "poses.txt").write_bytes(mark + b"0 1 2 3 0 0 0 1\r\n1 1 2 4 0 0 0 1\r\n")
    trajectory = read_trajectory(tmp_path / "poses.txt")
    assert trajectory.timestamps.tolist() == [0, 1]
    assert trajectory.T_world_cam[0, :3, 3].tolist() == [1, 2, 3]
    (tmp_path / "K.txt").write_bytes(mark + b"60 61 32 24\r\n")
    np.testing.assert_array_equal(read_intrinsics(tmp_path / "K.txt"), [[60, 0, 32], [0, 61, 24], [0, 0, 1]])
    (tmp_path / "suite.toml").write_bytes(
        mark + files("ufmstar_torch.eval.methods").joinpath("suites/demo.toml").read_bytes()
    )
    assert suite_named(str(tmp_path / "suite.toml")).rows == suite_named("demo").rows

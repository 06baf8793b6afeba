"""The table "Published networks" of docs/networks.md: every line runs on a tiny checkpoint with random weights, or on a
stand-in with the published code's interface."""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from depth_anything_files import write_depth_anything, write_other
from pages import blocks

from ufmstar_torch import UncertainDepth
from ufmstar_torch import models as package

PAGE = (Path(__file__).parents[1] / "docs" / "networks.md").read_text()
SECTION = PAGE[PAGE.index("## Published networks") :].split("\n## ")[0]
ROWS = re.findall(r"^\| ([^|,]+),[^|]*\| `([^`]+)` \|", SECTION, flags=re.MULTILINE)
LINES = {name: line for name, line in ROWS if name != "network"}
RECORDINGS = ("VGGT", "MapAnything", "MASt3R")
IMAGE = np.random.default_rng(0).integers(0, 256, (70, 98, 3), dtype=np.uint8)
K = torch.tensor([[80.0, 0, 48.5], [0, 84.0, 34.5], [0, 0, 1]])


def ramp(x: torch.Tensor) -> torch.Tensor:
    """[B, H, W] depth from the image: 1 m to 3 m for images in [0, 1]."""
    return 1 + 2 * (x - x.amin()).mean(1) / (x.amax() - x.amin())


class UniDepth(torch.nn.Module):
    """``infer`` takes RGB in 0..255 and K; returns points in the camera frame, and a "confidence" that grows with the
    error."""

    def infer(self, rgb: torch.Tensor, camera: torch.Tensor | None = None, normalize: bool = True) -> dict[str, Any]:
        assert rgb.amax() > 2
        assert camera is not None
        assert camera.shape == (len(rgb), 3, 3)
        depth = ramp(rgb)[:, None] * camera[:, 0, 0, None, None, None] / 80
        points = depth.expand(-1, 3, -1, -1)
        return {"depth": depth, "points": points, "confidence": depth / 10, "intrinsics": camera, "radius": depth}


class MoGe(torch.nn.Module):
    """``infer`` takes RGB in 0..1 and the horizontal field of view [deg]; masked pixels are infinite."""

    def infer(self, image: torch.Tensor, num_tokens: int | None = None, fov_x: Any = None) -> dict[str, torch.Tensor]:
        assert image.amax() <= 1
        torch.testing.assert_close(fov_x, torch.full((1,), 2 * np.rad2deg(np.arctan(49 / 80))).float())
        depth = ramp(image)
        depth[:, :3] = torch.inf
        return {"points": depth[..., None].expand(-1, -1, -1, 3), "depth": depth, "mask": depth.isfinite()}


class Metric3D(torch.nn.Module):
    """``inference`` takes a normalised image in a dict; returns depth for a focal length of 1000 px, confidence, and
    others."""

    def inference(self, data: dict[str, torch.Tensor]) -> tuple[torch.Tensor, torch.Tensor, dict[str, Any]]:
        x = data["input"]
        assert 1 < float(x.abs().amax()) < 4
        assert not any(side % 28 for side in x.shape[-2:])
        return ramp(x)[:, None], torch.sigmoid(x[:, :1]), {"prediction_normal": x}


class Yolo:
    """``ultralytics.YOLO``, whose ``model`` takes RGB in 0..1 and returns depth at a quarter of the resolution in eval
    mode, the "depth" of a mapping in training mode (``ultralytics.nn.modules.head.Depth``)."""

    class DepthModel(torch.nn.Module):
        def forward(self, x: torch.Tensor) -> torch.Tensor | dict[str, torch.Tensor]:
            assert x.amax() <= 1
            depth = ramp(x)[:, None, ::4, ::4]
            return {"depth": depth} if self.training else depth

    def __init__(self) -> None:
        self.model = self.DepthModel()


@dataclass
class Prediction:
    """As ``depth_anything_3.specs.Prediction``; the metric network returns no confidence and no cameras."""

    depth: np.ndarray
    is_metric: int = 1
    sky: np.ndarray | None = None
    conf: np.ndarray | None = None
    extrinsics: np.ndarray | None = None
    intrinsics: np.ndarray | None = None


class DepthAnything3(torch.nn.Module):
    """``inference`` takes a list of NumPy images and resizes their longer side to 504 px."""

    def inference(self, image: list[np.ndarray], **options: Any) -> Prediction:
        assert all(picture.dtype == np.uint8 and picture.shape[2] == 3 for picture in image)
        assert max(image[0].shape) == 504
        depth = np.stack([1 + picture.mean(-1, dtype=np.float32) / 255 for picture in image])
        return Prediction(depth.astype(np.float32))


def run(line: str, **names: Any) -> package.DepthNetwork:
    scope: dict[str, Any] = {**vars(package), "torch": torch, "wrap_network": package.wrap_network, **names}
    for name in ("from_hugging_face", "Preprocess", "DepthAnything"):
        scope[name] = getattr(package, name)
    network: package.DepthNetwork = eval(line, scope)
    return network


def write(folder: Path, name: str) -> dict[str, Any]:
    """Write the files for a line of the table, and return the values of the line's names."""
    if name == "Depth Anything V2":
        write_depth_anything(folder, "metric")
    elif name in ("ZoeDepth", "Depth Pro"):
        write_other(folder, {"ZoeDepth": "zoedepth", "Depth Pro": "depth_pro"}[name])
    stand_ins: dict[str, Any] = {
        "yolo": Yolo(), "unidepth": UniDepth(), "moge": MoGe(), "metric3d": Metric3D(), "da3": DepthAnything3(),
    }  # fmt: skip
    return {"DIR": folder, **stand_ins}


@pytest.mark.parametrize("name", sorted(set(LINES) - set(RECORDINGS)))
def test_the_line_makes_a_metric_network(tmp_path: Path, name: str) -> None:
    network = run(LINES[name], **write(tmp_path / "n", name))
    assert network.states_confidence == (name in ("UniDepth V2", "Metric3D v2"))
    assert network.takes_intrinsics == (name not in ("Depth Anything V2", "ZoeDepth", "YOLO26-Depth"))
    how = network.preprocess if name != "Depth Pro" else package.Preprocess(size=(64, 64))
    x, K_net = how(IMAGE, K)
    with torch.no_grad():
        network.eval()
        prediction = network(x, K_net) if network.takes_intrinsics else network(x)
    depth = prediction.depth
    assert depth.shape == (1, *x.shape[-2:])
    assert bool((depth > 0).any())
    focal = float(K_net[..., :2, :2].diagonal(dim1=-2, dim2=-1).mean())
    expected = {
        "UniDepth V2": lambda: ramp(x) * float(K_net[..., 0, 0]) / 80,
        "Metric3D v2": lambda: ramp(x) * focal / 1000,
        "Depth Anything 3": lambda: (1 + x.byte().float().mean(1) / 255) * focal / 300,
    }
    if name in expected:
        torch.testing.assert_close(depth, expected[name]())
    assert (prediction.confidence is not None) == network.states_confidence


class Scene:
    """``mast3r.cloud_opt.sparse_ga.SparseGA``: camera-to-world poses, flat depth maps, confidences as maps."""

    def __init__(self, depth: torch.Tensor, conf: torch.Tensor, T: torch.Tensor) -> None:
        self.intrinsics, self._maps, self._T = [K] * len(depth), (depth, conf), T

    def get_im_poses(self) -> torch.Tensor:
        return self._T

    def get_dense_pts3d(self) -> tuple[list[torch.Tensor], list[torch.Tensor], list[torch.Tensor]]:
        depth, conf = self._maps
        return [d.reshape(-1, 1).expand(-1, 3) for d in depth], [d.flatten() for d in depth], list(conf)


@pytest.mark.parametrize("name", RECORDINGS)
def test_a_reconstruction_is_a_recording(name: str) -> None:
    generator = torch.Generator().manual_seed(0)
    depth, conf = (1 + torch.rand(3, 70, 98, generator=generator) for _ in range(2))
    T = torch.eye(4).repeat(3, 1, 1)
    T[:, 0, 3] = torch.arange(3) * 0.1
    views = [
        {"depth_z": d[None, ..., None], "conf": c[None], "camera_poses": t[None], "intrinsics": K[None]}
        for d, c, t in zip(depth, conf, T, strict=True)
    ]
    names = {
        "views": views,
        "predictions": {"depth": depth[None, ..., None], "depth_conf": conf[None]},
        "extrinsic": torch.linalg.inv(T)[None, :, :3],
        "intrinsic": K.expand(1, 3, 3, 3),
        "scene": Scene(depth, conf, T),
    }
    (code,) = (code for code in blocks(SECTION) if "frames" in code)
    scope: dict[str, Any] = {"torch": torch, **names}
    setup, loop = code.split("for ", 1)
    exec(setup, scope)
    scope["frames"] = eval(LINES[name], scope)
    seen = [tuple(frame) for frame in scope["frames"]]
    for i, (d, c, pose, camera) in enumerate(seen):
        torch.testing.assert_close(torch.as_tensor(d).reshape(70, 98), depth[i])
        torch.testing.assert_close(torch.as_tensor(c).reshape(70, 98), conf[i])
        torch.testing.assert_close(torch.as_tensor(pose).reshape(4, 4).float(), T[i])
        assert torch.equal(torch.as_tensor(camera).reshape(3, 3), K)
    scope["frames"] = seen
    exec("for " + loop, scope)
    model = scope["model"]
    assert isinstance(model, UncertainDepth)
    assert model.ufm.config.confidence
    assert model.image_index == 3

"""Mixture files, parsed by an independent reader."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from ufmstar_torch.eval.run.gaussians import (
    OPACITY,
    SIGMA_FLOOR,
    write_mixture_npz,
    write_mixture_ply,
)
from ufmstar_torch.gaussians.mixture import GaussianMixture

KINDS = {"float": "<f4", "int": "<i4", "uchar": "u1"}


def parse(path: Path) -> tuple[dict[str, np.ndarray[Any, Any]], list[str]]:
    """A minimal PLY reader: elements by name, and the comments."""
    head, body = path.read_bytes().split(b"end_header\n", 1)
    lines = head.decode("ascii").split("\n")
    assert lines[:2] == ["ply", "format binary_little_endian 1.0"]
    layout: dict[str, tuple[int, list[Any]]] = {}
    for line in lines[2:]:
        match line.split():
            case ["element", name, count]:
                layout[name] = (int(count), [])
            case ["property", "list", length, kind, name]:  # of triangles
                layout[[*layout][-1]][1].extend([("n", KINDS[length]), (name, KINDS[kind], (3,))])
            case ["property", kind, name]:
                layout[[*layout][-1]][1].append((name, KINDS[kind]))
    elements, offset = {}, 0
    for name, (count, fields) in layout.items():
        elements[name] = np.frombuffer(body, np.dtype(fields), count, offset)
        offset += elements[name].nbytes
    assert offset == len(body)
    return elements, [line for line in lines if line.startswith("comment")]


def stack(table: np.ndarray[Any, Any], *names: str) -> np.ndarray[Any, Any]:
    return np.stack([table[name].astype(np.float64) for name in names], -1)


def mixture(k: int = 7, *, streams: int = 2, seed: int = 0, dtype: torch.dtype = torch.float64) -> GaussianMixture:
    """Random components from discs to needles, with two empty slots in the middle of each stream."""
    rng = np.random.default_rng(seed)
    R = Rotation.random(streams * k, random_state=rng).as_matrix().reshape(streams, k, 3, 3)
    sigma = np.exp(rng.uniform(np.log(0.005), np.log(1.0), (streams, k, 3)))
    covariance = np.einsum("bkij,bkj,bklj->bkil", R, sigma**2, R)
    weight = rng.integers(1, 9000, (streams, k)).astype(float)
    weight[:, 2:4] = 0
    used = weight > 0
    return GaussianMixture(
        mean=torch.tensor(rng.uniform(-3, 3, (streams, k, 3)) * used[..., None], dtype=dtype),
        covariance=torch.tensor(covariance * used[..., None, None], dtype=dtype),
        weight=torch.tensor(weight, dtype=dtype),
        disagreement=torch.tensor(rng.uniform(0, 0.2, (streams, k)) * used, dtype=dtype),
        compared=torch.tensor(weight / 2, dtype=dtype),
        views=torch.tensor(rng.uniform(0.1, 9, (streams, k)) * used, dtype=dtype),
        reference=torch.tensor(rng.uniform(0, 1, (streams, k, 5)) * used[..., None], dtype=dtype),
        features=torch.zeros(streams, k, 0, dtype=dtype),
    )


def matrix_of(q: np.ndarray[Any, Any]) -> np.ndarray[Any, Any]:
    """[K, 3, 3] rotations of unit quaternions w x y z, from the textbook formula."""
    w, x, y, z = q.T
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    return np.moveaxis(np.array(rows), -1, 0)


def world() -> torch.Tensor:
    T = torch.eye(4, dtype=torch.float64)
    T[:3, :3] = torch.tensor(Rotation.from_euler("xyz", [0.3, -1.2, 2.0]).as_matrix())
    T[:3, 3] = torch.tensor([1.0, -2.0, 3.0])
    return T


class TestSplats:
    @pytest.mark.parametrize("moved", [False, True])
    def test_read_back(self, tmp_path: Path, moved: bool) -> None:
        mix, stream = mixture(), 0
        assert write_mixture_ply(tmp_path / "m.ply", mix, T_world_first=world() if moved else None) == 5
        table = parse(tmp_path / "m.ply")[0]["vertex"]
        assert table.dtype.names == (
            *("x", "y", "z", "nx", "ny", "nz", "f_dc_0", "f_dc_1", "f_dc_2", "opacity"),
            *("scale_0", "scale_1", "scale_2", "rot_0", "rot_1", "rot_2", "rot_3"),
            *("weight", "disagreement", "views"),
        )  # the order of splat viewers
        used = mix.valid[stream]
        R = world()[:3, :3] if moved else torch.eye(3, dtype=torch.float64)
        t = world()[:3, 3] if moved else torch.zeros(3, dtype=torch.float64)
        mean = mix.mean[stream][used] @ R.T + t
        np.testing.assert_allclose(stack(table, "x", "y", "z"), mean, atol=1e-6)
        assert (table["rot_0"] >= 0).all()
        axes = matrix_of(stack(table, "rot_0", "rot_1", "rot_2", "rot_3"))
        sigma = np.exp(stack(table, "scale_0", "scale_1", "scale_2"))
        covariance = np.einsum("kij,kj,klj->kil", axes, sigma**2, axes)
        np.testing.assert_allclose(covariance, R @ mix.covariance[stream][used] @ R.T, atol=1e-6)
        assert np.abs(np.linalg.norm(stack(table, "rot_0", "rot_1", "rot_2", "rot_3"), axis=-1) - 1).max() < 1e-6
        for name in ("weight", "disagreement", "views"):
            np.testing.assert_allclose(table[name], getattr(mix, name)[stream][used], rtol=1e-7)
        np.testing.assert_allclose(1 / (1 + np.exp(-table["opacity"])), OPACITY, rtol=1e-6)

    def test_colour_follows_disagreement(self, tmp_path: Path) -> None:
        mix = mixture(30, streams=1)
        mix = mix.replace(views=torch.where(torch.arange(30) % 5 == 0, 0, mix.views))
        write_mixture_ply(tmp_path / "m.ply", mix)
        vertex = parse(tmp_path / "m.ply")[0]["vertex"]
        rgb, compared = 0.5 + 0.28209479177387814 * stack(vertex, "f_dc_0", "f_dc_1", "f_dc_2"), vertex["views"] > 0
        brightness = (rgb @ [0.3, 0.6, 0.1])[compared][np.argsort(vertex["disagreement"][compared])]
        assert (np.diff(brightness) >= -1e-6).all()
        np.testing.assert_allclose(rgb[~compared], 150 / 255, atol=1e-6)

    def test_flat_and_point_components_are_finite(self, tmp_path: Path) -> None:
        mix = mixture(4, streams=1)
        covariance = torch.zeros_like(mix.covariance)
        covariance[0, 0] = torch.diag(torch.tensor([0.25, 0.04, 0.0]))
        covariance[0, 1, 2, 2] = -1e-12  # rounding
        weight = torch.tensor([[1.0, 1.0, 0.0, 0.0]], dtype=torch.float64)
        write_mixture_ply(tmp_path / "m.ply", mix.replace(covariance=covariance, weight=weight))
        table = parse(tmp_path / "m.ply")[0]["vertex"]
        sigma = np.exp(stack(table, "scale_0", "scale_1", "scale_2"))
        np.testing.assert_allclose(sigma[0], [SIGMA_FLOOR, 0.2, 0.5], rtol=1e-6)
        np.testing.assert_allclose(sigma[1], [SIGMA_FLOOR] * 3, rtol=1e-6)

    def test_empty_mixture(self, tmp_path: Path) -> None:
        empty = GaussianMixture.empty(1, 4, dtype=torch.float32, device="cpu")
        assert write_mixture_ply(tmp_path / "m.ply", empty) == 0
        assert len(parse(tmp_path / "m.ply")[0]["vertex"]) == 0


def read_mixture_npz(path: Path) -> tuple[GaussianMixture, torch.Tensor | None]:
    """Read the fields of a mixture and the pose, as a user's program would."""
    with np.load(path, allow_pickle=False) as stored:
        fields = {name: torch.from_numpy(stored[name]) for name in stored.files}
    T_world_first = fields.pop("T_world_first", None)
    return GaussianMixture(**fields), T_world_first


class TestNpz:
    @pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
    def test_exact(self, tmp_path: Path, dtype: torch.dtype) -> None:
        mix = mixture(dtype=dtype)
        write_mixture_npz(tmp_path / "m.npz", mix.padded(64), T_world_first=world())
        back, T = read_mixture_npz(tmp_path / "m.npz")
        for name, value in mix.tensors().items():
            assert torch.equal(getattr(back, name), value)
            assert getattr(back, name).dtype == value.dtype
        assert T is not None
        assert torch.equal(T, world())

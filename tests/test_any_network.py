"""Networks of one's own: wrapping, saved programs, loading by name."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest
import torch
from onnx_files import small_network
from torch import Tensor, nn

from ufmstar_torch.models import (
    AlignedNetwork,
    Alignment,
    DecoderDropout,
    DepthNetwork,
    Ensemble,
    FastDepth,
    LazyMember,
    MonteCarloDropout,
    OutputSpec,
    Preprocess,
    load_network,
    save_checkpoint,
    wrap_network,
)
from ufmstar_torch.models.any_network import load_torchscript
from ufmstar_torch.models.outputs import ProgramSpec
from ufmstar_torch.prediction import DepthPrediction, infer

METRIC = ProgramSpec(OutputSpec("metric"))


@pytest.fixture
def image() -> Tensor:
    return torch.rand(2, 3, 6, 8, generator=torch.Generator().manual_seed(0))


class Sum(nn.Module):
    """Depth = a learned multiple of the channels' sum."""

    def __init__(self) -> None:
        super().__init__()
        self.factor = nn.Parameter(torch.tensor(0.5))

    def forward(self, x: Tensor) -> Tensor:
        return self.factor * x.sum(1, keepdim=True)


@dataclass
class Result:
    predicted_depth: Tensor
    name: str = "not a tensor"


@pytest.mark.parametrize(
    ("returned", "output"),
    [
        (lambda d: d, None),
        (lambda d: d[:, None], None),
        (lambda d: d[..., None], None),
        (lambda d: {"depth": d, "other": -d}, "depth"),
        (lambda d: {"only": d}, None),
        (lambda d: (-d, d), 1),
        (lambda d: [d], None),
        (lambda d: Result(d), "predicted_depth"),
        (lambda d: Result(d), None),
        (lambda d: DepthPrediction(d), None),
        (lambda d: d.to(torch.float64), None),
    ],
)
def test_forms_of_depth(image: Tensor, returned: Any, output: str | int | None) -> None:
    network = wrap_network(lambda x: returned(x.sum(1)), output)
    torch.testing.assert_close(network(image).depth, image.sum(1), check_dtype=False)


def test_units_and_variances(image: Tensor) -> None:
    """Millimetres with a standard deviation in millimetres and a log-variance in log mm^2."""
    network = wrap_network(
        lambda x: {"d": x.sum(1), "s": x[:, 0], "l": x[:, :1]},
        "d",
        scale=0.001,
        aleatoric="s",
        aleatoric_kind="std",
        epistemic="l",
        epistemic_kind="log_variance",
    )
    got = network(image)
    torch.testing.assert_close(got.depth, image.sum(1) * 1e-3)
    torch.testing.assert_close(got.aleatoric_variance, image[:, 0] ** 2 * 1e-6)
    torch.testing.assert_close(got.epistemic_variance, image[:, 0].exp() * 1e-6)


def cameras(*focals: tuple[float, float]) -> Tensor:
    """[B, 3, 3] float64, as sequences have them."""
    return torch.tensor([[[fx, 0, 4], [0, fy, 3], [0, 0, 1]] for fx, fy in focals], dtype=torch.float64)


def test_depth_for_a_canonical_focal_length(image: Tensor) -> None:
    """Depth and spreads in its units scale by f / 300, camera by camera; a relative spread does not scale again."""
    raw = {"d": image.sum(1), "s": image[:, 0], "r": image[:, 1]}
    kinds = {"aleatoric": "s", "aleatoric_kind": "std", "epistemic": "r", "epistemic_kind": "relative_std"}
    network = wrap_network(lambda x: raw, "d", scale=2.0, focal=300.0, **kinds)
    assert network.takes_intrinsics
    got = network(image, cameras((150, 150), (500, 700)))
    unit = 2 * torch.tensor([0.5, 2.0])[:, None, None]
    torch.testing.assert_close(got.depth, raw["d"] * unit)
    torch.testing.assert_close(got.aleatoric_variance, (raw["s"] * unit) ** 2)
    torch.testing.assert_close(got.epistemic_variance, (raw["r"] * raw["d"] * unit) ** 2)
    with pytest.raises(ValueError, match=r"focal=300 needs the intrinsics .* network\(x, K\)"):
        network(image)


class Metric(nn.Module):
    """Depth = the first channel times fx / 1000."""

    takes_intrinsics = True

    def forward(self, x: Tensor, K: Tensor) -> Tensor:
        return x[:, 0] * K[:, 0, 0, None, None] / 1000


@pytest.mark.parametrize("around", ["wrapped", "declared", "ensemble", "lazy", "samples", "batched", "aligned"])
def test_the_intrinsics_pass_through_every_wrapper(image: Tensor, around: str) -> None:
    """Every wrapper takes the intrinsics and passes them on, in single precision."""
    inner: DepthNetwork = wrap_network(Metric())
    networks: dict[str, Callable[[], DepthNetwork]] = {
        "wrapped": lambda: inner,
        "declared": lambda: wrap_network(lambda x, K: Metric()(x, K), takes_intrinsics=True),
        "ensemble": lambda: Ensemble([inner, wrap_network(lambda x: x[:, 0])]),
        "lazy": lambda: LazyMember(lambda: inner, inner.preprocess),
        "samples": lambda: MonteCarloDropout(wrap_network(Sampling()), 2),
        "batched": lambda: MonteCarloDropout(wrap_network(Sampling()), 2, batched=True),
        "aligned": lambda: AlignedNetwork(Metric(), Alignment("affine", 1.0, 0.0)),
    }
    network, factor = networks[around](), torch.tensor([0.5, 2.0])[:, None, None]
    assert network.takes_intrinsics
    depth = infer(network, image, cameras((500, 500), (2000, 2000))).depth
    expected = image[:, 0] * ((1 + factor) / 2 if around == "ensemble" else factor)
    torch.testing.assert_close(depth, expected)
    with pytest.raises(ValueError, match=r"network\(x, K\)"):
        network(image)


class Sampling(Metric):
    """With a dropout that a ``MonteCarloDropout`` can switch on, and that changes nothing here."""

    def __init__(self) -> None:
        super().__init__()
        self.dropout = DecoderDropout(0.5)


def test_a_wrapped_module_stays_a_module(image: Tensor) -> None:
    """Parameters, gradients, modes and state_dict pass through the wrapper."""
    network = wrap_network(Sum(), preprocess=Preprocess(size=(6, 8)))
    network(image).depth.sum().backward()
    assert [name for name, _ in network.named_parameters()] == ["network.factor"]
    factor = dict(network.named_parameters())["network.factor"]
    assert factor.grad is not None
    torch.testing.assert_close(factor.grad, image.sum())
    assert network.preprocess.size == (6, 8)
    assert all(not module.training for module in network.eval().modules())


@pytest.mark.filterwarnings("ignore:`torch.jit:FutureWarning", "ignore:`torch.jit:DeprecationWarning")
def test_torchscript(tmp_path: Path, image: Tensor) -> None:
    torch.jit.save(torch.jit.trace(Sum(), image), str(tmp_path / "n.ts"))
    expected = Sum()(image)[:, 0]
    torch.testing.assert_close(load_torchscript(tmp_path / "n.ts", METRIC)(image).depth, expected)
    network = load_network("torchscript", tmp_path / "n.ts", spec={"outputs": {"kind": "metric", "scale": 2}})
    torch.testing.assert_close(network(image).depth, 2 * expected)
    K = cameras((500, 500), (2000, 2000)).float()
    torch.jit.save(torch.jit.trace(Metric(), (image, K)), str(tmp_path / "k.ts"))
    network = load_network("torchscript", tmp_path / "k.ts", spec={**METRIC.to_dict(), "takes_intrinsics": True})
    torch.testing.assert_close(network(image, K).depth, Metric()(image, K))
    (tmp_path / "broken.ts").write_bytes((tmp_path / "n.ts").read_bytes()[:200])
    with pytest.raises(ValueError, match=r"broken.ts is not a readable TorchScript file"):
        load_torchscript(tmp_path / "broken.ts", METRIC)
    with pytest.raises(FileNotFoundError, match="none"):
        load_torchscript(tmp_path / "none", METRIC)


@pytest.mark.parametrize("suffix", ["pth", "safetensors"])
@pytest.mark.parametrize("folded", [False, True])
def test_fastdepth_from_a_checkpoint(tmp_path: Path, suffix: str, folded: bool) -> None:
    """A checkpoint of whatever widths is the same network (ONNX files: test_fastdepth.py)."""
    source = small_network().folded() if folded else small_network()
    path = tmp_path / f"w.{suffix}"
    save_checkpoint(path, {f"module.{k}": v for k, v in source.state_dict().items()})
    network = load_network("fastdepth", path)
    assert isinstance(network, FastDepth)
    assert network.widths == source.widths
    assert not network.training
    x = network.preprocess.apply_image(torch.rand(1, 3, 300, 400))
    with torch.inference_mode():
        assert torch.equal(network(x).depth, source(x).depth)
    save_checkpoint(path, {"a": torch.zeros(1)})
    with pytest.raises(ValueError, match=rf"w.{suffix}: not the weights of a FastDepth"):
        load_network("fastdepth", path)

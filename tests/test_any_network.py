"""A user's networks: wrapping, saved programs, loading by name."""

from __future__ import annotations

import io
import json
import os
import zipfile
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import pytest
import torch
from onnx_files import small_network
from torch import Tensor, nn

from ufmstar_torch import UncertainDepth
from ufmstar_torch.frames.prediction import DepthPrediction, infer
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
from ufmstar_torch.models.any_network import load_exported, load_torchscript
from ufmstar_torch.models.outputs import SPREADS, ProgramSpec

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


@pytest.mark.parametrize("kind", SPREADS)
def test_units_and_variances(image: Tensor, kind: Any) -> None:
    """Millimetres become metres, and a spread in millimetres, in any form, becomes m^2."""
    raw = image[:, 0] - 1  # logarithms can be negative
    maps = {"d": image.sum(1), "s": raw, "v": image[:, :1]}
    declared = {"aleatoric": "s", "aleatoric_kind": kind, "epistemic": "v"}
    got = wrap_network(lambda x: maps, "d", scale=0.001, **declared)(image)
    torch.testing.assert_close(got.depth, image.sum(1) * 1e-3)
    squared = {"variance": raw, "std": raw**2, "log_variance": raw.exp(), "log_std": raw.exp() ** 2}
    squared["relative_std"] = (raw * image.sum(1)) ** 2
    torch.testing.assert_close(got.aleatoric_variance, squared[kind] * 1e-6)
    torch.testing.assert_close(got.epistemic_variance, image[:, 0] * 1e-6)


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


@pytest.mark.parametrize("around", ["wrapped", "declared", "ensemble", "lazy", "samples", "aligned"])
def test_the_intrinsics_pass_through_every_wrapper(image: Tensor, around: str) -> None:
    """Every wrapper takes the intrinsics and passes them on, in single precision."""
    inner: DepthNetwork = wrap_network(Metric())
    networks: dict[str, Callable[[], DepthNetwork]] = {
        "wrapped": lambda: inner,
        "declared": lambda: wrap_network(lambda x, K: Metric()(x, K), takes_intrinsics=True),
        "ensemble": lambda: Ensemble([inner, wrap_network(lambda x: x[:, 0])]),
        "lazy": lambda: LazyMember(lambda: inner, inner.preprocess),
        "samples": lambda: MonteCarloDropout(wrap_network(Sampling()), 2),
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
    """Has a dropout layer that ``MonteCarloDropout`` can enable, and that changes nothing here."""

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
    torch.testing.assert_close(load_torchscript(tmp_path / "n.ts", METRIC, trust_code=True)(image).depth, expected)
    network = load_network(
        "torchscript", tmp_path / "n.ts", spec={"outputs": {"kind": "metric", "scale": 2}}, trust_code=True
    )
    torch.testing.assert_close(network(image).depth, 2 * expected)
    K = cameras((500, 500), (2000, 2000)).float()
    torch.jit.save(torch.jit.trace(Metric(), (image, K)), str(tmp_path / "k.ts"))
    network = load_network(
        "torchscript", tmp_path / "k.ts", spec={**METRIC.to_dict(), "takes_intrinsics": True}, trust_code=True
    )
    torch.testing.assert_close(network(image, K).depth, Metric()(image, K))
    (tmp_path / "broken.ts").write_bytes((tmp_path / "n.ts").read_bytes()[:200])
    with pytest.raises(ValueError, match=r"broken.ts is not a readable TorchScript file"):
        load_torchscript(tmp_path / "broken.ts", METRIC, trust_code=True)
    with pytest.raises(FileNotFoundError, match="none"):
        load_torchscript(tmp_path / "none", METRIC)


def test_exported_program(tmp_path: Path, image: Tensor) -> None:
    program = torch.export.export(nn.Sequential(Sum(), nn.Dropout(0.5)).eval(), (image,))
    torch.export.save(program, str(tmp_path / "n.pt2"))
    network = load_exported(tmp_path / "n.pt2", METRIC, trust_code=True)
    torch.testing.assert_close(network.eval()(image).depth, Sum()(image)[:, 0])
    torch.testing.assert_close(network.train()(image).depth, Sum()(image)[:, 0])  # exported without dropout
    spec = tmp_path / "spec.json"
    spec.write_text(json.dumps({"outputs": {"kind": "metric"}, "preprocess": {"size": [6, 8]}}))
    loaded = load_network("exported", tmp_path / "n.pt2", spec=spec, trust_code=True)
    assert loaded.preprocess == Preprocess(size=(6, 8))
    (tmp_path / "broken.pt2").write_bytes((tmp_path / "n.pt2").read_bytes()[:200])
    with pytest.raises(ValueError, match=r"broken.pt2 is not a readable torch.export file"):
        load_exported(tmp_path / "broken.pt2", METRIC, trust_code=True)


DEFECTS: dict[str, tuple[Any, str]] = {
    "two outputs": (lambda x: (x[:, 0], x[:, 1]), r"returns \[0, 1\]; declare which one is depth"),
    "two inputs": (lambda x, y: x[:, 0] + y[:, 1], r"fails on torch.float32 \(1, 3, 6, 8\): .*takes_intrinsics"),
    "another size": (lambda x: x.sum(1).reshape(1, 48), r"fails on torch.float32 .*declare its size|must be \[B, 1, H"),
    "rank 2": (lambda x: x[0, 0], r"output 'depth' must be \[B, 1, H, W\], .*, got \(6, 8\)"),
    "three channels": (lambda x: x + 1, r"must be \[B, 1, H, W\], .*, got \(1, 3, 6, 8\)"),
    "NaN": (lambda x: x[:, 0] * torch.nan, "output 'depth' is NaN, infinite or negative at every pixel"),
    "negative": (lambda x: -1 - x[:, 0], "output 'depth' is NaN, infinite or negative at every pixel"),
    "a mask": (lambda x: x[:, 0] > 0, "must be a tensor of numbers, got torch.bool"),
    "half the size": (lambda x: x[:, 0, ::2, ::2], r"has \(3, 4\) px, expected the input's \(6, 8\)"),
    "other images": (lambda x: x[:, 0].repeat(2, 1, 1), "holds 2 maps for 1 images"),
}


def test_only_the_first_prediction_must_have_a_depth(image: Tensor) -> None:
    """Without a depth in the first prediction, the network is refused. A later frame without depth has no valid pixel;
    the next frame is processed as usual."""
    network = wrap_network(lambda x: x[:, 0].log())
    with pytest.raises(ValueError, match="NaN, infinite or negative at every pixel"):
        network(0 * image)
    depth = network(2 + image).depth
    assert network(0 * image).depth.isinf().all()
    assert torch.equal(network(2 + image).depth, depth)


class Program(nn.Module):
    """A function as a module."""

    def __init__(self, function: Any) -> None:
        super().__init__()
        self.function = function

    def forward(self, *inputs: Tensor) -> Any:
        return self.function(*inputs)


@pytest.mark.filterwarnings("ignore:`torch.jit:FutureWarning", "ignore:`torch.jit:DeprecationWarning")
@pytest.mark.parametrize("kind", ["exported", "torchscript"])
@pytest.mark.parametrize("defect", DEFECTS)
def test_a_program_with_a_defect_is_named(tmp_path: Path, image: Tensor, kind: str, defect: str) -> None:
    function, message = DEFECTS[defect]
    one, path = image[:1], tmp_path / "n.graph"
    inputs = (one, one) if defect == "two inputs" else (one,)
    if kind == "exported":
        torch.export.save(torch.export.export(Program(function).eval(), inputs), path)
    else:
        torch.jit.save(torch.jit.trace(Program(function), inputs), str(path))
    network = load_network(kind, path, spec=METRIC, trust_code=True)
    with pytest.raises(ValueError, match=f"(?s)n.graph:? .*({message})"):
        network(torch.rand(1, 3, 8, 8) if defect == "another size" else one)


class Malice:
    """Unpickling it creates a folder."""

    def __init__(self, trap: Path) -> None:
        self.trap = str(trap)

    def __reduce__(self) -> tuple[Any, ...]:
        return os.mkdir, (self.trap,)


@pytest.mark.filterwarnings("ignore:`torch.jit:FutureWarning", "ignore:`torch.jit:DeprecationWarning")
@pytest.mark.parametrize("kind", ["exported", "torchscript"])
def test_a_program_in_a_file_runs_only_if_it_is_trusted(tmp_path: Path, image: Tensor, kind: str) -> None:
    """Both files run code when they are trusted, so the refusal of the others protects."""
    trap, path = tmp_path / "trap", tmp_path / "n.graph"
    if kind == "exported":
        torch.export.save(torch.export.export(Sum().eval(), (image,)), tmp_path / "n.pt2")
        evil = io.BytesIO()
        torch.save(Malice(trap), evil)
        with zipfile.ZipFile(tmp_path / "n.pt2") as source, zipfile.ZipFile(path, "w") as target:
            for entry in source.namelist():
                content = source.read(entry).replace(b'"use_pickle": false', b'"use_pickle": true')
                target.writestr(entry, evil.getvalue() if entry.endswith("weight_0") else content)
    else:
        torch.jit.save(torch.jit.trace(Writer(str(trap)), image), str(path))
        trap.unlink()  # tracing has written it

    def load(**trust: Any) -> None:
        load_network(kind, path, spec=METRIC, **trust)(image)

    for trust in ({}, {"trust_code": False}, {"trust_code": "yes"}):
        with pytest.raises(ValueError, match=r"n.graph is not loaded: .*pass --trust-code .*ONNX and safetensors"):
            load(**trust)
        assert not trap.exists()
    with suppress(Exception):  # the unpickled object is no weight
        load(trust_code=True)
    assert trap.exists()


class Writer(nn.Module):
    """A network that writes a file."""

    def __init__(self, file: str) -> None:
        super().__init__()
        self.file = file

    def forward(self, image: Tensor) -> Tensor:
        return image.sum(1) + torch.from_file(self.file, True, 5).fill_(1).sum()


@pytest.mark.parametrize("suffix", ["pth", "safetensors"])
@pytest.mark.parametrize("folded", [False, True])
def test_fastdepth_from_a_checkpoint(tmp_path: Path, suffix: str, folded: bool) -> None:
    """A checkpoint with any channel counts loads as the same network (ONNX files: test_fastdepth.py)."""
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


def test_midas_is_refused_and_can_be_aligned():
    """``torch.hub``'s MiDaS returns inverse depth [B, H, W], in the same form as a metric network's depth."""
    kind = type(
        "DPTDepthModel", (nn.Module,), {"__module__": "midas.dpt_depth", "forward": lambda self, x: 1 + x[:, 0]}
    )
    for wrap in (wrap_network, UncertainDepth, lambda network: UncertainDepth([network])):
        with pytest.raises(ValueError, match=r"MiDaS \(DPTDepthModel\), which predicts inverse.*AlignedNetwork"):
            wrap(kind())
    aligned = AlignedNetwork(kind(), Alignment("inverse", 0.5, 0.1))
    assert float(aligned(torch.ones(1, 3, 8, 8)).depth[0, 0, 0]) == pytest.approx(1 / 1.1)


def test_a_function_of_a_network_in_training_mode_is_named(caplog):
    network = nn.Sequential(nn.Conv2d(3, 1, 1), nn.BatchNorm2d(1))

    def function(x):
        return network(x).exp()

    for wrapped in (lambda x: network(x), network.forward, partial(network.forward), function):
        network.train()
        caplog.clear()
        wrap_network(wrapped)
        assert ["uses a Sequential in training mode" in text for text in caplog.messages] == [True]
        network.eval()
        wrap_network(wrapped)
        assert len(caplog.messages) == 1
    network.train()
    UncertainDepth(wrap_network(network))
    assert not network.training, "a module is set to eval mode"
    assert len(caplog.messages) == 1

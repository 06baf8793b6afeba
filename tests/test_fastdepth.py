"""FastDepth: the paper's sizes, agreement with ONNX Runtime, refused files, fine-tuning."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import onnx
import pytest
import torch
from onnx import numpy_helper
from onnx_files import Edit, edited, run_onnx, small_network, write_fastdepth
from PIL import Image
from shared_data import require_shared
from torch import Tensor, nn

from ufmstar_torch.models import FastDepth, FastDepthWidths

WEIGHTS = "weights/fastdepth_nyu.onnx"
TUM = "data/rgbd_dataset_freiburg1_xyz"


@pytest.fixture(scope="module")
def network() -> FastDepth:
    return FastDepth.from_onnx(require_shared(WEIGHTS))


def tum_frames(step: int) -> list[tuple[Tensor, Tensor]]:
    """Every step-th frame: image [1, 3, 480, 640] uint8, depth [1, 480, 640] [m], 0 = none."""
    root = require_shared(TUM)
    depth_files = sorted((root / "depth").glob("*.png"))
    times = np.array([float(f.stem) for f in depth_files])
    frames = []
    for file in sorted((root / "rgb").glob("*.png"))[::step]:
        nearest = depth_files[int(np.abs(times - float(file.stem)).argmin())]
        image = np.array(Image.open(file))
        depth = np.array(Image.open(nearest)).astype(np.float32) / 5000
        frames.append((torch.from_numpy(image).permute(2, 0, 1)[None], torch.from_numpy(depth)[None]))
    return frames


@pytest.mark.parametrize(
    ("widths", "weights", "macs"),
    [(FastDepthWidths.full(), 3.93e6, 0.74e9), (FastDepthWidths.pruned(), 1.34e6, 0.37e9)],
    ids=["full", "pruned"],
)
def test_weights_and_operations_are_the_papers(widths: FastDepthWidths, weights: float, macs: float) -> None:
    """Wofk et al. state 3.93 M weights and 0.74 G multiply-adds at 224 x 224; pruned, 1.34 M and 0.37 G."""
    network = FastDepth(widths).eval()
    counted = {"weights": 0, "macs": 0}

    def count(module: nn.Module, _: object, output: Tensor) -> None:
        assert isinstance(module, nn.Conv2d)
        counted["weights"] += module.weight.numel()
        counted["macs"] += output.numel() * module.weight[0].numel()

    for module in network.modules():
        if isinstance(module, nn.Conv2d):
            module.register_forward_hook(count)
    with torch.inference_mode():
        assert network(torch.rand(1, 3, 224, 224)).depth.shape == (1, 224, 224)
    assert counted["weights"] == pytest.approx(weights, rel=0.003)
    assert counted["macs"] == pytest.approx(macs, rel=0.01)


def test_published_weights_agree_with_onnx_runtime(network: FastDepth) -> None:
    """1e-4 m is required; observed 9e-7 m on noise and 8e-6 m on photographs (of 1.5 m)."""
    assert network.widths == FastDepthWidths.pruned()
    noise = torch.rand(2, 3, 224, 224, generator=torch.Generator().manual_seed(0))
    photographs = torch.cat([network.preprocess.apply_image(image) for image, _ in tum_frames(8)])
    image = torch.cat([noise, photographs])
    with torch.inference_mode():
        depth = network(image).depth
    expected = run_onnx(require_shared(WEIGHTS), image)[:, 0]
    assert float(depth.std()) > 0.1  # not a constant, which would agree trivially
    torch.testing.assert_close(depth, expected, rtol=0, atol=2e-5)


@pytest.mark.parametrize("folded", [False, True])
def test_import_of_other_widths_and_folded_norms(tmp_path: Path, folded: bool) -> None:
    """A graph with a newer opset, other channel counts, and separate or folded batch norms imports as the same
    function."""
    source = small_network()
    source = source.folded() if folded else source
    path = write_fastdepth(tmp_path / "small.onnx", source)
    loaded = FastDepth.from_onnx(path)
    assert loaded.widths == source.widths
    assert not loaded.training
    assert any(isinstance(m, nn.BatchNorm2d) for m in loaded.modules()) is not folded
    for key, value in loaded.state_dict().items():  # the graph has no counters; they start at 0
        assert torch.equal(value, source.state_dict()[key] * (not key.endswith("num_batches_tracked"))), key
    image = torch.rand(2, 3, 64, 64, generator=torch.Generator().manual_seed(1))
    with torch.inference_mode():
        depth = loaded(image).depth
    assert float(depth.std()) > 0.5
    # Untrained layers amplify rounding: torch's own float32 and float64 differ by 1e-4 here.
    torch.testing.assert_close(depth, run_onnx(path, image)[:, 0], rtol=0, atol=2e-3)


def test_a_bias_before_batch_norm_is_taken_into_account(tmp_path: Path) -> None:
    def with_bias(model: onnx.ModelProto) -> None:
        bias = np.linspace(-0.2, 0.3, 6, dtype=np.float32)
        model.graph.initializer.append(numpy_helper.from_array(bias, "extra_bias"))
        node(model, "Conv", 2).input.append("extra_bias")

    plain = write_fastdepth(tmp_path / "plain.onnx", small_network())
    path = edited(plain, tmp_path / "biased.onnx", with_bias)
    image = torch.rand(2, 3, 64, 64, generator=torch.Generator().manual_seed(1))
    with torch.inference_mode():
        depth = FastDepth.from_onnx(path)(image).depth
    expected = run_onnx(path, image)[:, 0]
    assert (expected - run_onnx(plain, image)[:, 0]).abs().max() > 0.1
    torch.testing.assert_close(depth, expected, rtol=0, atol=2e-3)


def node(model: onnx.ModelProto, kind: str, index: int) -> onnx.NodeProto:
    return [n for n in model.graph.node if n.op_type == kind][index]


def drop_weights(model: onnx.ModelProto, names: list[str]) -> None:
    remaining = [t for t in model.graph.initializer if t.name not in names]
    del model.graph.initializer[:]
    model.graph.initializer.extend(remaining)


def other_stride(model: onnx.ModelProto) -> None:
    stem = node(model, "Conv", 0)
    next(a for a in stem.attribute if a.name == "strides").ints[:] = [1, 1]


def no_skip(model: onnx.ModelProto) -> None:
    add = node(model, "Add", 0)
    for n in model.graph.node:
        n.input[:] = [add.input[1] if name == add.output[0] else name for name in n.input]
    model.graph.node.remove(add)


def leftover_weight(model: onnx.ModelProto) -> None:
    model.graph.initializer.append(numpy_helper.from_array(np.ones(5, np.float32), "left_over"))


def norm_after_some(model: onnx.ModelProto) -> None:
    norm = node(model, "BatchNormalization", 4)
    for n in model.graph.node:
        n.input[:] = [norm.input[0] if name == norm.output[0] else name for name in n.input]
    model.graph.node.remove(norm)
    drop_weights(model, list(norm.input[1:]))


def without_last(model: onnx.ModelProto) -> None:
    del model.graph.node[-3:]
    model.graph.output[0].name = model.graph.node[-1].output[0]
    drop_weights(model, [t.name for t in model.graph.initializer if t.name.startswith("head")])


def not_finite(model: onnx.ModelProto) -> None:
    bias = next(t for t in model.graph.initializer if t.name == "decoder.2.pointwise.norm.bias")
    bias.CopyFrom(numpy_helper.from_array(np.full(bias.dims, np.nan, np.float32), bias.name))


OTHER_FUNCTION = r"edited.onnx is not a FastDepth: its graph computes another depth from the same weights"


@pytest.mark.parametrize(
    ("edit", "message"),
    [
        (other_stride, r"edited.onnx is not a FastDepth: .*edited.onnx: output 'head' has \(128, 128\) px"),
        (no_skip, OTHER_FUNCTION),
        (leftover_weight, r"initialiser 'left_over' \(5,\) is used by no layer"),
        (norm_after_some, "batch norm after some convolutions only"),
        (without_last, "edited.onnx is not a FastDepth: expected 38 convolutions, got 37"),
        (not_finite, "with NaN or infinity: decoder.2.pointwise.norm.bias"),
    ],
)
def test_other_graphs_are_refused(tmp_path: Path, edit: Edit, message: str) -> None:
    good = write_fastdepth(tmp_path / "good.onnx", small_network())
    with pytest.raises(ValueError, match=message):
        FastDepth.from_onnx(edited(good, tmp_path / "edited.onnx", edit))


@pytest.mark.parametrize(
    ("multiplier", "stem", "last"), [(1.0, 32, 1024), (0.25, 8, 256), (0.3, 16, 304), (1.1, 32, 1128)]
)
def test_width_multiplier(multiplier: float, stem: int, last: int) -> None:
    widths = FastDepthWidths.scaled(multiplier)
    assert (widths.encoder[0], widths.encoder[-1]) == (stem, last)
    full = FastDepthWidths.full()
    for scaled, exact in zip(widths.encoder + widths.decoder, full.encoder + full.decoder, strict=True):
        assert scaled % 8 == 0
        assert scaled >= 0.9 * multiplier * exact
        assert scaled <= multiplier * exact + 8
    assert FastDepthWidths.scaled(1) == FastDepthWidths.full()


@pytest.mark.parametrize("norm", [True, False])
@pytest.mark.parametrize("positive", ["relu", "softplus"])
def test_fastdepth_starts_in_a_room(positive: str, norm: bool) -> None:
    """Without training, every pixel's depth is a few metres, so its gradient is not 0, with either activation."""
    torch.manual_seed(0)
    network = FastDepth(FastDepthWidths.scaled(0.25), positive=positive, norm=norm, size=(64, 96)).train()
    assert network.preprocess.size == (64, 96)
    image = torch.rand(4, 3, 64, 96, generator=torch.Generator().manual_seed(0))
    depth = network(image).depth.detach()
    assert float(depth.median()) == pytest.approx(2.5, abs=0.5)
    assert float((depth > 0).float().mean()) > 0.98
    nn.init.constant_(network.head.norm.bias if norm else network.head.conv.bias, -20.0)
    depth = network(image).depth
    assert (float(depth.detach().min()) > 0) == (positive == "softplus")
    depth.sum().backward()
    gradient = sum(float(p.grad.abs().sum()) for p in network.head.parameters() if p.grad is not None)
    assert (gradient > 0) == (positive == "softplus")

"""ResNet-Monodepth2: sizes, strides, an independent decoder, ImageNet weights, published state_dicts."""

from __future__ import annotations

import copy
from collections.abc import Mapping
from functools import cache
from pathlib import Path
from typing import Any

import pytest
import torch
import torch.nn.functional as F
from torch import Tensor, nn

from ufmstar_torch.eval.engine.load import NetworkChoice
from ufmstar_torch.models import CheckpointError, MonodepthResNet, load_monodepth2, load_network, save_checkpoint
from ufmstar_torch.models.monodepth2 import DECODER_WIDTHS, IMAGENET_MEAN, IMAGENET_STD

SMALL = (4, 8, 8, 8, 16)


def seeded(seed: int = 0) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def random_like(state: Mapping[str, Tensor], seed: int) -> dict[str, Tensor]:
    """Random values for every tensor, scaled to keep activations in range."""
    generator, result = seeded(seed), {}
    for key, value in state.items():
        if not value.is_floating_point():
            result[key] = value.clone()
        elif key.endswith("running_var") or (value.dim() == 1 and key.endswith("weight")):
            result[key] = 0.5 + torch.rand(value.shape, generator=generator)
        else:
            spread = 0.1 if value.dim() == 1 else value[0].numel() ** -0.5
            result[key] = spread * torch.randn(value.shape, generator=generator)
    return result


@cache
def untrained(**options: Any) -> MonodepthResNet:
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(0)
        return MonodepthResNet(18, decoder=SMALL, **options).eval()


def small(**options: Any) -> MonodepthResNet:
    return copy.deepcopy(untrained(**options))


@cache
def random_classifier(layers: int, seed: int) -> dict[str, Tensor]:
    import torchvision.models

    return random_like(getattr(torchvision.models, f"resnet{layers}")(weights=None).state_dict(), seed)


def classifier_weights(layers: int = 18, seed: int = 1) -> dict[str, Tensor]:
    """The state_dict of a complete classifier, like torchvision's."""
    return {name: value.clone() for name, value in random_classifier(layers, seed).items()}


@pytest.mark.parametrize(("layers", "encoder", "total"), [(18, 11_176_512, 14.3e6), (50, 23_508_032, 32.5e6)])
def test_sizes_are_monodepth2s(layers: int, encoder: int, total: float) -> None:
    """ResNets without classifier, and the totals that the literature states for Monodepth2."""
    network = MonodepthResNet(layers)
    assert sum(p.numel() for p in network.encoder.parameters()) == encoder
    assert sum(p.numel() for p in network.parameters()) == pytest.approx(total, rel=0.005)
    assert network.feature_channels == DECODER_WIDTHS[0] == 16


def test_untrained_depth_is_a_rooms() -> None:
    """Metric and positive everywhere, at full resolution, about 2.5 m."""
    image = torch.randn(2, 3, 64, 96, generator=seeded())
    network = small()
    with torch.inference_mode():
        depth = network(image).depth
        assert network.features(image).shape == (2, SMALL[0], 64, 96)
    assert depth.shape == (2, 64, 96)
    assert 2 < float(depth.min()) <= float(depth.max()) < 3
    nn.init.constant_(network.head.bias, -50.0)
    with torch.inference_mode():
        assert float(network(image).depth.min()) > 0


def decoder_of_the_paper(state: Mapping[str, Tensor], maps: list[Tensor]) -> Tensor:
    """Monodepth2's decoder up to the last features, written independently, with the published keys."""

    def convolve(x: Tensor, n: int) -> Tensor:
        x = F.pad(x, (1, 1, 1, 1), mode="reflect")
        x = F.conv2d(x, state[f"decoder.{n}.conv.conv.weight"], state[f"decoder.{n}.conv.conv.bias"])
        return torch.where(x > 0, x, x.exp() - 1)

    x = maps[4]
    for step in range(5):
        x = convolve(x, 2 * step)
        x = x.repeat_interleave(2, 2).repeat_interleave(2, 3)
        if step < 4:
            x = torch.cat([x, maps[3 - step]], 1)
        x = convolve(x, 2 * step + 1)
    return x


def published_decoder(channels: tuple[int, ...], widths: tuple[int, ...], seed: int = 2) -> dict[str, Tensor]:
    """Random tensors under depth.pth's keys: levels 4 to 0 with two convolutions each, then four disparities."""
    shapes, below = [], channels[-1]
    for i in (4, 3, 2, 1, 0):
        skip = channels[i - 1] if i else 0
        shapes += [(widths[i], below, 3, 3), (widths[i], widths[i] + skip, 3, 3)]
        below = widths[i]
    keys = [f"decoder.{n}.conv.conv" for n in range(10)] + [f"decoder.{n}.conv" for n in range(10, 14)]
    shapes += [(1, widths[i], 3, 3) for i in range(4)]
    empty = {f"{k}.weight": torch.zeros(s) for k, s in zip(keys, shapes, strict=True)}
    empty |= {f"{k}.bias": torch.zeros(s[0]) for k, s in zip(keys, shapes, strict=True)}
    return random_like(empty, seed)


def write_published(
    folder: Path, encoder: dict[str, Any], decoder: dict[str, Tensor], stereo: bool = False
) -> tuple[Path, Path]:
    extra = {"height": 64, "width": 96, "use_stereo": stereo}
    torch.save({f"encoder.{k}": v for k, v in encoder.items()} | extra, folder / "encoder.pth")
    torch.save(decoder, folder / "depth.pth")
    return folder / "encoder.pth", folder / "depth.pth"


def test_published_weights_are_taken(tmp_path: Path) -> None:
    """Every tensor is loaded except those of the classifier and the disparities."""
    network = small()
    before = {key: value.clone() for key, value in network.state_dict().items()}
    decoder = published_decoder(network.encoder.channels, SMALL)
    report = load_monodepth2(network, *write_published(tmp_path, classifier_weights(), decoder))
    assert len(report.loaded) == 120 + 20
    assert report.unchanged == ("head.bias", "head.weight")
    assert len(report.skipped) == 2 + 8
    assert report.skipped["decoder.10.conv.weight"] == "disparity is not metric depth"
    assert report.skipped["encoder.fc.weight"] == "the classifier is not used"
    assert all(torch.equal(network.state_dict()[key], before[key]) for key in report.unchanged)


def test_published_weights_predict_metric_depth(tmp_path: Path) -> None:
    """Weights trained on stereo pairs predict depth = 5.4 m / disparity, with the finest disparity scaled to 1/100 ...
    1/.1."""
    decoder = published_decoder((64, 64, 128, 256, 512), SMALL)
    write_published(tmp_path, classifier_weights(), decoder, stereo=True)
    network = load_network("monodepth2", tmp_path)
    assert isinstance(network, MonodepthResNet)
    assert (network.layers, network.preprocess.size, network.max_depth) == (18, (64, 96), 540.0)
    image = torch.randn(2, 3, 64, 96, generator=seeded())
    with torch.inference_mode():
        features = F.pad(decoder_of_the_paper(decoder, network.encoder(image)), (1, 1, 1, 1), mode="reflect")
        raw = F.conv2d(features, decoder["decoder.10.conv.weight"], decoder["decoder.10.conv.bias"])[:, 0]
        expected = 5.4 / (0.01 + (10 - 0.01) / (1 + (-raw).exp()))
        torch.testing.assert_close(network(image).depth, expected, rtol=1e-4, atol=1e-5)
    source = NetworkChoice("", "monodepth2", (str(tmp_path),)).load(torch.device("cpu"))
    assert source.label == "ResNet18-Monodepth2"


def test_published_weights_of_single_images_need_a_scale(tmp_path: Path) -> None:
    write_published(tmp_path, classifier_weights(), published_decoder((64, 64, 128, 256, 512), SMALL))
    with pytest.raises(ValueError, match=r"no scale: declare .scale. \[m\] or .alignment."):
        load_network("monodepth2", tmp_path)
    image = torch.randn(1, 3, 64, 96, generator=seeded())

    def depth(**spec: Any) -> Tensor:
        with torch.inference_mode():
            result: Tensor = load_network("monodepth2", tmp_path, spec=spec)(image).depth
        return result

    units = depth(scale=1.0)
    torch.testing.assert_close(depth(scale=30.0), 30 * units)
    affine = {"kind": "affine", "scale": 20.0, "shift": 1.5}
    torch.testing.assert_close(depth(alignment=affine), 20 * units + 1.5)
    torch.testing.assert_close(depth(alignment={**affine, "kind": "inverse"}), 1 / (20 / units + 1.5))
    nearer = depth(scale=1.0, least=0.2, largest=10.0)
    torch.testing.assert_close(1 / nearer, 0.1 + (1 / units - 0.01) * (5 - 0.1) / (10 - 0.01), rtol=1e-4, atol=1e-5)
    with pytest.raises(FileNotFoundError, match=r"expected a folder with Monodepth2's encoder.pth and depth.pth"):
        load_network("monodepth2", tmp_path.parent, spec={"scale": 1.0})
    with pytest.raises(ValueError, match=r"disparity must be \(least, largest\)"):
        depth(scale=1.0, least=200.0)


def test_colours_are_renormalised(tmp_path: Path) -> None:
    """The stem on an image with ImageNet's normalisation equals the published stem on (x - .45) / .225, except within
    two pixels of the padded border."""
    import torchvision.models

    weights = classifier_weights()
    published = torchvision.models.resnet18(weights=None).eval()
    published.load_state_dict(weights)
    network = small()
    decoder = published_decoder(network.encoder.channels, SMALL)
    load_monodepth2(network, *write_published(tmp_path, weights, decoder))
    image = torch.rand(1, 3, 64, 64, generator=seeded())
    mean, std = (torch.tensor(v)[:, None, None] for v in (IMAGENET_MEAN, IMAGENET_STD))
    with torch.inference_mode():
        expected = published.bn1(published.conv1((image - 0.45) / 0.225))
        observed = network.encoder.bn1(network.encoder.conv1((image - mean) / std))
        torch.testing.assert_close(observed[..., 2:-2, 2:-2], expected[..., 2:-2, 2:-2], rtol=1e-4, atol=1e-4)
        difference = (observed - expected).abs()
        assert float(difference.max()) > 1e-3, "the padding is another colour"


def test_what_does_not_fit_is_refused_and_loads_nothing(tmp_path: Path) -> None:
    network = small()
    before = {key: value.clone() for key, value in network.state_dict().items()}
    decoder = published_decoder(network.encoder.channels, SMALL)
    encoder, depth = write_published(tmp_path, classifier_weights(), decoder)
    key = "decoder.2.conv.conv.bias"
    for change, message in (
        ({key: torch.full_like(decoder[key], torch.nan)}, "1 with NaN or infinity: levels.3.before.bias"),
        ({key: torch.zeros(9)}, r"1 of another shape: levels.3.before.bias is \(9,\), expected \(8,\)"),
        ({"mask.weight": torch.zeros(1)}, "1 unexpected: mask.weight"),
    ):
        torch.save(decoder | change, depth)
        with pytest.raises(CheckpointError, match=rf"depth.pth does not fit MonodepthResNet \(142 keys\): {message}"):
            load_monodepth2(network, encoder, depth)
    with pytest.raises(CheckpointError, match=r"20 missing: levels\.0\.after\.bias"):
        load_monodepth2(network, encoder, encoder)
    assert all(torch.equal(value, before[key]) for key, value in network.state_dict().items())
    with pytest.raises(ValueError, match=r"strides 'v1.5', got a network with 'v1'"):
        load_monodepth2(small(strides="v1"), encoder, depth)
    with pytest.raises(FileNotFoundError):
        load_monodepth2(network, tmp_path / "none.pth", depth)


@pytest.mark.parametrize("suffix", [".pth", ".safetensors"])
@pytest.mark.parametrize("half", [False, True])
def test_imagenet_from_a_file(tmp_path: Path, suffix: str, half: bool) -> None:
    """The encoder equals torchvision's classifier up to its pooling."""
    import torchvision.models

    weights = classifier_weights()
    published = torchvision.models.resnet18(weights=None).eval()
    if half:
        weights = {k: v.half() if v.is_floating_point() else v for k, v in weights.items()}
    published.load_state_dict(weights)
    save_checkpoint(tmp_path / f"w{suffix}", weights)
    network = MonodepthResNet.imagenet(tmp_path / f"w{suffix}", 18, decoder=SMALL, dropout=0.2).eval()
    assert {p.dtype for p in network.parameters()} == {torch.float32}
    assert network.levels[0].dropout.p == 0.2
    image = torch.randn(1, 3, 64, 64, generator=seeded())
    published.avgpool, published.fc = nn.Identity(), nn.Identity()
    with torch.inference_mode():
        torch.testing.assert_close(network.encoder(image)[-1].flatten(1), published(image))


def test_imagenet_counts_every_tensor(tmp_path: Path) -> None:
    weights = classifier_weights()

    def load(changed: Mapping[str, Tensor], layers: int = 18) -> MonodepthResNet:
        torch.save(dict(changed), tmp_path / "w.pth")
        return MonodepthResNet.imagenet(tmp_path / "w.pth", layers, decoder=SMALL)

    load({k: v for k, v in weights.items() if not k.endswith("num_batches_tracked")})  # like old files
    with pytest.raises(CheckpointError, match=r"w.pth does not fit ResNetEncoder \(120 keys\): 1 unexpected: extra"):
        load(weights | {"extra": torch.zeros(1)})
    with pytest.raises(CheckpointError, match="does not fit ResNetEncoder"):
        load(weights, 34)


def test_a_variance_beyond_half_precision(tmp_path: Path) -> None:
    """Stored as infinity, the variance would zero its channel, so it becomes 65504. Any other infinity is an error."""
    weights = classifier_weights()
    weights["bn1.running_var"][3] = 1e5
    half = {k: v.half() if v.is_floating_point() else v for k, v in weights.items()}
    assert torch.isinf(half["bn1.running_var"][3])
    torch.save(half, tmp_path / "w.pth")
    network = MonodepthResNet.imagenet(tmp_path / "w.pth", 18, decoder=SMALL)
    assert float(network.encoder.bn1.running_var[3]) == 65504
    half["bn1.running_mean"][0] = float("inf")
    torch.save(half, tmp_path / "w.pth")
    with pytest.raises(CheckpointError, match=r"NaN or infinity: bn1.running_mean"):
        MonodepthResNet.imagenet(tmp_path / "w.pth", 18, decoder=SMALL)
    weights["bn1.running_var"][3] = float("inf")  # in single precision the value does not overflow
    torch.save(weights, tmp_path / "w.pth")
    with pytest.raises(CheckpointError, match=r"NaN or infinity: bn1.running_var"):
        MonodepthResNet.imagenet(tmp_path / "w.pth", 18, decoder=SMALL)


def test_v1_strides_move_to_the_first_convolution() -> None:
    for strides, expected in (("v1.5", ((1, 1), (2, 2))), ("v1", ((2, 2), (1, 1)))):
        encoder = MonodepthResNet(50, strides=strides, decoder=SMALL).encoder
        for stage in (encoder.layer2, encoder.layer3, encoder.layer4):
            assert (stage[0].conv1.stride, stage[0].conv2.stride) == expected
        assert encoder.layer1[0].conv1.stride == encoder.layer1[0].conv2.stride == (1, 1)
        maps = encoder.eval()(torch.zeros(1, 3, 64, 64))
        assert [m.shape[-1] for m in maps] == [32, 16, 8, 4, 2]
    v1, v15 = small(strides="v1"), small()
    image = torch.randn(1, 3, 64, 64, generator=seeded())
    with torch.inference_mode():  # no bottlenecks, no difference
        assert torch.equal(v1(image).depth, v15(image).depth)


def test_load_network(tmp_path: Path) -> None:
    for layers in (18, 34):
        network = MonodepthResNet(layers, decoder=SMALL).eval()
        save_checkpoint(tmp_path / "w.pth", network)
        loaded = load_network("monodepth2", tmp_path / "w.pth", size=(64, 96), dropout=0.1)
        assert isinstance(loaded, MonodepthResNet)
        assert (loaded.layers, loaded.preprocess.size) == (layers, (64, 96))
        image = torch.randn(1, 3, 64, 96, generator=seeded())
        with torch.inference_mode():
            assert torch.equal(loaded(image).depth, network(image).depth)
    torch.save({"a": torch.zeros(1)}, tmp_path / "w.pth")
    with pytest.raises(ValueError, match=r"w.pth: not the weights of a MonodepthResNet: no .* \(6 such"):
        load_network("monodepth2", tmp_path / "w.pth")
    with pytest.raises(ValueError, match="ends in a ReLU"):
        load_network("fastdepth", tmp_path / "w.onnx", positive="softplus")

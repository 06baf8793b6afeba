"""BatchEnsemble against loops over the formula, its members as plain networks, and typical conversion errors."""

from __future__ import annotations

import copy
import pickle
import threading
from collections import OrderedDict
from concurrent.futures import ThreadPoolExecutor

import pytest
import torch
import torch.nn.functional as F
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import nn

from ufmstar_torch import UncertainDepth
from ufmstar_torch.frames.prediction import combine
from ufmstar_torch.models import (
    Backbone,
    BatchEnsemble,
    FastDepth,
    FastDepthWidths,
    MonodepthResNet,
    Preprocess,
    convert,
    with_head,
)
from ufmstar_torch.models.batch_ensemble import converted_layers
from ufmstar_torch.models.batch_layer import BatchLayer, Selection

N = 3


class Tiny(Backbone):
    """A backbone with a depthwise, a grouped and a 1x1 convolution and a batch norm."""

    def __init__(self):
        super().__init__()
        self.preprocess = Preprocess(size=(6, 8))
        self.feature_channels = 4
        self.stem = nn.Conv2d(3, 4, 3, padding=1, padding_mode="reflect", bias=False)
        self.norm = nn.BatchNorm2d(4)
        self.rest = nn.Sequential(nn.Conv2d(4, 4, 3, padding=1, groups=4), nn.ELU(), nn.Conv2d(4, 4, 1, groups=2))
        self.out = nn.Linear(4, 1)

    def features(self, image):
        return self.rest(self.norm(self.stem(image)))

    def depth(self, features):
        return F.softplus(self.out(features.movedim(1, -1)))[..., 0]


def tiny():
    """A network in eval mode with non-initial statistics, and its ensemble with different biases."""
    torch.manual_seed(0)
    network = with_head(Tiny(), "aleatoric").double()
    network(torch.rand(8, 3, 6, 8, dtype=torch.float64))
    ensemble = BatchEnsemble(network, N, std=0.4)
    with torch.no_grad():
        for layer in converted_layers(ensemble):
            if layer.bias is not None:
                layer.bias += torch.randn_like(layer.bias)
    return network.eval(), ensemble.eval()


def images(batch=2):
    return torch.rand(batch, 3, 6, 8, dtype=torch.float64, generator=torch.Generator().manual_seed(1))


def alone(layer, n):
    """The layer with member n for every image."""

    def call(x):
        layer.selection.members = torch.full((len(x),), n)
        try:
            return layer(x)
        finally:
            layer.selection.members = None

    return call


@settings(max_examples=25)
@given(
    groups=st.sampled_from([(1, 3, 2), (2, 4, 6), (4, 4, 4), (4, 4, 8)]),
    kernel=st.sampled_from([1, 3, (1, 3)]),
    padding=st.sampled_from([("zeros", 0), ("zeros", 1), ("zeros", "same"), ("reflect", 1), ("circular", 1)]),
    stride=st.integers(1, 2),
    dilation=st.integers(1, 2),
    bias=st.booleans(),
)
def test_a_convolution_is_the_formula(groups, kernel, padding, stride, dilation, bias):
    count, inputs, outputs = groups
    mode, amount = padding
    stride = 1 if amount == "same" else stride
    options = {"padding": amount, "padding_mode": mode, "stride": stride, "dilation": dilation, "groups": count}
    torch.manual_seed(0)
    plain = nn.Conv2d(inputs, outputs, kernel, bias=bias, **options).double()
    layer = convert(plain, N, std=0.5)
    x = torch.randn(2, inputs, 7, 9, dtype=torch.float64)
    for n in range(N):
        # W_n[o, i] = W[o, i] s_n[o] r_n[j], j the channel that weight i of o's group multiplies.
        weight = plain.weight.detach().clone()
        for o in range(outputs):
            for i in range(inputs // count):
                j = o // (outputs // count) * (inputs // count) + i
                weight[o, i] *= layer.s[n, o].item() * layer.r[n, j].item()
        member = copy.deepcopy(plain)
        member.weight = nn.Parameter(weight)
        torch.testing.assert_close(alone(layer, n)(x), member(x), rtol=1e-12, atol=1e-12)
        torch.testing.assert_close(layer.weight_of(n), weight, rtol=1e-14, atol=0)
        torch.testing.assert_close(layer.plain(n)(x), member(x), rtol=1e-12, atol=1e-12)


@pytest.mark.parametrize("shape", [(2, 5), (2, 4, 5), (2, 3, 4, 5)])
@pytest.mark.parametrize("bias", [True, False])
def test_a_linear_layer_is_the_formula(shape, bias):
    plain = nn.Linear(5, 6, bias=bias).double()
    layer = convert(plain, N, std=0.5)
    if bias:
        with torch.no_grad():
            layer.bias += torch.randn(N, 6)
    x = torch.randn(shape, dtype=torch.float64)
    for n in range(N):
        W = torch.einsum("oi,o,i->oi", plain.weight, layer.s[n], layer.r[n])
        expected = torch.einsum("oi,...i->...o", W, x) + (layer.bias[n] if bias else 0)
        torch.testing.assert_close(alone(layer, n)(x), expected, rtol=1e-12, atol=1e-12)
        torch.testing.assert_close(layer.plain(n)(x), expected, rtol=1e-12, atol=1e-12)


def test_a_layer_needs_its_ensemble():
    layer = convert(nn.Conv2d(3, 2, 3), N)
    with pytest.raises(RuntimeError, match="it selects the members"):
        layer(torch.zeros(1, 3, 6, 6))
    layer.selection.members = torch.zeros(2, dtype=torch.int64)
    with pytest.raises(ValueError, match=r"of 2 images .* got 6"):
        layer(torch.zeros(6, 3, 6, 6))


def test_autocast_does_not_widen_what_follows():
    layer = convert(nn.Conv2d(3, 2, 3), N)
    layer.selection.members = torch.zeros(1, dtype=torch.int64)
    with torch.autocast("cpu", torch.bfloat16):
        assert layer(torch.zeros(1, 3, 6, 6)).dtype == torch.bfloat16


class KeepsTwice(nn.Module):
    """Holds modules in a ModuleList and also in an unregistered dict, a tuple and an attribute. On such modules a
    published conversion had no effect."""

    def __init__(self):
        super().__init__()
        self.by_name = OrderedDict(a=nn.Conv2d(3, 4, 1), b=nn.Conv2d(4, 3, 1))
        self.layers = nn.ModuleList(self.by_name.values())
        self.pairs = [(self.layers[0], self.layers[1])]
        self.parts = nn.ModuleDict({"x": nn.Sequential(nn.Identity(), nn.Sequential(nn.Conv2d(3, 3, 1)))})
        self.again = self.layers[1]

    def forward(self, x):
        (first, second), *_ = self.pairs
        return self.parts["x"](self.again(self.by_name["a"](x))) + second(first(x))


def test_conversion_replaces_layers_wherever_they_are_kept():
    plain = KeepsTwice().double()
    before = copy.deepcopy(plain.state_dict())
    network = convert(plain, N, std=0.3)
    assert len(converted_layers(network)) == 3
    assert network.by_name["a"] is network.layers[0] is network.pairs[0][0]
    assert network.by_name["b"] is network.layers[1] is network.pairs[0][1] is network.again
    assert isinstance(network.again, BatchLayer)
    x = torch.randn(2, 3, 4, 4, dtype=torch.float64)
    network.again.selection.members = torch.tensor([0, 1])
    assert (network(x) - plain(x)).abs().max() > 0.01
    for key, value in plain.state_dict().items():  # the argument is unchanged and shares nothing with the copy
        assert torch.equal(value, before[key])
    assert not {p.data_ptr() for p in plain.parameters()} & {p.data_ptr() for p in network.parameters()}
    assert not converted_layers(plain)


class Standardised(nn.Conv2d):
    """A convolution that does not use its weight directly."""


def test_layers_that_compute_something_else_are_refused():
    for layer in (
        Standardised(3, 3, 1),
        nn.LazyConv2d(3, 1),
        nn.utils.parametrizations.weight_norm(nn.Conv2d(3, 3, 1)),
        nn.MultiheadAttention(4, 2),
    ):
        with pytest.raises(TypeError, match=r"1.* cannot be converted"):
            convert(nn.Sequential(nn.Conv2d(3, 3, 1), layer), N)
    network = nn.Sequential(nn.Linear(3, 3))
    network.more = [nn.Sequential(nn.Linear(3, 3))]  # neither trained nor saved
    with pytest.raises(ValueError, match="Sequential keeps a Linear that is not registered"):
        convert(network, N)


def test_fastdepth_and_monodepth2_are_converted_whole():
    fastdepth = FastDepth(FastDepthWidths.scaled(0.1), size=(32, 32))
    monodepth = MonodepthResNet(18, size=(64, 64))
    for network in (fastdepth, monodepth):
        expected = sum(isinstance(m, (nn.Conv2d, nn.Linear)) for m in network.modules())
        ensemble = BatchEnsemble(with_head(network, "aleatoric"), N, std=0.2).eval()
        assert len(converted_layers(ensemble)) == expected + 1  # the head's
        x = torch.rand(1, 3, 64, 64)
        with torch.no_grad():
            together = ensemble.distribution(x).depth
            for n in range(N):
                torch.testing.assert_close(ensemble.member(n)(x).depth, together[n : n + 1], rtol=1e-5, atol=1e-5)
                torch.testing.assert_close(ensemble.folded(n)(x).depth, together[n : n + 1], rtol=2e-4, atol=1e-4)
            assert together.var(0).mean() > 0


def test_a_member_is_its_part_of_the_batched_pass_and_its_folded_network():
    _, ensemble = tiny()
    x = images()
    together = ensemble.distribution(x)
    assert together.depth.shape == (2 * N, 6, 8)
    for n, member in enumerate(ensemble.all_members()):
        prediction, plain = member.distribution(x), ensemble.folded(n)
        assert not converted_layers(plain)
        assert {type(m) for m in plain.modules()} >= {nn.Conv2d, nn.Linear, nn.BatchNorm2d}
        for name in ("depth", "log_variance"):
            part = getattr(together, name)[2 * n : 2 * n + 2]
            torch.testing.assert_close(part, getattr(prediction, name), rtol=1e-12, atol=1e-12)
            torch.testing.assert_close(getattr(plain.distribution(x), name), part, rtol=1e-12, atol=1e-12)
        with torch.no_grad():
            for value in plain.parameters():
                value.zero_()  # independent of the ensemble
        assert torch.equal(member.distribution(x).depth, prediction.depth)
        assert torch.equal(ensemble.distribution(x, n).depth, prediction.depth)


@pytest.mark.parametrize("method", ["aleatoric", "evidential"])
def test_the_batched_pass_combines_its_members(method):
    aleatoric = method == "aleatoric"
    ensemble = tiny()[1] if aleatoric else BatchEnsemble(with_head(Tiny(), method).double(), N, std=0.3).eval()
    x = images()
    expected = combine([member(x) for member in ensemble.all_members()])
    combined = ensemble(x)
    torch.testing.assert_close(combined.depth, expected.depth, rtol=1e-12, atol=1e-12)
    torch.testing.assert_close(combined.aleatoric_variance, expected.aleatoric_variance, rtol=1e-11, atol=1e-12)
    torch.testing.assert_close(combined.epistemic_variance, expected.epistemic_variance, rtol=1e-9, atol=1e-12)
    assert combined.epistemic_variance.mean() > 1e-3


@pytest.mark.parametrize("batch", [3, 4, 7])
def test_a_batch_is_split_among_the_members(batch):
    _, ensemble = tiny()
    x = images(batch)
    depth = ensemble.distribution(x, repeat=False).depth
    turns = [b * N // batch for b in range(batch)]
    assert set(turns) == set(range(N))
    for b, n in enumerate(turns):
        torch.testing.assert_close(depth[b], ensemble.member(n)(x).depth[b], rtol=1e-12, atol=1e-12)


def test_gradients_are_those_of_the_formula():
    layer = convert(nn.Conv2d(4, 2, 3, groups=2).double(), 2, std=0.3)
    x = torch.randn(2, 4, 5, 5, dtype=torch.float64, requires_grad=True)
    layer.selection.members = torch.tensor([1, 0])

    def call(x, r, s, bias, weight):
        parameters = {"r": r, "s": s, "bias": bias, "shared.weight": weight}
        return torch.func.functional_call(layer, parameters, (x,))

    assert torch.autograd.gradcheck(call, (x, layer.r, layer.s, layer.bias, layer.shared.weight))


def test_members_alternate_and_share_everything():
    _, ensemble = tiny()
    pipeline = UncertainDepth(ensemble.all_members())
    assert sum(p.numel() for p in pipeline.parameters()) == sum(p.numel() for p in ensemble.parameters())
    K, x = torch.tensor([[8.0, 0, 4], [0, 8, 3], [0, 0, 1]]), images(1)
    for turn in range(4):
        assert torch.equal(pipeline(x, torch.eye(4), K).depth, ensemble.member(turn % N)(x).depth)


@pytest.mark.parametrize("moved", [lambda m: m.to(torch.float32), lambda m: m.to("meta"), copy.deepcopy, lambda m: m])
def test_members_stay_one_when_they_are_moved(moved):
    _, ensemble = tiny()
    expected = ensemble.member(1)(images()).depth
    networks = moved(nn.ModuleList(ensemble.all_members()))
    assert all(member.ensemble is networks[0].ensemble for member in networks)
    layers = converted_layers(networks)
    assert len(layers) == len(converted_layers(ensemble))
    assert len({id(layer.selection) for layer in layers}) == 1
    dtype, device = next(networks.parameters()).dtype, next(networks.parameters()).device
    x = images().to(device=device, dtype=dtype)
    assert networks[1](x).depth.device == device
    if device.type == "cpu":
        torch.testing.assert_close(networks[1](x).depth.double(), expected, rtol=1e-4, atol=1e-4)


def test_a_copy_or_pickle_has_its_own_selection():
    _, ensemble = tiny()
    x = images()
    for other in (copy.deepcopy(ensemble), pickle.loads(pickle.dumps(ensemble))):
        selections = {id(layer.selection) for layer in converted_layers(other)}
        assert len(selections) == 1
        assert selections != {id(layer.selection) for layer in converted_layers(ensemble)}
        assert torch.equal(other.member(2)(x).depth, ensemble.member(2)(x).depth)
    assert isinstance(copy.deepcopy(Selection()), Selection)


def test_threads_do_not_mix_members():
    _, ensemble = tiny()
    x = images()
    expected, barrier = [ensemble.member(n)(x).depth for n in range(N)], threading.Barrier(N)

    def right(n):
        barrier.wait()
        return all(torch.equal(ensemble.member(n)(x).depth, expected[n]) for _ in range(30))

    with ThreadPoolExecutor(N) as pool:
        assert all(pool.map(right, range(N)))


def test_an_error_ends_the_selection():
    _, ensemble = tiny()
    with pytest.raises(RuntimeError):
        ensemble.member(0)(torch.zeros(1, 5, 6, 8, dtype=torch.float64))
    assert converted_layers(ensemble)[0].selection.members is None

"""Samples of pixels on the CPU against the reference: the same pixels and the same bits."""

import pytest
import torch

from ufmstar_torch import UfMStar
from ufmstar_torch.kernels.cpu import sample as compiled
from ufmstar_torch.steps import sample as reference


@pytest.mark.parametrize("count", [1, 20, 63])
def test_the_fast_sample_is_that_of_the_reference(count):
    generator = torch.Generator().manual_seed(count)
    valid = torch.rand(4, 9, 7, generator=generator) < torch.tensor([1.0, 0.5, 0.05, 0.0])[:, None, None]
    for seed in range(5):
        found, expected = compiled.sample_pixels(valid, count, seed), reference.sample_pixels(valid, count, seed)
        assert torch.equal(found[0], expected[0])
        assert torch.equal(found[1], expected[1])


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("n", [1, 2, 1000])
def test_the_fast_statistics_are_those_of_the_reference_to_the_last_bit(n, dtype):
    generator = torch.Generator().manual_seed(n)
    values = torch.randn(3, 4, n, generator=generator, dtype=dtype)
    values[:, 1, ::2] = torch.nan
    values[:, 2] = torch.nan
    used, measured = torch.rand(2, 4, n, generator=generator)
    used[3] = 0
    arguments = list(values), used > 0.2, measured, torch.tensor([n, 3 * n, n + 1, 0])
    found, expected = compiled.sample_summary(*arguments), reference.sample_summary(*arguments)
    assert len(found[0]) == len(expected[0]) == 3
    torch.testing.assert_close(found[1], expected[1], rtol=4 * torch.finfo(dtype).eps, atol=0, equal_nan=True)
    pairs = [(found[2], expected[2])]
    for a, b in zip(found[0], expected[0], strict=True):
        pairs += [(getattr(a, name), value) for name, value in vars(b).items()]
    for other, value in pairs:
        assert other.dtype == value.dtype
        assert torch.equal(other.nan_to_num(-1), value.nan_to_num(-1))


def test_the_mean_of_the_variance_has_the_gradient_of_the_network():
    K = torch.tensor([[20.0, 0, 15.5], [0, 20.0, 11.5], [0, 0, 1]])
    aleatoric = torch.full((1, 24, 32), 0.1, requires_grad=True)
    mean = UfMStar().mean_uncertainty(torch.full((1, 24, 32), 2.0), torch.eye(4), K, aleatoric, pixels=10).mean
    mean.sum().backward()
    assert aleatoric.grad is not None
    torch.testing.assert_close(aleatoric.grad.sum(), torch.tensor(1.0))
    assert int((aleatoric.grad > 0).sum()) == 10

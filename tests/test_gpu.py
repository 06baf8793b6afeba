"""Tests that need a CUDA device: no synchronisation, many streams, constant memory, CUDA graphs. ``pytest -m gpu``.

The tests with the fixture ``backend`` test the kernels, also on the device.
"""

from __future__ import annotations

import copy

import pytest
import torch
from modules import same
from walks import SPGF, walks

import scenes
from ufmstar_torch import AnchorConfig, DepthPrediction, PosteriorConfig, UfMStar, UfMStarConfig, UncertainDepth
from ufmstar_torch.anchors import Anchors
from ufmstar_torch.frames.warnings import EVERY
from ufmstar_torch.runtime.capture import Captured

pytestmark = [
    pytest.mark.gpu,
    pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a CUDA device, torch sees none"),
]

FIXED = {"on_bad_frame": "skip", "initial_capacity": 256, "max_components": 256}


def frames(streams: int, count: int):
    """Depth, pose and intrinsics on the device, for the first frames of a walk and back again."""
    present = [tuple(v.cuda() for v in frame[:3]) for frame in walks(streams, 8)]
    present += present[::-1]
    return [present[i % len(present)] for i in range(count)]


@pytest.mark.filterwarnings("ignore:Synchronization debug mode is a prototype:UserWarning")
@pytest.mark.parametrize("growing", [False, True])
def test_a_thousand_frames_with_flat_memory_and_no_synchronisation_but_of_the_warnings(growing):
    settings = {"on_bad_frame": "skip", "initial_capacity": 8} if growing else FIXED
    ufm, inputs = UfMStar(UfMStarConfig(segment=SPGF, **settings)), frames(2, 16)
    for frame in inputs:
        ufm(*frame)
    torch.cuda.synchronize()
    before = torch.cuda.memory_allocated()
    try:
        for i in range(16, 1016):
            torch.cuda.set_sync_debug_mode("default" if (i + 1) % EVERY == 0 else "error")
            ufm(*inputs[i % 16])
    finally:
        torch.cuda.set_sync_debug_mode("default")
    torch.cuda.synchronize()
    assert torch.cuda.memory_allocated() <= before + 2**20
    assert ufm.mixture.components.min() > 4


def test_256_streams_equal_themselves_alone_and_leave_each_other_alone():
    ufm, inputs = UfMStar(UfMStarConfig(segment=SPGF)), [f[:3] for f in walks(4, 6)]
    alone, broken = UfMStar(UfMStarConfig(segment=SPGF)), UfMStar(UfMStarConfig(segment=SPGF))
    for depth, pose, K in inputs:
        many = [v.repeat(64, *[1] * (v.dim() - 1)).cuda() for v in (depth, pose, K)]
        other = many[0].clone()
        other[1] = torch.nan
        out = ufm(*many)
        out_alone = alone(depth.cuda(), pose.cuda(), K.cuda())
        out_broken = broken(other, *many[1:])
        for b in range(256):
            assert same(out.variance[b], out_alone.variance[b % 4])
            if b != 1:
                assert same(out.variance[b], out_broken.variance[b])


def test_the_graph_equals_the_step():
    ufm, inputs = UfMStar(UfMStarConfig(segment=SPGF, **FIXED)), frames(2, 12)
    for _ in range(EVERY - 1):  # the capture runs in the frame that checks for warnings
        ufm(*inputs[0])
    plain = copy.deepcopy(ufm)
    captured = Captured(ufm, *inputs[0])
    for i, frame in enumerate(inputs):
        if i == 8:
            ufm.reset([1])
            plain.reset([1])
        expected = plain(*frame)
        out = captured(*frame)
        assert same(out.variance, expected.variance)
    for name, value in plain.state_dict().items():
        assert same(ufm.state_dict()[name], value)


@pytest.mark.parametrize("size", [(224, 224), (518, 518)])
def test_large_images(size):
    depths, poses, K = scenes.sequence(3, *size, 0.03)
    gpu, cpu = UfMStar(), UfMStar()
    for depth, pose in zip(depths, poses, strict=True):
        inputs = torch.tensor(depth)[None].float(), torch.tensor(pose), torch.tensor(K)
        a, b = gpu(*(v.cuda() for v in inputs)), cpu(*inputs)
        torch.testing.assert_close(a.variance.cpu(), b.variance, rtol=1e-3, atol=1e-6, equal_nan=True)
    assert a.variance.shape == (1, *size)


def test_the_posterior_equals_the_cpu_s():
    """The posterior runs on the host; its input, the evidence of anchors, is computed on the device."""
    config = UfMStarConfig(segment=SPGF, anchors=AnchorConfig(), posterior=PosteriorConfig())
    gpu, cpu = UfMStar(config), UfMStar(config)
    generator = torch.Generator().manual_seed(0)
    for depth, pose, K in [f[:3] for f in walks(2, 5)]:
        v, u = (torch.randint(0, size, (2, 40), generator=generator) for size in depth.shape[1:])
        z = torch.stack([one[row, column] for one, row, column in zip(depth, v, u, strict=True)]) * 1.2
        anchors = Anchors(torch.stack([u, v], -1).to(depth), z, 1e-3 * z.square())
        a, b = (
            gpu(depth.cuda(), pose.cuda(), K.cuda(), anchors=anchors.to("cuda")),
            cpu(depth, pose, K, anchors=anchors),
        )
        for name in ("depth", "variance", "posterior_outlier"):
            found = getattr(a, name)
            assert found.is_cuda
            torch.testing.assert_close(found.cpu(), getattr(b, name), rtol=1e-3, atol=1e-5, equal_nan=True)
    assert (b.depth / depth).nanmedian() > 1.1


def test_networks_on_the_gpu_and_ufmstar_on_the_cpu():
    from test_pipeline import CONFIG, POSES, K, Scaled, image

    members = [Scaled(1.0), Scaled(1.1)]
    split = UncertainDepth(members, CONFIG, posterior=False, multiview_device="cpu").cuda()
    inputs = [(image(i).cuda(), POSES[i], K) for i in range(5)]
    outputs = list(split.stream(inputs))
    plain = UncertainDepth(members, CONFIG, posterior=False).cpu()
    for out, frame in zip(outputs, inputs, strict=True):
        expected = plain(*(v.cpu() for v in frame))
        assert out.variance.device.type == "cpu"
        torch.testing.assert_close(out.variance, expected.variance, rtol=1e-5, atol=1e-8, equal_nan=True)


class Wall(torch.nn.Module):
    """Predicts a wall at 2 m that is textured slightly."""

    def __init__(self):
        super().__init__()
        self.distance = torch.nn.Parameter(torch.tensor(2.0))

    def forward(self, image):
        return DepthPrediction(self.distance + 0.02 * image[:, 0])


def test_anchors_of_images_on_the_gpu_reach_ufmstar_on_the_cpu():
    texture = torch.randint(0, 256, (3, 96, 168), dtype=torch.uint8, generator=torch.Generator().manual_seed(0))
    K = torch.tensor([[100.0, 0, 64], [0, 100, 48], [0, 0, 1]])
    plain = UncertainDepth(Wall(), posterior=True)
    split = UncertainDepth(Wall(), posterior=True, multiview_device="cpu").cuda()
    split.warm_up((96, 128))
    used = 0
    for i in range(10):
        image, pose = texture[None, ..., 4 * i : 4 * i + 128].contiguous(), torch.eye(4)
        pose[0, 3] = 0.08 * i
        expected, out = plain(image, pose, K), split(image.cuda(), pose, K)
        used += int(expected.statistics.anchors_used.sum())
        for name in ("ufm_variance", "depth", "variance"):
            found = getattr(out, name)
            assert found.device.type == "cpu"
            torch.testing.assert_close(found, getattr(expected, name), rtol=1e-3, atol=1e-5, equal_nan=True)
    assert used > 100

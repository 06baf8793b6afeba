"""In-memory objects as input: models and pipelines of ``transformers``."""

from __future__ import annotations

import pytest
import torch
import transformers
from depth_anything_files import write_depth_anything, write_other
from modules import CONFIG
from PIL import Image
from torch import nn

from ufmstar_torch import UncertainDepth
from ufmstar_torch.models import Preprocess, from_hugging_face, wrap_network

IMAGES = torch.randint(0, 256, (2, 3, 48, 64), dtype=torch.uint8, generator=torch.Generator().manual_seed(0))
CAMERA = torch.tensor([[60.0, 0, 31.5], [0, 60, 23.5], [0, 0, 1]])


@pytest.mark.parametrize("architecture", ["depth_anything", "depth_pro", "dpt", "glpn", "zoedepth"])
def test_a_model_in_memory_is_its_checkpoint(tmp_path, architecture):
    folder = tmp_path / architecture
    published = architecture == "depth_anything"
    write_depth_anything(folder, "metric") if published else write_other(folder, architecture)
    stored = from_hugging_face(folder, kind="metric", **({} if published else {"size": (64, 64)}))
    model = transformers.AutoModelForDepthEstimation.from_pretrained(folder)
    network = wrap_network(model, preprocess=stored.preprocess)
    x, _ = stored.preprocess(IMAGES, CAMERA)
    with torch.no_grad():
        assert torch.equal(network(x).depth, stored(x).depth)
    assert network.max_depth == stored.max_depth


def test_a_pipeline_brings_its_image_processor(tmp_path):
    folder = write_depth_anything(tmp_path / "n", "metric")
    pipe = transformers.pipeline("depth-estimation", model=str(folder))
    network, stored = wrap_network(pipe), from_hugging_face(folder)
    assert network.preprocess == stored.preprocess
    assert wrap_network(pipe.model, preprocess=pipe.image_processor).preprocess == stored.preprocess
    image = IMAGES[0].permute(1, 2, 0).numpy()
    with torch.no_grad():
        depth = network(network.preprocess(image, CAMERA)[0]).depth
        expected = pipe(Image.fromarray(image))["predicted_depth"]
    torch.testing.assert_close(depth.mean(), expected.mean(), rtol=0.05, atol=0)
    networks = [pipe, pipe.model, pipe.model, network]
    options = [{}, {"preprocess": pipe.image_processor}, {"preprocess": network.preprocess}, {}]
    for member, keywords in zip(networks, options, strict=True):
        assert torch.equal(UncertainDepth(member, CONFIG, **keywords)(image, torch.eye(4), CAMERA).depth, depth)


def test_depth_pro_takes_the_cameras_focal_length(tmp_path):
    """Inverse depth [1/m] times fx/W, with or without the network's estimate of the field of view."""
    folder = write_other(tmp_path / "n", "depth_pro", use_fov_model=False)
    model = transformers.AutoModelForDepthEstimation.from_pretrained(folder)
    with pytest.raises(ValueError, match=r"not the field of view .*declare takes_intrinsics=True"):
        wrap_network(model)
    network = wrap_network(model, takes_intrinsics=True, preprocess=Preprocess(size=(64, 64)))
    x, K_net = network.preprocess(IMAGES, CAMERA)
    near, far = (network(x, K_net * torch.tensor([[f], [f], [1.0]])).depth for f in (1.0, 2.0))
    raw = model(pixel_values=x).predicted_depth[:, None] * 64 / float(K_net[0, 0])
    expected = 1 / nn.functional.interpolate(raw, (64, 64), mode="bilinear")[:, 0]
    inside = (near > 2e-4) & (near < 5e3)
    torch.testing.assert_close(near[inside], expected[inside])
    torch.testing.assert_close(far[inside], 2 * near[inside])
    with pytest.raises(ValueError, match=r"call network\(x, K\)"):
        network(x)


def test_other_tasks_and_relative_models_are_refused(tmp_path):
    pipe = transformers.pipeline("depth-estimation", model=str(write_depth_anything(tmp_path / "n", "relative")))
    with pytest.raises(ValueError, match=r"'relative', which is 'inverse': .*aligned\(alignment\) makes it metric"):
        wrap_network(pipe)
    pipe.task = "image-classification"
    with pytest.raises(TypeError, match="pipeline of the task depth-estimation, got 'image-classification'"):
        wrap_network(pipe)

"""Tiny Depth Anything checkpoints with random weights, as a user's directory holds them."""

from __future__ import annotations

import torch

MEAN, STD = (0.485, 0.456, 0.406), (0.229, 0.224, 0.225)


def lively(model, seed):
    """Random weights large enough for outputs that depend on the image."""
    generator = torch.Generator().manual_seed(seed)
    with torch.no_grad():
        for value in model.parameters():
            if value.dim() > 1:
                value.copy_(torch.randn(value.shape, generator=generator) * (2 / value[0].numel()) ** 0.5)
    return model.eval()


def write_depth_anything(folder, kind, seed=0, max_depth=20):
    """A Depth Anything V2 of 90 thousand weights with the published checkpoints' image processor."""
    import transformers

    backbone = transformers.Dinov2Config(
        hidden_size=32, num_hidden_layers=4, num_attention_heads=2, image_size=70, out_indices=[1, 2, 3, 4],
        reshape_hidden_states=False, apply_layernorm=True, patch_size=14,
    )  # fmt: skip
    config = transformers.DepthAnythingConfig(
        backbone_config=backbone, reassemble_hidden_size=32, neck_hidden_sizes=[8, 8, 16, 16], fusion_hidden_size=8,
        head_hidden_size=8, depth_estimation_type=kind, max_depth=max_depth if kind == "metric" else 1,
    )  # fmt: skip
    model = lively(transformers.DepthAnythingForDepthEstimation(config), seed)
    with torch.no_grad():
        model.head.conv3.weight *= 0.2  # the sigmoid of metric ones is not saturated,
        model.head.conv3.bias += 0.0 if kind == "metric" else 5.0  # and the ReLU of relative ones open
    model.save_pretrained(folder)
    transformers.DPTImageProcessor(
        size={"height": 518, "width": 518}, keep_aspect_ratio=True, ensure_multiple_of=14, resample=3,
        image_mean=list(MEAN), image_std=list(STD),
    ).save_pretrained(folder)  # fmt: skip
    return folder

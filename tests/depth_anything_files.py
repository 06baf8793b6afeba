"""Writes tiny checkpoints of ``transformers`` with random weights."""

from __future__ import annotations

import torch

MEAN, STD = (0.485, 0.456, 0.406), (0.229, 0.224, 0.225)


def lively(model, seed):
    """Random weights, large enough for the output to depend on the image."""
    generator = torch.Generator().manual_seed(seed)
    with torch.no_grad():
        for value in model.parameters():
            if value.dim() > 1:
                value.copy_(torch.randn(value.shape, generator=generator) * (2 / value[0].numel()) ** 0.5)
    return model.eval()


def write_depth_anything(folder, kind, seed=0, max_depth=20):
    """Write a Depth Anything V2 of 90 thousand weights, with the image processor of the published checkpoints."""
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


def write_other(folder, architecture, seed=0, **changes):
    """Write a tiny model of another architecture with its image processor, for images of 64 x 64. ``changes`` override
    its configuration."""
    import transformers

    neck = {"neck_hidden_sizes": [16, 16, 32, 32], "fusion_hidden_size": 16}
    vit = {"num_hidden_layers": 4, "hidden_size": 32, "num_attention_heads": 2, "intermediate_size": 37}
    dinov2 = {"model_type": "dinov2", "num_hidden_layers": 2, "hidden_size": 16, "num_attention_heads": 1}
    dinov2 |= {"patch_size": 4, "image_size": 16, "intermediate_size": 37}
    if architecture == "depth_pro":
        config = transformers.DepthProConfig(
            patch_size=16, fusion_hidden_size=16, intermediate_hook_ids=[1, 0], intermediate_feature_dims=[10, 8],
            scaled_images_ratios=[0.5, 1.0], scaled_images_overlap_ratios=[0.0, 0.2],
            scaled_images_feature_dims=[12, 12], image_model_config=dinov2, patch_model_config=dinov2,
            fov_model_config=dinov2, **{"use_fov_model": True, **changes},
        )  # fmt: skip
        model = lively(transformers.DepthProForDepthEstimation(config), seed)
        if model.fov_model is not None:
            with torch.no_grad():
                list(model.fov_model.parameters())[-1].fill_(50.0)  # about 50 degrees
        processor = transformers.DepthProImageProcessor(size={"height": 64, "width": 64})
    elif architecture == "zoedepth":
        backbone = transformers.BeitConfig(
            image_size=64, patch_size=16, out_features=["stage1", "stage2", "stage3", "stage4"],
            reshape_hidden_states=False, use_relative_position_bias=True, **vit,
        )  # fmt: skip
        config = transformers.ZoeDepthConfig(
            backbone_config=backbone, bottleneck_features=16, num_relative_features=8, num_attractors=[4, 2, 2, 1],
            bin_embedding_dim=8, bin_configurations=[{"n_bins": 8, "min_depth": 0.001, "max_depth": 10.0, "name": "x"}],
            **neck, **changes,
        )  # fmt: skip
        model = lively(transformers.ZoeDepthForDepthEstimation(config), seed)
        processor = transformers.ZoeDepthImageProcessor(size={"height": 64, "width": 64}, ensure_multiple_of=32)
    elif architecture == "dpt":
        config = transformers.DPTConfig(
            image_size=64, patch_size=16, backbone_out_indices=[0, 1, 2, 3], is_hybrid=False, **vit, **neck, **changes
        )
        model = lively(transformers.DPTForDepthEstimation(config), seed)
        processor = transformers.DPTImageProcessor(size={"height": 64, "width": 64})
    else:
        config = transformers.GLPNConfig(
            hidden_sizes=[8, 8, 16, 16], depths=[1, 1, 1, 1], num_attention_heads=[1, 1, 2, 2], decoder_hidden_size=8
        )
        model = lively(transformers.GLPNForDepthEstimation(config), seed)
        processor = transformers.GLPNImageProcessor(size={"height": 64, "width": 64}, do_normalize=False)
    model.save_pretrained(folder)
    processor.save_pretrained(folder)
    return folder

"""From light to a picture: exposure, the response of a display, and the effects of a small camera."""

from __future__ import annotations

import torch
from torch import Tensor

_GREY, _ADAPTATION, _SPARSE = 0.33, 0.5, 8  # target mean brightness, exponent of the exposure, step of sampled pixels
_SHOULDER = 0.65  # brightness from which highlights are compressed
_SOFT = 1 - _SHOULDER  # makes the slope continuous at the shoulder
_EXPOSURE_SPREAD, _VIGNETTE, _SHOT, _READ = 0.08, 0.25, 0.012, 0.006


def develop(color: Tensor, seed: int | None = None) -> Tensor:
    """[H, W, 3] uint8 sRGB of linear light [3, H, W], where 1 is white; ``seed`` of the sensor's exposure, vignetting
    and noise, None = none of them."""
    # The sum of a few pixels has the same order for any number of threads.
    mean = float(color[:, ::_SPARSE, ::_SPARSE].mean())
    light = (_GREY / max(mean, _GREY / 8)) ** _ADAPTATION * color
    if seed is not None:
        light = _sensed(light, seed)
    light = light.clamp_min(0)
    shown = torch.where(light < _SHOULDER, light, 1 - (1 - _SHOULDER) * torch.exp(-(light - _SHOULDER) / _SOFT))
    encoded = torch.where(shown <= 0.0031308, 12.92 * shown, 1.055 * shown.clamp_min(1e-6) ** (1 / 2.4) - 0.055)
    return (encoded * 255).round().clamp(0, 255).to(torch.uint8).permute(1, 2, 0).contiguous()


def _sensed(light: Tensor, seed: int) -> Tensor:
    """Exposure, blur, vignetting and noise of a lens and a sensor."""
    rng = torch.Generator().manual_seed(seed)
    _, height, width = light.shape
    draws = torch.randn(2, generator=rng)
    exposure = float(1 + _EXPOSURE_SPREAD * draws[0].clamp(-2, 2))
    strength = _VIGNETTE * float((0.5 + 0.25 * draws[1]).clamp(0, 1))
    noise = torch.randn(light.shape, generator=rng)
    blurred = _blurred(_blurred(light).transpose(1, 2)).transpose(1, 2)
    y = torch.linspace(-1, 1, height)[:, None]
    x = torch.linspace(-1, 1, width)
    shaded = exposure * blurred * (1 - strength * (x * x + y * y) / 2)
    return shaded + noise * (_SHOT * shaded.clamp_min(0).sqrt() + _READ)


def _blurred(light: Tensor) -> Tensor:
    """[C, H, W] blurred along rows."""
    before = torch.cat([light[..., :1], light[..., :-1]], dim=-1)
    after = torch.cat([light[..., 1:], light[..., -1:]], dim=-1)
    return (before + after + 6 * light) / 8

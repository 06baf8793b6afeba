"""docs/networks.md: the code blocks run in order, on small files with the page's names."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
import torch
from depth_anything_files import write_depth_anything, write_other
from onnx_files import small_network, write_fastdepth
from pages import blocks
from test_monodepth2 import classifier_weights, published_decoder, write_published
from torch import nn

from ufmstar_torch.models.depth_anything import DepthAnything
from ufmstar_torch.models.heads import UncertaintyNetwork
from ufmstar_torch.models.monodepth2 import DECODER_WIDTHS

PAGE = Path(__file__).resolve().parents[1] / "docs" / "networks.md"


def write_files(folder: Path) -> None:
    """Write small networks under the page's file names."""
    torch.manual_seed(0)
    write_fastdepth(folder / "fastdepth_nyu.onnx", small_network())
    weights = classifier_weights(50)
    half = {k: v.half() if v.is_floating_point() else v for k, v in weights.items() if not k.startswith("fc.")}
    torch.save(half, folder / "resnet50_v1.pth")
    write_published(folder, classifier_weights(18), published_decoder((64, 64, 128, 256, 512), DECODER_WIDTHS))
    network, image = nn.Conv2d(3, 1, 3, padding=1).eval(), torch.rand(1, 3, 64, 64)
    torch.jit.save(torch.jit.trace(network, image), str(folder / "network.ts"))
    torch.export.save(torch.export.export(network, (image,)), folder / "network.pt2")
    write_fastdepth(folder / "network.onnx", small_network())
    write_other(folder / "glpn-nyu", "glpn")
    write_depth_anything(folder / "Depth-Anything-V2-Metric-Indoor-Small-hf", "metric")
    write_depth_anything(folder / "Depth-Anything-V2-Small-hf", "relative")


def camera() -> dict[str, Any]:
    """The page's inputs: images, intrinsics and measured depth; the alignment is 0.05 x + 0.1 [1/m]."""
    images = torch.randint(0, 256, (2, 3, 60, 80), dtype=torch.uint8, generator=torch.Generator().manual_seed(0))
    K = torch.tensor([[70.0, 0, 39.5], [0, 70.0, 29.5], [0, 0, 1]], dtype=torch.float64)
    relative = DepthAnything.from_pretrained("Depth-Anything-V2-Small-hf")
    with torch.no_grad():
        depth = 1 / (0.05 * relative.raw(relative.preprocess.apply_image(images)) + 0.1)
    measured = torch.zeros_like(depth)
    measured[:, ::20, ::20] = depth[:, ::20, ::20]
    view = (torch.ones(60, 80), torch.ones(60, 80), torch.eye(4), K)
    return {"images": images, "K": K, "measured": measured, "frames": [view]}


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:`torch.jit:FutureWarning", "ignore:`torch.jit:DeprecationWarning")
def test_every_piece_of_code_runs(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    write_files(tmp_path)
    monkeypatch.chdir(tmp_path)
    scope = camera()
    codes = blocks(PAGE.read_text())
    for code in codes:
        exec(compile(code, PAGE.name, "exec"), scope)
    assert len(codes) >= 4
    printed = capsys.readouterr().out
    assert "140 tensors; left as they were: ('head.bias', 'head.weight')" in printed
    assert scope["depth"].shape == (2, 518, 518)
    assert float(scope["fit"].alignment.scale) == pytest.approx(0.05, rel=1e-4)
    assert scope["baseline"].epistemic_variance.mean() > 0
    assert isinstance(scope["single"].networks[0].network, UncertaintyNetwork)

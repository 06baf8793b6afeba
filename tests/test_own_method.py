"""The example of a method and a metric of one's own: its figures against loops by hand."""

from __future__ import annotations

import numpy as np
import own_method as example
import pytest
import torch

from ufmstar_torch.eval.sequences import open_sequence
from ufmstar_torch.models import NetworkSpec, build_network, save_trained

SPEC = NetworkSpec(widths=0.1, positive="softplus", size=(64, 96), preprocess="resize")


@pytest.mark.slow
def test_both_rows_are_judged(tmp_path, capsys):
    torch.manual_seed(0)
    network = build_network(SPEC).eval()
    save_trained(tmp_path / "net.safetensors", network, SPEC)
    tour = "tour:5?frames=3&size=64x96"
    result = example.main([tour, "--model", "trained", "--weights", str(tmp_path / "net.safetensors")])
    assert list(result) == ["UfM*", "a tenth"]
    assert capsys.readouterr().out.startswith("UfM* ")
    inside = pixels = 0
    errors = []
    for frame in open_sequence(tour):
        with torch.no_grad():
            image = torch.from_numpy(frame.image).permute(2, 0, 1)[None]
            x, _ = network.preprocess(image, torch.from_numpy(frame.intrinsics)[None].float())
            depth = network(x).depth[0].numpy()
        use = frame.depth > 0
        errors.append(np.square(depth - frame.depth)[use])
        inside += int((np.abs(depth - frame.depth)[use] <= 0.2 * depth[use]).sum())
        pixels += int(use.sum())
    assert result["a tenth"]["within 2 sigma"] == pytest.approx(inside / pixels, abs=1e-3)
    assert result["a tenth"]["rmse"] == pytest.approx(float(np.sqrt(np.concatenate(errors).mean())), rel=0.05)

"""The camera example of ``LiveDepth`` with a stand-in for the camera; the demonstration on board."""

from __future__ import annotations

import json
import time
from importlib.resources import files
from types import SimpleNamespace

import live_camera
import numpy as np
import onboard
import pytest
import torch
from demo_networks import write_members
from onnx_files import small_network, write_fastdepth
from quantise import quantise

from ufmstar_torch.eval.sequences import live as sources
from ufmstar_torch.eval.sequences.images import image_tensor
from ufmstar_torch.eval.tour import tour_sequence
from ufmstar_torch.models.trained import load_trained


def test_the_camera_is_shown(tmp_path, monkeypatch):
    shown, ticks = [], [100.0]
    weights = write_fastdepth(tmp_path / "net.onnx", small_network(), 224)

    class Capture:
        """A camera with grey images, and a SLAM that is never late."""

        def __init__(self, index):
            assert index == 2

        def isOpened(self):
            return True

        def read(self):
            time.sleep(0.01)
            ticks[0] += 0.01
            with (tmp_path / "poses.txt").open("a") as file:
                file.write(f"{ticks[0]} {ticks[0] / 10} 0 0 0 0 0 1\n")
            return True, np.full((96, 128, 3), 90, np.uint8)

        def release(self):
            shown.append("released")

    monkeypatch.setattr(live_camera.cv2, "VideoCapture", Capture)
    monkeypatch.setattr(live_camera.cv2, "imshow", lambda _, picture: shown.append(picture))
    monkeypatch.setattr(live_camera.cv2, "waitKey", lambda _: ord("q") if shown or ticks[0] > 130 else -1)
    monkeypatch.setattr(sources, "time", SimpleNamespace(time=lambda: ticks[0]))
    words = ("--weights", weights, "--trajectory", tmp_path / "poses.txt", "--intrinsics", 70, 70, 63.5, 47.5)
    counts = live_camera.main([*map(str, words), "--camera", "2"])
    assert counts.results >= 1
    assert shown[0].shape == (224, 224)
    assert shown[-1] == "released"


def test_a_quantised_network_is_close_to_it(tmp_path):
    pytest.importorskip("onnxruntime")
    network = load_trained(str(files("ufmstar_torch.models").joinpath("weights", "demo.safetensors")))[0]
    frames = tour_sequence(3, frames=4, size=(160, 224))
    images = [network.preprocess(image_tensor(frame), torch.eye(3)[None])[0] for frame in frames]
    graph = quantise(network, images[:3], tmp_path / "int8.onnx", threads=1)
    with torch.no_grad():
        expected, found = network(images[3]), graph(images[3])
    assert graph.preprocess == network.preprocess
    assert 1e-4 < float(((found.depth - expected.depth).abs() / expected.depth).median()) < 0.03
    ratio = found.aleatoric_variance / expected.aleatoric_variance
    assert 0.8 < float(ratio.median()) < 1.25
    assert (tmp_path / "int8.onnx").stat().st_size < sum(p.nbytes for p in network.parameters()) / 2
    with pytest.raises(ValueError, match="at least one input"):
        quantise(network, [], tmp_path / "none.onnx")


def test_low_aleatoric_and_high_disagreement():
    aleatoric, M = np.meshgrid(np.arange(4.0), np.arange(4.0))
    error = np.where((aleatoric <= 1) & (M > 2.25), 3.0, 1.0)
    usable = np.ones((4, 4), bool)
    contrast = onboard.Contrast(np.zeros((4, 4, 3), np.uint8), aleatoric, M, error, usable)
    assert onboard.contrast_figures([contrast]) == pytest.approx(
        {"share": 2 / 16, "rmse_high": 3, "rmse_low": 1, "aleatoric_sigma_high": np.sqrt(0.5), "disagreement_high": 3}
    )
    nothing = onboard.Contrast(contrast.image, aleatoric, M, error, ~usable)
    assert np.isnan(onboard.contrast_figures([nothing])["rmse_high"])


@pytest.mark.slow
def test_the_demo_on_board(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(onboard, "_WALKED", 40)
    monkeypatch.setattr(onboard, "_CALIBRATION", 2)
    weights = write_members(tmp_path / "three.safetensors")
    words = ["--seconds", "1", "--out", str(tmp_path / "out"), "--weights", str(weights)]
    onboard.main(words)
    out = capsys.readouterr().out
    for text in ("image to variance", "target, p99 below 50 ms", "int8, ONNX Runtime: depth shifted by"):
        assert text in out
    summary = json.loads((tmp_path / "out" / "summary.json").read_text())
    assert summary["realtime"]["images"] == 30
    files = {"onboard.png", "onboard_int8.onnx", "onboard_costs.png"}
    assert {file.name for file in (tmp_path / "out").iterdir()} >= files
    assert set(summary["costs"]["seconds"]) == {"camera and network", "UfM*", "rest"}
    assert len(summary["costs"]["times"]) == summary["realtime"]["results"]
    for more, error in (("--seconds", "0"), "--seconds must be at least 1"), ((), "--overwrite replaces it"):
        with pytest.raises(SystemExit):
            onboard.main([*words, *more])
        assert error in capsys.readouterr().err

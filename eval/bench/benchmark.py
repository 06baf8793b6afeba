"""``ufmstar bench``: the time of UfM*, alone, with anchors and with the posterior, beside a network's forward pass.

Every call of a frame follows the others in alternating order, so that a busy machine slows all of them alike.
"""

from __future__ import annotations

import copy
import json
import os
import subprocess
import sys
import tempfile
from collections.abc import Callable
from datetime import UTC, datetime
from importlib.util import find_spec
from typing import Any

import torch
from torch import Tensor, nn

from ufmstar_torch import UfMStarConfig, UncertainDepth
from ufmstar_torch.eval.bench.frames import BenchFrame, read_frames
from ufmstar_torch.eval.bench.memory import state_memory
from ufmstar_torch.eval.bench.settings import BenchSettings
from ufmstar_torch.eval.bench.timing import StagedStep, TimedCalls, most_threads, pinned_threads
from ufmstar_torch.eval.methods.ufm import UfM, UfMConfig
from ufmstar_torch.eval.run import machine
from ufmstar_torch.models import FastDepth, FastDepthWidths, MonodepthResNet, load_network
from ufmstar_torch.models.inference import Inference, runtime_of
from ufmstar_torch.models.network import DepthNetwork
from ufmstar_torch.prediction import DepthPrediction, infer

STEP, STAGED, MEAN, CORNERS, POSTERIOR, UFM = "UfM*", "stages", "mean", "UfM*, corners", "posterior, dense", "UfM"
POINTS = 100_000  # of UfM
_PIXELS = 1000  # of the image average
_SIZES = (224, 518)
_MULTIPLE = 32  # [px] of the sides that the reference networks take
_WARM_UP, _TORCH_FRAMES = 3, 3
_COMPILE = """
import json, time
from ufmstar_torch import UfMStar
start = time.perf_counter()
UfMStar().warm_up(({0}, {0}))
print(json.dumps(time.perf_counter() - start))
"""
Progress = Callable[[str], object]


def run_benchmark(options: BenchSettings, progress: Progress = lambda text: None) -> dict[str, Any]:
    """Measure what the options ask for.

    Args:
        options: see :class:`BenchSettings`.
        progress: is called with a description of what is measured next.

    Returns:
        The report: settings, versions, hardware, load, "results" per size and backend (:func:`_measure`), and
        "compilation" (:func:`measure_compilation`), None where it was not measured.

    Raises:
        ValueError: an option is out of range, or the sequence has too few frames.
        FileNotFoundError, ModuleNotFoundError: a file or a package is missing.
    """
    load, device = machine.load_average(), torch.device(machine.require_device(options.device))
    threads = most_threads() if options.threads is None else options.threads
    compilation = None
    if not options.skip_compile and device.type == "cpu":
        progress("compilation")
        compilation = measure_compilation()
    results = []
    with pinned_threads(threads):
        network = _network(options, device)
        for size in options.sizes or _SIZES if network is None else (0,):
            results += _of_size(options, network, size, device, progress)
    return {
        "schema": 2,
        "date": datetime.now(UTC).isoformat(timespec="seconds"),
        "versions": machine.versions(),
        "hardware": machine.hardware() | {"gpu": torch.cuda.get_device_name(device) if device.type == "cuda" else None},
        "load_average": {"before": load, "after": machine.load_average()},
        "settings": {
            "sequence": options.sequence, "device": str(device), "threads": threads, "history": options.history,
            "config": UfMStarConfig().to_dict(),
        },
        "compilation": compilation,
        "results": results,
    }  # fmt: skip


def measure_compilation(size: int = 64) -> dict[str, float]:
    """Seconds of ``warm_up`` in a new process: "cold_s" compiles, "warm_s" loads the compiled code from disk.

    Raises:
        subprocess.CalledProcessError: the process failed; its messages are on standard error.
    """
    with tempfile.TemporaryDirectory() as cache:
        command, environment = [sys.executable, "-c", _COMPILE.format(size)], os.environ | {"NUMBA_CACHE_DIR": cache}
        cold, warm = (
            json.loads(subprocess.run(command, env=environment, stdout=subprocess.PIPE, text=True, check=True).stdout)
            for _ in range(2)
        )
    return {"cold_s": cold, "warm_s": warm}


class _Replay(nn.Module):
    """Stands for the network in ``UncertainDepth``: returns a frame's prediction without computing it.

    Attributes:
        frame: whose prediction is returned next.
    """

    frame: BenchFrame

    def prepare(self, image: Tensor, intrinsics: Tensor) -> tuple[Tensor, Tensor]:
        """The network's input and its intrinsics."""
        return self.frame.network_input, self.frame.map_intrinsics

    def forward(self, x: Tensor) -> DepthPrediction:
        return self.frame.prediction


def _network(options: BenchSettings, device: torch.device) -> DepthNetwork | None:
    """The network of the options, as ``ufmstar run`` runs it; None without weights."""
    if options.weights is None:
        return None
    inference = Inference(runtime=options.runtime)
    spec = {} if options.spec is None else {"spec": options.spec}
    loaded = load_network(options.model, options.weights, **spec, **inference.options(options.model, device))
    return inference.ready(loaded, options.weights, device).to(device)


def _reference_networks(size: int, device: torch.device) -> dict[str, tuple[DepthNetwork, Tensor]]:
    """The paper's two architectures with random weights, as they run fastest in torch, and their inputs: FastDepth
    (with the widths of its published weights), and ResNet50-Monodepth2 where torchvision is installed."""
    side = max(2 * _MULTIPLE, _MULTIPLE * round(size / _MULTIPLE))
    networks: dict[str, DepthNetwork] = {"FastDepth": FastDepth(FastDepthWidths.pruned()).eval().folded()}
    if find_spec("torchvision") is not None:
        networks["ResNet50-Monodepth2"] = MonodepthResNet().eval()
    image = torch.rand(1, 3, side, side).to(device)
    return {name: (one.to(device, memory_format=torch.channels_last), image) for name, one in networks.items()}


def _of_size(
    options: BenchSettings, network: DepthNetwork | None, size: int, device: torch.device, progress: Progress
) -> list[dict[str, Any]]:
    """The results of one size of depth map, by every backend."""
    what = f"{size} x {size}" if network is None else options.model
    progress(f"{what}: frames, and {options.history} of them before the clock starts")
    count = options.history + _WARM_UP + options.frames
    frames = read_frames(options.sequence, count, network=network, size=size, device=device)
    models, ufm = _models(device), UfM(UfMConfig(max_points=POINTS), device=device)
    for frame in frames[: options.history]:
        for model in models.values():
            _run(model, frame)
        _baseline(ufm, frame)
    results = []
    for backend in options.backends:
        progress(f"{what}: backend {backend}")
        timed = min(options.frames, _TORCH_FRAMES) if backend == "torch" else options.frames
        chosen = frames[options.history : options.history + _WARM_UP + timed]
        copies = {name: copy.deepcopy(model) for name, model in models.items()}
        for model in copies.values():
            model.ufm.config = model.ufm.config.replace(backend=backend)
        results.append(_measure(copies, copy.deepcopy(ufm), network, chosen, backend, device))
    return results


def _models(device: torch.device) -> dict[str, UncertainDepth]:
    """What is timed of UfM*, each with a state of its own; with anchors where OpenCV is installed."""
    config = UfMStarConfig()
    models = {name: UncertainDepth(_Replay(), config) for name in (STEP, STAGED, MEAN)}
    if find_spec("cv2") is not None:
        models[CORNERS] = UncertainDepth(_Replay(), config.replace(anchored=True), anchors="corners")
        models[POSTERIOR] = UncertainDepth(_Replay(), config, posterior=True, anchors="dense")
    for model in models.values():
        model.preprocess = model.networks[0].prepare
        model.to(device)
    return models


def _run(model: UncertainDepth, frame: BenchFrame) -> Any:
    """One frame, up to the variance or to the posterior's maps."""
    model.networks[0].frame = frame
    out = model(frame.image, frame.pose, frame.intrinsics)
    return out.ufm.posterior() if model.ufm.config.posterior else out


def _baseline(ufm: UfM, frame: BenchFrame) -> Any:
    prediction = frame.prediction
    variances = prediction.aleatoric_variance, prediction.epistemic_variance
    return ufm(prediction.depth, frame.pose, frame.map_intrinsics, *variances)


def _measure(
    models: dict[str, UncertainDepth], ufm: UfM, network: DepthNetwork | None, frames: list[BenchFrame], backend: str,
    device: torch.device,
) -> dict[str, Any]:  # fmt: skip
    """Time every call on every frame.

    Returns:
        "rows": by name the spread of its times [ms]; "ratios": of each over the first network's forward pass of the
        same frame; "stages" of a step; "memory" of the state; "components", "segments" and "anchors" of the last frame;
        what the frames and networks are.
    """
    height, width = frames[0].prediction.depth.shape[-2:]
    references = {} if network is not None else _reference_networks(height, device)
    staged = StagedStep(models[STAGED].ufm, device)

    def average(frame: BenchFrame) -> Any:
        model = models[MEAN]
        model.networks[0].frame = frame
        return model.mean_uncertainty(frame.image, frame.pose, frame.intrinsics, pixels=min(_PIXELS, height * width))

    calls: dict[str, Callable[[BenchFrame], Any]] = {
        name: (lambda frame, one=one, x=x: _forward(one, x, frame)) for name, (one, x) in references.items()
    }
    if network is not None:
        calls["network"] = lambda frame: _forward(network, frame.network_input, frame)
    calls |= {name: (lambda frame, m=model: _run(m, frame)) for name, model in models.items() if name != MEAN}
    calls |= {f"mean of {_PIXELS} pixels": average, f"UfM, {POINTS} points": lambda frame: _baseline(ufm, frame)}
    timed, results = TimedCalls(), {}
    for frame in timed.frames(frames, warm_up=_WARM_UP):
        results = timed.call(calls, frame, device=device)
    first = next(iter(calls))
    rows = {name: timed.times.spread(name) for name in calls if name != STAGED}
    anchored = results.get(CORNERS)
    return {
        "size": [height, width],
        "backend": backend,
        "frames": len(frames) - _WARM_UP,
        "network": {first: runtime_of(network, "float32")} if network is not None else {n: "torch" for n in references},
        "rows": rows,
        "ratios": {name: timed.times.ratio(name, first) for name in rows if name not in ("network", *references)},
        **staged.summary(warm_up=_WARM_UP),
        "memory": {name: state_memory(models[name].ufm) for name in (STEP, CORNERS, POSTERIOR) if name in models},
        "segments": int(results[STEP].ufm.statistics.segments),
        "anchors": None if anchored is None else int(anchored.ufm.statistics.anchors_used),
    }


def _forward(network: DepthNetwork, x: Tensor, frame: BenchFrame) -> DepthPrediction:
    with torch.inference_mode():
        return infer(network, x, frame.map_intrinsics)

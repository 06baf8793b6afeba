"""The paper's "System demonstration": a quantised FastDepth with an aleatoric head, live, among objects of many sizes.

UfM* runs in real time on two cores, and its disagreement is high where the aleatoric variance is low. The folder OUT
gets a table, a picture, and the cumulative costs.

    python examples/onboard.py --seconds 120 --out OUT
"""

from __future__ import annotations

import argparse
import math
import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import nullcontext
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from cumulative import CounterLog, EnergyReadings, cumulative_costs, draw_cumulative, read_power
from numpy.typing import NDArray
from quantise import quantise

from ufmstar_torch import models
from ufmstar_torch.config import UfMStarConfig
from ufmstar_torch.eval.bench.energy import CPU, EnergyMeter
from ufmstar_torch.eval.commands.terminal import Bars
from ufmstar_torch.eval.engine.files import to_json, write_json_atomic
from ufmstar_torch.eval.engine.progress import Progress, warm_up_command
from ufmstar_torch.eval.engine.realtime import RealTime
from ufmstar_torch.eval.report.style import save_figure
from ufmstar_torch.eval.report.text import number, realtime_table
from ufmstar_torch.eval.run.colours import ERROR_MAP, ColourScale, robust_range
from ufmstar_torch.eval.run.folder import FolderError, FolderKind, output_folder
from ufmstar_torch.eval.run.machine import hardware, load_average, share_threads, versions
from ufmstar_torch.eval.run.panels import DECADES, Bar, GridRow, Panel, draw_grid
from ufmstar_torch.eval.sequences.frame import Frame, FrameSequence, in_memory
from ufmstar_torch.eval.sequences.ground_truth import truth_at
from ufmstar_torch.eval.sequences.images import image_tensor
from ufmstar_torch.eval.tour import tour_sequence
from ufmstar_torch.live import LiveDepth
from ufmstar_torch.models.load import load_network
from ufmstar_torch.models.network import DepthNetwork
from ufmstar_torch.models.trained import load_trained
from ufmstar_torch.uncertain_depth import UncertainDepth

FPS = 30.0
GRAPH, PICTURE, COSTS = "onboard_int8.onnx", "onboard.png", "onboard_costs.png"
FOLDER = FolderKind("examples/onboard.py", "demonstration", "summary.json", (GRAPH, PICTURE, COSTS))
_PATH, _WALKED = 900, 300  # frames of the whole path at walking pace, and of the part that is walked back and forth
_CALIBRATION = 24  # images of another tour, for the ranges of the activations
_SIZES = {(160, 224): (160, 224)}  # size of the images by that of the network's input; default: half of VGA
_HALF_VGA = (240, 320)
_TARGET_MS, _TARGET_LOST = 50.0, 0.01
_ROWS, _MARKED = 4, np.array([0, 213, 255])
Report = Callable[[Progress], None]


@dataclass(frozen=True, eq=False)
class Contrast:
    """The maps [h, w] of a frame: the network's sigma, sqrt(M) and |error| [m], and the pixels with ground truth."""

    image: NDArray[np.uint8]
    aleatoric_sigma: NDArray[np.float32]
    disagreement: NDArray[np.float32]
    error: NDArray[np.float32]
    usable: NDArray[np.bool_]

    @property
    def confident(self) -> NDArray[np.bool_]:
        """True where the network's variance is in the lower half of the frame's."""
        limit = np.quantile(self.aleatoric_sigma[self.usable], 0.5) if self.usable.any() else -math.inf
        return self.usable & (self.aleatoric_sigma <= limit)

    @property
    def contradicted(self) -> NDArray[np.bool_]:
        """True where the network is confident and the disagreement is in the upper quarter of the frame's."""
        limit = np.quantile(self.disagreement[self.usable], 0.75) if self.usable.any() else math.inf
        return self.confident & (self.disagreement > limit)


def run_onboard(
    out: Path, weights: Path, seconds: float, seed: int, progress: Report, power: Path | None = None
) -> dict[str, Any]:
    """Run live at 30 images/s in the rendered rooms of a seed, then evaluate the frames and draw the picture.

    Args:
        out: folder for the quantised graph and the picture.
        weights: file of ``ufmstar train``, whose first network is quantised; or a FastDepth (.onnx).
        seconds: duration of the live run [s].
        seed: of the rooms.
        progress: receives the progress.
        power: log of an external meter (``cumulative.read_power``), which must be complete when the run ends; None =
            the computer's own counters, if there are any.

    Raises:
        FileNotFoundError, ValueError, ModuleNotFoundError: the network cannot be loaded or quantised.
    """
    network, description = _network(weights, out, seed)
    h, w = network.preprocess.size or _HALF_VGA
    way = tour_sequence(seed, frames=_PATH, size=_SIZES.get((h, w), _HALF_VGA), style="scales")
    part = replace(way, entries=way.entries[:_WALKED])
    sequence = in_memory(part, lambda done: progress(Progress("rooms", done, _WALKED)))
    config = UfMStarConfig(on_bad_frame="skip")
    warm_up_command(config, progress)
    model = UncertainDepth(network, config, posterior=False, check_poses=0)
    summary = {
        "network": description,
        **_live(model, sequence, seconds, progress, power),
        "load_average": load_average(),
    }
    contrasts = _contrasts(UncertainDepth(network, config, posterior=False, check_poses=0), sequence)
    if contrasts:
        summary["contrast"] = contrast_figures(contrasts)
        draw_contrasts(out / PICTURE, contrasts)
    return summary


def _network(weights: Path, out: Path, seed: int) -> tuple[DepthNetwork, dict[str, Any]]:
    """The network, and its description with the depth shift of quantisation."""
    threads = torch.get_num_threads()
    if weights.suffix == ".onnx":
        return load_network("fastdepth", weights, threads=threads), {"file": weights.name, "threads": threads}
    network = load_trained(weights)[0]
    size = network.preprocess.size or _HALF_VGA
    others = tour_sequence(seed + 1, frames=2 * _CALIBRATION, size=size, style="mixed")
    inputs = [_input(network, frame) for frame in others]
    graph = quantise(network, inputs[::2], out / GRAPH, threads=threads)
    with torch.no_grad():
        pairs = [(network(x).depth, graph(x).depth) for x in inputs[1::2]]
    shift = torch.cat([((b - a).abs() / a).flatten() for a, b in pairs])
    levels = torch.tensor([0.5, 0.99])
    shifts = dict(zip(("median", "p99"), shift.quantile(levels).tolist(), strict=True))
    return graph, {"file": weights.name, "quantised": "int8, ONNX Runtime", "threads": threads, "depth_shift": shifts}


def _input(network: DepthNetwork, frame: Frame) -> torch.Tensor:
    return network.preprocess(image_tensor(frame), torch.from_numpy(frame.intrinsics)[None])[0]


def _live(
    model: UncertainDepth, sequence: FrameSequence, seconds: float, progress: Report, power: Path | None
) -> dict[str, Any]:
    """Feed the walk, forwards and backwards, at 30 images/s: "realtime", the figures of :class:`RealTime`, and "costs",
    the cumulative ones."""
    frames, times, total = list(sequence), RealTime(model), round(seconds * FPS)
    there_and_back = [*range(len(frames)), *range(len(frames) - 2, 0, -1)]

    counters = _counters() if power is None else ""
    logged = nullcontext() if isinstance(counters, str) else counters
    with LiveDepth(model, times.take, frames[0].intrinsics) as live, logged:
        started = time.perf_counter()
        for n in range(total):
            time.sleep(max(0.0, started + n / FPS - time.perf_counter()))
            frame = frames[there_and_back[n % len(there_and_back)]]
            live.push_pose(n / FPS, frame.T_world_cam)
            live.push_image(n / FPS, frame.image)
            if n % round(FPS) == 0:
                progress(Progress("live", n, total))
        live.wait_idle()
        progress(Progress("live", total, total))
    readings = _logged(power) if power is not None else counters
    readings = readings.readings if isinstance(readings, CounterLog) else readings
    costs = cumulative_costs(times, readings) if len(times.finished) > 1 else {}
    return {"realtime": times.summary(live.statistics), "costs": costs}


def _counters() -> CounterLog | str:
    """The log of this computer's counters, or why it has none."""
    meter = EnergyMeter()
    return meter.missing.get(CPU) or CounterLog(meter)


def _logged(power: Path) -> EnergyReadings | str:
    """The log of an external meter, or why it cannot be used: the other figures of the run remain."""
    try:
        return read_power(power, time.time() - time.perf_counter())
    except (OSError, ValueError) as error:
        return " ".join(str(error).split())


def _contrasts(model: UncertainDepth, sequence: FrameSequence) -> list[Contrast]:
    """The maps of every fifth frame after the 30th; [] if the network predicts no variance."""
    found = []
    for n, frame in enumerate(sequence):
        out = model(image_tensor(frame), frame.T_world_cam, frame.intrinsics)
        aleatoric = out.aleatoric
        if aleatoric is None:
            return []
        if n % 5 or n < 30:
            continue
        depth = out.depth[0].numpy()
        truth = truth_at(frame, out.intrinsics[0].numpy(), depth.shape)
        assert truth is not None
        usable = (truth > 0) & (out.measured[0].numpy() > 0.5) & np.isfinite(out.variance[0].numpy())
        image = image_tensor(frame)[0].permute(1, 2, 0).numpy()
        roots = (aleatoric[0].sqrt().numpy(), np.nan_to_num(out.disagreement[0].sqrt().numpy()))
        found.append(Contrast(image, *roots, np.abs(depth - truth), usable))
    return found


def contrast_figures(contrasts: list[Contrast]) -> dict[str, float]:
    """RMSE [m] where the network is confident, at high disagreement and elsewhere; the network's sigma and sqrt(M) [m]
    at high disagreement; and the share of pixels with high disagreement."""
    high = [c.contradicted for c in contrasts]
    low = [c.confident & ~c.contradicted for c in contrasts]

    def rms(name: str, masks: list[NDArray[np.bool_]]) -> float:
        values = np.concatenate([getattr(c, name)[mask] for c, mask in zip(contrasts, masks, strict=True)])
        return float(np.sqrt(np.square(values, dtype=np.float64).mean())) if values.size else math.nan

    return {
        "share": int(np.sum(high)) / max(int(np.sum([c.usable for c in contrasts])), 1),
        "rmse_high": rms("error", high),
        "rmse_low": rms("error", low),
        "aleatoric_sigma_high": rms("aleatoric_sigma", high),
        "disagreement_high": rms("disagreement", high),
    }


def draw_contrasts(path: Path, contrasts: list[Contrast]) -> None:
    """Draw one frame from each quarter of the walk: the one with the most contradicted pixels."""
    parts = [part for part in np.array_split(np.arange(len(contrasts)), _ROWS) if part.size]
    chosen = [max((contrasts[n] for n in part), key=lambda c: int(c.contradicted.sum())) for part in parts]
    maps = [value for c in chosen for value in (c.aleatoric_sigma, c.disagreement, c.error)]
    high = robust_range(maps, from_zero=True)[1]
    scale = ColourScale(high / 10**DECADES, high, ERROR_MAP, logarithmic=True)  # M would be black beside the error
    rows = []
    for index, c in enumerate(chosen):
        marked = c.image.copy()
        if marked.shape[:2] == c.error.shape:
            marked[c.contradicted] = (0.4 * marked[c.contradicted] + 0.6 * _MARKED).astype(np.uint8)
        shown = (c.aleatoric_sigma, c.disagreement, c.error)
        panels = [Panel(c.image), *(Panel(scale.rgb(values)) for values in shown), Panel(marked)]
        rows.append(GridRow(f"{index + 1}", [], panels))
    rows[0] = rows[0].captioned(["image", "σ, aleatoric", "√M, disagreement", "|error|", "A low and M high"])
    height, width = chosen[0].error.shape
    title = "Disagreement is high where the aleatoric variance is low"
    draw_grid(path, rows, [Bar("σ, √M and |error| [m]", scale, 1, 3)], aspect=height / width, title=title, words=0.4)


def onboard_table(summary: Mapping[str, Any]) -> str:
    """The real-time table, its target, and the contrast of disagreement."""
    measured, network = summary["realtime"], summary["network"]
    lines = [realtime_table(measured)]
    latency = measured["latency_ms"] or {}
    met = latency.get("p99", math.inf) < _TARGET_MS and (measured["lost_share"] or 0) < _TARGET_LOST
    words = f"p99 below {_TARGET_MS:g} ms and less than {100 * _TARGET_LOST:g} % lost at 30 images/s"
    lines.append(f"target, {words}: {'met' if met else 'missed'} (load average {number(summary['load_average'])})")
    if shift := network.get("depth_shift"):
        lines.append(
            f"{network['quantised']}: depth shifted by {100 * shift['median']:.2g} % in the median, "
            f"{100 * shift['p99']:.2g} % at most for 99 % of the pixels"
        )
    if contrast := summary.get("contrast"):
        m = {name: number(value) for name, value in contrast.items()}
        lines.append(
            f"where the aleatoric variance is low: RMSE {m['rmse_high']} m at high disagreement "
            f"({100 * contrast['share']:.0f} % of the pixels; aleatoric sigma {m['aleatoric_sigma_high']} m, sqrt(M) "
            f"{m['disagreement_high']} m), {m['rmse_low']} m elsewhere"
        )
    costs = summary.get("costs") or {}
    if costs:
        lines.append(_cost_line(costs))
    files = ["summary.json", *([PICTURE] if contrast else []), *([COSTS] if costs else [])]
    return "\n".join([*lines, f"{summary['out']}: {', '.join(files)}"])


def _cost_line(costs: Mapping[str, Any]) -> str:
    """The time and energy of the parts of a live run."""
    seconds = ", ".join(f"{name} {number(values[-1])} s" for name, values in costs["seconds"].items())
    if "joules" not in costs:
        return f"time: {seconds}; energy is not measurable here: {costs['not_measurable']}"
    joules = ", ".join(f"{name} {number(values[-1])} J" for name, values in costs["joules"].items())
    return f"time: {seconds}; energy: {joules}"


def main(words: Sequence[str] | None = None) -> dict[str, Any]:
    """Run the demonstration, write its folder, and print its table. Returns the content of summary.json."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=Path("ufmstar_onboard"), help="folder for the results")
    packaged = Path(models.__file__).parent / "weights" / "demo.safetensors"
    weights_help = "of `ufmstar train`, whose first network is quantised; or a FastDepth (.onnx)"
    parser.add_argument("--overwrite", action="store_true", help="replace an earlier demonstration in that folder")
    parser.add_argument("--weights", type=Path, default=packaged, help=weights_help)
    parser.add_argument("--seconds", type=float, default=120.0, help="duration of the walk [s]")
    parser.add_argument("--seed", type=int, default=100_003, help="of the rooms")
    power_help = "log of an external power meter: CSV with the columns time (seconds since 1970) and power (W)"
    parser.add_argument("--power", type=Path, help=power_help)
    chosen = parser.parse_args(words)
    if not 1 <= chosen.seconds < math.inf:
        parser.error(f"--seconds must be at least 1, got {chosen.seconds}")
    share_threads()
    about = {"out": str(chosen.out), "settings": {name: str(value) for name, value in vars(chosen).items()}}
    try:
        folder = output_folder(chosen.out, FOLDER, about, overwrite=chosen.overwrite)
        with folder, Bars() as bars:
            measured = run_onboard(chosen.out, chosen.weights, chosen.seconds, chosen.seed, bars.show, chosen.power)
            if measured["costs"]:
                save_figure(draw_cumulative(measured["costs"]), chosen.out / COSTS)
            facts = {"program": FOLDER.program} | about | measured | {"hardware": hardware(), "versions": versions()}
            summary: dict[str, Any] = to_json(facts)
            write_json_atomic(chosen.out / FOLDER.manifest, summary)
    except FolderError as error:
        parser.error(str(error))
    print(onboard_table(summary))
    return summary


if __name__ == "__main__":
    main()

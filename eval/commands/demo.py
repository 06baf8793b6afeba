"""``ufmstar demo``: the suite ``demo`` on a rendered tour, with nothing but the installed package.

Small networks that come with the package predict depth. They were trained on rooms like the first ones of the tour; the
last room has other sizes and textures.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from importlib.resources import as_file, files
from pathlib import Path
from time import perf_counter
from typing import TYPE_CHECKING, Any

from ufmstar_torch.eval.commands.options import UsageError, as_dict, reader

if TYPE_CHECKING:
    import torch

    from ufmstar_torch.eval.engine.judge import RowFigures
    from ufmstar_torch.eval.engine.networks import NetworkSource
    from ufmstar_torch.eval.engine.progress import Progress

_WEIGHTS = ("weights", "demo.safetensors")


@dataclass(frozen=True, kw_only=True)
class DemoOptions:
    """The method on rendered rooms, without data or weights.

    Walks through rendered rooms with small depth networks that come with the package, compares their own variance with
    UfM's and UfM*'s, and saves pictures. Nothing else is needed; a minute on two cores.

    Attributes:
        out: folder for the results
        overwrite: replace an earlier demo there
        frames: number of frames of the walk through the rooms
        seed: of the rooms; the networks were trained on others
        weights: other trained networks (.safetensors of `ufmstar train`); with --onboard also a FastDepth (.onnx,
            .tflite)
        onboard: live instead, as on a small robot: one network, quantised, at 30 images/s among things of many sizes
        seconds: of --onboard
        device: cpu, cuda or cuda:N
        threads: number of CPU threads; default: all cores, with --onboard but one
        debug: show tracebacks
    """

    out: Path = Path("ufmstar_demo")
    overwrite: bool = False
    frames: int = 72
    seed: int = 100_003
    weights: Path | None = None
    onboard: bool = False
    seconds: float = 120.0
    device: str = "cpu"
    threads: int | None = None
    debug: bool = False

    def __post_init__(self) -> None:
        if self.frames < 2:
            raise ValueError(f"--frames must be at least 2, got {self.frames}: one view has nothing to disagree with")
        if self.seed < 0:
            raise ValueError(f"--seed must be at least 0, got {self.seed}")
        if not 1 <= self.seconds < float("inf"):
            raise ValueError(f"--seconds must be at least 1, got {self.seconds}")
        if self.onboard and self.device != "cpu":
            raise ValueError(f"--onboard runs on the CPU, got --device {self.device}")


read = reader(DemoOptions, "ufmstar demo")


def main(options: DemoOptions) -> int:
    """Run the demo, and print its table; the exit code."""
    from ufmstar_torch.eval.commands.terminal import Bars
    from ufmstar_torch.eval.report.text import demo_explanation, demo_table, onboard_table
    from ufmstar_torch.eval.run.folder import FolderError

    try:
        with Bars() as bars:
            summary = (run_onboard_demo if options.onboard else run_demo)(options, bars.show)
    except (FileNotFoundError, FolderError) as error:
        raise UsageError(error) from error
    if options.onboard:
        print(onboard_table(summary))
        return 0
    print(demo_table(summary), demo_explanation(summary), sep="\n\n")
    return 0


def run_demo(options: DemoOptions, progress: Callable[[Progress], None] = lambda _: None) -> dict[str, Any]:
    """Evaluate the suite on the tour and leave pictures, mixture and summary in a folder; the content of summary.json.
    ``progress`` is called at the start of each stage and after every step of it.

    Raises:
        FolderError: the folder contains other files, or an earlier demo and ``overwrite`` is off.
        FileNotFoundError, CheckpointError: the networks cannot be loaded.
        ValueError: the networks predict no variance.
        OSError: the results cannot be written.
    """
    import torch

    from ufmstar_torch.config import AnchorConfig, PosteriorConfig, UfMStarConfig
    from ufmstar_torch.eval.engine.evaluate import Judge, evaluate_sequence
    from ufmstar_torch.eval.engine.progress import Progress
    from ufmstar_torch.eval.engine.warm_up import warm_up_command
    from ufmstar_torch.eval.methods.method import UFM, UFM_STAR
    from ufmstar_torch.eval.methods.suite import suite_named
    from ufmstar_torch.eval.report.demo import DEMO_FILES, ROWS, DemoFrames, surface_kinds, write_pictures
    from ufmstar_torch.eval.report.text import demo_names
    from ufmstar_torch.eval.run.files import to_json, write_json_atomic
    from ufmstar_torch.eval.run.folder import FolderKind, OutputFolder, remover
    from ufmstar_torch.eval.run.summary import versions
    from ufmstar_torch.eval.sequences.frame import in_memory
    from ufmstar_torch.eval.tour import make_tour, tour_sequence

    started = perf_counter()
    device = torch.zeros((), device=options.device).device
    networks, size, network = _networks(options.weights, device)
    members = network["members"]
    kind = FolderKind(program="ufmstar demo", noun="demo", manifest="summary.json", clear=remover(*DEMO_FILES))
    OutputFolder.open(options.out, kind, {}, overwrite=options.overwrite).close()
    tour: dict[str, Any] = {"seed": options.seed, "style": "mixed", "frames": options.frames, "size": size}
    config = UfMStarConfig(anchors=AnchorConfig(), posterior=PosteriorConfig())
    warm_up_command(config, device, lambda done, total: progress(Progress("kernels", done, total)), dense=True)
    progress(Progress("rooms", 0, options.frames))
    sequence = in_memory(tour_sequence(**tour), lambda done: progress(Progress("rooms", done, options.frames)))
    suite = suite_named("demo")
    names = {row.slug: name for row, name in zip(suite.rows[: 5 if members > 1 else 4], ROWS, strict=False)}
    rooms = make_tour(options.seed, "mixed")
    frames = DemoFrames(names, [surface_kinds(rooms, frame) for frame in sequence])
    results = evaluate_sequence(
        sequence,
        [row for row in suite.rows if row.slug in names],
        Judge(dict.fromkeys(suite.bases, networks), device),
        sinks=[frames],
        progress=progress,
    )
    shown = demo_names(members)
    progress(Progress("pictures", 0, 1))
    curves = {shown[names[one.row.slug]].strip(): _own_curves(one) for one in results}
    title = f"ufmstar demo: {options.frames} frames, seed {options.seed}"
    summary = {
        "program": kind.program,
        "out": str(options.out),
        "settings": {name: value for name, value in as_dict(options).items() if name not in ("threads", "debug")},
        "tour": tour,
        "network": network,
        "methods": {names[one.row.slug]: _figures(one, frames.state_bytes(names[one.row.slug])) for one in results},
        "surfaces": frames.by_kind(),
        "components": frames.count(UFM_STAR),
        "points": frames.count(UFM),
        "versions": versions(),
        "outputs": write_pictures(options.out, frames.panels, curves, frames.ufm_star, title),
        "seconds": perf_counter() - started,
    }
    write_json_atomic(options.out / "summary.json", summary)
    progress(Progress("pictures", 1, 1))
    plain: dict[str, Any] = to_json(summary)
    return plain


def run_onboard_demo(options: DemoOptions, progress: Callable[[Progress], None] = lambda _: None) -> dict[str, Any]:
    """Run ``--onboard`` into the folder; the content of summary.json. Raises FolderError, FileNotFoundError: as
    :func:`run_demo`; ValueError, ModuleNotFoundError: as ``run_onboard``."""
    from ufmstar_torch.eval.bench.onboard import GRAPH, PICTURE, run_onboard
    from ufmstar_torch.eval.run.files import to_json, write_json_atomic
    from ufmstar_torch.eval.run.folder import FolderKind, OutputFolder, remover
    from ufmstar_torch.eval.run.machine import hardware, share_threads
    from ufmstar_torch.eval.run.summary import versions

    if options.threads is None:
        share_threads()
    kind = FolderKind(
        program="ufmstar demo --onboard", noun="demo", manifest="summary.json", clear=remover(GRAPH, PICTURE)
    )
    OutputFolder.open(options.out, kind, {}, overwrite=options.overwrite).close()
    with _weights(options.weights) as file:
        measured = run_onboard(options.out, file, options.seconds, options.seed, progress)
    settings = {name: value for name, value in as_dict(options).items() if name not in ("debug", "frames", "device")}
    about = {"program": kind.program, "out": str(options.out), "settings": settings}
    summary: dict[str, Any] = to_json(about | measured | {"hardware": hardware(), "versions": versions()})
    write_json_atomic(options.out / "summary.json", summary)
    return summary


def _networks(weights: Path | None, device: torch.device) -> tuple[NetworkSource, tuple[int, int], dict[str, Any]]:
    """The demo's networks, the size (h, w) of their input, and what the summary says about them. Raises ValueError:
    they predict no variance."""
    from ufmstar_torch.eval.engine.load import sha256
    from ufmstar_torch.eval.engine.networks import NetworkSource
    from ufmstar_torch.models.trained import load_trained, read_info
    from ufmstar_torch.networks_in_turn import NetworksInTurn

    with _weights(weights) as file:
        info, members, digest = read_info(file), load_trained(file), sha256(file)
    if info.spec.method == "depth":
        raise ValueError("the demo needs networks with a variance of their own (an aleatoric or evidential head)")
    source = NetworkSource(NetworksInTurn(members, preprocess=members[0].preprocess), device, {})
    about = {"file": info.path.name, "sha256": digest, "members": len(members), "spec": info.spec.to_dict()}
    return source, info.spec.size, about | {"training": info.info}


def _figures(result: RowFigures, state_bytes: int) -> dict[str, Any]:
    """A row of the table: figures, median times [ms] and the bytes of its state."""
    ms = result.ms
    uncertainty_ms = ms.get("anchors", 0.0) + ms["uncertainty"] if result.state else None
    return {
        "figures": result.figures,
        "network_ms": ms["network"],
        "uncertainty_ms": uncertainty_ms,
        "state_bytes": state_bytes,
    }


def _own_curves(result: RowFigures) -> dict[str, Any]:
    """The curves of a row but for those that depend on other rows (``RowJudge``)."""
    return {name: values for name, values in result.curves.items() if ":" not in name}


@contextmanager
def _weights(path: Path | None) -> Iterator[Path]:
    """The file with the networks: the user's, or the package's own wherever that is installed. Raises
    FileNotFoundError: it is not there."""
    if path is not None:
        if not path.is_file():
            raise FileNotFoundError(f"--weights: no such file: {path}")
        yield path
        return
    packaged = files("ufmstar_torch.models").joinpath(*_WEIGHTS)
    if not packaged.is_file():
        raise FileNotFoundError(f"the package was installed without {'/'.join(_WEIGHTS)}; --weights FILE names another")
    with as_file(packaged) as file:
        yield file

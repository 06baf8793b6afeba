"""``ufmstar demo``: the suite ``demo`` on rendered rooms, with the installed package alone.

It is ``ufmstar eval`` with the package's small networks, on two kinds of rooms: homes like those on which the networks
were trained, and a larger hall with other textures.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from ufmstar_torch import models
from ufmstar_torch.eval.commands import evaluate
from ufmstar_torch.eval.commands.errors import usage_errors
from ufmstar_torch.eval.commands.options import File, Flag, MachineOptions, as_dict, reader, require_least
from ufmstar_torch.eval.commands.terminal import Bars

_WEIGHTS = ("weights", "demo.safetensors")
_COSTS = "onboard_costs.png"
_WALK = 150  # frames of a whole walk; the first --frames of them are used, so that consecutive frames overlap
_ROOMS = {"unfamiliar": "hall", "familiar": "home"}  # style by data set


@dataclass(frozen=True, kw_only=True)
class DemoOptions(MachineOptions):
    """The method on rendered rooms, without data or weights.

    Walks through rendered rooms with small depth networks that come with the package, compares their own variance with
    UfM's and UfM*'s, and makes the report of an evaluation. Nothing else is needed; one to two minutes on two cores.

    Attributes:
        out: Write the results to this folder.
        overwrite: Replace an earlier demo there.
        frames: Each of the two walks has this many frames.
        seed: The rooms are drawn with this seed; the networks were trained on others.
        weights: Use another ensemble (.safetensors of `ufmstar train`); with --onboard any of its networks, or a
            FastDepth (.onnx).
        onboard: Run live, as on a small robot: one quantised network, 30 images/s, things of many sizes.
        seconds: With --onboard, walk this long [s].
        power: With --onboard, take the energy from this log of an external power meter, a CSV file with the columns
            time (seconds since 1970) and power (W) (default: the computer's own counters, if there are any).
        device: Run on cpu, cuda or cuda:N.
        threads: Use this many CPU threads (default: all cores, with --onboard all but one).
    """

    out: Path = Path("ufmstar_demo")
    overwrite: Flag = False
    frames: int = 36
    seed: int = 100_003
    weights: File = None
    onboard: Flag = False
    seconds: float = 120.0
    power: File = None

    def __post_init__(self) -> None:
        require_least(self, seed=0)
        if not 2 <= self.frames <= _WALK:
            raise ValueError(f"--frames must be 2 to {_WALK}, got {self.frames}")
        if not 1 <= self.seconds < float("inf"):
            raise ValueError(f"--seconds must be at least 1, got {self.seconds}")
        if self.power is not None and not self.onboard:
            raise ValueError("--power goes with --onboard")
        if self.onboard and self.device != "cpu":
            raise ValueError(f"--onboard runs on the CPU, got --device {self.device}")


read = reader(DemoOptions, "ufmstar demo")


def main(options: DemoOptions) -> int:
    """Run the demo, and print its table; the exit code."""
    from ufmstar_torch.eval.report.page import PAGE
    from ufmstar_torch.eval.run.folder import FolderError

    with usage_errors(FileNotFoundError, FolderError):
        file = options.weights or Path(models.__file__).parent.joinpath(*_WEIGHTS)
        if not file.is_file():
            missing = f"the package was installed without {'/'.join(_WEIGHTS)}; --weights FILE names another"
            raise FileNotFoundError(f"--weights: no such file: {file}" if options.weights else missing)
        if options.onboard:
            return _onboard(options, file)
        code = evaluate.main(evaluate.read(_words(options, file)))
    if (page := options.out / PAGE).is_file():
        print(f"open {page} in a browser")
    return code


def _words(options: DemoOptions, weights: Path) -> list[str]:
    """The arguments of ``ufmstar eval``."""
    threads = [] if options.threads is None else ["--threads", str(options.threads)]
    roots = [f"{name}=tour:{options.seed}?style={style}&frames={_WALK}" for name, style in _ROOMS.items()]
    networks = [f"aleatoric=trained:{weights}#0", f"ensemble=trained:{weights}"]
    return [
        *("--suite", "demo", "--root", *roots, "--frames", f":{options.frames}", "--network", *networks),
        *("--out", str(options.out), "--device", options.device, *threads),
        "--overwrite" if options.overwrite else "--resume",
    ]


def _onboard(options: DemoOptions, weights: Path) -> int:
    """Run ``--onboard``, write its folder, and print its table. Returns the exit code."""
    from ufmstar_torch.eval.bench.onboard import GRAPH, PICTURE, run_onboard
    from ufmstar_torch.eval.engine.files import to_json, write_json_atomic
    from ufmstar_torch.eval.report.efficiency import draw_cumulative
    from ufmstar_torch.eval.report.style import save_figure
    from ufmstar_torch.eval.report.text import onboard_table
    from ufmstar_torch.eval.run.folder import FolderKind, output_folder
    from ufmstar_torch.eval.run.machine import hardware, share_threads, versions

    if options.threads is None:
        share_threads()
    kind = FolderKind("ufmstar demo --onboard", "demo", "summary.json", (GRAPH, PICTURE, _COSTS))
    with output_folder(options.out, kind, {}, overwrite=options.overwrite), Bars() as bars:
        measured = run_onboard(options.out, weights, options.seconds, options.seed, bars.show, options.power)
        if measured["costs"]:
            save_figure(draw_cumulative(measured["costs"]), options.out / _COSTS)
    settings = {name: value for name, value in as_dict(options).items() if name not in ("frames", "device")}
    about = {"program": kind.program, "out": str(options.out), "settings": settings}
    summary: dict[str, Any] = to_json(about | measured | {"hardware": hardware(), "versions": versions()})
    write_json_atomic(options.out / "summary.json", summary)
    print(onboard_table(summary))
    return 0

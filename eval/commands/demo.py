"""``ufmstar demo``: the suite ``demo`` on rendered rooms, with the installed package alone.

It is ``ufmstar eval`` with the package's small networks, on two kinds of rooms: homes like those on which the networks
were trained, and a larger hall with other textures.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from ufmstar_torch import models
from ufmstar_torch.eval.commands import evaluate
from ufmstar_torch.eval.commands.options import File, Flag, MachineOptions, reader, require_least
from ufmstar_torch.eval.commands.terminal import usage_errors

_WEIGHTS = ("weights", "demo.safetensors")
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
        weights: Use another ensemble (.safetensors of `ufmstar train`).
        threads: Use this many CPU threads (default: all cores).
    """

    out: Path = Path("ufmstar_demo")
    overwrite: Flag = False
    frames: int = 36
    seed: int = 100_003
    weights: File = None

    def __post_init__(self) -> None:
        require_least(self, seed=0)
        if not 2 <= self.frames <= _WALK:
            raise ValueError(f"--frames must be 2 to {_WALK}, got {self.frames}")


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
        *(["--overwrite"] if options.overwrite else []),
    ]

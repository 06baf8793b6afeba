"""``ufmstar demo``: the main job with nothing but the installed package.

A camera walks through rendered rooms. Small depth networks that come with the package, trained on other rooms of
the same kind, predict depth; the last room looks and measures like none of them, so there is an uncertainty to find.
UfM and UfM* judge the same predictions, and the table says how well.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from importlib.resources import as_file, files
from pathlib import Path
from time import perf_counter
from typing import Any

import numpy as np
import torch

from ufmstar_torch.eval.demo_methods import ENSEMBLE, NETWORK, UFM, UFM_STAR, Comparison, Tally
from ufmstar_torch.eval.demo_options import FRAMES, OUT, SEED
from ufmstar_torch.eval.demo_pictures import FILES, DemoPanel, panel, write_pictures
from ufmstar_torch.eval.demo_report import names
from ufmstar_torch.eval.files import to_json, write_json_atomic
from ufmstar_torch.eval.ground_truth import truth_at
from ufmstar_torch.eval.run import Progress
from ufmstar_torch.eval.run_source import sha256
from ufmstar_torch.eval.sequences.frame import Frame, Sequence
from ufmstar_torch.eval.summary import versions
from ufmstar_torch.eval.tour import make_tour, tour_sequence
from ufmstar_torch.models.trained import TrainedInfo, load_trained, read_info
from ufmstar_torch.ufmstar import UfMStar

PROGRAM = "ufmstar demo"
# Of "mixed" tours: what the networks were trained on, and what they never saw.
KINDS = {"home": "familiar", "hall": "unfamiliar"}
STYLE = "mixed"
SHEET_ROWS = 6
_WEIGHTS = ("weights", "demo.safetensors")
_SUMMARY = "summary.json"


@dataclass(frozen=True)
class DemoOptions:
    """What to show.

    Attributes:
        out: folder for everything that is written.
        frames: of the tour.
        seed: of the rooms; the networks were trained on others.
        weights: trained networks (``save_trained``); None = those of the package.
        device: "cpu", "cuda", ...
        overwrite: replace an earlier demo in ``out``.

    Raises:
        ValueError: a number is out of range.
    """

    out: Path = OUT
    frames: int = FRAMES
    seed: int = SEED
    weights: Path | None = None
    device: str = "cpu"
    overwrite: bool = False

    def __post_init__(self) -> None:
        if self.frames < 2:
            raise ValueError(f"--frames must be at least 2, got {self.frames}: one view has nothing to disagree with")
        if self.seed < 0:
            raise ValueError(f"--seed must be at least 0, got {self.seed}")


class OutputError(ValueError):
    """The output folder cannot be used as asked; the message says what to do."""


def run_demo(options: DemoOptions, progress: Callable[[Progress], None] = lambda _: None) -> dict[str, Any]:
    """Walk through the tour and leave pictures, mixture and summary in a folder.

    Args:
        options: what to show.
        progress: called at the start of each stage and after every step of it.

    Returns:
        What summary.json holds; ``demo_report`` makes a table of it.

    Raises:
        OutputError: the folder holds something else, or an earlier demo and ``overwrite`` is off.
        FileNotFoundError, CheckpointError: the networks cannot be loaded.
        ValueError: the device is not there, or the networks state no variance.
        OSError: the results cannot be written.
    """
    started = perf_counter()
    device = _device(options.device)
    _prepare(options.out, overwrite=options.overwrite)
    with _weights(options.weights) as file:
        info, members = read_info(file), load_trained(file)
        digest = sha256(file)
    size = info.spec.size
    sequence = tour_sequence(options.seed, frames=options.frames, size=size, style=STYLE, device=device)
    frames, kinds = _render(sequence, device, progress), room_kinds(sequence, options.seed)
    comparison = Comparison(members, device)
    tally, panels = _walk(comparison, frames, kinds, progress)
    summary = {
        "program": PROGRAM,
        "out": str(options.out),
        "settings": asdict(options),
        "tour": {"seed": options.seed, "style": STYLE, "frames": len(sequence), "size": info.spec.size},
        "network": _network(info, digest, len(members)),
        "methods": _methods(comparison, tally),
        "rooms": tally.by_kind(),
        "components": int(comparison.ufm_star.mixture.components.sum()),
        "points": int(comparison.ufm.points.sum()),
        "versions": versions(),
    }
    progress(Progress("pictures", 0, 1, None, 0))
    shown = names(len(members))
    metrics = {shown[method].strip(): values for method, values in tally.overall().items()}
    title = f"ufmstar demo: {len(sequence)} frames, seed {options.seed}"
    outputs = write_pictures(options.out, panels, metrics, comparison.ufm_star, title)
    summary |= {"outputs": outputs, "seconds": perf_counter() - started}
    write_json_atomic(options.out / _SUMMARY, summary)
    progress(Progress("pictures", 1, 1, None, 0))
    plain: dict[str, Any] = to_json(summary)
    return plain


def room_kinds(sequence: Sequence, seed: int) -> list[str]:
    """Of every frame, whether the camera stands in a familiar or an unfamiliar room."""
    tour = make_tour(seed, STYLE)
    positions = (torch.from_numpy(entry.T_world_cam[:3, 3]) for entry in sequence.entries)
    return [KINDS[tour.style_at(position)] for position in positions]


def sheet_rows(kinds: list[str], rows: int = SHEET_ROWS) -> list[int]:
    """Frames to show: half of them in each kind of room, spread evenly, familiar ones first.

    Not the very first frame: nothing has been compared by then.
    """
    chosen: list[int] = []
    present = [kind for kind in KINDS.values() if kind in kinds]
    for kind in present:
        there = [index for index, found in enumerate(kinds) if found == kind and index > 0]
        share = rows // len(present)
        spread = np.linspace(0, len(there) - 1, share + 1).round().astype(int)[1:]
        chosen += [there[position] for position in sorted(set(spread.tolist()))] if there else []
    return chosen


def _walk(
    comparison: Comparison, frames: list[Frame], kinds: list[str], progress: Callable[[Progress], None]
) -> tuple[Tally, list[DemoPanel]]:
    """All frames by all methods, with their figures and the rows of the contact sheet."""
    comparison.take(frames[0])  # libraries set themselves up at the first call, which does not count
    comparison.restart()
    tally = Tally(comparison.methods, [kind for kind in KINDS.values() if kind in kinds])
    rows, panels = sheet_rows(kinds), {}
    progress(Progress("frames", 0, len(frames), None, 0))
    for index, frame in enumerate(frames):
        compared = comparison.take(frame)
        depth = compared.estimates[NETWORK].depth
        truth = truth_at(frame, compared.intrinsics.double().numpy(), (depth.shape[0], depth.shape[1]))
        assert truth is not None
        assert frame.image is not None
        tally.add(compared, torch.from_numpy(truth), kinds[index])
        if index in rows:
            panels[index] = panel(f"frame {index}", kinds[index], frame.image, compared, truth)
        components = int(comparison.ufm_star.mixture.components.sum())
        progress(Progress("frames", index + 1, len(frames), components, 0))
    return tally, [panels[row] for row in rows]


def _render(sequence: Sequence, device: torch.device, progress: Callable[[Progress], None]) -> list[Frame]:
    """All frames. Meanwhile UfM*'s kernels are compiled, which takes some twenty seconds on the very first run."""
    progress(Progress("rooms", 0, len(sequence), None, 0))
    frames = [sequence[index] for index in range(2)]
    with ThreadPoolExecutor(1) as beside:
        compiled = beside.submit(_compile, frames, device)
        for index in range(2, len(sequence)):
            frames.append(sequence[index])
            progress(Progress("rooms", index + 1, len(sequence), None, 0))
        progress(Progress("kernels", 0, 1, None, 0))
        compiled.result()
    progress(Progress("kernels", 1, 1, None, 0))
    return frames


def _compile(frames: list[Frame], device: torch.device) -> None:
    """UfM* on two frames with their true depth, whose segments match, so that every kernel is called."""
    ufm_star = UfMStar().to(device)
    for frame in frames:
        depth = torch.from_numpy(frame.depth)[None].to(device)
        pose, K = torch.from_numpy(frame.T_world_cam), torch.from_numpy(frame.intrinsics)
        ufm_star(depth, pose, K, torch.full_like(depth, 0.01))


def _methods(comparison: Comparison, tally: Tally) -> dict[str, Any]:
    """The rows of the table: figures, times and memory."""
    ms, state = tally.median_ms(), comparison.state_bytes()
    curves = tally.overall()
    return {
        method: {
            "figures": curves[method].compute(),
            "network_ms": ms[ENSEMBLE if method == ENSEMBLE else NETWORK],
            "uncertainty_ms": ms[method] if method in (UFM, UFM_STAR) else None,
            "state_bytes": state[method],
        }
        for method in tally.methods
    }


def _network(info: TrainedInfo, digest: str, members: int) -> dict[str, Any]:
    return {
        "file": info.path.name,
        "sha256": digest,
        "members": members,
        "spec": info.spec.to_dict(),
        "training": info.info,
    }


@contextmanager
def _weights(path: Path | None) -> Iterator[Path]:
    """The file with the networks: the user's, or the package's own wherever that is installed.

    Raises:
        FileNotFoundError: it is not there.
    """
    if path is not None:
        if not path.is_file():
            raise FileNotFoundError(f"--weights: no such file: {path}")
        yield path
        return
    own = files("ufmstar_torch.models").joinpath(*_WEIGHTS)
    if not own.is_file():
        raise FileNotFoundError(f"the package was installed without {'/'.join(_WEIGHTS)}; --weights FILE names another")
    with as_file(own) as file:
        yield file


def _device(name: str) -> torch.device:
    """The device, if it is there.

    Raises:
        ValueError: it is not.
    """
    try:
        return torch.zeros((), device=name).device
    except (RuntimeError, AssertionError) as error:
        raise ValueError(f"--device {name} is not available: {str(error).splitlines()[0]}") from error


def _prepare(out: Path, *, overwrite: bool) -> None:
    """Make the folder; files that are not the demo's are never touched.

    Raises:
        OutputError: the folder holds other files, or an earlier demo and ``overwrite`` is off.
    """
    if out.exists() and not out.is_dir():
        raise OutputError(f"--out {out} is a file, expected a folder")
    if out.is_dir() and any(out.iterdir()):
        if not _is_ours(out):
            raise OutputError(f"--out {out} holds files of someone else: choose an empty or a new folder")
        if not overwrite:
            raise OutputError(f"--out {out} holds an earlier demo: --overwrite replaces it")
        for name in (_SUMMARY, *FILES):
            (out / name).unlink(missing_ok=True)
    out.mkdir(parents=True, exist_ok=True)
    write_json_atomic(out / _SUMMARY, _unfinished())


def _unfinished() -> Mapping[str, Any]:
    """Marks the folder as the demo's until the summary takes its place."""
    return {"program": PROGRAM, "state": "not finished"}


def _is_ours(out: Path) -> bool:
    try:
        text = (out / _SUMMARY).read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError):
        return False
    return f'"program": "{PROGRAM}"' in text

"""``ufmstar demo``: the main job with nothing but the installed package.

A camera walks through rendered rooms. Small depth networks that come with the package, trained on other rooms of
the same kind, predict depth; the last room looks and measures like none of them, so there is an uncertainty to find.
UfM and UfM* judge the same predictions, and the table says how well.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from importlib.resources import as_file, files
from pathlib import Path
from time import perf_counter
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from ufmstar_torch.camera import unproject
from ufmstar_torch.eval.commands.demo_options import FRAMES, OUT, SEED
from ufmstar_torch.eval.commands.run import Progress
from ufmstar_torch.eval.engine.demo_methods import ENSEMBLE, NETWORK, UFM, UFM_STAR, Comparison, Tally
from ufmstar_torch.eval.engine.run_source import sha256
from ufmstar_torch.eval.report.demo_pictures import DemoPanel, panel, write_pictures
from ufmstar_torch.eval.report.demo_report import names
from ufmstar_torch.eval.results.demo_folder import PROGRAM, SUMMARY, DemoError, prepare
from ufmstar_torch.eval.results.files import to_json, write_json_atomic
from ufmstar_torch.eval.results.summary import versions
from ufmstar_torch.eval.sequences.frame import Frame, FrameSequence
from ufmstar_torch.eval.sequences.ground_truth import resample_nearest, truth_at
from ufmstar_torch.eval.tour import Tour, make_tour, tour_sequence
from ufmstar_torch.models.trained import TrainedInfo, load_trained, read_info
from ufmstar_torch.ufmstar import UfMStar

# Of "mixed" tours: what the networks were trained on, and what they never saw.
KINDS = {"home": "familiar", "hall": "unfamiliar"}
STYLE = "mixed"
SHEET_ROWS = 6
_WEIGHTS = ("weights", "demo.safetensors")


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
        DemoError: a number is out of range.
    """

    out: Path = OUT
    frames: int = FRAMES
    seed: int = SEED
    weights: Path | None = None
    device: str = "cpu"
    overwrite: bool = False

    def __post_init__(self) -> None:
        if self.frames < 2:
            raise DemoError(f"--frames must be at least 2, got {self.frames}: one view has nothing to disagree with")
        if self.seed < 0:
            raise DemoError(f"--seed must be at least 0, got {self.seed}")


def run_demo(options: DemoOptions, progress: Callable[[Progress], None] = lambda _: None) -> dict[str, Any]:
    """Walk through the tour and leave pictures, mixture and summary in a folder.

    Args:
        options: what to show.
        progress: called at the start of each stage and after every step of it.

    Returns:
        What summary.json holds; ``demo_report`` makes a table of it.

    Raises:
        DemoError: the folder holds something else, or an earlier demo and ``overwrite`` is off; the device is
            not there.
        FileNotFoundError, CheckpointError: the networks cannot be loaded.
        ValueError: the networks state no variance.
        OSError: the results cannot be written.
    """
    started = perf_counter()
    device = _device(options.device)
    with _weights(options.weights) as file:
        info, members = read_info(file), load_trained(file)
        digest = sha256(file)
    prepare(options.out, overwrite=options.overwrite)
    size = info.spec.size
    sequence = tour_sequence(options.seed, frames=options.frames, size=size, style=STYLE, device=device)
    frames = _render(sequence, device, progress)
    comparison = Comparison(members, device)
    tally, panels = _walk(comparison, frames, make_tour(options.seed, STYLE), progress)
    summary = {
        "program": PROGRAM,
        "out": str(options.out),
        "settings": asdict(options),
        "tour": {"seed": options.seed, "style": STYLE, "frames": len(sequence), "size": info.spec.size},
        "network": _network(info, digest, len(members)),
        "methods": _methods(comparison, tally),
        "surfaces": tally.by_kind(),
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
    write_json_atomic(options.out / SUMMARY, summary)
    progress(Progress("pictures", 1, 1, None, 0))
    plain: dict[str, Any] = to_json(summary)
    return plain


def surface_kinds(tour: Tour, frame: Frame) -> NDArray[np.int64]:
    """[H, W] at every pixel, whether what it shows stands in a familiar room (0) or the unfamiliar one (1).

    By what is seen, not by where the camera is: through a door it looks into the next room.
    """
    assert frame.depth is not None
    K, T = torch.from_numpy(frame.intrinsics)[None], torch.from_numpy(frame.T_world_cam)
    points = unproject(torch.from_numpy(frame.depth).double()[None], K)[0] @ T[:3, :3].T + T[:3, 3]
    names = list(KINDS)
    of_room = torch.tensor([names.index(style) for style in tour.room_styles])
    found: NDArray[np.int64] = of_room[tour.room_at(points)].numpy()
    return found


def sheet_rows(unfamiliar: list[bool], rows: int = SHEET_ROWS) -> list[int]:
    """Frames to show: half of them in each kind of room, spread evenly, familiar ones first.

    Not the very first frame: nothing has been compared by then.

    Args:
        unfamiliar: of every frame, whether most of it shows an unfamiliar room.
        rows: how many, at most.
    """
    groups = [[i for i, is_new in enumerate(unfamiliar) if is_new == wanted and i > 0] for wanted in (False, True)]
    present = [group for group in groups if group]
    chosen: list[int] = []
    for group in present:
        spread = np.linspace(0, len(group) - 1, rows // len(present) + 1).round().astype(int)[1:]
        chosen += [group[position] for position in sorted(set(spread.tolist()))]
    return chosen


def _walk(
    comparison: Comparison, frames: list[Frame], tour: Tour, progress: Callable[[Progress], None]
) -> tuple[Tally, list[DemoPanel]]:
    """All frames by all methods, with their figures and the rows of the contact sheet."""
    comparison.take(frames[0])  # libraries set themselves up at the first call, which does not count
    comparison.restart()
    kinds = [surface_kinds(tour, frame) for frame in frames]
    unfamiliar = [bool(kind.mean() > 0.5) for kind in kinds]
    labels, rows = list(KINDS.values()), sheet_rows(unfamiliar)
    tally, panels = Tally(comparison.methods, labels), {}
    progress(Progress("frames", 0, len(frames), None, 0))
    for index, frame in enumerate(frames):
        compared = comparison.take(frame)
        K, size = compared.intrinsics.double().numpy(), compared.size
        truth = truth_at(frame, K, size)
        assert truth is not None
        assert frame.image is not None
        kind = resample_nearest(kinds[index], frame.intrinsics, K, size)
        tally.add(compared, torch.from_numpy(truth), torch.from_numpy(kind))
        if index in rows:
            panels[index] = panel(f"frame {index}", labels[unfamiliar[index]], frame.image, compared, truth)
        components = int(comparison.ufm_star.mixture.components.sum())
        progress(Progress("frames", index + 1, len(frames), components, 0))
    return tally, [panels[row] for row in rows]


def _render(sequence: FrameSequence, device: torch.device, progress: Callable[[Progress], None]) -> list[Frame]:
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
        DemoError: it is not.
    """
    try:
        return torch.zeros((), device=name).device
    except (RuntimeError, AssertionError) as error:
        raise DemoError(f"--device {name} is not available: {str(error).splitlines()[0]}") from error

"""Tours as sequences, by name: ``tour:SEED?style=mixed&frames=150&size=160x224``."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache, partial
from pathlib import Path
from typing import Any

import numpy as np
import torch

from ufmstar_torch.eval.sequences.frame import Entry, FrameSequence, Size, make_sequence, parse_size
from ufmstar_torch.eval.tour.movers import Mover, make_movers, with_movers
from ufmstar_torch.eval.tour.path import tour_path
from ufmstar_torch.eval.tour.style import STYLES
from ufmstar_torch.eval.tour.tour import Tour, make_tour
from ufmstar_torch.eval.tour.view import TourView, intrinsics, render
from ufmstar_torch.files.limits import MOST_PIXELS, require_bytes, require_pixels
from ufmstar_torch.runtime.kinds import check_kinds

PREFIX = "tour:"
_FORM = (
    "tour:SEED or tour:SEED?option=value&..., with the options style, frames, size, fov, path, pan, sensor and movers"
)
FPS = 15.0  # of the timestamps
_MOST_MOVERS = 100  # each is placed by trial, which takes a second
_FRAME_BYTES = 4096  # of a frame's pose and entry, and of the arrays from which its pose is computed


def open_tour(name: str) -> FrameSequence:
    """The tour of a name.

    Options: ``style`` (home, hall, mixed, blank, scales, corridor, street, close), ``frames``, ``size`` (HxW), ``fov``
    (degrees), ``path`` (seed of the way), ``pan`` (1: the camera turns in place), ``sensor`` (1, or 0 for a perfect
    camera) and ``movers`` (number of things that move).

    Raises:
        ValueError: another form, an unknown option, or an invalid value.
    """
    seed, _, query = name.removeprefix(PREFIX).partition("?")
    if not name.startswith(PREFIX) or not seed.isdecimal():
        raise ValueError(f"a tour is named {_FORM}; got {name!r}")
    options: dict[str, Any] = {}
    for word in query.split("&") if query else []:
        key, _, value = word.partition("=")
        if key not in _OPTIONS:
            raise ValueError(f"{name!r}: unknown option {key!r}; a tour is named {_FORM}")
        argument, parse, expected = _OPTIONS[key]
        if argument in options:
            raise ValueError(f"{name!r}: the option {key} is given twice")
        try:
            options[argument] = parse(value)
        except (ValueError, KeyError) as error:
            raise ValueError(f"{name!r}: {key} must be {expected}, got {value!r}") from error
    return tour_sequence(int(seed), **options)


@check_kinds
def tour_sequence(
    seed: int,
    *,
    frames: int = 150,
    size: Size = (160, 224),
    style: str = "home",
    fov: float = 70.0,
    path_seed: int | None = None,
    pan: bool = False,
    sensor: bool = True,
    movers: int = 0,
) -> FrameSequence:
    """A tour as a sequence; frames are rendered when they are indexed.

    Args:
        seed, style: see :func:`make_tour`.
        frames, path_seed, pan: see :func:`tour_path`.
        size: (H, W) [px].
        fov: horizontal field of view [degrees].
        sensor: True to add exposure, vignetting and noise.
        movers: number of things that move (:func:`make_movers`); frames have a mask of them if there are any.

    Raises:
        ValueError: a value is out of range.
    """
    if len(size) != 2 or min(size) < 8:
        raise ValueError(f"size must be (H, W) of at least 8 px each, got {size}")
    require_pixels("size", size)
    require_bytes("frames", frames * _FRAME_BYTES)
    if not 20 <= fov <= 120:
        raise ValueError(f"fov must be 20 to 120 degrees, got {fov}")
    if not 0 <= movers <= _MOST_MOVERS:
        raise ValueError(f"movers must be 0 to {_MOST_MOVERS}, got {movers}")
    tour = make_tour(seed, style)
    poses = tour_path(tour, frames, path_seed, pan=pan)
    K = intrinsics(size[0], size[1], fov)
    things = make_movers(tour, poses, torch.from_numpy(K), size, movers)
    renderer = _Renderer(tour, poses, torch.from_numpy(K), size, sensor, things)
    entries = [
        Entry(
            f"{i:06d}",
            poses[i].numpy(),
            partial(renderer.image, i),
            partial(renderer.depth, i),
            timestamp=i / FPS,
            load_moving=partial(renderer.moving, i) if movers else None,
        )
        for i in range(frames)
    ]
    return make_sequence(f"tour-{seed}-{style}", "tour", entries, K, image_size=size, depth_size=size)


@dataclass(frozen=True, eq=False)
class _Renderer:
    """Renders the frames of one path."""

    tour: Tour
    poses: torch.Tensor
    K: torch.Tensor
    size: Size
    sensor: bool
    movers: tuple[Mover, ...]

    def image(self, index: int) -> np.ndarray:
        """[H, W, 3] uint8 RGB."""
        return _view(self, index).image.numpy()

    def depth(self, index: int) -> np.ndarray:
        """[H, W] float32 [m]."""
        return _view(self, index).depth.float().numpy()

    def moving(self, index: int) -> np.ndarray:
        """[H, W] bool, True on things that move."""
        return (_view(self, index).surface >= len(self.tour.surfaces.kind)).numpy()


@lru_cache(maxsize=4)  # a frame's image and depth come from one rendering
def _view(walk: _Renderer, index: int) -> TourView:
    seed = walk.tour.seed * 1_000_003 + index if walk.sensor else None
    tour = with_movers(walk.tour, walk.movers, index)
    return render(tour, walk.poses[index], walk.K, *walk.size, frame_seed=seed)


@check_kinds
def export_tour(sequence: FrameSequence, folder: str | Path) -> Path:
    """Write a sequence of :func:`tour_sequence` in the generic layout: images/, depth/ (float32 npy [m]), poses.txt and
    K.txt. Raises FileExistsError: the folder is not empty; ValueError: a frame has no image or no depth."""
    from PIL import Image

    folder = Path(folder)
    if folder.exists() and any(folder.iterdir()):
        raise FileExistsError(f"folder must be new or empty: {folder}")
    for name in ("images", "depth"):
        (folder / name).mkdir(parents=True, exist_ok=True)
    rows = []
    for frame in sequence:
        if frame.image is None or frame.depth is None:
            raise ValueError(f"sequence must have an image and a depth map for every frame, {frame.name} has not")
        Image.fromarray(frame.image).save(folder / "images" / f"{frame.name}.png")
        np.save(folder / "depth" / f"{frame.name}.npy", frame.depth)
        rows.append(frame.T_world_cam[:3].flatten())
    np.savetxt(folder / "poses.txt", np.array(rows))
    np.savetxt(folder / "K.txt", sequence.intrinsics)
    return folder


def _whole(text: str, least: int = 0) -> int:
    if not text.isdecimal() or int(text) < least:
        raise ValueError(text)
    return int(text)


# By option: the argument of ``tour_sequence``, its parser (raises ValueError or KeyError), and its form.
_OPTIONS: dict[str, tuple[str, Callable[[str], Any], str]] = {
    "style": ("style", {style: style for style in STYLES}.__getitem__, f"one of {', '.join(STYLES)}"),
    "frames": ("frames", partial(_whole, least=1), "a number of at least 1"),
    "size": ("size", parse_size, f"HxW in pixels, 160x224 say, and at most {MOST_PIXELS:,} pixels"),
    "fov": ("fov", float, "a number of degrees, 20 to 120"),
    "path": ("path_seed", _whole, "a number of at least 0"),
    "pan": ("pan", {"0": False, "1": True}.__getitem__, "0 or 1"),
    "sensor": ("sensor", {"0": False, "1": True}.__getitem__, "0 or 1"),
    "movers": ("movers", _whole, "a number of at least 0"),
}

"""Rendered tours as training frames, each rendered once into a memory-mapped file.

A tour's file is ``<seed>.npy``, an array [F] of records: ``image`` (uint8 [H, W, 3]), ``depth`` (uint16 [H, W] in
millimetres, 0 = none), ``pose`` (float64 [4, 4], camera-to-world) and ``camera`` (float64 [3, 3]). It is written
atomically. The name of its folder is a digest of everything that decides the content, the renderer's source included,
so that other settings and other versions have folders of their own.
"""

from __future__ import annotations

import hashlib
import json
import logging
import multiprocessing
import os
import random
from collections.abc import Iterable
from concurrent.futures import ProcessPoolExecutor
from dataclasses import asdict
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from ufmstar_torch.eval.sequences.frame import Entry, FrameError, FrameSequence, make_sequence
from ufmstar_torch.eval.tour.style import style_of
from ufmstar_torch.files.read import read_npy
from ufmstar_torch.files.write import write_atomic
from ufmstar_torch.runtime.kinds import check_kinds
from ufmstar_torch.train.data_config import DataConfig
from ufmstar_torch.train.sequence_data import SequenceFrames

_LOG = logging.getLogger(__name__)
# [m] Twice the largest error of a stored depth; the largest depth is 65 m.
_UNIT = 1e-3
_FARTHEST = np.iinfo(np.uint16).max


@check_kinds
def tour_frames(seeds: Iterable[int], config: DataConfig) -> SequenceFrames:
    """The frames of some tours, which are rendered if the cache does not have them.

    After an interruption it goes on with the missing tours. Several processes may call it at the same time (those of a
    distributed run do): they render in different orders, and skip tours that another process has stored.

    Args:
        seeds: of the tours.
        config: what is rendered, by how many processes, and the folder of the cache.

    Raises:
        OSError: the cache cannot be written.
        ValueError: a tour's file is damaged.
    """
    seeds = tuple(seeds)
    user_cache = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "ufmstar_torch" / "tours"
    folder = (Path(config.cache) if config.cache else user_cache) / f"tours-{digest(config)}"
    folder.mkdir(parents=True, exist_ok=True)
    missing = [seed for seed in seeds if not tour_file(folder, seed).exists()]
    random.Random(os.getpid()).shuffle(missing)
    if missing:
        _LOG.info("rendering %d tours of %d frames into %s", len(missing), config.tour_frames, folder)
        _render(folder, missing, config)
    return SequenceFrames([stored_tour(folder, seed) for seed in seeds])


def digest(config: DataConfig) -> str:
    """16 hexadecimal digits that change with every setting of the tours and with the renderer's source."""
    import ufmstar_torch.eval.tour as package

    settings = {name: getattr(config, f"tour_{name}") for name in ("frames", "stride", "size", "fov")}
    settings["style"] = asdict(style_of(config.tour_style))
    sources = sorted(Path(str(package.__file__)).parent.glob("*.py"))
    result = hashlib.sha256(json.dumps(settings, sort_keys=True).encode())
    for source in (*sources, Path(__file__)):
        result.update(source.read_bytes())
    return result.hexdigest()[:16]


def tour_file(folder: Path, seed: int) -> Path:
    """A tour's frames."""
    return folder / f"{seed}.npy"


def stored_tour(folder: Path, seed: int) -> FrameSequence:
    """The frames of a tour's file. Raises OSError, ValueError: it cannot be read."""
    file = tour_file(folder, seed)
    frames = read_npy(file, mapped=True)
    entries = [
        Entry(str(i), pose, partial(_image, file, i), partial(_depth, file, i)) for i, pose in enumerate(frames["pose"])
    ]
    size = frames["depth"].shape[1:]
    camera = np.array(frames["camera"][0])
    return make_sequence(f"tour-{seed}", "tour", entries, camera, image_size=size, depth_size=size)


def _image(file: Path, number: int) -> NDArray[np.uint8]:
    return np.array(_record(file, number)["image"])


def _depth(file: Path, number: int) -> NDArray[np.float32]:
    return _record(file, number)["depth"].astype(np.float32) * np.float32(_UNIT)


def _record(file: Path, number: int) -> Any:
    """A frame of a tour's file. Raises FrameError: it is missing or truncated."""
    try:
        return read_npy(file, mapped=True)[number]
    except (OSError, ValueError, IndexError) as error:
        raise FrameError(file, f"cannot be read: {error}") from error


def render_tour(folder: Path, config: DataConfig, seed: int) -> None:
    """Renders one tour into its file, unless it exists."""
    from ufmstar_torch.eval.tour import tour_sequence

    file = tour_file(folder, seed)
    if file.exists():
        return
    sequence = tour_sequence(
        seed,
        frames=config.tour_frames * config.tour_stride,
        size=config.tour_size,
        style=config.tour_style,
        fov=config.tour_fov,
        path_seed=0,  # the longest way, from anywhere on it
    )
    maps = [("image", np.uint8, (*config.tour_size, 3)), ("depth", np.uint16, config.tour_size)]
    frames = np.empty(config.tour_frames, [*maps, ("pose", np.float64, (4, 4)), ("camera", np.float64, (3, 3))])
    for i in range(config.tour_frames):
        frame = sequence[i * config.tour_stride]
        assert frame.image is not None
        assert frame.depth is not None
        depth = np.rint(frame.depth / _UNIT).clip(0, _FARTHEST)
        frames[i] = (frame.image, depth, frame.T_world_cam, frame.intrinsics)
    write_atomic(file, partial(np.save, arr=frames))


def _render(folder: Path, seeds: list[int], config: DataConfig) -> None:
    task, workers = partial(render_tour, folder, config), min(config.render_workers, len(seeds))
    if workers == 1:
        for seed in seeds:
            task(seed)
        return
    # "spawn" as for the loader's workers; each process renders with one thread.
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(workers, mp_context=context, initializer=torch.set_num_threads, initargs=(1,)) as pool:
        list(pool.map(task, seeds))

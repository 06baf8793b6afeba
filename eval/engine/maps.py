"""Depth sources from existing maps: a folder of another program's predictions, or the sequence's depth."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch

from ufmstar_torch.eval.engine.predictions import DepthSource
from ufmstar_torch.eval.methods.setting import CROP
from ufmstar_torch.eval.sequences.depth_folder import DepthMaps, depth_maps
from ufmstar_torch.eval.sequences.frame import Frame, FrameError, FrameSequence, Size
from ufmstar_torch.eval.sequences.ground_truth import depth_camera, resample_nearest
from ufmstar_torch.eval.sequences.intrinsics import IntrinsicsLike, read_intrinsics, scale_intrinsics
from ufmstar_torch.eval.sequences.own_output import OwnOutput, own_output
from ufmstar_torch.frames.prediction import DepthPrediction
from ufmstar_torch.gaussians.camera import resize_intrinsics

TRUTH = "ground-truth"
# Depth [H, W] float32 [m] (0 = no prediction), variance [H, W] float32 [m^2] or None, intrinsics [3, 3] float64 [px].
Maps = tuple[np.ndarray, np.ndarray | None, np.ndarray]


class MapSource(DepthSource):
    """Existing depth maps, resized to ``size`` (h, w) unless it is None; other arguments as for ``DepthSource``."""

    def __init__(
        self,
        read: Callable[[Frame], Maps],
        identity: Mapping[str, Any],
        *,
        size: Size | None = None,
        is_truth: bool = False,
        label: str = "",
        digest: str = "",
    ) -> None:
        super().__init__(identity, label, digest)
        self._read, self._size, self.is_truth = read, size, is_truth

    def prepared(self, how: str) -> MapSource:
        """This source, because maps show the whole frame. Raises ValueError: ``how`` is "crop"."""
        if how == CROP:
            raise ValueError(f'preprocess = "{CROP}" goes with networks: maps exist already')
        return self

    def one(self, frame: Frame, n: int) -> DepthPrediction:
        """The frame's map, resized by nearest neighbour. Raises FrameError: the map is missing or cannot be read."""
        depth, variance, K = self._read(frame)
        if self._size is not None and self._size != depth.shape:
            before, height, width = K, *depth.shape
            K = resize_intrinsics(torch.from_numpy(K), (height, width), self._size).numpy()
            depth = resample_nearest(depth, before, K, self._size)
            variance = None if variance is None else resample_nearest(variance, before, K, self._size)
        aleatoric = None if variance is None else torch.from_numpy(variance)[None]
        camera = torch.from_numpy(K)[None].double()
        return DepthPrediction(torch.from_numpy(depth)[None], aleatoric, intrinsics=camera)


def folder_source(
    sequence: FrameSequence,
    folder: str | Path,
    *,
    variance: str | Path | None = None,
    scale: float | None = None,
    intrinsics: IntrinsicsLike | None = None,
    size: Size | None = None,
    indices: Sequence[int] | None = None,
) -> MapSource:
    """Maps that another program predicted for the frames of a sequence (see ``depth_maps``).

    Args:
        sequence: of the maps.
        folder: of the maps, or the output folder of a run, which includes intrinsics and skipped frames.
        variance: folder of the variances; None = none.
        scale: metres per unit of the maps.
        intrinsics: of the maps [px]; None = the image's, scaled by the ratio of sizes: maps show the whole image.
        size: (h, w) to which maps are resized; None = not resized.
        indices: of the frames with maps; None = all.

    Raises:
        NotADirectoryError: no such folder.
        ValueError: no maps, maps that fit no frame, or a first map with another aspect ratio than the images.
    """
    run = own_output(Path(folder))
    _require_no_run(run, folder, scale, variance)
    chosen = range(len(sequence)) if indices is None else indices
    selected = [name for index in chosen if (name := sequence.names[index]) not in (run.skipped if run else ())]
    if not selected:
        raise ValueError(f"{folder}: none of the {len(chosen)} frames has a map")
    how: dict[str, Any] = {"scale": scale, "variance": variance, "key": run.depth if run else "depth"}
    how |= {"names_on_disk": sequence.names_on_disk, "selected": selected}
    maps = depth_maps(run.frames if run else folder, sequence.names, **how)
    number = {name: i for i, name in enumerate(selected)}
    K_given = None if intrinsics is None else read_intrinsics(intrinsics)

    def read(frame: Frame) -> Maps:
        if frame.name not in number:
            raise FrameError(frame.name, f"skipped in {folder}: {run.skipped[frame.name]}" if run else "no map")
        file = maps.depth_files[number[frame.name]]
        depth, spread = maps[number[frame.name]]
        K = K_given if run is None or K_given is not None else run.intrinsics.get(file.stem)
        size = sequence.image_size if frame.image is None else frame.image.shape[:2]
        return depth, spread, _of_whole_image(file, depth, size, frame.intrinsics) if K is None else K

    if K_given is None and run is None:
        _check_first(sequence, maps)
    files = (*maps.depth_files, *maps.variance_files)
    listing = "\n".join(f"{file.name} {file.stat().st_size}" for file in files)
    identity = {
        "maps": {"count": len(maps.depth_files), "names_and_sizes": hashlib.sha256(listing.encode()).hexdigest()},
        "with_variance": variance is not None,
        "scale": scale,
        "intrinsics": K_given,
        "size": size,
    }
    return MapSource(read, identity, size=size)


def _require_no_run(
    run: OwnOutput | None, folder: str | Path, scale: float | None, variance: str | Path | None
) -> None:
    """Raises ValueError: a scale for maps of a ``run``, or variances of one."""
    if variance is not None and own_output(Path(variance)) is not None:
        takes = "whose variance contains M: --variance takes what the network states"
        raise ValueError(f"{variance} is the output of a run, {takes}")
    if run and scale is not None:
        in_metres = "whose maps are in metres: --depth-scale does not go with it"
        raise ValueError(f"{folder} is the output of a run, {in_metres}")


def _check_first(sequence: FrameSequence, maps: DepthMaps) -> None:
    """Raises ValueError: the first map has another aspect ratio than the images; then all maps have."""
    try:
        depth, _ = maps[0]
    except FrameError:  # counted when its turn comes
        return
    try:
        _of_whole_image(maps.depth_files[0], depth, sequence.image_size, sequence.intrinsics)
    except FrameError as error:
        raise ValueError(str(error)) from error


def _of_whole_image(file: Path, depth: np.ndarray, size: Size | None, K: np.ndarray) -> np.ndarray:
    """[3, 3] intrinsics of a map that shows a whole image of ``size`` (H, W) with intrinsics K. Raises FrameError: the
    aspect ratios differ."""
    try:
        return scale_intrinsics(K, size, depth.shape[:2])
    except ValueError as error:
        height, width = size or (0, 0)
        reason = f"the map is {depth.shape[1]}x{depth.shape[0]}, the images are {width}x{height}: it does not show the "
        raise FrameError(file, f"{reason}whole image: give the intrinsics of the maps, --map-intrinsics") from error


def own_depth(size: Size | None = None) -> MapSource:
    """The sequence's depth as the prediction: UfM* on perfect depth, the lower bound of its error. ``size``: see
    :class:`MapSource`."""

    def read(frame: Frame) -> Maps:
        if frame.depth is None:
            raise FrameError(frame.name, "no depth map")
        return frame.depth, None, depth_camera(frame)

    identity = {"model": TRUTH, "label": "ground truth", "size": size}
    digest = hashlib.sha256(json.dumps(identity, sort_keys=True).encode()).hexdigest()
    return MapSource(read, identity, size=size, is_truth=True, label="ground truth", digest=digest)

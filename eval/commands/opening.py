"""The options of recordings that every command with a recording takes."""

from __future__ import annotations

from dataclasses import dataclass, fields
from functools import cached_property
from typing import Annotated, Any, Literal

from ufmstar_torch.eval.commands.options import Number, Repeated, Text, Texts, arg, assigned
from ufmstar_torch.eval.sequences.options import Options


@dataclass(frozen=True, kw_only=True)
class OpeningOptions:
    """Options for opening a recording.

    Attributes:
        layout: Read this layout (docs/data.md) instead of the detected one.
        intrinsics: The camera of the images is in this file, or is fx fy cx cy [px].
        distortion: Undo this lens distortion: k1 k2 p1 p2 [k3 [k4 k5 k6]], fisheye k1 k2 k3 k4, or none.
        truth_scale: One unit of the recording's own depth is this many metres.
        trajectory: Take the poses from this file (TUM or KITTI) instead of the layout's own.
        poses: The poses have these axes; ned is x forward, z down, opengl is y up, z back.
        pose_scale: One unit of poses and landmarks is this many metres.
        fps: Images without timestamps come at this rate [1/s].
        time_offset: Add this to the times of the images [s].
        images: The images of a generic recording are in this folder or video.
        truth: The true depth maps of a generic recording are in this folder.
        reader: Set a rarer option of the reader as NAME=VALUE (docs/data.md), as drive=3; repeatable.
        plugin: Load readers, methods and metrics from these Python files.
    """

    layout: str = "auto"
    intrinsics: Texts = ()
    distortion: Texts = ()
    truth_scale: Number = None
    trajectory: Text = None
    poses: Literal["camera-to-world", "world-to-camera", "ned", "opengl"] = "camera-to-world"
    pose_scale: Number = None
    fps: Number = None
    time_offset: float = 0.0
    images: Text = None
    truth: Text = None
    reader: Repeated = ()
    plugin: Texts = ()

    def __post_init__(self) -> None:
        _ = self.of_reader  # checks the values

    @cached_property
    def of_reader(self) -> Options:
        """The options for the readers. Raises ValueError: an unknown name or an impossible value."""
        values = {f.name: getattr(self, f.name) for f in fields(self) if f.name != "reader"}
        rarer = assigned(self.reader, "--reader")
        expected = {f.name for f in fields(Options)} - values.keys()
        if unknown := sorted(rarer.keys() - expected):
            raise ValueError(f"--reader has no {', '.join(unknown)}; it has {', '.join(sorted(expected))}")
        for name in ("depth_intrinsics", "topics"):
            if name in rarer:
                rarer[name] = tuple(str(rarer[name]).split(","))
        empty = {name: value for name, value in values.items() if value != ()}
        return Options(**empty, **rarer)

    def changed(self) -> dict[str, Any]:
        """The options that are not the default, as arguments of ``open_sequence``."""
        return self.of_reader.changed()


Recording = Annotated[OpeningOptions, arg(name="recording")]  # the title of its group in the help

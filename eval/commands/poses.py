"""``ufmstar poses``: its options, output files and printed output."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any, ClassVar

from ufmstar_torch.eval.commands.options import Count, Flag, Number, Positional, Text, Texts, arg, reader
from ufmstar_torch.eval.commands.terminal import Bars, stop_signals, usage_errors
from ufmstar_torch.eval.sequences.frame import parse_slice
from ufmstar_torch.eval.sequences.intrinsics import camera_file, parse_intrinsics, read_intrinsics
from ufmstar_torch.eval.sequences.options import Options, resolve


@dataclass(frozen=True, kw_only=True)
class PosesOptions:
    """Poses and landmarks of a video or a folder of images, by structure from motion.

    Images do not show a scale: give a known length or a metric trajectory. Without either, `ufmstar run` takes the
    result with --pose-scale or --scale-from network only.

    Attributes:
        source: A video file, or a folder of images in the order of their names.
        out: Write the result, which `ufmstar run` reads, to this folder; anchors are in OUT/landmarks.npz.
        intrinsics: The camera of the images is in this file, or is fx fy cx cy [px], and is not refined (default:
            K.txt in the folder, or else it is estimated).
        distortion: Undo this lens distortion in OUT/images: k1 k2 p1 p2 [k3 [k4 k5 k6]], or fisheye k1 k2 k3 k4.
        length: The distance of two places is A B METRES; a place is NAME, where the camera was at that image, or
            NAME:U,V, what a pixel of OUT/images/NAME.jpg shows.
        trajectory: Take the scale from metric positions of the camera (SLAM's, VIO's, GPS's), in TUM or KITTI format.
        images: The images are in this folder or video within the source.
        fps: Images without timestamps come at this rate [1/s].
        time_offset: Add this to the times of the images [s].
        max_pose_gap: Interpolate positions between samples at most this far apart [s].
        frames: Take these images, START:STOP:STEP, counted from 0 as Python does.
        overwrite: Replace the reconstruction in --out.
        threads: Use this many CPU threads (default: all cores).
    """

    USAGE: ClassVar[str] = (
        "ufmstar poses VIDEO|FOLDER --out DIR [--intrinsics FILE] [--length A B METRES | --trajectory FILE] [options]"
    )

    source: Annotated[Positional[str], arg(metavar="SOURCE")]
    out: Path
    intrinsics: Texts = ()
    distortion: Texts = ()
    length: Texts = ()
    trajectory: Text = None
    images: Text = None
    fps: Number = None
    time_offset: float = 0.0
    max_pose_gap: float = 0.1
    frames: Text = None
    overwrite: Flag = False
    threads: Count = None

    def __post_init__(self) -> None:
        parse_intrinsics(self.intrinsics, "--intrinsics")
        parse_slice(self.frames)
        Options(fps=self.fps, max_pose_gap=self.max_pose_gap)
        _ = self.known_length
        if self.length and self.trajectory:
            raise ValueError("--length and --trajectory contradict each other: give one of them")
        if self.distortion and not self.intrinsics:
            raise ValueError("--distortion goes with --intrinsics only")

    @property
    def known_length(self) -> tuple[str, str, float] | None:
        """Two places and their distance [m]. Raises ValueError: another form."""
        if not self.length:
            return None
        try:
            first, second, text = self.length
            metres = float(text)
            if not 0 < metres < float("inf"):
                raise ValueError
        except ValueError:
            raise ValueError(f"--length must be A B METRES, got {' '.join(self.length)!r}") from None
        return first, second, metres


read = reader(PosesOptions, "ufmstar poses")


def main(options: PosesOptions) -> int:
    """Reconstruct, write the folder, and print the result. Returns the exit code."""
    from ufmstar_torch.eval.reconstruct.reconstruct import POSES, require_pycolmap
    from ufmstar_torch.eval.run.folder import FolderError, output_folder

    require_pycolmap()
    with usage_errors(FolderError, FileNotFoundError, NotADirectoryError, ValueError):
        images, size = _images(options)
        with output_folder(options.out, POSES, {}, overwrite=options.overwrite):
            result = _reconstruct(options, images, size)
    _report(result, options.out)
    return 0


def _images(options: PosesOptions) -> tuple[list[Any], tuple[int, int]]:
    """The entries of the images with their times, and their (H, W). Raises ValueError: there are no images."""
    from ufmstar_torch.eval.sequences.generic import open_images

    path = Path(options.source)
    if not path.exists():
        raise FileNotFoundError(f"no such file or folder: {path}")
    entries, size = open_images(path, Options(images=options.images, fps=options.fps))
    entries = [
        entry if entry.timestamp is None else replace(entry, timestamp=entry.timestamp + options.time_offset)
        for entry in entries[parse_slice(options.frames)]
    ]
    if not entries or size is None:
        raise ValueError(f"{path}: no image that can be read")
    return entries, size


def _plain(name: str) -> str:
    """An image's name without leading zeros, where it is a number."""
    return str(int(name)) if name.isdecimal() else name


def _reconstruct(options: PosesOptions, images: list[Any], size: tuple[int, int]) -> dict[str, Any]:
    """Write keyframes, models, landmarks and poses.json. Returns the content of the last."""
    import numpy as np

    from ufmstar_torch.eval.engine.files import write_atomic, write_json_atomic
    from ufmstar_torch.eval.reconstruct.reconstruct import POSES, gaps, landmarks, scale_model
    from ufmstar_torch.eval.sequences.poses import read_trajectory

    root = Path(options.source) if Path(options.source).is_dir() else Path(options.source).parent
    lens = _lens(options, root, size)
    if lens is not None:  # COLMAP's mapper fails on some lenses; `run` need not undistort again
        images = [lens.see(entry) for entry in images]
    trajectory = None if options.trajectory is None else read_trajectory(resolve(root, options.trajectory))
    names, broken, models = _models(options, images, None if lens is None else lens.K)
    opening, out = Options(fps=options.fps, max_pose_gap=options.max_pose_gap), options.out
    scale = scale_model(models[0], images, length=options.known_length, trajectory=trajectory, options=opening)
    for number, model in enumerate(models):
        (out / "sparse" / str(number)).mkdir(exist_ok=True)
        model.write(out / "sparse" / str(number))
    points, sigma = landmarks(models[0])
    write_atomic(out / "landmarks.npz", lambda file: np.savez(file, points=points, sigma=sigma))
    result = {
        "program": POSES.program,
        "state": "finished",
        **scale,
        "images": len(images),
        "images_that_cannot_be_read": broken,
        "keyframes": len(names),
        "models": [model.num_reg_images() for model in models],
        "gaps": gaps(names, models[0]),
        "landmarks": len(points),
        "reprojection_error": models[0].compute_mean_reprojection_error(),
    }
    write_json_atomic(out / POSES.manifest, result)
    return result


def _models(options: PosesOptions, images: list[Any], K: Any) -> tuple[list[str], int, list[Any]]:
    """Write the keyframes of images with intrinsics ``K`` [3, 3] (None = unknown), and rgb.txt with their times.
    Returns their names, the number of images that cannot be read, and the models of the keyframes, the largest first.
    Raises ValueError: an image of --length does not exist, or no model fits."""
    from ufmstar_torch.eval.engine.files import write_bytes_atomic
    from ufmstar_torch.eval.engine.progress import Progress
    from ufmstar_torch.eval.reconstruct.keyframes import write_keyframes
    from ufmstar_torch.eval.reconstruct.reconstruct import reconstruct
    from ufmstar_torch.eval.run.machine import available_cores

    named = {_plain(word.partition(":")[0]) for word in options.length[:2]}
    always = {entry.name for entry in images if _plain(entry.name) in named}
    if unknown := sorted(named - {_plain(name) for name in always}):
        raise ValueError(f"--length: there is no image {', '.join(unknown)}; they are {images[0].name}, ...")
    out = options.out
    (out / "images").mkdir(exist_ok=True)
    with Bars() as bars, stop_signals(bars.say) as stop:
        how: dict[str, Any] = {"progress": lambda done: bars.show(Progress("frames", done, len(images))), "stop": stop}
        chosen, broken = write_keyframes(images, out / "images", always=always, **how)
        keyframes = [images[index] for index in chosen]
        names = [entry.name for entry in keyframes]
        if keyframes and keyframes[0].timestamp is not None:
            lines = "".join(f"{entry.timestamp:.9f} images/{entry.name}.jpg\n" for entry in keyframes)
            write_bytes_atomic(out / "rgb.txt", lines.encode())
        threads = options.threads or available_cores()
        return names, broken, reconstruct(out, names, K, threads=threads, say=bars.say)


def _lens(options: PosesOptions, root: Path, size: tuple[int, int]) -> Any:
    """The camera; None = estimate it. Raises ValueError: the intrinsics do not fit the images."""
    from ufmstar_torch.eval.sequences.generic import INTRINSICS
    from ufmstar_torch.eval.sequences.lens import Lens, parse_distortion

    named = parse_intrinsics(options.intrinsics, "--intrinsics")
    source = camera_file(root, INTRINSICS) if named is None else named
    if source is None:
        return None
    return Lens.of(read_intrinsics(source), size, *parse_distortion(options.distortion))


def _report(result: dict[str, Any], out: Path) -> None:
    largest, *others = result["models"]
    print(f"{largest} of {result['keyframes']} keyframes (of {result['images']} images) have a pose, error "
          f"{result['reprojection_error']:.2f} px; {result['landmarks']} landmarks")  # fmt: skip
    for first, last in result["gaps"]:
        print(f"  no pose: {first} to {last}")
    if others:
        print(f"  further models, which do not connect to the first: {', '.join(map(str, others))} keyframes")
    match result["scale_from"]:
        case None:
            print("scale unknown: pass --length A B METRES or --trajectory FILE, or to `ufmstar run` --pose-scale M or "
                  "--scale-from network")  # fmt: skip
        case "length":
            print(f"scale from the length: {result['metres_per_unit']:.4g} m per unit")
        case _:
            print(
                f"scale from the trajectory: {result['metres_per_unit']:.4g} m per unit, {result['residual']:.3f} m off"
            )
    print(f"{out}: ufmstar run {out} --anchors landmarks.npz ...")

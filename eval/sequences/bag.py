"""ROS 1 bags and ROS 2 bags (db3, mcap), through rosbags: images, camera info, depth, and poses of a topic or of tf.

A PoseStamped is the pose of the camera (its optical frame); an Odometry is the pose of its ``child_frame_id``, which tf
connects to the image's frame. Opening reads every message of the chosen topics once, for its time; images are decoded
later. Messages have ROS's standard types, so no definition in the file is compiled.
"""

from __future__ import annotations

import re
import struct
from collections.abc import Callable, Collection, Iterable, Iterator, Sequence
from contextlib import contextmanager
from functools import partial
from heapq import merge
from pathlib import Path
from typing import Any, NamedTuple
from weakref import finalize

import numpy as np

from ufmstar_torch.eval.sequences import ros_messages as ros
from ufmstar_torch.eval.sequences.assemble import assemble
from ufmstar_torch.eval.sequences.attach import UNKNOWN
from ufmstar_torch.eval.sequences.frame import Entry, FrameError, FrameSequence, Skipped
from ufmstar_torch.eval.sequences.lens import Lens
from ufmstar_torch.eval.sequences.options import Options
from ufmstar_torch.eval.sequences.paths import is_hidden, natural_key
from ufmstar_torch.eval.sequences.poses import associate
from ufmstar_torch.frames.warnings import LOGGER
from ufmstar_torch.gaussians.trajectory import interpolate_pose
from ufmstar_torch.runtime.optional import optional

LOOKED_FOR = "a .bag, .db3 or .mcap file, or a folder that holds one, or the numbered files of one (walk_0.db3, ...)"
_SUFFIXES = (".bag", ".db3", ".mcap")
_REPAIRS = {
    ".bag": "rosbag reindex",
    ".mcap": "mcap recover",
    ".db3": "sqlite3 FILE .recover",
}  # if a recorder was killed
_METADATA = "metadata.yaml"
# Name of one of the files that a recorder starts after a size or time; ROS 1 also writes the time at which it started.
_PART = re.compile(r"(.*?)(?:_?\d{4}(?:-\d\d){5})?_(\d+)")
_IMAGE, _COMPRESSED = "sensor_msgs/msg/Image", "sensor_msgs/msg/CompressedImage"
_INFO, _TF = "sensor_msgs/msg/CameraInfo", "tf2_msgs/msg/TFMessage"
_TF_FIELDS = "geometry_msgs/TransformStamped[] transforms"
_ODOMETRY = "nav_msgs/msg/Odometry"
_POSES = (_ODOMETRY, "geometry_msgs/msg/PoseStamped", "geometry_msgs/msg/PoseWithCovarianceStamped")
_TYPES = (_IMAGE, _COMPRESSED, _INFO, _TF, *_POSES)
_OLD_NAMES = {"tf/msg/tfMessage": _TF}
_NANOSECOND = 1e-9
_TRANSPORTS = ("compressed", "compressedDepth")  # last parts of the names of image_transport's topics
_SCALE_SAMPLES = 5  # images of a bag that determine the range of their 16 bits
# Errors of rosbags for damaged files, besides its own classes.
_BROKEN = (
    *(OSError, EOFError, LookupError, AssertionError, ArithmeticError, AttributeError, RuntimeError, TypeError),
    *(ValueError, MemoryError, struct.error),
)


def _module(name: str) -> Any:
    return optional(name, "ROS bags need rosbags", "'ufmstar-torch[recordings]'")


class MessageKey(NamedTuple):
    """Identifies a message in a bag: topic, time of reception [ns], and index among messages of that time."""

    topic: str
    received: int
    number: int


class Bag:
    """A bag that is opened at the first read, separately in each worker process. Raises FrameError: it cannot be
    read.

    Args:
        path: of the bag, for messages.
        files: of one recording, or its folder with metadata; None = ``path``.
    """

    def __init__(self, path: Path, files: Sequence[Path] | None = None) -> None:
        self.path, self._files = path, tuple(files or [path])
        self._readers: list[Any] = []
        self._store: Any = None

    @property
    def topics(self) -> dict[str, str]:
        """The types of the topics with messages, by name."""
        with self._opened() as readers:
            connections = [c for reader in readers for c in reader.connections if c.msgcount]
            return {c.topic: _OLD_NAMES.get(c.msgtype, c.msgtype) for c in connections}

    def messages(self, topics: Iterable[str], *when: int) -> Iterator[tuple[MessageKey, Any]]:
        """The messages of topics in the order of reception, those in [start, stop) [ns] if ``when`` has both."""
        types, wanted = self.topics, set(topics)
        last: dict[str, tuple[int, int]] = {}
        with self._opened() as readers:
            decode = self._store.deserialize_ros1 if self._ros1 else self._store.deserialize_cdr
            chosen = [[c for c in reader.connections if c.topic in wanted] for reader in readers]
            parts = [reader.messages(some, *when) for reader, some in zip(readers, chosen, strict=True) if some]
            for connection, received, raw in merge(*parts, key=lambda message: message[1]):
                before, number = last.get(connection.topic, (-1, 0))
                number = number + 1 if before == received else 0
                last[connection.topic] = (received, number)
                yield MessageKey(connection.topic, received, number), decode(raw, types[connection.topic])

    def read(self, key: MessageKey) -> Any:
        """Read one message."""
        for found, message in self.messages([key.topic], key.received, key.received + 1):
            if found == key:
                return message
        raise FrameError(self.path, f"the message of {key.topic} at {key.received} ns is missing")

    @property
    def _ros1(self) -> bool:
        return self._files[0].suffix == ".bag"

    @contextmanager
    def _opened(self) -> Iterator[list[Any]]:
        reader_errors = [_module(f"rosbags.{name}").ReaderError for name in ("rosbag1", "rosbag2")]
        zstd = _module("rosbags.rosbag2.storage_mcap").zstd
        try:
            if not self._readers:
                self._open()
            yield self._readers
        except (
            *reader_errors,
            _module("rosbags.serde").SerdeError,
            zstd.ZstdError,
            _module("apsw").Error,
            *_BROKEN,
        ) as error:
            reason = " ".join(str(error).split())[:200] or type(error).__name__
            how = _REPAIRS.get(next(iter(_bag_files(self.path)), self.path).suffix, "recording it again")
            raise FrameError(
                self.path, f"the bag cannot be read: {reason}; an unfinished one may need {how}"
            ) from error

    def _open(self) -> None:
        stores = _module("rosbags.typesys")
        readers = [_module("rosbags.rosbag1" if self._ros1 else "rosbags.rosbag2").Reader(file) for file in self._files]
        for reader in readers:
            reader.open()
            finalize(self, reader.close)
        self._store = stores.get_typestore(stores.Stores.ROS1_NOETIC if self._ros1 else stores.Stores.ROS2_HUMBLE)
        if self._ros1:  # ROS 1's types in rosbags have no tf
            self._store.register(stores.get_types_from_msg(_TF_FIELDS, _TF))
        self._readers = readers

    def __getstate__(self) -> dict[str, Any]:
        return {"path": self.path, "_files": self._files, "_readers": [], "_store": None}


class _Topics(NamedTuple):
    """The chosen topics, "" = none, and the frame after "=" in the option of the pose's topic."""

    image: str
    info: str
    depth: str
    pose: str
    frame: str


def detect(path: Path) -> bool:
    """True if the path is a bag, or a folder with one."""
    return bool(_bag_files(path))


def _bag_files(path: Path) -> list[Path]:
    """The files of one recording in the order of their numbers, or its folder with metadata; [] for other paths."""
    if path.is_file():
        return [path] if path.suffix in _SUFFIXES else []
    files = [p for p in path.glob("*") if any(end in p.suffixes for end in _SUFFIXES) and not is_hidden(p)]
    if files and (path / _METADATA).is_file():
        return [path]
    if len(files) > 1:
        parts = [_PART.fullmatch(file.stem) for file in files]
        if (
            not all(parts)
            or len({(part and part[1], file.suffix) for part, file in zip(parts, files, strict=True)}) > 1
        ):
            return []
    return sorted(files, key=natural_key) if files and files[0].suffix in _SUFFIXES else []


def read(path: Path, options: Options) -> FrameSequence:
    """Open the images of one camera, named by their number. Times are the headers', or the times of reception if those
    are 0. ``options.topics`` chooses among several. Raises ModuleNotFoundError: rosbags is not installed; ValueError: a
    damaged bag, topics that are missing or not unique (listed), or a camera without calibration."""
    files = _bag_files(path)
    file = files[0] if len(files) == 1 else path
    bag = Bag(file, files)
    try:
        topics = _choose(bag, options)
        content = _Content(bag, topics)
    except FrameError as error:
        raise ValueError(error) from error
    full = _full_scale(bag, [key for _, key in content.images])
    entries: list[Entry | Skipped] = []
    stamps, depth_stamps = (np.array([time for time, _ in keyed]) for keyed in (content.images, content.depths))
    paired = associate(stamps, depth_stamps, options.max_time_difference)
    for number, (time, key) in enumerate(content.images):
        load_depth = None
        if number in paired:
            load_depth = partial(_decoded, ros.depth, bag, content.depths[paired[number]][1], options.truth_scale)
        T = content.pose(time + options.time_offset, options.max_pose_gap) if options.trajectory is None else UNKNOWN
        name = f"{number:06d}"
        if T is None:
            entries.append(Skipped(name, f"no pose within {options.max_pose_gap:g} s around the image"))
        else:
            entries.append(Entry(name, T, partial(_decoded, ros.colour, bag, key, full), load_depth, time))
    size = None
    if content.lens is None:
        if not content.images:
            raise ValueError(f"{file} holds no image")
        height, width = _decoded(ros.colour, bag, content.images[0][1], full).shape[:2]
        size = height, width
    return assemble("bag", path, entries, content.lens, options, name=path.resolve().stem, size=size)


def _full_scale(bag: Bag, keys: Sequence[MessageKey]) -> int | None:
    """The largest value that the camera stores, by some of its images; None for images of 8 bits."""
    chosen = np.unique(np.linspace(0, len(keys) - 1, min(_SCALE_SAMPLES, len(keys))).astype(int)).tolist()
    scales = []
    for number in chosen:
        try:
            scale = ros.full_scale_of(bag.read(keys[number]), bag.path)
        except FrameError:  # counted when its turn comes
            continue
        if scale is None:
            return None
        scales.append(scale)
    if not scales:
        return None
    topic, full = keys[0].topic, max(scales)
    LOGGER.warning("%s: %s: images of 16 bits, read as 0 to %d and scaled to bytes", bag.path, topic, full)
    return full


def _decoded(decode: Callable[..., np.ndarray], bag: Bag, key: MessageKey, *how: Any) -> np.ndarray:
    return decode(bag.read(key), *how, bag.path)


def _choose(bag: Bag, options: Options) -> _Topics:
    """Choose the topics by type, ``options.topics`` first. Raises ValueError: a topic is missing or not unique."""
    types = bag.topics
    named = dict(word.partition("=")[::2] for word in options.topics or ())
    unknown = [name for name in named if types.get(name) not in _TYPES]
    if unknown:
        raise ValueError(f"topics: {unknown[0]!r} cannot be used; {bag.path} has {_listing(types)}")
    images, depths = _image_topics(bag, types)

    def one(kind: str, candidates: Iterable[str]) -> str:
        listed = list(candidates)
        chosen = [name for name in listed if name in named] or _without_transports(listed)
        if len(chosen) > 1:
            raise ValueError(f"{bag.path}: {kind} may be {', '.join(sorted(chosen))}: name one with --reader topics")
        return chosen[0] if chosen else ""

    image = one("the image", images)
    if not image:
        raise ValueError(f"{bag.path} has no topic of colour images, but {_listing(types)}")
    infos = [name for name, kind in types.items() if kind == _INFO]
    siblings = [name for name in infos if name.rsplit("/", 1)[0] in (image.rsplit("/", 1)[0], image.rsplit("/", 2)[0])]
    info = "" if options.intrinsics is not None else one("the camera info", siblings or infos)
    if not info and options.intrinsics is None:
        raise ValueError(f"{bag.path} has no camera info: pass intrinsics")
    depth = one("the depth", _depths_of(bag, depths, images[image], named))
    pose = ""
    if options.trajectory is None:
        by_tf = [name for name in named if types[name] == _TF]
        poses = [name for name, kind in types.items() if kind in _POSES]
        pose = by_tf[0] if by_tf else one("the pose", poses)
        pose = pose or next((name for name, kind in types.items() if kind == _TF and "static" not in name), "")
        if not pose:
            raise ValueError(f"{bag.path} has no poses: pass trajectory")
    return _Topics(image, info, depth, pose, ros.frame_name(named.get(pose, "")))


def _image_topics(bag: Bag, types: dict[str, str]) -> tuple[dict[str, str], dict[str, str]]:
    """The topics of colour images and of depth maps, each with the frame of its first message. Raises FrameError: a
    topic has no message."""
    images, depths = dict[str, str](), dict[str, str]()
    for name in (name for name, kind in types.items() if kind in (_IMAGE, _COMPRESSED)):
        first = next((message for _, message in bag.messages([name])), None)
        if first is None:
            raise FrameError(bag.path, f"{name} should have messages, but has none: the bag is damaged")
        (depths if ros.is_depth(first) else images)[name] = ros.frame_name(first.header.frame_id)
    return images, depths


def _depths_of(bag: Bag, depths: dict[str, str], view: str, named: Collection[str]) -> list[str]:
    """The topics of ``depths`` whose maps are of the frame ``view`` and no prediction, unless the user ``named`` it.
    Raises ValueError: a topic that the user named is of another frame."""
    same_view = [name for name, frame in depths.items() if frame == view]
    depth_named = [name for name in same_view if name in named or "depth" in name.lower()]  # not a map of sigma
    predicted = [name for name in depth_named if name.rsplit("/", 1)[0] + "/sigma" in depths and name not in named]
    if predicted:
        LOGGER.warning("%s: no ground truth: %s is a prediction, with a sigma beside it", bag.path, predicted[0])
        same_view = [name for name in same_view if name in named]
        return [name for name in depth_named if name not in predicted] or same_view
    if other := [name for name in named if name in depths and name not in same_view]:
        raise ValueError(f"topics: {other[0]!r} shows another camera's view ({depths[other[0]]!r}, not {view!r})")
    if depths and not same_view:
        name, frame = next(iter(depths.items()))
        LOGGER.warning("%s: no depth: %s is of %r and not registered to %r", bag.path, name, frame, view)
    return depth_named or same_view


def _without_transports(topics: list[str]) -> list[str]:
    """Remove topics that repeat the images of another topic: X/compressed and X/compressedDepth if X exists, and
    X/compressed if X/compressedDepth exists."""
    pairs = [(name, *name.rpartition("/")[::2]) for name in topics]
    return [
        name
        for name, base, transport in pairs
        if not (
            transport in _TRANSPORTS
            and (base in topics or (transport == _TRANSPORTS[0] and f"{base}/{_TRANSPORTS[1]}" in topics))
        )
    ]


def _listing(types: dict[str, str]) -> str:
    return ", ".join(f"{name} ({kind})" for name, kind in sorted(types.items())[:30]) or "no message"


class _Content:
    """The content of the chosen topics, read in one pass: times [s] and keys of images and depth maps, the camera, and
    poses."""

    def __init__(self, bag: Bag, topics: _Topics) -> None:
        self.bag, self.topics = bag, topics
        self.lens: Lens | None = None
        self.images: list[tuple[float, MessageKey]] = []
        self.depths: list[tuple[float, MessageKey]] = []
        self._tree, self._body, self._camera, samples = ros.FrameTree(), "", "", list[ros.Sample]()
        tf = [name for name, kind in bag.topics.items() if kind == _TF]
        for key, message in bag.messages({*filter(None, topics[:4]), *tf}):
            if key.topic in tf:
                for transform in message.transforms:
                    self._tree.add(_stamp(transform, key), transform)
            elif key.topic == topics.pose:
                pose = message.pose if message.__msgtype__ == _POSES[1] else message.pose.pose
                samples.append(ros.sample(_stamp(message, key), pose.position, pose.orientation))
                self._body = ros.frame_name(getattr(message, "child_frame_id", ""))
            elif key.topic == topics.info:
                self._add_lens(message)
            elif key.topic == topics.depth:
                self.depths.append((_stamp(message, key), key))
            else:
                self.images.append((_stamp(message, key), key))
                self._camera = ros.frame_name(message.header.frame_id)
        self._trajectory = ros.trajectory(samples) if samples else None
        self._prepare()

    def _add_lens(self, message: Any) -> None:
        rectified = "rect" in self.topics.image
        lens = ros.lens(message, rectified, f"{self.bag.path}: {self.topics.info}")
        if self.lens not in (None, lens):
            raise ValueError(f"{self.bag.path}: {self.topics.info} changes from message to message: pass intrinsics")
        self.lens = lens

    def _prepare(self) -> None:
        """Find the frame of the poses. Raises ValueError: tf does not connect it with the camera, or nothing moves."""
        topics, chain = self.topics, self._tree.chain(self._camera)
        if not topics.pose:
            return
        if self._trajectory is None:  # tf
            self._body = topics.frame or chain[-1]
            if self._body not in chain or not self._tree.moves(chain[: chain.index(self._body)]):
                other = f"it has {', '.join(chain)}; name another one by --reader topics={topics.pose}=FRAME"
                how = f"how the image's frame {self._camera!r} moves in {self._body!r}"
                raise ValueError(f"{self.bag.path}: tf does not say {how}; {other}")
            return
        of_odometry = self.bag.topics[topics.pose] == _ODOMETRY
        self._body = topics.frame or (self._body if of_odometry else self._camera)
        if self._body != self._camera and not set(self._tree.chain(self._body)) & set(chain):
            what = f"{self._body!r}, whose poses {topics.pose} has, with the image's frame {self._camera!r}"
            remedy = f"if they are the camera's, say --reader topics={topics.pose}={self._camera}"
            raise ValueError(f"{self.bag.path}: tf does not connect {what}; {remedy}")

    def pose(self, time: float, max_gap: float) -> np.ndarray | None:
        """[4, 4] camera-to-world at ``time`` [s], or None."""
        T_body_camera = self._tree.between(self._camera, self._body, time, max_gap)
        if self._trajectory is None or T_body_camera is None:
            return T_body_camera
        T_world_body = interpolate_pose(self._trajectory, time, max_gap)
        return None if T_world_body is None else T_world_body @ T_body_camera


def _stamp(message: Any, key: MessageKey) -> float:
    """Time of a message's header, or of its reception [s]."""
    stamp = message.header.stamp
    return stamp.sec + stamp.nanosec * _NANOSECOND or key.received * _NANOSECOND

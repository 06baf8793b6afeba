"""Checks of one frame's input.

A wrong shape or dtype raises at once. A fault in the values (a pose that is not rigid, invalid intrinsics) becomes a
code per stream, so that the check does not synchronise with an accelerator; the caller raises or skips. Invalid pixels
are marked ``valid = False`` and counted.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from ufmstar_torch.anchors.anchors import Anchors
from ufmstar_torch.frames.arguments import (
    Array,
    CameraLike,
    as_intrinsics,
    as_pose,
    as_tensor,
    require_float,
    require_mask,
)
from ufmstar_torch.gaussians.camera import focal_and_centre, nearest_rotation, rotation_deviation

# Index = code. Each text finishes the sentence "stream b: ...".
FRAME_FAULTS = (
    "fine",
    "pose holds NaN or infinity; expected a finite camera-to-world matrix",
    "pose has a last row other than (0, 0, 0, 1); expected a rigid 4x4 camera-to-world matrix",
    "pose has a rotation that is not orthonormal within rotation_tolerance; expected a rigid 4x4 matrix",
    "pose has a reflection (negative determinant); expected a rotation",
    "intrinsics hold NaN or infinity; expected [[fx, 0, cx], [0, fy, cy], [0, 0, 1]] in pixels",
    "intrinsics are not [[fx, 0, cx], [0, fy, cy], [0, 0, 1]] with fx, fy > 0",
    "pose lies farther from the origin than 1e9 m, or than its dtype is exact to 1 cm (float32: 84 km, float16: 10 m); "
    "expected float64, or positions from which an origin was subtracted",
    "intrinsics have a focal length outside [0.01, 1e7] px",
    "intrinsics have their principal point outside the depth map; expected the intrinsics of the depth map, not those "
    "of an image of another size (ufmstar_torch.gaussians.camera.resize_intrinsics)",
)
NOT_FINITE = 1  # index of a pose with NaN or infinity
# Accepted ranges. Within them, no square or quotient of the algorithm leaves the range of float32.
DEPTH_RANGE = (1e-6, 1e6)  # [m]
LARGEST = 1e12  # A and E [m^2]
FOCAL_RANGE = (1e-2, 1e7)  # [px]
FARTHEST = 1e9  # [m] any coordinate of a camera


@dataclass(frozen=True)
class FrameInput:
    """A checked frame of B streams, all on the depth's device.

    Attributes:
        depth: [B, H, W] [m], float32 or float64; 0 where not valid.
        T_world_cam: [B, 4, 4] float64 camera-to-world, rotation projected onto SO(3); identity if faulty.
        intrinsics: [B, 3, 3] float64 [px]; the identity if faulty.
        aleatoric, epistemic: [B, H, W] [m^2] in the depth's dtype, or None.
        features: [B, 3, H, W] A, E and 1, which are averaged in H, or None.
        valid: [B, H, W] True where depth lies in ``DEPTH_RANGE`` and not beyond the largest depth, A and E in
            [0, ``LARGEST``], the caller's mask agrees and the stream has no fault.
        beyond: [B] number of pixels of the mask with a finite depth beyond the largest one.
        out_of_range: [B] number of other pixels of the mask with a finite positive depth that are not valid.
        valid_pixels: [B] number of valid pixels.
        fault: [B] int64 index into ``FRAME_FAULTS``, 0 = fine.
        rotation_deviation: [B] float64 max |R^T R - I| of the original pose.
        host_fault: ``fault`` on the CPU if pose and intrinsics were there, so that reading it does not wait; else None.
        member: [B] float64 index of the network, or of the random sample, that predicted; None = always the same.
        informative: [B] False where the image shows nothing, so that its depth is a guess; None = all True.
        anchors: of the frame, checked (``anchors.check``), or None.
        confidence: [B, H, W] float32, finite or NaN, the network's confidence; None = not predicted, or not used.
    """

    depth: Tensor
    T_world_cam: Tensor
    intrinsics: Tensor
    aleatoric: Tensor | None
    epistemic: Tensor | None
    features: Tensor | None
    valid: Tensor
    fault: Tensor
    rotation_deviation: Tensor
    beyond: Tensor
    out_of_range: Tensor
    valid_pixels: Tensor
    host_fault: Tensor | None = None
    member: Tensor | None = None
    informative: Tensor | None = None
    anchors: Anchors | None = None
    confidence: Tensor | None = None

    @property
    def size(self) -> tuple[int, int]:
        """Image height and width [px]."""
        return self.depth.shape[-2], self.depth.shape[-1]

    @property
    def informative_depth(self) -> Tensor:
        """The depth to segment [B, H, W]: 0 where not valid, and everywhere in an image that shows nothing."""
        if self.informative is None:
            return self.depth
        return torch.where(self.informative[:, None, None], self.depth, torch.zeros_like(self.depth))


def check_values(
    depth: Tensor, pose: Tensor, intrinsics: Tensor, aleatoric: Tensor | None, epistemic: Tensor | None,
    mask: Tensor | None, *, rotation_tolerance: float, max_depth: float,
) -> FrameInput:  # fmt: skip
    """Check a frame's values; the caller has checked shapes and dtypes. All maps have one dtype and device.

    Args:
        depth: [B, H, W] [m], detached, float32 or float64.
        pose: [B, 4, 4], or [1, 4, 4] or [4, 4] for all streams, of any floating dtype, on any device.
        intrinsics: likewise [B, 3, 3] and so on [px].
        aleatoric, epistemic: [B, H, W] [m^2] or None.
        mask: [B, H, W] bool, True = use, or None.
        rotation_tolerance, max_depth: as :func:`check_frame`.
    """
    device = depth.device
    pose, intrinsics = (of_streams(camera, len(depth)) for camera in (pose, intrinsics))
    deviation = rotation_deviation(pose[..., :3, :3])
    faults = pose_fault(pose, deviation, rotation_tolerance), intrinsics_fault(intrinsics, depth.shape[-2:])
    host_fault = _first(*faults, torch.device("cpu")) if pose.device.type == intrinsics.device.type == "cpu" else None
    fault = _first(*faults, device) if host_fault is None else _moved(host_fault, device)
    fine = fault == 0
    has_depth = (depth > 0) & (depth < torch.inf) & fine[:, None, None]  # NaN is neither
    if mask is not None:
        has_depth = has_depth & mask
    beyond = has_depth & (depth > max_depth)
    near = has_depth & ~beyond
    use = near & (depth >= DEPTH_RANGE[0]) & (depth <= DEPTH_RANGE[1])
    for variance in (aleatoric, epistemic):
        if variance is not None:
            use = use & (variance.detach() >= 0) & (variance.detach() <= LARGEST)
    T_safe, K_safe = _harmless(_moved(pose, device), _moved(intrinsics, device), fine)
    safe_depth = torch.where(use, depth, torch.zeros_like(depth))
    return FrameInput(
        safe_depth, T_safe, K_safe, aleatoric, epistemic, None, use, fault, _moved(deviation, device),
        beyond.sum((1, 2)), (near & ~use).sum((1, 2)), use.sum((1, 2)), host_fault,
    )  # fmt: skip


CheckKernel = Callable[..., FrameInput]  # as ``check_values``


def check_frame(
    depth: Tensor, pose: CameraLike, intrinsics: CameraLike, aleatoric: Array | None, epistemic: Array | None,
    valid: Array | None, *, variances_in_h: bool = False, rotation_tolerance: float,
    max_depth: float = DEPTH_RANGE[1], member: int | Tensor = 0, informative: Tensor | None = None,
    kernel: CheckKernel = check_values,
) -> FrameInput:  # fmt: skip
    """Check and normalise one frame (shapes as in :meth:`ufmstar_torch.UfMStar.forward`).

    Args:
        variances_in_h: the frame has features: A, E (0 where the network predicts none) and 1.
        rotation_tolerance: largest deviation of a pose's rotation from an orthogonal matrix.
        max_depth: farther pixels are not valid [m].
        member: index of the network, for all streams or [B].
        informative: [B] bool or None, see :class:`FrameInput`.
        kernel: an implementation of :func:`check_values`.

    Raises:
        TypeError: an argument is no tensor or has the wrong kind of dtype.
        ValueError: an argument has the wrong shape or lies on another device than ``depth``, or ``variances_in_h``
            without ``aleatoric``.
    """
    shape = tuple(require_float("depth", depth).shape)
    if not (len(shape) == 3 or (len(shape) == 4 and shape[1] == 1)) or 0 in shape:
        one = "; a single map is depth[None]" if len(shape) == 2 else ""
        raise ValueError(f"depth must be [B, H, W] or [B, 1, H, W] with no empty dimension, got {shape}{one}")
    dtype = torch.float64 if depth.dtype == torch.float64 else torch.float32
    size = (shape[0], *shape[-2:])
    plain = _as(_constant(depth), size, dtype)
    shapes = [shape, size]

    def converted(name: str, value: Array) -> Tensor:
        return _as(require_float(name, as_tensor(name, value), shapes, depth), size, dtype)

    a = None if aleatoric is None else converted("aleatoric", aleatoric)
    e = None if epistemic is None else converted("epistemic", epistemic)
    T, K = _of_depth("pose", as_pose(pose), plain), _of_depth("intrinsics", as_intrinsics(intrinsics), plain)
    mask = None
    if valid is not None:
        either = [*shapes, (shape[0], 1, *shape[-2:])]
        mask = _as(require_mask("valid", as_tensor("valid", valid), either, depth), size, torch.bool)
    frame = kernel(plain, T, K, a, e, mask, rotation_tolerance=rotation_tolerance, max_depth=max_depth)
    if variances_in_h:
        frame = replace(frame, features=_variances(a, e, plain))
    if informative is not None:
        if not isinstance(informative, Tensor) or informative.dtype != torch.bool or informative.shape != shape[:1]:
            raise ValueError(f"informative must be a bool tensor [{len(plain)}], got {informative!r}")
        informative = _moved(informative, plain.device)
        if informative.is_cpu and bool(informative.all()):
            informative = None
    if informative is None and isinstance(member, int) and member == 0:
        return frame
    if isinstance(member, Tensor):
        index = _moved(member.to(torch.float64), plain.device).expand(shape[0])
    else:  # filled on the device: a copy would synchronise
        index = torch.full(shape[:1], float(member), dtype=torch.float64, device=plain.device)
    return replace(frame, member=index, informative=informative)


def as_confidence(values: object, frame: FrameInput) -> Tensor:
    """Convert a confidence to [B, H, W] float32, clamped to finite values. Raises TypeError, ValueError: not a map of
    the depth's shape."""
    size = tuple(frame.depth.shape)
    c = require_float("confidence", values, [size, (size[0], 1, *size[1:])], frame.depth).detach()
    limit = torch.finfo(torch.float32).max
    return c.reshape(size).float().clamp(-limit, limit)


def raise_faults(frame: FrameInput) -> None:
    """Raise a ValueError that names every faulty stream; waits for an accelerator unless the camera was on the CPU.

    Raises:
        ValueError: a stream is faulty, or the frame has no values.
    """
    fault = frame.fault if frame.host_fault is None else frame.host_fault
    if fault.is_meta:
        raise ValueError("depth lies on device meta, without values: set on_bad_frame='skip'")
    if any(faults := fault.tolist()):
        raise ValueError("; ".join(f"stream {b}: {FRAME_FAULTS[code]}" for b, code in enumerate(faults) if code))


def _variances(aleatoric: Tensor | None, epistemic: Tensor | None, plain: Tensor) -> Tensor:
    """[B, 3, H, W] A, E and 1; 0 for one that the network does not predict."""
    if aleatoric is None and epistemic is None:
        raise ValueError("aleatoric or epistemic must be given with config.variances_in_h, which averages them")
    maps = (torch.zeros_like(plain) if value is None else _constant(value) for value in (aleatoric, epistemic))
    return torch.stack([*maps, torch.ones_like(plain)], 1)


def _of_depth(name: str, value: Tensor, plain: Tensor) -> Tensor:
    """A checked camera on its original device (the check of a pose on the CPU does not wait for an accelerator)."""
    if value.dim() == 3 and value.shape[0] not in (1, plain.shape[0]):
        raise ValueError(f"{name} must have depth's {plain.shape[0]} streams, got {value.shape[0]}")
    if value.is_meta and not plain.is_meta:
        raise ValueError(f"{name} must hold values, got a tensor on device meta")
    return _constant(value)


def of_streams(cameras: Tensor, streams: int) -> Tensor:
    """[B, n, n] float64 of [B, n, n], [1, n, n] or [n, n]."""
    return cameras.double().expand(streams, *cameras.shape[-2:])


# A torch call takes microseconds, several times longer right after a network: these helpers skip calls without effect.
def _constant(value: Tensor) -> Tensor:
    """The tensor without its graph."""
    return value.detach() if value.requires_grad else value


def _as(value: Tensor, shape: tuple[int, ...], dtype: torch.dtype) -> Tensor:
    """The tensor in a shape and dtype."""
    value = value if value.dtype == dtype else value.to(dtype)
    return value if value.shape == shape else value.reshape(shape)


def _moved(value: Tensor, device: torch.device) -> Tensor:
    """On ``device``; copies to an accelerator are queued, not waited for."""
    return value.to(device, non_blocking=device.type != "cpu")


def pose_fault(T: Tensor, deviation: Tensor, tolerance: float) -> Tensor:
    """[B] codes 1 to 4 and 7, on the pose's device."""
    zero = torch.zeros((), dtype=T.dtype, device=T.device)
    last = torch.stack([zero, zero, zero, zero + 1])
    checks = [
        ~T.isfinite().all((-2, -1)),
        (T[:, 3] - last).abs().amax(-1) > tolerance,
        deviation > tolerance,
        (torch.linalg.cross(T[:, 0, :3], T[:, 1, :3]) * T[:, 2, :3]).sum(-1) < 0,  # the determinant
    ]
    far = T[:, :3, 3].abs().amax(-1) > FARTHEST
    return _code({**dict(enumerate(checks, start=1)), 7: far})


def intrinsics_fault(K: Tensor, size: tuple[float, ...]) -> Tensor:
    """[B] codes 5, 6, 8 and 9 for a depth map of ``size`` (H, W), on the intrinsics' device."""
    off_diagonal = K[:, 0, 1].abs() + K[:, 1, 0].abs() + K[:, 2, :2].abs().sum(-1)
    shape = (off_diagonal != 0) | (K[:, 2, 2] != 1) | (K[:, 0, 0] <= 0) | (K[:, 1, 1] <= 0)
    fx, fy, cx, cy = focal_and_centre(K)
    low, high = FOCAL_RANGE
    focal = (torch.minimum(fx, fy) < low) | (torch.maximum(fx, fy) > high)
    outside = (torch.minimum(cx, cy) < -0.5) | (cx > size[1] - 0.5) | (cy > size[0] - 0.5)
    return _code({5: ~K.isfinite().all((-2, -1)), 6: shape, 8: focal, 9: outside})


def _code(checks: dict[int, Tensor]) -> Tensor:
    """The number of the first check that is True, 0 for none."""
    first = next(iter(checks.values()))
    fault = torch.zeros(first.shape, dtype=torch.int64, device=first.device)
    for code, bad in reversed(checks.items()):
        fault = torch.where(bad, torch.full_like(fault, code), fault)
    return fault


def _first(fault: Tensor, other: Tensor, device: torch.device) -> Tensor:
    fault, other = _moved(fault, device), _moved(other, device)
    return torch.where(fault > 0, fault, other)


def _harmless(T: Tensor, K: Tensor, fine: Tensor) -> tuple[Tensor, Tensor]:
    """Poses with exact rotations, and intrinsics; identities in place of faulty ones."""
    eye4 = torch.eye(4, dtype=T.dtype, device=T.device)
    eye3 = torch.eye(3, dtype=K.dtype, device=K.device)
    mask = fine[:, None, None]
    T = torch.where(mask, T, eye4)
    upper = torch.cat([nearest_rotation(T[:, :3, :3]), T[:, :3, 3:]], dim=-1)
    return torch.cat([upper, eye4[3:].expand(T.shape[0], 1, 4)], dim=1), torch.where(mask, K, eye3)

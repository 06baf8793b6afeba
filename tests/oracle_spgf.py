"""SPGF as NumPy float64 loops, written from the specification alone: the reference for both implementations.

Accumulates raw moments pixel by pixel. Imports neither torch nor the package.
"""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Settings:
    """The specification's thresholds, under its names; ``a`` applies at the image's resolution."""

    a: float
    noise_floor: float
    noise_thresh: float
    line_t: float
    occ_x: int
    n_check: int
    max_open: int
    angle: float
    sparse: int
    min_gaussian_length: float
    frame_max_scale: float
    max_depth: float


@dataclass(frozen=True)
class Camera:
    """Pinhole intrinsics [px]."""

    fx: float
    fy: float
    cx: float
    cy: float


@dataclass
class Piece:
    """A segment or an active Gaussian: the specification's fields and its pixels."""

    N: int
    S: Array
    J: Array
    W: float
    pL: Array
    pR: Array
    uL: int
    uR: int
    l: Array
    k: int
    n: int = 1
    mu0: Array = field(default_factory=lambda: np.zeros(3))
    pi: Array = field(default_factory=lambda: np.zeros(3))
    pi2: float = 0.0
    upd: bool = False
    pixels: list[tuple[int, int]] = field(default_factory=list)

    @property
    def mu(self) -> Array:
        return self.S / self.N

    @property
    def covariance(self) -> Array:
        """Sample covariance; a single pixel has none (zeros)."""
        if self.N == 1:
            return np.zeros((3, 3))
        return (self.J - np.outer(self.S, self.S) / self.N) / (self.N - 1)


def bins(settings: Settings, camera: Camera, height: int, width: int) -> tuple[list[float], list[float]]:
    """Lengths of the depth bins and their cumulative far edges [m]."""
    L0 = settings.min_gaussian_length
    Lmax = settings.frame_max_scale * L0
    s = 0.5 * min(width / camera.fx, height / camera.fy)
    lengths, edges, saturated = [L0], [L0], False
    while edges[-1] < settings.max_depth:
        length = s * edges[-1]
        saturated = saturated or length > Lmax
        length = Lmax if saturated else max(length, L0)
        lengths.append(length)
        edges.append(edges[-1] + length)
    return lengths, edges


def segment(
    depth: NDArray[np.floating],
    camera: Camera,
    settings: Settings,
    *,
    valid: NDArray[np.bool_] | None = None,
) -> tuple[list[Piece], NDArray[np.int64]]:
    """All Gaussians in emission order, before pruning, and the label of every pixel (-1 = none)."""
    height, width = depth.shape
    z = np.asarray(depth, dtype=np.float64)
    with np.errstate(invalid="ignore"):
        use = np.isfinite(z) & (z > 0) & (z <= settings.max_depth)
    if valid is not None:
        use &= valid
    frame = _Frame(z, use, camera, settings, *bins(settings, camera, height, width))

    active: list[Piece] = []
    emitted: list[Piece] = []
    for v in range(height):
        before = active
        for o in before:
            o.upd = False
        new = [h for h in frame.scanline(v) if not frame.merge(h, before)]
        last = v == height - 1  # then all complete at once, in the order of the active list
        emitted += [o for o in before if not o.upd and not last]
        active = [o for o in before if o.upd or last] + new
    emitted += active

    labels = np.full((height, width), -1, dtype=np.int64)
    for g, piece in enumerate(emitted):
        for v, u in piece.pixels:
            labels[v, u] = g
    return emitted, labels


@dataclass
class _Frame:
    z: Array
    use: NDArray[np.bool_]
    camera: Camera
    settings: Settings
    lengths: list[float]
    edges: list[float]

    @property
    def slope(self) -> float:
        """a / f [1/m]."""
        return self.settings.a / min(self.camera.fx, self.camera.fy)

    def scanline(self, v: int) -> list[Piece]:
        out: list[Piece] = []
        queue: deque[Piece] = deque()  # newest first
        for u in np.flatnonzero(self.use[v]).tolist():
            z = float(self.z[v, u])
            c = self.camera
            p = np.array([(u - c.cx) * z / c.fx, (v - c.cy) * z / c.fy, z])
            moment = np.outer(p, p)
            k = sum(edge < z for edge in self.edges)
            for o in queue:
                if self._fits(o, u, p, k):
                    self._extend(o, u, v, p, moment, k)
                    break
            else:
                start = Piece(1, p, moment, math.sqrt(float(p @ p)), p, p, u, u, np.zeros(3), k, pixels=[(v, u)])
                queue.appendleft(start)
                if len(queue) > self.settings.max_open:
                    out.append(queue.pop())
        sparse = self.settings.sparse
        return [o for o in [*out, *queue] if sparse < o.N]

    def _fits(self, o: Piece, u: int, p: Array, k: int) -> bool:
        w = o.pR - o.pL
        if u - o.uR > self.settings.occ_x or not float(w @ w) < self.lengths[k] ** 2:
            return False
        x, _, z = (float(value) for value in p)
        t = self.slope * z * z
        low = self.settings.noise_floor
        tau_z = min(max(6 * t, low), self.settings.noise_thresh)
        n_check = self.settings.n_check
        if n_check >= o.N:
            tau_x = min(max(t, low), self.settings.line_t)
            return bool(abs(z - o.pR[2]) < tau_z and abs(x - o.pR[0]) < tau_x)
        lx, _, lz = (float(value) for value in o.l)
        return lx != 0 and bool(abs(o.pL[2] + lz * (x - o.pL[0]) / lx - z) < tau_z)

    @staticmethod
    def _extend(o: Piece, u: int, v: int, p: Array, moment: Array, k: int) -> None:
        o.N += 1
        o.S = o.S + p
        o.J = o.J + moment
        o.W += math.sqrt(float(p @ p))
        o.pR, o.uR = p, u
        o.l = o.l + (p - o.pL)
        o.k = min(o.k, k)
        o.pixels.append((v, u))

    def merge(self, h: Piece, before: list[Piece]) -> bool:
        best, o = 0.0, None
        for candidate in before:
            overlap = min(candidate.uR, h.uR) - max(candidate.uL, h.uL)
            if overlap > 0:
                rho = overlap / (max(candidate.uR, h.uR) - min(candidate.uL, h.uL))
                if rho > best:
                    best, o = rho, candidate
        if o is None or not self._same_plane(o, h):
            return False
        mu_h = h.mu
        o.N, o.W, o.S, o.J, o.l = o.N + h.N, o.W + h.W, o.S + h.S, o.J + h.J, o.l + h.l
        o.uL, o.uR = (o.uL + h.uL) // 2, (o.uR + h.uR) // 2
        if o.n == 1:
            o.mu0 = o.S / o.N
            o.pi = mu_h - o.mu0
        else:
            o.pi = o.pi + (mu_h - o.mu0)
        o.pi2 = float((mu_h - o.mu0) @ (mu_h - o.mu0))
        o.n += 1
        o.k = min(o.k, h.k)
        o.upd = True
        o.pixels += h.pixels
        return True

    def _same_plane(self, o: Piece, h: Piece) -> bool:
        if not o.pi2 < self.lengths[o.k] ** 2:
            return False
        a, b = h.l[[0, 2]], o.l[[0, 2]]
        if not float(a @ b) ** 2 > self.settings.angle**2 * float(a @ a) * float(b @ b):
            return False
        mu_o, mu_h = o.mu, h.mu
        if o.n == 1:
            return bool(abs(mu_o[2] - mu_h[2]) < 6 * self.slope * mu_o[2] * mu_o[2])
        nu = np.cross(o.l, o.pi)
        return float(nu @ (mu_o - mu_h)) ** 2 < float(nu @ nu) * self.settings.noise_floor**2

"""Anchors of a depth camera: its depth, thinned to what the posterior can use, with the variance of its kind of sensor.

The sensor's depth has holes, ends at a range and is wrong at edges. There, its depths of earlier frames
(:class:`SensorMemory`) and landmarks of the images complete it (:func:`completed`), the latter less the common errors
that the sensor shows where both measure. With rho an inverse depth, u and v from -1 to 1, and wrong poses that shift
and turn the images' inverse depths,

    rho_image - rho_sensor = b . (1, u, v, rho_image) + e.

b is normal with the variances that the landmarks state for their common errors: ``Landmarks.shared`` for the first
three, ``Landmarks.scale`` for the last. e is Student-t distributed, with the landmark's own variance and the sensor's.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import torch
from numpy.typing import NDArray
from torch.nn.functional import max_pool2d

from ufmstar_torch.anchors.landmarks import Landmarks
from ufmstar_torch.runtime.kinds import check_kinds

# Cells of the image on each side, of which each gives at most one anchor: the nodes of the posterior's grid.
_CELLS = 28
# Candidates in a cell on each side; larger maps are subsampled.
_CANDIDATES = 6
# Side of the neighbourhood of a candidate [px], in which depths differ at most by this share of the depth and this many
# standard deviations: at edges, sensors measure the wrong surface or a mean of two.
_SIDE, _SHARE, _SIGMAS = 5, 0.02, 3.0
# Degrees of freedom of e, and iterations of the reweighting. Least variance of a coefficient of b, against division by
# 0: 1e-5/m, which is 1 mm in a depth of 10 m.
_FREEDOM, _ITERATIONS, _LEAST = 2.0, 8, 1e-10
# Least share of a landmark's variance that is independent; least inverse depth, as a share of that measured.
_INDEPENDENT, _NEAREST_ZERO = 0.1, 0.1
# Limits for landmarks of the images in holes: depth over that of the nearest sensor landmark, and standard deviation
# over depth. A landmark below the first and above the second is left out. Most of these are wrong, because weak matches
# and patches at depth edges measure the nearer surface. Most certain near ones are right: a sensor misses black things.
_SHARE_BESIDE, _UNCERTAIN = 0.8, 0.05
# Number of stored points; width to which depth maps are reduced to store and show points [px]; share of the depth that
# wrong poses add to its standard deviation.
_STORED, _WIDTH, _POSES = 4096, 320, 0.01
# A point is stored if its surroundings of this side [px] have a depth everywhere: a hole may begin at an edge. In a
# hole it is visible if nothing in these surroundings [px] is nearer by more than this factor.
_WHOLE, _AROUND, _NEARER = 7, 11, 1.1
# Least share of the points on measured pixels that lie within this factor of the measured depth; with less, the poses
# contradict the depths, and all points are deleted.
_LEAST_AGREEING, _AGREEING = 0.5, 1.1


# Standard deviation of a depth z, sigma = a + b z + c z^2 [m], by kind of sensor. Stereo and structured light measure a
# disparity: .0019 z^2 for a Kinect (Nguyen, Izadi and Lovell, 2012), .0037 z^2 for a RealSense D435 with a matching
# error of .08 px. Time of flight: 1 cm and 1 %; Azure Kinect's data sheet states 11 mm + .1 %, and a noise of 17 mm.
_SIGMA = {"stereo": (0.001, 0.0, 0.003), "tof": (0.01, 0.01, 0.0)}
SENSORS = tuple(_SIGMA)


@check_kinds
def sensor_landmarks(
    depth: NDArray[np.float32],
    K_depth: NDArray[np.float64],
    K: NDArray[np.float64],
    kind: str = "stereo",
) -> Landmarks:
    """At most one depth in each of 28 x 28 cells, that nearest to the cell's centre, away from depth edges.

    Args:
        depth: [H, W] of the sensor, 0 = none [m].
        K_depth: [3, 3] of the depth map [px].
        K: [3, 3] of the image, which has the same pose [px].
        kind: of the sensor: "stereo" (also structured light) or "tof".

    Returns:
        Landmarks in the pixels of the image.

    Raises:
        ValueError: ``depth`` is no map, or an unknown kind.
    """
    if kind not in SENSORS:
        raise ValueError(f"kind must be one of {', '.join(SENSORS)}, got {kind!r}")
    if depth.ndim != 2 or not np.issubdtype(depth.dtype, np.floating):
        raise ValueError(f"depth must be a map [H, W] of floating-point numbers, got {depth.dtype} {depth.shape}")
    size = np.array(depth.shape)
    step = max(1, int(size.min()) // (_CELLS * _CANDIDATES))
    v, u = (step * index for index in np.nonzero(_away_from_edges(depth, kind)[::step, ::step]))
    row, column = _CELLS * v // size[0], _CELLS * u // size[1]
    off_centre = np.hypot(_CELLS * (v + 0.5) / size[0] - row - 0.5, _CELLS * (u + 0.5) / size[1] - column - 0.5)
    cell = row * _CELLS + column
    order = np.lexsort((off_centre, cell))
    chosen = order[np.diff(cell[order], prepend=-1) > 0]
    v, u = v[chosen], u[chosen]
    z = depth[v, u].astype(np.float64)
    mapping = K @ np.linalg.inv(K_depth)
    pixel = np.stack([u, v, np.ones_like(u)], axis=-1) @ mapping.T
    return Landmarks(pixel[:, :2], z, np.square(sensor_sigma(z, kind)), len(z), none="no depth of the sensor")


def completed(sensor: Landmarks, others: Landmarks, depth: NDArray[np.float32], kind: str = "stereo") -> Landmarks:
    """The sensor's landmarks, and plausible ones of the images on pixels without the sensor's depth, less the common
    errors that the sensor shows.

    Args:
        sensor: in the pixels of the image.
        others: likewise; their figures of poses are those of the result.
        depth: [H, W] of the sensor at the image's pixels, 0 = none [m].
        kind: of the sensor, as for :func:`sensor_landmarks`.
    """
    if not len(others.depth):  # then its common errors concern no depth
        others = replace(others, shared=0.0, scale=0.0)
    row, column = _nearest_pixel(others.pixel, depth.shape)
    z = np.where(_away_from_edges(depth, kind), depth, np.float32(0))[row, column].astype(np.float64)
    corrected = _without_common_errors(others, z, depth.shape, kind)
    apart = _none_around(depth > 0)[row, column] & ~_too_near(corrected, sensor)
    return replace(
        corrected,
        pixel=np.concatenate([sensor.pixel, corrected.pixel[apart]]),
        depth=np.concatenate([sensor.depth, corrected.depth[apart]]),
        variance=np.concatenate([sensor.variance, corrected.variance[apart]]),
        motion=None,  # the sensor measures what moves, too
        tracked=sensor.tracked + others.tracked,
    )


class SensorMemory:
    """The last points that a depth camera has measured, for the holes of later frames; none at first."""

    def __init__(self) -> None:
        self._point, self._sigma = np.empty((0, 3)), np.empty(0)  # in the world, and of their depths [m]

    @property
    def bytes(self) -> int:
        """Size of the points."""
        return self._point.nbytes + self._sigma.nbytes

    def extended(
        self, sensor: Landmarks, depth: NDArray[np.float32], T_world_cam: NDArray[np.float64], K: NDArray[np.float64]
    ) -> Landmarks:
        """The sensor's landmarks, and in its holes the points of earlier frames, at most one in each of 28 x 28 cells.
        Points on measured pixels are deleted, and the landmarks are stored.

        Args:
            sensor: in the pixels of the image.
            depth: [H, W] of the sensor at the image's pixels, 0 = none [m].
            T_world_cam: [4, 4] of the image [m]; if it is not finite, nothing is added or stored.
            K: [3, 3] of the image [px].
        """
        if not np.isfinite(T_world_cam).all():
            return sensor
        step = max(1, round(depth.shape[1] / _WIDTH))
        small = np.where(depth > 0, depth, np.float32(0))[::step, ::step]
        pixel, z, row, column = self._projected(T_world_cam, K, step, small.shape)
        found = np.where(row >= 0, small[row, column], 0)
        measured = found > 0
        off = np.abs(np.log(z[measured] / found[measured])) > np.log(_AGREEING)
        chosen = self._visible(small, z, row, column)
        if off.sum() > (1 - _LEAST_AGREEING) * len(off):
            chosen, measured = chosen[:0], np.ones(len(z), np.bool_)
        variance = np.square(self._sigma[chosen]) + np.square(_POSES * z[chosen])
        self._store(sensor, small, T_world_cam, K, step, ~measured)
        return replace(
            sensor,
            pixel=np.concatenate([sensor.pixel, pixel[chosen]]),
            depth=np.concatenate([sensor.depth, z[chosen]]),
            variance=np.concatenate([sensor.variance, variance]),
        )

    def _projected(
        self, T: NDArray[np.float64], K: NDArray[np.float64], step: int, size: tuple[int, ...]
    ) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.int64], NDArray[np.int64]]:
        """Pixels [N, 2] of the points and their depths [N]; row and column [N] in the reduced depth map of this size,
        -1 outside."""
        in_camera = (self._point - T[:3, 3]) @ T[:3, :3]
        z = in_camera[:, 2]
        ahead = z > 0
        pixel = (in_camera @ K.T)[:, :2] / np.where(ahead, z, 1)[:, None]
        column, row = np.rint(pixel.T / step)
        inside = ahead & (row >= 0) & (row < size[0]) & (column >= 0) & (column < size[1])
        row, column = (np.where(inside, x, -1).astype(np.int64) for x in (row, column))
        return pixel, np.where(ahead, z, 1), row, column

    def _visible(
        self, depth: NDArray[np.float32], z: NDArray[np.float64], row: NDArray[np.int64], column: NDArray[np.int64]
    ) -> NDArray[np.int64]:
        """Indices of the newest point of each cell among those in holes that nothing hides."""
        inside, rho = row >= 0, (1 / z).astype(np.float32)
        nearest = np.where(depth > 0, 1 / np.where(depth > 0, depth, 1), 0).astype(np.float32)
        np.maximum.at(nearest, (row[inside], column[inside]), rho[inside])
        hidden = _NEARER * rho < _spread(nearest, _AROUND)[row, column]
        index = np.flatnonzero(inside & _none_around(depth > 0)[row, column] & ~hidden)[::-1]  # the newest first
        cell = (_CELLS * row[index] // depth.shape[0]) * _CELLS + _CELLS * column[index] // depth.shape[1]
        return index[np.unique(cell, return_index=True)[1]]

    def _store(
        self, sensor: Landmarks, depth: NDArray[np.float32], T: NDArray[np.float64], K: NDArray[np.float64], step: int,
        retained: NDArray[np.bool_],
    ) -> None:  # fmt: skip
        """Store the landmarks away from holes behind the ``retained`` points."""
        whole = _none_around(depth <= 0, _WHOLE)[_nearest_pixel(sensor.pixel / step, depth.shape)]
        ray = np.concatenate([sensor.pixel[whole], np.ones((int(whole.sum()), 1))], axis=1) @ np.linalg.inv(K).T
        point = (sensor.depth[whole, None] * ray) @ T[:3, :3].T + T[:3, 3]
        self._point = np.concatenate([self._point[retained], point])[-_STORED:]
        self._sigma = np.concatenate([self._sigma[retained], np.sqrt(sensor.variance[whole])])[-_STORED:]


def _too_near(others: Landmarks, sensor: Landmarks) -> NDArray[np.bool_]:
    """[N] True for uncertain landmarks of the images that are much nearer than the nearest landmark of the sensor."""
    if not len(sensor.depth):
        return np.zeros(len(others.depth), np.bool_)
    nearest = np.square(others.pixel[:, None] - sensor.pixel).sum(axis=-1).argmin(axis=1)
    uncertain = others.variance > np.square(_UNCERTAIN * others.depth)
    return uncertain & (others.depth < _SHARE_BESIDE * sensor.depth[nearest])


def _without_common_errors(others: Landmarks, z: NDArray[np.float64], size: tuple[int, ...], kind: str) -> Landmarks:
    """The landmarks less b . x, with the variances after that (the module's equation).

    Args:
        others: of the images.
        z: [N] the sensor's depth at their pixels, 0 = none [m].
        size: (H, W) of the image.
        kind: of the sensor.
    """
    seen, rho = z > 0, 1 / others.depth
    total, shared, scale = others.variance * rho**4, others.shared, others.scale
    if not seen.any() or not np.isfinite(shared):
        return others
    u, v = 2 * (others.pixel.T + 0.5) / np.array([size[1], size[0]])[:, None] - 1
    x = np.stack([np.ones_like(rho), u, v, rho], axis=-1)
    independent = np.maximum(total - shared - scale * rho**2, _INDEPENDENT * total)
    x_seen, z = x[seen], z[seen]
    noise = independent[seen] + np.square(sensor_sigma(z, kind) / z**2)
    prior, weight = np.diag(1 / np.maximum([shared, shared, shared, scale], _LEAST)), 1 / noise
    for _ in range(_ITERATIONS):
        covariance = np.linalg.inv(prior + (x_seen.T * weight) @ x_seen)
        b = covariance @ x_seen.T @ (weight * (rho[seen] - 1 / z))
        residual = rho[seen] - 1 / z - x_seen @ b
        weight = (_FREEDOM + 1) / (_FREEDOM * noise + np.square(residual))
    depth = 1 / np.maximum(rho - x @ b, _NEAREST_ZERO * rho)
    variance = np.minimum(independent + np.einsum("ni,ij,nj->n", x, covariance, x), total) * depth**4
    return replace(others, depth=depth, variance=variance)


def sensor_sigma(z: NDArray[np.float64], kind: str) -> NDArray[np.float64]:
    """Standard deviations of depths z that a kind of ``SENSORS`` measures, of the same shape [m]."""
    a, b, c = _SIGMA[kind]
    return a + b * z + c * np.square(z)


def _away_from_edges(depth: NDArray[np.float32], kind: str) -> NDArray[np.bool_]:
    """[H, W] True where there is a depth, and those around it are similar."""
    valid = np.isfinite(depth) & (depth > 0)
    farthest = _spread(np.where(valid, depth, 0).astype(np.float32))
    nearest = 1 / _spread(np.where(valid, 1 / np.where(valid, depth, 1), 1e-6).astype(np.float32))
    z = np.where(valid, depth, 0).astype(np.float64)
    return valid & (farthest - nearest <= _SHARE * z + _SIGMAS * sensor_sigma(z, kind))


def _nearest_pixel(pixel: NDArray[np.float64], size: tuple[int, ...]) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Rows and columns [N] of the nearest pixels of a map [H, W] to the positions (u, v) ``pixel`` [N, 2]."""
    column, row = np.rint(pixel).astype(np.int64).clip(0, (size[1] - 1, size[0] - 1)).T
    return row, column


def _none_around(mask: NDArray[np.bool_], side: int = _SIDE) -> NDArray[np.bool_]:
    """[H, W] True where the mask is False in the whole square of ``side`` pixels."""
    return _spread(mask.astype(np.float32), side) == 0


def _spread(values: NDArray[np.float32], side: int = _SIDE) -> NDArray[np.float32]:
    """[H, W] the largest value in a square of ``side`` pixels."""
    largest = torch.from_numpy(np.ascontiguousarray(values))[None, None]
    for size in ((1, side), (side, 1)):
        largest = max_pool2d(largest, size, 1, (size[0] // 2, size[1] // 2))
    return np.asarray(largest[0, 0].numpy())

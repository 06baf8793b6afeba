"""Windows of images: sampled, normalised, compared by ZNCC, and refined to a fraction of a pixel along a line.

On the CPU (numba). Windows have an even side: their centres lie between pixels, and a row of eight pixels is copied at
once. Loops run over all pixels of a window, so that they are vectorised. ``tests/oracle_dense.py`` is the same in
NumPy.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ufmstar_torch.kernels.compile_cpu import reordered_leaf
from ufmstar_torch.kernels.cpu.vectors import LANES, Lanes, vectors

# [px] Side of the compared windows, and offset of their first pixel from the centre.
SIDE, FIRST = 8, -3.5
COUNT = SIDE * SIDE
# A template is a pixel wider than the window on each side; offsets of its pixels from the centre.
WIDE = SIDE + 2
_RIGHT = np.tile(np.arange(WIDE, dtype=np.float32) + np.float32(FIRST - 1), WIDE)
_DOWN = np.repeat(np.arange(WIDE, dtype=np.float32) + np.float32(FIRST - 1), WIDE)
# The same for the pixels of the window.
_INSIDE_RIGHT = np.tile(np.arange(SIDE, dtype=np.float32) + np.float32(FIRST), SIDE)
_INSIDE_DOWN = np.repeat(np.arange(SIDE, dtype=np.float32) + np.float32(FIRST), SIDE)
# [gray levels] Least standard deviation of a compared window: below it there is only noise.
LEAST_CONTRAST = 2.0
# [px] Pixels nearer to the border are not measured.
MARGIN = 6
# Most steps of the refinement, length of a step at which it has converged, and largest distance of the refined position
# from the start [px].
STEPS, CONVERGED, FARTHEST = 5, 0.01, 1.5
# Largest change of scale between the patch and its image in the keyframe.
LARGEST_SCALE = 2.0


def eights(images: NDArray[np.uint8]) -> NDArray[np.uint64]:
    """View images [V, H, W] as [V, H W - 7] numbers: each holds eight consecutive pixels."""
    views, size = len(images), images.shape[1] * images.shape[2]
    return np.ndarray((views, max(size - SIDE + 1, 0)), np.uint64, images, strides=(size, 1))


@reordered_leaf
def sampled(flat, width, height, u, v, a, b, c, d, corner, share, template):
    """The pixels of an image at (u, v) + ((a, b), (c, d)) x, for the pixels x of a template, bilinear. ``corner`` and
    ``share`` are buffers. False where one lies outside."""
    far_u, far_v = (abs(a) + abs(b)) * (1 - FIRST), (abs(c) + abs(d)) * (1 - FIRST)
    if not (far_u <= u < width - 1.01 - far_u and far_v <= v < height - 1.01 - far_v):  # .01: for rounding
        return False
    u, v, a, b, c, d = np.float32(u), np.float32(v), np.float32(a), np.float32(b), np.float32(c), np.float32(d)
    for k in range(WIDE * WIDE):
        su, sv = u + a * _RIGHT[k] + b * _DOWN[k], v + c * _RIGHT[k] + d * _DOWN[k]
        iu, iv = np.int32(su), np.int32(sv)
        share[0, k], share[1, k] = su - np.float32(iu), sv - np.float32(iv)
        corner[k] = np.uint32(iv * np.int32(width) + iu)
    for k in range(WIDE * WIDE):  # the four pixels around, as the bytes of a number, which vector code unpacks
        at = np.uint64(corner[k])
        below = at + np.uint64(width)
        upper, lower = (flat[at + np.uint64(1)] << 8) | flat[at], (flat[below + np.uint64(1)] << 8) | flat[below]
        corner[k] = np.uint32((lower << 16) | upper)
    for k in range(WIDE * WIDE):
        upper, lower = np.float32(np.int32(corner[k] & 255)), np.float32(np.int32(corner[k] >> 16 & 255))
        upper += share[0, k] * (np.float32(np.int32(corner[k] >> 8 & 255)) - upper)
        lower += share[0, k] * (np.float32(np.int32(corner[k] >> 24)) - lower)
        template[k] = upper + share[1, k] * (lower - upper)
    return True


@reordered_leaf
def normalised(template, patch, along_u, along_v):
    """Write the window of a template with mean 0 and norm 1, and its gradients of mean 0 [1/px]. False without
    contrast."""
    mean = mean_u = mean_v = squares = np.float32(0)
    half = np.float32(0.5)
    for j in range(SIDE):
        for i in range(SIDE):
            k, at = j * SIDE + i, (j + 1) * WIDE + i + 1
            patch[k] = template[at]
            along_u[k] = half * (template[at + 1] - template[at - 1])
            along_v[k] = half * (template[at + WIDE] - template[at - WIDE])
    for k in range(COUNT):
        mean += patch[k]
        mean_u += along_u[k]
        mean_v += along_v[k]
    mean, mean_u, mean_v = mean / np.float32(COUNT), mean_u / np.float32(COUNT), mean_v / np.float32(COUNT)
    for k in range(COUNT):
        patch[k] -= mean
        squares += patch[k] * patch[k]
    if squares <= COUNT * LEAST_CONTRAST * LEAST_CONTRAST:
        return False
    over = np.float32(1 / np.sqrt(squares))
    for k in range(COUNT):
        patch[k] *= over
        along_u[k] = (along_u[k] - mean_u) * over
        along_v[k] = (along_v[k] - mean_v) * over
    return True


@reordered_leaf
def copy_rows(key, at, width, count, rows):
    """Copy ``count`` rows of SIDE pixels of an image (:func:`eights`), the first one at index ``at``, to ``rows``."""
    for j in range(count):
        rows[j] = key[np.uint64(at)]
        at += width


@reordered_leaf
def zncc(patch, window):
    """The correlation of a normalised patch and a window; -1 where the window has no contrast."""
    total = squares = cross = np.float32(0)
    for k in range(COUNT):
        total += window[k]
        squares += window[k] * window[k]
        cross += patch[k] * window[k]
    return _zncc(total, squares, cross)


@reordered_leaf
def _zncc(total, squares, cross):
    deviation = squares - total * total / np.float32(COUNT)
    if deviation <= COUNT * LEAST_CONTRAST * LEAST_CONTRAST:
        return np.float32(-1)
    return cross / np.sqrt(deviation)


@vectors
def _sum(code, patch, pixels, starts, count, width, sums):
    """Write the sums of values, squares, and products with a patch for ``count`` windows, in ``LANES`` parts each."""
    patches = [patch.load(0, LANES * pair) for pair in range(SIDE // 2)]
    with code.loop(count) as w:
        row, values = starts.whole(w), list[Lanes]()
        for _ in patches:
            values.append(pixels.load_rows((row, code.plus(row, width)), SIDE).floats())
            row = code.plus(row, code.times(width, 2))
        for at, (a, b, c, d) in enumerate((values, [x * x for x in values],
                                           [x * p for x, p in zip(values, patches, strict=True)])):  # fmt: skip
            sums.store((a + b) + (c + d), code.times(w, 3 * LANES), LANES * at)


@reordered_leaf
def correlate(patch, pixels, starts, count, width, sums, scores):
    """Write the correlations (:func:`zncc`) of ``count`` windows, whose first pixels have the indices ``starts``.
    ``sums`` is a buffer [n, 3, LANES]."""
    _sum(patch, pixels, starts, count, width, sums)
    for w in range(count):
        total = squares = cross = np.float32(0)
        for k in range(LANES):
            total += sums[w, 0, k]
            squares += sums[w, 1, k]
            cross += sums[w, 2, k]
        scores[w] = _zncc(total, squares, cross)


@reordered_leaf
def refined(patch, along_u, along_v, key, width, height, u, v, eu, ev, rows, out):
    """Gauss-Newton steps along (eu, ev) from the centre (u, v). ``out``: the displacement [px]; G along, between and
    across the line [1/px^2]; gradient across times residual [1/px]; ZNCC; mean position (u, v) of the squared gradient
    along the line, from the centre [px]. False where the window leaves the image or
    the match."""
    cu, cv = np.float32(eu), np.float32(ev)
    g_ee = g_ep = g_pp = patch_e = patch_p = mean_u = mean_v = np.float32(0)
    for k in range(COUNT):
        e, p = cu * along_u[k] + cv * along_v[k], cu * along_v[k] - cv * along_u[k]
        g_ee += e * e
        mean_u += e * e * _INSIDE_RIGHT[k]
        mean_v += e * e * _INSIDE_DOWN[k]
        g_ep += e * p
        g_pp += p * p
        patch_e += e * patch[k]
        patch_p += p * patch[k]
    if g_ee <= 1e-9:
        return False
    displacement, one, copied = 0.0, np.float32(1), -1
    pixels, next_pixels = rows[0].view(np.uint8), rows[1].view(np.uint8)
    for step in range(STEPS + 1):
        left, top = u + displacement * eu + FIRST, v + displacement * ev + FIRST
        iu, iv = int(np.floor(left)), int(np.floor(top))
        if iu < 0 or iv < 0 or iu + SIDE >= width or iv + SIDE >= height:
            return False
        if iv * width + iu != copied:
            copied = iv * width + iu
            copy_rows(key, copied, width, SIDE + 1, rows[0])
            copy_rows(key, copied + 1, width, SIDE + 1, rows[1])
        fu, fv = np.float32(left - iu), np.float32(top - iv)
        w00, w01, w10, w11 = (one - fv) * (one - fu), (one - fv) * fu, fv * (one - fu), fv * fu
        total = squares = cross = down_u = down_v = np.float32(0)
        for k in range(COUNT):
            upper = w00 * np.float32(pixels[k]) + w01 * np.float32(next_pixels[k])
            lower = w10 * np.float32(pixels[k + SIDE]) + w11 * np.float32(next_pixels[k + SIDE])
            value = upper + lower
            total += value
            squares += value * value
            cross += patch[k] * value
            down_u += along_u[k] * value
            down_v += along_v[k] * value
        deviation = squares - total * total / np.float32(COUNT)
        if deviation <= COUNT * LEAST_CONTRAST * LEAST_CONTRAST:
            return False
        # The gradients have mean 0, so that the values' mean drops out. The part of the patch is not residual.
        over = one / np.sqrt(deviation)
        score = cross * over
        change = -((cu * down_u + cv * down_v) * over - score * patch_e) / g_ee
        if step == STEPS or abs(change) < CONVERGED:
            break
        displacement += change
        if abs(displacement) > FARTHEST:
            return False
    right_p = (cu * down_v - cv * down_u) * over - score * patch_p
    out[0], out[1], out[2], out[3], out[4], out[5] = displacement, g_ee, g_ep, g_pp, right_p, score
    out[6], out[7] = mean_u / g_ee, mean_v / g_ee
    return True

"""Reduces gray images by the mean over the area of each pixel; on the CPU (numba)."""

from __future__ import annotations

import numpy as np

from ufmstar_torch.kernels.compile_cpu import empty, kernel, leaf

# Pixels of which less than this share lies in the area of a reduced one are left out, as in OpenCV.
_NEGLIGIBLE = 1e-3


@kernel
def reduce(image, out):
    """Reduce an image [H, W] to ``out`` [h, w]: OpenCV's ``INTER_AREA`` to the bit, where the ratio of the sizes is no
    whole number, in a third of its time."""
    (height, width), (rows, columns) = image.shape, out.shape
    across, down = int(np.ceil(width / columns)) + 1, int(np.ceil(height / rows)) + 1
    column, share = empty(columns, np.int64), empty((across, columns), np.float32)
    first_row, row_share = empty(rows, np.int64), empty((down, rows), np.float32)
    _shares(width, column, share)
    _shares(height, first_row, row_share)
    flat, gray = image.reshape(image.size), empty(columns, np.int32)
    row, total, last = empty(columns, np.float32), empty(columns, np.float32), -1
    for v in range(rows):
        for i in range(columns):
            total[i] = np.float32(0)
        for k in range(down):
            weight, y = row_share[k, v], first_row[v] + k
            if weight == 0:
                continue
            if y != last:  # neighbours share rows
                last = y
                for t in range(across):
                    at, one = y * width + t, share[t]
                    for i in range(columns):  # apart from the sums, which are vectorised
                        gray[i] = np.int32(flat[np.uint64(at + column[i])])
                    for i in range(columns):
                        row[i] = (np.float32(0) if t == 0 else row[i]) + one[i] * np.float32(gray[i])
            for i in range(columns):
                total[i] += weight * row[i]
        for i in range(columns):
            out[v, i] = np.uint8(np.rint(total[i]))


@leaf
def _shares(size, first, share):
    """Write the first of the pixels on an axis of a ``size`` that each of n reduced ones covers [n], and the shares of
    it and the next ones [K, n]."""
    scale, taps = size / len(first), len(share)
    for i in range(len(first)):
        begin = i * scale
        end, length = begin + scale, min(scale, size - begin)
        whole = min(int(np.ceil(begin)), min(int(np.floor(end)), size - 1))
        last = min(int(np.floor(end)), size - 1)
        before = whole - begin > _NEGLIGIBLE
        first[i] = min(whole - 1 if before else whole, size - taps)
        for t in range(taps):
            share[t, i] = np.float32(0)
        if before:
            share[whole - 1 - first[i], i] = np.float32((whole - begin) / length)
        for at in range(whole, last):
            share[at - first[i], i] = np.float32(1 / length)
        if end - last > _NEGLIGIBLE:
            share[last - first[i], i] = np.float32(min(min(end - last, 1.0), length) / length)

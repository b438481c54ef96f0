"""Max-pooling of maps that are channels last in memory, compiled."""

from __future__ import annotations

import numba


@numba.njit(cache=True, nogil=True)
def max_pool(maps, kernel, stride, pooled):  # type: ignore[no-untyped-def]
    """Put the maxima over windows into ``pooled``; the lower and the right edge cut windows off.

    Args:
        maps: float32 [B, X, Y, K].
        kernel, stride: side of a window, and how far apart windows begin.
        pooled: float32 [B, X', Y', K].
    """
    count, height, width, channels = maps.shape
    for b in range(count):
        for y in range(pooled.shape[1]):
            top, bottom = y * stride, min(height, y * stride + kernel)
            for x in range(pooled.shape[2]):
                left, right = x * stride, min(width, x * stride + kernel)
                row = pooled[b, y, x]
                if bottom - top == 3 and right - left == 3:  # CaffeNet's windows, all at once
                    for k in range(channels):
                        upper = max(max(maps[b, top, left, k], maps[b, top, left + 1, k]), maps[b, top, left + 2, k])
                        v = top + 1
                        middle = max(max(maps[b, v, left, k], maps[b, v, left + 1, k]), maps[b, v, left + 2, k])
                        v = top + 2
                        lower = max(max(maps[b, v, left, k], maps[b, v, left + 1, k]), maps[b, v, left + 2, k])
                        row[k] = max(max(upper, middle), lower)
                else:
                    row[:] = maps[b, top, left]
                    for v in range(top, bottom):
                        for u in range(left, right):
                            for k in range(channels):
                                row[k] = max(row[k], maps[b, v, u, k])

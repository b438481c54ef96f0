"""Convolutions with fewer multiplications (Winograd, 1980; Lavin and Gray, CVPR 2016), for kernels of 3 x 3 and 5 x 5.

A convolution is a product of polynomials, and a product of degree n - 1 is known from its values at n points:
m neighbouring outputs of a kernel of r taps cost n = m + r - 1 multiplications a channel instead of m·r, as

    y = Aᵀ [(G g) ⊙ (Bᵀ d)],    d: n inputs, g: the r taps, y: the m outputs  (F(m, r), Lavin and Gray's eq. 6).

G g is worked out once.  Bᵀ d and Aᵀ are sums over neighbouring cells, compiled here; the sums over channels are one
grouped product for all points, which oneDNN does.  In float32 the result is as near to the true one as that of the
direct sum for 3 x 3 (both ways, F(2, 3)), and for 5 x 5 (along rows, F(3, 5)) within 5e-6 of the largest activation.
"""

from __future__ import annotations

from collections.abc import Sequence
from fractions import Fraction
from typing import TypeAlias

import numba
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from core.networks.convolution import FusedConvolution

Matrix: TypeAlias = NDArray[np.float64]

SQUARE_POINTS = (Fraction(0), Fraction(1), Fraction(-1))
"""Of F(2, 3), besides infinity: sums and differences alone, so that nothing is lost."""

STRIP_POINTS = (*SQUARE_POINTS, Fraction(1, 2), Fraction(-1, 2), Fraction(2))
"""Of F(3, 5): of the small ones those that round the least on real activations."""

SAVED_A_VALUE = 150
"""Multiplications that must be saved for each value that is moved between cells and points, or the direct sum is as
quick: moving is the memory's work.  CaffeNet's conv2 and conv3 save 190, its conv4 120."""

FEWEST_SAVED = 0.25
"""Share of the multiplications that must be saved: of a small map the last tiles are mostly edge."""


def transforms(outputs: int, taps: int, points: Sequence[Fraction]) -> tuple[Matrix, Matrix, Matrix]:
    """Aᵀ [m, n], G [n, r] and Bᵀ [n, n] of F(m, r), worked out in fractions.

    Args:
        outputs, taps: m and r.
        points: m + r - 2 different ones; infinity is added.

    Raises:
        ValueError: there is another number of points, or two are the same.
    """
    n = outputs + taps - 1
    if len(set(points)) != n - 1 or len(points) != n - 1:
        raise ValueError(f"F({outputs}, {taps}) needs {n - 1} different points besides infinity")
    at, g, bt = [], [], []
    for point in points:
        others = [other for other in points if other != point]
        distance = Fraction(1)
        for other in others:
            distance *= point - other
        at.append([point**power for power in range(outputs)])
        g.append([point**power / distance for power in range(taps)])
        bt.append([*_with_roots(others), Fraction(0)])
    at.append([Fraction(power == outputs - 1) for power in range(outputs)])
    g.append([Fraction(power == taps - 1) for power in range(taps)])
    bt.append(_with_roots(points))
    return _array(at).T.copy(), _array(g), _array(bt)


def _with_roots(roots: Sequence[Fraction]) -> list[Fraction]:
    """The coefficients of Π (x - root), lowest power first."""
    made = [Fraction(1)]
    for root in roots:
        made = [low - root * high for low, high in zip([Fraction(0), *made], [*made, Fraction(0)], strict=True)]
    return made


def _array(rows: Sequence[Sequence[Fraction]]) -> Matrix:
    return np.array([[float(value) for value in row] for row in rows])


def fast_convolution(module: nn.Module, rectified: bool) -> SquareTiles | Strips | None:
    """A layer in float32 with fewer multiplications; None where the direct sum is as good."""
    assert isinstance(module, nn.Conv2d)
    plain = module.stride == (1, 1) and module.dilation == (1, 1) and module.padding_mode == "zeros"
    if not plain or isinstance(module.padding, str) or module.padding[0] != module.padding[1]:
        return None
    each = module.in_channels // module.groups * module.out_channels  # multiplications at one point
    if module.kernel_size == (3, 3) and (36 - 16) * each >= SAVED_A_VALUE * 16 * _channels(module):
        return SquareTiles(module, rectified)
    if module.kernel_size == (5, 5) and 5 * (15 - 7) * each >= SAVED_A_VALUE * 7 * _channels(module):
        return Strips(module, rectified)
    return None


def _channels(module: nn.Conv2d) -> int:
    """In and out."""
    return module.in_channels + module.out_channels


class _Fast:
    """What both kinds have in common.

    Called with B x C x H x W float32, channels last in memory; gives B x O x X x Y, channels last too.
    """

    def __init__(self, module: nn.Conv2d, rectified: bool, weights: Matrix) -> None:
        """Of a layer, with its weights at all points: float64 [points, O, C / groups, height]."""
        self._direct = FusedConvolution.of(module, rectified)
        self._pad, self._taps, self._points = int(module.padding[0]), int(module.kernel_size[0]), len(weights)
        self._channels = module.out_channels
        bias = np.zeros(module.out_channels) if module.bias is None else module.bias.detach().numpy()
        self._bias, self._least = bias.astype(np.float32), np.float32(0 if rectified else -np.inf)
        kernels = np.ascontiguousarray(weights.reshape(-1, *weights.shape[2:], 1), np.float32)
        self._products = FusedConvolution(torch.from_numpy(kernels), None, groups=self._points * module.groups)

    def _summed(self, transformed: NDArray[np.float32]) -> NDArray[np.float32]:
        """The sums over channels at all points; float32 [B, rows, columns, points, C] to [..., points, O]."""
        flat = transformed.reshape(*transformed.shape[:3], -1)
        made = self._products(torch.from_numpy(flat).permute(0, 3, 1, 2)).permute(0, 2, 3, 1)
        return made.numpy().reshape(*made.shape[:3], self._points, self._channels)

    def _size(self, cells: int) -> int:
        """Rows or columns that come out of so many."""
        return cells + 2 * self._pad - self._taps + 1


class SquareTiles(_Fast):
    """3 x 3: two outputs down and two across at a time, F(2 x 2, 3 x 3), 16 multiplications instead of 36."""

    def __init__(self, module: nn.Conv2d, rectified: bool) -> None:
        _, g, _ = transforms(2, 3, SQUARE_POINTS)
        kernels = module.weight.detach().double().numpy()
        weights = np.einsum("yr,ocrs,xs->yxoc", g, kernels, g)
        super().__init__(module, rectified, weights.reshape(16, *kernels.shape[:2], 1))

    def __call__(self, x: Tensor) -> Tensor:
        maps = x.permute(0, 2, 3, 1).contiguous().numpy()
        count, height, width, channels = maps.shape
        shape = self._size(height), self._size(width)
        rows, columns = -(-shape[0] // 2), -(-shape[1] // 2)
        if 16 * rows * columns > (1 - FEWEST_SAVED) * 9 * shape[0] * shape[1]:
            return self._direct(x)
        transformed = np.empty((count, rows, columns, 16, channels), np.float32)
        _square_inputs(maps, self._pad, transformed)
        made = np.empty((count, *shape, self._channels), np.float32)
        _square_outputs(self._summed(transformed), self._bias, self._least, made)
        return torch.from_numpy(made).permute(0, 3, 1, 2)


class Strips(_Fast):
    """5 x 5: three outputs across at a time, F(3, 5) of each row of the kernel, 7 multiplications instead of 15."""

    def __init__(self, module: nn.Conv2d, rectified: bool) -> None:
        at, g, bt = transforms(3, 5, STRIP_POINTS)
        self._at, self._bt = at.astype(np.float32), bt.astype(np.float32)
        super().__init__(module, rectified, np.einsum("xs,ocrs->xocr", g, module.weight.detach().double().numpy()))

    def __call__(self, x: Tensor) -> Tensor:
        maps = x.permute(0, 2, 3, 1).contiguous().numpy()
        count, height, width, channels = maps.shape
        shape = self._size(height), self._size(width)
        strips = -(-shape[1] // 3)
        if 7 * strips > (1 - FEWEST_SAVED) * 5 * shape[1]:
            return self._direct(x)
        transformed = np.empty((count, height + 2 * self._pad, strips, 7, channels), np.float32)
        _strip_inputs(maps, self._bt, self._pad, transformed)
        made = np.empty((count, *shape, self._channels), np.float32)
        _strip_outputs(self._summed(transformed), self._at, self._bias, self._least, made)
        return torch.from_numpy(made).permute(0, 3, 1, 2)


@numba.njit(cache=True, nogil=True, fastmath={"contract"})
def _two_of_three(d0, d1, d2, d3, t0, t1, t2, t3):  # type: ignore[no-untyped-def]
    """Bᵀ d of F(2, 3); float32 [C] all."""
    for k in range(len(t0)):
        t0[k] = d2[k] - d0[k]
    for k in range(len(t1)):
        t1[k] = d1[k] + d2[k]
    for k in range(len(t2)):
        t2[k] = d2[k] - d1[k]
    for k in range(len(t3)):
        t3[k] = d3[k] - d1[k]


@numba.njit(cache=True, nogil=True)
def _square_inputs(maps, pad, transformed):  # type: ignore[no-untyped-def]
    """Bᵀ d B of each tile; float32 [B, H, W, C] to [B, rows, columns, 16, C]."""
    count, height, width, channels = maps.shape
    all_rows, nothing = maps.reshape(count, height, width * channels), np.zeros(width * channels, np.float32)
    # A row of tiles down at first, with what stands to the left and to the right of the map, which is zero.
    down = np.zeros((4, (2 * transformed.shape[2] + 2) * channels), np.float32)
    within = down[:, pad * channels : (pad + width) * channels]
    for number in range(count * transformed.shape[1]):
        image, row = number // transformed.shape[1], number % transformed.shape[1]
        rows, top = all_rows[image], 2 * row - pad
        d0 = rows[top] if 0 <= top < height else nothing
        d1 = rows[top + 1] if 0 <= top + 1 < height else nothing
        d2 = rows[top + 2] if 0 <= top + 2 < height else nothing
        d3 = rows[top + 3] if 0 <= top + 3 < height else nothing
        _two_of_three(d0, d1, d2, d3, within[0], within[1], within[2], within[3])
        for column in range(transformed.shape[2]):
            out, x = transformed[image, row, column], 2 * column * channels
            for i in range(4):
                d0, d1 = down[i, x : x + channels], down[i, x + channels : x + 2 * channels]
                d2, d3 = down[i, x + 2 * channels : x + 3 * channels], down[i, x + 3 * channels : x + 4 * channels]
                _two_of_three(d0, d1, d2, d3, out[4 * i], out[4 * i + 1], out[4 * i + 2], out[4 * i + 3])


@numba.njit(cache=True, nogil=True, fastmath={"contract", "nnan", "nsz"})
def _square_outputs(summed, bias, least, maps):  # type: ignore[no-untyped-def]
    """Aᵀ y A of each tile, with bias and rectifier; float32 [B, rows, columns, 16, O] to [B, X, Y, O]."""
    count, height, width, channels = maps.shape
    down = np.empty((2, 4, channels), np.float32)
    for number in range(count * summed.shape[1]):
        image, row = number // summed.shape[1], number % summed.shape[1]
        for column in range(summed.shape[2]):
            points = summed[image, row, column]
            for j in range(4):
                p0, p1, p2, p3 = points[j], points[4 + j], points[8 + j], points[12 + j]
                upper, lower = down[0, j], down[1, j]
                for k in range(channels):
                    upper[k] = p0[k] + (p1[k] + p2[k])
                for k in range(channels):
                    lower[k] = p3[k] + (p1[k] - p2[k])
            for i in range(min(2, height - 2 * row)):
                p0, p1, p2, p3 = down[i, 0], down[i, 1], down[i, 2], down[i, 3]
                left = maps[image, 2 * row + i, 2 * column]
                for k in range(channels):
                    left[k] = max(p0[k] + (p1[k] + p2[k]) + bias[k], least)
                if 2 * column + 1 < width:
                    right = maps[image, 2 * row + i, 2 * column + 1]
                    for k in range(channels):
                        right[k] = max(p3[k] + (p1[k] - p2[k]) + bias[k], least)


@numba.njit(cache=True, nogil=True, fastmath={"contract"})
def _strip_inputs(maps, bt, pad, transformed):  # type: ignore[no-untyped-def]
    """Bᵀ d of each strip of each row; float32 [B, H, W, C] to [B, H + 2 pad, strips, 7, C]."""
    count, height, width, channels = maps.shape
    nothing = np.zeros(channels, np.float32)
    for number in range(count * transformed.shape[1]):
        image, y = number // transformed.shape[1], number % transformed.shape[1]
        if not pad <= y < height + pad:
            transformed[image, y] = 0
            continue
        row = maps[image, y - pad]
        for strip in range(transformed.shape[2]):
            x = 3 * strip - pad
            d0 = row[x] if 0 <= x < width else nothing
            d1 = row[x + 1] if 0 <= x + 1 < width else nothing
            d2 = row[x + 2] if 0 <= x + 2 < width else nothing
            d3 = row[x + 3] if 0 <= x + 3 < width else nothing
            d4 = row[x + 4] if 0 <= x + 4 < width else nothing
            d5 = row[x + 5] if 0 <= x + 5 < width else nothing
            d6 = row[x + 6] if 0 <= x + 6 < width else nothing
            for point in range(7):
                b = bt[point]
                b0, b1, b2, b3, b4, b5, b6 = b[0], b[1], b[2], b[3], b[4], b[5], b[6]
                out = transformed[image, y, strip, point]
                for k in range(channels):
                    near = b0 * d0[k] + b1 * d1[k] + b2 * d2[k] + b3 * d3[k]
                    out[k] = near + (b4 * d4[k] + b5 * d5[k] + b6 * d6[k])


@numba.njit(cache=True, nogil=True, fastmath={"contract", "nnan", "nsz"})
def _strip_outputs(summed, at, bias, least, maps):  # type: ignore[no-untyped-def]
    """Aᵀ y of each strip, with bias and rectifier; float32 [B, X, strips, 7, O] to [B, X, Y, O]."""
    count, height, width, channels = maps.shape
    for number in range(count * height):
        image, y = number // height, number % height
        for strip in range(summed.shape[2]):
            points = summed[image, y, strip]
            p0, p1, p2, p3, p4, p5, p6 = points[0], points[1], points[2], points[3], points[4], points[5], points[6]
            for i in range(min(3, width - 3 * strip)):
                a0, a1, a2, a3, a4, a5, a6 = at[i, 0], at[i, 1], at[i, 2], at[i, 3], at[i, 4], at[i, 5], at[i, 6]
                out = maps[image, y, 3 * strip + i]
                for k in range(channels):
                    most = a0 * p0[k] + a1 * p1[k] + a2 * p2[k] + a3 * p3[k]
                    out[k] = max(most + (a4 * p4[k] + a5 * p5[k] + a6 * p6[k]) + bias[k], least)

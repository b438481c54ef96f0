"""The equations of the thesis as plain NumPy, in the order in which they turn a layer's activations into a match.

This module says what is computed; it is written to be read and to try things out in a notebook.  The encoder calls
most of these functions; regions and what is summed over them come from compiled loops (``core.kernels``), which the
tests hold equal to the functions here.  Numbers 3.x are
of chapter 3 (Region-VLAD, one layer), numbers 4.x of chapter 4 (M-Region-VLAD, several layers).  The vocabulary of
equations 3.6 and 4.6 is trained in ``vocabulary.py``; equation 4.15 is a sum of times.

Activations are an array [X, Y, K]: X x Y cells and K feature maps, rectified.  The K values of one cell are its local
descriptor d_l (equations 3.1 and 4.1).
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

Array = NDArray[Any]
"""Floating-point values; results from float32 are float32 unless the function says otherwise."""

Normalization = Literal["intra", "global"]


def levels(activations: Array, step: float) -> Array:
    """⌊a / q⌋: activations of one level count as "approximately the same value" (sections 3.2.2 and 4.2.2).

    Args:
        activations: [X, Y, K].
        step: q > 0, the quantisation step in units of the activations.

    Returns:
        [X, Y, K], whole numbers; level 0 and below is background.
    """
    return np.floor(activations / step)


def labelled_regions(levels: Array) -> NDArray[np.int64]:
    """G_h: the regions, each a group of 8-connected cells of one feature map that have one level above 0.

    Args:
        levels: [X, Y, K].

    Returns:
        int64 [X, Y, K], the number h of each cell's region, from 1 in the order of the regions' first cells (map by
        map, then row by row); 0 for background.
    """
    from scipy import ndimage  # here, as it takes long to import and only this function needs it

    within_a_map = np.zeros((3, 3, 3), np.bool_)
    within_a_map[:, :, 1] = True
    labels = np.zeros(levels.shape, np.int64)
    for level in np.unique(levels[levels > 0]):
        found, _ = ndimage.label(levels == level, within_a_map)
        labels = np.where(found > 0, found + labels.max(), labels)
    in_order = labels.transpose(2, 0, 1)
    old, first = np.unique(in_order[in_order > 0], return_index=True)
    numbers = np.zeros(len(old) + 1, np.int64)
    numbers[old[np.argsort(first)]] = np.arange(1, len(old) + 1)
    return numbers[labels]


def energies(activations: Array, regions: NDArray[np.int64]) -> NDArray[np.float64]:
    """E_h = 1/|G_h| Σ_f a_h^f, the mean activation of each region (equations 3.2 and 4.2).

    Args:
        activations: [X, Y, K].
        regions: int64 [X, Y, K], as :func:`labelled_regions` numbers them.

    Returns:
        float64 [H].
    """
    sums = np.bincount(regions.ravel(), activations.ravel(), minlength=1)
    return sums[1:] / np.bincount(regions.ravel(), minlength=1)[1:]


def strongest_regions(energies: Array, count: int) -> NDArray[np.int64]:
    """R^L: the numbers of the N regions of highest energy (equations 3.3 and 4.3), ties by the lower number.

    Args:
        energies: [H].
        count: N.

    Returns:
        int64 [min(N, H)], by falling energy; numbers count from 1.
    """
    return np.argsort(-energies, kind="stable")[:count] + 1


def bounding_boxes(regions: NDArray[np.int64], chosen: NDArray[np.int64]) -> NDArray[np.int64]:
    """The boxes of regions in cells, int64 [T, 4]: top, left, bottom, right, half-open.

    Args:
        regions: int64 [X, Y, K], as :func:`labelled_regions` numbers them.
        chosen: int64 [T], numbers of regions.
    """
    cells, numbers = np.argwhere(regions)[:, :2], regions[regions > 0] - 1
    boxes = np.zeros((regions.max(initial=0), 4), np.int64)
    boxes[:, :2] = regions.shape[:2]
    np.minimum.at(boxes[:, :2], numbers, cells)
    np.maximum.at(boxes[:, 2:], numbers, cells + 1)
    return boxes[chosen - 1]


def regional_features(activations: Array, boxes: NDArray[np.integer[Any]]) -> NDArray[np.float64]:
    """f_t = Σ D_q, the sum of the local descriptors in the bounding box of each region (equations 3.4 and 4.4).

    Args:
        activations: [X, Y, K].
        boxes: int [T, 4], top, left, bottom, right, half-open.

    Returns:
        float64 [T, K], F^L (equation 3.5).
    """
    sums = [
        activations[top:bottom, left:right].sum(axis=(0, 1), dtype=np.float64) for top, left, bottom, right in boxes
    ]
    return np.array(sums, np.float64).reshape(len(boxes), activations.shape[2])


def fused_features(layers: Sequence[Array], steps: Sequence[float], count: int) -> NDArray[np.float64]:
    """F_I: the features of the N strongest regions of each layer, one layer after the other (equation 4.5).

    Args:
        layers: [X, Y, K] each; K is the same for all.
        steps: the quantisation step of each layer.
        count: N, of each layer.

    Returns:
        float64 [T, K].
    """
    features = []
    for activations, step in zip(layers, steps, strict=True):
        regions = labelled_regions(levels(activations, step))
        chosen = strongest_regions(energies(activations, regions), count)
        features.append(regional_features(activations, bounding_boxes(regions, chosen)))
    return np.concatenate(features)


def assign(features: Array, centers: Array) -> NDArray[np.int64]:
    """Z = α(F): the nearest centre of each feature by Euclidean distance (equations 3.7 and 4.7).

    As ‖f - o‖² = ‖f‖² - 2 (f·o - ‖o‖²/2), the nearest centre has the highest f·o - ‖o‖²/2.

    Args:
        features: [T, K].
        centers: [V, K].

    Returns:
        int64 [T]; of centres equally near the first.
    """
    return np.argmax(features @ centers.T - (centers**2).sum(axis=1) / 2, axis=1)


def residuals(features: Array, centers: Array) -> Array:
    """v_u = Σ (f - o_u) over the features f assigned to the centre o_u (equations 3.8 and 4.8).

    Args:
        features: [T, K].
        centers: [V, K].

    Returns:
        [V, K].
    """
    nearest = assign(features, centers)
    sums = np.zeros_like(centers)
    np.add.at(sums, nearest, features - centers[nearest])
    return sums


def power(vectors: Array, gamma: float) -> Array:
    """v := sign(v)·|v|^γ, element by element (equations 3.9 and 4.9)."""
    return np.copysign(np.abs(vectors) ** gamma, vectors)


def unit_length(vectors: Array) -> Array:
    """v := v / √(vᵀv), row by row (equations 3.10 and 4.10); a zero row stays zero.

    Args:
        vectors: [n, K].
    """
    norms = np.sqrt(np.einsum("nk,nk->n", vectors, vectors))[:, np.newaxis]
    return np.divide(vectors, norms, out=np.zeros_like(vectors), where=norms > 0)


def normalize(vectors: Array, normalization: Normalization) -> Array:
    """Normalize residuals, [V, K].

    ``intra`` divides each v_u by its own norm (equations 3.10 and 4.10); ``global`` divides all values by the norm of
    the whole, as the authors' released code does.  Zero stays zero.
    """
    return unit_length(vectors if normalization == "intra" else vectors.reshape(1, -1)).reshape(vectors.shape)


def vlad(features: Array, centers: Array, gamma: float, normalization: Normalization) -> Array:
    """S: the VLAD of one frame (equations 3.11 and 4.11).

    Args:
        features: [T, K].
        centers: [V, K].

    Returns:
        [V, K].
    """
    return normalize(power(residuals(features, centers), gamma), normalization)


def word_cosines(a: Array, b: Array) -> Array:
    """j_u = S_u^A · S_u^B / (‖S_u^A‖ ‖S_u^B‖) of each word u (equations 3.12 and 4.12); 0 where either is zero.

    Args:
        a, b: [V, K], the VLADs of two frames.

    Returns:
        [V].
    """
    return (unit_length(a) * unit_length(b)).sum(axis=1)


def matching_score(a: Array, b: Array) -> float:
    """J = Σ_u j_u of two VLADs, [V, K] each (equations 3.13 and 4.13); in [-V, V]."""
    return float(word_cosines(a, b).sum())


def best_match(query: Array, references: Array) -> int:
    """P = argmax_X J, the number of the reference that scores highest (equations 3.14 and 4.14).

    Args:
        query: [V, K].
        references: [R, V, K], R >= 1.
    """
    return int(np.argmax([matching_score(query, reference) for reference in references]))

"""Why two frames score as they do: the contributions of words, regions and cells to the score (thesis, section 3.4.3).

The score of an encoder with two stages is the sum of two sums: the first over the words of the vocabulary (equations
3.13 and 4.13), the second over the corresponding cells (``agreement.py``).  A region has no share of its own, since
its residual passes through a power and a norm with the others of its word; its contribution is what the score would
lose without it.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from core.method.agreement import Cells, Correspondences, correspondences
from core.method.encoder import Encoder
from core.method.equations import assign, power, residuals, unit_length
from core.method.regions import Regions
from core.method.vlad import aggregate
from core.method.whitening import Whitening

Array = NDArray[np.float32]
Indices = NDArray[np.int64]


@dataclass(frozen=True)
class Shown:
    """One of the two frames of an explanation.

    descriptor: float32 [D].
    local: int8 [C, L], its local descriptors.
    regions: None if the frame itself is not available, as for a place without a stored picture.
    """

    descriptor: Array
    local: Cells
    regions: Regions | None


@dataclass(frozen=True)
class Explanation:
    """The parts of the score of a frame a against a frame b.

    words: float32 [V], the contribution of each word to the score (its j_u, scaled as in the score); of whitened
        descriptors only their sum, float32 [1], for whitening mixes the words.
    losses: of a and of b, float32 [T], the loss of the score without each region; negative if it would gain.
        None if a frame's regions are not known.
    answers: int64 [n, 2], regions of a and of b of one word that are each other's nearest.
    cells: the corresponding cells of a and b; none without a second stage.
    gains: float32 [n], the contribution of each pair of cells to the score.
    """

    words: Array
    losses: tuple[Array | None, Array | None]
    answers: Indices
    cells: Correspondences
    gains: Array

    @property
    def score(self) -> float:
        """The sum of all parts."""
        return float(self.words.sum(dtype=np.float64) + self.gains.sum(dtype=np.float64))


def explain(encoder: Encoder, a: Shown, b: Shown) -> Explanation:
    """Split the score of two frames into parts; they add up to the score that both stages give.

    Args:
        encoder: of both frames.
    """
    if encoder.whitening is None:
        shape = encoder.centers.shape
        products = np.einsum("vk,vk->v", a.descriptor.reshape(shape), b.descriptor.reshape(shape))
    else:
        products = (a.descriptor @ b.descriptor)[np.newaxis]
    cells = _cells(encoder, a.local, b.local)
    stage = encoder.definition.agreement
    share = 0.0 if stage is None else stage.share / len(a.local)
    return Explanation(
        words=encoder.scores_from_inner_products(products),
        losses=(_losses(encoder, a, b), _losses(encoder, b, a)),
        answers=_answers(encoder, a.regions, b.regions),
        cells=cells,
        gains=np.asarray(cells.cosines**2 * np.float32(share), np.float32),
    )


def _cells(encoder: Encoder, a: Cells, b: Cells) -> Correspondences:
    stage = encoder.definition.agreement
    if stage is None or not a.any() or not b.any():
        none = np.empty(0, np.int64)
        return Correspondences(none, none, np.empty(0, np.float32))
    return correspondences(a, b, encoder.grid[1], stage.reach)


def _losses(encoder: Encoder, frame: Shown, other: Shown) -> Array | None:
    """The loss of the score without each region of ``frame``; float32 [T]."""
    if frame.regions is None:
        return None
    features, centers, definition = frame.regions.features, encoder.centers, encoder.definition
    if not len(features):
        return np.zeros(0, np.float32)
    if encoder.whitening is not None:
        return encoder.scores_from_inner_products(_whitened_losses(encoder, encoder.whitening, frame, other))
    against = other.descriptor.reshape(centers.shape)
    words = assign(features, centers)
    sums = residuals(features, centers)  # V x K
    without = power(sums[words] - (features - centers[words]), definition.gamma)  # T x K
    whole = power(sums, definition.gamma)
    products = np.einsum("tk,tk->t", without, against[words])
    if definition.normalization == "intra":
        reduced = np.einsum("tk,tk->t", unit_length(without), against[words])
        parts = np.einsum("vk,vk->v", unit_length(whole), against)[words]
    else:
        # The parts of the other words stay, but the norm of the whole changes.
        by_word, squares = np.einsum("vk,vk->v", whole, against), np.einsum("vk,vk->v", whole, whole)
        left = by_word.sum() - by_word[words] + products
        norms = np.sqrt(np.maximum(0, squares.sum() - squares[words] + np.einsum("tk,tk->t", without, without)))
        reduced = np.divide(left, norms, out=np.zeros_like(left), where=norms > 0)
        parts = np.full(len(words), by_word.sum() / max(float(np.sqrt(squares.sum())), 1e-12), np.float32)
    return encoder.scores_from_inner_products(np.asarray(parts - reduced, np.float32))


def _whitened_losses(encoder: Encoder, whitening: Whitening, frame: Shown, other: Shown) -> Array:
    """The loss of the inner product without each region of a frame that has regions; float32 [T]."""
    assert frame.regions is not None
    features, definition = frame.regions.features, encoder.definition
    without = [
        aggregate(np.delete(features, at, axis=0), encoder.centers, definition.gamma, definition.normalization)
        for at in range(len(features))
    ]
    left = whitening(np.stack(without)) @ other.descriptor
    return np.asarray(frame.descriptor @ other.descriptor - left, np.float32)


def _answers(encoder: Encoder, a: Regions | None, b: Regions | None) -> Indices:
    """Regions of a and of b of one word that are each other's nearest by cosine, best first; int64 [n, 2]."""
    if a is None or b is None or not len(a) or not len(b):
        return np.empty((0, 2), np.int64)
    cosines = unit_length(a.features) @ unit_length(b.features).T  # T_a x T_b
    apart = assign(a.features, encoder.centers)[:, None] != assign(b.features, encoder.centers)[None, :]
    cosines[apart] = -np.inf
    there, back = cosines.argmax(axis=1), cosines.argmax(axis=0)
    mine = np.arange(len(a))
    best = cosines[mine, there]
    mutual = np.flatnonzero((back[there] == mine) & np.isfinite(best))
    mutual = mutual[np.argsort(-best[mutual], kind="stable")]
    return np.stack([mutual, there[mutual]], axis=1)

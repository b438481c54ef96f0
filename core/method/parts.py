"""Parts of a frame that are no regions of interest: every cell of a map by itself, or all cells pooled.

Others' networks are aggregated over them: a VLAD over every cell (Keetha et al.: AnyLoc, 2024), a generalized mean of
all cells (Radenović, Tolias, Chum: Fine-tuning CNN Image Retrieval with No Human Annotation, 2018).  To everything that
follows they are regions, with boxes of one cell, or of the whole map.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from core.method.regions import Activations, Regions

SMALLEST = 1e-6
"""The least value of the generalized mean: smaller ones are raised to it, as in its published form."""


def cells(layers: Sequence[Activations], count: int) -> Regions:
    """The ``count`` cells of each layer that have the longest features, by falling length; a cell of zeros is no part.

    Args:
        layers: of one frame, each float32 [X, Y, K].
    """
    found = []
    for number, layer in enumerate(layers):
        features = layer.reshape(-1, layer.shape[2])
        lengths = np.linalg.norm(features, axis=1)
        chosen = np.argsort(-lengths, kind="stable")[:count]
        chosen = chosen[lengths[chosen] > 0]
        corners = np.stack(np.divmod(chosen, layer.shape[1]), axis=1)
        found.append(_parts(np.concatenate([corners, corners + 1], axis=1), lengths[chosen], features[chosen], number))
    return _joined(found)


def pooled(layers: Sequence[Activations], exponent: float) -> Regions:
    """The generalized mean (1/n Σ max(x, ε)^p)^(1/p) of all n cells of each layer; none of a layer of zeros.

    Args:
        layers: of one frame, each float32 [X, Y, K].
        exponent: p, at least 1.
    """
    found = []
    for number, layer in enumerate(layers):
        raised = np.maximum(layer, SMALLEST).astype(np.float64) ** exponent
        mean = raised.mean(axis=(0, 1), dtype=np.float64) ** (1 / exponent)
        seen = int(layer.any())
        whole = np.array([[0, 0, *layer.shape[:2]]])[:seen]
        found.append(_parts(whole, np.array([np.linalg.norm(mean)])[:seen], mean[np.newaxis][:seen], number))
    return _joined(found)


def _parts(boxes: np.ndarray, energies: np.ndarray, features: np.ndarray, layer: int) -> Regions:
    return Regions(
        boxes=boxes.astype(np.int32),
        energies=energies.astype(np.float32),
        channels=np.zeros(len(boxes), np.int32),
        layers=np.full(len(boxes), layer, np.int32),
        features=features.astype(np.float32),
    )


def _joined(parts: Sequence[Regions]) -> Regions:
    names = ("boxes", "energies", "channels", "layers", "features")
    return Regions(*(np.concatenate([getattr(part, name) for part in parts]) for name in names))

"""The projections of an encoder: what stays alike when the light changes, from disturbed and from real nights."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from rich.progress import track

from core.frames.preprocessing import prepare
from core.method.equations import unit_length
from core.method.projection import Projection, fit_projection
from core.networks.network import ShallowNetwork
from training.contrast import Pairs
from training.distillation import SIDE
from training.photographs import DisturbedCrops, split_photographs

Array = NDArray[np.float32]

CROPS = 1200
CELLS_PER_CROP = 50
SEED_OFFSET = 77
"""Keeps these crops apart from those that the backbone was trained on with the same seed."""


def fit_projections(
    network: ShallowNetwork, values: dict[str, int], photographs: Path, crops: int = CROPS, seed: int = 0
) -> dict[str, Projection]:
    """One projection for each layer of ``values``, from the cells of clean crops and of the same crops disturbed.

    Args:
        network: returns at least these layers.
        values: how many directions to keep, by layer.
        photographs: folder of the training photographs.
    """
    pairs = crop_pairs(photographs, crops, seed)
    generator = np.random.default_rng(seed)
    clear: dict[str, list[Array]] = {layer: [] for layer in values}
    changed: dict[str, list[Array]] = {layer: [] for layer in values}
    for index in track(range(crops), "cells for the projections"):
        maps = _maps(network, pairs[index])
        for layer in values:
            cells = maps[layer]  # 2 x C x K
            chosen = generator.choice(cells.shape[1], min(CELLS_PER_CROP, cells.shape[1]), replace=False)
            # A cell that is blank under either condition says nothing of how conditions change features.
            chosen = chosen[(cells[:, chosen].any(axis=2)).all(axis=0)]
            clear[layer].append(unit_length(cells[0, chosen]))
            changed[layer].append(unit_length(cells[1, chosen]))
    return {
        layer: fit_projection(np.concatenate(clear[layer]), np.concatenate(changed[layer]), kept)
        for layer, kept in values.items()
    }


def crop_pairs(photographs: Path, crops: int, seed: int) -> DisturbedCrops:
    """Clean crops and the same disturbed, others than those of the distillation with this seed."""
    paths = split_photographs(photographs).train
    return DisturbedCrops(paths, photographs, SIDE, seed + SEED_OFFSET, 0, crops)


def paired_cells(network: ShallowNetwork, photographs: Path, crops: int, seed: int = 0) -> Pairs:
    """The local descriptors of all cells of such crops, as ``training.contrast`` learns from them."""
    pairs = crop_pairs(photographs, crops, seed)
    maps = [_maps(network, pairs[index]) for index in track(range(crops), "cells for the contrast")]
    clear, changed = (
        {layer: np.stack([frame[layer][side].astype(np.float16) for frame in maps]) for layer in network.outputs}
        for side in (0, 1)
    )
    cells = maps[0][network.outputs[0]].shape[1]
    return Pairs(clear, changed, columns=round(cells**0.5))


def _maps(network: ShallowNetwork, frames: Sequence[NDArray[np.uint8]]) -> dict[str, Array]:
    """Activations of each output, B x C x K."""
    batch = np.stack([prepare(frame, network.input) for frame in frames])
    with torch.inference_mode():
        outputs = network(torch.from_numpy(batch).permute(0, 3, 1, 2))
    return {
        name: np.ascontiguousarray(output.flatten(2).permute(0, 2, 1).numpy())
        for name, output in zip(network.outputs, outputs, strict=True)
    }

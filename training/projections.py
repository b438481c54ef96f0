"""The projections of an encoder, learnt from pairs of crops that show the same scene in different light.

:func:`fit_projections` finds the directions that stay alike when the light changes in closed form; the packaged
encoders use these.  :func:`refine` goes on from there by InfoNCE (van den Oord et al., 2018): the descriptors of one
cell under two conditions attract, all others repel.  A cell's negatives are all cells of all crops of the batch but
its own neighbours; the backbone stays as it is.  The packaged encoders do not use it: its own loss fell while
recognition did not gain (see the model card).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
import torch.nn.functional as F
from numpy.typing import NDArray
from rich.progress import track
from torch import Tensor, nn

from core.frames.preprocessing import prepare
from core.method.agreement import AgreementDefinition
from core.method.equations import unit_length
from core.method.projection import Projection, fit_projection
from core.networks.network import ShallowNetwork
from training.distillation import SIDE
from training.photographs import AugmentedCrops, split_photographs

Array = NDArray[np.float32]

CROPS = 1200
CELLS_PER_CROP = 50
SEED_OFFSET = 77
"""Keeps these crops apart from those that the backbone was trained on with the same seed."""

TEMPERATURE = 0.07
RATE = 2e-4
"""Learning rate of the refinement, relative to the norm of each projection."""
DECAY = 0.997
BATCH = 12  # crops


@dataclass(frozen=True)
class PairedCells:
    """Local features of the same n crops under two conditions; by layer float [n, C, K].

    columns: of the grid of the C cells.
    """

    clean: Mapping[str, NDArray[np.floating]]
    augmented: Mapping[str, NDArray[np.floating]]
    columns: int


def fit_projections(
    network: ShallowNetwork, values: dict[str, int], photographs: Path, crops: int = CROPS, seed: int = 0
) -> dict[str, Projection]:
    """One projection for each layer of ``values``, from the cells of clean crops and of the same crops augmented.

    Args:
        network: returns at least these layers.
        values: how many directions to keep, by layer.
        photographs: folder of the training photographs.
    """
    pairs = _crop_pairs(photographs, crops, seed)
    generator = np.random.default_rng(seed)
    clean: dict[str, list[Array]] = {layer: [] for layer in values}
    augmented: dict[str, list[Array]] = {layer: [] for layer in values}
    for index in track(range(crops), "cells for the projections"):
        maps = _maps(network, pairs[index])
        for layer in values:
            cells = maps[layer]  # 2 x C x K
            chosen = generator.choice(cells.shape[1], min(CELLS_PER_CROP, cells.shape[1]), replace=False)
            # A cell that is blank under either condition says nothing of how conditions change features.
            chosen = chosen[(cells[:, chosen].any(axis=2)).all(axis=0)]
            clean[layer].append(unit_length(cells[0, chosen]))
            augmented[layer].append(unit_length(cells[1, chosen]))
    return {
        layer: fit_projection(np.concatenate(clean[layer]), np.concatenate(augmented[layer]), kept)
        for layer, kept in values.items()
    }


def _crop_pairs(photographs: Path, crops: int, seed: int) -> AugmentedCrops:
    """Pairs of a clean and an augmented crop, others than those of the distillation with this seed."""
    paths = split_photographs(photographs).train
    return AugmentedCrops(paths, photographs, SIDE, seed + SEED_OFFSET, 0, crops)


def paired_cells(network: ShallowNetwork, photographs: Path, crops: int, seed: int = 0) -> PairedCells:
    """The features of all cells of such crops, which :func:`refine` learns from."""
    pairs = _crop_pairs(photographs, crops, seed)
    maps = [_maps(network, pairs[index]) for index in track(range(crops), "cells for the refinement")]
    clean, augmented = (
        {layer: np.stack([frame[layer][side].astype(np.float16) for frame in maps]) for layer in network.outputs}
        for side in (0, 1)
    )
    cells = maps[0][network.outputs[0]].shape[1]
    return PairedCells(clean, augmented, columns=round(cells**0.5))


def _maps(network: ShallowNetwork, frames: Sequence[NDArray[np.uint8]]) -> dict[str, Array]:
    """Activations of each output, B x C x K."""
    batch = np.stack([prepare(frame, network.input) for frame in frames])
    with torch.inference_mode():
        outputs = network(torch.from_numpy(batch).permute(0, 3, 1, 2))
    return {
        name: np.ascontiguousarray(output.flatten(2).permute(0, 2, 1).numpy())
        for name, output in zip(network.outputs, outputs, strict=True)
    }


class CellDescriptor(nn.Module):
    """Descriptors of cells as the second stage compares them, with projections that can be learnt."""

    def __init__(self, projections: Mapping[str, Projection], stage: AgreementDefinition) -> None:
        super().__init__()
        self.stage = stage
        self.means = [torch.from_numpy(projections[layer].mean) for layer in stage.layers]
        self.matrices = nn.ParameterList(
            nn.Parameter(torch.from_numpy(projections[layer].matrix[:, : stage.values].copy()))
            for layer in stage.layers
        )

    def forward(self, layers: list[Tensor]) -> Tensor:
        """Unit-length descriptors of cells, ... x L, of the layers' features, ... x K each."""
        parts = []
        for weight, features, mean, matrix in zip(self.stage.weights, layers, self.means, self.matrices, strict=True):
            projected = F.normalize((F.normalize(features, dim=-1) - mean) @ matrix, dim=-1)
            parts.append(weight**0.5 * projected)
        return torch.cat(parts, dim=-1)

    def projections(self) -> dict[str, Projection]:
        """The projections as they are now."""
        matrices = [matrix.detach().numpy().copy() for matrix in self.matrices]
        named = zip(self.stage.layers, self.means, matrices, strict=True)
        return {layer: Projection(mean.numpy(), matrix) for layer, mean, matrix in named}


def neighbours(cells: int, columns: int) -> Tensor:
    """Which pairs of different cells touch each other; bool [C, C]."""
    y, x = torch.div(torch.arange(cells), columns, rounding_mode="floor"), torch.arange(cells) % columns
    touching = ((y[:, None] - y).abs() <= 1) & ((x[:, None] - x).abs() <= 1)
    return touching & ~torch.eye(cells, dtype=torch.bool)


def contrastive_loss(clean: Tensor, augmented: Tensor, touching: Tensor) -> Tensor:
    """InfoNCE in both directions.

    Args:
        clean, augmented: B x C x L, unit length.
        touching: C x C, cells of one frame that are no negatives of each other.
    """
    frames, cells, _ = clean.shape
    logits = augmented.flatten(0, 1) @ clean.flatten(0, 1).T / TEMPERATURE  # BC x BC
    same_frame = torch.eye(frames, dtype=torch.bool).repeat_interleave(cells, 0).repeat_interleave(cells, 1)
    logits = logits.masked_fill(same_frame & touching.repeat(frames, frames), -torch.inf)
    own = torch.arange(frames * cells)
    return (F.cross_entropy(logits, own) + F.cross_entropy(logits.T, own)) / 2


def refine(
    projections: Mapping[str, Projection], stage: AgreementDefinition, pairs: PairedCells, steps: int, seed: int = 0
) -> tuple[dict[str, Projection], list[float]]:
    """The projections after ``steps`` steps of contrastive learning, and the loss of each step."""
    model = CellDescriptor(projections, stage)
    groups = [{"params": [matrix], "lr": RATE * float(matrix.detach().norm())} for matrix in model.matrices]
    optimizer = torch.optim.Adam(groups)
    schedule = torch.optim.lr_scheduler.ExponentialLR(optimizer, DECAY)
    generator = np.random.default_rng(seed)
    count, cells, _ = pairs.clean[stage.layers[0]].shape
    touching, losses = neighbours(cells, pairs.columns), []
    for _ in range(steps):
        chosen = generator.choice(count, min(BATCH, count), replace=False)
        clean, augmented = (
            model([torch.from_numpy(side[layer][chosen].astype(np.float32)) for layer in stage.layers])
            for side in (pairs.clean, pairs.augmented)
        )
        loss = contrastive_loss(clean, augmented, touching)
        optimizer.zero_grad()
        loss.backward()  # type: ignore[no-untyped-call]
        optimizer.step()
        schedule.step()
        losses.append(loss.item())
    return model.projections(), losses

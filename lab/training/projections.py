"""The projections of an encoder, learnt from pairs of crops that show the same scene in different light.

:func:`fit_projections` finds the directions that stay alike when the light changes in closed form; the packaged
encoders use these.  :func:`refine` goes on from there by InfoNCE (van den Oord et al., 2018): the descriptors of one
cell under two conditions attract, all others repel.  A cell's negatives are all cells of all crops of the batch but
its own neighbours; the backbone stays as it is.  The packaged encoders do not use it: its own loss fell while
recognition did not gain (see the model card).

:func:`fit_cell_projections` is for the second stage alone.  Its pairs are displaced views and neighbouring frames, and
in place of the variance of all cells it asks for the difference between a cell and the one that a frame of another
place matches it with.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from itertools import chain
from pathlib import Path

import numpy as np
import torch
import torch.nn.functional as F
from numpy.typing import NDArray
from rich.progress import track
from torch import Tensor, nn

from core.frames.preprocessing import prepare
from core.method.agreement import AgreementDefinition, Cells, correspondences, local_descriptors
from core.method.encoder import Encoder
from core.method.equations import unit_length
from core.method.projection import Projection, discriminant, fit_projection
from core.networks.torch_network import TorchNetwork
from lab.training.distillation import SIDE
from lab.training.photographs import AugmentedCrops, split_photographs
from lab.training.views.displaced_views import COLUMNS, DisplacedViews, Displacement, Kind, displaced_views
from lab.training.views.neighbouring_views import neighbouring_views

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

VIEWS, NEIGHBOURS = 2400, 1400
"""Pairs of displaced views, and of neighbouring frames that are drawn."""
ANSWERS_PER_PAIR, WRONG_PER_FRAME = 40, 30
WEIGHTS: dict[Kind, float] = {"displaced": 1.0, "neighbours": 2.0, "cameras": 2.0}
"""Of the mean differences of each kind of pairs."""
CONFUSABLE, APART = 3, 8
"""How many other frames a view is matched with; photographs this close in order of names may show one place."""
WRONG_REACH = (3, 5)
"""Rows and columns within which wrong matches are looked for."""
SHRINKAGE = 2.0
"""As in ``core.method.projection``; the differences of single matches need more of it."""


@dataclass(frozen=True)
class PairedCells:
    """Local features of the same n crops under two conditions; by layer float [n, C, K].

    columns: of the grid of the C cells.
    """

    clean: Mapping[str, NDArray[np.floating]]
    augmented: Mapping[str, NDArray[np.floating]]
    columns: int


def fit_projections(
    network: TorchNetwork, values: dict[str, int], photographs: Path, crops: int = CROPS, seed: int = 0
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
        layer: fit_projection(np.concatenate(clean[layer]), np.concatenate(augmented[layer]), retained)
        for layer, retained in values.items()
    }


def _crop_pairs(photographs: Path, crops: int, seed: int) -> AugmentedCrops:
    """Pairs of a clean and an augmented crop, others than those of the distillation with this seed."""
    paths = split_photographs(photographs).train
    return AugmentedCrops(paths, photographs, SIDE, seed + SEED_OFFSET, 0, crops)


def paired_cells(network: TorchNetwork, photographs: Path, crops: int, seed: int = 0) -> PairedCells:
    """The features of all cells of such crops, which :func:`refine` learns from."""
    pairs = _crop_pairs(photographs, crops, seed)
    maps = [_maps(network, pairs[index]) for index in track(range(crops), "cells for the refinement")]
    clean, augmented = (
        {layer: np.stack([frame[layer][side].astype(np.float16) for frame in maps]) for layer in network.outputs}
        for side in (0, 1)
    )
    cells = maps[0][network.outputs[0]].shape[1]
    return PairedCells(clean, augmented, columns=round(cells**0.5))


def _maps(network: TorchNetwork, frames: Sequence[NDArray[np.uint8]]) -> dict[str, Array]:
    """Activations of each output, B x C x K."""
    batch = np.stack([prepare(frame, network.input) for frame in frames])
    with torch.inference_mode():
        outputs = network(torch.from_numpy(batch).permute(0, 3, 1, 2))
    return {
        name: np.ascontiguousarray(output.flatten(2).permute(0, 2, 1).numpy())
        for name, output in zip(network.outputs, outputs, strict=True)
    }


Features = NDArray[np.float16]
Matches = NDArray[np.int64]
"""Cells that are compared: int64 [n, 4], frame and cell of a second view, and frame and cell of a first one."""


def fit_cell_projections(
    encoder: Encoder,
    stage: AgreementDefinition,
    photographs: Path,
    pairs: int = VIEWS,
    neighbours: int = NEIGHBOURS,
    seed: int = 0,
) -> dict[str, Projection]:
    """A projection for each layer of a second stage.

    It has the directions in which the right matches of a cell differ least, relative to the wrong ones.  Right is what
    shows the same spot; wrong is the mutual match in a frame that the first stage confuses and that shows another
    place.

    Args:
        encoder: of the first stage; it has all layers of the stage, and projections of them.
        photographs: folder of the training photographs.
        pairs, neighbours: how many displaced views and neighbouring frames are drawn.
    """
    views = Views.of(
        encoder,
        stage,
        track(
            chain(
                displaced_views(photographs, SIDE, pairs, seed + SEED_OFFSET),
                neighbouring_views(photographs, SIDE, neighbours, seed + SEED_OFFSET),
            ),
            "pairs of views",
            total=pairs + neighbours,
        ),
    )
    return taught_projections(views, stage, encoder.extractor.projections, seed)


@dataclass(frozen=True)
class Views:
    """n pairs of views as an encoder sees them.

    first, second: by layer the features of the views' cells, of unit length, float16 [n, C, K].
    likeness: inner products of the descriptors of second views and of first ones, float32 [n, n].
    """

    displacements: Sequence[Displacement]
    first: Mapping[str, Features]
    second: Mapping[str, Features]
    likeness: Array

    @classmethod
    def of(cls, encoder: Encoder, stage: AgreementDefinition, pairs: Iterable[DisplacedViews]) -> Views:
        """Encode pairs of views; the second stage's features of them stay unprojected."""
        outputs = encoder.definition.outputs
        displacements: list[Displacement] = []
        sides: tuple[dict[str, list[Features]], ...] = tuple({layer: [] for layer in stage.layers} for _ in "ab")
        descriptors: tuple[list[Array], ...] = [], []
        for views in pairs:
            displacements.append(views.displacement)
            seen = encoder.extractor.activations((views.first, views.second))
            for activations, side, described in zip(seen, sides, descriptors, strict=True):
                described.append(encoder.describe(activations).descriptor)
                for layer in stage.layers:
                    cells = activations[outputs.index(layer)]
                    side[layer].append(unit_length(cells.reshape(-1, cells.shape[-1])).astype(np.float16))
        first, second = ({layer: np.stack(side.pop(layer)) for layer in stage.layers} for side in sides)
        return cls(displacements, first, second, np.stack(descriptors[1]) @ np.stack(descriptors[0]).T)


def taught_projections(
    views: Views, stage: AgreementDefinition, start: Mapping[str, Projection], seed: int = 0
) -> dict[str, Projection]:
    """The projections of :func:`fit_cell_projections` from pairs of views.

    Args:
        start: projections of the stage's layers, by which wrong matches are found.
    """
    compared = [
        [
            local_descriptors(
                [start[layer](side[layer][view].astype(np.float32), stage.values) for layer in stage.layers], stage
            )
            for view in range(len(views.displacements))
        ]
        for side in (views.first, views.second)
    ]
    generator = np.random.default_rng(seed)
    right = _right_matches(views.displacements, generator)
    kind = np.array([pair.kind for pair in views.displacements])[right[:, 0]]
    wrong = _wrong_matches(views, compared[1], compared[0], generator)
    made = {}
    for layer in stage.layers:
        sides = views.first[layer], views.second[layer]
        apart = {one: _differences(*sides, right[kind == one]) for one in WEIGHTS if (kind == one).any()}
        within = np.average(list(apart.values()), axis=0, weights=[WEIGHTS[one] for one in apart])
        matrix = discriminant(within, _differences(*sides, wrong), stage.values, SHRINKAGE)
        mean = np.mean([side.mean(axis=(0, 1), dtype=np.float64) for side in sides], axis=0)
        made[layer] = Projection(mean.astype(np.float32), matrix)
    return made


def _right_matches(views: Sequence[Displacement], generator: np.random.Generator) -> Matches:
    """Some cells of each second view and those of its first view that they show."""
    found = []
    for number, pair in enumerate(views):
        drawn = generator.permutation(pair.answers)[:ANSWERS_PER_PAIR]
        found += [(number, there, number, here) for here, there in drawn.tolist()]
    return np.array(found, np.int64)


def _wrong_matches(
    views: Views, queries: Sequence[Cells], references: Sequence[Cells], generator: np.random.Generator
) -> Matches:
    """Some mutual matches of each second view in the first views of other places that are most like it."""
    photograph = np.array([pair.photograph for pair in views.displacements])
    camera = np.array([pair.camera for pair in views.displacements])
    one_place = (camera[:, np.newaxis] == camera) & (camera != "")
    one_place |= np.abs(photograph[:, np.newaxis] - photograph) < APART
    likeness = np.where(one_place, -np.inf, views.likeness)
    found = []
    for number, row in enumerate(likeness):
        for other in np.argsort(-row)[:CONFUSABLE].tolist():
            if row[other] > -np.inf:
                matched = correspondences(queries[number], references[other], COLUMNS, WRONG_REACH)
                pairs = generator.permutation(np.stack([matched.query, matched.reference], axis=1))[:WRONG_PER_FRAME]
                found += [(number, here, other, there) for here, there in pairs.tolist()]
    return np.array(found, np.int64)


def _differences(first: Features, second: Features, matches: Matches) -> NDArray[np.float64]:
    """Half the mean outer product of what matched cells differ by, float64 [K, K], of features float16 [n, C, K]."""
    here, there = second[matches[:, 0], matches[:, 1]], first[matches[:, 2], matches[:, 3]]
    seen = here.any(axis=1) & there.any(axis=1)
    difference = here[seen].astype(np.float32) - there[seen].astype(np.float32)
    return (difference.T @ difference).astype(np.float64) / max(1, 2 * len(difference))


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

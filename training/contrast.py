"""A place-recognition objective on top: cells of one spot under two conditions attract, all others repel.

InfoNCE (van den Oord et al., 2018) over the local descriptors as the second stage compares them, between clean crops
and the same crops disturbed or, of fixed cameras, taken at night.  A cell's negatives are all cells of all crops of
the batch but its own neighbours.  The backbone stays as it is; the projections are what learns, from where the
discriminant (``training.projection``) left them.

The packaged encoders do not use it: its own loss fell while recognition did not gain (see the model card).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import torch
import torch.nn.functional as F
from numpy.typing import NDArray
from torch import Tensor, nn

from core.method.agreement import AgreementDefinition
from core.method.projection import Projection

TEMPERATURE = 0.07
RATE = 2e-4
"""Learning rate, relative to the norm of each projection."""
DECAY = 0.997
BATCH = 12  # crops


@dataclass(frozen=True)
class Pairs:
    """Local descriptors of the same n crops under two conditions; by layer float [n, C, K]."""

    clear: Mapping[str, NDArray[np.floating]]
    changed: Mapping[str, NDArray[np.floating]]
    columns: int


class CellDescriptor(nn.Module):
    """The projections as something that learns."""

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
        """As they are now."""
        matrices = [matrix.detach().numpy().copy() for matrix in self.matrices]
        named = zip(self.stage.layers, self.means, matrices, strict=True)
        return {layer: Projection(mean.numpy(), matrix) for layer, mean, matrix in named}


def neighbours(cells: int, columns: int) -> Tensor:
    """Which cells touch one another, themselves left out; bool [C, C]."""
    y, x = torch.div(torch.arange(cells), columns, rounding_mode="floor"), torch.arange(cells) % columns
    touching = ((y[:, None] - y).abs() <= 1) & ((x[:, None] - x).abs() <= 1)
    return touching & ~torch.eye(cells, dtype=torch.bool)


def contrastive_loss(clear: Tensor, changed: Tensor, touching: Tensor) -> Tensor:
    """InfoNCE in both directions; B x C x L each, C x C which cells are no negatives of one another."""
    frames, cells, _ = clear.shape
    logits = changed.flatten(0, 1) @ clear.flatten(0, 1).T / TEMPERATURE  # BC x BC
    same_frame = torch.eye(frames, dtype=torch.bool).repeat_interleave(cells, 0).repeat_interleave(cells, 1)
    logits = logits.masked_fill(same_frame & touching.repeat(frames, frames), -torch.inf)
    own = torch.arange(frames * cells)
    return (F.cross_entropy(logits, own) + F.cross_entropy(logits.T, own)) / 2


def refine(
    projections: Mapping[str, Projection], stage: AgreementDefinition, pairs: Pairs, steps: int, seed: int = 0
) -> tuple[dict[str, Projection], list[float]]:
    """The projections after so many steps of the contrast, and the loss of each step."""
    model = CellDescriptor(projections, stage)
    groups = [{"params": [matrix], "lr": RATE * float(matrix.detach().norm())} for matrix in model.matrices]
    optimizer = torch.optim.Adam(groups)
    schedule = torch.optim.lr_scheduler.ExponentialLR(optimizer, DECAY)
    generator = np.random.default_rng(seed)
    count, cells, _ = pairs.clear[stage.layers[0]].shape
    touching, losses = neighbours(cells, pairs.columns), []
    for _ in range(steps):
        chosen = generator.choice(count, min(BATCH, count), replace=False)
        clear, changed = (
            model([torch.from_numpy(side[layer][chosen].astype(np.float32)) for layer in stage.layers])
            for side in (pairs.clear, pairs.changed)
        )
        loss = contrastive_loss(clear, changed, touching)
        optimizer.zero_grad()
        loss.backward()  # type: ignore[no-untyped-call]
        optimizer.step()
        schedule.step()
        losses.append(loss.item())
    return model.projections(), losses

"""From a frame to its features: backbone, regions of interest, fusion, projection (thesis, sections 3.2 and 4.1)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any, Literal

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, model_validator

from core.errors import InvalidModel
from core.frames.masks import Mask
from core.frames.preprocessing import Pixels, contrast, prepare
from core.method.equations import unit_length
from core.method.parts import cells, pooled
from core.method.projection import Projection
from core.method.regions import Regions, extract_regions, find_regions, projected_box_sums
from core.networks.backbone import Array, Device, OwnPass, Precision
from core.networks.forward import forward_pass
from core.networks.identity import arrays_digest, json_digest
from core.networks.network import ShallowNetwork
from core.threads import keep_numpy_single_threaded


class FeatureDefinition(BaseModel):
    """Which regions are taken from which layers (method, sections 3 and 4).

    ``steps`` are the quantisation steps, one a layer, in units of its activations.
    ``unit_features`` scales each regional feature to unit length before anything else, which the thesis does not.
    ``projection`` is to how many values regional features are projected (``projection.py``); None: not at all.
    ``parts`` are taken in place of regions of interest, ``regions`` being the most of them, and there are no steps; a
    network of others that gives a global descriptor has one cell.  ``exponent`` is that of the generalized mean.
    ``least_contrast`` is what a frame must have (``preprocessing.contrast``): a blank one excites a
    network through its biases alone, and what looks like regions says nothing of the scene.
    """

    model_config = ConfigDict(frozen=True, extra="forbid")

    layers: tuple[str, ...] = Field(min_length=1)
    regions: int = Field(ge=1, le=10_000, description="N, per layer")
    steps: tuple[float, ...]
    unit_features: bool
    projection: int | None = Field(default=None, ge=1)
    parts: Literal["cells", "pooled"] | None = Field(
        default=None, description="In place of regions: every cell, or one generalized mean of all; null: regions."
    )
    exponent: float | None = Field(default=None, ge=1, le=100, description="Of the generalized mean.")
    least_contrast: float = Field(default=2.0, ge=0, le=255, allow_inf_nan=False)

    @model_validator(mode="after")
    def _one_step_a_layer(self) -> FeatureDefinition:
        if (self.exponent is None) == (self.parts == "pooled"):
            raise ValueError("an exponent belongs to a generalized mean, and to it only")
        if self.parts is not None:
            if self.steps or self.projection is not None:
                raise ValueError("steps and a projection belong to regions")
            return self
        if len(self.steps) != len(self.layers) or not all(0 < step < float("inf") for step in self.steps):
            raise ValueError("each layer needs one positive quantisation step")
        if self.projection is not None and not self.unit_features:
            raise ValueError("projected features are of unit length")
        return self

    @property
    def outputs(self) -> tuple[str, ...]:
        """The layers that the backbone must return, those whose regions are fused first."""
        return self.layers

    def projected(self) -> dict[str, int]:
        """How many values of each layer's projection are used."""
        return {} if self.projection is None else dict.fromkeys(self.layers, self.projection)


class FeatureExtractor:
    """Computes the regions of interest of frames and their features, [T, K].

    Args:
        projections: by layer, of those layers for which the definition needs one.
        cells: by layer, the projections of local descriptors that have their own.

    Raises:
        InvalidModel: the backbone does not return the layers of the definition, or a projection is missing or has too
            few values.
    """

    def __init__(
        self,
        backbone: ShallowNetwork | OwnPass,
        definition: FeatureDefinition,
        projections: Mapping[str, Projection] | None = None,
        cells: Mapping[str, Projection] | None = None,
    ) -> None:
        if backbone.outputs != definition.outputs:
            raise InvalidModel(f"the backbone returns {backbone.outputs}, the encoder needs {definition.outputs}.")
        keep_numpy_single_threaded()
        self.backbone, self.definition = backbone, definition
        self._computed: tuple[Precision, Device] | None = None
        self.compute()
        self.projections, self.cells = dict(projections or {}), dict(cells or {})
        for layer, values in definition.projected().items():
            if layer not in self.projections or self.projections[layer].matrix.shape[1] < values:
                raise InvalidModel(f"the encoder needs a projection of {layer} to {values} values.")
        parts: dict[str, Any] = {
            "network": backbone.describe(),
            "weights": arrays_digest(backbone.weights()),
            "features": content_of(definition, set(FeatureDefinition.model_fields)),
        }
        if definition.projected():
            parts["projections"] = arrays_digest(projection_arrays(self.projections))
        self.origin = json_digest(parts)
        """The identity of the features; a vocabulary must have been trained on features of the same identity."""

    def compute(self, precision: Precision = "float32", device: Device = "cpu") -> None:
        """Choose how forward passes are computed from now on; a plugged network computes in its own way.

        Raises:
            InvalidModel: this machine or this network cannot compute so.
        """
        if (precision, device) != self._computed:
            self.forward = forward_pass(self.backbone, precision, device)
            """The forward pass in use: float32 [B, H, W, 3] to one float32 [B, X, Y, K] for each output."""
            self._computed = precision, device

    def activations(self, frames: Sequence[Pixels], masks: Sequence[Mask | None] | None = None) -> list[list[Array]]:
        """Of each frame the rectified maps of each output, float32 [X, Y, K]; see :meth:`maps`."""
        maps = self.maps(frames, masks)
        return [[layer[index] for layer in maps] for index in range(len(frames))]

    def maps(self, frames: Sequence[Pixels], masks: Sequence[Mask | None] | None = None) -> list[Array]:
        """Of each output the rectified maps of all frames, float32 [B, X, Y, K]; zeros for a blank frame.

        Args:
            frames: uint8 [H, W, 3] each, BGR.
            masks: of each frame, or None.  The network is shown its mean colour where a mask covers the frame, and
                cells that are covered by half or more are zero, so that they have no region and no local descriptor.
        """
        hidden = [None] * len(frames) if masks is None else masks
        shown = self.backbone.input
        batch, blank = np.empty((len(frames), shown.height, shown.width, 3), np.float32), []
        for image, frame, mask in zip(batch, frames, hidden, strict=True):
            prepare(frame, shown, image)
            if mask is not None:
                image[mask.covered(shown.height, shown.width)] = 0
            blank.append(contrast(frame, mask) < self.definition.least_contrast)
        maps = list(self.forward(batch))
        for index, mask in enumerate(hidden):
            for layer in maps:
                if blank[index]:
                    layer[index] = 0
                elif mask is not None and layer.shape[1:3] != (1, 1):  # which is of the whole frame
                    layer[index][mask.covered(*layer.shape[1:3])] = 0
        return maps

    def products(self, activations: Sequence[Array]) -> dict[str, Array]:
        """The products of the cells with the projection's matrix, float32 [..., X, Y, d], of each layer in use.

        Args:
            activations: of each output, of one frame or of several, float32 [..., X, Y, K].
        """
        maps = zip(self.definition.outputs, activations, strict=True)
        used = [
            name for name in self.definition.projected() if name in self.definition.layers or name not in self.cells
        ]
        return {
            name: self.projections[name].products(_cells(layer)).reshape(*layer.shape[:-1], -1)
            for name, layer in maps
            if name in used
        }

    def regions(self, activations: Sequence[Array], products: Mapping[str, Array] | None = None) -> Regions:
        """The regions of all layers of one frame, fused (equations 4.4 and 4.5).

        Args:
            activations: of each output, float32 [X, Y, K].
            products: the result of :meth:`products`, if it is known.
        """
        definition = self.definition
        fused = activations[: len(definition.layers)]
        if definition.parts is not None:
            found = (
                cells(fused, definition.regions) if definition.exponent is None else pooled(fused, definition.exponent)
            )
        elif definition.projection is not None:
            found = find_regions(fused, definition.steps, definition.regions)
            features = self._projected(found, fused, products or self.products(activations), definition.projection)
            return replace(found, features=features)
        else:
            found = extract_regions(fused, definition.steps, definition.regions)
        return replace(found, features=unit_length(found.features)) if definition.unit_features else found

    def _projected(self, found: Regions, fused: Sequence[Array], products: Mapping[str, Array], values: int) -> Array:
        """The projected regional features, float32 [T, values]."""
        features = np.empty((len(found), values), np.float32)
        parts = found.parts(len(fused))
        for name, layer, part in zip(self.definition.layers, fused, parts, strict=True):
            projection = self.projections[name]
            projected_box_sums(layer, products[name], found.boxes[part], projection.shift, features[part])
        return features

    def projected_cells(
        self, activations: Sequence[Array], products: Mapping[str, Array], layers: Sequence[str], values: int
    ) -> list[Array]:
        """The projected local descriptors D^L of the given layers of one frame, float32 [C, values] each."""
        maps = dict(zip(self.definition.outputs, activations, strict=True))
        made = []
        for name in layers:
            features, own = _cells(maps[name]), self.cells.get(name)
            known = _cells(products[name]) if own is None else own.products(features)
            made.append((own or self.projections[name]).finish(known, features, values))
        return made

    def layer_grids(self) -> dict[str, tuple[int, int]]:
        """Rows and columns of each layer's maps at the network's input size."""
        shown = self.backbone.input
        blank = np.zeros((shown.height, shown.width, 3), np.uint8)
        maps = self.activations([blank])[0]
        return {name: layer.shape[:2] for name, layer in zip(self.definition.outputs, maps, strict=True)}


def _cells(layer: Array) -> Array:
    """The local descriptors of maps: float32 [..., X, Y, K] to [n, K]."""
    return layer.reshape(-1, layer.shape[-1])


def content_of(definition: BaseModel, fields: set[str] | None = None) -> dict[str, Any]:
    """A definition as JSON, for identities; fields that are None are left out, so that later versions may add some."""
    return definition.model_dump(mode="json", include=fields, exclude_none=True)


def projection_arrays(projections: Mapping[str, Projection]) -> dict[str, Array]:
    """The arrays of projections by name: ``<layer>.mean`` and ``<layer>.matrix``."""
    arrays: dict[str, Array] = {}
    for layer, projection in projections.items():
        arrays[f"{layer}.mean"], arrays[f"{layer}.matrix"] = projection.mean, projection.matrix
    return arrays

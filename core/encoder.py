"""From a frame to its descriptor: backbone, regions, fusion, VLAD (thesis, Figure 4.1)."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field, model_validator

from core.backbone import Backbone
from core.errors import GoldenMismatch, InvalidModel, WrongVocabulary
from core.identity import json_digest, tensors_digest
from core.matching import scores
from core.preprocessing import Pixels, contrast, prepare
from core.regions import Regions, extract_regions, unit_length
from core.threads import keep_numpy_single_threaded
from core.verdict import Calibration
from core.vlad import Normalization, aggregate
from core.vocabulary import Vocabulary

Array = NDArray[np.float32]

GOLDEN_COSINE = 0.999
"""How close a machine's or a faster path's descriptors must come to the golden ones."""


class FeatureDefinition(BaseModel):
    """Which regions are taken from which layers (method, sections 3 and 4).

    ``steps`` are the quantisation steps, one a layer, in units of its activations.
    ``unit_features`` scales each regional feature to unit length before anything else.
    ``least_contrast`` is what a frame must have (``preprocessing.contrast``): a blank one excites a
    network through its biases alone, and what looks like regions says nothing of the scene.
    """

    model_config = ConfigDict(frozen=True, extra="forbid")

    layers: tuple[str, ...] = Field(min_length=1)
    regions: int = Field(ge=1, le=10_000, description="N, per layer")
    steps: tuple[float, ...]
    unit_features: bool
    least_contrast: float = Field(default=2.0, ge=0, le=255, allow_inf_nan=False)

    @model_validator(mode="after")
    def _one_step_a_layer(self) -> FeatureDefinition:
        if len(self.steps) != len(self.layers) or not all(0 < step < float("inf") for step in self.steps):
            raise ValueError("each layer needs one positive quantisation step")
        return self


class EncoderDefinition(FeatureDefinition):
    """All choices of an encoder besides its backbone and its vocabulary's values."""

    words: int = Field(ge=1, le=65_536, description="V")
    gamma: float = Field(gt=0, le=1)
    normalization: Normalization


@dataclass(frozen=True)
class Encoding:
    """What a frame becomes.

    descriptor: float32 [D]; zeros where the frame has no region.
    milliseconds: of the stages ``forward``, ``regions`` and ``vlad``.
    """

    descriptor: Array
    regions: Regions
    milliseconds: dict[str, float]


class FeatureExtractor:
    """Frames to regions of interest with their features, T x K.

    Raises:
        InvalidModel: the backbone does not return the layers of the definition.
    """

    def __init__(self, backbone: Backbone, definition: FeatureDefinition) -> None:
        if backbone.outputs != definition.layers:
            raise InvalidModel(f"the backbone returns {backbone.outputs}, the encoder needs {definition.layers}.")
        keep_numpy_single_threaded()
        self.backbone, self.definition = backbone, definition
        fields = FeatureDefinition.model_fields
        self.origin = json_digest(
            {
                "network": backbone.describe(),
                "weights": tensors_digest(backbone.weights()),
                "features": definition.model_dump(mode="json", include=set(fields)),
            }
        )
        """Identity of the features: what a vocabulary must have been trained on."""

    def activations(self, frames: Sequence[Pixels]) -> list[list[Array]]:
        """For each frame the rectified maps of each layer, float32 [X, Y, K]; zeros for a blank frame."""
        batch = np.stack([prepare(frame, self.backbone.input) for frame in frames])  # B x H x W x 3
        with torch.inference_mode():
            outputs = self.backbone(torch.from_numpy(batch).permute(0, 3, 1, 2))  # channels last in memory
        maps = [output.permute(0, 2, 3, 1).contiguous().numpy() for output in outputs]  # B x X x Y x K
        for index, frame in enumerate(frames):
            if contrast(frame) < self.definition.least_contrast:
                for layer in maps:
                    layer[index] = 0
        return [[layer[index] for layer in maps] for index in range(len(frames))]

    def regions(self, activations: Sequence[Array]) -> Regions:
        """The regions of all layers of one frame, fused (eqs. 4.4, 4.5)."""
        definition = self.definition
        found = extract_regions(activations, definition.steps, definition.regions)
        if not definition.unit_features:
            return found
        return Regions(found.boxes, found.energies, found.channels, found.layers, unit_length(found.features))

    def layer_grids(self) -> dict[str, tuple[int, int]]:
        """Cells (rows, columns) of each layer's maps at the network's input size."""
        shown = self.backbone.input
        blank = np.zeros((shown.height, shown.width, 3), np.uint8)
        maps = self.activations([blank])[0]
        return {name: layer.shape[:2] for name, layer in zip(self.definition.layers, maps, strict=True)}


class Encoder:
    """M-Region-VLAD, or Region-VLAD with one layer: a frame to one vector of V·K values.

    Thread-safe: encoding changes nothing.

    Args:
        name: what users call it.
        extractor: backbone and regions.
        vocabulary: trained on the features of just this extractor.
        calibration: the default that a map uses until it has its own.
        golden: float [D], the canary frame's descriptor where the encoder was made.

    Raises:
        WrongVocabulary: the vocabulary was trained for another extractor.
        InvalidModel: it has another number of words than the definition says.
    """

    def __init__(
        self,
        name: str,
        extractor: FeatureExtractor,
        definition: EncoderDefinition,
        vocabulary: Vocabulary,
        calibration: Calibration,
        golden: Array | None = None,
    ) -> None:
        if vocabulary.origin != extractor.origin:
            raise WrongVocabulary(
                f"the vocabulary of {name} was trained for the features {vocabulary.origin[:12]}, "
                f"this network and its regions give {extractor.origin[:12]}; train it again."
            )
        if len(vocabulary.centers) != definition.words:
            raise InvalidModel(f"{name} needs {definition.words} words, its vocabulary has {len(vocabulary.centers)}.")
        self.name, self.extractor, self.definition = name, extractor, definition
        self.centers = vocabulary.centers
        self.calibration, self._golden = calibration, golden
        self.dimension = int(self.centers.size)
        self.identity = encoder_identity(name, definition, vocabulary)

    def encode(self, pixels: Pixels) -> Encoding:
        """Encode one frame, H x W x 3 uint8 BGR of any size."""
        return self.encode_batch([pixels])[0]

    def encode_batch(self, frames: Sequence[Pixels]) -> list[Encoding]:
        """Encode frames with one forward pass; ``forward`` is each frame's share of it."""
        if not frames:
            return []
        started = time.perf_counter()
        activations = self.extractor.activations(frames)
        forward = 1e3 * (time.perf_counter() - started) / len(frames)
        return [self._describe(layers, forward) for layers in activations]

    def _describe(self, activations: Sequence[Array], forward: float) -> Encoding:
        definition = self.definition
        began = time.perf_counter()
        regions = self.extractor.regions(activations)
        between = time.perf_counter()
        descriptor = aggregate(regions.features, self.centers, definition.gamma, definition.normalization)
        ended = time.perf_counter()
        times = {"forward": forward, "regions": 1e3 * (between - began), "vlad": 1e3 * (ended - between)}
        return Encoding(descriptor, regions, times)

    def scores_from_inner_products(self, inner_products: Array) -> Array:
        """Inner products of descriptors, any shape, as the scores that users see."""
        return scores(inner_products, self.definition.words, self.definition.normalization)

    def score(self, a: Array, b: Array) -> float:
        """The score of two descriptors, float32 [D]: J / V (eq. 4.13) or the inner product."""
        return float(self.scores_from_inner_products(np.array(a @ b, np.float32)))

    def layer_grids(self) -> dict[str, tuple[int, int]]:
        """Cells (rows, columns) of each fused layer's maps."""
        return self.extractor.layer_grids()

    def check_golden(self) -> None:
        """Encode the canary frame and compare.

        Raises:
            GoldenMismatch: the cosine to the golden descriptor is under 0.999, or there is none.
        """
        if self._golden is None:
            raise GoldenMismatch(f"{self.name} has no golden values.")
        made = self.encode(canary_frame()).descriptor
        golden = self._golden.astype(np.float32)
        cosine = float(made @ golden / max(1e-12, float(np.linalg.norm(made) * np.linalg.norm(golden))))
        if not cosine >= GOLDEN_COSINE:
            raise GoldenMismatch(f"{self.name} gives a cosine of {cosine:.4f} to its golden values on this machine.")


def encoder_identity(name: str, definition: EncoderDefinition, vocabulary: Vocabulary) -> str:
    """``<name>@<sha256>`` over every field that can change a descriptor, tensors by content."""
    centers = tensors_digest({"centers": torch.from_numpy(vocabulary.centers)})
    fields = {"features": vocabulary.origin, "vocabulary": centers, "definition": definition.model_dump(mode="json")}
    return f"{name}@{json_digest(fields)}"


def canary_frame() -> Pixels:
    """A 480 x 640 BGR picture made of integers alone: stripes, blocks and a ramp."""
    y, x = np.mgrid[0:480, 0:640]
    blue = (x * 3 + y) % 256
    green = ((x // 40 + y // 30) % 2) * 120 + (x * y // 97) % 90
    red = np.where((x - 320) ** 2 + (y - 240) ** 2 < 150**2, 220, (y * 2) % 140)
    return np.stack([blue, green, red], axis=2).astype(np.uint8)

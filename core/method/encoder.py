"""From a frame to its descriptors: backbone, regions, fusion, VLAD (thesis, Figure 4.1); cells for the second stage."""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any, Literal

import numpy as np
import torch
from numpy.typing import NDArray
from pydantic import Field

from core.errors import GoldenMismatch, InvalidModel, WrongVocabulary
from core.frames.masks import Mask
from core.frames.preprocessing import Pixels
from core.judgement.verdict import Calibration
from core.method.agreement import AgreementDefinition, Cells, ScatteredCells, agreement, local_descriptors
from core.method.equations import Normalization
from core.method.features import FeatureDefinition, FeatureExtractor, content_of
from core.method.regions import Regions
from core.method.vlad import Words, aggregate, scores
from core.method.vocabulary import Vocabulary
from core.networks.forward import Device, Precision, has_bfloat16
from core.networks.identity import json_digest, tensors_digest
from core.networks.network import ShallowNetwork
from core.threads import each

Array = NDArray[np.float32]

FRAMES_A_PASS = 4
"""Frames that share a forward pass at most: more gain nothing, and their maps would not stay in the caches."""

GOLDEN_COSINE = 0.999
"""How close a machine's or a faster path's descriptors must come to the golden ones."""


class EncoderDefinition(FeatureDefinition):
    """All choices of an encoder besides its backbone and the values of its projections and its vocabulary."""

    words: int = Field(ge=1, le=65_536, description="V")
    gamma: float = Field(gt=0, le=1)
    normalization: Normalization
    agreement: AgreementDefinition | None = Field(default=None, description="The second stage; null: none.")

    @property
    def outputs(self) -> tuple[str, ...]:
        """The layers that the backbone must return: those whose regions are fused, then those only compared."""
        further = () if self.agreement is None else self.agreement.layers
        return self.layers + tuple(layer for layer in further if layer not in self.layers)

    def projected(self) -> dict[str, int]:
        """How many values of each layer's projection are in use."""
        used = super().projected()
        if self.agreement is not None:
            for layer in self.agreement.layers:
                used[layer] = max(used.get(layer, 0), self.agreement.values)
        return used


@dataclass(frozen=True)
class Encoding:
    """What a frame becomes.

    descriptor: float32 [D]; zeros where the frame has no region.
    local: int8 [C, L], local descriptors of the C cells for the second stage, zeros where the frame has no region;
        [0, 0] without one.
    milliseconds: of the stages ``forward``, ``regions`` and ``vlad``; the last includes the local descriptors.
    """

    descriptor: Array
    local: Cells
    regions: Regions
    milliseconds: dict[str, float]


class Encoder:
    """M-Region-VLAD, or Region-VLAD with one layer: a frame to one vector of V·K values, K of a projected feature
    if features are projected, and to the local descriptors of its cells if there is a second stage.

    Thread-safe: encoding changes nothing.

    Args:
        name: what users call it.
        extractor: backbone and regions.
        vocabulary: trained on the features of just this extractor.
        calibration: the default that a map uses until it has its own.
        golden: what the canary frame gave where the encoder was made: float [D], its descriptor, and
            int8 [C, L], its local descriptors.

    Raises:
        WrongVocabulary: the vocabulary was trained for another extractor.
        InvalidModel: it has another number of words than the definition says, or the layers of the
            second stage have different grids.
    """

    def __init__(
        self,
        name: str,
        extractor: FeatureExtractor,
        definition: EncoderDefinition,
        vocabulary: Vocabulary,
        calibration: Calibration,
        golden: tuple[Array, Cells] | None = None,
    ) -> None:
        if vocabulary.origin != extractor.origin:
            raise WrongVocabulary(
                f"the vocabulary of {name} was trained for the features {vocabulary.origin[:12]}, "
                f"this network and its regions give {extractor.origin[:12]}; train it again."
            )
        if len(vocabulary.centers) != definition.words:
            raise InvalidModel(f"{name} needs {definition.words} words, its vocabulary has {len(vocabulary.centers)}.")
        self.name, self.extractor, self.definition = name, extractor, definition
        self.centers, self._words = vocabulary.centers, Words(vocabulary.centers)
        self.calibration, self._golden = calibration, golden
        self.dimension = int(self.centers.size)
        self.identity = encoder_identity(name, definition, vocabulary)
        self.grid = self._agreement_grid()
        """Rows and columns of the cells that the second stage compares; (0, 0) without one."""

    def _agreement_grid(self) -> tuple[int, int]:
        if self.definition.agreement is None:
            return 0, 0
        grids = self.layer_grids()
        found = {grids[layer] for layer in self.definition.agreement.layers}
        if len(found) != 1:
            raise InvalidModel(f"{self.name}: the layers of its second stage have different grids, {sorted(found)}.")
        return found.pop()

    @property
    def local_shape(self) -> tuple[int, int]:
        """C and L, cells of a frame and values of each that the second stage compares; (0, 0) without one."""
        stage = self.definition.agreement
        return (0, 0) if stage is None else (self.grid[0] * self.grid[1], stage.length)

    @property
    def candidates(self) -> int:
        """How many of the best matches the second stage examines."""
        stage = self.definition.agreement
        return 0 if stage is None else stage.candidates

    def agreement(self, query: Cells, candidates: Cells | ScatteredCells) -> Array:
        """What the second stage adds to the candidates' scores, at least 0; int8 [C, L], [k, C, L] to float32 [k]."""
        stage = self.definition.agreement
        if stage is None:
            return np.zeros(len(candidates), np.float32)
        return agreement(query, candidates, self.grid[1], stage)

    def encode(self, pixels: Pixels, mask: Mask | None = None) -> Encoding:
        """Encode one frame, H x W x 3 uint8 BGR of any size, but for what a mask covers; its pass has all cores."""
        return self._encode([pixels], [mask])[0]

    def encode_batch(self, frames: Sequence[Pixels], masks: Sequence[Mask | None] | None = None) -> list[Encoding]:
        """Encode frames, a few to a forward pass and a pass to a core: more frames a second than one by one.

        Args:
            frames: H x W x 3 uint8 BGR each, of any sizes.
            masks: of each frame what not to see; None: all is seen.

        Raises:
            ValueError: there is another number of masks than of frames.
        """
        hidden = [None] * len(frames) if masks is None else masks
        if len(hidden) != len(frames):
            raise ValueError(f"{len(hidden)} masks for {len(frames)} frames")
        threads = torch.get_num_threads()
        passes = max(min(threads, len(frames)), -(-len(frames) // FRAMES_A_PASS))
        cuts = [len(frames) * index // max(passes, 1) for index in range(passes + 1)]

        def encode(part: tuple[int, int]) -> list[Encoding]:
            return self._encode(frames[part[0] : part[1]], hidden[part[0] : part[1]])

        return [encoding for made in each(encode, list(pairwise(cuts)), threads) for encoding in made]

    def _encode(self, frames: Sequence[Pixels], masks: Sequence[Mask | None]) -> list[Encoding]:
        """Encode frames with one forward pass; ``forward`` is each frame's share of it."""
        started = time.perf_counter()
        maps = self.extractor.maps(frames, masks)
        products = self.extractor.products(maps)
        forward = 1e3 * (time.perf_counter() - started) / len(frames)
        return [
            self.describe([layer[i] for layer in maps], forward, {name: layer[i] for name, layer in products.items()})
            for i in range(len(frames))
        ]

    def describe(
        self, activations: Sequence[Array], forward: float = 0.0, products: Mapping[str, Array] | None = None
    ) -> Encoding:
        """Encode a frame whose activations are known, as ``extractor.activations`` gives them.

        Args:
            forward: milliseconds that they and the products took.
            products: as ``extractor.products`` gives them, if they are known.
        """
        definition = self.definition
        began = time.perf_counter()
        products = self.extractor.products(activations) if products is None else products
        regions = self.extractor.regions(activations, products)
        between = time.perf_counter()
        descriptor = aggregate(regions.features, self._words, definition.gamma, definition.normalization)
        local = self.local(activations, products) if len(regions) else np.zeros(self.local_shape, np.int8)
        ended = time.perf_counter()
        times = {"forward": forward, "regions": 1e3 * (between - began), "vlad": 1e3 * (ended - between)}
        return Encoding(descriptor, local, regions, times)

    def local(self, activations: Sequence[Array], products: Mapping[str, Array]) -> Cells:
        """The local descriptors of a frame that has a region, as :attr:`Encoding.local`.

        Whatever a frame without regions excites, it is like no other: its descriptors are zero.
        """
        stage = self.definition.agreement
        if stage is None:
            return np.zeros(self.local_shape, np.int8)
        cells = self.extractor.projected_cells(activations, products, stage.layers, stage.values)
        return local_descriptors(cells, stage)

    def scores_from_inner_products(self, inner_products: Array) -> Array:
        """Inner products of descriptors, any shape, as the scores that users see: of places not examined further."""
        first = scores(inner_products, self.definition.words, self.definition.normalization)
        stage = self.definition.agreement
        return first if stage is None else first * np.float32(1 - stage.share)

    def score(self, a: Encoding, b: Encoding) -> float:
        """The score of two frames: J / V (eq. 4.13) or the inner product, shared with their agreement if it counts."""
        product = np.array(a.descriptor @ b.descriptor, np.float32)
        return float(self.scores_from_inner_products(product) + self.agreement(a.local, b.local[np.newaxis])[0])

    def with_agreement(self, scores: Array, queries: Cells, references: Cells) -> Array:
        """The scores after the second stage: of each query those of the best ``candidates`` have gained.

        Args:
            scores: float32 [Q, R].
            queries: int8 [Q, C, L], their local descriptors.
            references: int8 [R, C, L].
        """
        if not self.candidates:
            return scores
        raised = scores.copy()
        for row, query in zip(raised, queries, strict=True):
            best = np.argsort(-row, kind="stable")[: self.candidates]
            row[best] += self.agreement(query, references[best])
        return raised

    def layer_grids(self) -> dict[str, tuple[int, int]]:
        """Cells (rows, columns) of the maps of each layer in use."""
        return self.extractor.layer_grids()

    def settle(self, precision: Precision | Literal["auto"] = "auto", device: Device = "cpu") -> Precision:
        """Choose how forward passes are computed, before the first frame is encoded; the precision now in use.

        A lower precision is used only where it makes no difference that counts: descriptors of one identity are
        held against each other, whichever machine made them.

        Args:
            precision: "auto" takes bfloat16 where the processor multiplies it and the descriptors of a few frames
                come as close to those of float32 as ``GOLDEN_COSINE``.
            device: of the forward pass; on a GPU it is float32.

        Raises:
            InvalidModel: this machine has not what was asked for.
            GoldenMismatch: bfloat16 was asked for, and the descriptors do not stand it.
        """
        self.extractor.compute("float32", device)
        lower = has_bfloat16() and isinstance(self.extractor.backbone, ShallowNetwork)
        if device == "cuda" or precision == "float32" or (precision == "auto" and not lower):
            return "float32"
        frames = [canary_frame(), canary_frame()[:, ::-1].copy(), 255 - canary_frame()]
        exact = [self.encode(frame) for frame in frames]
        try:
            self.extractor.compute("bfloat16")
            for frame, wanted in zip(frames, exact, strict=True):
                self._hold_against(self.encode(frame), wanted.descriptor, wanted.local, "those of float32")
        except (GoldenMismatch, InvalidModel):
            self.extractor.compute("float32")
            if precision == "bfloat16":
                raise
            return "float32"
        return "bfloat16"

    def _hold_against(self, made: Encoding, descriptor: NDArray[Any], local: Cells, what: str) -> None:
        for cosine in (_cosine(made.descriptor, descriptor), _cosine(made.local, local)):
            if not cosine >= GOLDEN_COSINE:
                raise GoldenMismatch(f"{self.name} gives a cosine of {cosine:.4f} to {what} on this machine.")

    def check_golden(self) -> None:
        """Encode the canary frame and compare.

        Raises:
            GoldenMismatch: the cosine to the golden descriptor is under 0.999, or there is none.
        """
        if self._golden is None:
            raise GoldenMismatch(f"{self.name} has no golden values.")
        made = self.encode(canary_frame())
        self._hold_against(made, *self._golden, "its golden values")
        self.agreement(made.local, made.local[np.newaxis])  # compiled now, as all else is, and not by the first query


def _cosine(found: NDArray[Any], golden: NDArray[Any]) -> float:
    """Of two arrays of one shape, flattened; 1 where both are empty."""
    if found.shape != golden.shape:
        return 0.0
    a, b = found.astype(np.float64).ravel(), golden.astype(np.float64).ravel()
    return float(a @ b / max(1e-12, float(np.linalg.norm(a) * np.linalg.norm(b)))) if a.size else 1.0


def encoder_identity(name: str, definition: EncoderDefinition, vocabulary: Vocabulary) -> str:
    """``<name>@<sha256>`` over every field that can change a descriptor, tensors by content."""
    centers = tensors_digest({"centers": torch.from_numpy(vocabulary.centers)})
    fields = {"features": vocabulary.origin, "vocabulary": centers, "definition": content_of(definition)}
    return f"{name}@{json_digest(fields)}"


def canary_frame() -> Pixels:
    """A 480 x 640 BGR picture made of integers alone: stripes, blocks and a ramp."""
    y, x = np.mgrid[0:480, 0:640]
    blue = (x * 3 + y) % 256
    green = ((x // 40 + y // 30) % 2) * 120 + (x * y // 97) % 90
    red = np.where((x - 320) ** 2 + (y - 240) ** 2 < 150**2, 220, (y * 2) % 140)
    return np.stack([blue, green, red], axis=2).astype(np.uint8)

"""The encoder, from a frame to its descriptors: backbone, regions, fusion, VLAD (thesis, Figure 4.1), and its cells."""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from core.errors import GoldenMismatch, InvalidModel, WrongVocabulary
from core.frames.masks import Mask
from core.frames.preprocessing import Pixels
from core.judgement.verdict import Calibration
from core.method.agreement import AgreementDefinition, Cells, agreement, local_descriptors, promise
from core.method.equations import Normalization
from core.method.features import FeatureDefinition, FeatureExtractor, content_of, projection_arrays
from core.method.projection import Projection
from core.method.regions import Regions
from core.method.vlad import aggregate, are_normalized, scores
from core.method.vocabulary import Vocabulary
from core.method.whitening import Whitening
from core.networks.backbone import Device
from core.networks.identity import arrays_digest, json_digest
from core.threads import allowed_threads, each

Array = NDArray[np.float32]

GOLDEN_COSINE = 0.999
"""Least cosine of the descriptors of a machine to the golden ones."""


class EncoderDefinition(FeatureDefinition):
    """All choices of an encoder besides its backbone and the values of its projections and its vocabulary."""

    words: int = Field(ge=1, le=65_536, description="V")
    gamma: float = Field(gt=0, le=1)
    normalization: Normalization
    agreement: AgreementDefinition | None = Field(default=None, description="The second stage; null: none.")
    whitening: int | None = Field(default=None, ge=1, le=65_536, description="Values of the whitened descriptor.")

    @property
    def outputs(self) -> tuple[str, ...]:
        """The layers that the backbone must return: those whose regions are fused, then those of the second stage."""
        further = () if self.agreement is None else self.agreement.layers
        return self.layers + tuple(layer for layer in further if layer not in self.layers)

    @property
    def descriptor_normalization(self) -> Normalization:
        """The normalization of the descriptors that are stored and compared."""
        return self.normalization if self.whitening is None else "global"

    def could_give(self, descriptors: Array, tolerance: float) -> NDArray[np.bool_]:
        """Which descriptors, float32 [n, D], have the length of those that such an encoder gives (:mod:`vlad`)."""
        return are_normalized(descriptors, self.words, self.descriptor_normalization, tolerance)

    def projected(self) -> dict[str, int]:
        """How many values of each layer's projection are in use."""
        used = super().projected()
        if self.agreement is not None:
            for layer in self.agreement.layers:
                used[layer] = max(used.get(layer, 0), self.agreement.values)
        return used


@dataclass(frozen=True)
class Encoding:
    """An encoded frame.

    descriptor: float32 [D]; zeros if the frame has no region.
    local: int8 [C, L], local descriptors of the C cells for the second stage, zeros if the frame has no region;
        [0, 0] for an encoder without a second stage.
    milliseconds: of the stages ``forward``, ``regions`` and ``vlad``; the second includes the cells' products with the
        projections, the last the local descriptors.
    """

    descriptor: Array
    local: Cells
    regions: Regions
    milliseconds: dict[str, float]


class Encoder:
    """M-Region-VLAD, or Region-VLAD if there is one layer; or a network of others, with its own parts of a frame.

    A frame becomes one vector of V·K values (K is that of the projected features if features are projected; whitening
    leaves fewer) and, if there is a second stage, the local descriptors of its cells.  Thread-safe: encoding changes
    nothing.

    Args:
        name: by which users choose the encoder.
        extractor: backbone and regions.
        vocabulary: trained on the features of this extractor.
        calibration: the default for maps that have none of their own.
        golden: the descriptor, float [D], and the local descriptors, int8 [C, L], of the canary frame on the machine
            where the encoder was made.
        whitening: fitted to descriptors of this vocabulary, if the definition has one.

    Raises:
        WrongVocabulary: the vocabulary was trained for another extractor.
        InvalidModel: it has another number of words than the definition says, the layers of the second stage have
            different grids, or taught cells lack a projection.
    """

    def __init__(
        self,
        name: str,
        extractor: FeatureExtractor,
        definition: EncoderDefinition,
        vocabulary: Vocabulary,
        calibration: Calibration,
        golden: tuple[Array, Cells] | None = None,
        whitening: Whitening | None = None,
    ) -> None:
        if vocabulary.origin != extractor.origin:
            raise WrongVocabulary(
                f"the vocabulary of {name} was trained for the features {vocabulary.origin[:12]}, "
                f"this network and its regions give {extractor.origin[:12]}; train it again."
            )
        if len(vocabulary.centers) != definition.words:
            raise InvalidModel(f"{name} needs {definition.words} words, its vocabulary has {len(vocabulary.centers)}.")
        if definition.whitening != (None if whitening is None else whitening.values):
            raise InvalidModel(f"{name} needs a whitening to {definition.whitening} values.")
        if whitening is not None and len(whitening.mean) != vocabulary.centers.size:
            raise InvalidModel(f"{name}: its whitening is not of vectors of {vocabulary.centers.size} values.")
        stage = definition.agreement
        taught = {} if stage is None or not stage.taught else dict.fromkeys(stage.layers, stage.values)
        if {layer: min(one.matrix.shape[1], taught.get(layer, 0)) for layer, one in extractor.cells.items()} != taught:
            raise InvalidModel(f"{name} needs projections of its cells in {', '.join(taught) or 'no layer'}.")
        self.name, self.extractor, self.definition = name, extractor, definition
        self.centers, self.whitening = vocabulary.centers, whitening
        self.calibration, self._golden = calibration, golden
        self.dimension = int(self.centers.size) if whitening is None else whitening.values
        self.identity = encoder_identity(name, definition, vocabulary, whitening, extractor.cells)
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
        """How many of the best matches the second stage examines; 0 without one."""
        stage = self.definition.agreement
        return 0 if stage is None else stage.candidates

    @property
    def screened(self) -> int:
        """Among how many of the best matches the second stage looks for those that it examines; 0 without one."""
        stage = self.definition.agreement
        return 0 if stage is None else stage.screened or stage.candidates

    def promise(self, query: Cells, candidates: Cells) -> Array:
        """About what the second stage would add to the candidates' scores; int8 [C, L] and [k, C, L] to float32 [k]."""
        stage = self.definition.agreement
        if stage is None:
            return np.zeros(len(candidates), np.float32)
        return promise(query, candidates, self.grid[1], stage)

    def agreement(self, query: Cells, candidates: Cells) -> Array:
        """The gain of the candidates' scores by the second stage; int8 [C, L] and [k, C, L] to float32 [k]."""
        stage = self.definition.agreement
        if stage is None:
            return np.zeros(len(candidates), np.float32)
        return agreement(query, candidates, self.grid[1], stage)

    def encode(self, pixels: Pixels, mask: Mask | None = None) -> Encoding:
        """Encode one frame, uint8 [H, W, 3], BGR, of any size; a mask hides a part of it.

        The forward pass uses all cores, unless the calling thread computes alone (``core.threads``).
        """
        started = time.perf_counter()
        activations = self.extractor.activations([pixels], [mask])[0]
        return self.describe(activations, 1e3 * (time.perf_counter() - started))

    def encode_batch(self, frames: Sequence[Pixels], masks: Sequence[Mask | None] | None = None) -> list[Encoding]:
        """Encode frames: each core takes one after the other, which is faster than all cores together.

        Args:
            frames: uint8 [H, W, 3] each, BGR, of any sizes.
            masks: one for each frame, None for a frame that is not masked; None: no frame is masked.

        Raises:
            ValueError: the number of masks is not that of the frames.
        """
        hidden = [None] * len(frames) if masks is None else masks
        if len(hidden) != len(frames):
            raise ValueError(f"{len(hidden)} masks for {len(frames)} frames")
        shown = list(zip(frames, hidden, strict=True))
        return each(lambda frame: self.encode(*frame), shown, allowed_threads())

    def describe(self, activations: Sequence[Array], forward: float = 0.0) -> Encoding:
        """Encode a frame whose activations are known.

        Args:
            activations: of each output, float32 [X, Y, K], as ``extractor.activations`` gives them.
            forward: milliseconds that they took.
        """
        definition = self.definition
        began = time.perf_counter()
        products = self.extractor.products(activations)
        regions = self.extractor.regions(activations, products)
        between = time.perf_counter()
        descriptor = aggregate(regions.features, self.centers, definition.gamma, definition.normalization)
        if self.whitening is not None:
            descriptor = self.whitening(descriptor[np.newaxis])[0]
        local = self.local(activations, products) if len(regions) else np.zeros(self.local_shape, np.int8)
        ended = time.perf_counter()
        times = {"forward": forward, "regions": 1e3 * (between - began), "vlad": 1e3 * (ended - between)}
        return Encoding(descriptor, local, regions, times)

    def local(self, activations: Sequence[Array], products: Mapping[str, Array]) -> Cells:
        """The local descriptors of a frame that has a region, int8 [C, L], as in :attr:`Encoding.local`.

        A frame without regions has no local descriptors: it is like no other frame.
        """
        stage = self.definition.agreement
        if stage is None:
            return np.zeros(self.local_shape, np.int8)
        cells = self.extractor.projected_cells(activations, products, stage.layers, stage.values)
        return local_descriptors(cells, stage)

    def scores_from_inner_products(self, inner_products: Array) -> Array:
        """Scores from inner products of descriptors, float32 of any shape, of places that the second stage has not
        examined."""
        first = scores(inner_products, self.definition.words, self.definition.descriptor_normalization)
        stage = self.definition.agreement
        return first if stage is None else first * np.float32(1 - stage.share)

    def score(self, a: Encoding, b: Encoding) -> float:
        """The score of two frames: J / V (equation 4.13) or the inner product; with a second stage, also agreement."""
        product = np.array(a.descriptor @ b.descriptor, np.float32)
        return float(self.scores_from_inner_products(product) + self.agreement(a.local, b.local[np.newaxis])[0])

    def layer_grids(self) -> dict[str, tuple[int, int]]:
        """Rows and columns of the maps of each layer in use."""
        return self.extractor.layer_grids()

    def use(self, device: Device) -> None:
        """Choose where forward passes are computed, in float32, before the first frame is encoded.

        In a lower precision descriptors differ too much from those that other machines made of the same frames
        (``benchmarks.devices.precision``).

        Raises:
            InvalidModel: this machine lacks the device.
        """
        self.extractor.compute("float32", device)

    def check_golden(self) -> None:
        """Encode the canary frame and compare its descriptors with the golden ones.

        Raises:
            GoldenMismatch: a cosine to the golden values is under ``GOLDEN_COSINE``, or there are no golden values.
        """
        if self._golden is None:
            raise GoldenMismatch(f"{self.name} has no golden values.")
        made = self.encode(canary_frame())
        descriptor, local = self._golden
        for cosine in (_cosine(made.descriptor, descriptor), _cosine(made.local, local)):
            if not cosine >= GOLDEN_COSINE:
                what = f"{self.name} gives a cosine of {cosine:.4f} to its golden values"
                raise GoldenMismatch(f"{what} on this machine.")
        self.agreement(made.local, made.local[np.newaxis])  # compile the second stage now, not in the first query
        if self.screened > self.candidates:
            self.promise(made.local, made.local[np.newaxis])


def _cosine(found: NDArray[Any], golden: NDArray[Any]) -> float:
    """The cosine of two arrays of one shape, flattened; 1 if both are empty, 0 if the shapes differ."""
    if found.shape != golden.shape:
        return 0.0
    a, b = found.astype(np.float64).ravel(), golden.astype(np.float64).ravel()
    return float(a @ b / max(1e-12, float(np.linalg.norm(a) * np.linalg.norm(b)))) if a.size else 1.0


def encoder_identity(
    name: str,
    definition: EncoderDefinition,
    vocabulary: Vocabulary,
    whitening: Whitening | None = None,
    cells: Mapping[str, Projection] | None = None,
) -> str:
    """``<name>@<sha256>`` over everything that can change a descriptor, tensors by content."""
    centers = arrays_digest({"centers": vocabulary.centers})
    fields: dict[str, Any] = {
        "features": vocabulary.origin,
        "vocabulary": centers,
        "definition": content_of(definition),
    }
    if whitening is not None:
        fields["whitening"] = arrays_digest(whitening.arrays())
    if cells:
        fields["cells"] = arrays_digest(projection_arrays(cells))
    return f"{name}@{json_digest(fields)}"


def canary_frame() -> Pixels:
    """A picture of stripes, blocks and a ramp, uint8 [480, 640, 3], computed with integers, so the same everywhere."""
    y, x = np.mgrid[0:480, 0:640]
    blue = (x * 3 + y) % 256
    green = ((x // 40 + y // 30) % 2) * 120 + (x * y // 97) % 90
    red = np.where((x - 320) ** 2 + (y - 240) ** 2 < 150**2, 220, (y * 2) % 140)
    return np.stack([blue, green, red], axis=2).astype(np.uint8)

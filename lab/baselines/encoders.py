"""This project's encoders, M-Region-VLAD and Region-VLAD among them, as systems of the comparison."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from core.frames.preprocessing import Pixels
from core.recognition.stages import score_matrix
from lab.baselines.system import About, Array, Description, InnerProducts, ReferenceIndex, stack, system_identity

if TYPE_CHECKING:
    from core.method.catalogue import EncoderSummary
    from core.method.encoder import Encoder

Box = tuple[float, float, float, float]
"""A region of a frame: left, top, right, bottom, as fractions of its width and height."""

_CAMAL = (
    "Khaliq, Ehsan, Milford, McDonald-Maier: CAMAL: Context-Aware Multi-layer Attention framework "
    "for Lightweight Environment Invariant Visual Place Recognition, 2019"
)
LOCAL_AGREEMENT = " with local agreement"
"""Names the second stage in titles."""

TITLES = {
    "m-region-vlad": f"M-Region-VLAD{LOCAL_AGREEMENT}",
    "m-region-vlad-thesis": "M-Region-VLAD as in the thesis",
    "region-vlad": "Region-VLAD as in the thesis",
}
PAPERS = {
    "m-region-vlad": _CAMAL,
    "m-region-vlad-thesis": _CAMAL,
    "region-vlad": "Khaliq, Ehsan, Chen, Milford, McDonald-Maier: A Holistic Visual Place Recognition Approach Using "
    "Lightweight CNNs for Significant ViewPoint and Appearance Changes, IEEE Transactions on Robotics 36(2), 2020",
}


def about_encoder(summary: EncoderSummary) -> About:
    """An installed encoder as a system; for a damaged one, the fault in place of the paper."""
    definition = summary.definition
    if definition is None:
        return About(summary.name, summary.name, summary.damaged or "", {})
    return About(
        name=summary.name,
        title=TITLES.get(summary.name, summary.name),
        paper=PAPERS.get(summary.name, "an encoder installed on this machine"),
        configuration={"network": summary.network, **constants(definition.model_dump())},
    )


def constants(fields: Mapping[str, Any], within: str = "") -> dict[str, Any]:
    """The fields of a definition without those that are None; fields of its parts are called ``part.field``."""
    flat: dict[str, Any] = {}
    for name, value in fields.items():
        if isinstance(value, Mapping):
            flat |= constants(value, f"{within}{name}.")
        elif value is not None:
            flat[within + name] = value
    return flat


class EncoderSystem:
    """One vector a frame, scored by inner products, and local descriptors if the encoder has a second stage."""

    sequential = False

    def __init__(self, encoder: Encoder, about: About) -> None:
        self.encoder, self.about = encoder, about
        own = about.name == encoder.name
        self.identity = encoder.identity if own else system_identity(about, encoder=encoder.identity)

    def describe(self, pixels: Pixels) -> Description:
        encoding = self.encoder.encode(pixels)
        arrays: dict[str, NDArray[Any]] = {"descriptor": encoding.descriptor}
        if self.encoder.candidates:
            arrays["local"] = encoding.local
        return Description(arrays, encoding.milliseconds)

    def region_boxes(self, pixels: Pixels) -> list[Box]:
        """The boxes of a frame's regions, highest energy first; none for a blank frame.

        A frame is resized whole, so the cells of a layer are spread evenly over it; receptive fields are wider.
        """
        by_layer = self.encoder.layer_grids()
        grids = np.array([by_layer[layer] for layer in self.encoder.definition.layers], np.float64)  # rows, columns
        regions = self.encoder.encode(pixels).regions
        cells = grids[regions.layers]  # T x 2
        tops_lefts, bottoms_rights = regions.boxes[:, :2] / cells, regions.boxes[:, 2:] / cells
        boxes = np.concatenate([tops_lefts[:, ::-1], bottoms_rights[:, ::-1]], axis=1)[
            np.argsort(-regions.energies, kind="stable")
        ]
        return [(left, top, right, bottom) for left, top, right, bottom in boxes.tolist()]

    def index(self, references: Sequence[Description]) -> ReferenceIndex:
        vectors = stack(references)
        if not self.encoder.candidates:
            return InnerProducts(vectors, finish=self.encoder.scores_from_inner_products)
        return TwoStages(InnerProducts(vectors), local_of(references), self.encoder)


@dataclass(frozen=True)
class TwoStages:
    """An index that scores as the service does: by inner product, then cell by cell; local: int8 [R, C, L]."""

    first: InnerProducts
    local: NDArray[np.int8]
    encoder: Encoder

    def score(self, queries: Sequence[Description]) -> Array:
        return score_matrix(self.encoder, self.first.score(queries), local_of(queries), self.local)


def local_of(descriptions: Sequence[Description]) -> NDArray[np.int8]:
    """The local descriptors of n descriptions, int8 [n, C, L]."""
    return np.stack([description.arrays["local"] for description in descriptions]).astype(np.int8, copy=False)

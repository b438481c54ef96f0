"""Cross-Region: landmarks found on a late layer, described by the layer before it, matched mutually.

Chen, Maffra, Sa, Chli: Only Look Once, Mining Distinctive Landmarks from ConvNet for Visual Place
Recognition, IROS 2017.  A landmark is a group of connected cells of one late map whose activation is not
zero, whatever its value; the N of highest mean are retained.  Cross-Region-BoW matches the landmarks of two frames
and weighs each pair by how rare its words are; Cross-Region-VLAD is the thesis's variant that
aggregates them as this project does (section 3.4.1).  The thesis matches the regions of R-MAC in the same way.
"""

from __future__ import annotations

import time
from abc import ABC, abstractmethod
from collections.abc import Iterable, Sequence
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from core.errors import InvalidModel
from core.frames.preprocessing import Pixels
from lab.baselines.pooling import (
    EARLY,
    GAMMA,
    LATE,
    RMAC_CONSTANTS,
    RMAC_PAPER,
    MapsSystem,
    read_maps,
    regional_vectors,
)
from lab.baselines.system import (
    About,
    Array,
    Constants,
    Description,
    InnerProducts,
    ReferenceIndex,
    Resources,
    arrays_digest,
    stack,
    system_identity,
    unit,
)
from lab.baselines.visual_words import nearest_words, train_words

if TYPE_CHECKING:
    from core.method.features import FeatureExtractor

N = 200
VLAD_WORDS = 128
PAPER = (
    "Chen, Maffra, Sa, Chli: Only Look Once, Mining Distinctive Landmarks from ConvNet for Visual Place "
    "Recognition, IROS 2017"
)
LAYERS: Constants = {"N": N, "regions": LATE, "features": EARLY}
VLAD = About("cross-region-vlad", "Cross-Region-VLAD", PAPER, {**LAYERS, "V": VLAD_WORDS, "gamma": GAMMA})
BOW_10K = About("cross-region-bow", "Cross-Region-BoW, 10k words", PAPER, {**LAYERS, "V": 10_000})
BOW_2_6K = About("cross-region-bow-2.6k", "Cross-Region-BoW, 2.6k words", PAPER, {**LAYERS, "V": 2_600})
RMAC_MUTUAL = About("rmac-mutual", "RMAC, mutual regions", RMAC_PAPER, RMAC_CONSTANTS)

BLOCK = 64
"""References scored at a time, so that memory stays bounded."""

Boxes = list[tuple[slice, slice]]


# Landmarks


def find_landmarks(late: Array, count: int) -> tuple[Boxes, NDArray[np.int64]]:
    """The ``count`` landmarks of highest mean activation, ties by map and then by first cell.

    Args:
        late: float32 [X, Y, L], rectified.

    Returns:
        Bounding boxes as rows and columns, and the map of each, int64 [T], T <= count.
    """
    from scipy import ndimage

    maps = late.transpose(2, 0, 1)  # L x X x Y
    structure = np.zeros((3, 3, 3), np.bool_)
    structure[1] = True  # eight neighbours in a map, none in another
    labels, found = ndimage.label(maps > 0, structure)
    if not found:
        return [], np.empty(0, np.int64)
    sizes = np.bincount(labels.ravel())[1:]
    energies = np.bincount(labels.ravel(), weights=maps.ravel())[1:] / sizes
    strongest = np.argsort(-energies, kind="stable")[:count]
    boxes = ndimage.find_objects(labels)
    chosen = [boxes[index] for index in strongest]
    return [(rows, columns) for _, rows, columns in chosen], np.array([planes.start for planes, _, _ in chosen])


def cross_features(early: Array, late: Array) -> Array:
    """Of each landmark the early descriptors in its box, weighted by its late map there, unit length.

    Args:
        early: float32 [X, Y, K].
        late: float32 [X, Y, L], of the same grid.

    Returns:
        float32 [T, K], T <= N.

    Raises:
        InvalidModel: the two layers have different grids.
    """
    if early.shape[:2] != late.shape[:2]:
        raise InvalidModel(f"Cross-Region needs two layers of one grid, not {early.shape[:2]} and {late.shape[:2]}.")
    boxes, channels = find_landmarks(late, N)
    features = np.zeros((len(boxes), early.shape[2]), np.float32)
    for feature, (rows, columns), channel in zip(features, boxes, channels, strict=True):
        weights = late[rows, columns, channel].reshape(-1)
        feature[:] = weights @ early[rows, columns].reshape(len(weights), -1)
    return unit(features)


# Mutual regions


def mutual_scores(query: Array, query_weights: Array, references: Array, reference_weights: Array) -> Array:
    """Σ over mutual nearest neighbours of cosine x weight x weight.

    A region of the query and one of a reference are mutual if each is the other's most alike; of
    equally alike ones the first.

    Args:
        query: float32 [T, K], regions of unit length; rows of zeros are no regions.
        query_weights: float32 [T].
        references: float32 [R, U, K], likewise.
        reference_weights: float32 [R, U].

    Returns:
        float32 [R].
    """
    count, regions, width = references.shape
    cosines = (references.reshape(-1, width) @ query.T).reshape(count, regions, len(query))  # R x U x T
    chosen = cosines.argmax(axis=2)  # R x U: by each reference region
    choosing = cosines.argmax(axis=1)  # R x T: by each query region
    mutual = np.take_along_axis(choosing, chosen, axis=1) == np.arange(regions)
    best = np.take_along_axis(cosines, chosen[..., None], axis=2)[..., 0]
    weighted = best * reference_weights * query_weights[chosen]
    return np.where(mutual, weighted, np.float32(0)).sum(axis=1, dtype=np.float32)


class MutualRegions:
    """An index of descriptions with ``regions`` [T, K] and ``weights`` [T], T the same for all.

    Args:
        scale: the factor by which the sums are multiplied.
    """

    def __init__(self, references: Sequence[Description], scale: float) -> None:
        self._regions, self._weights = stack(references, "regions"), stack(references, "weights")
        self._scale = np.float32(scale)

    def score(self, queries: Sequence[Description]) -> Array:
        scores = np.empty((len(queries), len(self._regions)), np.float32)
        for row, query in zip(scores, queries, strict=True):
            regions, weights = stack([query], "regions")[0], stack([query], "weights")[0]
            for start in range(0, len(row), BLOCK):
                block = slice(start, start + BLOCK)
                row[block] = self._scale * mutual_scores(regions, weights, self._regions[block], self._weights[block])
        return scores


# The systems


class CrossRegion(ABC):
    """The base of both encodings: the landmarks of a frame, and the words learned from those of many frames."""

    sequential = False

    def __init__(self, about: About, extractor: FeatureExtractor) -> None:
        self.about, self.extractor, self.words = about, extractor, int(str(about.configuration["V"]))
        self.centers = np.empty((0, 0), np.float32)  # V x K, once trained
        self.identity = system_identity(about, features=extractor.origin)

    def learned(self) -> dict[str, NDArray[np.float32]]:
        """All arrays that training makes."""
        return {"centers": self.centers}

    @abstractmethod
    def learn(self, features: Sequence[Array], seed: int) -> None:
        """Learn what the encoding needs, from the features of each training frame."""

    def train(self, frames: Iterable[Pixels], seed: int) -> None:
        """Learn the words from frames of other places.

        Raises:
            InvalidModel: there are too few landmarks to make words of.
        """
        self.learn([cross_features(*read_maps(self.extractor, pixels)[0]) for pixels in frames], seed)
        training = arrays_digest(**self.learned())
        self.identity = system_identity(self.about, features=self.extractor.origin, training=training)

    def landmarks(self, pixels: Pixels) -> tuple[Array, float, float]:
        """Features float32 [T, K] of a frame, and the milliseconds of its forward pass and its landmarks.

        Raises:
            InvalidModel: there are no words yet.
        """
        if not len(self.centers):
            raise InvalidModel(f"{self.about.name} has no words yet; train it on frames first.")
        maps, forward = read_maps(self.extractor, pixels)
        began = time.perf_counter()
        features = cross_features(*maps)
        return features, forward, 1e3 * (time.perf_counter() - began)


class CrossRegionBow(CrossRegion):
    """Scores by mutual landmarks, each pair's cosine times the inverse document frequencies of both words."""

    def __init__(self, about: About, extractor: FeatureExtractor) -> None:
        super().__init__(about, extractor)
        self.rarity = np.empty(0, np.float32)

    def learned(self) -> dict[str, NDArray[np.float32]]:
        return {**super().learned(), "rarity": self.rarity}

    def learn(self, features: Sequence[Array], seed: int) -> None:
        self.centers = train_words(features, self.words, seed)
        self.rarity = rarity([nearest_words(frame, self.centers) for frame in features], len(self.centers))

    def describe(self, pixels: Pixels) -> Description:
        features, forward, found = self.landmarks(pixels)
        began = time.perf_counter()
        regions, weights = np.zeros((N, self.centers.shape[1]), np.float32), np.zeros(N, np.float32)
        regions[: len(features)] = features
        weights[: len(features)] = self.rarity[nearest_words(features, self.centers)]
        times = {"forward": forward, "regions": found, "words": 1e3 * (time.perf_counter() - began)}
        return Description({"regions": regions, "weights": weights}, times)

    def index(self, references: Sequence[Description]) -> ReferenceIndex:
        return MutualRegions(references, scale=1 / N)


def rarity(frames: Sequence[NDArray[np.int64]], words: int) -> NDArray[np.float32]:
    """log10(frames / frames with the word) of each word; one that no frame has counts as if one had.

    Args:
        frames: of each training frame its words.

    Returns:
        float32 [V].
    """
    seen = np.zeros(words, np.int64)
    for found in frames:
        seen[np.unique(found)] += 1
    return np.log10(len(frames) / np.maximum(seen, 1)).astype(np.float32)


class CrossRegionVlad(CrossRegion):
    """The landmarks' VLAD, intra-normalized, scored as this project's own."""

    def learn(self, features: Sequence[Array], seed: int) -> None:
        from core.method.vocabulary import pool_features, train_vocabulary

        # Few words, so as well as an encoder's own.
        pooled = pool_features(features, seed, per_frame=N)
        self.centers = train_vocabulary(pooled, self.words, seed, self.extractor.origin).centers

    def describe(self, pixels: Pixels) -> Description:
        from core.method.vlad import aggregate

        features, forward, found = self.landmarks(pixels)
        began = time.perf_counter()
        vector = aggregate(features, self.centers, GAMMA, "intra")
        times = {"forward": forward, "regions": found, "vlad": 1e3 * (time.perf_counter() - began)}
        return Description({"descriptor": vector}, times)

    def index(self, references: Sequence[Description]) -> ReferenceIndex:
        words = len(self.centers)
        return InnerProducts(stack(references), finish=lambda products: products / np.float32(words))


class MutualRmac(MapsSystem):
    """The regions of R-MAC matched one with another: the score is the mean of the cosines of mutual ones."""

    def keep(self, maps: list[Array]) -> dict[str, Array]:
        vectors = regional_vectors(*maps)
        return {"regions": vectors, "weights": np.ones(len(vectors), np.float32)}

    def index(self, references: Sequence[Description]) -> ReferenceIndex:
        return MutualRegions(references, scale=1 / len(references[0].arrays["weights"]))


def build_vlad(about: About, resources: Resources) -> CrossRegionVlad:
    return CrossRegionVlad(about, resources.extractor(EARLY, LATE))


def build_bow(about: About, resources: Resources) -> CrossRegionBow:
    return CrossRegionBow(about, resources.extractor(EARLY, LATE))


def build_rmac_mutual(about: About, resources: Resources) -> MutualRmac:
    return MutualRmac(about, resources.extractor(LATE))

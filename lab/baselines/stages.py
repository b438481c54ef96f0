"""An encoder of two stages as the service asks it, and with fewer stages, so that one sees what each adds.

``ENCODER`` has three stages, as every map of the service: of the best places of two stages, those that share more of
the query's keypoints move up (``core.geometry``), by default where two stages leave doubt.  ``ENCODER.verified`` always
verifies them, ``ENCODER.two-stages`` never, and ``ENCODER.first-stage`` does not compare cells of frames, either.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import partial

import numpy as np
from numpy.typing import NDArray

from core.frames.preprocessing import Pixels
from core.geometry import detection, keypoints, matching
from core.geometry.detection import find_keypoints
from core.geometry.keypoints import Keypoints, keypoints_of
from core.geometry.pairs import Pairs
from core.geometry.verification import verify
from core.judgement.geometry import AGREEMENT, INLIERS, SIMILARITY
from core.judgement.verdict import Calibration, Judgement, judge
from core.method.encoder import Encoder
from core.method.features import FeatureExtractor
from core.method.vocabulary import Vocabulary
from core.networks.backbone import OwnPass
from core.networks.network import ShallowNetwork
from core.networks.xfeat import load_xfeat
from core.recognition.question import Verifier, Verify
from core.recognition.stages import Candidates, Positions, likeness_of_first, traverse_candidates, traverse_neighborhood
from core.recognition.verification import CANDIDATES, verify_candidates
from lab.baselines.encoders import LOCAL_AGREEMENT, EncoderSystem, local_of
from lab.baselines.system import About, Array, Description, InnerProducts, ReferenceIndex, stack

FIRST_STAGE, TWO_STAGES, VERIFIED = ".first-stage", ".two-stages", ".verified"

NOTHING = Calibration(source="encoder-default", threshold=0, margin=0, background_mean=0, background_deviation=1)
"""The calibration of an encoder with its second stage says nothing of its first alone."""


def about_first_stage(about: About) -> About:
    """The first stage of the two-stage encoder that ``about`` describes."""
    configuration = {name: value for name, value in about.configuration.items() if not name.startswith("agreement.")}
    title = f"{about.title.removesuffix(LOCAL_AGREEMENT)}, first stage alone"
    return replace(about, name=about.name + FIRST_STAGE, title=title, configuration=configuration)


def first_stage(encoder: Encoder, network: ShallowNetwork | OwnPass) -> Encoder:
    """A two-stage encoder without its second stage: the same vectors, and scores J / V (equation 4.13).

    Args:
        network: the encoder's, returning the layers whose regions it fuses.
    """
    definition = encoder.definition.model_copy(update={"agreement": None})
    extractor = FeatureExtractor(network, definition, encoder.extractor.projections)
    vocabulary = Vocabulary(encoder.centers, extractor.origin)
    return Encoder(encoder.name + FIRST_STAGE, extractor, definition, vocabulary, NOTHING, whitening=encoder.whitening)


def about_two_stages(about: About) -> About:
    """A two-stage encoder by itself."""
    return replace(about, name=about.name + TWO_STAGES)


def about_verified(about: About, verify: Verify = "always") -> About:
    """A two-stage encoder and geometric verification, ``auto`` or ``always``; the latter has a name of its own."""
    constants = {
        "verify": verify,
        "keypoints": keypoints.MOST,
        "area": detection.AREA,
        "least_cosine": matching.LEAST_COSINE,
        "candidates": CANDIDATES,
        "similarity": SIMILARITY,
        "agreement": AGREEMENT,
        "inliers": INLIERS,
    }
    return replace(
        about,
        title=f"{about.title} and verification" + (" where these leave doubt" if verify == "auto" else ""),
        paper=f"{about.paper}; keypoints by Potje, Cadar, Araujo, Martins, Nascimento: XFeat: Accelerated Features for "
        "Lightweight Image Matching, CVPR 2024",
        configuration={**about.configuration, **{f"verification.{name}": value for name, value in constants.items()}},
    )


class VerifiedSystem(EncoderSystem):
    """An encoder whose best places are verified; a frame has the encoder's arrays and its keypoints' record, uint8.

    Args:
        about: under the encoder's own name it has the encoder's identity, which maps are bound to.
        verify: when they are.
    """

    def __init__(self, encoder: Encoder, about: About, verify: Verify) -> None:
        super().__init__(encoder, about)
        self._verify, self._network = verify, load_xfeat()

    def describe(self, pixels: Pixels) -> Description:
        described, began = super().describe(pixels), time.perf_counter()
        record = np.frombuffer(find_keypoints(self._network, pixels).record(), np.uint8)
        spent = 1e3 * (time.perf_counter() - began)
        return Description({**described.arrays, "keypoints": record}, {**described.milliseconds, "keypoints": spent})

    def index(self, references: Sequence[Description]) -> ReferenceIndex:
        return ThreeStages(self.encoder, self._verify, references)


@dataclass(frozen=True)
class ThreeStages:
    """The references as the places of one map, which is queried as by the service.

    The score of a place is the value by which the service orders it (``core.judgement.geometry``).
    """

    encoder: Encoder
    verify: Verify
    references: Sequence[Description]
    vectors: Array = field(init=False)
    local: NDArray[np.int8] = field(init=False)

    def __post_init__(self) -> None:
        object.__setattr__(self, "vectors", stack(self.references))  # float32 [R, D]
        object.__setattr__(self, "local", local_of(self.references))  # int8 [R, C, L]

    def score(self, queries: Sequence[Description]) -> Array:
        pairs = Pairs([keypoints_in(one) for one in queries], [keypoints_in(one) for one in self.references])
        products, cells = InnerProducts(self.vectors).score(queries), local_of(queries)
        return scores_of_three_stages(self.encoder, products, cells, self.vectors, self.local, pairs, self.verify)


def scores_of_three_stages(
    encoder: Encoder,
    products: Array,
    cells: NDArray[np.int8],
    vectors: Array,
    local: NDArray[np.int8],
    pairs: Pairs,
    verify: Verify,
) -> Array:
    """The values by which the service orders the places of a traverse for Q queries, float32 [Q, R].

    Args:
        products: float32 [Q, R], inner products of the descriptors.
        cells: int8 [Q, C, L], the queries' local descriptors.
        vectors, local: float32 [R, D] and int8 [R, C, L], of the references.
        pairs: of the keypoints of both.
    """

    def judged(candidates: Candidates) -> Judgement:
        def likeness(positions: Positions) -> Array:
            rows = candidates.rows[np.concatenate([[0], positions])]
            return likeness_of_first(encoder, vectors[rows], local[rows])

        return judge(
            candidates.ordered,
            candidates.whereabouts,
            encoder.calibration,
            traverse_neighborhood(),
            candidates.examined,
            likeness,
            candidates.geometry,
        )

    scores = np.empty_like(products)
    for number, candidates in enumerate(traverse_candidates(encoder, products, cells, local)):

        def agreements(rows: Sequence[int], number: int = number) -> Array:
            return encoder.agreement(cells[number], local[list(rows)])

        verifier = Verifier(verify, partial(pairs.queries.__getitem__, number))
        comparison = pairs.comparison(number, agreements)
        found, _, _ = verify_candidates(candidates, judged, verifier, encoder.calibration, comparison)
        scores[number, found.rows] = found.values
    return scores


def verified_gains(query: Keypoints, places: Sequence[Keypoints]) -> NDArray[np.float32]:
    """The gain of the scores of k places by the share of their keypoints that are inliers, float32 [k]."""
    return INLIERS * np.array([one.inlier_share for one in verify(query, places)], np.float32)


def keypoints_in(description: Description) -> Keypoints:
    """The keypoints of a described frame."""
    return keypoints_of(description.arrays["keypoints"].tobytes())

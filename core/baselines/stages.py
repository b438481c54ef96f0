"""An encoder with fewer or more stages than its own, so that one sees what each stage adds.

``ENCODER.first-stage`` is the encoder without the second stage, in which cells of frames are compared.
``ENCODER.verified`` adds a third, geometric verification (``core.geometry``): of the best places of both stages, those
that share more of the query's keypoints move up.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from core.baselines.encoders import LOCAL_AGREEMENT, EncoderSystem
from core.baselines.system import About, Array, Description, Index, system_identity
from core.frames.preprocessing import Pixels
from core.geometry import detection, keypoints, verification
from core.geometry.detection import find_keypoints
from core.geometry.keypoints import Keypoints, keypoints_of
from core.geometry.verification import verify
from core.judgement.geometry import WEIGHT
from core.judgement.verdict import Calibration
from core.method.encoder import Encoder
from core.method.features import FeatureExtractor
from core.method.vocabulary import Vocabulary
from core.networks.backbone import Backbone
from core.networks.xfeat import load_xfeat
from core.recognition.verification import CANDIDATES

FIRST_STAGE, VERIFIED = ".first-stage", ".verified"

NOTHING = Calibration(source="encoder-default", threshold=0, margin=0, background_mean=0, background_deviation=1)
"""The calibration of an encoder with its second stage says nothing of its first alone."""


def about_first_stage(about: About) -> About:
    """The first stage of a two-stage encoder, of which ``about`` tells."""
    kept = {name: value for name, value in about.configuration.items() if not name.startswith("agreement.")}
    title = f"{about.title.removesuffix(LOCAL_AGREEMENT)}, first stage alone"
    return replace(about, name=about.name + FIRST_STAGE, title=title, configuration=kept)


def first_stage(encoder: Encoder, network: Backbone) -> Encoder:
    """A two-stage encoder without its second stage: the same vectors, and scores J / V (equation 4.13).

    Args:
        network: the encoder's, returning the layers whose regions it fuses.
    """
    definition = encoder.definition.model_copy(update={"agreement": None})
    extractor = FeatureExtractor(network, definition, encoder.extractor.projections)
    vocabulary = Vocabulary(encoder.centers, extractor.origin)
    return Encoder(encoder.name + FIRST_STAGE, extractor, definition, vocabulary, NOTHING, whitening=encoder.whitening)


def about_verified(about: About) -> About:
    """A two-stage encoder and geometric verification."""
    constants = {
        "keypoints": keypoints.MOST,
        "longest_side": detection.LONGEST_SIDE,
        "least_cosine": verification.LEAST_COSINE,
        "candidates": CANDIDATES,
        "weight": WEIGHT,
    }
    return replace(
        about,
        name=about.name + VERIFIED,
        title=f"{about.title} and verification",
        paper=f"{about.paper}; keypoints by Potje, Cadar, Araujo, Martins, Nascimento: XFeat: Accelerated Features for "
        "Lightweight Image Matching, CVPR 2024",
        configuration={**about.configuration, **{f"verification.{name}": value for name, value in constants.items()}},
    )


class VerifiedSystem:
    """An encoder whose best places are verified; a frame has the encoder's arrays and its keypoints' record, uint8."""

    sequential = False

    def __init__(self, system: EncoderSystem) -> None:
        self._system, self._network = system, load_xfeat()
        self.about = about_verified(system.about)
        self.identity = system_identity(self.about, encoder=system.identity)

    def describe(self, pixels: Pixels) -> Description:
        described, began = self._system.describe(pixels), time.perf_counter()
        record = np.frombuffer(find_keypoints(self._network, pixels).record(), np.uint8)
        spent = 1e3 * (time.perf_counter() - began)
        return Description({**described.arrays, "keypoints": record}, {**described.milliseconds, "keypoints": spent})

    def index(self, references: Sequence[Description]) -> Index:
        return ThreeStages(self._system.index(references), [keypoints_in(reference) for reference in references])


@dataclass(frozen=True)
class ThreeStages:
    """An index whose best places are verified; ``places`` are the keypoints of the R references."""

    stages: Index
    places: list[Keypoints]

    def score(self, queries: Sequence[Description]) -> Array:
        scores = self.stages.score(queries)
        for row, query in zip(scores, queries, strict=True):
            best = np.argsort(-row, kind="stable")[:CANDIDATES]
            row[best] += verified_gains(keypoints_in(query), [self.places[place] for place in best])
        return scores


def verified_gains(query: Keypoints, places: Sequence[Keypoints]) -> NDArray[np.float32]:
    """What verification adds to the scores of k places, float32 [k]: ``WEIGHT`` times the share of the keypoints that
    are inliers, of the picture that has fewer."""
    return WEIGHT * np.array([one.inlier_share for one in verify(query, places)], np.float32)


def keypoints_in(description: Description) -> Keypoints:
    """The keypoints of a described frame."""
    return keypoints_of(description.arrays["keypoints"].tobytes())

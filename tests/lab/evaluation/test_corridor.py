"""The packaged default on real frames: places that the map lost are not recognized, others still are."""

from __future__ import annotations

import csv
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from core.frames.images import decode
from core.frames.traverses import find_images
from core.judgement.alignment import of_matrix, shared_stretches
from core.judgement.curves import auc_pr
from core.judgement.verdict import judge
from core.method.catalogue import DEFAULT_ENCODER, EncoderCatalogue
from core.method.encoder import Encoder, Encoding
from core.places import Neighborhood, Whereabouts
from core.recognition.stages import score_matrix

CORRIDOR = Path(__file__).parents[4] / "shared/datasets/eval/corridor"
MAP_DEFAULTS = Neighborhood(radius=5.0, frames=3)

pytestmark = pytest.mark.skipif(not CORRIDOR.is_dir(), reason="the corridor images are not on this machine")


@pytest.fixture(scope="module")
def encoder() -> Encoder:
    return EncoderCatalogue().get(DEFAULT_ENCODER)


def encode(encoder: Encoder, folder: Path) -> list[Encoding]:
    frames = [decode(path.read_bytes()) for path in find_images(folder)]
    batches = [frames[start : start + 8] for start in range(0, len(frames), 8)]
    return [encoding for batch in batches for encoding in encoder.encode_batch(batch)]


@pytest.fixture(scope="module")
def queries(encoder: Encoder) -> list[Encoding]:
    return encode(encoder, CORRIDOR / "query")


@pytest.fixture(scope="module")
def references(encoder: Encoder) -> list[Encoding]:
    return encode(encoder, CORRIDOR / "ref")


@pytest.fixture(scope="module")
def truth() -> NDArray[np.bool_]:
    with (CORRIDOR / "ground_truth.csv").open() as file:
        pairs = [(int(row["query"]), int(row["reference"])) for row in csv.DictReader(file)]
    true = np.zeros((111, 111), np.bool_)
    true[tuple(np.transpose(pairs))] = True
    return true


def answers(encoder: Encoder, queries: list[Encoding], references: list[Encoding]) -> NDArray[np.float32]:
    """The scores of both stages, Q x R."""
    products = np.stack([one.descriptor for one in queries]) @ np.stack([one.descriptor for one in references]).T
    asked, known = (np.stack([one.local for one in side]) for side in (queries, references))
    return score_matrix(encoder, products, asked, known)


@pytest.mark.thorough
def test_the_default_is_ahead_of_every_published_technique(
    encoder: Encoder, queries: list[Encoding], references: list[Encoding], truth: NDArray[np.bool_]
) -> None:
    scores = answers(encoder, queries, references)
    best = scores.argmax(axis=1)
    right = truth[np.arange(len(best)), best]
    assert auc_pr(scores.max(axis=1), right) >= 0.96  # AMOSNet 0.954
    assert right.mean() >= 0.90  # HybridNet 0.901


@pytest.fixture(scope="module")
def pairs(
    encoder: Encoder, queries: list[Encoding], references: list[Encoding]
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """The scores of both stages for every query and reference, and for every two references."""
    known = np.stack([one.descriptor for one in references])
    cells = np.stack([one.local for one in references])

    def scored(side: list[Encoding]) -> NDArray[np.float32]:
        first = encoder.scores_from_inner_products(np.stack([one.descriptor for one in side]) @ known.T)
        return np.asarray(first + np.stack([encoder.agreement(one.local, cells) for one in side]), np.float32)

    return scored(queries), scored(references)


@pytest.mark.thorough
@pytest.mark.parametrize("size", [1, 2, 5, 10, 30])
def test_strangers_are_not_recognized_in_maps_of_any_size(
    encoder: Encoder, pairs: tuple[NDArray[np.float32], NDArray[np.float32]], truth: NDArray[np.bool_], size: int
) -> None:
    """Every fifth stretch of that length; so few are all examined by the second stage."""
    strangers, known = [], []
    for start in range(0, len(truth) - size + 1, 5):
        held = np.arange(start, start + size)
        around = slice(max(0, start - 8), start + size + 8)
        for query, true in enumerate(truth):
            order = held[np.argsort(-pairs[0][query, held], kind="stable")]
            places = Whereabouts.along_sequence(order)
            judgement = judge(pairs[0][query, order], places, encoder.calibration, MAP_DEFAULTS, encoder.candidates)
            recognized = judgement.verdict == "recognized"
            if true[held].any():
                known.append(recognized and bool(true[order[0]]))
            elif not true[around].any():
                strangers.append(recognized)
    assert np.mean(strangers) <= 0.05
    assert np.mean(known) >= 0.3


def test_rivals_of_a_second_sequence_are_named_and_explain_the_verdict(
    encoder: Encoder, pairs: tuple[NDArray[np.float32], NDArray[np.float32]], truth: NDArray[np.bool_]
) -> None:
    """Every place is enrolled in two sequences without poses: no answer can be recognized, few may be unknown."""
    held = np.tile(np.arange(30), 2)
    sequence = np.repeat([0, 1], 30).astype(np.int32)
    found = []
    for query in np.flatnonzero(truth[:, :30].any(axis=1)).tolist():
        order = np.argsort(-pairs[0][query, held], kind="stable")
        rows = held[order]
        places = Whereabouts(np.zeros(60, np.int8), np.zeros((60, 3)), sequence[order], rows)

        def likeness(at: NDArray[np.int64], rows: NDArray[np.int64] = rows) -> NDArray[np.float32]:
            return pairs[1][rows[0], rows[at]]

        judgement = judge(pairs[0][query, rows], places, encoder.calibration, MAP_DEFAULTS, 60, likeness)
        found.append(judgement.verdict)
        if judgement.verdict == "ambiguous":
            assert 1 in judgement.rivals[0].positions and judgement.rivals[0].same_place
    assert found.count("recognized") == 0
    assert found.count("ambiguous") >= 0.5 * len(found)


def test_sequence_matching_pairs_the_two_traverses(
    pairs: tuple[NDArray[np.float32], NDArray[np.float32]], truth: NDArray[np.bool_]
) -> None:
    (found,) = shared_stretches(of_matrix(pairs[0]), *pairs[0].shape)
    assert len(found.first) >= 0.95 * len(truth)
    assert truth[found.first, found.second].mean() >= 0.95
    apart = pairs[0][:40, 60:]
    assert shared_stretches(of_matrix(apart), *apart.shape) == [], "neither part shows a place of the other"


def test_verdicts_with_the_second_half_of_the_references_left_out(
    encoder: Encoder, queries: list[Encoding], references: list[Encoding], truth: NDArray[np.bool_]
) -> None:
    retained = len(references) // 2
    scores = answers(encoder, queries, references[:retained])
    known = [bool(row.any()) for row in truth[:, :retained]]
    refused, found = 0, 0
    for query, row in enumerate(scores):
        order = np.argsort(-row, kind="stable")
        frames = Whereabouts(
            np.zeros(retained, np.int8), np.zeros((retained, 3)), np.zeros(retained, np.int32), order.astype(np.int64)
        )
        judgement = judge(row[order], frames, encoder.calibration, MAP_DEFAULTS, encoder.candidates)
        recognized = judgement.verdict == "recognized"
        refused += int(not known[query] and not recognized)
        found += int(known[query] and recognized and truth[query, order[0]])

    shares = refused / known.count(False), found / known.count(True)
    assert shares[0] >= 0.6, shares
    assert shares[1] >= 0.25, shares

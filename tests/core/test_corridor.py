"""The packaged default on real frames: places that the map lost are not recognized, others still are."""

from __future__ import annotations

import csv
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from core.encoders import DEFAULT_ENCODER, EncoderCatalogue
from core.images import decode
from core.traverses import find_images
from core.verdict import Neighborhood, Whereabouts, judge

CORRIDOR = Path(__file__).parents[3] / "shared/datasets/eval/corridor"
MAP_DEFAULTS = Neighborhood(radius=5.0, frames=3)

pytestmark = pytest.mark.skipif(not CORRIDOR.is_dir(), reason="the corridor images are not on this machine")


def descriptors(folder: Path) -> NDArray[np.float32]:
    encoder = EncoderCatalogue().get(DEFAULT_ENCODER)
    frames = [decode(path.read_bytes()) for path in find_images(folder)]
    batches = [frames[start : start + 8] for start in range(0, len(frames), 8)]
    return np.stack([encoding.descriptor for batch in batches for encoding in encoder.encode_batch(batch)])


def test_verdicts_with_the_second_half_of_the_references_left_out() -> None:
    encoder = EncoderCatalogue().get(DEFAULT_ENCODER)
    queries, references = descriptors(CORRIDOR / "query"), descriptors(CORRIDOR / "ref")
    kept = len(references) // 2
    with (CORRIDOR / "ground_truth.csv").open() as file:
        pairs = [(int(row["query"]), int(row["reference"])) for row in csv.DictReader(file)]
    truth = np.zeros((len(queries), len(references)), np.bool_)
    truth[tuple(np.transpose(pairs))] = True

    scores = encoder.scores_from_inner_products(queries @ references[:kept].T)
    known = [bool(row.any()) for row in truth[:, :kept]]
    refused, found = 0, 0
    for query, row in enumerate(scores):
        order = np.argsort(-row, kind="stable")
        frames = Whereabouts(
            np.zeros(kept, np.int8), np.zeros((kept, 3)), np.zeros(kept, np.int32), order.astype(np.int64)
        )
        judgement = judge(row[order], frames, encoder.calibration, MAP_DEFAULTS)
        recognized = judgement.verdict == "recognized"
        refused += int(not known[query] and not recognized)
        found += int(known[query] and recognized and truth[query, order[0]])

    shares = refused / known.count(False), found / known.count(True)
    assert shares[0] >= 0.6, shares
    assert shares[1] >= 0.25, shares

"""HOG: one block's histogram by hand, and the published figure on corridor."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from core.frames.images import decode
from core.frames.traverses import find_images, read_ground_truth
from core.judgement.curves import auc_pr
from lab.baselines.hog import ABOUT, BINS, BLOCK, STRIDE, WINDOW, Hog
from lab.evaluation.protocol.outcomes import best_matched, best_scores, judge

CORRIDOR = Path(__file__).parents[4] / "shared/datasets/eval/corridor"
PUBLISHED_AUC_PR = 0.697  # VPR-Bench's stored similarities, judged as here


def test_a_vertical_edge_falls_into_the_bin_of_its_gradient() -> None:
    frame = np.zeros((WINDOW, WINDOW, 3), np.uint8)
    frame[:, WINDOW // 2 :] = 200
    side = (WINDOW - BLOCK) // STRIDE + 1
    histograms = Hog(ABOUT).describe(frame).arrays["descriptor"].reshape(side, side, BINS)  # columns first
    across = np.abs(histograms).sum(axis=(1, 2)).nonzero()[0] * STRIDE
    assert across.min() > WINDOW // 2 - BLOCK - STRIDE and across.max() < WINDOW // 2 + STRIDE
    strongest = histograms[(WINDOW // 2 - BLOCK // 2) // STRIDE, side // 2]
    # A horizontal gradient lies between the first and the last of the bins over 180 degrees.
    assert strongest[[0, -1]].sum() == pytest.approx(strongest.sum())


def test_colour_edges_count_by_their_strongest_channel() -> None:
    frame = np.zeros((64, 64, 3), np.uint8)
    frame[:, 32:, 2] = 200
    assert np.linalg.norm(Hog(ABOUT).describe(frame).arrays["descriptor"]) == pytest.approx(1)
    grey = np.repeat(frame[:, :, 2:], 3, axis=2)
    scores = Hog(ABOUT).index([Hog(ABOUT).describe(frame)]).score([Hog(ABOUT).describe(grey)])
    assert scores[0, 0] == pytest.approx(1, abs=1e-5)


def test_a_blank_frame_scores_zero() -> None:
    blank = Hog(ABOUT).describe(np.full((64, 64, 3), 9, np.uint8))
    assert Hog(ABOUT).index([blank]).score([blank]).tolist() == [[0.0]]


@pytest.mark.thorough
@pytest.mark.skipif(not CORRIDOR.is_dir(), reason="the corridor images are not on this machine")
def test_corridor_comes_out_as_published() -> None:
    system = Hog(ABOUT)
    references, queries = (
        [system.describe(decode(path.read_bytes())) for path in find_images(CORRIDOR / folder)]
        for folder in ("ref", "query")
    )
    truth = read_ground_truth(CORRIDOR / "ground_truth.csv", len(queries), len(references))
    scores = system.index(references).score(queries)
    outcomes = judge(scores, np.arange(len(references)), truth)
    figure = auc_pr(best_scores(outcomes), best_matched(outcomes))
    assert abs(figure - PUBLISHED_AUC_PR) < 0.05

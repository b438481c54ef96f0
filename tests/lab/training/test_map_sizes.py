"""Maps cut from traverses, and what is fitted to them."""

from __future__ import annotations

import numpy as np
import pytest

from core.geometry import verification
from core.geometry.keypoints import Keypoints
from core.geometry.pairs import Pairs
from core.judgement.background import Environment
from core.judgement.geometry import TERMS
from core.judgement.probability import Curve
from core.judgement.verdict import Calibration, worth_verifying
from core.recognition.verification import CANDIDATES
from lab.training.map_sizes import (
    APART,
    SMALL,
    ScoredTraverse,
    cut,
    trials_of_size,
)

CALIBRATION = Calibration(
    source="test",
    threshold=0.09,
    margin=0.004,
    background_mean=0.07,
    background_deviation=0.014,
    curve=Curve(slope=37, intercept=-3.5),
    environment=Environment(mean=0.13, deviation=0.034, mean_weight=0.66, deviation_weight=6.6),
)
COUNT = 80


def traverse(mean: float, seed: int, gain: float = 0.1) -> ScoredTraverse:
    """Places that score ``mean`` with each other, and ``gain`` more where they are the same."""
    random = np.random.default_rng(seed)
    apart = np.abs(np.arange(COUNT)[:, None] - np.arange(COUNT))
    truth = apart <= 2
    both = (random.normal(mean, 0.02, (COUNT, COUNT)) + gain * truth).astype(np.float32)
    return ScoredTraverse(both / 4, both, both, truth, 30)


def test_a_stranger_is_far_from_every_place_of_the_map() -> None:
    one = traverse(0.1, 0)
    assert one.strangers(np.arange(20, 30)).tolist() == [
        query for query in range(COUNT) if query + 2 < 20 - APART or query - 2 > 29 + APART
    ]


def test_a_map_is_a_run_or_drawn() -> None:
    generator = np.random.default_rng(0)
    run, drawn = (cut(traverse(0.1, 0), 10, how, generator) for how in ("run", "spread"))
    assert (np.diff(run) == 1).all() and len(run) == 10
    assert (np.diff(drawn) > 0).all() and len(drawn) == 10 and (np.diff(drawn) > 1).any()


@pytest.mark.thorough
@pytest.mark.parametrize("size", SMALL)
def test_trials_are_of_known_places_and_of_strangers(size: int) -> None:
    trials, judgements = trials_of_size(traverse(0.1, 0), size, "run", CALIBRATION, 4)
    assert len(trials) == len(judgements)
    assert trials.known.any() and not trials.known.all()
    assert not trials.right[~trials.known].any()
    assert ((trials.imagined > 0) & (trials.imagined <= 1)).all()


def verifiable(mean: float, seed: int) -> ScoredTraverse:
    """A traverse of which true pairs have much evidence, and the nearest one the most."""
    random = np.random.default_rng(100 + seed)
    plain = traverse(mean, seed, gain=0.05)
    apart = np.abs(np.arange(COUNT)[:, None] - np.arange(COUNT))
    share = np.where(plain.truth, 0.3 - 0.1 * apart, random.uniform(0, 0.03, (COUNT, COUNT)))
    evidence = np.where(plain.truth, random.gamma(2, 60, (COUNT, COUNT)), random.gamma(2, 12, (COUNT, COUNT)))
    some = Keypoints(8, 8, np.zeros((100, 2), np.uint16), np.ones((100, 64), np.int8))
    pairs = Pairs([some] * COUNT, [some] * COUNT)
    for query, place in np.ndindex(COUNT, COUNT):
        inliers = np.arange(100) < round(100 * float(share[query, place]))
        pairs.found[query, place] = verification.Verification(
            (100, 100), np.zeros((100, 2), np.int64), inliers, float(evidence[query, place]), 0.5
        )
    return ScoredTraverse(plain.first, plain.both, plain.among, plain.truth, 30, pairs)


def test_a_pair_is_verified_once(monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[int] = []

    def verify(query: Keypoints, candidates: list[Keypoints]) -> list[verification.Verification]:
        asked.append(len(candidates))
        nothing = np.zeros((0, 2), np.int64)
        return [verification.Verification((0, 0), nothing, np.zeros(0, np.bool_), 7.0, 0.0) for _ in candidates]

    monkeypatch.setattr(verification, "verify", verify)
    blank = [Keypoints(8, 8, np.zeros((0, 2), np.uint16), np.zeros((0, 64), np.int8))] * 4
    pairs = Pairs(blank, blank)
    assert [one.evidence for one in pairs.verified(1, [3, 0])] == [7.0, 7.0]
    assert len(pairs.verified(1, [0, 2, 3])) == 3
    assert asked == [2, 1]


@pytest.mark.thorough
def test_verification_puts_the_candidates_into_another_order() -> None:
    one, retained, sequence = verifiable(0.1, 0), np.arange(COUNT), np.zeros(COUNT, np.int64)
    calibration = CALIBRATION.model_copy(update={"geometry": TERMS})
    never, always = (
        [one.judged(query, retained, calibration, sequence, how) for query in range(COUNT)]
        for how in ("never", "always")
    )
    assert all(found.verified == 0 and found.judgement.evidence is None for found in never)
    assert all(1 <= found.verified <= CANDIDATES for found in always)
    right = [sum(found.best == query for query, found in enumerate(made)) for made in (never, always)]
    assert 1.2 * right[0] < right[1]


@pytest.mark.thorough
def test_auto_verifies_where_two_stages_leave_doubt() -> None:
    one, calibration = verifiable(0.1, 0), CALIBRATION.model_copy(update={"geometry": TERMS})
    _, small = trials_of_size(one, 2, "run", calibration, 4, verify="auto")
    assert {found.verified for found in small} <= {1, 2}, "two stages know nothing of a map of two places"
    retained, sequence = np.arange(COUNT), np.zeros(COUNT, np.int64)
    by_two, whole = (
        [one.judged(query, retained, calibration, sequence, how) for query in range(COUNT)] for how in ("never", "auto")
    )
    verified = [found.verified for found in whole]
    assert [count > 0 for count in verified] == [worth_verifying(found.judgement, calibration) for found in by_two]
    assert min(verified) == 0 < max(verified) <= CANDIDATES

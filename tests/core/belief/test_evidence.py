"""What scores say."""

from __future__ import annotations

import numpy as np
import pytest

from core.belief.evidence import LISTED, STRENGTH, STRONGEST, UNKNOWN, evidence
from core.judgement.verdict import Calibration, judge
from core.places import Neighborhood, Whereabouts
from tests.core.belief.maps import walk

CALIBRATION = Calibration(
    source="test", threshold=0.09, margin=0.004, background_mean=0.067, background_deviation=0.0136
)
APART = Neighborhood(5, 0)


def told(scores: list[float], examined: int) -> dict[int, float]:
    values = np.sort(np.array(scores, np.float32))[::-1].copy()
    marks = np.arange(len(values)) < examined
    seen = evidence(np.arange(len(values)), values, walk(len(values)), CALIBRATION, APART, marks)
    others = len(values) - 1  # the best has row 0
    assert seen.unknown == pytest.approx(
        UNKNOWN + np.log1p(np.expm1(seen.gains[seen.rows > 0]).sum() / max(others, 1)), abs=1e-5
    )
    return dict(zip(seen.rows.tolist(), seen.gains.tolist(), strict=True))


@pytest.mark.parametrize("examined", [0, 30])
def test_a_place_that_would_just_be_believed_gains_the_strength(examined: int) -> None:
    random = np.random.default_rng(0)
    rest = random.normal(0.07, 0.01, 60).tolist()
    below, above = 0.05, 1.0
    for _ in range(60):  # the least score that the single-frame verdict takes
        middle = (below + above) / 2
        scores = np.sort(np.array([middle, *rest], np.float32))[::-1].copy()
        verdict = judge(scores, walk(61), CALIBRATION, APART, examined).verdict
        below, above = (below, middle) if verdict != "unknown" else (middle, above)
    gains = told([above, *rest], examined)
    assert gains[0] == pytest.approx(STRENGTH, abs=0.02)
    assert told([2 * above, *rest], examined)[0] > 2 * STRENGTH


def test_only_listed_places_speak_and_none_too_loudly() -> None:
    scores = np.linspace(0.9, 0.1, 300).tolist()
    assert max(told(scores, 0)) < LISTED
    assert max(told(scores, 30)) < 30
    assert told([1.0, *[0.001] * 60], 30)[0] == STRONGEST
    assert min(told(scores, 0).values()) > 0


def test_tiny_maps() -> None:
    nothing = evidence(np.empty(0, np.int64), np.empty(0, np.float32), walk(), CALIBRATION, APART)
    assert len(nothing.rows) == 0 and nothing.unknown == 0
    assert told([0.5], 1)[0] > STRENGTH
    assert 0 not in told([0.01], 1)


def test_places_that_show_the_same_do_not_speak_against_one_another() -> None:
    scores = np.array([1.0, 0.99, *np.linspace(0.08, 0.06, 60)], np.float32)
    rows, where, marks = np.arange(len(scores)), walk(*[1] * len(scores)), np.arange(len(scores)) < 30
    alone = evidence(np.delete(rows, 1), np.delete(scores, 1), walk(*[1] * 61), CALIBRATION, APART, np.delete(marks, 1))
    twins = evidence(rows, scores, where, CALIBRATION, APART, marks, rivals=[1])
    rivals = evidence(rows, scores, where, CALIBRATION, APART, marks)
    assert twins.unknown == pytest.approx(alone.unknown, abs=0.05) and rivals.unknown > twins.unknown + 1
    assert twins.gains[:2] == pytest.approx(alone.gains[0], abs=0.1)
    assert twins.gains[0] - twins.gains[1] == pytest.approx(rivals.gains[0] - rivals.gains[1], abs=1e-4)
    assert len(twins.rows) == len(rivals.rows), "the others gain no more than before"


def test_what_verification_found_raises_and_lowers_a_places_evidence() -> None:
    scores = np.array([0.16, 0.15, 0.14, *np.linspace(0.08, 0.06, 60)], np.float32)
    verified = np.full(len(scores), np.nan)
    verified[:2] = 200.0, 0.0
    rows, where, marks = np.arange(len(scores)), walk(len(scores)), np.arange(len(scores)) < 30
    plain, changed = (evidence(rows, scores, where, CALIBRATION, APART, marks, found) for found in (None, verified))
    before, after = (dict(zip(seen.rows.tolist(), seen.gains.tolist(), strict=True)) for seen in (plain, changed))
    assert after[0] > before[0] + 0.5 and after[1] < before[1] - 0.5
    assert after[2] == before[2], "it was not verified"


def test_what_verification_found_of_a_view_counts_for_all_its_frames() -> None:
    scores = np.array([0.16, 0.159, 0.158, 0.15, *np.linspace(0.08, 0.06, 60)], np.float32)
    rows, where = np.arange(len(scores)), Whereabouts.along_sequence([0, 0, 0, *range(1, 62)])
    one_looked_at, all_looked_at = np.full((2, len(scores)), np.nan)
    one_looked_at[0], all_looked_at[:3] = 0, 0
    some, every = (
        evidence(rows, scores, where, CALIBRATION, APART, None, found) for found in (one_looked_at, all_looked_at)
    )
    assert some.gains == pytest.approx(every.gains) and some.rows.tolist() == every.rows.tolist()

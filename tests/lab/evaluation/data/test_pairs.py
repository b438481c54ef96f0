from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from core.errors import InvalidGroundTruth
from core.frames.traverses import tolerance_truth
from lab.evaluation.data.pairs import TraversePair, all_references, count_negatives, leave_run_out


def removed(retained: np.ndarray, references: int) -> list[int]:
    return sorted(set(range(references)) - set(retained.tolist()))


def test_a_pair_knows_its_kept_references_and_its_negatives() -> None:
    references = [Path(f"{n}.png") for n in range(4)]
    pair = TraversePair("made", references, references[:3], tolerance_truth(3, 4, 0), np.array([0, 3]))
    assert pair.retained_references == [Path("0.png"), Path("3.png")]
    assert pair.negatives() == 2
    assert all_references(references).tolist() == [0, 1, 2, 3]
    assert count_negatives(pair.truth, all_references(references)) == 0


def test_a_run_by_hand() -> None:
    # Ten references, query i true at i-1, i, i+1. Without four in the middle (s … s+3) the two queries whose three
    # references all go are new places; at an end it is three. Eight answerable queries: in the middle.
    truth = tolerance_truth(10, 10, 1)
    retained = leave_run_out(truth, 10, keep=6, answerable=8, seed=0)
    gone = removed(retained, 10)
    assert gone == list(range(gone[0], gone[0] + 4))
    assert 0 < gone[0] < 6
    assert count_negatives(truth, retained) == 2
    # Seven answerable: at an end.
    assert removed(leave_run_out(truth, 10, 6, 7, 0), 10)[0] in (0, 6)


def test_the_seed_draws_and_the_same_seed_draws_the_same() -> None:
    truth = tolerance_truth(200, 200, 2)
    drawn = [leave_run_out(truth, 200, 150, 154, seed).tolist() for seed in range(8)]
    assert drawn[3] == leave_run_out(truth, 200, 150, 154, 3).tolist()
    assert len({tuple(retained) for retained in drawn}) > 4


@pytest.mark.thorough
@settings(deadline=None)  # the processor may be busy
@given(st.integers(2, 60), st.integers(0, 4), st.data())
def test_as_many_are_kept_as_requested_in_two_runs(references: int, tolerance: int, data: st.DataObject) -> None:
    keep = data.draw(st.integers(1, references - 1))
    answerable = data.draw(st.integers(0, references))
    truth = tolerance_truth(references, references, tolerance)
    retained = leave_run_out(truth, references, keep, answerable, seed=1)
    gone = removed(retained, references)
    assert len(retained) == keep and gone == list(range(gone[0], gone[0] + references - keep))
    # No other run comes nearer.
    starts = range(keep + 1)
    others = [np.delete(np.arange(references), range(start, start + references - keep)) for start in starts]
    misses = [abs(references - count_negatives(truth, other) - answerable) for other in others]
    assert abs(references - count_negatives(truth, retained) - answerable) == min(misses)


def test_something_must_go_and_something_stay() -> None:
    truth = tolerance_truth(3, 3, 0)
    for keep in (0, 3, 4):
        with pytest.raises(InvalidGroundTruth, match="cannot be retained"):
            leave_run_out(truth, 3, keep, 1, 0)

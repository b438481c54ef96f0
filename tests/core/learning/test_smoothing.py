"""The place of each frame by all others, against sums over the whole chain, written out."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from core.belief import Evidence, Odometry, PlaceGraph, Step, Stride
from core.belief.filter import JUMP, LEAVING, RETURNING, START_UNKNOWN
from core.belief.motion import Pending, transition
from core.learning import WeighedFrame, smoothed
from core.learning.smoothing import LOSING, WEIGHT
from tests.core.learning.runs import dark, seen_at, way

Matrix = NDArray[np.float64]

evidences = st.lists(
    st.tuples(st.lists(st.integers(0, 5), max_size=3, unique=True), st.floats(0.1, 5), st.floats(0, 2)),
    min_size=1,
    max_size=5,
)
shares = st.floats(0.1, 1)


def frames_of(seen: Sequence[tuple[list[int], float, float]], share: float = 1.0) -> list[WeighedFrame]:
    return [
        WeighedFrame(
            Evidence(np.array(rows, np.int64), np.full(len(rows), gain, np.float32), unknown),
            Step(odometry=Odometry(2.0, 0.1, 0.02)),
            share,
        )
        for rows, gain, unknown in seen
    ]


def written_out(frames: Sequence[WeighedFrame], graph: PlaceGraph) -> list[Matrix]:
    """P(place, or away last | all frames but one), float64 [n + 1] for each frame, by matrices of all states."""
    n, pending = len(graph), Pending()
    matrices, likely = [], []
    for number, frame in enumerate(frames):
        if number:
            matrices.append(_states(transition(graph, frame.step, frame.stride, pending), n, frame.share))
        seen = frame.seen.tempered(WEIGHT * frame.share)
        gains = np.zeros(n)
        gains[graph.places_at(seen.rows)] = seen.gains
        likely.append(np.exp(np.concatenate([gains, np.full(n + 1, seen.unknown)])))
    start = np.concatenate(
        [np.full(n, (1 - START_UNKNOWN) / n), np.full(n, START_UNKNOWN / 2 / n), [START_UNKNOWN / 2]]
    )
    found = []
    for left_out in range(len(frames)):
        before, later = start, np.ones(2 * n + 1)
        for number in range(left_out):
            before = (before * likely[number]) @ matrices[number]
        for number in range(len(frames) - 1, left_out, -1):
            later = matrices[number - 1] @ (later * likely[number])
        joint = before * later / (before @ later)
        found.append(np.append(joint[:n] + joint[n : 2 * n], joint[-1]))
    return found


def _states(step: object, n: int, share: float) -> Matrix:
    """The transition between all states: n that see their place, n that do not, and away."""
    leaving, returning, losing, jump = (share * rate for rate in (LEAVING, RETURNING, LOSING, JUMP))
    moves, gone = np.zeros((n, n)), np.zeros(n)
    for place in range(n):
        alone = np.zeros(n, np.float32)
        alone[place] = 1
        after, spread, left = step.forward(alone, 0.0)  # type: ignore[attr-defined]
        moves[place], gone[place] = (1 - jump) * (after + spread / n) + jump / n, (1 - jump) * left
    away = np.append(np.concatenate([np.full(n, returning / n), np.zeros(n)]), 1 - returning)
    seeing = np.hstack([(1 - leaving) * moves, leaving * moves, np.zeros((n, 1))])
    blind = (1 - losing) * np.hstack([returning * moves, (1 - returning) * moves, np.zeros((n, 1))])
    blind[:, -1] += losing * moves.sum(axis=1)
    return np.vstack([seeing + np.outer(gone, away), blind + np.outer(gone, away), away])


@settings(deadline=None, max_examples=40)
@given(evidences, shares)
def test_it_is_the_chain_of_all_states(seen: list[tuple[list[int], float, float]], share: float) -> None:
    graph, frames = way(6), frames_of(seen, share)
    for posterior, exact in zip(smoothed(frames, graph), written_out(frames, graph), strict=True):
        dense = np.full(len(graph), posterior.elsewhere)
        dense[posterior.places] = posterior.probabilities
        np.testing.assert_allclose(np.append(dense, posterior.away), exact, rtol=2e-3, atol=1e-6)


def test_places_without_poses_go_along_their_sequence() -> None:
    graph = way(6, posed=False)
    frames = [replace(one, stride=Stride(1.0)) for one in frames_of([([0], 4.0, 1.0), ([], 1.0, 1.0), ([2], 4.0, 1.0)])]
    posterior, exact = smoothed(frames, graph)[1], written_out(frames, graph)[1]
    np.testing.assert_allclose(posterior.probabilities[np.argsort(posterior.places)], exact[:-1], rtol=2e-3)
    assert posterior.best == 1


@settings(deadline=None, max_examples=40)
@given(evidences, st.data())
def test_a_frame_has_no_say_about_itself(seen: list[tuple[list[int], float, float]], data: st.DataObject) -> None:
    graph, frames = way(6), frames_of(seen)
    number = data.draw(st.integers(0, len(frames) - 1))
    changed = list(frames)
    changed[number] = replace(frames[number], seen=seen_at(data.draw(st.integers(0, 5)), 7.0))
    before, after = smoothed(frames, graph)[number], smoothed(changed, graph)[number]
    np.testing.assert_allclose(before.probabilities, after.probabilities, rtol=1e-4, atol=1e-7)


@settings(deadline=None, max_examples=30)
@given(evidences, st.integers(1, 12))
def test_probabilities_sum_to_one_however_few_are_stored(
    seen: list[tuple[list[int], float, float]], stored: int
) -> None:
    graph = way(12)
    for posterior in smoothed(frames_of(seen), graph, stored):
        everywhere = posterior.at(np.arange(len(graph)))
        assert everywhere + posterior.away == pytest.approx(1, abs=1e-4)
        assert len(posterior.places) <= max(stored, 1)


def test_a_dark_stretch_is_known_from_both_ends() -> None:
    graph = way(40)
    seen = [seen_at(row) if row < 10 or row >= 20 else dark() for row in range(30)]
    frames = [WeighedFrame(one, Step(odometry=Odometry(2.0))) for one in seen]
    posteriors = smoothed(frames, graph)
    for row in range(10, 20):
        assert posteriors[row].at(graph.same_place(row)) > 0.9
    ahead = smoothed(frames[:20], graph)
    assert ahead[19].at(graph.same_place(19)) < posteriors[19].at(graph.same_place(19))


def test_frames_that_show_the_same_prove_nothing() -> None:
    graph = way(40)
    moving = [WeighedFrame(seen_at(row, 2.0), Step(odometry=Odometry(2.0))) for row in (3, 4, 5)]
    standing = [WeighedFrame(seen_at(30, 2.0), Step(odometry=Odometry(0.0)), 0.0)] * 50
    alone, repeated = smoothed(moving, graph), smoothed([*moving, *standing], graph)
    assert repeated[2].at(graph.same_place(5)) == pytest.approx(alone[2].at(graph.same_place(5)), abs=1e-3)


def test_an_empty_map_has_no_places() -> None:
    (found,) = smoothed([WeighedFrame(dark(), Step())], way(0))
    assert found.best is None
    assert found.away == 1


def test_the_memory_of_a_long_run_does_not_grow_with_the_map() -> None:
    graph = way(600)
    frames = [WeighedFrame(seen_at(row % 600), Step(odometry=Odometry(2.0))) for row in range(50)]
    posteriors = smoothed(frames, graph, stored=32)
    assert all(len(one.places) == 32 for one in posteriors)
    assert posteriors[25].at(graph.same_place(25)) > 0.99

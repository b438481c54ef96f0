"""The path search against a search over all paths, one by one."""

from __future__ import annotations

import numpy as np
import pytest

from core.belief import Evidence, Stride
from core.belief.paths import BEST, PACES, SHARE, PathSearch
from tests.core.belief.maps import graph_of, walk


@pytest.mark.parametrize("stride", [Stride(), Stride(2.0), Stride(1.0, backwards=True)])
def test_each_place_has_its_best_path(stride: Stride) -> None:
    random, graph = np.random.default_rng(1), graph_of(walk(30, 20))
    frames, search = [], PathSearch(6)
    for _ in range(9):
        rows = random.choice(50, 12, replace=False)
        frames.append(Evidence(rows, random.uniform(0.1, 2, 12).astype(np.float32), 0.5))
        search.append(frames[-1])
    best = np.zeros(50)
    for end in range(50):
        for pace in (sign * pace for pace in PACES for sign in ((1, -1) if stride.backwards else (1,))):
            total = 0.0
            for age, frame in enumerate(reversed(frames[-6:])):
                velocity = round(stride.advance * abs(pace), 3)
                place = end - int(np.sign(pace)) * int(np.floor(velocity * age + 0.5))
                if graph.first[end] <= place < graph.last[end]:
                    total += float(frame.gains[frame.rows == place].sum())
            best[end] = max(best[end], total)
    belief = search.belief(graph, stride)
    best *= SHARE
    expected = np.exp(best) / np.exp(best).sum()
    np.testing.assert_allclose(belief.given, expected, atol=1e-5)
    outside = np.exp(3 * SHARE * BEST)
    assert belief.unknown == pytest.approx(outside / (outside + np.exp(best.max())), abs=1e-5)


def test_frames_that_did_not_arrive_keep_their_time() -> None:
    graph = graph_of(walk(40))
    search = PathSearch(5)
    search.append(Evidence(np.array([10]), np.array([2.0], np.float32), 0.5))
    search.append(Evidence(np.array([13]), np.array([2.0], np.float32), 0.5), missed=2)
    assert search.belief(graph, Stride()).given.argmax() == 13
    assert [len(seen.rows) for seen in search.seen] == [1, 0, 0, 1]
    assert PathSearch(3).belief(graph_of(walk()), Stride()).unknown == 1

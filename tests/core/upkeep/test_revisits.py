"""Signs that lie together are one stretch to go again."""

from __future__ import annotations

from itertools import pairwise

from hypothesis import given
from hypothesis import strategies as st

from core.upkeep.revisits import BRIDGED, WEIGHTS, Reason, Sign, silent_runs, stretches


def test_runs_that_never_matched() -> None:
    flags = [c == "#" for c in "##..#...##....."]
    assert [(s.first, s.last) for s in silent_runs(flags)] == [(5, 7), (10, 14)]
    assert silent_runs([False] * 20) == [], "nobody asked there at all"
    assert silent_runs([]) == []


def test_what_touches_is_one() -> None:
    signs = [Sign(10, 11, "distance-gap"), Sign(12, 15, "never-matched"), Sign(40, 41, "time-gap")]
    first, second = stretches(signs)
    assert (first.first, first.last, first.reasons) == (10, 15, ("distance-gap", "never-matched"))
    assert (second.first, second.last, second.reasons) == (40, 41, ("time-gap",))
    assert first.weight == WEIGHTS["distance-gap"] + 4 * WEIGHTS["never-matched"]


reasons = st.sampled_from(sorted(WEIGHTS))
signs = st.builds(lambda a, n, r: Sign(a, a + n, r), st.integers(0, 60), st.integers(0, 5), reasons)


@given(st.lists(signs, max_size=20))
def test_every_sign_is_in_one_stretch(found: list[Sign]) -> None:
    made = stretches(found)
    for sign in found:
        reason: Reason = sign.reason
        (holder,) = [s for s in made if s.first <= sign.first and sign.last <= s.last]
        assert reason in holder.reasons
    ordered = sorted(made, key=lambda s: s.first)
    assert all(b.first > a.last + BRIDGED for a, b in pairwise(ordered))
    assert [s.weight for s in made] == sorted((s.weight for s in made), reverse=True)

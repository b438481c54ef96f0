"""The shortlist: what going through all codes would give, among allowed rows only, however the rows were added."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from core.index import CodedQuery, Coder, CodeTable, table
from core.index.best_estimates import best_first, best_positions, together
from core.kernels.codes import estimates_of
from tests.core.index.made_up import Array, descriptors, second_looks, table_of

COUNT = 5000
ROWS = descriptors(COUNT)
TABLE = table_of(ROWS)
QUERIES = [TABLE.coder.query(look) for look in second_looks(ROWS[:40])]


@pytest.fixture
def few_survivors(monkeypatch: pytest.MonkeyPatch) -> None:
    """Full codes are read of some hundred rows, so that sketches decide."""
    monkeypatch.setattr(table, "FEWEST_SURVIVORS", 300)
    monkeypatch.setattr(table, "SURVIVORS", 1)


def all_estimates(of: CodeTable, query: CodedQuery) -> Array:
    """By the full codes of all rows."""
    codes, made = of.codes(0, len(of)), np.empty(len(of), np.float32)
    code = query.code
    estimates_of(codes.bits, codes.scales[:, 1], code.planes, code.step, code.total, made)
    return made


def by_brute_force(of: CodeTable, query: CodedQuery, count: int, allowed: NDArray[np.bool_]) -> list[int]:
    estimates = np.where(allowed, all_estimates(of, query), -np.inf)
    order = np.argsort(-estimates, kind="stable")
    return order[: min(count, int(allowed.sum()))].tolist()


def test_a_small_table_is_ranked_by_all_full_codes() -> None:
    small = table_of(ROWS[:1500], TABLE.coder)
    for query in QUERIES[:10]:
        found = small.shortlist(query, 25)
        assert found.rows.tolist() == by_brute_force(small, query, 25, np.ones(1500, np.bool_))
        assert np.array_equal(found.estimates, all_estimates(small, query)[found.rows])
        assert (np.diff(found.estimates) <= 0).all()


@pytest.mark.usefixtures("few_survivors")
def test_sketches_pass_on_what_full_codes_rank_first() -> None:
    everything = np.ones(COUNT, np.bool_)
    for row, query in enumerate(QUERIES):
        found = TABLE.shortlist(query, 50)
        assert found.rows[0] == row  # its second look
        assert set(found.rows[:3]) & set(by_brute_force(TABLE, query, 3, everything))
        assert np.array_equal(found.estimates, all_estimates(TABLE, query)[found.rows])


@pytest.mark.usefixtures("few_survivors")
@settings(max_examples=30, deadline=None)
@given(st.floats(0, 1), st.integers(0, 2**20), st.sampled_from([1, 10, 400]))
def test_only_allowed_rows_are_returned_and_as_many_as_there_are(share: float, seed: int, count: int) -> None:
    allowed = np.random.default_rng(seed).random(COUNT) < share
    found = TABLE.shortlist(QUERIES[seed % 40], count, allowed)
    assert allowed[found.rows].all()
    assert len(set(found.rows.tolist())) == len(found.rows) == min(count, int(allowed.sum()))


@pytest.mark.usefixtures("few_survivors")
def test_few_allowed_rows_are_all_ranked_by_their_full_codes() -> None:
    allowed = np.random.default_rng(0).random(COUNT) < 0.05
    for query in QUERIES[:10]:
        assert TABLE.shortlist(query, 20, allowed).rows.tolist() == by_brute_force(TABLE, query, 20, allowed)


@pytest.mark.usefixtures("few_survivors")
def test_a_filter_that_takes_most_rows_away_reads_sketches_of_the_others_only(monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(*arguments: object) -> None:
        raise AssertionError("all rows were read")

    monkeypatch.setattr(CodeTable, "sketched", refuse)
    allowed = np.arange(COUNT) % 10 == 0
    assert TABLE.shortlist(QUERIES[20], 5, allowed).rows[0] == 20


def test_rows_added_one_by_one_are_those_added_at_once(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(table, "ROWS_PER_BLOCK", 64)
    codes = TABLE.codes(0, 200)
    grown = CodeTable.empty(TABLE.coder)
    states = []
    for start, stop in [(0, 1), (1, 63), (63, 65), (65, 65), (65, 200)]:
        grown = grown.appended(TABLE.codes(start, stop))
        states.append((grown, stop))
    for state, length in states:  # older values of the table still see their own rows
        assert len(state) == length
        assert np.array_equal(state.codes(0, length).bits, codes.bits[:length])
        assert np.array_equal(state.codes(length // 2, length).scales, codes.scales[length // 2 : length])
        assert state.shortlist(QUERIES[0], 500).rows.max() == length - 1
    assert [block.used for block in grown.blocks] == [64, 64, 64, 8]
    assert np.array_equal(grown.sketches_at(np.array([199, 3, 64])).sketches, codes.sketches[[199, 3, 64]])


def test_codes_are_taken_as_they_are_and_more_may_follow() -> None:
    codes = TABLE.codes(0, 3000)
    taken = CodeTable.of(TABLE.coder, codes)
    assert np.shares_memory(taken.codes(0, 3000).bits, codes.bits)
    grown = taken.appended(TABLE.codes(3000, COUNT))
    for query in QUERIES[:5]:
        assert grown.shortlist(query, 30).rows.tolist() == TABLE.shortlist(query, 30).rows.tolist()


def test_threads_change_nothing(few_survivors: None, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(table, "_ROWS_PER_TASK", 700)
    allowed = np.arange(COUNT) % 3 > 0
    with ThreadPoolExecutor(2) as executor:
        for query in QUERIES[:10]:
            for mask in (None, allowed):
                alone, shared = (TABLE.shortlist(query, 40, mask, executor=one) for one in (None, executor))
                assert np.array_equal(alone.rows, shared.rows)
                assert np.array_equal(alone.estimates, shared.estimates)


def test_nothing_is_found_where_nothing_is() -> None:
    empty = CodeTable.empty(TABLE.coder)
    assert len(empty) == len(empty.shortlist(QUERIES[0], 10).rows) == len(empty.codes(0, 10)) == 0
    assert len(TABLE.shortlist(QUERIES[0], 10, np.zeros(COUNT, np.bool_)).rows) == 0
    assert len(TABLE.shortlist(QUERIES[0], 0).rows) == 0


def test_what_does_not_fit_is_refused() -> None:
    with pytest.raises(ValueError, match="allowed is said of all 5000"):
        TABLE.shortlist(QUERIES[0], 10, np.ones(10, np.bool_))
    with pytest.raises(ValueError, match="another shape"):
        CodeTable.of(Coder.fitted(descriptors(5, 512)), TABLE.codes(0, 10))


@settings(max_examples=50, deadline=None)
@given(st.integers(1, 20_000), st.integers(0, 5000), st.integers(1, 50), st.integers(0, 2**20))
def test_the_best_are_never_missed(size: int, count: int, levels: int, seed: int) -> None:
    """With many equal values too, where no limit parts the best from the rest."""
    values = np.random.default_rng(seed).integers(0, levels, size).astype(np.float32)
    best = np.argsort(-values, kind="stable")[:count]
    assert best_first(values, count).tolist() == best.tolist()
    assert best_positions(values, count).tolist() == np.sort(best).tolist()


def test_what_a_task_raises_is_raised() -> None:
    def fail() -> None:
        raise KeyError("this one")

    done: list[int] = []
    with ThreadPoolExecutor(1) as executor, pytest.raises(KeyError):
        together([fail, lambda: done.append(1), fail], executor)

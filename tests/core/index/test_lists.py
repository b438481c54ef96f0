"""Inverted lists: every row is in one, all of them probed find what no lists find, and later rows are not forgotten."""

from __future__ import annotations

import numpy as np
import pytest

from core.index import InvertedLists, lists, table
from tests.core.index.made_up import descriptors, second_looks, table_of

COUNT = 5000
ROWS = descriptors(COUNT)
TABLE = table_of(ROWS)
QUERIES = [TABLE.coder.query(look) for look in second_looks(ROWS[:40])]


@pytest.fixture(autouse=True)
def few_survivors(monkeypatch: pytest.MonkeyPatch) -> None:
    """Sketches decide, as they do in large maps."""
    monkeypatch.setattr(table, "FEWEST_SURVIVORS", 300)
    monkeypatch.setattr(table, "SURVIVORS", 1)


@pytest.fixture(scope="module")
def made() -> InvertedLists:
    return InvertedLists.built(TABLE)


def test_every_row_is_in_one_list(made: InvertedLists) -> None:
    assert made.rows == COUNT
    assert sorted(made.order.tolist()) == list(range(COUNT))
    assert len(made.ends) == int(2 * np.sqrt(COUNT))
    assert (np.diff(made.ends) >= 0).all()
    for start, end in zip(made.starts.tolist(), made.ends.tolist(), strict=True):
        assert (np.diff(made.order[start:end]) > 0).all()
    codes = TABLE.codes(0, COUNT)
    assert np.array_equal(made.sketches, codes.sketches[made.order])
    assert np.array_equal(made.scales, codes.scales[made.order, 0])


def test_with_all_lists_probed_the_candidates_are_those_of_no_lists(made: InvertedLists) -> None:
    for query in QUERIES:
        every = made.candidates(TABLE, query, 300, share=1.0)
        estimates = TABLE.sketched(query, 0, COUNT)
        best = np.argsort(-estimates, kind="stable")[:300]
        assert set(best.tolist()) <= set(every.tolist())


def test_with_a_share_probed_second_looks_are_found(made: InvertedLists) -> None:
    found = [TABLE.shortlist(query, 10, lists=made).rows[0] for query in QUERIES]
    assert np.mean(np.array(found) == np.arange(len(QUERIES))) >= 0.95


def test_a_share_of_the_rows_is_probed_nearest_first(made: InvertedLists) -> None:
    chosen = made.probed(QUERIES[0], 0.3)
    sizes = (made.ends - made.starts)[chosen]
    assert sizes[:-1].sum() < 0.3 * COUNT <= sizes.sum()
    closeness = made.centers @ QUERIES[0].principal
    assert closeness[chosen].min() >= np.delete(closeness, chosen).max()
    assert len(made.probed(QUERIES[0], 0.0)) == 1
    assert len(made.probed(QUERIES[0], 1.0)) == len(made.ends)


def test_only_allowed_rows_are_returned_and_as_many_as_there_are(made: InvertedLists) -> None:
    for seed, share in enumerate([0.0, 0.01, 0.08, 0.3, 0.9]):
        allowed = np.random.default_rng(seed).random(COUNT) < share
        found = TABLE.shortlist(QUERIES[seed], 200, allowed, made)
        assert allowed[found.rows].all()
        assert len(found.rows) == min(200, int(allowed.sum()))


def test_a_filter_on_rows_of_far_lists_still_finds_them(made: InvertedLists) -> None:
    probed = made.probed(QUERIES[0])
    near = np.concatenate([made.order[made.starts[one] : made.ends[one]] for one in probed.tolist()])
    allowed = np.ones(COUNT, np.bool_)
    allowed[near] = False
    found = TABLE.shortlist(QUERIES[0], 50, allowed, made)
    assert len(found.rows) == 50
    assert not set(found.rows.tolist()) & set(near.tolist())


def test_rows_that_came_later_are_found_before_and_after_they_are_listed(made: InvertedLists) -> None:
    later = descriptors(80, seed=5)
    grown = TABLE.appended(TABLE.coder.encode(later))
    extended = made.extended(grown)
    assert extended.rows == COUNT + 80
    assert np.array_equal(extended.centers, made.centers)
    assert sorted(extended.order.tolist()) == list(range(COUNT + 80))
    for offset in (0, 40, 79):
        query = TABLE.coder.query(second_looks(later)[offset])
        for of in (made, extended):
            assert grown.shortlist(query, 10, lists=of).rows[0] == COUNT + offset
    assert np.array_equal(made.extended(TABLE).order, made.order)


def test_lists_come_back_from_their_tensors(made: InvertedLists) -> None:
    again = InvertedLists.of({name: tensor.copy() for name, tensor in made.tensors().items()})
    for query in QUERIES[:5]:
        kept, stored = (TABLE.shortlist(query, 20, lists=of) for of in (made, again))
        assert np.array_equal(kept.rows, stored.rows)


@pytest.mark.parametrize("damage", ["missing", "short", "descending", "empty"])
def test_other_tensors_are_refused(made: InvertedLists, damage: str) -> None:
    tensors = dict(made.tensors())
    if damage == "missing":
        del tensors["order"]
    elif damage == "short":
        tensors["sketches"] = tensors["sketches"][:-1]
    elif damage == "descending":
        tensors["ends"] = np.concatenate([tensors["ends"][1::-1], tensors["ends"][2:]])
    else:
        tensors.update(ends=tensors["ends"][:0], centers=tensors["centers"][:0])
    with pytest.raises(ValueError, match="not the tensors of lists"):
        InvertedLists.of(tensors)


def test_building_tells_how_far_it_is_and_can_be_stopped(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(lists, "_AT_ONCE", 1000)
    told: list[tuple[int, int]] = []
    InvertedLists.built(TABLE, progress=lambda done, total: told.append((done, total)))
    rounds = told.count((0, COUNT))
    assert rounds > 2
    assert told[rounds:] == [(done, COUNT) for done in range(1000, COUNT + 1, 1000)]

    def stop(done: int, total: int) -> None:
        told.append((done, total))
        if len(told) == 2:
            raise InterruptedError

    told.clear()
    with pytest.raises(InterruptedError):
        InvertedLists.built(TABLE, progress=stop)
    assert told == [(0, COUNT)] * 2  # while centres were sought


def test_few_rows_can_be_listed_and_none_cannot() -> None:
    for count in (1, 2, 3):
        assert InvertedLists.built(table_of(ROWS[:count], TABLE.coder)).rows == count
    with pytest.raises(ValueError, match="nothing to list"):
        InvertedLists.built(table_of(ROWS[:0], TABLE.coder))

from __future__ import annotations

import threading
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
from numpy.typing import NDArray

from core.index import Coder, CodeTable, table
from tests.core.index.made_up import Array, descriptors, second_looks, table_of

ROWS = descriptors(1000)
CODER = Coder.of(1024)


@pytest.fixture(autouse=True)
def small(monkeypatch: pytest.MonkeyPatch) -> None:
    """Blocks of few rows, and scans of them, so that a few rows make all kinds of blocks."""
    monkeypatch.setattr(table, "ROWS_PER_BLOCK", 64)
    monkeypatch.setattr(table, "LARGEST_BLOCK", 512)
    monkeypatch.setattr(table, "LOOSE_ROWS", 128)
    monkeypatch.setattr(table, "SCANNED_VALUES", 512)
    monkeypatch.setattr(table, "SHARED_FROM", 256)


def grown(rows: Array, step: int) -> CodeTable:
    """A table to which so many rows were added at a time."""
    made = CodeTable.empty(CODER)
    for start in range(0, len(rows), step):
        made = made.appended(CODER.encode(rows[start : start + step]))
    return made


def joined(of: CodeTable) -> CodeTable:
    """With all blocks joined that should be."""
    while (block := of.joined()) is not None:
        of = of.with_block(block)
    return of


def best(of: CodeTable, queries: Array, count: int = 10, allowed: NDArray[np.bool_] | None = None) -> list[list[int]]:
    return [found.rows.tolist() for found in of.shortlists(queries, count, allowed)]


@pytest.mark.parametrize("step", [1, 7, 64, 1000])
def test_rows_are_the_same_however_they_came(step: int) -> None:
    made, queries = grown(ROWS[:300], step), second_looks(ROWS[:40])
    assert len(made) == 300
    np.testing.assert_array_equal(made.codes(0, 300), CODER.encode(ROWS[:300]))
    np.testing.assert_array_equal(made.codes(60, 70), CODER.encode(ROWS[60:70]))
    assert best(made, queries) == best(table_of(ROWS[:300]), queries)


def test_an_older_table_stays_what_it_was() -> None:
    first = grown(ROWS[:70], 70)
    second = first.appended(CODER.encode(ROWS[70:80]))
    assert max(best(first, ROWS[70:71], 70)[0]) == 69
    assert best(second, ROWS[70:71], 70)[0][0] == 70


def test_a_write_that_was_given_up_is_overwritten() -> None:
    first = grown(ROWS[:70], 70)
    first.appended(CODER.encode(ROWS[500:510]))
    second = first.appended(CODER.encode(ROWS[70:80]))
    np.testing.assert_array_equal(second.codes(70, 80), CODER.encode(ROWS[70:80]))


def test_an_empty_table() -> None:
    assert best(CodeTable.empty(CODER), ROWS[:2]) == [[], []]
    assert table_of(ROWS[:10]).shortlists(ROWS[:0], 5) == []


def test_blocks_are_joined_and_find_what_they_found() -> None:
    loose = grown(ROWS, 50)
    assert loose.is_loose
    made = joined(loose)
    assert [(block.first, block.used, block.scan is not None) for block in made.blocks] == [
        (0, 512, True),
        (512, 448, True),
        (960, 40, False),
    ]
    assert not made.is_loose
    np.testing.assert_array_equal(made.codes(0, 1000), loose.codes(0, 1000))
    queries = second_looks(ROWS)
    firsts = [rows[0] for rows in best(loose, queries)]
    assert np.mean([found == rows[0] for found, rows in zip(firsts, best(made, queries), strict=True)]) > 0.97
    assert np.mean(np.array(firsts) == np.arange(1000)) > 0.9


def test_a_block_is_extended_until_it_is_the_largest() -> None:
    made, sizes = CodeTable.empty(CODER), []
    for start in range(0, 960, 64):
        made = joined(made.appended(CODER.encode(ROWS[start : start + 64])))
        sizes.append([block.used for block in made.blocks if block.scan is not None])
    assert sizes[1] == [128] and [512, 384] in sizes
    assert [block.first for block in made.blocks] == np.cumsum([0, *(block.used for block in made.blocks)])[
        :-1
    ].tolist()


def test_rows_that_come_while_blocks_are_joined_stay() -> None:
    before = grown(ROWS[:300], 50)
    block = before.joined()
    assert block is not None
    after = before.appended(CODER.encode(ROWS[300:400])).with_block(block)
    np.testing.assert_array_equal(after.codes(0, 400), CODER.encode(ROWS[:400]))
    assert best(after, second_looks(ROWS[350:351]))[0][0] == 350


def test_joining_reports_progress_and_may_be_stopped() -> None:
    told = []

    def stop(done: int, total: int) -> None:
        told.append((done, total))
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        grown(ROWS, 100).joined(stop)
    assert told == [(256, 500)]


def test_codes_of_few_values_are_all_compared() -> None:
    rows, coder = descriptors(600, 256), Coder.of(256)
    made = CodeTable.empty(coder)
    for start in range(0, 600, 50):
        made = made.appended(coder.encode(rows[start : start + 50]))
    assert made.is_loose and len(made.blocks) == 10
    larger = joined(made)
    assert not larger.is_loose and len(larger.blocks) < 4 and all(block.scan is None for block in larger.blocks)
    np.testing.assert_array_equal(larger.codes(0, 600), made.codes(0, 600))
    assert best(larger, rows[::60]) == best(made, rows[::60])


@pytest.mark.parametrize("share", [0.0, 0.01, 0.1, 0.6, 1.0])
@pytest.mark.parametrize("scanned", [False, True])
def test_only_allowed_rows_are_found(share: float, scanned: bool) -> None:
    made = joined(grown(ROWS, 50)) if scanned else grown(ROWS, 50)
    allowed = np.random.default_rng(0).random(1000) < share
    for found in made.shortlists(second_looks(ROWS[:9]), 20, allowed):
        assert allowed[found.rows].all()
        assert len(found.rows) == len(set(found.rows.tolist())) == min(20, np.count_nonzero(allowed))
        assert (np.diff(found.estimates) <= 0).all()


@pytest.mark.parametrize("queries", [1, 2, 5])
def test_threads_and_company_change_nothing(queries: int) -> None:
    made, asked = joined(grown(ROWS, 50)), second_looks(ROWS[:5])
    alone = [made.shortlists(asked[i : i + 1], 20)[0].rows.tolist() for i in range(queries)]
    with ThreadPoolExecutor(3) as executor:
        together = made.shortlists(asked[:queries], 20, executor=executor)
    assert [found.rows.tolist() for found in together] == alone


def test_what_is_allowed_is_said_of_all_rows() -> None:
    with pytest.raises(ValueError, match="of all 1000"):
        table_of(ROWS).shortlists(ROWS[:1], 5, np.ones(999, np.bool_))


def test_searches_while_rows_are_added_and_joined() -> None:
    newest, done, faults = [grown(ROWS[:64], 64)], threading.Event(), []

    def search() -> None:
        while not done.is_set():
            made = newest[0]
            last = len(made) - 1
            found = made.shortlists(ROWS[[0, last]], 5)
            if [found[0].rows[0], found[1].rows[0]] != [0, last]:
                faults.append(last)

    threads = [threading.Thread(target=search) for _ in range(3)]
    for thread in threads:
        thread.start()
    for start in range(64, 1000, 8):
        newest[0] = joined(newest[0].appended(CODER.encode(ROWS[start : start + 8])))
    done.set()
    for thread in threads:
        thread.join()
    assert faults == []

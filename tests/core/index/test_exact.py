from __future__ import annotations

import numpy as np
import pytest

from core.index import exact
from core.index.exact import compare, compile_ahead, ranked


def plain(queries: np.ndarray, rows: np.ndarray, chosen: np.ndarray) -> np.ndarray:
    """In double precision, one by one."""
    return np.array(
        [[np.dot(query, rows[row].astype(np.float64)) for row in chosen] for query in queries.astype(float)]
    )


@pytest.mark.parametrize("kind", [np.float16, np.float32])
@pytest.mark.parametrize("dimension", [1, 5, 16, 33, 200])
def test_products_are_those_of_a_plain_sum(dimension: int, kind: type[np.floating]) -> None:
    random = np.random.default_rng(dimension)
    rows = random.standard_normal((20, dimension)).astype(kind)
    for count in (1, 2, 3, 4, 5, 8, 9):
        queries = random.standard_normal((count, dimension), np.float32)
        for chosen in (np.arange(20), np.arange(6), np.array([19]), np.array([3, 4, 9, 11, 12, 13, 17])):
            found = compare(queries, rows, chosen)
            assert (found.dtype.name, found.shape) == ("float32", (count, len(chosen)))
            np.testing.assert_allclose(found, plain(queries, rows, chosen), rtol=1e-5, atol=1e-5)


def test_every_half_becomes_the_same_float() -> None:
    """The smallest ones too, which have no leading one, and both zeros."""
    halves = np.arange(1 << 16, dtype=np.uint16).view(np.float16)
    rows = halves[np.isfinite(halves)].reshape(-1, 1)
    found = compare(np.ones((1, 1), np.float32), rows, np.arange(len(rows)))
    np.testing.assert_array_equal(found[0], rows[:, 0].astype(np.float32))
    spread = np.repeat(rows, 32, axis=1)
    found = compare(np.eye(1, 32, 5, dtype=np.float32), spread, np.arange(len(rows)))
    np.testing.assert_array_equal(found[0], rows[:, 0].astype(np.float32))


@pytest.mark.parametrize("kind", [np.float16, np.float32])
def test_a_product_is_the_same_number_alone_and_in_company(kind: type[np.floating]) -> None:
    random = np.random.default_rng(1)
    rows, queries = random.standard_normal((17, 4099)).astype(kind), random.standard_normal((7, 4099), np.float32)
    together = compare(queries, rows, np.arange(17))
    for number in range(7):
        for row in range(17):
            assert compare(queries[number : number + 1], rows, np.array([row]))[0, 0] == together[number, row]


def test_a_processor_that_knows_no_halves_gets_floats(monkeypatch: pytest.MonkeyPatch) -> None:
    random = np.random.default_rng(2)
    rows, queries = random.standard_normal((9, 50)).astype(np.float16), random.standard_normal((3, 50), np.float32)
    chosen = np.array([1, 2, 8])
    expected = compare(queries, rows, chosen)
    monkeypatch.setattr(exact, "_KNOWS_HALVES", False)
    np.testing.assert_array_equal(compare(queries, rows, chosen), expected)


def test_memory_of_any_layout_is_read_as_it_is_meant() -> None:
    random = np.random.default_rng(3)
    rows, queries = random.standard_normal((9, 24), np.float32), random.standard_normal((4, 24), np.float32)
    expected = compare(queries, rows, np.arange(9))
    rows.flags.writeable = False
    wide = np.repeat(queries, 2, axis=1)[:, ::2]
    np.testing.assert_array_equal(compare(wide, np.asfortranarray(rows), np.arange(9)), expected)
    np.testing.assert_array_equal(compare(queries.astype(np.float64), rows, np.arange(9)), expected)


def test_nothing_with_nothing() -> None:
    nobody = np.empty(0, np.int64)
    assert compare(np.ones((2, 8), np.float32), np.ones((4, 8), np.float32), nobody).shape == (2, 0)
    assert compare(np.ones((0, 8), np.float32), np.ones((4, 8), np.float32), np.arange(4)).shape == (0, 4)
    assert compare(np.ones((2, 8), np.float32), np.ones((0, 8), np.float32), nobody).shape == (2, 0)


@pytest.mark.parametrize("row", [-1, 4])
def test_memory_that_is_not_of_the_rows_is_not_read(row: int) -> None:
    with pytest.raises(IndexError, match="4 rows"):
        compare(np.ones((2, 8), np.float32), np.ones((4, 8), np.float32), np.array([0, row]))
    with pytest.raises(ValueError, match="8 values"):
        compare(np.ones((2, 8), np.float32), np.ones((4, 7), np.float32), np.array([0]))


def test_nothing_is_compiled_after_it_was_ahead() -> None:
    compile_ahead()
    known = len(exact._compare.signatures)
    random = np.random.default_rng(0)
    halves = random.random((9, 40)).astype(np.float16)
    compare(random.random((3, 40), np.float32), halves, np.arange(9))
    compare(random.random((2, 40), np.float32), halves.astype(np.float32), np.arange(9))
    assert len(exact._compare.signatures) == known


@pytest.mark.parametrize("count", [0, 1, 2, 700])
def test_equal_products_are_ranked_by_row(count: int) -> None:
    random = np.random.default_rng(count)
    rows = random.permutation(2**32 - 1 - np.arange(count))
    products = random.integers(-3, 4, count).astype(np.float32) * np.float32(0.125)
    products[::5] *= np.float32(-1)  # zeros of both signs
    found, values = ranked(rows, products)
    order = np.lexsort((rows, -products))
    assert (found.dtype.name, values.dtype.name) == ("int64", "float32")
    assert found.tolist() == rows[order].tolist()
    assert values.tolist() == products[order].tolist()


def test_products_of_every_size_are_told_apart() -> None:
    tiny, largest = np.float32(1e-45), np.finfo(np.float32).max
    products = np.array(
        [0, tiny, -tiny, 1, np.nextafter(np.float32(1), np.float32(2)), -1, largest, -largest], np.float32
    )
    products = np.concatenate([products, np.array([np.inf, -np.inf], np.float32)])
    found, values = ranked(np.arange(10), products)
    assert found.tolist() == np.argsort(-products, kind="stable").tolist()
    assert values.tolist() == sorted(products.tolist(), reverse=True)

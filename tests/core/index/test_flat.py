from __future__ import annotations

import faiss
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from core.index.flat import flat_index, in_one_thread, products, ranked, vectors


def filled(rows: NDArray[np.float32], halves: bool) -> faiss.IndexFlatCodes:
    index = flat_index(len(rows), rows.shape[1], halves)
    vectors(index)[:] = rows
    return index


@pytest.mark.parametrize("halves", [False, True])
@pytest.mark.parametrize("queries", [1, 3, 30])
@pytest.mark.parametrize("chosen", [None, [], [0], [2, 3, 39], list(range(40))])
def test_products_are_those_of_numpy(halves: bool, queries: int, chosen: list[int] | None) -> None:
    random = np.random.default_rng(0)
    kept = random.standard_normal((40, 24)).astype(np.float16).astype(np.float32)
    asked = random.standard_normal((queries, 24)).astype(np.float32)
    rows = None if chosen is None else np.array(chosen, np.int64)
    found = products(filled(kept, halves), asked, rows)
    expected = asked @ (kept if rows is None else kept[rows]).T
    assert (str(found.dtype), found.shape) == ("float32", expected.shape)
    np.testing.assert_allclose(found, expected, rtol=1e-5, atol=1e-5)


def test_an_index_without_rows() -> None:
    assert vectors(flat_index(0, 8)).shape == (0, 8)
    assert products(flat_index(0, 8), np.ones((2, 8), np.float32)).shape == (2, 0)
    assert products(filled(np.ones((3, 8), np.float32), False), np.empty((0, 8), np.float32)).shape == (0, 3)


def test_faiss_keeps_its_threads_for_others() -> None:
    before = faiss.omp_get_max_threads()
    with pytest.raises(KeyError), in_one_thread():
        assert faiss.omp_get_max_threads() == 1
        raise KeyError
    assert faiss.omp_get_max_threads() == before


@given(
    st.lists(st.tuples(st.integers(0, 50), st.sampled_from([0.0, -0.0, 1.5, -2.0, np.inf])), unique_by=lambda p: p[0])
)
def test_ranked_is_by_product_then_by_row(pairs: list[tuple[int, float]]) -> None:
    rows, found = np.array([row for row, _ in pairs], np.int64), np.array([product for _, product in pairs], np.float32)
    expected = sorted(pairs, key=lambda pair: (-pair[1], pair[0]))
    ordered, best = ranked(rows, found)
    assert list(zip(ordered.tolist(), best.tolist(), strict=True)) == expected

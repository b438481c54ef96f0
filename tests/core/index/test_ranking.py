from __future__ import annotations

import numpy as np
import pytest

from core.index.ranking import ranked


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

from __future__ import annotations

import numpy as np
import pytest

from core.index import Coder
from core.index.flat import stored
from tests.core.index.made_up import descriptors, second_looks, table_of


def test_codes_depend_on_their_own_rows_alone() -> None:
    rows, coder = descriptors(600), Coder.of(1024)
    codes = coder.encode(rows)
    assert (str(codes.dtype), codes.shape) == ("uint8", (600, 1024 // 8 + 8))
    np.testing.assert_array_equal(codes[300:305], coder.encode(rows[300:305]))
    assert coder.encode(rows[:0]).shape == coder.blank(0).shape == (0, coder.bytes_per_place)


@pytest.mark.parametrize(("dimension", "width"), [(1, 1), (5, 8), (8, 8), (100, 128), (1024, 1024)])
def test_a_rotation_keeps_inner_products(dimension: int, width: int) -> None:
    coder = Coder.of(dimension)
    rows = np.random.default_rng(0).standard_normal((7, dimension)).astype(np.float32)
    turned = coder.rotated(rows)
    assert coder.width == turned.shape[1] == width
    np.testing.assert_allclose(turned @ turned.T, rows @ rows.T, rtol=1e-4, atol=1e-4)


def test_estimates_are_near_inner_products_and_without_bias() -> None:
    rows = descriptors(1500)
    queries = second_looks(rows[:20])
    errors = []
    for query, found in zip(queries, table_of(rows).shortlists(queries, 1500), strict=True):
        errors.append(found.estimates - rows[found.rows] @ query)
    spread = np.linalg.norm(rows, axis=1).mean() * np.linalg.norm(queries, axis=1).mean() / np.sqrt(1024)
    assert np.std(errors) < spread
    assert abs(np.mean(errors)) < 0.1 * spread


@pytest.mark.parametrize("count", [8, 512, 1024])
def test_the_first_values_are_decoded_as_faiss_decodes_all(count: int) -> None:
    coder, rows = Coder.of(1024), descriptors(20)
    codes = coder.encode(rows)
    index = coder.index(20)
    stored(index)[:] = codes
    found = coder.decoded(codes, count)
    assert (str(found.dtype), found.shape) == ("float32", (20, count))
    np.testing.assert_allclose(found, index.reconstruct_n(0, 20)[:, :count], rtol=1e-5)


def test_a_digest_is_of_the_codes_of_one_length() -> None:
    assert Coder(64).digest == Coder.of(64).digest
    assert Coder.of(64).digest != Coder.of(128).digest


@pytest.mark.parametrize("shape", [(3, 63), (64,)])
def test_others_than_descriptors_are_refused(shape: tuple[int, ...]) -> None:
    with pytest.raises(ValueError, match="of 64 values"):
        Coder.of(64).encode(np.ones(shape, np.float32))

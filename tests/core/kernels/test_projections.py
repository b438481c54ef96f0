"""The compiled loops of projections give what the projection is defined as."""

from __future__ import annotations

import numpy as np
import pytest

from core.method.projection import Projection


@pytest.mark.parametrize(("count", "length", "values"), [(5, 6, 3), (300, 384, 128), (0, 4, 2)])
def test_finished_products_are_projections(count: int, length: int, values: int) -> None:
    generator = np.random.default_rng(length)
    mean = (generator.random(length) / length).astype(np.float32)
    projection = Projection(mean, generator.standard_normal((length, values + 2)).astype(np.float32))
    features = generator.random((count, length)).astype(np.float32)
    features[1:2] = 0
    made = projection.finish(projection.products(features), features, values)
    np.testing.assert_allclose(made, projection(features, values), atol=1e-5)

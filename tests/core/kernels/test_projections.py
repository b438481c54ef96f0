"""The compiled loops of projections give what the projection is defined as, and values rounded to whole steps."""

from __future__ import annotations

import numpy as np
import pytest

from core.kernels.projections import quantize
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


def test_quantized_values_are_rounded_and_cut_off() -> None:
    values = np.random.default_rng(0).standard_normal((30, 20)).astype(np.float32)
    made = np.empty((30, 40), np.int8)
    quantize(values, 100.0, made[:, 10:30])
    np.testing.assert_array_equal(made[:, 10:30], np.clip(np.rint(values * np.float64(100)), -127, 127))

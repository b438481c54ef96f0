"""Pooled systems on the packaged network."""

from __future__ import annotations

import numpy as np
import pytest

from core.baselines.catalogue import build
from core.baselines.maps import PooledSystem, unit
from core.baselines.system import stack
from core.method.catalogue import EncoderCatalogue
from core.method.equations import power

LENGTHS = {
    "sum-pool": 384,
    "max-pool": 384,
    "cross-pool": 384 * 384,
    "whole": 13 * 13 * 384,
    "spp": 30 * 384,
    "rmac": 384,
}


def test_unit_and_power() -> None:
    vectors = np.array([[3, -4], [0, 0]], np.float32)
    np.testing.assert_allclose(unit(vectors), np.array([[0.6, -0.8], [0, 0]]), rtol=1e-6)
    np.testing.assert_allclose(power(np.array([4, -9, 0], np.float32), 0.5), [2, -3, 0], rtol=1e-6)


@pytest.mark.parametrize("name", LENGTHS)
def test_pooled_systems_pool_the_networks_own_maps(name: str) -> None:
    system = build(name, models=EncoderCatalogue())
    assert isinstance(system, PooledSystem)
    picture = np.random.default_rng(1).integers(0, 255, (60, 80, 3)).astype(np.uint8)
    described = system.describe(picture)
    vector = stack([described])[0]
    pooled = system.pool(*system.extractor.activations([picture])[0])
    np.testing.assert_allclose(vector, pooled / np.linalg.norm(pooled), rtol=1e-4, atol=1e-7)
    assert vector.shape == (LENGTHS[name],) and vector.dtype == np.float32
    assert described.nbytes == 4 * LENGTHS[name]
    assert set(described.milliseconds) == {"forward", "pool"}

    blank = system.describe(np.full((60, 80, 3), 7, np.uint8))
    scores = system.index([described, blank]).compare([described])
    np.testing.assert_allclose(scores, [[1, 0]], atol=1e-5)


def test_the_identity_speaks_of_constants_and_weights() -> None:
    identities = {build(name, models=EncoderCatalogue()).identity for name in LENGTHS}
    assert len(identities) == len(LENGTHS)
    assert build("spp", models=EncoderCatalogue()).identity in identities

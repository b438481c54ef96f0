"""The synthesized references: the same whichever block they come in, and put together as is said."""

from __future__ import annotations

import numpy as np
import pytest

from benchmarks.maps.references import NEIGHBOURS, Material, _kind, _roles

WORDS, VALUES = 8, 16


@pytest.fixture(scope="module")
def made() -> Material:
    random = np.random.default_rng(0)
    parts = random.standard_normal((40, WORDS, VALUES)).astype(np.float32)
    parts /= np.linalg.norm(parts, axis=2, keepdims=True)
    parts[random.random((40, WORDS)) < 0.3] = 0
    real = parts.reshape(40, -1)
    neighbours = random.integers(0, 30, (30, NEIGHBOURS))
    return Material(
        WORDS, real[:30], np.zeros(30, np.int64), neighbours, real[30:34], real[34:], np.zeros(4, np.int64), ("set",)
    )


@pytest.mark.thorough
def test_rows_are_the_same_in_every_block(made: Material) -> None:
    whole = made.references(0, 50)
    assert np.array_equal(whole[20:33], made.references(20, 33))
    for size in (7, 50):
        blocks = list(made.blocks(50, size))
        assert [start for start, _ in blocks] == list(range(0, 50, size))
        assert np.array_equal(np.concatenate([block for _, block in blocks]), whole)
    assert np.array_equal(next(made.blocks(50, 10, 40))[1], whole[40:])


def test_real_places_come_first(made: Material) -> None:
    assert np.array_equal(made.references(0, 10)[:6], made.places)


def test_parts_are_of_unit_length_or_empty_as_those_of_a_source_are(made: Material) -> None:
    parts = made.references(6, 306).reshape(300, WORDS, VALUES)
    lengths = np.linalg.norm(parts, axis=2)
    assert np.logical_or(np.isclose(lengths, 1, atol=1e-5), lengths == 0).all()
    assert 0.15 < (lengths == 0).mean() < 0.45


def test_distractors_differ_and_are_mostly_one_of_two_sources(made: Material) -> None:
    rows = made.references(6, 206)
    assert len(np.unique(rows, axis=0)) > 190  # so few words leave few ways to mix two
    parts, sources = rows.reshape(200, WORDS, VALUES), made.sources.reshape(30, WORDS, VALUES)
    cosines = np.einsum("nwk,swk->nsw", parts, sources)
    filled = np.linalg.norm(parts, axis=2) > 0
    assert (cosines.max(axis=1)[filled] > 0.5).mean() > 0.9


def test_photographs_have_one_role_each() -> None:
    names = [
        "eval/corridor/query/1.jpg",
        "eval/corridor/ref/1.jpg",
        "eval/lip6_outdoor/reference/4.jpg",
        "eval/webcams/mexico/a.jpg",
        "eval/webcams/mexico/b.jpg",
        "train/day_night/1x1/day_1.jpg",
        "train/day_night/1x1/night_1.jpg",
        "train/tower/floor9/1.jpg",
        "train/tower/floor9/3.jpg",
        "train/tower/floor1/3.jpg",
        "train/roads/rainy_roads/1.jpg",
    ]
    wanted = ["query", "place", "place", "place", "query", "place", "query", "place", "query", "source", "source"]
    assert _roles(names) == wanted
    assert _kind("train/roads/rainy_roads/1.jpg") == "train/roads/rainy_roads"
    assert _kind("train/tower/floor9/1.jpg") == "train/tower"

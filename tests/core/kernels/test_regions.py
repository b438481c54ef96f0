"""The compiled region pass finds the regions of equations 3.1 to 3.3."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from numpy.typing import NDArray

from core.method.equations import (
    bounding_boxes,
    energies,
    labelled_regions,
    levels,
    regional_features,
    strongest_regions,
)
from core.method.projection import Projection
from core.method.regions import box_sums, find_regions, projected_box_sums

Array = NDArray[np.float32]


def assert_same_regions(activations: Array, step: float, count: int) -> None:
    made = find_regions([activations], [step], count)
    regions = labelled_regions(levels(activations, step))
    energy = energies(activations, regions)
    chosen = strongest_regions(energy, count)
    channels = [int(np.argwhere(regions == number)[0, 2]) for number in chosen[:50]]
    assert made.boxes.tolist() == bounding_boxes(regions, chosen).tolist()
    assert made.channels[:50].tolist() == channels
    np.testing.assert_allclose(made.energies, energy[chosen - 1], rtol=1e-6)


@pytest.mark.thorough
@settings(max_examples=150)
@given(
    activations=arrays(
        np.float32,
        st.tuples(st.integers(1, 9), st.integers(1, 9), st.integers(1, 5)),
        # Eighths: many equal levels and equal means, so that ties and merging are exercised.
        elements=st.integers(0, 48).map(lambda n: n / 8),
    ),
    step=st.sampled_from([0.125, 0.5, 1.0, 2.5]),
    count=st.integers(1, 60),
)
def test_agrees_with_the_obvious_reference(activations: Array, step: float, count: int) -> None:
    assert_same_regions(activations, step, count)


@pytest.mark.parametrize("scale", [0.02, 1.0, 60.0])
@pytest.mark.parametrize("count", [1, 300, 100_000])
def test_agrees_on_maps_of_the_real_size(scale: float, count: int) -> None:
    generator = np.random.default_rng(5)
    smooth = generator.standard_normal((15, 15, 48))
    smooth = smooth[:-2, :-2] + smooth[1:-1, 1:-1] + smooth[2:, 2:]
    activations = np.maximum(smooth, 0).astype(np.float32) * np.float32(scale)
    assert_same_regions(activations, 1.0, count)


@pytest.mark.parametrize("count", [5, 40, 5000])
def test_agrees_where_many_levels_and_energies_are_equal(count: int) -> None:
    generator = np.random.default_rng(count)
    quarters = np.maximum(generator.integers(-12, 24, (6, 5, 130)), 0)
    activations = np.asarray(quarters / 4, np.float32)
    assert_same_regions(activations, 1.0, count)


def test_what_one_frame_leaves_behind_does_not_touch_the_next() -> None:
    generator = np.random.default_rng(8)
    frames = [np.maximum(generator.standard_normal((7, 7, 80)) * scale, 0).astype(np.float32) for scale in (9, 1, 4)]
    for frame in frames * 2:
        assert_same_regions(frame, 1.0, 30)


FEW = [[0, 0, 12, 11], [3, 4, 4, 5], [2, 1, 7, 9]]
SMALL = [
    [top, left, top + height, left + width] for top, left, height, width in np.ndindex(3, 3, 5, 5) if height * width
]


@pytest.fixture(params=[[], FEW, FEW * 20, SMALL], ids=["none", "few", "many", "small"])
def boxes(request: pytest.FixtureRequest) -> NDArray[np.int32]:
    return np.array(request.param, np.int32).reshape(-1, 4)


def test_sums(boxes: NDArray[np.int32]) -> None:
    layer = np.random.default_rng(3).random((12, 11, 40)).astype(np.float32)
    np.testing.assert_allclose(box_sums(layer, boxes), regional_features(layer, boxes), rtol=1e-5)


def test_projected_sums(boxes: NDArray[np.int32]) -> None:
    generator = np.random.default_rng(4)
    layer = generator.random((12, 11, 40)).astype(np.float32)
    layer[:3, :3] = 0  # boxes of zeros alone stay zero
    projection = Projection(
        (generator.random(40) / 40).astype(np.float32), generator.standard_normal((40, 9)).astype(np.float32)
    )
    products = projection.products(layer.reshape(-1, 40)).reshape(12, 11, 9)
    made = np.empty((len(boxes), 6), np.float32)
    projected_box_sums(layer, products, boxes, projection.shift, made)
    wanted = projection(regional_features(layer, boxes).astype(np.float32), 6)
    np.testing.assert_allclose(made, wanted, atol=1e-4)

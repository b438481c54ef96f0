"""The compiled region pass against a slow, obvious one (scikit-image), and its edge cases."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from numpy.typing import NDArray
from skimage import measure

from core.method.regions import box_sums, extract_regions, unit_length

Array = NDArray[np.float32]


def obvious_regions(activations: Array, step: float, count: int) -> list[tuple[float, int, tuple[int, ...]]]:
    """(energy, channel, box) of the strongest regions, by the definitions of method.md, section 3."""
    found: list[tuple[float, int, tuple[int, ...]]] = []
    for channel in range(activations.shape[2]):
        values = activations[:, :, channel]
        levels = np.floor(values / np.float32(step)).astype(np.int64)
        labels = measure.label(np.maximum(levels, 0), connectivity=2, background=0)  # type: ignore[no-untyped-call]
        regions = measure.regionprops(labels, values.astype(np.float64))  # type: ignore[no-untyped-call]
        # Within a map: by the first cell in row-major order.
        first = sorted(regions, key=lambda region: tuple(min(map(tuple, region.coords))))
        found += [(float(region.intensity_mean), channel, tuple(region.bbox)) for region in first]
    return sorted(found, key=lambda region: -region[0])[:count]


def assert_same_regions(activations: Array, step: float, count: int) -> None:
    made = extract_regions([activations], [step], count)
    wanted = obvious_regions(activations, step, count)
    assert len(made) == len(wanted)
    assert [tuple(box) for box in made.boxes.tolist()] == [box for _, _, box in wanted]
    assert made.channels.tolist() == [channel for _, channel, _ in wanted]
    np.testing.assert_allclose(made.energies, [energy for energy, _, _ in wanted], rtol=1e-6)
    for (top, left, bottom, right), feature in zip(made.boxes, made.features, strict=True):
        in_box = activations[top:bottom, left:right].astype(np.float64).sum(axis=(0, 1))
        np.testing.assert_allclose(feature, in_box, rtol=1e-6, atol=1e-6)


@settings(max_examples=150, deadline=None)
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


@pytest.mark.parametrize("channels", [63, 64, 65, 130])
@pytest.mark.parametrize("count", [5, 40, 5000])
def test_agrees_whether_or_not_channels_come_in_whole_blocks(channels: int, count: int) -> None:
    generator = np.random.default_rng(channels)
    quarters = np.maximum(generator.integers(-12, 24, (6, 5, channels)), 0)
    activations = np.asarray(quarters / 4, np.float32)
    assert_same_regions(activations, 1.0, count)


def test_many_regions_of_one_energy_keep_the_order_of_maps_and_rows() -> None:
    activations = np.zeros((9, 9, 70), np.float32)
    activations[::2, ::2] = 3  # 25 x 70 single cells
    made = extract_regions([activations], [1.0], 60)
    assert made.channels.tolist() == [0] * 25 + [1] * 25 + [2] * 10
    assert made.boxes[:6, :2].tolist() == [[0, 0], [0, 2], [0, 4], [0, 6], [0, 8], [2, 0]]


def test_what_one_frame_leaves_behind_does_not_touch_the_next() -> None:
    generator = np.random.default_rng(8)
    frames = [np.maximum(generator.standard_normal((7, 7, 80)) * scale, 0).astype(np.float32) for scale in (9, 1, 4)]
    for frame in frames * 2:
        assert_same_regions(frame, 1.0, 30)


def test_large_boxes_are_summed_by_a_table_and_few_of_them_directly() -> None:
    generator = np.random.default_rng(3)
    grid = generator.random((12, 11, 40)).astype(np.float32)
    few = np.array([[0, 0, 12, 11], [3, 4, 4, 5], [2, 1, 7, 9]], np.int32)
    for boxes in (few, np.repeat(few, 20, axis=0)):
        wanted = [grid[top:bottom, left:right].sum(axis=(0, 1), dtype=np.float64) for top, left, bottom, right in boxes]
        np.testing.assert_allclose(box_sums(grid, boxes), wanted, rtol=1e-6)


@pytest.mark.parametrize("largest", [1e6, 1e30])
def test_levels_beyond_any_histogram_are_told_apart(largest: float) -> None:
    activations = np.zeros((4, 4, 1), np.float32)
    activations[0, 0], activations[0, 1], activations[3, 3] = largest, largest * 0.5, largest
    made = extract_regions([activations], [1.0], 10)
    assert made.boxes.tolist() == [[0, 0, 1, 1], [3, 3, 4, 4], [0, 1, 1, 2]]


def test_diagonal_neighbours_are_one_region() -> None:
    activations = np.zeros((3, 3, 1), np.float32)
    activations[[0, 1, 2], [0, 1, 2], 0] = [1.2, 1.4, 1.6]
    made = extract_regions([activations], [1.0], 5)
    assert made.boxes.tolist() == [[0, 0, 3, 3]]
    assert made.energies[0] == pytest.approx(1.4)


def test_a_feature_sums_over_the_box_and_over_all_channels() -> None:
    activations = np.zeros((3, 3, 2), np.float32)
    activations[[0, 1], [0, 1], 0] = 5
    activations[0, 1, 1] = 0.25  # inside the box, outside the region, below the first level
    made = extract_regions([activations], [1.0], 5)
    assert made.features.tolist() == [[10.0, 0.25]]


def test_a_blank_frame_has_no_region() -> None:
    made = extract_regions([np.zeros((13, 13, 384), np.float32)], [1.0], 300)
    assert len(made) == 0
    assert made.features.shape == (0, 384)


def test_a_single_cell() -> None:
    assert extract_regions([np.full((1, 1, 1), 3.5, np.float32)], [1.0], 300).boxes.tolist() == [[0, 0, 1, 1]]


def test_a_large_grid_with_one_region() -> None:
    activations = np.ones((200, 300, 2), np.float32)
    made = extract_regions([activations], [1.0], 300)
    assert made.boxes.tolist() == [[0, 0, 200, 300]] * 2
    np.testing.assert_allclose(made.features, 60_000)


def test_negative_activations_are_background() -> None:
    activations = np.full((4, 4, 1), -7, np.float32)
    activations[2, 2] = 1
    assert extract_regions([activations], [1.0], 9).boxes.tolist() == [[2, 2, 3, 3]]


@pytest.mark.parametrize(("step", "count"), [(0.0, 1), (-1.0, 1), (float("nan"), 1), (1.0, 0)])
def test_senseless_parameters_are_refused(step: float, count: int) -> None:
    with pytest.raises(ValueError, match="positive"):
        extract_regions([np.zeros((2, 2, 1), np.float32)], [step], count)


def test_fusion_keeps_the_layers_apart() -> None:
    generator = np.random.default_rng(0)
    layers = [generator.random((size, size, 6)).astype(np.float32) * 9 for size in (13, 6)]
    fused = extract_regions(layers, (1.0, 1.0), 20)
    assert len(fused) == 40
    assert fused.layers.tolist() == [0] * 20 + [1] * 20
    np.testing.assert_array_equal(fused.features[20:], extract_regions(layers[1:], (1.0,), 20).features)


def test_unit_length_leaves_zero_rows_alone() -> None:
    made = unit_length(np.array([[3, 4], [0, 0]], np.float32))
    np.testing.assert_allclose(made, np.array([[0.6, 0.8], [0, 0]], np.float32), rtol=1e-6)


def test_layers_of_other_channels_cannot_be_fused() -> None:
    with pytest.raises(ValueError, match="channels"):
        extract_regions([np.ones((2, 2, 3), np.float32), np.ones((2, 2, 4), np.float32)], (1.0, 1.0), 5)

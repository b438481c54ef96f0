"""Regions of interest and their features on layers for which the answer is known."""

from __future__ import annotations

import numpy as np
import pytest

from core.method.regions import extract_regions


def test_many_regions_of_one_energy_keep_the_order_of_maps_and_rows() -> None:
    activations = np.zeros((9, 9, 70), np.float32)
    activations[::2, ::2] = 3  # 25 x 70 single cells
    made = extract_regions([activations], [1.0], 60)
    assert made.channels.tolist() == [0] * 25 + [1] * 25 + [2] * 10
    assert made.boxes[:6, :2].tolist() == [[0, 0], [0, 2], [0, 4], [0, 6], [0, 8], [2, 0]]


@pytest.mark.parametrize("largest", [1e6, 1e30])
def test_levels_beyond_any_histogram_are_distinguished(largest: float) -> None:
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
    np.testing.assert_allclose(fused.features[20:], extract_regions(layers[1:], (1.0,), 20).features, rtol=1e-5)


def test_layers_of_other_channels_cannot_be_fused() -> None:
    with pytest.raises(ValueError, match="channels"):
        extract_regions([np.ones((2, 2, 3), np.float32), np.ones((2, 2, 4), np.float32)], (1.0, 1.0), 5)

"""The equations on values small enough to work them out by hand."""

from __future__ import annotations

import numpy as np
import pytest

from core.method import equations


def test_regions_are_connected_cells_of_one_level_and_one_map() -> None:
    activations = np.zeros((3, 4, 2))
    activations[:, :, 0] = [[1.2, 0.0, 2.5, 2.9], [0.9, 1.8, 0.0, 0.0], [0.0, 0.0, 3.0, -5.0]]
    activations[0, 0, 1] = 1.5  # over the first region, in another map
    regions = equations.labelled_regions(equations.levels(activations, 1.0))
    assert regions[:, :, 0].tolist() == [[1, 0, 2, 2], [0, 1, 0, 0], [0, 0, 3, 0]]
    assert regions[:, :, 1].tolist() == [[4, 0, 0, 0], [0, 0, 0, 0], [0, 0, 0, 0]]
    energies = equations.energies(activations, regions)
    np.testing.assert_allclose(energies, [1.5, 2.7, 3.0, 1.5])
    chosen = equations.strongest_regions(energies, 3)
    assert chosen.tolist() == [3, 2, 1], "of equal energies the first region"
    boxes = equations.bounding_boxes(regions, chosen)
    assert boxes.tolist() == [[2, 2, 3, 3], [0, 2, 1, 4], [0, 0, 2, 2]]
    # The box of the first region holds a cell of level 0 and a cell of the other map besides its own cells.
    np.testing.assert_allclose(equations.regional_features(activations, boxes), [[3.0, 0.0], [5.4, 0.0], [3.9, 1.5]])
    fused = equations.fused_features([activations, 2 * activations], [1.0, 2.0], 3)
    np.testing.assert_allclose(fused[:3] * 2, fused[3:])


def test_a_blank_layer_has_no_region() -> None:
    assert equations.fused_features([np.zeros((3, 4, 2))], [1.0], 5).shape == (0, 2)


def test_a_feature_belongs_to_the_nearest_centre_and_between_two_to_the_first() -> None:
    centers = np.array([[0.0, 0.0], [2.0, 2.0]])
    assert equations.assign(np.array([[1.0, 1.0], [1.1, 1.0], [-3.0, 0.0]]), centers).tolist() == [0, 1, 0]


def test_vlad_and_its_score() -> None:
    centers = np.array([[0.0, 0.0], [10.0, 10.0], [100.0, 100.0]])
    features = np.array([[3.0, 0.0], [1.0, -9.0], [10.0, 14.0]])
    residuals = equations.residuals(features, centers)
    assert residuals.tolist() == [[4, -9], [0, 4], [0, 0]]
    powered = equations.power(residuals, 0.5)
    assert powered.tolist() == [[2, -3], [0, 2], [0, 0]]
    np.testing.assert_allclose(equations.normalize(powered, "global"), powered / np.sqrt(17))
    intra = equations.vlad(features, centers, 0.5, "intra")
    np.testing.assert_allclose(intra, [[2 / np.sqrt(13), -3 / np.sqrt(13)], [0, 1], [0, 0]])
    np.testing.assert_allclose(equations.word_cosines(intra, powered), [1, 1, 0], atol=1e-12)
    assert equations.matching_score(intra, -intra) == pytest.approx(-2)
    assert equations.best_match(intra, np.stack([-intra, intra, np.zeros_like(intra)])) == 1

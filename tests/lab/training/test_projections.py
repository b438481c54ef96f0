"""Projections fitted to crops, and refined by contrastive learning."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
import torch

from core.method.agreement import AgreementDefinition
from core.method.encoder import Encoder, EncoderDefinition
from core.method.features import FeatureExtractor
from core.method.projection import Projection, discriminant
from core.method.vocabulary import Vocabulary
from core.networks.torch_network import TorchNetwork
from lab.training.default_calibration import UNCALIBRATED
from lab.training.loss_curve import draw_loss_curve
from lab.training.projections import (
    CellDescriptor,
    PairedCells,
    Views,
    _wrong_matches,
    contrastive_loss,
    fit_cell_projections,
    fit_projections,
    neighbours,
    paired_cells,
    refine,
)
from lab.training.student import student_definition
from lab.training.views.displaced_views import Displacement

STAGE = AgreementDefinition(layers=("a",), values=4, weights=(1.0,), reach=(1, 1), candidates=3, share=0.5)


def network(*layers: str) -> TorchNetwork:
    torch.manual_seed(0)
    return TorchNetwork(student_definition(), layers).eval().requires_grad_(False)


@pytest.mark.thorough
def test_projections_are_fitted_layer_by_layer_and_repeatably(photographs: Path) -> None:
    made, again = (fit_projections(network("pool2", "conv3"), {"pool2": 5, "conv3": 7}, photographs, 6) for _ in "ab")
    assert {layer: one.matrix.shape for layer, one in made.items()} == {"pool2": (256, 5), "conv3": (384, 7)}
    for layer, one in made.items():
        np.testing.assert_allclose(one.matrix, again[layer].matrix, rtol=1e-3, atol=1e-5)


def encoder(stage: AgreementDefinition, photographs: Path) -> Encoder:
    """A small encoder with these cells in the projections of its regions."""
    definition = EncoderDefinition(
        layers=("conv3",),
        regions=20,
        steps=(2.0,),
        unit_features=True,
        projection=6,
        words=4,
        gamma=0.5,
        normalization="intra",
        agreement=stage,
    )
    made = network(*definition.outputs)
    projections = fit_projections(made, definition.projected(), photographs, 4)
    extractor = FeatureExtractor(made.as_data(), definition, projections)
    centers = np.random.default_rng(0).standard_normal((4, 6)).astype(np.float32)
    return Encoder("small", extractor, definition, Vocabulary(centers, extractor.origin), UNCALIBRATED)


@pytest.mark.thorough
def test_projections_of_cells_are_fitted_to_the_stage_and_repeatably(photographs: Path) -> None:
    stage = STAGE.model_copy(update={"layers": ("pool2", "conv3"), "weights": (0.5, 0.5)})
    small = encoder(stage, photographs)
    made, again = (fit_cell_projections(small, stage, photographs, 5, 0) for _ in "ab")
    assert {layer: one.matrix.shape for layer, one in made.items()} == {"pool2": (256, 4), "conv3": (384, 4)}
    for layer, one in made.items():
        np.testing.assert_allclose(one.matrix, again[layer].matrix, rtol=1e-3, atol=1e-5)
        assert not np.allclose(one.matrix, small.extractor.projections[layer].matrix[:, :4], rtol=0.1)


def test_wrong_matches_are_of_other_places_that_the_first_stage_confuses() -> None:
    # Three photographs far apart, one of them twice, and two pictures of one fixed camera.
    photograph, camera = (0, 1, 100, 200, 300, 400), ("", "", "", "", "lane", "lane")
    nothing = np.zeros((0, 2), np.int64)
    displacements = [
        Displacement(nothing, number, "displaced", name) for number, name in zip(photograph, camera, strict=True)
    ]
    likeness = np.random.default_rng(0).random((6, 6), np.float32)
    likeness[0, :] = (1, 0.9, 0.5, 0.6, 0.1, 0.7)  # its own, the next photograph, and others
    likeness[4, :] = (0.5, 0.1, 0.6, 0.2, 1, 0.9)
    cells = [np.eye(169, 8, k=-number, dtype=np.int8) + 1 for number in range(6)]
    wrong = _wrong_matches(Views(displacements, {}, {}, likeness), cells, cells, np.random.default_rng(1))
    assert {(asked, shown) for asked, _, shown, _ in wrong.tolist() if asked in (0, 4)} == {
        (0, 5), (0, 3), (0, 2), (4, 2), (4, 0), (4, 3),
    }  # fmt: skip


def test_a_discriminant_tells_wrong_matches_from_right_ones() -> None:
    # The first value differs most between wrong matches, but between right ones, too; the second tells them apart.
    within, between = np.diag([9.0, 0.1, 1.0]), np.diag([10.0, 2.0, 0.5])
    plain, shrunk = (discriminant(within, between, 2, shrinkage) for shrinkage in (0.0, 100.0))
    assert np.abs(plain).argmax(axis=0).tolist() == [1, 0]
    assert np.abs(shrunk).argmax(axis=0).tolist() == [0, 1]
    np.testing.assert_allclose(plain.T @ within @ plain, np.eye(2), atol=1e-5)


@pytest.mark.thorough
def test_refining_finds_the_directions_that_conditions_leave_alone(photographs: Path) -> None:
    generator = np.random.default_rng(3)
    spot = generator.standard_normal((20, 16, 4))
    sides = [np.concatenate([spot, generator.standard_normal((20, 16, 4))], axis=2) + 3 for _ in "ab"]
    pairs = PairedCells({"a": sides[0].astype(np.float32)}, {"a": sides[1].astype(np.float32)}, columns=4)
    matrix = generator.standard_normal((8, 4)).astype(np.float32)
    start = {"a": Projection(np.full(8, 0.3, np.float32), matrix)}
    refined, losses = refine(start, STAGE, pairs, steps=150)
    assert np.mean(losses[-10:]) < np.mean(losses[:10])

    def share(projection: Projection) -> float:
        return float(np.linalg.norm(projection.matrix[:4]) / np.linalg.norm(projection.matrix))

    assert share(refined["a"]) > share(start["a"])


def test_neighbouring_cells_are_no_negatives() -> None:
    touching = neighbours(9, 3)
    assert touching[4].sum() == 8
    assert touching[0].sum() == 3
    assert not touching.diagonal().any()
    clean = torch.nn.functional.normalize(torch.randn(1, 9, 5, generator=torch.Generator().manual_seed(0)), dim=2)
    # In a 3 x 3 frame the middle touches all others: nothing is left to tell it apart from.
    alone = contrastive_loss(clean, clean, ~torch.eye(9, dtype=torch.bool))
    assert float(alone) == pytest.approx(0, abs=1e-6)
    assert float(contrastive_loss(clean, clean, touching)) > 0


def test_cells_are_described_as_in_the_second_stage(photographs: Path) -> None:
    pairs = paired_cells(network("conv3"), photographs, crops=3)
    assert pairs.clean["conv3"].shape == pairs.augmented["conv3"].shape == (3, 169, 384)
    assert pairs.columns == 13
    generator = np.random.default_rng(0)
    projection = Projection(
        (generator.random(384) / 384).astype(np.float32), generator.standard_normal((384, 4)).astype(np.float32)
    )
    stage = STAGE.model_copy(update={"layers": ("conv3",)})
    cells = pairs.clean["conv3"][0].astype(np.float32)
    with torch.no_grad():
        made = CellDescriptor({"conv3": projection}, stage)([torch.from_numpy(cells)]).numpy()
    np.testing.assert_allclose(made, projection(cells, 4), atol=1e-3)


def test_the_curve_is_drawn_from_the_log(tmp_path: Path) -> None:
    log = tmp_path / "log.csv"
    log.write_text("crops,rate,loss,held_out_loss,seconds\n16000,0.1,1.2,1.1,9\n32000,0.1,1.1,1.0,18\n")
    draw_loss_curve(log, tmp_path / "curve.png")
    drawn = cv2.imread(str(tmp_path / "curve.png"))
    assert drawn is not None and drawn.std() > 5
    log.write_text("crops,rate,loss,held_out_loss,seconds\n")
    with pytest.raises(ValueError, match="no row"):
        draw_loss_curve(log, tmp_path / "curve.png")

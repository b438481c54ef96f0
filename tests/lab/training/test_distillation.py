"""A tiny run of the whole distillation on pictures made here; the student and the teacher."""

from __future__ import annotations

import csv
from functools import partial
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from safetensors.torch import load_file

from core.networks.torch_network import TorchNetwork
from lab.training.distillation import cosine_loss, distill, learning_rate
from lab.training.student import SCALE, Student
from lab.training.teacher import BLOCKS, Teacher

SIDE = 67
"""Of the crops, in pixels: both networks make 3 x 3 cells of them."""

small_run = partial(distill, batch=8, workers=0, side=SIDE, held_out_batches=1)


@pytest.fixture(scope="module")
def teacher_weights(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A MobileNetV1 of random values in the layout that is read."""
    generator = np.random.default_rng(1)

    def normal(*shape: int) -> NDArray[np.float32]:
        values: NDArray[np.float32] = generator.standard_normal(shape, np.float32)
        return values * np.float32(np.sqrt(2 / np.prod(shape[1:])))

    arrays = {"conv1/W": normal(32, 3, 3, 3), "conv1/b": np.zeros(32, np.float32)}
    inner = 32
    for block, _ in BLOCKS:
        outer = {"2_1": 64, "2_2": 128, "3_1": 128, "3_2": 256, "4_1": 256}.get(block, 512)
        arrays |= {f"conv{block}_dw/W": normal(inner, 3, 3), f"conv{block}_dw/b": np.zeros(inner, np.float32)}
        arrays |= {f"conv{block}_sep/W": normal(outer, inner, 1, 1), f"conv{block}_sep/b": np.zeros(outer, np.float32)}
        inner = outer
    path = tmp_path_factory.mktemp("teacher") / "teacher.npz"
    np.savez(path, allow_pickle=False, **arrays)
    return path


@pytest.mark.thorough
def test_a_run_in_two_sittings_equals_one(photographs: Path, teacher_weights: Path, tmp_path: Path) -> None:
    whole = small_run(photographs, teacher_weights, tmp_path / "one", crops=48)
    small_run(photographs, teacher_weights, tmp_path / "two", crops=48, stop_after=3)
    resumed = small_run(photographs, teacher_weights, tmp_path / "two", crops=48)
    first, second = load_file(whole), load_file(resumed)
    assert set(first) == {f"conv{n}.{kind}" for n in (1, 2, 3, 4) for kind in ("weight", "bias")}
    for name, tensor in first.items():
        torch.testing.assert_close(tensor, second[name], rtol=1e-3, atol=1e-4)
    rows = list(csv.DictReader((tmp_path / "two" / "log.csv").open()))
    assert [int(row["crops"]) for row in rows] == [24, 48]
    assert all(0 < float(row["held_out_loss"]) < 4 for row in rows)


@pytest.mark.thorough
def test_the_loss_falls(photographs: Path, teacher_weights: Path, tmp_path: Path) -> None:
    small_run(photographs, teacher_weights, tmp_path, crops=160, checkpoint_every=10)
    losses = [float(row["loss"]) for row in csv.DictReader((tmp_path / "log.csv").open())]
    assert losses[-1] < losses[0] - 0.1


@pytest.mark.thorough
def test_a_run_goes_on_from_earlier_weights(photographs: Path, teacher_weights: Path, tmp_path: Path) -> None:
    first = small_run(photographs, teacher_weights, tmp_path / "one", crops=64)
    second = small_run(photographs, teacher_weights, tmp_path / "two", crops=4000, start=first, stop_after=5)
    before, after = load_file(first), load_file(second)
    # The heads learn alone at first, so the backbone's features are still those that it started with.
    pixels = torch.rand(1, 3, SIDE, SIDE) * 255
    maps = []
    for weights in (before, after):
        network = TorchNetwork(Student().definition, ("conv4",))
        network.load_weights(weights)
        with torch.no_grad():
            maps.append(network((pixels - 115) * SCALE)[0].flatten())
    assert torch.nn.functional.cosine_similarity(maps[0], maps[1], dim=0) > 0.98


@pytest.mark.thorough
def test_loading_folded_weights_keeps_the_features() -> None:
    torch.manual_seed(1)
    student, other = Student(), Student()
    student.train()
    pixels = torch.rand(8, 3, SIDE, SIDE) * 255
    with torch.no_grad():
        student.features(pixels)
    student.eval()
    other.load_folded_weights(student.folded_weights(), pixels)
    other.eval()
    with torch.no_grad():
        for taken, original in zip(other.features(pixels), student.features(pixels), strict=True):
            torch.testing.assert_close(taken, original, rtol=1e-2, atol=1e-3)


@pytest.mark.thorough
def test_folding_keeps_the_features() -> None:
    torch.manual_seed(0)
    student = Student()
    student.train()
    with torch.no_grad():
        for _ in range(3):  # moves the running statistics away from their start
            student.features(torch.rand(8, 3, SIDE, SIDE) * 255)
    student.eval()
    network = TorchNetwork(student.definition, ("conv3", "conv4"))
    network.load_weights(student.folded_weights())
    pixels = torch.rand(1, 3, SIDE, SIDE) * 255
    with torch.no_grad():
        for folded, original in zip(network((pixels - student.mean) * SCALE), student.features(pixels), strict=True):
            torch.testing.assert_close(folded, original, rtol=1e-3, atol=1e-4)


def test_the_teacher_is_aligned_with_the_student(teacher_weights: Path) -> None:
    """A spot where the student has the centre of a cell stands in the same cell of the teacher's grid."""
    teacher = Teacher(teacher_weights)
    for module in teacher.modules():
        if isinstance(module, torch.nn.Conv2d):  # averages: what comes out is where it went in
            module.weight.data.fill_(1 / module.weight[0].numel())
    pixels = torch.zeros(1, 3, 227, 227)
    flat = teacher(pixels)[0]
    y, x = 17 + 16 * 4, 17 + 16 * 9
    pixels[:, :, y - 4 : y + 5, x - 4 : x + 5] = 255
    change = (teacher(pixels)[0] - flat).abs().sum(1)[0]
    assert change.shape == (13, 13)
    cells = torch.arange(13.0)
    centre = [float((change.sum(1 - axis) * cells).sum() / change.sum()) for axis in (0, 1)]
    assert centre == pytest.approx([4, 9], abs=0.25)


def test_the_learning_rate_rises_then_falls() -> None:
    rates = [learning_rate(step, 1000, 2e-3) for step in range(1000)]
    assert rates[0] < rates[19] == pytest.approx(2e-3)
    assert rates[-1] < 3e-5
    assert all(a >= b for a, b in pairwise(rates[20:]))


def test_cosine_loss_is_zero_for_parallel_and_two_for_opposite_maps() -> None:
    maps = torch.rand(2, 8, 3, 3) + 0.1
    assert cosine_loss(maps * 5, maps).item() == pytest.approx(0, abs=1e-6)
    assert cosine_loss(-maps, maps).item() == pytest.approx(2, abs=1e-6)

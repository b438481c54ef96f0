"""The training photographs: how they are split, cropped and augmented."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from lab.training.photographs import AugmentedCrops, day_and_night, random_crop, split_photographs
from lab.training.views.augmentation import STEPS, augment


def test_the_split_keeps_whole_cameras_out_and_never_overlaps(photographs: Path) -> None:
    split = split_photographs(photographs)
    assert not set(split.train) & set(split.held_out)
    cameras = {path.parent.name for path in split.held_out if "day_night" in path.parts}
    assert cameras == {"a"}
    assert any("day_night" not in path.parts for path in split.held_out)


def test_a_crop_depends_on_seed_and_number_alone(photographs: Path) -> None:
    paths = split_photographs(photographs).train
    early = AugmentedCrops(paths, photographs, 64, seed=3, start=0, stop=20)
    late = AugmentedCrops(paths, photographs, 64, seed=3, start=10, stop=20)
    for a, b in zip(early[15], late[5], strict=True):
        np.testing.assert_array_equal(a, b)
    assert not np.array_equal(early[15][0], early[16][0])


def test_a_fixed_camera_shows_the_same_crop_by_day_and_by_night(photographs: Path) -> None:
    paths = tuple(path for path in split_photographs(photographs).train if "day_night" in path.parts)
    cameras = day_and_night(paths, photographs)
    assert {path.name for path in cameras} == {"b", "c"}
    for days, nights in cameras.values():
        assert {path.name.split("_")[0] for path in days} == {"day"}
        assert {path.name.split("_")[0] for path in nights} == {"night"}


def test_mostly_the_teacher_sees_a_day_and_the_student_a_night(tmp_path: Path) -> None:
    generator = np.random.default_rng(0)
    for light, brightness in (("day", 190), ("night", 20)):
        for n in range(3):
            path = tmp_path / "day_night" / "yard" / f"{light}_{n}.png"
            path.parent.mkdir(parents=True, exist_ok=True)
            cv2.imwrite(str(path), generator.integers(brightness - 15, brightness + 15, (72, 96, 3), np.uint8))
    crops = AugmentedCrops(tuple(sorted(tmp_path.rglob("*.png"))), tmp_path, 64, seed=5, start=0, stop=80)
    pairs = [(clean.mean() > 150, shown.mean() < 100) for clean, shown in (crops[item] for item in range(80))]
    # If each picture made a pair with itself alone, half of the clean crops would be nights.
    assert sum(day and night for day, night in pairs) > 0.65 * len(pairs)


def test_a_crop_is_the_same_window_of_each_picture() -> None:
    y, x = np.mgrid[0:60, 0:80].astype(np.uint8)
    first = np.stack([x, y, x], axis=2)
    for seed in range(5):
        one, other = random_crop([first, 255 - first], 32, np.random.default_rng(seed))
        np.testing.assert_allclose(one.astype(int) + other, 255, atol=1)


@pytest.mark.parametrize("step", [step for _, step in STEPS], ids=lambda step: step.__name__)
def test_each_augmentation_changes_light_and_not_shape(step) -> None:  # type: ignore[no-untyped-def]
    image = np.random.default_rng(0).random((61, 83, 3)).astype(np.float32)
    made = step(image.copy(), np.random.default_rng(4))
    assert made.shape == image.shape
    assert np.isfinite(made).all()
    assert not np.allclose(made, image, atol=1e-4)


def test_augmenting_is_reproducible() -> None:
    pixels = np.random.default_rng(0).integers(0, 256, (40, 50, 3), np.uint8)
    first, again = (augment(pixels, np.random.default_rng(7)) for _ in range(2))
    np.testing.assert_array_equal(first, again)
    assert first.dtype == np.uint8

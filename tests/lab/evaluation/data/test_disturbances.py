from __future__ import annotations

import numpy as np
import pytest

from lab.evaluation.data.disturbances import (
    DISTURBANCES,
    GREY,
    Disturbance,
    blur,
    darkness,
    lateral_shift,
    noise,
    occlusion,
    scale,
)
from tests.service.scenes import scene

RANDOM = np.random.default_rng(0)


def by_name(name: str) -> Disturbance:
    return next(disturbance for disturbance in DISTURBANCES if disturbance.name == name)


@pytest.mark.parametrize("disturbance", DISTURBANCES, ids=lambda disturbance: disturbance.name)
def test_levels_rise_and_change_the_image_more_and_more(disturbance: Disturbance) -> None:
    pixels = scene(3, 160, 120)
    levels = disturbance.levels
    assert list(levels) == sorted(set(levels))
    assert disturbance.changed(pixels, levels[0], 0, 0) is pixels
    changed = [disturbance.changed(pixels, level, 0, 0) for level in levels]
    assert all(one.shape == pixels.shape and one.dtype == np.uint8 for one in changed)
    errors = [float(np.abs(one.astype(int) - pixels).mean()) for one in changed]
    # The same scene has smaller and larger structures, so that a shift need not rise strictly.
    assert errors[0] == 0 and errors[1] > 0.5 and errors[-1] > errors[1]


@pytest.mark.parametrize("disturbance", DISTURBANCES, ids=lambda disturbance: disturbance.name)
def test_a_seed_and_a_number_give_one_image(disturbance: Disturbance) -> None:
    pixels, level = scene(3, 80, 60), disturbance.levels[2]
    once, again = disturbance.changed(pixels, level, 5, 7), disturbance.changed(pixels, level, 5, 7)
    assert np.array_equal(once, again)
    others = [disturbance.changed(pixels, level, 5, 8), disturbance.changed(pixels, level, 6, 7)]
    random = disturbance.name in ("noise", "occlusion")
    assert [bool(np.array_equal(once, other)) for other in others] == [not random] * 2


def test_a_shift_by_hand() -> None:
    row = np.arange(10, dtype=np.uint8) * 10
    pixels = np.repeat(np.repeat(row[None, :, None], 4, axis=0), 3, axis=2)
    moved = lateral_shift(pixels, 20, RANDOM)
    assert moved[0, :, 0].tolist() == [20, 10, 0, 10, 20, 30, 40, 50, 60, 70]


def test_a_scale_by_hand() -> None:
    pixels = np.zeros((41, 41, 3), np.uint8)
    pixels[15:26, 15:26] = 200  # eleven pixels about the middle become some twenty-two
    grown = scale(pixels, 2, RANDOM)[:, :, 0]
    assert grown[20, 20] == 200
    assert np.count_nonzero(grown[20] > 100) in (21, 22, 23)
    assert np.array_equal(grown, grown[::-1])


def test_darkness_by_hand() -> None:
    pixels = np.full((2, 2, 3), 200, np.uint8)
    assert darkness(pixels, 75, RANDOM).max() == 50
    assert darkness(pixels, 95, RANDOM).max() == 10


def test_noise_has_its_deviation() -> None:
    pixels = np.full((200, 200, 3), 128, np.uint8)
    noisy = noise(pixels, 20, np.random.default_rng(1)).astype(float)
    assert noisy.std() == pytest.approx(20, rel=0.02)
    assert noisy.mean() == pytest.approx(128, abs=0.5)
    # More of it is the same noise, stronger.
    weak, strong = (by_name("noise").changed(pixels, level, 0, 0).astype(float) - 128 for level in (10, 20))
    assert np.corrcoef(weak.ravel(), strong.ravel())[0, 1] > 0.99


def test_blur_spreads_a_point_by_its_deviation() -> None:
    pixels = np.zeros((101, 100, 3), np.uint8)
    pixels[:, 50] = 255
    profile = blur(pixels, 3, RANDOM)[50, :, 0].astype(float)
    places = np.arange(100)
    assert np.sqrt((profile * (places - 50) ** 2).sum() / profile.sum()) == pytest.approx(3, rel=0.1)


@pytest.mark.parametrize("level", [10, 25, 60])
def test_an_occlusion_covers_its_share(level: float) -> None:
    pixels = np.full((120, 160, 3), 10, np.uint8)
    for seed in range(5):
        covered = occlusion(pixels, level, np.random.default_rng(seed))[:, :, 0] == GREY
        assert covered.mean() == pytest.approx(level / 100, abs=0.02)
        rows, columns = np.flatnonzero(covered.any(axis=1)), np.flatnonzero(covered.any(axis=0))
        assert covered[rows[0] : rows[-1] + 1, columns[0] : columns[-1] + 1].all()  # one box
    assert pixels.max() == 10  # the image itself stays

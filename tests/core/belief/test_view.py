"""What counts as a new view, and as none."""

from __future__ import annotations

import numpy as np
import pytest

from core.belief.view import NEW, STILL, View, novelty, view_of
from core.frames.masks import Mask
from core.frames.preprocessing import Pixels
from tests.service.scenes import blank, scene, seen_again

RANDOM = np.random.default_rng(0)


def noisy(level: float, deviation: float) -> Pixels:
    return np.asarray(np.clip(RANDOM.normal(level, deviation, (240, 320, 3)), 0, 255), np.uint8)


@pytest.mark.parametrize(
    ("pixels", "uniform"),
    [(blank(), True), (noisy(128, 2), True), (noisy(10, 8), True), (noisy(128, 30), True), (scene(1), False)],
)
def test_a_covered_lens_is_uniform_however_noisy(pixels: Pixels, uniform: bool) -> None:
    assert view_of(pixels).uniform == uniform


def test_noise_and_exposure_are_no_change_and_motion_is() -> None:
    first, picture = view_of(scene(1)), scene(1).astype(np.float64)
    darker = np.clip(0.8 * picture + 10 + RANDOM.normal(0, 5, picture.shape), 0, 255).astype(np.uint8)
    assert first.change(first) == 0 and first.change(view_of(darker)) < STILL
    shifts = [first.change(view_of(np.roll(scene(1), shift, axis=1))) for shift in (4, 16, 64)]
    assert STILL < shifts[0] < shifts[1] < shifts[2] <= 2
    assert first.change(view_of(seen_again(scene(1)))) < first.change(view_of(scene(2)))


def test_uniform_views_differ_from_all_others() -> None:
    black = view_of(blank())
    assert black.change(black) == black.change(view_of(scene(1))) == pytest.approx(np.sqrt(2))


def test_what_a_mask_hides_is_no_change() -> None:
    mask = Mask(polygons=(((0, 0.5), (1, 0.5), (1, 1), (0, 1)),))
    below = scene(1).copy()
    below[130:] = scene(2)[130:]
    assert view_of(scene(1)).change(view_of(below)) > STILL
    assert view_of(scene(1), mask).change(view_of(below, mask)) < STILL


def test_a_frame_counts_as_much_as_it_shows_what_is_new() -> None:
    assert [novelty(change) for change in (0.0, 0.9 * STILL, NEW, 2.0)] == [0, 0, 1, 1]
    assert novelty(NEW / 2) == pytest.approx(0.5)


def test_a_view_is_small() -> None:
    assert isinstance(view_of(scene(1)), View) and view_of(scene(1)).levels.nbytes < 1024

"""Threshold and margin from frames kept out of training, on scores made up for the purpose."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from core.judgement.encoder_calibration import calibrate, second_look
from core.judgement.verdict import Calibration, Judgement, judge
from core.places import Neighborhood, Whereabouts

N = 60


def made_up(seed: int = 0) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Unrelated frames score about 0.1 ± 0.02; neighbours 0.5, the frame itself 1; second looks a little less."""
    random = np.random.default_rng(seed)
    unknown = random.normal(0.1, 0.02, (N, N)).astype(np.float32)
    unknown = (unknown + unknown.T) / np.sqrt(2)
    unknown += np.float32(0.1 - unknown.mean())
    known = unknown.copy()
    near = np.abs(np.subtract.outer(np.arange(N), np.arange(N))) <= 2
    unknown[near], known[near] = 0.5, 0.4
    np.fill_diagonal(unknown, 1.0)
    np.fill_diagonal(known, 0.6)
    return unknown, known


def test_the_background_is_that_of_frames_that_are_apart() -> None:
    unknown, known = made_up()
    apart = np.abs(np.subtract.outer(np.arange(N), np.arange(N))) > 2
    made = calibrate(unknown, known, 2, "encoder-default")
    assert made.background_mean == pytest.approx(float(unknown[apart].mean()))
    assert made.background_deviation == pytest.approx(float(unknown[apart].std()))
    assert made.source == "encoder-default"


def verdict_on(scores: NDArray[np.float32], places: NDArray[np.intp], calibration: Calibration) -> str:
    """Of one query against a map of the frames ``places``."""
    return judged(scores, places, calibration).verdict


def judged(scores: NDArray[np.float32], places: NDArray[np.intp], calibration: Calibration) -> Judgement:
    """The same in full."""
    order = places[np.argsort(-scores[places], kind="stable")]
    n = len(order)
    frames = Whereabouts(np.zeros(n, np.int8), np.zeros((n, 3)), np.zeros(n, np.int32), order)
    return judge(scores[order], frames, calibration, Neighborhood(radius=0.0, frames=2))


def test_few_strangers_are_recognized_and_all_second_looks() -> None:
    unknown, known = made_up()
    made = calibrate(unknown, known, 2, "encoder-default")
    everywhere = np.arange(N)
    strangers = [verdict_on(unknown[i], everywhere[np.abs(everywhere - i) > 2], made) for i in range(N)]
    unknowns = strangers.count("unknown")
    assert 0.85 * N <= unknowns < N  # the threshold is not higher than it need be
    # The margin is the smallest lead but for 2 %: of 60 looks the one or two closest become ambiguous.
    looks = [verdict_on(known[i], everywhere, made) for i in range(N)]
    assert looks.count("recognized") >= 0.95 * N
    assert "unknown" not in looks
    assert 0.35 < made.margin < 0.5


def test_frames_that_are_all_alike() -> None:
    alike = np.ones((12, 12), np.float32)
    made = calibrate(alike, alike, 2, "encoder-default")
    assert made.background_deviation > 0
    assert np.isfinite(made.threshold)
    assert made.margin == 0.0


def test_too_few_frames() -> None:
    with pytest.raises(ValueError, match="too few"):
        calibrate(np.ones((3, 3), np.float32), np.ones((3, 3), np.float32), 2, "encoder-default")


@pytest.mark.parametrize("shape", [(16, 16, 3), (120, 160, 3)])
def test_a_second_look_is_another_picture_of_the_same_size(shape: tuple[int, int, int]) -> None:
    pixels = np.random.default_rng(0).integers(0, 256, shape, dtype=np.uint8)
    again = second_look(pixels)
    assert again.shape == shape
    assert again.dtype == np.uint8
    assert again.mean() < pixels.mean()


def test_the_curve_is_sure_of_second_looks_and_not_of_strangers() -> None:
    unknown, known = made_up()
    made = calibrate(unknown, known, 2, "encoder-default")
    assert made.curve is not None
    assert (made.decision, made.frames) == ("leading", N)
    looks = [judged(known[i], np.arange(N), made).probability for i in range(N)]
    strangers = [judged(unknown[i], np.flatnonzero(np.abs(np.arange(N) - i) > 2), made).probability for i in range(N)]
    assert np.median(np.array(looks, float)) > 0.9
    assert np.median(np.array(strangers, float)) < 0.1

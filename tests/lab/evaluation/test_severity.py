from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from core.frames.images import decode
from core.frames.preprocessing import Pixels
from core.frames.traverses import tolerance_truth
from core.method.catalogue import EncoderCatalogue
from lab.baselines.registry import build
from lab.evaluation.cache import EvaluationCache
from lab.evaluation.data.disturbances import Disturbance, darkness
from lab.evaluation.data.pairs import TraversePair
from lab.evaluation.severity import severity, severity_steps
from lab.evaluation.subject import Subject, Training
from tests.lab.evaluation.lookup import Lookup, load, write_images
from tests.service.scenes import encoded, scene

DIMMER = Disturbance("dimmer", "% gone", (0, 50, 90), darkness)


def made(folder: Path) -> TraversePair:
    references, queries = write_images(folder / "r", [0, 8, 16]), write_images(folder / "q", [0, 8, 16])
    return TraversePair("made", references, queries, tolerance_truth(3, 3, 0), np.arange(3))


def by_value() -> Lookup:
    """Rows by an image's value: 16 dimmed by half is 8, which looks like another place; 8 becomes 4, like itself."""
    table = np.zeros((17, 3), np.float32)
    table[0] = table[2] = [1, 0, 0]
    table[8] = [0, 1, 0]
    table[4] = [0, 0.9, 0]
    table[1] = [0, 0.5, 0]
    table[16] = [0, 0, 1]
    return Lookup(table)


def test_a_curve_by_hand(tmp_path: Path) -> None:
    pair = made(tmp_path)
    system = by_value()
    subject = Subject(system, pair, Training([], "nothing"), load)
    (curve,) = severity(subject, EvaluationCache(None), [DIMMER])
    assert (curve.disturbance, curve.system, curve.unit, curve.levels) == ("dimmer", "lookup", "% gone", [0, 50, 90])
    # By half: 0 → 0 right, 8 → 4 right, 16 → 8 wrong. By 90 %: 0 right, 8 → 1 right, 16 → 2, like place 0, wrong.
    assert curve.recall_at_1 == [1.0, 2 / 3, 2 / 3]
    assert curve.auc_pr[0] == 1.0
    # Best first: {1.0 right, 1.0 wrong}, 0.9 right: (0, 1), (1/2, 1/2), (1, 2/3).
    assert curve.auc_pr[1] == pytest.approx((1.5 / 2 + (1 / 2 + 2 / 3) / 2) / 2)
    assert system.described == 3 + 3 + 2 * 3
    assert severity_steps(subject, [DIMMER]) == 2 * 3 + 3 * 3  # described, and compared


def test_curves_are_cached(tmp_path: Path) -> None:
    pair, cache = made(tmp_path), EvaluationCache(tmp_path / "cache")
    first = severity(Subject(by_value(), pair, Training([], "nothing"), load), cache, [DIMMER])
    system = by_value()
    subject = Subject(system, pair, Training([], "nothing"), load)
    assert severity(subject, cache, [DIMMER]) == first
    assert system.described == 0
    severity(subject, cache, [DIMMER], seed=1)
    assert system.described == 12


def test_a_real_system_gets_worse_in_the_dark(tmp_path: Path) -> None:
    for name in ("r", "q"):
        (tmp_path / name).mkdir()
        for place in range(4):
            (tmp_path / name / f"{place}.png").write_bytes(encoded(scene(place, 96, 72), ".png"))

    def read(path: Path) -> Pixels:
        return decode(path.read_bytes())

    pair = TraversePair(
        "scenes",
        sorted((tmp_path / "r").iterdir()),
        sorted((tmp_path / "q").iterdir()),
        tolerance_truth(4, 4, 0),
        np.arange(4),
    )
    subject = Subject(build("hog", models=EncoderCatalogue()), pair, Training([], "nothing"), read)
    gone = Disturbance("darkness", "%", (0, 50, 100), darkness)
    (curve,) = severity(subject, EvaluationCache(None), [gone])
    assert curve.recall_at_1 == [1.0, 1.0, 0.25]  # gradients survive half the light; of black frames one is right

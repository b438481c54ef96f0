"""Trials for a map's calibration where a ranking is a shortlist, against rankings of all places."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from core.judgement.calibration import adjust_calibration
from core.judgement.probability import Curve
from core.judgement.trials import Trials
from core.maps import Enrolment, MapSettings
from core.method.encoder import Encoder
from core.places import PlaceFields, Pose
from core.recognition.calibration import calibration_warnings, queries_from_map, run_trials
from core.store import Directory
from tests.core.judgement.test_calibration import BASE, PRECISE, drawn

PLACES, QUERIES = 400, 30


def walk(encoder: Encoder) -> list[Enrolment]:
    """A place every 20 cm, so that 150 of them are around one; what they show changes slowly."""
    random = np.random.default_rng(0)
    steps = random.standard_normal((PLACES + 30, encoder.dimension)).astype(np.float32)
    cells = random.normal(0, 30, (PLACES + 30, *encoder.local_shape))
    made = []
    for i in range(PLACES):
        weights = np.exp(-(np.linspace(-2, 2, 30) ** 2)).astype(np.float32)
        descriptor = weights @ steps[i : i + 30]
        local = np.clip(np.tensordot(weights, cells[i : i + 30], 1) / 3, -127, 127).astype(np.int8)
        fields = PlaceFields(pose=Pose(x=0.2 * i, y=0))
        unit = descriptor / np.linalg.norm(descriptor)
        made.append(Enrolment(f"p{i}", fields, unit, 600, i.to_bytes(32, "big"), local=local))
    return made


def trials(folder: Path, encoder: Encoder, index: str) -> Trials:
    atlas = Directory(folder)
    settings = MapSettings(keep="none", index=index)  # type: ignore[arg-type]
    dense = atlas.create("dense", encoder.identity, encoder.dimension, settings, encoder.local_shape)
    dense.enrol(walk(encoder))
    snapshot = dense.snapshot()
    queries = queries_from_map(dense, snapshot, QUERIES)
    found = run_trials(dense, encoder, snapshot, queries, encoder.calibration, lambda _done, _all: None)
    atlas.close()
    return found.two


@pytest.mark.thorough
def test_a_place_without_its_surroundings_is_tried_in_a_dense_map(
    tmp_path: Path, encoder: Encoder, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("core.store.snapshot.SHORTLIST", 40)
    exact, compact = trials(tmp_path / "exact", encoder, "exact"), trials(tmp_path / "compact", encoder, "compact")
    assert len(compact) == len(exact) == 2 * QUERIES
    np.testing.assert_array_equal(compact.known, exact.known)
    np.testing.assert_array_equal(compact.right, exact.right)
    assert np.isclose(compact.decision, exact.decision, atol=0.01).mean() > 0.9


def test_a_precision_that_held_out_answers_do_not_have_is_warned_of() -> None:
    believing = BASE.model_copy(update={"curve": Curve(slope=60, intercept=-2), "threshold": 0.02})
    plain, precise = (adjust_calibration(drawn(200), believing, "runs", one) for one in (None, PRECISE))
    held = plain.measurement.cross_validated.precision
    assert held.high < 0.95 <= precise.measurement.cross_validated.precision.high
    told = calibration_warnings(plain, "runs", PRECISE)[-1]
    assert f"Only {held.value:.0%} of the answers" in told and "the 95% of the target" in told
    assert not any("of the target" in one for one in calibration_warnings(precise, "runs", PRECISE))
    assert not any("of the target" in one for one in calibration_warnings(plain, "runs", None))

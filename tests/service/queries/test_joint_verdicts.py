"""The verdict over several maps: it and its probability never disagree."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any, cast

import pytest

from core.judgement.probability import sigmoid
from core.judgement.verdict import Judgement
from core.places import Whereabouts
from service.queries.multi_map import MapReport, judge_together
from tests.core.judgement.test_fusion import CALIBRATION


def report(name: str, log_odds: float, evidence: float | None = None) -> MapReport:
    """The answer of a map that recognizes a place without a pose."""
    probability = float(sigmoid(cast(Any, log_odds)))
    judgement = Judgement("recognized", 0.5, 0.3, None, None, probability, evidence=evidence)
    candidates = SimpleNamespace(whereabouts=Whereabouts.along_sequence([0]))
    answer = SimpleNamespace(judgement=judgement, calibration=CALIBRATION, candidates=candidates, matches=[(0.5, None)])
    settings = SimpleNamespace(same_place_radius=5.0, same_place_frames=3, same_place_height=1.5)
    return MapReport(name, cast(Any, SimpleNamespace(record=settings)), cast(Any, answer))


@pytest.mark.parametrize("evidence", [None, 40.0])
def test_what_several_maps_recognize_is_as_likely_as_the_threshold_demands(evidence: float | None) -> None:
    """Each of the others is less than a quarter as likely as the best, but together they outweigh it."""
    alone = judge_together([report("best", 0.1, evidence)])
    assert alone.verdict == "recognized"
    many = judge_together([report("best", 0.1, evidence), *(report(f"other-{n}", -1.4) for n in range(6))])
    assert many.verdict == "ambiguous"
    assert many.probability is not None and many.probability < 0.5


def test_an_ambiguous_answer_of_two_maps_is_no_likelier_than_a_half() -> None:
    found = judge_together([report("best", 9.0), report("other", 8.0)])
    assert (found.verdict, found.probability) == ("ambiguous", 0.5)
    assert judge_together([report("best", 9.0), report("other", 5.0)]).verdict == "recognized"

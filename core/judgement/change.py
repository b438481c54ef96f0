"""Whether a frame shows the map as it is, as it was, or something else: known, changed or new.

A frame is *known* if it shows a place of the map as one of its looks does, *changed* if it shows a place that looks
different from all of them, and *new* if the map does not have what it shows.  Two things tell:

* the log odds L that the best match is right, of all stages, which the verdict has weighed already (``verdict.py``);
* the score s of the best match beside the usual score u of frames that were recognized at its place, or in the map:
  r = log(s / u), which counts by the share h = n / (n + SHRINKING) with n frames seen.

The frame is in the map, and known if it is, with the probabilities

    P = P(in the map) = σ(IN_MAP · L + AT_HOME),
    Q = P(known | in the map) = σ((1 - h) · (SURE · L + UNSEEN) + h · (USUAL · r + SEEN)),

so that known is P · Q, changed P · (1 - Q) and new 1 - P; Q is kept between 0.05 and 0.95, for neither scores nor
odds make it surer.  Both rise with L and r: a frame that matches better is never less known.  What lies between
what is known and what is new is changed.

Without a history, odds hardly tell a changed place from one of a map that looks alike everywhere: the known frames
of a corridor have lower odds than a street's changed ones.  Then UNSEEN, at least 0, leaves a frame known whose
match is rather right than wrong, and that P · (1 - Q) is hardly less says that this is not sure.  The history of
the map or of the place tells, as it grows.  In an ``unknown`` answer, whose match a strict threshold does not
believe, odds over 0 do not count for known.

The frames of a run say more.  A belief weighs by itself whether the robot sees the map, from all frames; it takes
the place of P, and where it is sure of another place than the best match, the frame alone does not know its place.
Then Q is as small as it gets, and no smaller, for single frames match wrong places on usual days, too.  To weigh
the frame's P beside the belief, one to nine, was tried, and is no better.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

import numpy as np

from core.judgement.probability import sigmoid
from core.judgement.verdict import Calibration, Judgement, log_odds_of

ChangeVerdict = Literal["known", "changed", "new"]

IN_MAP, AT_HOME = 0.62, 0.25
SURE, UNSEEN = 0.08, 0.0
USUAL, SEEN = 6.26, 2.3
"""Fitted by ``benchmarks.learning.change`` to worlds of training data.  With one of the four left out, the numbers lie
within 0.57 to 0.82, -0.52 to 0.67, 0.05 to 0.11, 0 alone (its bound), 5.85 to 7.45 and 2.18 to 2.39."""

SURELY = 8.0
"""Log odds count up to this, either way."""

DIFFERS = 2.0
"""Logarithms of ratios of scores count up to this, either way."""

SHRINKING = 4.0
"""With so many recognized frames, their usual score counts by half."""

SUREST = (0.05, 0.95)
"""Between these lies P(known | in the map), whatever a frame or a run says.  Worlds of training data that
are left out of the fit lose less than 0.01 in log loss by it."""

NEW = 0.5
"""A frame is called new from this probability on."""

LEAST = 1e-3
"""Scores under it count as this."""


@dataclass(frozen=True)
class UsualScore:
    """The usual score of recognized frames of a place, or of a map.

    count: how many there were.
    total: the sum of their scores by the first two stages.
    """

    count: int = 0
    total: float = 0.0

    @property
    def mean(self) -> float | None:
        """None if there were none."""
        return self.total / self.count if self.count else None

    def within(self, whole: UsualScore) -> UsualScore:
        """The usual score of a place, with that of its map as if SHRINKING frames had it."""
        mean = whole.mean
        if mean is None:
            return self
        weight = min(SHRINKING, whole.count)
        return UsualScore(self.count + round(weight), self.total + round(weight) * mean)

    def __add__(self, other: UsualScore) -> UsualScore:
        return UsualScore(self.count + other.count, self.total + other.total)


@dataclass(frozen=True)
class WorldChange:
    """The probabilities that a frame is known, changed or new, which sum to 1."""

    known: float
    changed: float
    new: float

    @property
    def verdict(self) -> ChangeVerdict:
        """``new`` if that is a half at least, otherwise the more probable of ``known`` and ``changed``."""
        if self.new >= NEW:
            return "new"
        return "known" if self.known > self.changed else "changed"

    def during(self, unknown: float, agreement: float) -> WorldChange:
        """The change by a run: the belief says whether the robot sees the map, the frame whether it looks as ever.

        Args:
            unknown: the probability by the run that the robot does not see the map.
            agreement: the probability by the run, if the robot sees the map, that it is at the frame's best match.
        """
        there = self.known + self.changed
        usual = _doubted(agreement * (self.known / there if there > 0 else 0.0))
        return WorldChange((1 - unknown) * usual, (1 - unknown) * (1 - usual), unknown)


def difference(score: float, usual: UsualScore) -> float:
    """r, the logarithm of a score over the usual one; 0 if none is known."""
    mean = usual.mean
    if mean is None:
        return 0.0
    return min(max(math.log(max(score, LEAST) / max(mean, LEAST)), -DIFFERS), DIFFERS)


def log_odds_in_map(judgement: Judgement, calibration: Calibration) -> float | None:
    """L, the log odds that the best match is right; None without a match, or if the calibration has no curve.

    Where rivals explain that nothing stands out, the frame is as one that just does.
    """
    if judgement.decision is None or calibration.curve is None:
        return None
    stated = log_odds_of(judgement.decision, judgement.lead, calibration, judgement.imagined, judgement.evidence)
    if stated is None:
        return None
    odds = float(stated)
    if judgement.verdict == "ambiguous":
        odds = max(odds, float(calibration.curve.log_odds(calibration.threshold)))
    return min(max(odds, -SURELY), SURELY)


def change_of(
    judgement: Judgement, calibration: Calibration, score: float, usual: UsualScore = UsualScore()
) -> WorldChange | None:
    """The change that a single frame shows; None without a match, or if the calibration has no curve.

    Args:
        score: of the best match, by the first two stages.
        usual: of the frames that were recognized at its place before, or in its map.
    """
    odds = log_odds_in_map(judgement, calibration)
    if odds is None:
        return None
    seen = usual.count / (usual.count + SHRINKING)
    believed = min(odds, 0.0) if judgement.verdict == "unknown" else odds
    as_usual = (1 - seen) * (SURE * believed + UNSEEN) + seen * (USUAL * difference(score, usual) + SEEN)
    there, same = sigmoid(np.array([IN_MAP * odds + AT_HOME, as_usual])).tolist()
    same = _doubted(same)
    return WorldChange(there * same, there * (1 - same), 1 - there)


def _doubted(known: float) -> float:
    """P(known | in the map), no surer than it can be."""
    return min(max(known, SUREST[0]), SUREST[1])

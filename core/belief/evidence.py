"""The evidence of one frame about every place: log likelihood ratios from the scores of a search.

A score means little by itself, so it is compared with two other scores of the same frame: the mean score of listed
places other than the best match's (a place with this score is no likelier than one that is not listed), and the
*believable* score, at which the single-frame verdict would just accept a best match.  Evidence grows in proportion to
the score and is STRENGTH at the believable score.  Places that are not listed have the background's evidence, 0: a
compact index returns only about the best hundred, and a second stage compares only its candidates.

On traverses of camvid and nordland_tiny the true place's score is distributed so that its log likelihood ratio grows by
about 5 from the mean score to the believable one, and flattens at 7 to 8; a true place that is not listed has -1 to -2.
Consecutive frames show the same things and lead to the same mistakes, so that less than half of that is counted.  How
much a frame shows that the last one did not is for ``view`` to say.  A frame that is recognized by itself is a sighting
as well, which ``estimate`` holds against the belief.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from core.judgement.background import GUARD_FACTOR
from core.judgement.verdict import Calibration, Judgement
from core.places import NO_SEQUENCE, Neighborhood, Whereabouts
from core.recognition.recognition import Answer

LISTED = 100
"""Without a second stage, this many places are listed; every index returns as many."""

STRENGTH = 2.0
"""Log likelihood ratio of a place at the believable score against one in the background.  ``filter.LEAVING`` says what
2.5 was chosen on, with the second stage of 0.1.0; today's examines the most promising places, whose scores lie closer
together.  2.0 was chosen on nordland_tiny.  With 1.4 a run on lip6 has 30 errors in place of 37, where single frames
have 61, but it takes longer to be sure of a place, and its probabilities are off by twice as much."""

STRONGEST = 8.0
"""Largest log likelihood ratio that a frame gives to a place; 6 and 12 give the same results."""

VERIFIED, LEAST_VERIFIED, MOST_VERIFIED = 45.0, -2.0, 2.5
"""Geometric evidence e changes the log likelihood ratio of a place by log(1 + e) - log(1 + VERIFIED), within these
bounds, of which half is counted as of the score's.  On camvid and tower, cropped and changed in light, candidates that
show the place and others are as frequent at 30 to 60; the ratio is -1.5 to -2.7 at 0 and 1.2 to 3.9 over 200, and about
the same whatever the score is."""

UNKNOWN = 1.0
"""Log likelihood ratio of not being in the map to a place in the background, besides what the other places of the map
gain on average: in a small map most places are listed, and some score well by chance.  ``filter.LEAVING`` says what it
was chosen on."""


@dataclass(frozen=True)
class Sighting:
    """The place where a frame was taken, as a frame recognized by itself gives it.

    row: of the map, the place that it shows.
    probability: that it does, whatever came before.
    """

    row: int
    probability: float


@dataclass(frozen=True)
class Evidence:
    """The evidence of one frame; the background's log likelihood is 0.

    rows: int64 [k], rows of the map.
    gains: float32 [k], over 0: the log likelihood ratio of those places to the background.
    unknown: the log likelihood ratio of not being in the map to the background.
    sighting: None if the frame is not recognized by itself.
    storeys: int64 [m], rows of places on different storeys that the frame may as well show, so that it says where on
        its storey the robot is, and nothing of which storey that is; empty if there is no doubt.
    """

    rows: NDArray[np.int64]
    gains: NDArray[np.float32]
    unknown: float
    sighting: Sighting | None = None
    storeys: NDArray[np.int64] = field(default_factory=lambda: np.empty(0, np.int64))

    def tempered(self, weight: float) -> Evidence:
        """The evidence with every log likelihood ratio multiplied by ``weight``."""
        return replace(self, gains=self.gains * np.float32(weight), unknown=self.unknown * weight)

    def strongest(self, count: int) -> Evidence:
        """The evidence for the ``count`` places that gain most."""
        if len(self.rows) <= count:
            return self
        best = np.argpartition(-self.gains, count)[:count]
        return replace(self, rows=self.rows[best], gains=self.gains[best])


NOTHING = Evidence(np.empty(0, np.int64), np.empty(0, np.float32), 0.0)
"""The evidence of a frame that says nothing: one without regions, or one in an empty map."""


def evidence_of(answer: Answer, neighborhood: Neighborhood) -> Evidence:
    """The evidence of a frame that was answered alone."""
    ranked = answer.candidates
    seen = evidence(
        ranked.rows,
        ranked.scores,
        ranked.whereabouts,
        answer.calibration,
        neighborhood,
        ranked.examined,
        None if ranked.geometry is None else ranked.geometry.evidence,
        [place for group in answer.judgement.rivals if group.same_place for place in group.positions],
    )
    if answer.judgement.twins:
        seen = replace(seen, storeys=ranked.rows[[0, *answer.judgement.twins]])
    return sighted(seen, ranked.rows, answer.judgement)


def sighted(seen: Evidence, rows: NDArray[np.int64], judgement: Judgement) -> Evidence:
    """Evidence with the sighting of a frame, if its verdict is ``recognized`` and says how probable it is.

    Args:
        rows: int64 [n], of the ranking that was judged, best first.
    """
    if judgement.verdict != "recognized" or judgement.probability is None:
        return seen
    return replace(seen, sighting=Sighting(int(rows[0]), judgement.probability))


def evidence(
    rows: NDArray[np.int64],
    scores: NDArray[np.floating],
    whereabouts: Whereabouts,
    calibration: Calibration,
    neighborhood: Neighborhood,
    examined: NDArray[np.bool_] | None = None,
    verified: NDArray[np.float64] | None = None,
    rivals: Sequence[int] = (),
) -> Evidence:
    """The evidence of a search.

    Args:
        rows, scores: int64 [n] and float [n], of two stages, best first, or in the order of three; the best LISTED
            suffice.
        whereabouts: of the same n places.
        calibration: by which the frame is judged.
        neighborhood: which places are the same place.
        examined: bool [n], which of them the encoder's second stage has examined; None, or none of them: it has no
            second stage.
        verified: float64 [n], the results of their geometric verification (``core.geometry.verification``), -ln of the
            number of false alarms; NaN where a place was not verified; other frames of its view may then count.
            None: none was.
        rivals: positions of places that show what the best match shows, as another traverse's do.  A robot is at one of
            them or at the best match, and in the map: they gain together what the best match would without them.
    """
    if len(rows) == 0:
        return NOTHING
    second_stage = examined is not None and bool(examined.any())
    listed = np.flatnonzero(examined) if examined is not None and second_stage else np.arange(min(len(rows), LISTED))
    values = scores[listed].astype(np.float64)
    best = int(listed[0])
    others = whereabouts.others(best, neighborhood, across=False)
    apart = ~whereabouts.near(best, neighborhood.times(GUARD_FACTOR))

    def ratios_beside(others: NDArray[np.bool_], apart: NDArray[np.bool_]) -> NDArray[np.float64]:
        rest = values[others[listed]]
        ordinary, believable = believable_score(rest, int(others.sum()), calibration, values[apart[listed]])
        return STRENGTH * (values - ordinary) / (believable - ordinary)

    ratios = ratios_beside(others, apart)
    if rivals:
        alike = np.logical_or.reduce([whereabouts.near(one, neighborhood) for one in rivals])
        others, apart = others & ~alike, apart & ~alike
        raised = min(float(ratios_beside(others, apart)[0]), STRONGEST) - float(ratios[0])
        ratios[(alike | whereabouts.near(best, neighborhood))[listed]] += max(0.0, raised)
    if verified is not None:
        found = np.log1p(_of_views(verified[listed], whereabouts.take(listed))) - np.log1p(VERIFIED)
        ratios += np.nan_to_num(0.5 * np.clip(found, LEAST_VERIFIED, MOST_VERIFIED))
    gains = np.minimum(ratios, STRONGEST).astype(np.float32)
    gaining = gains > 0
    beside = others[listed] & gaining
    ordinarily = 1 + float((np.exp(gains[beside]) - 1).sum()) / max(int(others.sum()), 1)
    return Evidence(rows[listed][gaining], gains[gaining], UNKNOWN + float(np.log(ordinarily)))


def _of_views(verified: NDArray[np.float64], where: Whereabouts) -> NDArray[np.float64]:
    """Evidence of verification for n places, or the largest for other frames of the same view; NaN without either."""
    _, view = np.unique(where.view_keys(), return_inverse=True)
    most = np.full(len(verified), np.nan)
    np.fmax.at(most, view, verified)
    return np.where(np.isnan(verified) & (where.sequence != NO_SEQUENCE), most[view], verified)


def believable_score(
    rest: NDArray[np.float64], others: int, calibration: Calibration, apart: NDArray[np.float64] | None = None
) -> tuple[float, float]:
    """The mean score of the rest, and the least score at which a best match would be accepted beside that rest.

    The second solves the verdict's rule threshold² = s · (s - top) for s, where top is the mean of the best few of the
    rest.

    Args:
        rest: float64 [n], best first: scores of listed places other than the best match's.
        others: how many other places the map has, at least n.
        apart: float64 [m], the scores of those of them that cannot overlap with the best match; None: all.
    """
    behind = calibration.background(rest, others, apart)
    ordinary, top = float(behind.scores.mean()), behind.top
    spread = max(float(behind.scores.std()), 0.1 * calibration.background_deviation)
    positive = max(top, 0.0)
    believable = (positive + np.sqrt(positive**2 + 4 * max(calibration.threshold, 0.0) ** 2)) / 2
    return ordinary, float(max(believable, ordinary + 0.5 * spread))

"""Several frames of one moment as one query, and several maps as one answer: evidence added up as log odds.

*Cameras of a rig.*  A place is what :meth:`Whereabouts.near` calls one.  Held against the places outside it, a
camera's best score within a place gives a decision value, and the calibrated curve its log odds x.  A camera that
does not recognise a place says little against it: it may be covered, or look where nobody took a frame.  With the
probability e it says nothing at all, so that its part is

    log((1 - e) · exp(x) + e)  >=  log e,

and the log odds of a place are the sum of its cameras' parts.  Cameras are taken for independent given the place,
which they are not altogether: they share the light and the weather.  A rig of one camera is a plain query.

*Maps.*  Each map's best match has the log odds x_m of being right.  Different places cannot both be where the frame
was taken, and none of them may be: the probability of match m is exp(x_m) / (1 + Σ exp(x_j)).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from core.judgement.priors import decision_slope, log_odds, log_odds_per_score
from core.judgement.probability import FARTHEST
from core.judgement.verdict import Calibration, Judgement, Verdict, leading, standing_out
from core.places import Neighborhood, Whereabouts

Values = NDArray[np.float64]

BLIND = 0.3
"""e: how often a camera of a rig says nothing of the place where it is."""

LISTED = 50
"""Places of each camera's ranking that count where there is no second stage."""

ALIKE = float(np.log(4))
"""Two maps' places whose log odds differ by less are not told apart: one is less than four times as likely."""


@dataclass(frozen=True)
class View:
    """What one camera of a rig found.

    rows: int64 [n], best first, their scores, float32 [n], and where they are.
    examined: bool [n], which of them the second stage has compared; none: there is none.
    weights: float64 [n], log prior of the places, the same for all cameras; None: nothing is known.
    """

    rows: NDArray[np.int64]
    scores: NDArray[np.float32]
    whereabouts: Whereabouts
    examined: NDArray[np.bool_]
    weights: Values | None = None

    def listed(self) -> NDArray[np.int64]:
        """Positions of the places whose scores can be compared with each other."""
        return np.flatnonzero(self.examined) if self.examined.any() else np.arange(min(LISTED, len(self.rows)))


@dataclass(frozen=True)
class Fused:
    """What all cameras together found.

    rows: int64 [n], best first, and where they are.
    scores: float32 [n], the best that any camera gives to each.
    log_odds: float64 [n], descending, of the places by all cameras and what was known.
    weights: float64 [n], log prior of the places; zeros if nothing was known.
    """

    judgement: Judgement
    rows: NDArray[np.int64]
    whereabouts: Whereabouts
    scores: NDArray[np.float32]
    log_odds: Values
    weights: Values


def fuse(views: Sequence[View], calibration: Calibration, neighborhood: Neighborhood, second_stage: bool) -> Fused:
    """One judgement from what several cameras found in one map.

    Args:
        views: of the cameras that have something to say; at least one, each with at least one place.
        second_stage: whether the encoder has one.
    """
    listed = [view.listed() for view in views]
    rows, first = np.unique(
        np.concatenate([view.rows[part] for view, part in zip(views, listed, strict=True)]), return_index=True
    )
    places = joined([view.whereabouts.take(part) for view, part in zip(views, listed, strict=True)]).take(first)
    scores = np.full((len(views), len(rows)), -np.inf)
    for camera, (view, part) in enumerate(zip(views, listed, strict=True)):
        scores[camera, np.searchsorted(rows, view.rows[part])] = view.scores[part]
    near = np.stack([places.near(i, neighborhood) for i in range(len(rows))])
    of_place = _added(np.stack([_camera_log_odds(row, near, calibration, second_stage) for row in scores]))
    prior = np.concatenate(
        [
            np.zeros(len(part)) if view.weights is None else view.weights[part]
            for view, part in zip(views, listed, strict=True)
        ]
    )[first]
    of_place += np.where(near, prior, -np.inf).max(axis=1)
    steepness = log_odds_per_score(calibration, second_stage)
    # Frames of one place share its evidence; among them those come first that the cameras are like themselves.
    lowest = np.where(np.isfinite(scores), scores, np.inf).min(axis=1, keepdims=True)
    own = np.where(np.isfinite(scores), scores, lowest)
    behind = np.stack([np.where(near, row, -np.inf).max(axis=1) for row in own]) - own
    total = of_place - steepness * behind.mean(axis=0)
    # Places that lead in no camera's eyes have the same odds, and are told by their scores.
    order = np.lexsort((-own.mean(axis=0), -np.round(total, 9)))
    found = scores.max(axis=0)[order].astype(np.float32)
    judgement = _judged(of_place[order], found, near[order[0]][order], calibration, steepness)
    return Fused(judgement, rows[order], places.take(order), found, total[order], prior[order])


def joined(parts: Sequence[Whereabouts]) -> Whereabouts:
    """One after the other; at least one."""
    return Whereabouts(
        *(
            np.concatenate([getattr(part, name) for part in parts])
            for name in ("kind", "position", "sequence", "ordinal", "heading", "timestamp")
        )
    )


def _camera_log_odds(scores: Values, near: NDArray[np.bool_], calibration: Calibration, second_stage: bool) -> Values:
    """Of each place by one camera: float64 [n], from its scores [n] (-inf: not listed) and who is near whom, [n, n]."""
    found = np.empty(len(scores))
    for place, same in enumerate(near):
        best = float(scores[same].max())
        rest = np.sort(scores[~same & np.isfinite(scores)])[::-1].astype(np.float32)
        if not np.isfinite(best):
            best = min(calibration.background_mean, float(rest[0]) if len(rest) else np.inf)
        if second_stage or calibration.decision == "leading":
            decision = leading(best, rest, calibration)
        else:
            decision = standing_out(best, rest, calibration, is_part=True)
        found[place] = log_odds(decision, calibration)
    return found


def _added(parts: Values) -> Values:
    """Σ log((1 - e) · exp(x) + e) over cameras, float64 [C, n] to [n]; x itself where there is one camera."""
    if len(parts) == 1:
        return np.asarray(parts[0], np.float64)
    return np.asarray(np.logaddexp(np.log1p(-BLIND) + parts, np.log(BLIND)).sum(axis=0), np.float64)


def _judged(
    log_odds_of_places: Values,
    scores: NDArray[np.float32],
    same: NDArray[np.bool_],
    calibration: Calibration,
    steepness: float,
) -> Judgement:
    """The verdict on the first of places in order; ``same`` says which of them are its place, too.

    Besides by a margin that is too small it is ambiguous if the best rival would be believed by itself.
    """
    best = float(log_odds_of_places[0])
    others = np.flatnonzero(~same)
    rival, margin = None, None
    if len(others):
        rival = int(others[np.argmax(log_odds_of_places[others])])
        margin = max(0.0, (best - float(log_odds_of_places[rival])) / steepness)
    least = log_odds(calibration.threshold, calibration)
    decision = calibration.threshold + (best - least) / decision_slope(calibration)
    verdict: Verdict = "recognized"
    if best < least:
        verdict = "unknown"
    elif margin is not None and margin < calibration.margin:
        verdict = "ambiguous"
    elif rival is not None and log_odds_of_places[rival] >= least:
        verdict = "ambiguous"  # one camera says this and another that, each of which would be believed alone
    probability = None
    if calibration.curve is not None:
        rivals = () if rival is None else (float(log_odds_of_places[rival]),)
        probability = float(joint_probabilities([best, *rivals])[0])
    return Judgement(verdict, float(scores[0]), decision, margin, rival, probability)


def joint_probabilities(log_odds_of_matches: Sequence[float]) -> Values:
    """exp(x_m) / (1 + Σ exp(x_j)) of matches that exclude each other; float64 [m], adding up to less than 1."""
    x = np.clip(np.asarray(log_odds_of_matches, np.float64), -FARTHEST, FARTHEST)
    total = np.logaddexp.reduce(np.append(x, 0.0))
    return np.asarray(np.exp(x - total), np.float64)


def log_odds_of(judgement: Judgement, calibration: Calibration) -> float:
    """The log odds of a best match: by its probability or, without a calibrated curve, by its decision value alone."""
    if judgement.probability is not None:
        probability = min(max(judgement.probability, 1e-15), 1 - 1e-15)
        return float(np.log(probability) - np.log1p(-probability))
    return -FARTHEST if judgement.decision is None else log_odds(judgement.decision, calibration)

"""The fusion of several frames of one moment into one query, and of several maps' answers into one.

*Cameras of a rig.*  Frames that are near each other by :meth:`Whereabouts.near` are one place.  Compared with the
places outside it, a camera's best score within a place gives a decision value, and the calibrated curve its log odds x.
A camera that does not recognize a place says little against it: its view may be blocked, or it may look where no frame
was taken.  With the probability e it says nothing at all, so that it contributes

    log((1 - e) · exp(x) + e)  >=  log e,

and the log odds of a place are the sum over the cameras.  Where a camera's candidates were verified, x has the evidence
of the place and its lead as well (``geometry.py``).  Leads of cameras that see one scene say nearly the same, so that
of each counts by its share of the cameras.  The evidence is 0 of a place that could not win any more; so the candidates
of all cameras are verified where those of one are (``core.recognition.rigs``).  Cameras are
assumed to be independent given the place, which is not quite true, since they share the light and the weather.  A rig
of one camera is a plain query.

*Maps.*  Each map's best match has the log odds x_m of being right.  At most one of the maps' matches can be right, and
perhaps none is: the probability of match m is exp(x_m) / (1 + Σ exp(x_j)).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from core.judgement.background import GUARD_FACTOR
from core.judgement.geometry import Geometry, share_of_lead
from core.judgement.priors import decision_slope, log_odds
from core.judgement.probability import FARTHEST
from core.judgement.verdict import MOST_RIVALS, Calibration, Judgement, Rivals, Verdict
from core.places import Neighborhood, Whereabouts

Values = NDArray[np.float64]

BLIND = 0.3
"""e, the probability that a camera of a rig says nothing about the place where it is."""

LISTED = 50
"""Without a second stage, this many places of each camera's ranking count."""

ALIKE = float(np.log(4))
"""If the log odds of two maps' places, or of two verified places of a rig, differ by less than this (a factor of four
in the odds), the answer is ambiguous."""


@dataclass(frozen=True)
class CameraRanking:
    """The ranking of one camera of a rig.

    rows: int64 [n], rows of the map, best first.
    scores: float32 [n].
    whereabouts: of the n places.
    examined: bool [n], which of them the second stage has compared; none if the encoder has no second stage.
    weights: float64 [n], log prior of the places, the same for all cameras; None: there is no prior.
    geometry: the results of verification for the n places; None: none was verified.
    """

    rows: NDArray[np.int64]
    scores: NDArray[np.float32]
    whereabouts: Whereabouts
    examined: NDArray[np.bool_]
    weights: Values | None = None
    geometry: Geometry | None = None

    @property
    def values(self) -> Values:
        """The scores of all stages, float64 [n]."""
        values = self.scores.astype(np.float64)
        return values if self.geometry is None else values + self.geometry.gain

    def listed(self) -> NDArray[np.int64]:
        """The positions of the places whose scores can be compared with each other, int64."""
        return np.flatnonzero(self.examined) if self.examined.any() else np.arange(min(LISTED, len(self.rows)))


@dataclass(frozen=True)
class Fused:
    """The joint ranking of all cameras.

    rows: int64 [n], rows of the map, best first.
    whereabouts: of the n places.
    scores: float32 [n], the best score of all stages that any camera gives to each place.
    log_odds: float64 [n], descending, by all cameras and the prior.
    weights: float64 [n], log prior of the places; zeros without a prior.
    """

    judgement: Judgement
    rows: NDArray[np.int64]
    whereabouts: Whereabouts
    scores: NDArray[np.float32]
    log_odds: Values
    weights: Values


def fuse(views: Sequence[CameraRanking], calibration: Calibration, neighborhood: Neighborhood) -> Fused:
    """Judge the frames of several cameras of a rig together, against one map.

    Args:
        views: of the cameras whose frames have a region; at least one, each with at least one place.
    """
    listed = [view.listed() for view in views]
    rows, first = np.unique(
        np.concatenate([view.rows[part] for view, part in zip(views, listed, strict=True)]), return_index=True
    )
    parts = [view.whereabouts.take(part) for view, part in zip(views, listed, strict=True)]
    places = Whereabouts.joined(parts).take(first)
    scores, values = np.full((2, len(views), len(rows)), -np.inf)
    evidence = np.full((len(views), len(rows)), np.nan)
    for camera, (view, part) in enumerate(zip(views, listed, strict=True)):
        at = np.searchsorted(rows, view.rows[part])
        scores[camera, at], values[camera, at] = view.scores[part], view.values[part]
        if view.geometry is not None:
            evidence[camera] = 0.0  # of places that are not worth verifying
            evidence[camera, at] = np.nan_to_num(view.geometry.evidence[part])
    near = np.stack([places.near(i, neighborhood) for i in range(len(rows))])
    beside = np.stack([places.near(i, neighborhood.times(GUARD_FACTOR)) for i in range(len(rows))])
    counts = [len(view.rows) for view in views]
    of_place = _added(
        np.stack(
            [
                _camera_log_odds(*one, near, beside, calibration, len(views))
                for one in zip(scores, values, evidence, counts, strict=True)
            ]
        )
    )
    prior = np.concatenate(
        [
            np.zeros(len(part)) if view.weights is None else view.weights[part]
            for view, part in zip(views, listed, strict=True)
        ]
    )[first]
    of_place += np.where(near, prior, -np.inf).max(axis=1)
    steepness = decision_slope(calibration)
    # The frames of one place share its evidence; among them, those with the best scores of their own come first.
    lowest = np.where(np.isfinite(values), values, np.inf).min(axis=1, keepdims=True)
    own = np.where(np.isfinite(values), values, lowest)
    behind = np.stack([np.where(near, row, -np.inf).max(axis=1) for row in own]) - own
    total = of_place - steepness * behind.mean(axis=0)
    # Places that lead for no camera have the same odds and are ranked by their scores.
    order = np.lexsort((-own.mean(axis=0), -np.round(total, 9)))
    found = values.max(axis=0)[order].astype(np.float32)
    of_best = evidence[:, near[order[0]]]
    best_evidence = None if np.isnan(of_best).all() else float(np.nanmax(of_best))
    judgement = _judged(of_place[order], found, near[np.ix_(order, order)], calibration, steepness, best_evidence)
    return Fused(judgement, rows[order], places.take(order), found, total[order], prior[order])


def _camera_log_odds(
    scores: Values,
    values: Values,
    evidence: Values,
    places: int,
    near: NDArray[np.bool_],
    beside: NDArray[np.bool_],
    calibration: Calibration,
    cameras: int,
) -> Values:
    """The log odds of each place by one camera, float64 [n].

    Args:
        scores, values: float64 [n], of two stages and of all; -inf for places that the camera does not list.
        evidence: float64 [n]; NaN if none of the camera's places was verified.
        places: how many the camera's ranking has.
        near: bool [n, n], which places are the same place.
        beside: bool [n, n], which places may overlap.
        cameras: how many the rig has.
    """
    found = np.empty(len(scores))
    for place, same in enumerate(near):
        best = float(scores[same].max())
        rest = np.sort(scores[~same & np.isfinite(scores)])[::-1].astype(np.float32)
        if not np.isfinite(best):
            best = min(calibration.background_mean, float(rest[0]) if len(rest) else np.inf)
        apart = scores[~beside[place] & np.isfinite(scores)]
        behind = calibration.background(rest, places - int(same.sum()), apart)
        found[place] = log_odds(behind.decision(best), calibration, behind.imagined)
        if calibration.geometry is not None and not np.isnan(evidence[same]).any():
            lead = values[same].max() - values[~same].max(initial=-np.inf)
            leads = share_of_lead(lead, behind.imagined) / cameras
            found[place] = calibration.geometry.log_odds(found[place], evidence[same].max(), leads)
    return found


def _added(parts: Values) -> Values:
    """Σ log((1 - e) · exp(x) + e) over cameras, float64 [C, n] to [n]; x itself for a single camera."""
    if len(parts) == 1:
        return np.asarray(parts[0], np.float64)
    return np.asarray(np.logaddexp(np.log1p(-BLIND) + parts, np.log(BLIND)).sum(axis=0), np.float64)


def _judged(
    log_odds_of_places: Values,
    scores: NDArray[np.float32],
    near: NDArray[np.bool_],
    calibration: Calibration,
    steepness: float,
    evidence: float | None,
) -> Judgement:
    """Judge the first of the ranked places; ``near`` says which of them are the same place, bool [n, n].

    The verdict is ambiguous if the margin is too small, and also if the best rival alone would be recognized.  Where
    the first was verified, each place that shares its view fits and would be; the rival is then close if its odds are
    within a factor of four.
    """
    best = float(log_odds_of_places[0])
    others = np.flatnonzero(~near[0])
    rival, margin = None, None
    if len(others):
        rival = int(others[np.argmax(log_odds_of_places[others])])
        margin = max(0.0, (best - float(log_odds_of_places[rival])) / steepness)
    least = log_odds(calibration.threshold, calibration)
    decision = calibration.threshold + (best - least) / decision_slope(calibration)
    if evidence is not None:
        least = max(0.0, least)
    # Of places that the cameras prefer each alone is close, or would be believed.
    weighed = evidence is not None and calibration.geometry is not None
    likely = best - log_odds_of_places < ALIKE if weighed else log_odds_of_places >= least
    close = likely | (best - log_odds_of_places < calibration.margin * steepness)
    verdict: Verdict = "recognized"
    rivals: tuple[Rivals, ...] = ()
    if best < least:
        verdict = "unknown"
    elif rival is not None and close[rival]:
        verdict = "ambiguous"
        rivals = tuple(Rivals((head,), False) for head in _heads(others[close[others]], near))
    probability = None
    if calibration.curve is not None:
        against = () if rival is None else (float(log_odds_of_places[rival]),)
        probability = float(joint_probabilities([best, *against])[0])
    return Judgement(verdict, float(scores[0]), decision, margin, rival, probability, rivals=rivals, evidence=evidence)


def _heads(places: NDArray[np.int64], near: NDArray[np.bool_]) -> list[int]:
    """The first of some places, int64 [k], without those that are the same place as a better one."""
    heads: list[int] = []
    while len(places) and len(heads) < MOST_RIVALS:
        heads.append(int(places[0]))
        places = places[~near[heads[-1], places]]
    return heads


def joint_probabilities(log_odds_of_matches: Sequence[float]) -> Values:
    """exp(x_m) / (1 + Σ exp(x_j)) of matches that exclude each other; float64 [m], with a sum below 1."""
    x = np.clip(np.asarray(log_odds_of_matches, np.float64), -FARTHEST, FARTHEST)
    total = np.logaddexp.reduce(np.append(x, 0.0))
    return np.asarray(np.exp(x - total), np.float64)


def log_odds_of(judgement: Judgement, calibration: Calibration) -> float:
    """The log odds of a best match, from its probability or, without a calibrated curve, from its decision value."""
    if judgement.probability is not None:
        probability = min(max(judgement.probability, 1e-15), 1 - 1e-15)
        return float(np.log(probability) - np.log1p(-probability))
    return -FARTHEST if judgement.decision is None else log_odds(judgement.decision, calibration)

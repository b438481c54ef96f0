"""The third stage of a search: the keypoints of the query and of its best candidates are compared.

``always`` verifies the best places of two stages, the best of the first alone, and those that match at a glance best of
the best hundred: where the view has moved far, cells on a grid mislead the second stage.  The most promising come
first, and a place that cannot win any more is left out.  ``auto`` does the same where two stages leave doubt.  It does
not stop at a best match with evidence, for the places beside the true one have as much.  Where the best match of two
stages has no keypoints, as in a map that stores none, the answer stays that of two stages.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import dataclass, field, replace
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from core.errors import UnfitIntrinsics
from core.geometry.keypoints import Keypoints
from core.geometry.matching import GLANCED
from core.geometry.pose import LEAST_EVIDENCE, RelativeView, SharedPoints, relative_view, sighting_of
from core.geometry.verification import Verification, verify
from core.judgement.geometry import Geometry, final_gains, final_order
from core.judgement.position import places_apart
from core.judgement.verdict import Calibration, Judgement, worth_verifying
from core.method.encoder import Encoder
from core.places import NO_POSE, Neighborhood
from core.recognition.comparison import Comparison, MapComparison
from core.recognition.question import Query, Verifier
from core.recognition.stages import Candidates, Positions, calibration_of, neighborhood_of
from core.store import Map

VerificationState = Literal["verified", "not-needed", "no-keypoints", "never"]
"""Whether they were: ``not-needed`` if two stages settle the answer, ``no-keypoints`` if the best match of two stages
has none, or the frame so few that they would say nothing."""

MOST_VIEWS = 1
"""The most places whose turn and shift give the pose, or where a search for it begins; each takes some 10 ms."""

NEIGHBOURS = 3
"""The places around the best match that are compared for the sake of the pose if they were not verified."""

OF_TWO_STAGES, OF_THE_FIRST, OF_GLANCES = 6, 2, 4
"""How many places are candidates for being the best of two stages, the best of the first, and by their matches."""
CANDIDATES = OF_TWO_STAGES + OF_THE_FIRST + OF_GLANCES
"""How many places are verified at most, unless a place that was not comes first after that."""
GLANCES = 100
"""Among how many places the matches of few keypoints choose."""
OF_A_GLANCE, BESIDE = 0.5, 0.07
"""A place has at most so many inliers, as a share of keypoints: half of the matches at a glance, and some more.  One
that would stay behind the best all the same is left out.  The bound holds for 97 of 100 places of the tasks to fit on
(``benchmarks.geometry.verification``)."""
BEST = np.zeros(1, np.int64)
"""The position of the best match of two stages."""
AT_FIRST = 4
"""How many places are verified before it is asked which others may still win."""


@dataclass(frozen=True)
class ThirdStage:
    """The outcome of the third stage.

    keypoints: of the query; None if its candidates were not verified.
    stored: of the places that were verified, by their rows.
    milliseconds: how long it took.
    """

    state: VerificationState
    keypoints: Keypoints | None = None
    stored: Mapping[int, Keypoints] = field(default_factory=dict)
    milliseconds: float = 0.0


NOT_VERIFIED = ThirdStage("never")

Judge = Callable[[Candidates], Judgement]


def third_stage(
    map_: Map, encoder: Encoder, candidates: Candidates, judged: Judge, query: Query
) -> tuple[Candidates, Judgement, ThirdStage]:
    """Verify the candidates of a query where that is wanted.

    Args:
        candidates: after two stages.
        judged: judges candidates; it is called for them at once, and again after places were verified.
        query: has the verifier, which says when to verify; None: never.

    Returns:
        The candidates in their final order, and the judgement of them.

    Raises:
        InvalidModel: the network of keypoints cannot be loaded.
        StorageFailure: the map's files cannot be read.
    """

    if (verifier := query.verifier) is None:
        return candidates, judged(candidates), NOT_VERIFIED

    def tells_pose(judgement: Judgement) -> bool:
        return _tells_pose(map_, candidates, judgement, verifier)

    comparison = MapComparison(map_, encoder, query.encoding.local, verifier)
    ranked, judgement, stage = verify_candidates(
        candidates, judged, verifier, calibration_of(map_, encoder), comparison, tells_pose
    )
    return ranked, judgement, replace(stage, stored=comparison.stored)


def verify_candidates(
    candidates: Candidates,
    judged: Judge,
    verifier: Verifier,
    calibration: Calibration,
    comparison: Comparison,
    tells_pose: Callable[[Judgement], bool] = lambda _: False,
) -> tuple[Candidates, Judgement, ThirdStage]:
    """The third stage over candidates of any origin, see :func:`third_stage`.

    Args:
        calibration: by which they are judged.
        comparison: of the query with the candidates.
        tells_pose: whether they are verified after a judgement for the sake of the pose.
    """
    before = judgement = judged(candidates)
    if verifier.when == "never" or not len(candidates.rows):
        return candidates, judgement, NOT_VERIFIED
    doubtful = verifier.when == "always" or worth_verifying(judgement, calibration)
    if not doubtful and not tells_pose(judgement):
        return candidates, judgement, ThirdStage("not-needed")
    began, ranked, trial = time.perf_counter(), candidates, _Trial(candidates, comparison)
    if not doubtful:
        trial.verify(BEST)
        ranked = trial.ranked()
        judgement = judged(ranked)
        doubtful = trial.weighs_the_best and worth_verifying(judgement, calibration)
    if doubtful:
        trial.verify_chosen()
        ranked = trial.ranked()
        judgement = judged(ranked)
    milliseconds = 1e3 * (time.perf_counter() - began)
    if not trial.weighs_the_best:
        return candidates, before, ThirdStage("no-keypoints", milliseconds=milliseconds)
    return ranked, judgement, ThirdStage("verified", verifier.keypoints, milliseconds=milliseconds)


class _Trial:
    """The verification of the candidates of one query.

    found: results by positions among the candidates, those of places that have keypoints.
    """

    def __init__(self, candidates: Candidates, comparison: Comparison) -> None:
        self.candidates, self.comparison = candidates, comparison
        self.found: dict[int, Verification] = {}
        self._tried: set[int] = set()

    def verify(self, positions: Positions) -> None:
        """Verify the candidates at some positions, int64 [k], that were not yet."""
        if not (missing := [position for position in positions.tolist() if position not in self._tried]):
            return
        self._tried.update(missing)
        results = self.comparison.verifications(self.candidates.rows[missing].tolist())
        self.found |= {at: one for at, one in zip(missing, results, strict=True) if one is not None}

    @property
    def weighs_the_best(self) -> bool:
        """Whether the best match of two stages was verified.

        If it has no keypoints, those of other places say nothing against it.
        """
        return 0 in self.found

    def ranked(self) -> Candidates:
        """The candidates in their final order, with the results."""
        return verified(self.candidates, self.found)

    def verify_chosen(self) -> None:
        """Verify those that are chosen as far as they can still win, and whatever comes first then."""
        chosen, shares = self._choose()
        promised = self._values(OF_A_GLANCE * shares + BESIDE)
        self.verify(np.union1d(BEST, chosen[np.argsort(-promised[chosen], kind="stable")][:AT_FIRST]))
        if not self.weighs_the_best:
            return
        best = self._values(self._shares())[[*self.found]].max() if len(self.found) > 1 else -np.inf
        self.verify(chosen[promised[chosen] >= best])
        while (first := int(np.argmax(self._values(self._shares())))) not in self._tried:
            self.verify(np.array([first]))

    def _choose(self) -> tuple[Positions, NDArray[np.float64]]:
        """The positions to verify, int64 [k], and of all candidates the share of keypoints that match at a glance.

        Those that the second stage has not compared with the query are compared now, so that all are judged alike.
        """
        candidates = self.candidates
        # Of several frames of one view the best is enough.
        views = np.flatnonzero(~candidates.whereabouts.repeats(np.arange(len(candidates.rows))))[:GLANCES]
        shares = np.zeros(len(candidates.rows))
        shares[views] = self.comparison.matches_at_a_glance(candidates.rows[views].tolist()) / GLANCED
        chosen = views[:OF_TWO_STAGES]
        if candidates.first is not None:
            similar = views[np.argsort(-candidates.first[views], kind="stable")[:OF_THE_FIRST]]
            chosen = np.union1d(chosen, similar)
        others = np.setdiff1d(views, chosen)
        chosen = np.append(chosen, others[np.argsort(-shares[others], kind="stable")[:OF_GLANCES]])
        if candidates.examined.any() and len(late := chosen[~candidates.examined[chosen]]):
            gains = self.comparison.agreements(candidates.rows[late].tolist())
            self.candidates = candidates.examined_further(late, gains)
        return chosen, shares

    def _shares(self) -> NDArray[np.float64]:
        """The share of inliers of all candidates, float64 [n]; 0 where none were found."""
        shares = np.zeros(len(self.candidates.rows))
        for at, one in self.found.items():
            shares[at] = one.inlier_share
        return shares

    def _values(self, shares: NDArray[np.float64]) -> NDArray[np.float64]:
        """The values by which three stages order the candidates, float64 [n], if these had so many inliers."""
        gains = final_gains(shares, self.candidates.first, self.candidates.agreement)
        return np.asarray(self.candidates.ordered + gains, np.float64)


def _tells_pose(map_: Map, candidates: Candidates, judgement: Judgement, verifier: Verifier) -> bool:
    """Whether the geometry of the best match gives the robot's pose, which its scores alone do not."""
    posed = judgement.verdict == "recognized" and candidates.whereabouts.kind[0] != NO_POSE
    return bool(posed) and map_.cameras.intrinsics(verifier.camera) is not None


def relative_views(
    map_: Map, candidates: Candidates, stage: ThirdStage, verifier: Verifier | None
) -> tuple[list[RelativeView | None], str | None]:
    """The query's camera relative to those of the places that were verified and belong to the best match's answer.

    Returns:
        One for each of the first candidates, and why intrinsics were not used, if they do not fit a frame.
    """
    query = stage.keypoints
    if verifier is None or query is None:
        return [], None
    near = candidates.whereabouts.near(0, neighborhood_of(map_))
    views: list[RelativeView | None] = []
    note, used = None, 0
    for row, one, belongs in zip(candidates.rows.tolist(), candidates.verifications, near.tolist(), strict=False):
        place = stage.stored.get(row)
        if one is None or place is None or not belongs or used == MOST_VIEWS:
            views.append(None)
            continue
        (known,) = map_.places_at([row])
        names = verifier.camera, None if known is None else known.camera
        cameras = [map_.cameras.intrinsics(name) for name in names]
        if None in cameras and used:  # without intrinsics only the best match's heading is known
            views.append(None)
            continue
        try:
            view = relative_view(query, place, one, *cameras)
        except UnfitIntrinsics as error:
            view, note = relative_view(query, place, one), str(error)
        views.append(view)
        used += view is not None
    return views, note


def sightings(
    map_: Map, candidates: Candidates, stage: ThirdStage, verifier: Verifier | None
) -> list[SharedPoints | None]:
    """The points that the query shares with places that were verified, however far they are from the best match.

    The best match's neighbours are compared as well: one place does not tell how far the query is.

    Returns:
        One for each of the first candidates; None where the intrinsics of a camera are not known or do not fit.

    Raises:
        StorageFailure: the map's files cannot be read.
    """
    query = stage.keypoints
    if verifier is None or query is None or (camera := map_.cameras.intrinsics(verifier.camera)) is None:
        return []
    compared = {at: one for at, one in enumerate(candidates.verifications) if one is not None}
    stored = {at: stage.stored.get(int(candidates.rows[at])) for at in compared}
    if 0 in compared and compared[0].evidence >= LEAST_EVIDENCE:
        around = [at for at in _around(candidates, neighborhood_of(map_)) if at not in compared]
        there = zip(around, map_.keypoints_at(candidates.rows[around].tolist()), strict=True)
        more = {at: keypoints for at, keypoints in there if keypoints is not None}
        stored |= more
        compared |= dict(zip(more, verify(query, list(more.values())), strict=True))
    found: list[SharedPoints | None] = [None] * (max(compared, default=-1) + 1)
    for at, one in compared.items():
        place = stored[at]
        if place is not None and one.evidence >= LEAST_EVIDENCE:
            (known,) = map_.places_at([int(candidates.rows[at])])
            shown = map_.cameras.intrinsics(None if known is None else known.camera)
            with suppress(UnfitIntrinsics):
                found[at] = None if shown is None else sighting_of(query, place, one, camera, shown)
    return found


def _around(candidates: Candidates, neighborhood: Neighborhood) -> list[int]:
    """The candidates around the best match, on its storey, that tell how far the query is, at most NEIGHBOURS, the
    nearest ones."""
    places = candidates.whereabouts.on_level_of(0, neighborhood.height)
    distances = np.linalg.norm(places.ground - places.ground[0], axis=1)
    order = np.argsort(np.where(places.kind == places.kind[0], distances, np.inf), kind="stable").tolist()
    return places_apart(places, neighborhood.radius, order, NEIGHBOURS)


def verified(candidates: Candidates, found: Mapping[int, Verification]) -> Candidates:
    """The candidates in their final order, with the results of verification.

    As long as the best match alone was verified, nobody knows how well the others fit, and the scores stay.

    Args:
        found: the results by positions among the candidates.
    """
    evidence, share = np.full(len(candidates.rows), np.nan), np.zeros(len(candidates.rows))
    for at, one in found.items():
        evidence[at], share[at] = one.evidence, one.inlier_share
    alone = set(found) <= {0}
    gains = np.zeros(len(share)) if alone else final_gains(share, candidates.first, candidates.agreement)
    order = final_order(candidates.ordered, gains)
    last = max(np.flatnonzero(~np.isnan(evidence[order])), default=-1)
    verifications = tuple(found.get(at) for at in order[: last + 1].tolist())
    return candidates.take(order).with_geometry(Geometry(evidence[order], gains[order]), verifications)

"""The third stage of a search: the keypoints of the query and of its best candidates are compared.

``always`` verifies the best ``CANDIDATES`` places of two stages.  ``auto`` looks only where these leave doubt: at the
best match first, whose evidence may settle it, and else at the others.  A place without keypoints, as of a map that
stores none, stays where the first two stages have put it.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from typing import Literal

import numpy as np

from core.errors import UnfitIntrinsics
from core.geometry.keypoints import Keypoints
from core.geometry.pose import LEAST_EVIDENCE, RelativeView, SharedPoints, relative_view, sighting_of
from core.geometry.verification import LEAST_MATCHES, Verification, verify
from core.judgement.geometry import Geometry, final_order
from core.judgement.position import APART, BUNDLE_REACH
from core.judgement.verdict import Calibration, Judgement, worth_verifying
from core.maps import Map
from core.method.encoder import Encoder
from core.places import NO_POSE
from core.recognition.question import Verifier
from core.recognition.stages import Candidates, calibration_of, neighborhood_of

VerificationState = Literal["verified", "not-needed", "no-keypoints", "never"]
"""Whether they were: ``not-needed`` if two stages settle the answer, ``no-keypoints`` if no candidate has any, or the
frame so few that they would say nothing."""

MOST_VIEWS = 1
"""The most places whose turn and shift give the pose, or where a search for it begins; each takes some 20 ms."""

NEIGHBOURS = 2
"""Places beside the best match that are compared for the sake of the pose where no others were verified."""

CANDIDATES = 10
"""How many places are verified at most: five lose 0.027 of the recall@1 on lip6, and fifteen gain 0.002."""


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
    map_: Map, encoder: Encoder, candidates: Candidates, judged: Judge, verifier: Verifier | None
) -> tuple[Candidates, Judgement, ThirdStage]:
    """Verify the candidates of a query where that is wanted.

    Args:
        candidates: after two stages.
        judged: judges candidates; it is called for them at once, and again after places were verified.
        verifier: when to verify, and the query's keypoints; None: never.

    Returns:
        The candidates in their final order, and the judgement of them.

    Raises:
        InvalidModel: the network of keypoints cannot be loaded.
        StorageFailure: the map's files cannot be read.
    """

    def tells_pose(judgement: Judgement) -> bool:
        return verifier is not None and _tells_pose(map_, candidates, judgement, verifier)

    calibration = calibration_of(map_, encoder)
    return verify_candidates(candidates, judged, verifier, calibration, map_.keypoints_at, tells_pose)


def verify_candidates(
    candidates: Candidates,
    judged: Judge,
    verifier: Verifier | None,
    calibration: Calibration,
    keypoints_at: Callable[[list[int]], list[Keypoints | None]],
    tells_pose: Callable[[Judgement], bool] = lambda _: False,
) -> tuple[Candidates, Judgement, ThirdStage]:
    """The third stage over candidates of any origin, see :func:`third_stage`.

    Args:
        calibration: by which they are judged.
        keypoints_at: returns the keypoints of places by their rows; None for one that has none.
        tells_pose: whether they are verified after a judgement for the sake of the pose.
    """
    judgement = judged(candidates)
    if verifier is None or verifier.when == "never" or not len(candidates.rows):
        return candidates, judgement, NOT_VERIFIED
    automatic = verifier.when == "auto"
    if automatic and not (worth_verifying(judgement, calibration) or tells_pose(judgement)):
        return candidates, judgement, ThirdStage("not-needed")
    began = time.perf_counter()
    # Of several frames of one view the best is enough.
    chosen = np.flatnonzero(~candidates.whereabouts.repeats(np.arange(len(candidates.rows))))[:CANDIDATES].tolist()
    count = chosen[-1] + 1
    stored: list[Keypoints | None] = [None] * count
    for at, keypoints in zip(chosen, keypoints_at(candidates.rows[chosen].tolist()), strict=True):
        stored[at] = keypoints
    if all(keypoints is None for keypoints in stored) or len(verifier.keypoints) < LEAST_MATCHES:
        return candidates, judgement, ThirdStage("no-keypoints", milliseconds=1e3 * (time.perf_counter() - began))
    found: list[Verification | None] = [None] * count
    ranked = candidates
    for some in (range(1), range(1, count)) if automatic else (range(count),):
        if some.start and not worth_verifying(judgement, calibration):
            break
        there = [(at, keypoints) for at in some if (keypoints := stored[at]) is not None]
        for (at, _), one in zip(there, verify(verifier.keypoints, [keypoints for _, keypoints in there]), strict=True):
            found[at] = one
        if there:
            ranked = verified(candidates, found)
            judgement = judged(ranked)
    milliseconds = 1e3 * (time.perf_counter() - began)
    compared = {
        row: keypoints
        for row, keypoints, one in zip(candidates.rows.tolist(), stored, found, strict=False)
        if keypoints is not None and one is not None
    }
    return ranked, judgement, ThirdStage("verified", verifier.keypoints, compared, milliseconds)


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

    If only the best match was, its neighbours are compared as well: one place does not tell how far the query is.

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
    if list(compared) == [0] and compared[0].evidence >= LEAST_EVIDENCE:
        around = _around(candidates)
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


def _around(candidates: Candidates) -> list[int]:
    """The candidates nearest to the best match that do not stand where it does, at most NEIGHBOURS."""
    places = candidates.whereabouts
    distances = np.linalg.norm(places.position - places.position[0], axis=1)
    usable = (places.kind == places.kind[0]) & (distances >= APART) & (distances <= BUNDLE_REACH)
    order = np.argsort(np.where(usable, distances, np.inf), kind="stable")[:NEIGHBOURS]
    return order[usable[order]].tolist()


def verified(candidates: Candidates, found: Sequence[Verification | None]) -> Candidates:
    """The candidates in their final order, with the results of verification for the first of them."""
    evidence, share = np.full((2, len(candidates.rows)), np.nan)
    for at, one in enumerate(found):
        if one is not None:
            evidence[at], share[at] = one.evidence, one.inlier_share
    order = final_order(candidates.ordered, share)
    ranked = candidates.take(order)
    verifications = tuple(found[at] if at < len(found) else None for at in order[: len(found)].tolist())
    return ranked.with_geometry(Geometry(evidence[order], share[order]), verifications)

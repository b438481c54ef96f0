"""A frame that shows more or less of the world than the places of the map: which framing it has.

Whether a frame is enlarged or was taken some steps ahead cannot be told from it alone, but the right place tells: seen
in its framing (``core.frames.framing``), a frame fits that place cell by cell better than it fits any other place in
any other framing.  What is compared is the mean squared cosine of the cells that the frame shows.  The frame is encoded
anew for each framing that is tried, and that is dear.  Where the intrinsics of both cameras are known, they give the
framing.  Otherwise others are tried where the best match fits badly, and where the best places fit the frame's cells
better if these are shrunk as they are.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from core.errors import UnfitIntrinsics, UnknownPlace
from core.frames.framing import SAME_VIEW, Framing
from core.frames.intrinsics import Intrinsics
from core.geometry.detection import ScaledFrame, find_keypoints
from core.geometry.keypoints import SHARES, Keypoints
from core.judgement.verdict import Judgement, Rivals
from core.method.agreement import Cells
from core.method.encoder import Encoder
from core.networks.xfeat import packaged_xfeat
from core.places import Neighborhood
from core.recognition.question import Query
from core.recognition.stages import Candidates, rank_places
from core.store import Map

FITS = 0.27
"""A best match whose cells have this mean squared cosine is not doubted: of frames cut to 60 % hardly any has."""

SHRUNK, PROMISING, STEEPNESS = 0.6, 0.9, 2.2
"""Others are tried where cells, shrunk so far, gain more than PROMISING + STEEPNESS times their mean squared cosine, as
a factor: with FITS that are 0.11 and 0.09 of the plain frames of corridor and lip6, and of those cut to 60 % 1.0 and
0.93, to 75 % 1.0 and 0.54.  With 0.85 it is 0.15 and 0.11 of the plain frames, and 0.95 and 0.58 of the last two."""

BESIDE = 8
"""Places, the best ones, with which shrunk cells are compared; 16 take twice the time, and find hardly more."""

FIRST, FURTHER, GAIN = 0.7, (0.6, 0.84), 1.05
"""The framing that is tried first, and those that are tried if the frame fits better in it by a factor of GAIN.  Of
cut frames (60 %) it gains 1.08 at least on corridor and lip6, and 1.3 and 1.6 mostly; plain ones, if tried, 1.0."""

HOPEFUL = 0.2
"""Further ones are tried if the frame is as probable as this in the first: of frames from elsewhere 0 and 0.12 are, on
corridor and lip6, and of those cut to 60 % 0.88 and all."""

SHARPNESS, BETWEEN, LEAST_SHARE = 4.0, 0.6, 0.7
"""Of two framings that show places apart, the one that fits better is right with odds of the ratio of their fits to the
power of SHARPNESS; where no other shows a place apart, one between those that were tried may, as if it had a ratio of
BETWEEN, unless the frame fits best as it is.  With a share under LEAST_SHARE the answer is ambiguous.  Chosen on
corridor and lip6 cut to 60 and 75 %: of a ratio under 0.7 the best is right in 0.88 of the cases, up to 0.8 in 0.67, up
to 0.9 in 0.5, above in 0.4; of frames that fit best as they are (ratios from 0.94 on) five were wrong on corridor, one
on lip6, and none right."""

OTHER_SHAPE = 1.2
"""The factor between the shapes of two frames, as width by height, from which on one of them shows another part."""


@dataclass(frozen=True)
class FrameReframing:
    """Makes the query of a frame as it is in another framing.

    encoder: of the map.
    find: returns the frame, scaled.
    """

    encoder: Encoder
    find: Callable[[], ScaledFrame]

    def size(self) -> tuple[int, int]:
        """Width and height of the frame, in pixels."""
        frame = self.find()
        return frame.width, frame.height

    def __call__(self, query: Query, framing: Framing) -> Query | None:
        """The query in a framing; None if it shows too little then."""
        frame = self.find()
        made = framing.applied(frame.pixels, frame.width, frame.height, frame.mask)
        if made is None:
            return None
        pixels, mask = made
        encoding = self.encoder.encode(pixels, mask)
        if not len(encoding.regions):
            return None
        # So the mean squared cosine is that of the cells that the frame shows.
        cells = np.clip(np.rint(encoding.local / np.sqrt(framing.shown)), -127, 127).astype(np.int8)
        encoding = replace(encoding, local=cells)
        return Query(encoding, query.question, lambda: find_keypoints(packaged_xfeat(), pixels, mask))


@dataclass(frozen=True)
class FramedView:
    """A frame in one framing, and its candidates after two stages.

    fit: the mean squared cosine of the cells that the frame shows and those of the best match.
    """

    framing: Framing
    query: Query
    candidates: Candidates
    fit: float


def framed(
    map_: Map, encoder: Encoder, query: Query, candidates: Candidates, judged: Callable[[Candidates], Judgement]
) -> tuple[FramedView, list[FramedView]]:
    """The framing in which a query fits a place best, and all that were tried.

    Args:
        candidates: of the query as it is, after two stages.
        judged: judges candidates.

    Raises:
        StorageFailure: the map's files cannot be read.
    """
    plain = FramedView(SAME_VIEW, query, candidates, _fit(encoder, candidates))
    if query.reframing is None or query.verifier is None or not len(candidates.rows):
        return plain, [plain]
    views, reframed = [plain], query.reframing

    def look(*framings: Framing) -> FramedView:
        for framing in framings:
            if (other := reframed(query, framing)) is not None:
                (found,) = rank_places(map_, encoder, [other.encoding], query.question.selection)
                if len(found.rows):
                    views.append(FramedView(framing, other, found, _fit(encoder, found)))
        return max(views, key=lambda view: view.fit)

    if (known := known_framing(map_, query, candidates)) is not None:
        if not known.is_like(SAME_VIEW):
            look(known)
        return views[-1], views[-1:]
    if plain.fit == 0 or plain.fit >= FITS:
        return plain, views
    shape = _shape(map_, query, candidates)
    if shape.is_like(SAME_VIEW):
        if not _may_be_narrower(map_, encoder, plain):
            return plain, views
    else:
        look(shape)
    before = look()
    first = look(shape.zoomed(FIRST))
    probability = judged(first.candidates).probability
    if first.fit > GAIN * before.fit and (probability is None or probability >= HOPEFUL):
        look(*(shape.zoomed(factor) for factor in FURTHER))
        return look(), views
    return before, views


def doubted(
    judgement: Judgement,
    ranked: Candidates,
    best: FramedView,
    views: Sequence[FramedView],
    neighborhood: Neighborhood,
) -> Judgement:
    """A judgement that takes into account that another framing may be the right one, and show another place.

    Args:
        judgement: of the best view.
        ranked: its candidates in their final order.
        views: all that were tried; one alone is known to be right.
    """
    if len(views) == 1 or judgement.probability is None:
        return judgement
    apart = [
        view
        for view in views
        if view.framing != best.framing and not _is_near(ranked, int(view.candidates.rows[0]), neighborhood)
    ]
    rival = max(apart, key=lambda view: view.fit, default=None)
    between = 0.0 if best.framing == SAME_VIEW else BETWEEN
    ratio = max(between, 0.0 if rival is None else rival.fit / best.fit)
    share = 1 / (1 + ratio**SHARPNESS)
    judgement = replace(judgement, probability=judgement.probability * share)
    if rival is None or share >= LEAST_SHARE or judgement.verdict != "recognized":
        return judgement
    at = np.flatnonzero(ranked.rows == rival.candidates.rows[0])
    rivals = (Rivals((int(at[0]),), False),) if len(at) else ()
    return replace(judgement, verdict="ambiguous", rivals=rivals)


def _is_near(candidates: Candidates, row: int, neighborhood: Neighborhood) -> bool:
    """Whether the place of a row is the place of the best candidate."""
    at = np.flatnonzero(candidates.rows == row)
    return bool(len(at)) and bool(candidates.whereabouts.near(0, neighborhood)[at[0]])


def _fit(encoder: Encoder, candidates: Candidates) -> float:
    stage, agreement = encoder.definition.agreement, candidates.agreement
    return 0.0 if stage is None or agreement is None or not len(agreement) else float(agreement[0]) / stage.share


def known_framing(map_: Map, query: Query, candidates: Candidates) -> Framing | None:
    """The framing by the intrinsics of both cameras; None if one is not known, or does not fit the frame."""
    ours = map_.cameras.intrinsics(query.question.camera)
    if ours is None or query.reframing is None:
        return None
    (place,) = map_.places_at(candidates.rows[:1].tolist())
    theirs = None if place is None else map_.cameras.intrinsics(place.camera)
    if theirs is None:
        return None
    try:
        ours.of_size(*query.reframing.size())
    except UnfitIntrinsics:
        return None
    return _seen_by(ours, theirs)


def _seen_by(ours: Intrinsics, theirs: Intrinsics) -> Framing:
    """The framing of one camera in the view of another."""
    across, down = (
        (ours.width / ours.fx) / (theirs.width / theirs.fx),
        (ours.height / ours.fy) / (theirs.height / theirs.fy),
    )
    return Framing(across, down)


def _shape(map_: Map, query: Query, candidates: Candidates) -> Framing:
    """The framing of a frame of another shape, if it shows as much as the best match along one side."""
    (keypoints,) = map_.keypoints_at(candidates.rows[:1].tolist())
    if keypoints is None or query.reframing is None:
        return SAME_VIEW
    width, height = query.reframing.size()
    factor = (width / height) / (keypoints.width / keypoints.height)
    if max(factor, 1 / factor) < OTHER_SHAPE:
        return SAME_VIEW
    return Framing(min(1.0, factor), min(1.0, 1 / factor))


def _may_be_narrower(map_: Map, encoder: Encoder, plain: FramedView) -> bool:
    """Whether the best places fit the frame's cells better if these are shrunk; not if one was deleted meanwhile."""
    stage = encoder.definition.agreement
    try:
        places = map_.snapshot().locals_at(plain.candidates.rows[:BESIDE])
    except UnknownPlace:
        return False
    if stage is None:
        return False
    cells, share = shrunk(plain.query.encoding.local, encoder.grid, SHRUNK)
    fits = encoder.agreement(cells, places) / (stage.share * share)
    return bool(float(fits.max()) > plain.fit * (PROMISING + STEEPNESS * plain.fit))


def shrunk(cells: Cells, grid: tuple[int, int], factor: float) -> tuple[Cells, float]:
    """Cells as if their frame were shrunk into the middle of a larger one, int8 [C, L], and the share that it fills.

    Args:
        cells: int8 [C, L].
        grid: rows and columns of the C cells.
        factor: at most 1.
    """
    rows, columns = grid
    inner = [max(1, side - 2 * round(side * (1 - factor) / 2)) for side in grid]
    down, across = (_averages(side, size) for side, size in zip(grid, inner, strict=True))
    small = np.einsum(
        "ar,bc,rcl->abl", down, across, cells.reshape(rows, columns, -1).astype(np.float32), optimize=True
    )
    lengths = np.linalg.norm(small, axis=2, keepdims=True)
    usual = np.linalg.norm(cells.astype(np.float32), axis=1).max(initial=0.0)
    small *= usual / np.maximum(lengths, 1e-6)
    made = np.zeros((rows, columns, cells.shape[1]), np.int8)
    top, left = (rows - inner[0]) // 2, (columns - inner[1]) // 2
    made[top : top + inner[0], left : left + inner[1]] = np.clip(np.rint(small), -127, 127)
    return made.reshape(cells.shape), inner[0] * inner[1] / len(cells)


def _averages(side: int, size: int) -> NDArray[np.float32]:
    """The weights by which ``size`` values are means of ``side``, float32 [size, side]."""
    return np.asarray(cv2.resize(np.eye(side, dtype=np.float32), (side, size), interpolation=cv2.INTER_AREA))


def keypoints_in_frame(keypoints: Keypoints, framing: Framing, width: int, height: int) -> Keypoints:
    """The keypoints of a frame that were found in a framing of it."""
    shares = framing.in_frame(keypoints.shares())
    positions = np.clip(shares * SHARES, 0, SHARES - 1).astype(np.uint16)
    return Keypoints(width, height, positions, keypoints.descriptors)

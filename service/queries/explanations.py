"""Explanations: why the best match of a query scores as it does, as JSON and as a picture of both frames."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, replace

import numpy as np

from core.errors import NoThumbnail, UnknownCamera, UnknownPlace
from core.frames.preprocessing import Pixels
from core.geometry.verification import LEAST_MATCHES
from core.method.encoder import Encoder
from core.method.equations import assign
from core.method.explanation import Explanation, Shown, explain
from core.method.region_drawing import boxes, layer_grids
from core.method.regions import Regions
from core.places import Place, look_address
from core.recognition.recognition import Answer
from core.store import Map
from service.engine.encoders import Encoded
from service.engine.engine import Engine, camera_mask
from service.engine.queue import RequestDeadline
from service.queries.pictures import DrawnLine, DrawnOutline, ExplanationPictures, scaled, side_by_side
from service.queries.schemas import (
    CellPair,
    ExplainedRegion,
    ExplanationView,
    KeypointPair,
    MatchExplanation,
    RegionPair,
    RelativeBox,
)
from service.queries.statistics import map_key
from service.worker_threads import in_thread

LISTED = 30
"""How many regions of a frame an explanation lists."""

DRAWN = 60
"""How many lines a picture has at most."""


def scaled_for_drawing(encoded: Encoded) -> Encoded:
    """A copy whose pixels are scaled to the size of the drawing: a frame of 40 megapixels would fill the memory."""
    return replace(encoded, pixels=scaled(encoded.pixels))


async def explain_match(
    engine: Engine, pictures: ExplanationPictures, map_: Map, query: Encoded, answer: Answer, deadline: RequestDeadline
) -> MatchExplanation | None:
    """The explanation of a query's best match, with the path of a picture of both frames; None if the place is gone.

    The picture that the map stores of the place is encoded again, because the map does not store its regions.

    Args:
        query: the query, with pixels scaled for drawing.
        answer: the map's answer to it, which has a match.

    Raises:
        QueueFull, EncoderNotInstalled: the picture cannot be encoded.
        Others: see ``EncoderQueue.encode``.
    """
    match_place = answer.matches[0][1]
    place_id, look = match_place.id, match_place.look
    found = await in_thread(_stored_place, map_, place_id if look is None else look_address(place_id, look))
    if found is None:
        return None
    inliers = _inliers(answer)
    stored, place, picture = found
    encoder, encoded = query.encoder, None
    if picture is not None:
        mask = None
        with suppress(UnknownCamera):  # the camera was deleted after the place was enrolled
            mask = await camera_mask(map_, place.camera)
        with engine.queue.place():
            encoded = await engine.queue.encode(map_.record.encoder, picture, deadline, mask)
    match = replace(stored, regions=None if encoded is None else encoded.encoding.regions)
    shown = Shown(query.encoding.descriptor, query.encoding.local, query.encoding.regions)
    explained = await in_thread(lambda: explanation_view(encoder, explain(encoder, shown, match), shown, match))
    path = None
    if encoded is not None:
        drawn = await in_thread(draw_explanation, explained, query.pixels, encoded.pixels, inliers)
        path = f"/v1/maps/{map_.record.id}/explanations/{pictures.keep(map_key(map_), drawn)}"
    return MatchExplanation(
        **explained.__dict__, place=place_id, inliers=inliers, match_picture=place.picture, picture=path
    )


def _inliers(answer: Answer) -> list[KeypointPair]:
    """The keypoints of the query and of its best match that fit one rigid scene; none if they were not verified."""
    candidates, stage = answer.candidates, answer.third_stage
    verified = candidates.verifications[0] if candidates.verifications else None
    ours, theirs = stage.keypoints, stage.stored.get(int(candidates.rows[0]))
    if verified is None or ours is None or theirs is None:
        return []
    pairs = verified.matches[verified.inliers]
    sides = [np.round(keypoints.shares()[pairs[:, side]], 4).tolist() for side, keypoints in enumerate((ours, theirs))]
    return [KeypointPair(query=query, match=match) for query, match in zip(*sides, strict=True)]


def _stored_place(map_: Map, place_id: str) -> tuple[Shown, Place, bytes | None] | None:
    """The descriptors, the fields and the picture (or None) that a map stores of a place or a look; None: it is gone.

    Args:
        place_id: its id; of a look its address.
    """
    snapshot = map_.snapshot()
    (row,) = map_.rows_of([place_id])
    if row is None or row >= snapshot.rows:
        return None
    rows = np.array([row])
    shown = Shown(snapshot.descriptors_at(rows)[0], snapshot.locals_at(rows)[0], None)
    try:
        place = map_.place(place_id)
        picture = None if place.picture == "none" else map_.thumbnail(place_id)
    except (UnknownPlace, NoThumbnail):
        return None
    return shown, place, picture


@dataclass(frozen=True)
class _Listed:
    """The listed regions of a frame, the most important first, with their indices among all regions."""

    indices: list[int]
    regions: list[ExplainedRegion]


def explain_pair(query: Encoded, match: Encoded) -> ExplanationView:
    """The explanation of the score of two frames that one encoder has encoded."""
    shown = [Shown(one.encoding.descriptor, one.encoding.local, one.encoding.regions) for one in (query, match)]
    return explanation_view(query.encoder, explain(query.encoder, *shown), *shown)


def explanation_view(encoder: Encoder, explanation: Explanation, query: Shown, match: Shown) -> ExplanationView:
    """The JSON view of an explanation."""
    sides = [
        _listed(encoder, shown.regions, losses)
        for shown, losses in zip((query, match), explanation.losses, strict=True)
    ]
    mine, other = sides
    assert mine is not None
    pairs = []
    if other is not None:
        here, there = ({index: at for at, index in enumerate(side.indices)} for side in (mine, other))
        answers = explanation.answers.tolist()
        pairs = [RegionPair(query=here[a], match=there[b]) for a, b in answers if a in here and b in there]
    columns = max(1, encoder.grid[1])
    order = np.argsort(-explanation.gains, kind="stable")
    cells = explanation.cells
    return ExplanationView(
        score=explanation.score,
        words=[round(word, 6) for word in explanation.words.tolist()],
        query_regions=mine.regions,
        match_regions=None if other is None else other.regions,
        regions=pairs,
        cells=[
            CellPair(
                query=divmod(int(cells.query[at]), columns),
                match=divmod(int(cells.reference[at]), columns),
                gain=round(float(explanation.gains[at]), 6),
            )
            for at in order
        ],
        grid=encoder.grid,
    )


def _listed(encoder: Encoder, regions: Regions | None, losses: np.ndarray | None) -> _Listed | None:
    if regions is None or losses is None:
        return None
    grids = layer_grids(encoder)
    names, corners = list(grids), boxes(regions, list(grids.values()), 1.0, 1.0)
    words = assign(regions.features, encoder.centers) if len(regions) else np.empty(0, np.int64)
    chosen = [int(index) for index in np.argsort(-losses, kind="stable")[:LISTED]]
    listed = []
    for index in chosen:
        left, top, right, bottom = (round(corner, 4) for corner in corners[index].tolist())
        listed.append(
            ExplainedRegion(
                layer=names[regions.layers[index]],
                word=int(words[index]),
                box=RelativeBox(left=left, top=top, right=right, bottom=bottom),
                loss=round(float(losses[index]), 6),
            )
        )
    return _Listed(chosen, listed)


def draw_explanation(
    shown: ExplanationView, query: Pixels, match: Pixels, inliers: Sequence[KeypointPair] = ()
) -> bytes:
    """A PNG of both frames side by side: inliers are joined by lines, or matching cells, or regions.

    Where there are fewer than eight inliers, the cells are joined; without a second stage, the regions, and those that
    contribute to the score are outlined.

    Args:
        query, match: uint8 [H, W, 3], BGR.
        inliers: the result of geometric verification.
    """
    if len(inliers) >= LEAST_MATCHES:
        lines = [DrawnLine(pair.query, pair.match, 0.0) for pair in inliers[:DRAWN]]
        return side_by_side(query, match, lines, ([], []))
    sides = (shown.query_regions, shown.match_regions or [])
    outlines = ([], []) if shown.cells else (_outlines(sides[0]), _outlines(sides[1]))
    return side_by_side(query, match, _lines(shown), outlines)


def _outlines(regions: Sequence[ExplainedRegion]) -> list[DrawnOutline]:
    most = max((region.loss for region in regions), default=0.0)
    drawn = [region for region in regions if region.loss > 0]
    return [DrawnOutline((one.box.left, one.box.top, one.box.right, one.box.bottom), one.loss / most) for one in drawn]


def _lines(shown: ExplanationView) -> list[DrawnLine]:
    if shown.cells:
        rows, columns = shown.grid
        most = max(pair.gain for pair in shown.cells) or 1.0

        def centre(cell: tuple[int, int]) -> tuple[float, float]:
            return (cell[1] + 0.5) / columns, (cell[0] + 0.5) / rows

        return [DrawnLine(centre(pair.query), centre(pair.match), pair.gain / most) for pair in shown.cells[:DRAWN]]
    if shown.match_regions is None:
        return []
    ends = [(shown.query_regions[pair.query].box, shown.match_regions[pair.match].box) for pair in shown.regions]
    return [DrawnLine(_middle(a), _middle(b), 0.0) for a, b in ends[:DRAWN]]


def _middle(box: RelativeBox) -> tuple[float, float]:
    return (box.left + box.right) / 2, (box.top + box.bottom) / 2

"""The similarity of two traverses of a map: a matrix of scores, as a picture, as bytes, or as JSON about it."""

from __future__ import annotations

import hashlib
from collections import OrderedDict
from dataclasses import dataclass
from functools import cached_property
from typing import Annotated

import cv2
import numpy as np
from anyio import CapacityLimiter, to_thread
from fastapi import APIRouter, Depends, Query, Request
from numpy.typing import NDArray
from pydantic import Field
from starlette.responses import JSONResponse, Response

from core import errors
from core.judgement.alignment import SharedStretch
from core.maps import own_poses
from core.method.encoder import Encoder
from core.recognition.stages import neighborhood_of
from core.store import Map
from core.upkeep.similarity import NONE, GreyScale, Rows, counterparts, nearest_by_pose, score_pairs, stretches_of
from service.errors.faults import EncoderNotInstalled, TooManyPairs
from service.errors.problems import problem_documentation
from service.http.headers import preferred
from service.http.openapi import BINARY
from service.http.routing import EngineDep, FromState, MapId, milliseconds_since, rounded, single_values, started
from service.http.schemas import Parameters
from service.jobs.context import creation_time
from service.upkeep.alignment import TraversesToAlign
from service.upkeep.schemas import ComparedTraverse, SharedPath, SimilarityScale, SimilarityView

router = APIRouter(prefix="/v1/maps/{map}", tags=["upkeep"], dependencies=[Depends(single_values)])

JSON, OCTETS, PNG = "application/json", "application/octet-stream", "image/png"

MOST_CACHED = 2
"""The number of matrices that are cached: the JSON and the picture of a matrix are fetched one after the other."""


class SimilarityParameters(Parameters):
    """Which traverses are compared."""

    query: str = Field(min_length=1, max_length=128, description="The traverse of the rows.", examples=["tuesday"])
    reference: str = Field(
        min_length=1, max_length=128, description="The traverse of the columns.", examples=["monday"]
    )


@dataclass(frozen=True)
class Matrix:
    """The scores of two traverses, float32 [Q, R], and what follows from them."""

    scores: NDArray[np.float32]

    @cached_property
    def scale(self) -> GreyScale:
        """Its scale."""
        return GreyScale.of(self.scores)

    @cached_property
    def values(self) -> NDArray[np.uint8]:
        """The scores as 8-bit values, uint8 [Q, R]."""
        return self.scale.values(self.scores)

    @cached_property
    def png(self) -> bytes:
        """The values as a grey picture, a row for each query."""
        return cv2.imencode(".png", self.values, [cv2.IMWRITE_PNG_COMPRESSION, 1])[1].tobytes()

    @cached_property
    def stretches(self) -> list[SharedStretch]:
        """The stretches that the traverses share."""
        return stretches_of(self.scores)


class Matrices:
    """The matrices that were made last, and the turn of the next one: they are made one at a time, in a thread."""

    def __init__(self) -> None:
        self.turn = CapacityLimiter(1)
        self._cached: OrderedDict[tuple[str, str], Matrix] = OrderedDict()

    def of(self, map_: Map, traverses: TraversesToAlign, encoder: Encoder, queries: Rows, references: Rows) -> Matrix:
        """The matrix of two traverses; call it in the turn.

        Raises:
            UnknownPlace, StorageFailure.
        """
        rows = hashlib.sha256(queries.tobytes() + b"/" + references.tobytes()).hexdigest()
        key = (f"{map_.record.id} {creation_time(map_)}", rows)
        found = self._cached.pop(key, None)
        if found is None:
            found = Matrix(score_pairs(traverses.snapshot, encoder, queries, references))
        self._cached[key] = found
        while len(self._cached) > MOST_CACHED:
            self._cached.popitem(last=False)
        return found


@router.get(
    "/similarity",
    response_model=SimilarityView,
    responses={
        200: {
            "description": "About the matrix, or the matrix itself.",
            "content": {PNG: {"schema": BINARY}, OCTETS: {"schema": BINARY}},
        },
        **problem_documentation(errors.UnknownSequence, TooManyPairs, EncoderNotInstalled),
    },
)
async def compare_traverses(
    map_id: MapId,
    options: Annotated[SimilarityParameters, Query()],
    request: Request,
    engine: EngineDep,
    matrices: Annotated[Matrices, Depends(FromState("similarity_matrices"))],
) -> Response:
    """Compare two traverses of a map frame by frame: the matrix of their scores, and the way through it.

    With `Accept: image/png` the matrix is a grey picture with a row for each frame of `query` and a column for each of
    `reference`; with `application/octet-stream` it is the same values, row by row. JSON, the default, gives its size
    and scale, the places, the stretches that the traverses share by sequence matching, and what poses and alignment
    say. The scores are those of the first stage. One matrix is made at a time; the latest are cached for a moment, so
    that the picture after the JSON costs nothing.
    """
    map_ = await engine.map(map_id)
    encoder = await engine.queue.load(map_.record.encoder)
    wanted = preferred(request.headers.get("accept"), JSON, PNG, OCTETS)
    most = engine.settings.max_similarity_pairs

    def make() -> Response:
        traverses = TraversesToAlign(map_)
        queries, references = (traverses.frames(name) for name in (options.query, options.reference))
        if len(queries) * len(references) > most:
            raise TooManyPairs(
                f"The traverses have {len(queries)} and {len(references)} frames, which makes more than {most} pairs."
            )
        matrix = matrices.of(map_, traverses, encoder, queries, references)
        if wanted == PNG:
            return Response(matrix.png, media_type=PNG, headers=_about(matrix))
        if wanted == OCTETS:
            return Response(matrix.values.tobytes(), media_type=OCTETS, headers=_about(matrix))
        view = _view(map_, traverses, encoder, options, (queries, references), matrix)
        view.milliseconds = rounded({"total": milliseconds_since(started(request))})
        return JSONResponse(view.model_dump(mode="json"))

    return await to_thread.run_sync(make, limiter=matrices.turn)


def _about(matrix: Matrix) -> dict[str, str]:
    """Headers with the size and the scale of a matrix."""
    rows, columns = matrix.values.shape
    scale = {"X-Low": str(matrix.scale.low), "X-High": str(matrix.scale.high)}
    return {"X-Rows": str(rows), "X-Columns": str(columns), **scale}


def _view(
    map_: Map,
    traverses: TraversesToAlign,
    encoder: Encoder,
    options: SimilarityParameters,
    rows: tuple[Rows, Rows],
    matrix: Matrix,
) -> SimilarityView:
    queries, references = (own_poses(map_.counterparts, traverses.snapshot.whereabouts_at(some), some) for some in rows)
    radius = map_.record.same_place_radius
    truth, aligned = nearest_by_pose(queries, references, neighborhood_of(map_)), counterparts(queries, references)
    return SimilarityView(
        map=map_.record.id,
        encoder=encoder.identity,
        query=ComparedTraverse(sequence=options.query, places=[traverses.places[row].id for row in rows[0].tolist()]),
        reference=ComparedTraverse(
            sequence=options.reference, places=[traverses.places[row].id for row in rows[1].tolist()]
        ),
        rows=len(queries),
        columns=len(references),
        scale=SimilarityScale(low=matrix.scale.low, high=matrix.scale.high),
        stretches=[
            SharedPath(gain=one.gain, query=one.first.tolist(), reference=one.second.tolist())
            for one in matrix.stretches
        ],
        truth=None if truth is None else _columns(truth),
        radius=radius,
        aligned=bool((aligned != NONE).any()),
        counterparts=_columns(aligned) if (aligned != NONE).any() else None,
        milliseconds={},
    )


def _columns(found: Rows) -> list[int | None]:
    return [None if column == NONE else column for column in found.tolist()]

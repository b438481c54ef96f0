"""The pictures of explanations: a query and its best match, side by side."""

from __future__ import annotations

from typing import Annotated

from fastapi import APIRouter, Depends, Path
from starlette.responses import Response

from service.errors.faults import UnknownExplanation
from service.errors.problems import problem_documentation
from service.http.dependencies import EngineDep, FromState, MapId, single_values
from service.http.openapi import BINARY
from service.queries.pictures import ExplanationPictures
from service.queries.statistics import key_of

PicturesDep = Annotated[ExplanationPictures, Depends(FromState("explanation_pictures"))]

router = APIRouter(prefix="/v1/maps/{map}/explanations", tags=["queries"], dependencies=[Depends(single_values)])


@router.get(
    "/{explanation}",
    response_class=Response,
    responses={
        200: {"description": "Both frames side by side.", "content": {"image/png": {"schema": BINARY}}},
        **problem_documentation(UnknownExplanation),
    },
)
def see_explanation(
    map_id: MapId,
    name: Annotated[str, Path(alias="explanation", max_length=64, description="As the answer to the query named it.")],
    engine: EngineDep,
    pictures: PicturesDep,
) -> Response:
    """See a query beside its best match: cells (or regions) that answer each other are joined by lines.

    `picture` in the explanation of a query is the path; the last pictures can be fetched for some minutes.
    """
    picture = pictures.fetch(key_of(engine.atlas.find(map_id)), name)
    return Response(picture, media_type="image/png", headers={"Cache-Control": "private, max-age=600"})

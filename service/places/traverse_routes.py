"""Traverses: the places of one sequence, as a whole."""

from __future__ import annotations

from fastapi import APIRouter, Depends, Request

from core import errors
from service.errors.problems import problem_documentation
from service.http.dependencies import EngineDep, MapId, Page, SequenceName, single_values
from service.places.schemas import ForgottenSequence, SequencePage

router = APIRouter(
    prefix="/v1/maps/{map}/sequences",
    tags=["sequences"],
    dependencies=[Depends(single_values)],
)


@router.get("", responses=problem_documentation(errors.InvalidCursor))
def list_sequences(map_id: MapId, page: Page, engine: EngineDep) -> SequencePage:
    """List the traverses of a map in the order of their names."""
    summaries, next_cursor = engine.atlas.get(map_id).sequences(page.cursor, page.limit)
    return SequencePage(items=summaries, next_cursor=next_cursor)


@router.delete("/{sequence}", responses=problem_documentation(errors.UnknownSequence))
def delete_sequence(map_id: MapId, sequence: SequenceName, request: Request, engine: EngineDep) -> ForgottenSequence:
    """Forget all places of a traverse at once."""
    count = engine.atlas.get(map_id).forget_sequence(sequence)
    request.state.noted = {"places": count}
    return ForgottenSequence(name=sequence, places=count)

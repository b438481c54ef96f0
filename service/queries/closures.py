"""Loop closure: look for a frame among the places of a map and, if nobody knows it, make it a place; no HTTP."""

from __future__ import annotations

from dataclasses import dataclass, replace

from core.places import Place
from core.recognition.recognition import Answer, locate
from core.recognition.selection import Selection
from core.storage import Map
from service.engine.engine import Engine
from service.engine.queue import Encoded
from service.errors.faults import PlaceTaken
from service.places.enrolment import Candidate, describe_candidate, digest_of


@dataclass(frozen=True)
class Closure:
    """What became of a frame.

    enrolled: its place; None if the frame is that of another place, or may be.
    created: whether the place was made now.
    """

    located: Answer
    enrolled: Place | None
    created: bool


def close_loop(
    engine: Engine, map_: Map, candidate: Candidate, encoded: Encoded, k: int, selection: Selection | None
) -> Closure:
    """Locate a frame and, if the verdict is ``unknown``, enrol it: as one step, so that of two frames of one new place
    that come together the second finds the first.  Blocks; call it in a thread.

    A repeated request finds the same as the first did: its own place is left out of the search.

    Args:
        encoded: the candidate's frame, which has regions.
        selection: what is known of the place asked for; None: nothing.

    Raises:
        PlaceTaken: the candidate's id is that of a place with another frame.
        StorageFull, StorageFailure: nothing was enrolled.
    """
    digest = digest_of(candidate)
    enrolment = describe_candidate(engine, map_, candidate, digest, encoded)
    with engine.writing(map_.record.id):
        known = map_.digest(candidate.id)
        if known is not None and known != digest:
            raise PlaceTaken(f"The place {candidate.id!r} has another frame; PUT replaces it.")
        if known is not None:
            selection = replace(selection or Selection(), without=candidate.id)
        (located,) = locate(map_, encoded.encoder, [encoded.encoding], k, selection)
        if known is not None:
            return Closure(located, map_.place(candidate.id), created=False)
        if located.judgement.verdict != "unknown":
            return Closure(located, None, created=False)
        ((place, _),) = map_.enrol([enrolment])
        return Closure(located, place, created=True)

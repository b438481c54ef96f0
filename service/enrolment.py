"""From frames as they were sent to places that are stored; one commit for all that are good; no HTTP."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field

from core.errors import NoRegions, UnknownPlace
from core.images import encode_thumbnail
from core.places import Place, PlaceFields
from core.storage import Change, Enrolment, Map
from service.engine import Engine, in_thread
from service.inference import Encoded, Patience


@dataclass(frozen=True)
class Candidate:
    """One frame that a caller wants remembered as the place ``id``."""

    id: str
    fields: PlaceFields
    data: bytes


@dataclass(frozen=True)
class Enrolled:
    """A place as it was stored, and what changed by it.

    milliseconds: of the stages of encoding; empty where the same picture was known already.
    """

    place: Place
    change: Change
    milliseconds: Mapping[str, float] = field(default_factory=dict)


def _raise(_index: int, error: Exception) -> None:
    raise error


async def enrol(
    engine: Engine,
    map_: Map,
    candidates: Sequence[Candidate],
    patience: Patience,
    reject: Callable[[int, Exception], None] = _raise,
) -> dict[int, Enrolled]:
    """Enrol frames; a picture that the place shows already is not encoded again.

    Nothing is stored before all frames are encoded, so a request that is dropped leaves nothing.

    Args:
        candidates: of different ids.
        reject: is told the index of a frame that cannot be encoded and why; it may raise to end all.

    Returns:
        What was stored, by index; durable, and seen by every later query.

    Raises:
        QueueFull, DeadlineExceeded, ClientGone: nothing was stored.
        StorageFull, StorageFailure: nothing of the last commit was kept.
    """
    digests = await in_thread(lambda: [hashlib.sha256(candidate.data).digest() for candidate in candidates])
    stored: dict[int, Enrolled] = {}
    open_ = set(range(len(candidates)))
    known = await in_thread(lambda: {i for i in open_ if map_.digest(candidates[i].id) == digests[i]})
    while open_:
        enrolments: dict[int, Enrolment] = {}
        times: dict[int, Mapping[str, float]] = {}
        if open_ - known:
            with engine.inference.place_in_queue():
                for i in sorted(open_ - known):
                    try:
                        encoded = await engine.encode_for(map_, candidates[i].data, patience)
                        enrolments[i] = await in_thread(_prepare, engine, map_, candidates[i], digests[i], encoded)
                        times[i] = encoded.milliseconds
                    except Exception as error:
                        reject(i, error)
        fields = {i: candidates[i] for i in known}
        done = await in_thread(_commit, engine, map_, enrolments, {i: (fields[i], digests[i]) for i in fields})
        stored.update({i: Enrolled(place, change, times.get(i, {})) for i, (place, change) in done.items()})
        # Known a moment ago, but given another picture or forgotten in between: these have to be encoded.
        open_, known = known - set(done), set()
    return stored


def _prepare(engine: Engine, map_: Map, candidate: Candidate, digest: bytes, encoded: Encoded) -> Enrolment:
    """What to commit for one frame: descriptors, fields, and of the picture what the map keeps."""
    encoding, keep = encoded.encoding, map_.record.keep
    if len(encoding.regions) == 0:
        raise NoRegions("The frame has no region of interest: it is blank, or nearly so.")
    thumbnail = encode_thumbnail(encoded.pixels, engine.settings.thumbnail_side) if keep == "thumbnail" else None
    return Enrolment(
        id=candidate.id,
        fields=candidate.fields,
        descriptor=encoding.descriptor,
        local=encoding.local,
        regions=len(encoding.regions),
        digest=digest,
        thumbnail=thumbnail,
        image=candidate.data if keep == "image" else None,
    )


def _commit(
    engine: Engine,
    map_: Map,
    enrolments: Mapping[int, Enrolment],
    known: Mapping[int, tuple[Candidate, bytes]],
) -> dict[int, tuple[Place, Change]]:
    """Store new pictures in one commit, and new fields of pictures that are still the ones known."""
    done: dict[int, tuple[Place, Change]] = {}
    # No other picture may take the place between the look at its digest and the writing of its fields.
    with engine.writing(map_.record.id):
        if enrolments:
            done.update(zip(enrolments, map_.enrol(list(enrolments.values())), strict=True))
        for i, (candidate, digest) in known.items():
            try:
                if map_.digest(candidate.id) == digest:
                    done[i] = map_.set_fields(candidate.id, candidate.fields)
            except UnknownPlace:
                continue
    return done

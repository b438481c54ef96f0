"""From frames as they were sent to places that are stored; one commit for all that are good; no HTTP."""

from __future__ import annotations

import hashlib
import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import aclosing, nullcontext
from dataclasses import dataclass, field

from core.frames.masks import Mask
from core.places import Place, PlaceFields
from core.recognition.recognition import describe, frame_digest
from core.storage import Change, Enrolment, Map, SameFrame
from service.engine.engine import Engine
from service.engine.queue import AHEAD, Encoded, RequestDeadline
from service.errors.faults import FrameNeeded, TooManyPlaces
from service.places.batch_order import Sequel, Stage
from service.worker_threads import in_thread


@dataclass(frozen=True)
class Candidate:
    """One frame that a caller wants remembered as the place ``id``.

    data: the bytes of its file; None where the place is to keep the frame that it holds.
    sha256: digest of that frame, 32 bytes; None where there are ``data``.
    """

    id: str
    fields: PlaceFields
    data: bytes | None
    mask: Mask | None = None
    sha256: bytes | None = None


@dataclass(frozen=True)
class Enrolled:
    """A place as it was stored, and what changed by it.

    milliseconds: of the stages of encoding; empty where the same picture was known already.
    """

    place: Place
    change: Change
    milliseconds: Mapping[str, float] = field(default_factory=dict)


def digest_of(candidate: Candidate) -> bytes:
    """By what its map knows the candidate's frame, so that a frame is not encoded twice."""
    sha256 = candidate.sha256 or hashlib.sha256(candidate.data or b"").digest()
    return frame_digest(sha256, candidate.mask)


def describe_candidate(engine: Engine, map_: Map, candidate: Candidate, digest: bytes, encoded: Encoded) -> Enrolment:
    """What the map stores of a candidate whose frame was encoded.

    Raises:
        NoRegions: the frame is blank, or nearly so.
    """
    return describe(
        map_,
        candidate.id,
        candidate.fields,
        candidate.data,
        digest,
        encoded.pixels,
        encoded.encoding,
        engine.settings.thumbnail_side,
    )


def _raise(_index: int, error: Exception) -> None:
    raise error


async def enrol(
    engine: Engine,
    map_: Map,
    candidates: Sequence[Candidate],
    deadline: RequestDeadline,
    reject: Callable[[int, Exception], None] = _raise,
    queued: bool = True,
    sequel: Sequel | None = None,
) -> dict[int, Enrolled]:
    """Enrol frames; one that the place holds already is not encoded again.

    Nothing is stored before all frames are encoded, so a request that is dropped leaves nothing.

    Args:
        candidates: of different ids.
        reject: is told the index of a frame that cannot be encoded and why; it may raise to end all.
        queued: it takes a place in the queue, as a request does; a job stands back instead.
        sequel: in line behind another batch, which is to be encoded and stored before.

    Returns:
        What was stored, by index; durable, and seen by every later query.

    Raises:
        QueueFull, DeadlineExceeded, ClientGone, BatchOutOfOrder: nothing was stored.
        StorageFull, StorageFailure: nothing of the last commit was kept.
    """
    digests = await in_thread(lambda: [digest_of(candidate) for candidate in candidates])
    stored: dict[int, Enrolled] = {}
    open_ = set(range(len(candidates)))
    known = await in_thread(lambda: {i for i in open_ if map_.digest(candidates[i].id) == digests[i]})
    if sequel is not None:
        await sequel.wait_for(Stage.ENCODED)
    while open_:
        enrolments: dict[int, Enrolment] = {}
        times: dict[int, Mapping[str, float]] = {}
        sent = [(i, data) for i in sorted(open_ - known) if (data := candidates[i].data) is not None]
        for i in sorted(open_ - known - {i for i, _ in sent}):
            reject(i, FrameNeeded(f"The place {candidates[i].id!r} does not hold the frame of this digest; send it."))
        if sent:
            new, bodies = [i for i, _ in sent], [data for _, data in sent]
            masks = [candidates[i].mask for i in new]
            with engine.queue.place(len(sent)) if queued else nullcontext():
                async with aclosing(engine.encode_many(map_.record.encoder, bodies, deadline, masks)) as outcomes:
                    async for some in outcomes:
                        frames = {new[index]: outcome for index, outcome in some}
                        # Thumbnails are made, and pixels let go, while the encoder is at the next frames.
                        prepared = await in_thread(_prepare_all, engine, map_, candidates, digests, frames)
                        for i, made in prepared.items():
                            if isinstance(made, Exception):
                                reject(i, made)
                            else:
                                enrolments[i], times[i] = made
                        if sequel is not None and len(sent) - len(enrolments) <= AHEAD:
                            sequel.reach(Stage.ENCODED)
        if sequel is not None:
            sequel.reach(Stage.ENCODED)
            await sequel.wait_for(Stage.STORED)
        done = await in_thread(
            _commit, engine, map_, enrolments, {i: (candidates[i], digests[i]) for i in sorted(known)}
        )
        stored.update({i: Enrolled(place, change, times.get(i, {})) for i, (place, change) in done.items()})
        # Known a moment ago, but given another picture or forgotten in between: these have to be encoded.
        open_, known = known - set(done), set()
    return stored


def _prepare_all(
    engine: Engine,
    map_: Map,
    candidates: Sequence[Candidate],
    digests: Sequence[bytes],
    frames: Mapping[int, Encoded | Exception],
) -> dict[int, tuple[Enrolment, Mapping[str, float]] | Exception]:
    """What to commit for each frame and its times, or why it cannot be enrolled."""
    made: dict[int, tuple[Enrolment, Mapping[str, float]] | Exception] = {}
    for i, outcome in frames.items():
        try:
            if isinstance(outcome, Exception):
                raise outcome
            made[i] = describe_candidate(engine, map_, candidates[i], digests[i], outcome), outcome.milliseconds
        except Exception as error:
            made[i] = error
    return made


def _commit(
    engine: Engine,
    map_: Map,
    enrolments: Mapping[int, Enrolment],
    known: Mapping[int, tuple[Candidate, bytes]],
) -> dict[int, tuple[Place, Change]]:
    """Store new pictures, and new fields of pictures that are still the ones known, in one commit.

    In the order in which they were given: it is the order of the places in their sequence.
    """
    items: dict[int, Enrolment | SameFrame] = dict(enrolments)
    items |= {i: SameFrame(candidate.id, candidate.fields, digest) for i, (candidate, digest) in known.items()}
    items = dict(sorted(items.items()))
    began = time.perf_counter()
    with engine.writing(map_.record.id):
        if enrolments:
            check_places(engine, map_, [enrolment.id for enrolment in enrolments.values()])
        found = zip(items, map_.transfer.enrol(list(items.values())), strict=True)
        done = {i: stored for i, stored in found if stored is not None}
    engine.metrics.commits.observe(time.perf_counter() - began)
    return done


def check_places(engine: Engine, map_: Map, ids: Sequence[str]) -> None:
    """See that a map has room for places of these ids, those that it has included; call it in possession of the map.

    Raises:
        TooManyPlaces: it has not.
    """
    most, there = engine.settings.max_places, map_.count_places()
    if there + len(ids) <= most:  # nearly always
        return
    if there + sum(row is None for row in map_.rows_of(ids)) > most:
        raise TooManyPlaces(f"The map {map_.record.id} has {there} places of at most {most}.")

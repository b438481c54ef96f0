"""Enrolment: frames are encoded and stored as places, all of a request in one commit."""

from __future__ import annotations

import hashlib
import time
from collections.abc import Mapping, Sequence
from contextlib import aclosing, nullcontext
from dataclasses import dataclass, field, replace

from core.frames.masks import Mask
from core.maps import Change, Enrolment, Reject, SameFrame, refuse_all
from core.places import Place, PlaceFields, look_address
from core.recognition.recognition import describe, frame_digest
from core.store import Map
from service.engine.encoder_threads import AHEAD
from service.engine.encoders import Encoded
from service.engine.engine import Engine, camera_mask
from service.engine.queue import RequestDeadline
from service.errors.faults import FrameNeeded, PlacesTaken, TooManyPlaces
from service.places.batch_order import BatchTurn, Stage
from service.places.place_events import tell_enrolment
from service.worker_threads import in_thread


@dataclass(frozen=True)
class LookOrigin:
    """Where a look comes from.

    run: the run from which it was learnt; None: a person added it.
    least: the score of two stages from which a match with it is believed; None: from any.
    """

    run: str | None = None
    least: float | None = None


@dataclass(frozen=True)
class FrameToEnrol:
    """One frame that a caller wants to store as the place ``id``.

    fields: pose, time, sequence, camera and metadata of the place.
    data: the bytes of the file; None if the place already holds the frame and only its fields are set.
    mask: the part of the frame that is ignored.
    sha256: the digest of the frame that the place holds, 32 bytes; None if there are ``data``.
    origin: of a look.
    """

    id: str
    fields: PlaceFields
    data: bytes | None
    mask: Mask | None = None
    sha256: bytes | None = None
    origin: LookOrigin = LookOrigin()


@dataclass(frozen=True)
class Enrolled:
    """A stored place.

    change: whether the place was created, updated or replaced, or is unchanged.
    milliseconds: the times of the stages of encoding; empty if the map had encoded the frame before.
    """

    place: Place
    change: Change
    milliseconds: Mapping[str, float] = field(default_factory=dict)


@dataclass(frozen=True)
class EnrolledLook:
    """A stored look.

    name: of the look.
    change: whether it was created, or is unchanged.
    milliseconds: as of :class:`Enrolled`.
    """

    name: str
    change: Change
    milliseconds: Mapping[str, float]


def digest_of(frame: FrameToEnrol) -> bytes:
    """The ``frame_digest`` of a frame, 32 bytes; a map does not encode a frame again that it knows by this digest."""
    sha256 = frame.sha256 or hashlib.sha256(frame.data or b"").digest()
    return frame_digest(sha256, frame.mask)


def describe_frame(engine: Engine, map_: Map, frame: FrameToEnrol, digest: bytes, encoded: Encoded) -> Enrolment:
    """The record that a map stores of an encoded frame.

    Raises:
        NoRegions: the frame is blank, or nearly so.
    """
    described = describe(
        map_,
        frame.id,
        frame.fields,
        frame.data,
        digest,
        encoded.pixels,
        encoded.encoding,
        engine.settings.thumbnail_side,
        encoded.keypoints,
        encoded.few_values,
    )
    return replace(described, run=frame.origin.run, least=frame.origin.least)


async def enrol(
    engine: Engine,
    map_: Map,
    frames: Sequence[FrameToEnrol],
    deadline: RequestDeadline,
    reject: Reject = refuse_all,
    queued: bool = True,
    batch_turn: BatchTurn | None = None,
    replace_places: bool = True,
) -> dict[int, Enrolled]:
    """Encode frames and store them as places; a frame that its place already holds is not encoded again.

    Nothing is stored before all frames are encoded, so a request that is aborted leaves nothing behind.

    Args:
        frames: frames with different ids.
        reject: is called with the index of a frame that cannot be encoded or stored, and the error; it may raise to
            abort all.
        queued: whether the frames take a place in the queue, as those of a request do, but not those of a job.
        batch_turn: the turn of this batch, if it has to be encoded and stored after another one.
        replace_places: whether a place of another frame is replaced; else ``PlacesTaken`` rejects the frame.

    Returns:
        The stored places by index; they are on disk, and every later query finds them.

    Raises:
        QueueFull, DeadlineExceeded, ClientGone, BatchOutOfOrder: nothing was stored.
        TooManyPlaces: the map has no room for the places.
        StorageFull, StorageFailure: nothing of the last commit was stored.
        Others: errors of ``reject``.
    """
    digests = await in_thread(lambda: [digest_of(frame) for frame in frames])
    stored: dict[int, Enrolled] = {}
    open_, refused = set(range(len(frames))), set[int]()

    def refuse(index: int, error: Exception) -> None:
        refused.add(index)
        reject(index, error)

    there = await in_thread(lambda: {i: map_.digest(frames[i].id) for i in open_})
    known = {i for i in open_ if there[i] == digests[i]}
    for i in sorted(open_ - known) if not replace_places else ():
        if there[i] is not None:
            refuse(i, PlacesTaken(f"The place {frames[i].id!r} has another frame; choose another id, or send replace."))
            open_.discard(i)
    if batch_turn is not None:
        await batch_turn.wait_for(Stage.ENCODED)
    while open_:
        enrolments: dict[int, Enrolment] = {}
        times: dict[int, Mapping[str, float]] = {}
        sent = [(i, data) for i in sorted(open_ - known) if (data := frames[i].data) is not None]
        for i in sorted(open_ - known - {i for i, _ in sent}):
            refuse(i, FrameNeeded(f"The place {frames[i].id!r} does not hold the frame of this digest; send it."))
        if sent:
            new, bodies = [i for i, _ in sent], [data for _, data in sent]
            masks = [frames[i].mask for i in new]
            identity, keypoints = map_.record.encoder, map_.record.verification
            with engine.queue.place(len(sent)) if queued else nullcontext():
                async with aclosing(engine.queue.encode_many(identity, bodies, deadline, masks, keypoints)) as outcomes:
                    async for some in outcomes:
                        encoded = {new[index]: outcome for index, outcome in some}
                        # Thumbnails are made, and pixels freed, while the encoder works at the next frames.
                        prepared = await in_thread(_prepare_all, engine, map_, frames, digests, encoded)
                        for i, made in prepared.items():
                            if isinstance(made, Exception):
                                refuse(i, made)
                            else:
                                enrolments[i], times[i] = made
                        if batch_turn is not None and len(sent) - len(enrolments) <= AHEAD:
                            batch_turn.report(Stage.ENCODED)
        if batch_turn is not None:
            batch_turn.report(Stage.ENCODED)
            await batch_turn.wait_for(Stage.STORED)
        held = {i: (frames[i], digests[i]) for i in sorted(known)}
        done = await in_thread(_commit, engine, map_, enrolments, held, refuse)
        stored.update({i: Enrolled(place, change, times.get(i, {})) for i, (place, change) in done.items()})
        # Places that were deleted, or got another frame, since their digest was read: their frames have to be encoded.
        open_, known = known - set(done) - refused, set()
    return stored


async def enrol_look(
    engine: Engine,
    map_: Map,
    place_id: str,
    data: bytes,
    fields: PlaceFields,
    deadline: RequestDeadline,
    origin: LookOrigin = LookOrigin(),
) -> EnrolledLook:
    """Add a frame to the looks of a place.

    Args:
        fields: time and camera of the frame.

    Raises:
        UnknownPlace, RepeatedLook, LookNameTaken, TooManyLooks: the place cannot have it.
        UnknownCamera, and what ``enrol`` raises.
    """
    frame = FrameToEnrol(place_id, fields, data, await camera_mask(map_, fields.camera), origin=origin)
    await in_thread(map_.place, place_id)  # an unknown place is refused before its frame is encoded
    name = (await in_thread(digest_of, frame)).hex()[:16]
    stored = (await enrol(engine, map_, [replace(frame, id=look_address(place_id, name))], deadline))[0]
    return EnrolledLook(name, stored.change, stored.milliseconds)


def _prepare_all(
    engine: Engine,
    map_: Map,
    frames: Sequence[FrameToEnrol],
    digests: Sequence[bytes],
    outcomes: Mapping[int, Encoded | Exception],
) -> dict[int, tuple[Enrolment, Mapping[str, float]] | Exception]:
    """For each frame the record to commit and the times of its stages, or the error that keeps it from being stored."""
    made: dict[int, tuple[Enrolment, Mapping[str, float]] | Exception] = {}
    for i, outcome in outcomes.items():
        try:
            if isinstance(outcome, Exception):
                raise outcome
            made[i] = describe_frame(engine, map_, frames[i], digests[i], outcome), outcome.milliseconds
        except Exception as error:
            made[i] = error
    return made


def _commit(
    engine: Engine,
    map_: Map,
    enrolments: Mapping[int, Enrolment],
    known: Mapping[int, tuple[FrameToEnrol, bytes]],
    refuse: Reject,
) -> dict[int, tuple[Place, Change]]:
    """Store new frames, and new fields of frames that the map still holds, in one commit.

    They are stored in the order of the request, which is the order of the places in their sequence.

    Args:
        known: the frames that the map held when their digests were read, with these digests.
        refuse: is called with the index of a frame that the map does not take.
    """
    items: dict[int, Enrolment | SameFrame] = dict(enrolments)
    items |= {i: SameFrame(frame.id, frame.fields, digest) for i, (frame, digest) in known.items()}
    items = dict(sorted(items.items()))
    order = list(items)
    began = time.perf_counter()
    with engine.writing(map_.record.id):
        if enrolments:
            check_place_limit(engine, map_, [enrolment.id for enrolment in enrolments.values()])
        stored = map_.enrol(list(items.values()), lambda position, error: refuse(order[position], error))
        found = zip(order, stored, strict=True)
        done = {i: one for i, one in found if one is not None}
    engine.metrics.commits.observe(time.perf_counter() - began)
    tell_enrolment(engine, map_, list(done.values()))
    return done


def check_place_limit(engine: Engine, map_: Map, ids: Sequence[str]) -> None:
    """Check that a map has room for places of these ids, some of which it may have already.

    Call it while holding the map's lock (``engine.writing``).

    Raises:
        TooManyPlaces: the map would have too many places.
    """
    most, there = engine.settings.max_places, map_.count_places()
    if there + len(ids) <= most:  # nearly always
        return
    if there + sum(row is None for row in map_.rows_of(ids)) > most:
        raise TooManyPlaces(f"The map {map_.record.id} has {there} places of at most {most}.")

# Written from _async/enrolment.py by scripts/client.  Do not edit.
"""Enrolment of many frames, without sending those that the service has already.

Each batch names the one before, after which it is to be stored: that keeps the order of the places in their sequence,
on which verdicts depend.
"""

from __future__ import annotations

import secrets
from collections import deque
from collections.abc import Container, Iterable, Iterator, Mapping, Sequence
from typing import Any

from placerec_client import models, problems
from placerec_client._sync.batches import Batch, Batches, Sent
from placerec_client._sync.concurrency import Task, in_thread
from placerec_client._sync.connection import Connection
from placerec_client._sync.jobs import Job
from placerec_client.answers import problem_of
from placerec_client.batches import (
    BATCH_BYTES,
    KNOWN_AT_ONCE,
    OF_THE_FRAME,
    OUT_OF_ORDER,
    TOO_SLOW,
    Enrolled,
    NewPlace,
    Read,
    outcome_of,
    read_place,
    too_large,
)
from placerec_client.errors import PlacerecError, Problem, UnexpectedAnswer
from placerec_client.frames import media_type
from placerec_client.requests import Part, dumps, form, form_type, items_of, part_end, part_head

Answered = list[tuple[Read, models.BatchResult | None, PlacerecError | None]]
"""The service's answer for each frame; None for one that could not be read and was not sent."""


class Enrolment(Batches[Read, Enrolled]):
    """Enrols frames in their order.

    Args:
        path: of the places of the map.
        places: the frames to enrol; read in a thread, a batch ahead.
        known: ids that the map has already; for these frames a first request finds out whether it has their bytes.
        options: of the request, such as ``encoder``.
    """

    def __init__(
        self,
        connection: Connection,
        path: str,
        places: Iterable[NewPlace],
        known: Container[str],
        options: Mapping[str, Any],
    ) -> None:
        super().__init__()
        self._connection, self._path, self._options, self._known = connection, path, options, known
        self._places = iter(items_of("places", places))
        self._waiting: deque[NewPlace] = deque()  # read from the places, but not dealt with yet
        self._needed: deque[NewPlace] = deque()  # known, but to be sent all the same

    def read(self) -> Batch[Read, Enrolled] | None:
        """Read the next frames; of known ones ask whether they have to be sent."""
        if not self._needed:
            known = in_thread(self._read_known)
            if known:
                return Batch(self._ask(known), [])
        batch = in_thread(self._read_batch)
        return Batch([], batch) if batch else None

    def _ask(self, known: Sequence[Read]) -> list[Enrolled]:
        """Update the places that have these frames; keep those that have to be sent."""
        settled: list[Enrolled] = []
        for read, item, error in self._post(known, {}):
            if isinstance(error, problems.FrameNeeded):
                self._needed.append(read.place)
            else:
                settled.append(outcome_of(read, item, error, uploaded=False))
        return settled

    def _read_known(self) -> list[Read]:
        known: list[Read] = []
        while len(known) < KNOWN_AT_ONCE and (place := self._peek()) is not None and self._knows(place):
            known.append(read_place(self._waiting.popleft(), digest=True))
        return known

    def _read_batch(self) -> list[Read]:
        batch: list[Read] = []
        size, most = 0, self.pace.frames
        while len(batch) < most and size < BATCH_BYTES:
            if self._needed:
                place = self._needed.popleft()
            elif (following := self._peek()) is None or self._knows(following):
                break
            else:
                place = self._waiting.popleft()
            batch.append(read_place(place))
            size += len(batch[-1].data)
        return batch

    def _knows(self, place: NewPlace) -> bool:
        return isinstance(place, NewPlace) and isinstance(place.id, str) and place.id in self._known

    def _peek(self) -> NewPlace | None:
        if not self._waiting:
            try:
                self._waiting.append(next(self._places))
            except StopIteration:
                return None
        return self._waiting[0]

    def begin(self, batch: Batch[Read, Enrolled], before: Sent[Enrolled] | None) -> Sent[Enrolled]:
        """Begin to send a batch, to be stored after the one before."""
        name = secrets.token_hex(8)

        def send() -> list[Enrolled]:
            return [*batch.known, *self._send(batch.items, name, before)]

        sent = Named(len(batch.items), Task(send))
        sent.name = name
        return sent

    def _send(self, batch: Sequence[Read], name: str, before: Sent[Enrolled] | None = None) -> list[Enrolled]:
        """Send a batch; split it in halves if the service finds it too large."""
        if not batch:
            return []
        order = {"batch": name}
        if isinstance(before, Named) and before.frames:
            order["after"] = before.name
        try:
            return [outcome_of(*one, uploaded=True) for one in self._post(batch, order)]
        except (Problem, UnexpectedAnswer) as refused:
            if "after" in order and before is not None:
                # The error of the batch before comes first; if that batch failed, this one does not matter.
                before.task.result()
                if isinstance(refused, OUT_OF_ORDER):
                    return self._send(batch, name)
            if too_large(refused, len(batch)):
                half = self.pace.halve(len(batch))
                first = self._send(batch[:half], secrets.token_hex(8))
                return first + self._send(batch[half:], name)
            if len(batch) == 1 and refused.status in OF_THE_FRAME:
                return [outcome_of(batch[0], None, refused, uploaded=True)]
            raise

    def _post(self, batch: Sequence[Read], order: Mapping[str, str]) -> Answered:
        """Send one form with the frames that could be read."""
        sent = [one for one in batch if one.error is None]
        items: dict[int, models.BatchResult] = {}
        if sent:
            parts = [Part("places", dumps([one.entry for one in sent]).encode(), "application/json", is_file=False)]
            parts += [Part(one.place.id, one.data, media_type(one.data)) for one in sent if "file" in one.entry]
            content, kind = form(parts)
            found = self._connection.ask(
                models.BatchResults,
                "POST",
                self._path,
                params={**self._options, **order},
                content=content,
                media_type=kind,
                final=TOO_SLOW if len(sent) > 1 else frozenset(),
            )
            items = dict(zip(map(id, sent), found.items, strict=True))
        return [(one, items.get(id(one)), _error(items.get(id(one)))) for one in batch]


class Named(Sent[Enrolled]):
    """A batch under way that others can name."""

    name: str


def _error(item: models.BatchResult | None) -> PlacerecError | None:
    if item is None or item.problem is None:
        return None
    return problem_of(item.problem.model_dump(exclude_none=True), item.status)


def enrol_by_job(connection: Connection, path: str, places: Sequence[NewPlace], options: Mapping[str, Any]) -> Job:
    """Send frames in one long form, which is never in memory as a whole, and return the job that enrols them."""
    boundary = secrets.token_hex(16)
    items_of("places", places)
    entries = in_thread(lambda: [_usable(place).entry for place in places])

    def pieces() -> Iterator[bytes]:
        yield part_head(Part("places", b"", "application/json", is_file=False), boundary)
        yield dumps(entries).encode() + b"\r\n"
        for place in places:
            read = in_thread(_usable, place)
            yield part_head(Part(place.id, b"", media_type(read.data)), boundary) + read.data + b"\r\n"
        yield part_end(boundary)

    params = {**options, "background": True}
    return Job.submit(connection, path, params=params, content=pieces, media_type=form_type(boundary))


def _usable(place: NewPlace) -> Read:
    read = read_place(place)
    if read.error is not None:
        raise read.error
    return read

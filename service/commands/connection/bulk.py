"""Many frames to a service: in batches whose size follows the speed, and none sent that the service holds already.

Two batches are under way at a time, so that one is encoded while the other is stored, and the next is read meanwhile.
Each names the one before, after which it is to be stored: their order is that of the places in their sequence, and a
verdict looks at a place's neighbours there.
"""

from __future__ import annotations

import asyncio
import hashlib
import json
import secrets
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from service.commands.connection.client import Refused, Service, media_type, path_of
from service.commands.manifest import Frame

PATIENCE = 120.0
"""Seconds for which a batch is sent again while the service is overloaded or restarts."""

OF_THE_FRAME = frozenset({400, 413, 415, 422})
"""Statuses that concern one frame; with any other the rest would most likely fail as well."""

OUT_OF_ORDER = "batch-out-of-order"
"""The problem of a batch that came before the one that it is to follow."""

TOO_SLOW = frozenset({"deadline-exceeded"})
"""Problems of a batch that it would have again, but smaller ones may not."""

FIRST_BATCH, LARGEST_BATCH, FASTEST_GROWTH = 16, 128, 8
BATCH_BYTES = 16 * 1024 * 1024
"""A batch is closed by the frame that reaches it; two that are sent, their forms and the next are in memory at once."""

BATCH_SECONDS = 4.0
"""How long a batch should take: long beside what each costs, short beside the time that the service gives it."""

KNOWN_AT_ONCE = 128
"""Frames whose digests are asked about in one request."""


@dataclass(frozen=True)
class Outcome:
    """What became of one frame: ``change``, or why it was refused; ``uploaded`` is whether its bytes were sent."""

    frame: Frame
    change: str | None
    posed: bool = False
    refusal: str | None = None
    uploaded: bool = True


@dataclass(frozen=True)
class _Read:
    """A frame with its bytes; none where it is only named by their digest, or cannot be read."""

    frame: Frame
    entry: dict[str, Any] = field(default_factory=dict)
    data: bytes = b""
    refusal: str | None = None

    @property
    def posed(self) -> bool:
        return bool(self.entry.keys() & {"x", "latitude"})


async def enrol_frames(
    service: Service,
    map_id: str,
    frames: Sequence[Frame],
    known: frozenset[str],
    encoder: str | None,
    tell: Callable[[Outcome], None],
) -> None:
    """Enrol frames in their order; ``tell`` hears of each as soon as it is settled.

    Args:
        known: ids that the map has; of these frames the service is asked first whether it holds them.
        encoder: to be asserted; None: whichever is the map's.

    Raises:
        Refused: the service refuses what is no frame's fault; what was told is done.
        Failure: it does not answer.
    """
    sender = _Sender(service, map_id, {} if encoder is None else {"encoder": encoder}, tell)
    asked = [frame for frame in frames if frame.id in known]
    needed: set[str] = set()
    for start in range(0, len(asked), KNOWN_AT_ONCE):
        needed |= await sender.ask(asked[start : start + KNOWN_AT_ONCE])
    await sender.send_all([frame for frame in frames if frame.id not in known or frame.id in needed])


@dataclass(frozen=True)
class _Sent:
    """A batch under way: its name, its number of frames, what becomes of them."""

    name: str
    frames: int
    task: asyncio.Task[list[Outcome]]
    began: float = field(default_factory=time.monotonic)


class _Sender:
    def __init__(
        self, service: Service, map_id: str, parameters: Mapping[str, str], tell: Callable[[Outcome], None]
    ) -> None:
        self._service, self._map_id, self._parameters, self._tell = service, map_id, dict(parameters), tell
        self._batch, self._most = FIRST_BATCH, LARGEST_BATCH

    async def ask(self, frames: Sequence[Frame]) -> set[str]:
        """Apply fields to the places that hold these frames; the ids of those whose bytes are needed."""
        read = await asyncio.gather(*(asyncio.to_thread(_read, frame, digest=True) for frame in frames))
        needed = set()
        for one, item in await self._post(read):
            if item is not None and item.get("problem", {}).get("type", "").endswith(":frame-needed"):
                needed.add(one.frame.id)
            else:
                self._tell(_outcome(one, item, uploaded=False))
        return needed

    async def send_all(self, frames: Sequence[Frame]) -> None:
        """Send frames batch by batch: one is encoded while the one before is stored, and the next is read."""
        position, started = 0, list[_Sent]()
        following = asyncio.ensure_future(asyncio.to_thread(self._read_batch, frames, position))
        try:
            while batch := await following:
                position += len(batch)
                following = asyncio.ensure_future(asyncio.to_thread(self._read_batch, frames, position))
                started.append(self._begin(batch, started[-1] if started else None))
                # The first one alone: it says what the service takes, and how fast it is.
                if len(started) == 2 or position == len(batch):
                    await self._end(started.pop(0))
            for sent in started:
                await self._end(sent)
        finally:
            for task in (following, *(sent.task for sent in started)):
                task.cancel()
            await asyncio.gather(following, *(sent.task for sent in started), return_exceptions=True)

    def _read_batch(self, frames: Sequence[Frame], position: int) -> list[_Read]:
        batch: list[_Read] = []
        size, most = 0, self._batch
        while position + len(batch) < len(frames) and len(batch) < most and size < BATCH_BYTES:
            batch.append(_read(frames[position + len(batch)]))
            size += len(batch[-1].data)
        return batch

    def _begin(self, batch: Sequence[_Read], before: _Sent | None) -> _Sent:
        name = secrets.token_hex(8)
        return _Sent(name, len(batch), asyncio.ensure_future(self._send(batch, name, before)))

    async def _end(self, sent: _Sent) -> None:
        """Wait for the outcomes of a batch and tell of them; the next to be read follows the speed."""
        for outcome in await sent.task:
            self._tell(outcome)
        rate = sent.frames / max(time.monotonic() - sent.began, 1e-3)
        self._batch = max(1, min(self._most, int(rate * BATCH_SECONDS), FASTEST_GROWTH * self._batch))

    async def _send(self, batch: Sequence[_Read], name: str, before: _Sent | None = None) -> list[Outcome]:
        """Send a batch, to be stored after the one before; in halves if it is more than the service takes at a time."""
        order = {"batch": name} if before is None else {"batch": name, "after": before.name}
        try:
            return [_outcome(one, item, uploaded=True) for one, item in await self._post(batch, order)]
        except Refused as refused:
            if before is not None:
                # Whatever it is, the one before comes first; if that fails, this one is of no interest.
                await asyncio.wait({before.task})
                before.task.result()
                if refused.slug == OUT_OF_ORDER:
                    return await self._send(batch, name)
            if len(batch) == 1 and refused.status in OF_THE_FRAME:
                return [Outcome(batch[0].frame, None, refusal=str(refused))]
            # Of a form as a whole these say that it is longer than this service takes.
            if len(batch) == 1 or not (refused.status in OF_THE_FRAME or refused.slug in TOO_SLOW):
                raise
            half = len(batch) // 2
            self._most = self._batch = half
            first = await self._send(batch[:half], secrets.token_hex(8))
            return first + await self._send(batch[half:], name)

    async def _post(
        self, batch: Sequence[_Read], order: Mapping[str, str] | None = None
    ) -> list[tuple[_Read, dict[str, Any] | None]]:
        """What the service says of each frame; None for one that could not be read, which is not sent."""
        sent = [one for one in batch if one.refusal is None]
        items: dict[str, dict[str, Any]] = {}
        if sent:
            boundary = secrets.token_hex(16)
            form = _form(sent, boundary)
            response = await self._service.request(
                "POST",
                path_of("maps", self._map_id, "places"),
                params={**self._parameters, **(order or {})},
                content=form,
                headers={"Content-Type": f"multipart/form-data; boundary={boundary}"},
                patience=PATIENCE,
                final=TOO_SLOW if len(sent) > 1 else frozenset(),
            )
            items = dict(zip((one.frame.id for one in sent), response.json()["items"], strict=True))
        return [(one, items.get(one.frame.id)) for one in batch]


def _outcome(one: _Read, item: dict[str, Any] | None, uploaded: bool) -> Outcome:
    """What the service said of a frame, None where it was not sent, as callers hear it."""
    if item is None:
        return Outcome(one.frame, None, refusal=one.refusal, uploaded=False)
    if "problem" in item:
        return Outcome(one.frame, None, refusal=item["problem"]["detail"], uploaded=uploaded)
    return Outcome(one.frame, item["change"], posed=one.posed, uploaded=uploaded)


def _read(frame: Frame, digest: bool = False) -> _Read:
    """A frame's bytes and its entry; with ``digest`` the bytes are only named."""
    try:
        data = frame.path.read_bytes()
    except OSError as error:
        return _Read(frame, refusal=f"it cannot be read: {error.strerror}.")
    entry = {"id": frame.id, **frame.parameters(data)}
    if digest:
        return _Read(frame, {**entry, "sha256": hashlib.sha256(data).hexdigest()})
    return _Read(frame, {**entry, "file": frame.id}, data)


def _form(batch: Sequence[_Read], boundary: str) -> bytes:
    """A multipart form: the JSON part first, then the frames."""
    places = json.dumps([one.entry for one in batch]).encode()
    chunks = [_part(boundary, "places", "application/json"), places]
    for one in batch:
        if "file" in one.entry:
            kind = media_type(one.data)
            chunks += [b"\r\n", _part(boundary, one.frame.id, kind, one.frame.id), one.data]
    return b"".join([*chunks, f"\r\n--{boundary}--\r\n".encode()])


def _part(boundary: str, name: str, kind: str, filename: str | None = None) -> bytes:
    """The head of one part; ids are of letters, digits and ``._~-`` and need no quoting."""
    file = "" if filename is None else f'; filename="{filename}"'
    return (
        f'--{boundary}\r\nContent-Disposition: form-data; name="{name}"{file}\r\nContent-Type: {kind}\r\n\r\n'.encode()
    )

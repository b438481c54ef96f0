"""Enrol many frames in batches whose size adapts to the speed, without sending frames that the service already has.

Two batches are under way at a time, so that one is encoded while the other is stored and the next is read from disk.
Each batch names the one before, after which it is to be stored: that keeps the order of the places in their sequence,
on which verdicts depend.
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

from core.errors import PlacerecError
from service.commands.connection.client import Refused, Service, media_type, path_of
from service.commands.traverse import Frame

PATIENCE = 120.0
"""Seconds for which a batch is repeated while the service is overloaded or restarts."""

OF_THE_FRAME = frozenset({400, 413, 415, 422})
"""Statuses that concern one frame; with any other status the remaining frames would most likely fail as well."""

OUT_OF_ORDER = "batch-out-of-order"
"""The problem of a batch whose predecessor is not stored."""

TOO_SLOW = frozenset({"deadline-exceeded"})
"""Problems that a batch would have again, but a smaller one might not."""

FIRST_BATCH, LARGEST_BATCH, FASTEST_GROWTH = 16, 128, 8
BATCH_BYTES = 16 * 1024 * 1024
"""A batch ends with the frame that reaches this size; two batches, their forms and the next are in memory at once."""

BATCH_SECONDS = 4.0
"""How long a batch should take: long compared with its fixed costs, short compared with the service's time limit."""

KNOWN_AT_ONCE = 128
"""Most frames whose digests one request asks about."""


@dataclass(frozen=True)
class Outcome:
    """The result for one frame: its ``change``, or why it was refused, and whether its bytes were ``uploaded``."""

    frame: Frame
    change: str | None
    posed: bool = False
    refusal: str | None = None
    uploaded: bool = True


@dataclass(frozen=True)
class _Read:
    """A frame that was read; ``data`` is empty if only its digest is sent, or if it cannot be read."""

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
    """Enrol frames in their order.

    Args:
        known: ids that the map already has; for these frames the service is first asked whether it has their bytes.
        encoder: the encoder that the map must have; None for any.
        tell: is called with the outcome of each frame as soon as it is known.

    Raises:
        Refused: the service refuses a request for a reason that concerns no single frame.
        Failure: the service does not answer.
    """
    sender = _Sender(service, map_id, {} if encoder is None else {"encoder": encoder}, tell)
    asked = [frame for frame in frames if frame.id in known]
    needed: set[str] = set()
    for start in range(0, len(asked), KNOWN_AT_ONCE):
        needed |= await sender.ask(asked[start : start + KNOWN_AT_ONCE])
    await sender.send_all([frame for frame in frames if frame.id not in known or frame.id in needed])


@dataclass(frozen=True)
class _Sent:
    """A batch under way: its name, its number of frames, and the task that sends it."""

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
        """Update the places that have these frames; return the ids of the frames that have to be sent."""
        read = await asyncio.to_thread(lambda: [_read(frame, digest=True) for frame in frames])
        needed = set()
        for one, item in await self._post(read):
            if item is not None and item.get("problem", {}).get("type", "").endswith(":frame-needed"):
                needed.add(one.frame.id)
            else:
                self._tell(_outcome(one, item, uploaded=False))
        return needed

    async def send_all(self, frames: Sequence[Frame]) -> None:
        """Send frames batch by batch: one is encoded while its predecessor is stored and the next is read."""
        position, started = 0, list[_Sent]()
        following = asyncio.ensure_future(asyncio.to_thread(self._read_batch, frames, position))
        try:
            while batch := await following:
                position += len(batch)
                following = asyncio.ensure_future(asyncio.to_thread(self._read_batch, frames, position))
                started.append(self._begin(batch, started[-1] if started else None))
                # The first batch goes alone: it shows what the service accepts, and how fast it is.
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
        """Wait for the outcomes of a batch, report them, and adapt the size of the next one to the speed."""
        for outcome in await sent.task:
            self._tell(outcome)
        rate = sent.frames / max(time.monotonic() - sent.began, 1e-3)
        self._batch = max(1, min(self._most, int(rate * BATCH_SECONDS), FASTEST_GROWTH * self._batch))

    async def _send(self, batch: Sequence[_Read], name: str, before: _Sent | None = None) -> list[Outcome]:
        """Send a batch, to be stored after the one before; split it in halves if the service finds it too large."""
        order = {"batch": name} if before is None else {"batch": name, "after": before.name}
        try:
            return [_outcome(one, item, uploaded=True) for one, item in await self._post(batch, order)]
        except Refused as refused:
            if before is not None:
                # The error of the batch before comes first; if that batch failed, this one does not matter.
                await asyncio.wait({before.task})
                before.task.result()
                if refused.slug == OUT_OF_ORDER:
                    return await self._send(batch, name)
            if len(batch) == 1 and refused.status in OF_THE_FRAME:
                return [Outcome(batch[0].frame, None, refusal=str(refused))]
            # For a whole form these statuses mean that it is larger than the service accepts.
            if len(batch) == 1 or not (refused.status in OF_THE_FRAME or refused.slug in TOO_SLOW):
                raise
            half = len(batch) // 2
            self._most = self._batch = half
            first = await self._send(batch[:half], secrets.token_hex(8))
            return first + await self._send(batch[half:], name)

    async def _post(
        self, batch: Sequence[_Read], order: Mapping[str, str] | None = None
    ) -> list[tuple[_Read, dict[str, Any] | None]]:
        """The service's answer for each frame; None for a frame that could not be read and was not sent."""
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
    """The outcome of a frame from the service's answer, which is None if it was not sent."""
    if item is None:
        return Outcome(one.frame, None, refusal=one.refusal, uploaded=False)
    if "problem" in item:
        return Outcome(one.frame, None, refusal=item["problem"]["detail"], uploaded=uploaded)
    return Outcome(one.frame, item["change"], posed=one.posed, uploaded=uploaded)


def _read(frame: Frame, digest: bool = False) -> _Read:
    """Read a frame and make its entry; with ``digest`` only the digest of its bytes is kept."""
    try:
        data = frame.taken.load()
    except OSError as error:
        return _Read(frame, refusal=f"the file cannot be read: {error.strerror}.")
    except PlacerecError as error:
        return _Read(frame, refusal=str(error))
    entry = {"id": frame.id, **frame.parameters(data)}
    if digest:
        return _Read(frame, {**entry, "sha256": hashlib.sha256(data).hexdigest()})
    return _Read(frame, {**entry, "file": frame.id}, data)


def _form(batch: Sequence[_Read], boundary: str) -> bytes:
    """A multipart form of the JSON part ``places`` and the frames."""
    places = json.dumps([one.entry for one in batch]).encode()
    chunks = [_part(boundary, "places", "application/json"), places]
    for one in batch:
        if "file" in one.entry:
            kind = media_type(one.data)
            chunks += [b"\r\n", _part(boundary, one.frame.id, kind, one.frame.id), one.data]
    return b"".join([*chunks, f"\r\n--{boundary}--\r\n".encode()])


def _part(boundary: str, name: str, kind: str, filename: str | None = None) -> bytes:
    """The head of one part; ids consist of letters, digits and ``._~-``, so they need no quoting."""
    file = "" if filename is None else f'; filename="{filename}"'
    return (
        f'--{boundary}\r\nContent-Disposition: form-data; name="{name}"{file}\r\nContent-Type: {kind}\r\n\r\n'.encode()
    )

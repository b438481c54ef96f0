"""Batches of frames whose size adapts to the speed.

Two batches are under way at a time, so that one is encoded while the other is stored and the next is read.
"""

from __future__ import annotations

import time
from abc import ABC, abstractmethod
from collections.abc import AsyncGenerator, Iterable, Mapping, Sequence
from typing import Any, Generic, TypeVar

from placerec_client import models
from placerec_client._async.concurrency import Task, in_thread
from placerec_client._async.connection import AsyncConnection
from placerec_client.answers import problem_of
from placerec_client.batches import BATCH_BYTES, OF_THE_FRAME, TOO_SLOW, Located, Pace, too_large
from placerec_client.errors import InvalidFrame, Problem, UnexpectedAnswer
from placerec_client.frames import Frame, frame_bytes, media_type
from placerec_client.requests import Part, form, items_of

Item = TypeVar("Item")
Outcome = TypeVar("Outcome")


class AsyncBatch(Generic[Item, Outcome]):
    """A batch: the outcomes that are already known, and the frames to send."""

    def __init__(self, known: Sequence[Outcome], items: Sequence[Item]) -> None:
        self.known, self.items = known, items


class AsyncSent(Generic[Outcome]):
    """A batch under way."""

    def __init__(self, frames: int, task: Task[list[Outcome]]) -> None:
        self.frames, self.task, self.began = frames, task, time.monotonic()


class AsyncBatches(ABC, Generic[Item, Outcome]):
    """Sends frames batch by batch, and yields an outcome for each in their order."""

    def __init__(self) -> None:
        self.pace = Pace()

    @abstractmethod
    async def read(self) -> AsyncBatch[Item, Outcome] | None:
        """The next batch; None at the end. It is called for the next batch while others are under way."""

    @abstractmethod
    def begin(self, batch: AsyncBatch[Item, Outcome], before: AsyncSent[Outcome] | None) -> AsyncSent[Outcome]:
        """Begin to send a batch, after the one that is under way."""

    async def run(self) -> AsyncGenerator[Outcome]:
        """Yield the outcomes.

        Raises:
            PlacerecError: a batch failed for a reason that concerns no single frame; the outcomes so far are final.
        """
        started: list[AsyncSent[Outcome]] = []
        alone = True
        following = Task(self.read)
        try:
            while batch := await following.result():
                following = Task(self.read)
                started.append(self.begin(batch, started[-1] if started else None))
                # The first batch goes alone: it shows what the service accepts, and how fast it is.
                if len(started) == 2 or alone:
                    for outcome in await self._end(started.pop(0)):
                        yield outcome
                alone = False
            while started:
                for outcome in await self._end(started.pop(0)):
                    yield outcome
        finally:
            under_way: list[Task[Any]] = [following, *(sent.task for sent in started)]
            for task in under_way:
                await task.end()

    async def _end(self, sent: AsyncSent[Outcome]) -> list[Outcome]:
        """Wait for the outcomes of a batch, and adapt the size of the next one to its speed."""
        outcomes = await sent.task.result()
        if sent.frames:
            self.pace.took(sent.frames, time.monotonic() - sent.began)
        return outcomes


class AsyncQueries(AsyncBatches[tuple[Frame, bytes], Located]):
    """Queries of many frames."""

    def __init__(
        self, connection: AsyncConnection, path: str, frames: Iterable[Frame], options: Mapping[str, Any]
    ) -> None:
        super().__init__()
        self._connection, self._path, self._options = connection, path, options
        self._frames = iter(items_of("frames", frames))

    async def read(self) -> AsyncBatch[tuple[Frame, bytes], Located] | None:
        """Read frames until the batch is full; one that cannot be read ends it."""
        failed: list[Located] = []
        items = await in_thread(self._read, failed)
        return AsyncBatch(failed, items) if failed or items else None

    def _read(self, failed: list[Located]) -> list[tuple[Frame, bytes]]:
        items: list[tuple[Frame, bytes]] = []
        size = 0
        while len(items) < self.pace.frames and size < BATCH_BYTES and not failed:
            try:
                frame = next(self._frames)
            except StopIteration:
                break
            try:
                items.append((frame, frame_bytes(frame)))
                size += len(items[-1][1])
            except InvalidFrame as error:
                failed.append(Located(frame, None, error))
        return items

    def begin(
        self, batch: AsyncBatch[tuple[Frame, bytes], Located], before: AsyncSent[Located] | None
    ) -> AsyncSent[Located]:
        """Begin to send a batch."""

        async def send() -> list[Located]:
            return [*await self._send(batch.items), *batch.known]

        return AsyncSent(len(batch.items), Task(send))

    async def _send(self, items: Sequence[tuple[Frame, bytes]]) -> list[Located]:
        """Send a batch, in halves if the service finds it too large."""
        if not items:
            return []
        content, kind = form([Part(str(index), data, media_type(data)) for index, (_, data) in enumerate(items)])
        try:
            answers = await self._connection.ask(
                models.BatchAnswers,
                "POST",
                self._path,
                params=self._options,
                content=content,
                media_type=kind,
                final=TOO_SLOW if len(items) > 1 else frozenset(),
            )
        except (Problem, UnexpectedAnswer) as error:
            if too_large(error, len(items)):
                half = self.pace.halve(len(items))
                return [*await self._send(items[:half]), *await self._send(items[half:])]
            if error.status in OF_THE_FRAME:
                return [Located(items[0][0], None, error)]
            raise
        return [_located(frame, item) for (frame, _), item in zip(items, answers.items, strict=True)]


def _located(frame: Frame, item: models.BatchAnswer) -> Located:
    if item.problem is not None:
        return Located(frame, None, problem_of(item.problem.model_dump(exclude_none=True), item.status))
    return Located(frame, item.answer)

"""Frames of queries that a map keeps for review, and their labels."""

from __future__ import annotations

from collections.abc import AsyncIterator, Sequence
from typing import Unpack

from placerec_client import models, parameters
from placerec_client._async.connection import AsyncConnection
from placerec_client._async.jobs import AsyncJob
from placerec_client.requests import path_of


class AsyncReview:
    """The frames that a map keeps for review; iterated, one after the other."""

    def __init__(self, connection: AsyncConnection, path: str) -> None:
        self._connection, self._path = connection, path + "/review"

    def __aiter__(self) -> AsyncIterator[models.ReviewFrameView]:
        return self.list()

    async def list(self, **options: Unpack[parameters.ListReview]) -> AsyncIterator[models.ReviewFrameView]:
        """Yield the frames; ``labelled`` chooses those with or without a label."""
        async for page in self._connection.pages(models.ReviewPage, self._path, dict(options)):
            for item in page.items:
                yield item

    async def labels(self) -> Sequence[models.ExportedLabel]:
        """Return all labels."""
        return (await self._connection.ask(models.LabelList, "GET", self._path + "/labels")).items

    async def picture(self, frame: int) -> bytes:
        """Return the file of a frame."""
        path = path_of(frame, "picture", below=self._path)
        return (await self._connection.request("GET", path)).content

    async def stretches(self) -> Sequence[models.GroundStretchView]:
        """Return the stretches of new ground that wait for review."""
        return (await self._connection.ask(models.GroundStretchList, "GET", self._path + "/stretches")).items

    async def accept_stretch(self, stretch: str) -> AsyncJob:
        """Accept a stretch; the job makes its frames places of the map."""
        return await AsyncJob.submit(self._connection, path_of("stretches", stretch, below=self._path))

    async def reject_stretch(self, stretch: str) -> None:
        """Reject a stretch: its frames are thrown away."""
        await self._connection.request("DELETE", path_of("stretches", stretch, below=self._path))

    async def label(
        self, frame: int, *, deadline: float | None = None, **options: Unpack[parameters.LabelOrder]
    ) -> models.Labelled:
        """Say what a frame shows: a ``place``, a ``new`` one, a ``stranger``; ``clear`` that, or ``discard`` it."""
        path = path_of(frame, below=self._path)
        return await self._connection.ask(models.Labelled, "POST", path, json=options, deadline=deadline)

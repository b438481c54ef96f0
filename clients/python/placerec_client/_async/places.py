"""The places of a map."""

from __future__ import annotations

from collections.abc import AsyncIterator
from typing import Unpack

from placerec_client import models, parameters, problems
from placerec_client._async.connection import AsyncConnection
from placerec_client.frames import Frame, frame_bytes, media_type
from placerec_client.renamed import OldNames
from placerec_client.requests import fields, path_of


class AsyncPlaces(OldNames, forget="delete", forget_many="delete_many"):
    """The places of a map; iterated, in the order of their enrolment."""

    def __init__(self, connection: AsyncConnection, path: str) -> None:
        self._connection, self._path, self._looks = connection, path + "/places", path + "/looks"

    def __aiter__(self) -> AsyncIterator[models.PlaceView]:
        return self.list()

    async def list(self, **options: Unpack[parameters.ListPlaces]) -> AsyncIterator[models.PlaceView]:
        """Yield the places in the order of their enrolment.

        Args:
            options: which places: ``sequence``, ``camera``, ``after``, ``before``, ``where``.
        """
        async for page in self._connection.pages(models.PlacePage, self._path, dict(options)):
            for item in page.items:
                yield item

    async def put(
        self,
        place_id: str,
        frame: Frame,
        *,
        deadline: float | None = None,
        request_id: str | None = None,
        **options: Unpack[parameters.EnrolPlace],
    ) -> models.EnrolledPlace:
        """Enrol one frame as a place, or replace the place of this id. The answer says that it is on disk.

        Args:
            place_id: which the caller chooses.
            frame: bytes, a path, an open file, or pixels.
            deadline: seconds after which an answer is of no use.
            request_id: under which the service logs the request; made if left out.
            options: such as ``x``, ``y``, ``heading``, ``sequence``, ``timestamp``, ``camera``, ``metadata``.
        """
        data = frame_bytes(frame)
        return await self._connection.ask(
            models.EnrolledPlace,
            "PUT",
            self._of(place_id),
            params=options,
            content=data,
            media_type=media_type(data),
            deadline=deadline,
            request_id=request_id,
        )

    async def read(self, place_id: str) -> models.PlaceView:
        """Return one place."""
        return await self._connection.ask(models.PlaceView, "GET", self._of(place_id))

    async def edit(self, place_id: str, changes: parameters.PlaceChanges) -> models.PlaceView:
        """Change fields of a place; those left out stay, and None clears a field."""
        return await self._connection.ask(models.PlaceView, "PATCH", self._of(place_id), json=changes)

    async def delete(self, place_id: str) -> None:
        """Delete a place: no later query finds it."""
        try:
            await self._connection.request("DELETE", self._of(place_id))
        except problems.UnknownPlace as problem:
            if not problem.after_loss:
                raise

    async def delete_many(self, **options: Unpack[parameters.Deletion]) -> models.DeletedPlaces:
        """Delete the places of these ``ids``, or those that a ``filter`` lets through, in one commit.

        It only reports which these are unless ``dry_run=False``.
        """
        path = self._path + ":delete"
        return await self._connection.ask(models.DeletedPlaces, "POST", path, json=fields(options))

    async def matches(self, place_id: str, **options: Unpack[parameters.ListPlaceMatches]) -> models.PlaceMatchList:
        """Return the latest answers in which a place was a match."""
        path = path_of(place_id, "matches", below=self._path)
        return await self._connection.ask(models.PlaceMatchList, "GET", path, params=options)

    async def thumbnail(self, place_id: str) -> bytes:
        """Return a small picture of a place, a JPEG file, if the map keeps one."""
        path = path_of(place_id, "thumbnail", below=self._path)
        return (await self._connection.request("GET", path)).content

    async def add_look(
        self,
        place_id: str,
        frame: Frame,
        *,
        deadline: float | None = None,
        request_id: str | None = None,
        **options: Unpack[parameters.AddLook],
    ) -> models.AddedLook:
        """Add a look to a place: a frame of it under other conditions, such as at night.

        Args:
            place_id: of the place.
            frame: bytes, a path, an open file, or pixels.
            deadline: seconds after which an answer is of no use.
            request_id: under which the service logs the request; made if left out.
            options: such as ``timestamp``, ``camera``.
        """
        data = frame_bytes(frame)
        return await self._connection.ask(
            models.AddedLook,
            "POST",
            path_of(place_id, "looks", below=self._path),
            params=options,
            content=data,
            media_type=media_type(data),
            deadline=deadline,
            request_id=request_id,
        )

    async def looks(self, place_id: str) -> AsyncIterator[models.LookView]:
        """Yield the looks that a place has besides its first, in the order in which they were added."""
        path = path_of(place_id, "looks", below=self._path)
        async for page in self._connection.pages(models.LookPage, path, {}):
            for item in page.items:
                yield item

    async def all_looks(self, **options: Unpack[parameters.ListAllLooks]) -> AsyncIterator[models.LookView]:
        """Yield the looks of all places in the order in which they were added.

        Args:
            options: ``run``, of which they were learnt.
        """
        async for page in self._connection.pages(models.LookPage, self._looks, dict(options)):
            for item in page.items:
                yield item

    async def look_thumbnail(self, place_id: str, look: str) -> bytes:
        """Return a small picture of a look, a JPEG file, if the map keeps one."""
        path = path_of(place_id, "looks", look, "thumbnail", below=self._path)
        return (await self._connection.request("GET", path)).content

    async def delete_look(self, place_id: str, look: str) -> None:
        """Remove a look of a place: no later query finds the place by it."""
        try:
            await self._connection.request("DELETE", path_of(place_id, "looks", look, below=self._path))
        except problems.UnknownLook as problem:
            if not problem.after_loss:
                raise

    async def delete_learnt_looks(self, run: str) -> models.RemovedLooks:
        """Remove all looks that were learnt from one run."""
        return await self._connection.ask(models.RemovedLooks, "DELETE", self._looks, params={"run": run})

    def _of(self, place_id: str) -> str:
        return path_of(place_id, below=self._path)

# Written from _async/places.py by scripts/client.  Do not edit.
"""The places of a map."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Unpack

from placerec_client import models, parameters, problems
from placerec_client._sync.concurrency import in_thread
from placerec_client._sync.connection import Connection
from placerec_client._sync.jobs import Job
from placerec_client._sync.transfers import file_of
from placerec_client.errors import UnreadableFile
from placerec_client.frames import Frame, frame_bytes, media_type
from placerec_client.renamed import OldNames
from placerec_client.requests import fields, path_of


class Places(OldNames, forget="delete", forget_many="delete_many"):
    """The places of a map; iterated, in the order of their enrolment."""

    def __init__(self, connection: Connection, path: str) -> None:
        self._connection, self._path, self._looks = connection, path + "/places", path + "/looks"

    def __iter__(self) -> Iterator[models.PlaceView]:
        return self.list()

    def list(self, **options: Unpack[parameters.ListPlaces]) -> Iterator[models.PlaceView]:
        """Yield the places in the order of their enrolment.

        Args:
            options: which places: ``sequence``, ``camera``, ``after``, ``before``, ``where``.
        """
        for page in self._connection.pages(models.PlacePage, self._path, dict(options)):
            for item in page.items:
                yield item

    def put(
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
        return self._connection.ask(
            models.EnrolledPlace,
            "PUT",
            self._of(place_id),
            params=options,
            content=data,
            media_type=media_type(data),
            deadline=deadline,
            request_id=request_id,
        )

    def read(self, place_id: str) -> models.PlaceView:
        """Return one place."""
        return self._connection.ask(models.PlaceView, "GET", self._of(place_id))

    def edit(self, place_id: str, changes: parameters.PlaceChanges) -> models.PlaceView:
        """Change fields of a place; those left out stay, and None clears a field."""
        return self._connection.ask(models.PlaceView, "PATCH", self._of(place_id), json=changes)

    def delete(self, place_id: str) -> None:
        """Delete a place: no later query finds it."""
        try:
            self._connection.request("DELETE", self._of(place_id))
        except problems.UnknownPlace as problem:
            if not problem.after_loss:
                raise

    def delete_many(self, **options: Unpack[parameters.Deletion]) -> models.DeletedPlaces:
        """Delete the places of these ``ids``, or those that a ``filter`` lets through, in one commit.

        It only reports which these are unless ``dry_run=False``.
        """
        path = self._path + ":delete"
        return self._connection.ask(models.DeletedPlaces, "POST", path, json=fields(options))

    def compare(
        self, places: Sequence[parameters.FrameToCompare], **options: Unpack[parameters.TraverseToCompare]
    ) -> models.TraverseComparison:
        """Compare a traverse with what the map has, before its frames are sent; nothing is stored.

        First send the ids alone; then, of the places that are ``taken``, the ids with the SHA-256 of the frames.

        Args:
            places: each frame's ``id`` and, where its bytes were read, ``sha256`` in hexadecimal.
            options: ``sequence``, ``named``, ``camera``.
        """
        path = self._path + ":compare"
        return self._connection.ask(models.TraverseComparison, "POST", path, json={"places": places, **fields(options)})

    def matches(self, place_id: str, **options: Unpack[parameters.ListPlaceMatches]) -> models.PlaceMatchList:
        """Return the latest answers in which a place was a match."""
        path = path_of(place_id, "matches", below=self._path)
        return self._connection.ask(models.PlaceMatchList, "GET", path, params=options)

    def thumbnail(self, place_id: str) -> bytes:
        """Return a small picture of a place, a JPEG file, if the map keeps one."""
        path = path_of(place_id, "thumbnail", below=self._path)
        return (self._connection.request("GET", path)).content

    def add_look(
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
        return self._connection.ask(
            models.AddedLook,
            "POST",
            path_of(place_id, "looks", below=self._path),
            params=options,
            content=data,
            media_type=media_type(data),
            deadline=deadline,
            request_id=request_id,
        )

    def looks(self, place_id: str) -> Iterator[models.LookView]:
        """Yield the looks that a place has besides its first, in the order in which they were added."""
        path = path_of(place_id, "looks", below=self._path)
        for page in self._connection.pages(models.LookPage, path, {}):
            for item in page.items:
                yield item

    def all_looks(self, **options: Unpack[parameters.ListAllLooks]) -> Iterator[models.LookView]:
        """Yield the looks of all places in the order in which they were added.

        Args:
            options: ``run``, of which they were learnt.
        """
        for page in self._connection.pages(models.LookPage, self._looks, dict(options)):
            for item in page.items:
                yield item

    def look_thumbnail(self, place_id: str, look: str) -> bytes:
        """Return a small picture of a look, a JPEG file, if the map keeps one."""
        path = path_of(place_id, "looks", look, "thumbnail", below=self._path)
        return (self._connection.request("GET", path)).content

    def delete_look(self, place_id: str, look: str) -> None:
        """Remove a look of a place: no later query finds the place by it."""
        try:
            self._connection.request("DELETE", path_of(place_id, "looks", look, below=self._path))
        except problems.UnknownLook as problem:
            if not problem.after_loss:
                raise

    def delete_learnt_looks(self, **options: Unpack[parameters.DeleteLearntLooks]) -> models.RemovedLooks:
        """Remove the looks that were learnt from one run, or in a period, or both; those that people added stay.

        With a run and no period all else that the map has learnt from it goes, too: its places of new ground, and its
        answers by which the map calibrates itself.

        Args:
            options: ``run``, from which they were learnt; ``since`` and ``until``, when they were added.
        """
        return self._connection.ask(models.RemovedLooks, "DELETE", self._looks, params=dict(options))

    def _of(self, place_id: str) -> str:
        return path_of(place_id, below=self._path)


PIECE_BYTES = 16 << 20
"""Bytes of one request of an upload: they are in memory at one time, and sent again if the connection breaks."""


class Recordings:
    """Bags that are uploaded into a map, a file each, and enrolled by a job."""

    def __init__(self, connection: Connection, path: str) -> None:
        self._connection, self._path = connection, path

    def _of(self, name: str) -> str:
        return path_of("recordings", name, below=self._path)

    def size(self, name: str) -> int:
        """Return how many bytes of a bag have arrived."""
        return (self._connection.ask(models.RecordingView, "GET", self._of(name))).bytes

    def upload(
        self,
        file: str | os.PathLike[str],
        name: str | None = None,
        *,
        progress: Callable[[int, int], object] | None = None,
    ) -> str:
        """Upload a bag, from where an upload before this one has ended; return its name.

        Args:
            file: a file of a rosbag2 (``.mcap``, ``.db3``) or a ROS 1 ``.bag``.
            name: under which it is uploaded; that of the file if left out.
            progress: is called with the bytes that are through, and their number.

        Raises:
            RecordingOffset: another upload of this name is under way.
            UnreadableFile: the file cannot be read.
        """
        path = file_of(file)
        name, total = path.name if name is None else name, in_thread(_size, path)
        at = self.size(name)
        while at < total:
            piece = in_thread(_piece, path, at)
            try:
                view = self._connection.ask(
                    models.RecordingView,
                    "PUT",
                    self._of(name),
                    params={"offset": at},
                    content=piece,
                    media_type="application/octet-stream",
                )
                at = view.bytes
            except problems.RecordingOffset:
                here = self.size(name)
                if here <= at:
                    raise
                at = here  # it had arrived, and its answer was lost
            if progress is not None:
                progress(at, total)
        return name

    def enrol(self, name: str, **options: Unpack[parameters.RecordingOrder]) -> Job:
        """Enrol the frames of a bag that has arrived; it is removed when the job has succeeded.

        Args:
            options: such as ``sequence``, ``topic``, ``pose_topic``, ``every_metres``, ``keep_standing``.
        """
        return Job.submit(self._connection, self._of(name), json=dict(options))

    def delete(self, name: str) -> None:
        """Remove what has arrived of a bag."""
        self._connection.request("DELETE", self._of(name))


def _size(path: Path) -> int:
    with _readable(path):
        return path.stat().st_size


def _piece(path: Path, at: int) -> bytes:
    with _readable(path), path.open("rb") as opened:
        opened.seek(at)
        return opened.read(PIECE_BYTES)


@contextmanager
def _readable(path: Path) -> Iterator[None]:
    """Have the errors of reading a file become UnreadableFile."""
    try:
        yield
    except OSError as error:
        raise UnreadableFile(f"{path} cannot be read: {error.strerror}.") from error

# Written from _async/review.py by scripts/client.  Do not edit.
"""Frames of queries that a map keeps for review, and their labels."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Unpack

from placerec_client import models, parameters
from placerec_client._sync.connection import Connection
from placerec_client._sync.jobs import Job
from placerec_client.requests import path_of


class Review:
    """The frames that a map keeps for review; iterated, one after the other."""

    def __init__(self, connection: Connection, path: str) -> None:
        self._connection, self._path = connection, path + "/review"

    def __iter__(self) -> Iterator[models.ReviewFrameView]:
        return self.list()

    def list(self, **options: Unpack[parameters.ListReview]) -> Iterator[models.ReviewFrameView]:
        """Yield the frames; ``labelled`` chooses those with or without a label."""
        for page in self._connection.pages(models.ReviewPage, self._path, dict(options)):
            for item in page.items:
                yield item

    def labels(self) -> Sequence[models.ExportedLabel]:
        """Return all labels."""
        return (self._connection.ask(models.LabelList, "GET", self._path + "/labels")).items

    def picture(self, frame: int) -> bytes:
        """Return the file of a frame."""
        path = path_of(frame, "picture", below=self._path)
        return (self._connection.request("GET", path)).content

    def stretches(self) -> Sequence[models.GroundStretchView]:
        """Return the stretches of new ground that wait for review."""
        return (self._connection.ask(models.GroundStretchList, "GET", self._path + "/stretches")).items

    def accept_stretch(self, stretch: str) -> Job:
        """Accept a stretch; the job makes its frames places of the map."""
        return Job.submit(self._connection, path_of("stretches", stretch, below=self._path))

    def reject_stretch(self, stretch: str) -> None:
        """Reject a stretch: its frames are thrown away."""
        self._connection.request("DELETE", path_of("stretches", stretch, below=self._path))

    def label(
        self, frame: int, *, deadline: float | None = None, **options: Unpack[parameters.LabelOrder]
    ) -> models.Labelled:
        """Say what a frame shows: a ``place``, a ``new`` one, a ``stranger``; ``clear`` that, or ``discard`` it."""
        path = path_of(frame, below=self._path)
        return self._connection.ask(models.Labelled, "POST", path, json=options, deadline=deadline)

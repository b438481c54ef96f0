# Written from _async/maps.py by scripts/client.  Do not edit.
"""Maps: the listing, and one map with all that can be done with it."""

from __future__ import annotations

import os
from collections.abc import Container, Generator, Iterable, Iterator, Mapping, Sequence
from contextlib import closing
from typing import Any, Literal, Unpack, overload

from placerec_client import models, parameters, problems
from placerec_client._sync.batches import Queries
from placerec_client._sync.connection import Connection
from placerec_client._sync.enrolment import Enrolment, enrol_by_job
from placerec_client._sync.following import follow
from placerec_client._sync.jobs import Job
from placerec_client._sync.places import Places, Recordings
from placerec_client._sync.review import Review
from placerec_client._sync.sessions import Sessions
from placerec_client._sync.transfers import Progress, export, upload
from placerec_client.answers import parsed
from placerec_client.batches import PATIENCE, Enrolled, Located, NewPlace
from placerec_client.errors import InvalidParameter
from placerec_client.events import MapEvent
from placerec_client.frames import Frame, frame_bytes, media_type
from placerec_client.renamed import OldNames, Subscripted
from placerec_client.requests import Part, dumps, fields, form, name_of, path_of, text_of

TRANSFER_PATIENCE = 3600.0
"""Seconds for which the request for a piece is repeated while the service is overloaded, restarts or writes the file of
a map, which for 100 000 places takes minutes; if the client has any patience."""


class Maps(Subscripted):
    """The maps of a service; iterated, their settings in the order of their ids."""

    def __init__(self, connection: Connection) -> None:
        self._connection = connection

    def __getitem__(self, map_id: str) -> Map:
        return Map(self._connection, map_id)

    def __iter__(self) -> Iterator[models.MapView]:
        return self.list()

    def list(self) -> Iterator[models.MapView]:
        """Yield the settings of every map, page by page."""
        for page in self.pages():
            for item in page.items:
                yield item

    def pages(self) -> Iterator[models.MapPage]:
        """Yield the pages of the listing; each also names the maps that are damaged and out of service."""
        for page in self._connection.pages(models.MapPage, "/v1/maps", {}):
            yield page

    def create(self, map_id: str, **options: Unpack[parameters.NewMap]) -> Map:
        """Create a map, bound for life to one encoder.

        If the answer to the first attempt is lost, an empty map of this id with these settings counts as created.

        Raises:
            MapExists: there is a map of this id.
        """
        body = {"id": map_id, **options}
        made = self[map_id]
        try:
            made.view = self._connection.ask(models.MapView, "POST", "/v1/maps", json=body)
        except problems.MapExists as problem:
            if not problem.after_loss:
                raise
            found = made.read()
            if found.places or not _holds(found, {**options, "encoder": None}):
                raise
        return made

    def import_(
        self,
        path: str | os.PathLike[str],
        *,
        id: str | None = None,
        encoder: str | None = None,
        progress: Progress | None = None,
    ) -> Job:
        """Upload the file of an exported map, and return the job that makes a map of it.

        Args:
            path: of the file.
            id: of the new map; the file's own if left out.
            encoder: name or identity that the map must have.
            progress: is called with the bytes sent and their number, and may be called again from the beginning.

        Raises:
            MapExists: there is a map of this id; nothing was sent, unless somebody made it meanwhile.
        """
        return upload(self._connection.lasting(TRANSFER_PATIENCE), path, id, encoder, progress)


class Map:
    """One map; nothing is sent before a method is called.

    Attributes:
        id: of the map.
        view: its settings as they were last read, created or edited through this object; None before.
        places: its places.
        sequences: its traverses.
        cameras: its cameras.
        sessions: its sessions.
        review: frames of queries that it keeps for review.
        recordings: bags that are uploaded to be enrolled.
    """

    def __init__(self, connection: Connection, map_id: str) -> None:
        self.id = map_id
        self.view: models.MapView | None = None
        self.connection = connection
        self.path = path_of("maps", map_id)
        self.places = Places(connection, self.path)
        self.sequences = Sequences(connection, self.path)
        self.cameras = Cameras(connection, self.path)
        self.sessions = Sessions(connection, self.path)
        self.review = Review(connection, self.path)
        self.recordings = Recordings(connection, self.path)
        self._query = self.path + "/query"

    def __repr__(self) -> str:
        return f"{type(self).__name__}({self.id!r})"

    def read(self) -> models.MapView:
        """Return the settings, the calibration and the size of the map."""
        self.view = self.connection.ask(models.MapView, "GET", self.path)
        return self.view

    def edit(self, changes: parameters.MapChanges, *, if_match: int | str | None = None) -> models.MapView:
        """Change settings; those left out stay, and None clears a field.

        Args:
            changes: the fields to change.
            if_match: the revision that the map must have, or its ETag.

        Raises:
            RevisionMismatch: the map has another revision; nothing is changed.
        """
        try:
            self.view = self.connection.ask(
                models.MapView, "PATCH", self.path, json=changes, headers=_condition(if_match)
            )
        except problems.RevisionMismatch as problem:
            if not problem.after_loss or not _holds(self.read(), changes):
                raise
        assert self.view is not None
        return self.view

    def delete(self, *, if_match: int | str | None = None) -> None:
        """Delete the map with everything that it contains."""
        try:
            self.connection.request("DELETE", self.path, headers=_condition(if_match))
        except problems.UnknownMap as problem:
            if not problem.after_loss:
                raise

    @overload
    def verify(self) -> models.VerifyReport: ...
    @overload
    def verify(self, *, background: Literal[True]) -> Job: ...
    def verify(self, *, background: bool = False) -> models.VerifyReport | Job:
        """Read all that is stored of the map and compare it with its checksums; in the ``background`` as a job."""
        path = self.path + "/verify"
        if background:
            return self._job(path, params={"background": True})
        return self.connection.ask(models.VerifyReport, "POST", path)

    def health(self, **options: Unpack[parameters.CheckHealth]) -> models.MapHealth:
        """Report how well the map works, and which stretches should be recorded again."""
        return self.connection.ask(models.MapHealth, "GET", self.path + "/health", params=options)

    def plan(self, **options: Unpack[parameters.ReadPlan]) -> models.PlanView:
        """Return where all places are, column by column: made for maps of many places."""
        return self.connection.ask(models.PlanView, "GET", self.path + "/plan", params=options)

    def coverage(self, **options: Unpack[parameters.CheckCoverage]) -> models.CoverageView:
        """Return whether a pose is in the map, and how well: the places, traverses and looks around it.

        ::

            assert (lab.coverage(x=4.0, y=1.5, heading=90)).state == "covered"

        Args:
            options: ``x`` and ``y``, or ``latitude`` and ``longitude``; ``heading``; ``k``, how many places to list.
        """
        return self.connection.ask(models.CoverageView, "GET", self.path + "/coverage", params=options)

    def compare(self, query: str, reference: str) -> models.SimilarityView:
        """Compare two traverses by frames: the shared stretches, and the size and scale of their matrix of scores."""
        params = {"query": query, "reference": reference}
        return self.connection.ask(models.SimilarityView, "GET", self.path + "/similarity", params=params)

    def draw_comparison(self, query: str, reference: str) -> bytes:
        """Return the matrix of scores of two traverses as a grey picture, a PNG file."""
        params, headers = {"query": query, "reference": reference}, {"Accept": "image/png"}
        response = self.connection.request("GET", self.path + "/similarity", params=params, headers=headers)
        return response.content

    def answers(self, **options: Unpack[parameters.ListAnswers]) -> models.RecentAnswerList:
        """Return the latest answers that the service remembers, and the mix of verdicts."""
        return self.connection.ask(models.RecentAnswerList, "GET", self.path + "/answers", params=options)

    def calibration(self, **options: Unpack[parameters.ReadCalibration]) -> models.CalibrationState:
        """Return the calibration, and what another ``threshold`` or ``margin`` would do."""
        return self.connection.ask(models.CalibrationState, "GET", self.path + "/calibration", params=options)

    def query(
        self,
        frame: Frame,
        *,
        deadline: float | None = None,
        request_id: str | None = None,
        **options: Unpack[parameters.Query],
    ) -> models.QueryAnswer:
        """Ask where a frame was taken.

        Args:
            frame: bytes, a path, an open file, or pixels.
            deadline: seconds after which an answer is of no use; the request is sent again until then.
            request_id: under which the service logs the request; made if left out.
            options: such as ``k``, ``verify``, ``camera``, ``x``, ``y`` and ``radius``.
        """
        data = frame_bytes(frame)
        response = self.connection.request(
            "POST",
            self._query,
            params={**options, "format": None},
            content=data,
            media_type=media_type(data),
            deadline=deadline,
            request_id=request_id,
        )
        return parsed(models.QueryAnswer, response.content)

    def geopose(
        self,
        frame: Frame,
        *,
        angles: bool = False,
        deadline: float | None = None,
        request_id: str | None = None,
        **options: Unpack[parameters.Query],
    ) -> models.GeoPose:
        """Ask where a frame was taken, and return the answer as an OGC GeoPose.

        Args:
            frame, deadline, request_id, options: as of ``query``.
            angles: yaw, pitch and roll instead of a quaternion.

        Raises:
            NotLocalized: the frame was not recognized.
            NoGeopose: the map is in metres, or its places have no headings.
        """
        data = frame_bytes(frame)
        return self.connection.ask(
            models.GeoPose,
            "POST",
            self._query,
            params={**options, "format": "geopose-ypr" if angles else "geopose"},
            content=data,
            media_type=media_type(data),
            deadline=deadline,
            request_id=request_id,
        )

    def query_batch(self, frames: Iterable[Frame], **options: Unpack[parameters.QueryBatch]) -> Generator[Located]:
        """Ask where many frames were taken; yield the answers in their order.

        The frames are read a batch ahead, and batches are as large as the service is fast. Those that were answered
        are not sent again when a connection is lost. A frame that cannot be used has an ``error``.

        Args:
            frames: read in a thread when their turn comes.
            options: as of ``query``; they hold for every frame.
        """
        queries = Queries(self.connection.lasting(PATIENCE), self.path + "/query:batch", frames, options)
        with closing(queries.run()) as answers:
            for located in answers:
                yield located

    def enrol(
        self,
        places: Iterable[NewPlace],
        *,
        known: Container[str] | None = None,
        encoder: str | None = None,
    ) -> list[Enrolled]:
        """Enrol many frames in their order, and return what became of each.

        It can be broken off and called again with the same frames: those that the map holds already are neither sent
        nor encoded a second time; their fields are updated. A frame that cannot be used has an ``error``, and the
        others are enrolled; one whose id or fields no place can have is not sent. Within a batch, frames that the map
        holds come first.

        ::

            frames = (NewPlace(path.stem, path, {"sequence": "monday"}) for path in sorted(folder.glob("*.jpg")))
            refused = [one.error for one in lab.enrol(frames) if one.error]

        Args:
            places: read in a thread when their turn comes.
            known: ids that the map has; found out if left out.
            encoder: name or identity that the map must have.
        """
        return [one for one in self.enrol_each(places, known=known, encoder=encoder)]

    def enrol_each(
        self,
        places: Iterable[NewPlace],
        *,
        known: Container[str] | None = None,
        encoder: str | None = None,
    ) -> Generator[Enrolled]:
        """Enrol many frames as ``enrol`` does, and yield what became of each as soon as it is known.

        Frames are sent only while the outcomes are taken: called without a loop over it, it does nothing.

        ::

            for one in lab.enrol_each(frames):
                print(one.place.id, one.change or one.error)

        Args:
            places, known, encoder: as of ``enrol``.
        """
        if known is None:
            known = {place.id for place in self.places.list()}
        options = {"encoder": encoder}
        lasting = self.connection.lasting(PATIENCE)
        enrolment = Enrolment(lasting, self.path + "/places", places, known, options)
        with closing(enrolment.run()) as outcomes:
            for outcome in outcomes:
                yield outcome

    def enrol_by_job(
        self,
        places: Sequence[NewPlace],
        *,
        align: bool = False,
        encoder: str | None = None,
        most_speed: float | None = None,
    ) -> Job:
        """Send many frames in one request, and return the job that enrols them.

        Args:
            places: all are read twice; none of them is held in memory.
            align: whether the job then finds which frames show places that the map had already.
            encoder: name or identity that the map must have.
            most_speed: metres a second of the vehicle; places whose poses are reached faster are refused, by default
                at 60.

        Raises:
            InvalidFrame, InvalidName, InvalidParameter: a frame cannot be read, or no place can have its id or its
                fields; nothing is enrolled.
        """
        options = {"align": align or None, "encoder": encoder, "most_speed": most_speed}
        return enrol_by_job(self.connection.lasting(PATIENCE), self.path + "/places", places, options)

    def query_or_enrol(
        self,
        place_id: str,
        frame: Frame,
        *,
        deadline: float | None = None,
        request_id: str | None = None,
        **options: Unpack[parameters.QueryOrEnrol],
    ) -> models.ClosureAnswer:
        """Ask where a frame was taken, and enrol it as a place if that is unknown, as one step.

        Args:
            place_id: of the place that it becomes.
            frame, deadline, request_id, options: as of ``query``.
        """
        data = frame_bytes(frame)
        return self.connection.ask(
            models.ClosureAnswer,
            "POST",
            self.path + "/query:enrol",
            params={**options, "id": name_of(place_id)},
            content=data,
            media_type=media_type(data),
            deadline=deadline,
            request_id=request_id,
        )

    def events(self, **options: Unpack[parameters.FollowMap]) -> Generator[MapEvent]:
        """Yield what happens in the map: queries, enrolments, sessions, jobs, and changes of the map.

        A connection that is lost is taken up again; the event ``missed`` says how many were lost all the same.

        ::

            for event in lab.events(kinds=["query"], verdicts=["unknown"]):
                print(event.data["at"], event.data["best"])

        Args:
            options: such as ``kinds``, ``verdicts`` and ``pictures``.
        """
        with closing(follow(self.connection, self.path + "/events", options)) as events:
            for event in events:
                made = MapEvent(event.name, event.id, event.json())
                yield made
                if made.kind == "map" and made.data.get("change") == "deleted":
                    return

    def explanation(self, explanation: str) -> bytes:
        """Return the picture of an explanation, a PNG file, by its id or the address in an answer."""
        path = path_of("explanations", text_of("explanation", explanation).rpartition("/")[2], below=self.path)
        return (self.connection.request("GET", path)).content

    @overload
    def calibrate(
        self,
        method: Literal["frames", "sequence", "map", "labels"],
        *,
        frames: Mapping[str, Frame] | None = None,
        if_match: int | str | None = None,
        deadline: float | None = None,
        background: Literal[False] = False,
        **options: Unpack[parameters.CalibrationOrder],
    ) -> models.CalibrationReport: ...
    @overload
    def calibrate(
        self,
        method: Literal["frames", "sequence", "map", "labels"],
        *,
        frames: Mapping[str, Frame] | None = None,
        if_match: int | str | None = None,
        deadline: float | None = None,
        background: Literal[True],
        **options: Unpack[parameters.CalibrationOrder],
    ) -> Job: ...
    def calibrate(
        self,
        method: Literal["frames", "sequence", "map", "labels"],
        *,
        frames: Mapping[str, Frame] | None = None,
        if_match: int | str | None = None,
        deadline: float | None = None,
        background: bool = False,
        **options: Any,
    ) -> models.CalibrationReport | Job:
        """Measure when the map's answers can be believed, and store the result.

        Args:
            method: ``frames`` with labels, a ``sequence`` of the map, the ``map`` itself, or the ``labels`` of reviewed
                frames.
            frames: with ``frames``: those that ``labels`` names as files.
            if_match: the revision that the map must have.
            deadline: seconds after which an answer is of no use.
            background: return a job, which may take longer than a request.
            options: such as ``target``, ``labels``, ``sequence``, ``pairs``, ``dry_run``.
        """
        order = {"method": method, **fields(options), "background": background}
        sent: dict[str, Any] = {"headers": _condition(if_match), "deadline": deadline}
        if frames is None:
            sent["json"] = order
        elif not isinstance(frames, Mapping):
            raise InvalidParameter(f"frames has to map the files of labels to frames; it is a {type(frames).__name__}.")
        else:
            read = {name: frame_bytes(frame) for name, frame in frames.items()}
            parts = [Part("calibration", dumps(order).encode(), "application/json", is_file=False)]
            parts += [Part(name, data, media_type(data)) for name, data in read.items()]
            sent["content"], sent["media_type"] = form(parts)
        path = self.path + "/calibrate"
        if background:
            return self._job(path, **sent)
        return self.connection.ask(models.CalibrationReport, "POST", path, **sent)

    def align(self, sequence: str, with_: list[str] | None = None, **options: Unpack[parameters.Aligning]) -> Job:
        """Find which frames of a traverse show the places of others, of all or those of ``with_``, by a job."""
        body = {"sequence": sequence, "with": with_, **fields(options)}
        return self._job(self.path + "/align", json=body)

    def prune(self, **options: Unpack[parameters.Pruning]) -> Job:
        """Remove places whose neighbours can stand in for them, by a job; it only reports unless ``dry_run=False``."""
        return self._job(self.path + "/prune", json=options)

    def merge(self, other: str, **options: Unpack[parameters.Merging]) -> Job:
        """Copy the places of another map into this one, by a job; it only reports unless ``dry_run=False``."""
        return self._job(self.path + "/merge", json={"from": other, **options})

    def reencode(self, to: str, **options: Unpack[parameters.Reencoding]) -> Job:
        """Make the new map ``to`` from the pictures of this one, by a job."""
        return self._job(self.path + "/re-encode", json={"to": to, **options})

    def rebuild(self) -> Job:
        """Rebuild the search index of the map, by a job."""
        return self._job(self.path + "/rebuild")

    def erase(self, **options: Unpack[parameters.Erasing]) -> Job:
        """Erase frames for good, by a job: places and looks by ``ids`` or ``filter``, or what a ``session`` has sent.

        Their pictures, descriptors and keypoints are overwritten, and frames for review and answers about them go.
        Without options it erases what places that were deleted before have left.
        """
        return self._job(self.path + "/erase", json=fields(options))

    def keypoints(self) -> Job:
        """Find the keypoints of places that have none, by a job."""
        return self._job(self.path + "/keypoints")

    def export(
        self,
        path: str | os.PathLike[str],
        *,
        overwrite: bool = False,
        known: str | None = None,
        progress: Progress | None = None,
    ) -> str | None:
        """Download the map as a file; a download that was broken off goes on where it was.

        Args:
            path: of the file; until it is complete and compared with its checksums, its name ends with ``.part``.
            overwrite: whether an existing file is replaced.
            known: the result of an earlier call; nothing is downloaded if the map has not changed since.
            progress: is called with the bytes that are there and their number.

        Returns:
            The SHA-256 of the file's manifest, which names its content; None if it is ``known``.

        Raises:
            TransferFailed: the file exists, cannot be written, or is damaged.
        """
        return export(self.connection.lasting(TRANSFER_PATIENCE), self.path, path, overwrite, known, progress)

    def _job(self, path: str, **options: Any) -> Job:
        return Job.submit(self.connection, path, **options)


class Sequences(OldNames, forget="delete"):
    """The traverses of a map."""

    def __init__(self, connection: Connection, path: str) -> None:
        self._connection, self._path = connection, path + "/sequences"

    def __iter__(self) -> Iterator[models.SequenceSummary]:
        return self.list()

    def list(self) -> Iterator[models.SequenceSummary]:
        """Yield the traverses in the order of their names."""
        for page in self._connection.pages(models.SequencePage, self._path, {}):
            for item in page.items:
                yield item

    def delete(self, name: str) -> models.DeletedSequence:
        """Delete all places of a traverse. If the answer to the first attempt is lost, 0 places are reported."""
        try:
            path = path_of(name, below=self._path)
            return self._connection.ask(models.DeletedSequence, "DELETE", path)
        except problems.UnknownSequence as problem:
            if not problem.after_loss:
                raise
            return models.DeletedSequence(name=name, places=0)


class Cameras(OldNames, forget="delete"):
    """The cameras of a map."""

    def __init__(self, connection: Connection, path: str) -> None:
        self._connection, self._path = connection, path + "/cameras"

    def __iter__(self) -> Iterator[models.CameraView]:
        return self.list()

    def list(self) -> Iterator[models.CameraView]:
        """Yield the cameras."""
        for page in self._connection.pages(models.CameraList, self._path, {"limit": None}):
            for item in page.items:
                yield item

    def put(self, name: str, **options: Unpack[parameters.CameraDefinition]) -> models.CameraView:
        """Create or replace a camera: ``mask`` is what to ignore in its frames, ``intrinsics`` measure poses."""
        return self._connection.ask(models.CameraView, "PUT", self._of(name), json=options)

    def read(self, name: str) -> models.CameraView:
        """Return one camera."""
        return self._connection.ask(models.CameraView, "GET", self._of(name))

    def delete(self, name: str) -> None:
        """Delete a camera; places that were enrolled with it stay."""
        try:
            self._connection.request("DELETE", self._of(name))
        except problems.UnknownCamera as problem:
            if not problem.after_loss:
                raise

    def _of(self, name: str) -> str:
        return path_of(name, below=self._path)


def _condition(if_match: int | str | None) -> dict[str, str]:
    """The header that makes an edit depend on the revision."""
    if if_match is None:
        return {}
    revision = text_of("if_match", if_match)
    return {"If-Match": revision if revision.startswith('"') else f'"{revision}"'}


def _holds(view: models.MapView, wanted: Mapping[str, Any]) -> bool:
    """Whether a map has these settings; None stands for any value."""
    found = view.model_dump()
    return all(
        value is None or name not in found or isinstance(value, Mapping) or found[name] == value
        for name, value in wanted.items()
    )

"""Bulk enrolment: a request writes a form with a whole traverse to disk, and a job stores its frames in small commits.

After each commit the job notes how far it is.  After a crash it goes on there; frames that were stored but not yet
noted are recognized by their digest, and their places stay as they are.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from starlette.requests import Request

from core.recordings.plausibility import MOST_SPEED
from core.store import Map
from service.engine.engine import Engine
from service.engine.queue import RequestDeadline
from service.errors.faults import BodyTooLarge, InvalidRequest, NothingEnrolled, UnsupportedMediaType
from service.errors.problems import problem_of
from service.http.bodies import intake_of, parse_json
from service.http.multipart import FormPart
from service.http.uploads import FIELD_PARTS, FORM, media_type
from service.jobs.context import (
    JobCancelled,
    JobContext,
    JobGivesWay,
    JobInterrupted,
    creation_time,
    run_after_requests,
)
from service.jobs.job import Job
from service.jobs.jobs import Jobs
from service.places.batches import check_batch, check_frame_error, entry_id, read_entry
from service.places.enrolment import Enrolled, FrameToEnrol, enrol
from service.places.plausible import judge_entries, pose_remarks
from service.places.staging import StagedForm, StagedPart, Staging
from service.worker_threads import in_thread, to_its_end

KIND = "enrol"

PLACES_PER_COMMIT = 64
"""The most places of one commit."""

BYTES_PER_COMMIT = 32 << 20
"""The most bytes of the frames of one commit, unless it is a single frame."""

MOST_LISTED = 200
"""The largest number of refused frames that the result of the job lists; the others are only counted."""

PART = "places"
"""The form's part with the JSON array of places."""


Align = Callable[[Engine, JobContext, Sequence[str]], list[dict[str, Any]]]
"""Aligns traverses of a job's map with its others, and returns a report for each."""


async def receive(
    engine: Engine,
    jobs: Jobs,
    staging: Staging,
    map_: Map,
    request: Request,
    align: bool = False,
    most_speed: float | None = None,
    replace: bool = True,
) -> Job:
    """Write a form to disk as it arrives, and submit a job for it; both are on disk when this returns.

    Args:
        align: whether the job aligns the traverses of the form with those that the map has.
        most_speed: metres a second of the vehicle at most; None: as by default.
        replace: whether its frames replace places of other frames.

    Raises:
        JobQueueFull, StagingFull: the form was not read.
        UnsupportedMediaType, MalformedBody, BodyTooLarge, InvalidRequest: the form is malformed or too large.
        DeadlineExceeded, ClientGone: the form did not arrive completely.
        StorageFull, StorageFailure: the form could not be stored; nothing of it is left.
    """
    await in_thread(jobs.check_room)
    if (kind := media_type(request)) != FORM:
        raise UnsupportedMediaType(f"Send the frames in a {FORM}, not as {kind[:80] or 'a body without a media type'}.")
    settings, length = engine.settings, request.headers.get("content-length", "")
    announced = int(length) if length.isdigit() else settings.max_bulk_bytes
    if announced > settings.max_bulk_bytes:
        raise BodyTooLarge(f"The body has more than {settings.max_bulk_bytes} bytes, the most that is accepted here.")
    intake_of(request).pass_on(settings.max_bulk_bytes, settings.bulk_timeout)
    most = settings.max_bulk_items + FIELD_PARTS
    header = request.headers["content-type"]
    name = await staging.receive(request.stream(), header, announced, most, settings.max_image_bytes)
    arguments = {"align": align, "most_speed": most_speed, "replace": replace}
    return await to_its_end(lambda: _submit(engine, jobs, staging, map_, name, arguments))


def _submit(engine: Engine, jobs: Jobs, staging: Staging, map_: Map, name: str, arguments: Mapping[str, Any]) -> Job:
    """Submit a job for a form; if that fails, the form is removed."""
    try:
        count = len(_read_form(engine, staging.open(name))[0])
        maps = {map_.record.id: creation_time(map_)}
        arguments = {"form": name, "places": count, **arguments}
        return jobs.submit(KIND, map_.record.id, arguments=arguments, maps=maps)
    except BaseException:
        staging.remove(name)
        raise


def discard(staging: Staging, job: Job) -> None:
    """Remove the form of a job that has ended."""
    if (name := job.arguments.get("form")) is not None:
        staging.remove(name)


def _read_form(engine: Engine, form: StagedForm) -> tuple[list[Any], dict[str, StagedPart]]:
    """The entries of a form's part ``places``, and its file parts by name.

    Raises:
        InvalidRequest, MalformedBody: the form as a whole is malformed.
        StorageFailure: the form is damaged on disk.
    """
    listed = [part for part in form.parts if part.name == PART]
    if len(listed) != 1 or listed[0].oversized:
        raise InvalidRequest(f"The form needs one JSON part named {PART!r}.")
    entries = parse_json(form.read(listed[0]).data, f"The part {PART!r}")
    files = [part for part in form.parts if part.name != PART]
    check_batch(entries, [part.name for part in files], engine.settings.max_bulk_items)
    return entries, {part.name: part for part in files}


def enrol_staged(engine: Engine, staging: Staging, align: Align, context: JobContext) -> Mapping[str, Any]:
    """The work of a job: enrol the frames of its form, from where an earlier attempt stopped; then align on request.

    Returns:
        The result of the job.

    Raises:
        NothingEnrolled: every frame failed.
        UnknownMap, MapQuarantined, EncoderNotInstalled, TooManyPlaces, StorageFull, StorageFailure: the frames that
            were stored before stay.
        JobCancelled, JobInterrupted, JobGivesWay: the job has to stop.
    """
    form = _Form(engine, staging, context)
    replace = bool(context.arguments.get("replace", True))
    made = EnrolmentInCommits(engine, context, form.entries, form.frame, replace=replace).run()
    result = {**made, "remarks": [*form.remarks, *pose_remarks(context.map(engine.maps), form.sequences())]}
    if not context.arguments.get("align", False):
        return result
    return {**result, "aligned": align(engine, context, form.sequences())}


@dataclass
class _Outcome:
    """The outcome of the first ``done`` entries; it is stored in the job's notes.

    changes: how many places were created, updated, replaced or unchanged.
    failed: how many entries could not be enrolled.
    named: the first of these, with their problems.
    """

    done: int
    changes: dict[str, int]
    failed: int
    named: list[dict[str, Any]]

    def fail(self, position: int, entry: Any, error: Exception) -> None:
        self.failed += 1
        if len(self.named) < MOST_LISTED:
            problem = problem_of(error).model_dump(exclude_none=True)
            item = {"position": position, "id": entry_id(entry), "status": problem["status"], "problem": problem}
            self.named.append(item)

    def nothing_enrolled(self) -> NothingEnrolled:
        """The error of a job all of whose frames failed."""
        listed = [
            {"location": item["id"] or f"places.{item['position']}", "message": item["problem"]["detail"]}
            for item in self.named
        ]
        first = listed[0]
        return NothingEnrolled(
            f"None of the {self.failed} frames became a place; the first, {first['location']}: {first['message']}",
            listed,
        )


class EnrolmentInCommits:
    """One attempt of a job that enrols many frames, some with each commit.

    Args:
        entries: JSON values, each with the ``id`` of its place.
        frame: reads the frame of an entry by its position; an error that concerns this frame alone is reported.  It may
            give way, after which it is asked for the same frame again.
        gives_way: whether other jobs may come between two commits, after which the entries are read again.
        replace: whether a frame replaces the place of another frame.
    """

    def __init__(
        self,
        engine: Engine,
        context: JobContext,
        entries: Sequence[Any],
        frame: Callable[[int], FrameToEnrol],
        gives_way: bool = True,
        replace: bool = True,
    ) -> None:
        self.engine, self.context, self.entries, self._frame = engine, context, entries, frame
        self._gives_way, self._replace = gives_way, replace
        self.map = context.map(engine.maps)
        nothing = {"done": 0, "changes": {}, "failed": 0, "named": []}
        self.outcome = _Outcome(**context.notes.get("told", nothing))

    def run(self) -> Mapping[str, Any]:
        """Enrol what an attempt before this one has not; the result of the job.

        Raises:
            NothingEnrolled: every frame failed.
            TooManyPlaces, EncoderNotInstalled, StorageFull, StorageFailure: what was stored before stays.
            JobCancelled, JobInterrupted, JobGivesWay: the job has to stop.
        """
        outcome, total = self.outcome, len(self.entries)
        while outcome.done < total:
            self.context.progress(outcome.done, total)
            self.context.check_cancelled()
            self._enrol_some()
            self.context.remember(told=vars(outcome))
            if self._gives_way:
                self.context.give_way()
        self.context.progress(outcome.done, total)
        if outcome.failed and not outcome.changes:
            raise outcome.nothing_enrolled()
        return {
            "map": self.map.record.id,
            "encoder": self.map.record.encoder,
            "places": self.map.count_places(),
            "changes": outcome.changes,
            "failed": {"count": outcome.failed, "items": outcome.named},
        }

    def _enrol_some(self) -> None:
        """Encode and store the frames of one commit."""
        frames: list[FrameToEnrol] = []
        positions: list[int] = []
        failures: dict[int, Exception] = {}
        stop, size = self.outcome.done, 0
        while stop < len(self.entries) and len(frames) < PLACES_PER_COMMIT and size < BYTES_PER_COMMIT:
            try:
                frames.append(self._frame(stop))
            except (JobCancelled, JobInterrupted):
                raise
            except JobGivesWay:
                if stop == self.outcome.done:
                    raise
                break  # those before it are stored first
            except Exception as error:
                check_frame_error(error)
                failures[stop] = error
            else:
                positions.append(stop)
                size += len(frames[-1].data or b"")
            stop += 1

        def reject(index: int, error: Exception) -> None:
            check_frame_error(error)
            failures[positions[index]] = error

        async def work(deadline: RequestDeadline) -> dict[int, Enrolled]:
            return await enrol(
                self.engine, self.map, frames, deadline, reject, queued=False, replace_places=self._replace
            )

        stored = run_after_requests(self.engine, self.context, work) if frames else {}
        for one in stored.values():
            self.outcome.changes[one.change] = self.outcome.changes.get(one.change, 0) + 1
        for position in sorted(failures):
            self.outcome.fail(position, self.entries[position], failures[position])
        self.outcome.done = stop


class _Form:
    """The form of a job."""

    def __init__(self, engine: Engine, staging: Staging, context: JobContext) -> None:
        self._settings, self._cameras = engine.settings, context.map(engine.maps).cameras
        self._form = staging.open(context.arguments["form"])
        self.entries, self._files = _read_form(engine, self._form)
        self._first: dict[str, int] = {}
        """The position of the first entry of each id."""
        for position, entry in enumerate(self.entries):
            self._first.setdefault(entry_id(entry) or "", position)
        self._implausible, self.remarks = judge_entries(self.entries, context.arguments.get("most_speed") or MOST_SPEED)

    def sequences(self) -> list[str]:
        """The names of the form's traverses, in the order of their first entries."""
        names = [entry.get("sequence") for entry in self.entries if isinstance(entry, dict)]
        return list(dict.fromkeys(name for name in names if isinstance(name, str)))

    def frame(self, position: int) -> FrameToEnrol:
        """The frame of an entry."""
        frame = read_entry(self.entries[position], self._files, self._read, self._cameras, self._settings)
        if self._first[frame.id] != position:
            raise InvalidRequest(f"id: the form has {frame.id} twice.")
        if position in self._implausible:
            raise self._implausible[position]
        return frame

    def _read(self, name: str) -> FormPart:
        return self._form.read(self._files[name])

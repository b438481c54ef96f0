"""A traverse enrolled by one request and a job: its frames wait on disk, and are stored some at a time.

What the job has told of is stored; after a kill it goes on behind that.  What was stored and not told of yet is met
again: a place that holds the frame already is left as it is.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from starlette.requests import Request

from core.storage import Map
from service.engine.engine import Engine
from service.engine.queue import RequestDeadline
from service.errors.faults import BodyTooLarge, InvalidRequest, UnsupportedMediaType
from service.errors.problems import problem_of
from service.http.bodies import intake_of, parse_json
from service.http.multipart import Part
from service.http.uploads import FIELD_PARTS, FORM, media_type
from service.jobs.context import JobContext, creation_time, run_after_requests
from service.jobs.jobs import Jobs
from service.jobs.records import Job
from service.places.batches import candidate_of, check_batch, check_own, given_id
from service.places.enrolment import Candidate, Enrolled, enrol
from service.places.staging import StagedForm, StagedPart, Staging
from service.worker_threads import to_its_end

KIND = "enrol"

TOGETHER = 64
"""Places of one commit, at most."""

BYTES_TOGETHER = 32 << 20
"""Bytes of their frames, at most, if there is more than one."""

NAMED = 200
"""Frames that could not be enrolled are counted, and so many named."""

PART = "places"


async def receive(engine: Engine, jobs: Jobs, staging: Staging, map_: Map, request: Request) -> Job:
    """Write a form down as it arrives, and let a job for it wait; both are on disk when this returns.

    Raises:
        JobQueueFull, StagingFull: it was not read.
        UnsupportedMediaType, MalformedBody, BodyTooLarge, InvalidRequest, DeadlineExceeded, ClientGone: it is none, or
            did not come whole.
        StorageFull, StorageFailure: nothing of it is left.
    """
    jobs.check_room()
    if (kind := media_type(request)) != FORM:
        raise UnsupportedMediaType(f"The frames are sent in a {FORM}, not as {kind[:80] or 'anything unnamed'}.")
    settings, length = engine.settings, request.headers.get("content-length", "")
    announced = int(length) if length.isdigit() else settings.max_bulk_bytes
    if announced > settings.max_bulk_bytes:
        raise BodyTooLarge(f"The body has more than the {settings.max_bulk_bytes} bytes that are taken here.")
    intake_of(request).pass_on(settings.max_bulk_bytes, settings.bulk_timeout)
    most = settings.max_bulk_items + FIELD_PARTS
    header = request.headers["content-type"]
    name = await staging.receive(request.stream(), header, announced, most, settings.max_image_bytes)
    return await to_its_end(lambda: _submit(engine, jobs, staging, map_, name))


def _submit(engine: Engine, jobs: Jobs, staging: Staging, map_: Map, name: str) -> Job:
    """Let a job wait for a form, which is removed if there comes none."""
    try:
        count = len(_entries(engine, staging.open(name))[0])
        maps = {map_.record.id: creation_time(map_)}
        return jobs.submit(KIND, map_.record.id, arguments={"form": name, "places": count}, maps=maps)
    except BaseException:
        staging.remove(name)
        raise


def discard(staging: Staging, job: Job) -> None:
    """Remove the frames of a job that has ended."""
    if (name := job.arguments.get("form")) is not None:
        staging.remove(name)


def _entries(engine: Engine, form: StagedForm) -> tuple[list[Any], dict[str, StagedPart]]:
    """The places that a form lists, and its file parts by name.

    Raises:
        InvalidRequest, MalformedBody: it makes no sense as a whole.
        StorageFailure: it is damaged.
    """
    listed = [part for part in form.parts if part.name == PART]
    if len(listed) != 1 or listed[0].oversized:
        raise InvalidRequest(f"The form needs one JSON part named {PART!r}.")
    entries = parse_json(form.read(listed[0]).data, f"The part {PART!r}")
    files = [part for part in form.parts if part.name != PART]
    check_batch(entries, [part.name for part in files], engine.settings.max_bulk_items)
    return entries, {part.name: part for part in files}


def enrol_staged(engine: Engine, staging: Staging, context: JobContext) -> Mapping[str, Any]:
    """Do, or go on with, what the job says: enrol the frames of the form that waits for it.

    Raises:
        UnknownMap, MapQuarantined, EncoderNotInstalled, TooManyPlaces, StorageFull, StorageFailure: what was enrolled
            until then stays.
    """
    return _BulkEnrolment(engine, staging, context).run()


@dataclass
class _Told:
    """What became of the places so far: ``done`` of them in all."""

    done: int
    changes: dict[str, int]
    failed: int
    named: list[dict[str, Any]]

    def fail(self, position: int, entry: Any, error: Exception) -> None:
        self.failed += 1
        if len(self.named) < NAMED:
            problem = problem_of(error).model_dump(exclude_none=True)
            told = {"position": position, "id": given_id(entry), "status": problem["status"], "problem": problem}
            self.named.append(told)


class _BulkEnrolment:
    """One attempt."""

    def __init__(self, engine: Engine, staging: Staging, context: JobContext) -> None:
        self.engine, self.context = engine, context
        self.map = context.map(engine.atlas)
        self.form = staging.open(context.arguments["form"])
        self.entries, self.files = _entries(engine, self.form)
        self.first: dict[str, int] = {}
        """Where each id stands first."""
        for position, entry in enumerate(self.entries):
            self.first.setdefault(given_id(entry) or "", position)
        known = {"done": 0, "changes": {}, "failed": 0, "named": []}
        self.told = _Told(**context.notes.get("told", known))

    def run(self) -> Mapping[str, Any]:
        told, total = self.told, len(self.entries)
        while told.done < total:
            self.context.progress(told.done, total)
            self.context.check_cancelled()
            self._enrol_some()
            self.context.remember(told=vars(told))
            self.context.give_way()
        self.context.progress(told.done, total)
        return {
            "map": self.map.record.id,
            "encoder": self.map.record.encoder,
            "places": self.map.count_places(),
            "changes": told.changes,
            "failed": {"count": told.failed, "items": told.named},
        }

    def _enrol_some(self) -> None:
        """One commit."""
        candidates: list[Candidate] = []
        positions: list[int] = []
        failures: dict[int, Exception] = {}
        stop, size = self.told.done, 0
        while stop < len(self.entries) and len(candidates) < TOGETHER and size < BYTES_TOGETHER:
            try:
                candidates.append(self._candidate(stop))
            except Exception as error:
                check_own(error)
                failures[stop] = error
            else:
                positions.append(stop)
                size += len(candidates[-1].data or b"")
            stop += 1

        def reject(index: int, error: Exception) -> None:
            check_own(error)
            failures[positions[index]] = error

        async def work(deadline: RequestDeadline) -> dict[int, Enrolled]:
            return await enrol(self.engine, self.map, candidates, deadline, reject, queued=False)

        stored = run_after_requests(self.engine, self.context, work) if candidates else {}
        for one in stored.values():
            self.told.changes[one.change] = self.told.changes.get(one.change, 0) + 1
        for position in sorted(failures):
            self.told.fail(position, self.entries[position], failures[position])
        self.told.done = stop

    def _candidate(self, position: int) -> Candidate:
        entry = self.entries[position]
        candidate = candidate_of(entry, self.files, self._read, self.map, self.engine.settings)
        if self.first[candidate.id] != position:
            raise InvalidRequest(f"id: {candidate.id} stands in the form twice.")
        return candidate

    def _read(self, name: str) -> Part:
        return self.form.read(self.files[name])

"""Jobs that any number of services share.

The table in PostgreSQL is what counts; a service holds in memory only the jobs that it does.  Whoever adds or takes a
job holds one lock, so that each job is taken once, and of each map at most one job runs.  A service that does a job
writes only as its owner, in the attempt in which it took it: one that was away for too long, and whose job another has
taken over, finds that out at its next write, or before.
"""

from __future__ import annotations

import json
import logging
import threading
import time
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from core.errors import PlacerecError, StorageFailure, StorageFull
from service.errors.faults import JobEnded, JobLost, JobQueueFull, UnknownJob
from service.events.events import Events
from service.jobs.context import JobInterrupted, Work
from service.jobs.jobs import Jobs, note_event, problem_of_job
from service.jobs.records import Job, JobState
from service.peers.replica import BEAT_SECONDS, ServiceReplica
from service.shared.database import LIVING, SharedDatabase

TAKING = 7_061_636_575
"""The lock of whoever adds or takes a job."""

RETRY_SECONDS = 0.2
"""How soon a write of a running job is tried again while PostgreSQL is away."""

TOPIC = "job"

_JSON = ("arguments", "notes", "result", "problem", "maps", "asker")
_PLAIN = (
    "number", "id", "kind", "map", "state", "resumable", "cancelling", "attempt", "change", "done", "total", "message",
    "created_at", "started_at", "ended_at",
)  # fmt: skip
_COLUMNS = _PLAIN + _JSON
_READ = f"SELECT {', '.join(_COLUMNS)} FROM service.jobs"
_GIVEN = ", ".join(f"j.{name}" for name in _COLUMNS)
_WRITTEN = ("state", "change", "done", "total", "message", "ended_at", "notes", "result", "problem")
_OWNED = "number = %s AND owner = %s AND attempt = %s AND state = 'running'"

log = logging.getLogger("placerec.jobs")


class JobTable:
    """The table of the jobs, as one service uses it.

    Every method may raise StorageFull and StorageFailure.

    Args:
        service: the id of the service.
    """

    def __init__(self, database: SharedDatabase, service: str) -> None:
        self._database, self._service = database, service

    def add(self, job: Job, home: str | None, longest_queue: int) -> Job:
        """Add a job to the queue; the job with its number.

        Args:
            home: the only service that can do it; None: any.

        Raises:
            JobQueueFull: the largest number of jobs wait.
        """
        names = ("id", "kind", "map", "state", "resumable", "cancelling", "attempt", "change", "done", "total",
                 "message", *_JSON)  # fmt: skip
        query = (
            f"INSERT INTO service.jobs ({', '.join(names)}, home) VALUES ({', '.join(['%s'] * len(names))}, %s)"
            f" RETURNING {', '.join(_COLUMNS)}"
        )
        with self._database.text_transaction("add a job", TAKING) as connection:
            count = "SELECT count(*) FROM service.jobs WHERE state = 'queued'"
            if connection.execute(count).fetchall()[0][0] >= longest_queue:
                raise JobQueueFull("")
            values = [_value(job, name) for name in names]
            return _job(connection.execute(query, (*values, home)).fetchall()[0])

    def take(self, kinds: Sequence[str], own: Sequence[str]) -> tuple[Job, bool] | None:
        """Take the next job that this service can do; None if there is none.

        Jobs of one map run one after another, in the order of submission.  Those that wait for a service that is gone
        keep the others waiting no longer.

        Args:
            kinds: the kinds that it can do.
            own: ids of jobs of other kinds that it alone can do.

        Returns:
            The job, which counts as running, and whether it had given way.
        """
        mine = (
            "(j.home IS NULL OR j.home = %(me)s) AND ((j.resumable AND j.kind = ANY(%(kinds)s)) OR j.id = ANY(%(own)s))"
        )
        query = (
            "UPDATE service.jobs AS j SET state = 'running', owner = %(me)s, attempt = j.attempt + 1, change = 0,"
            " started_at = clock_timestamp() FROM (SELECT number FROM service.jobs AS j"
            f" WHERE j.state = 'queued' AND {mine} AND {_FREE}"
            " ORDER BY coalesce(j.behind, j.number), j.yielded LIMIT 1) AS next"
            f" WHERE j.number = next.number RETURNING {_GIVEN}, j.yielded > 0"
        )
        with self._database.text_transaction("take a job", TAKING) as connection:
            found = connection.execute(query, {"me": self._service, "kinds": list(kinds), "own": list(own)}).fetchall()
        return (_job(found[0][:-1]), found[0][-1]) if found else None

    def others_wait(self, map_id: str | None, kinds: Sequence[str]) -> bool:
        """Whether jobs of other maps wait that this service could do."""
        query = (
            "SELECT 1 FROM service.jobs AS j WHERE j.state = 'queued' AND (j.home IS NULL OR j.home = %s)"
            f" AND j.kind = ANY(%s) AND (j.map IS NULL OR j.map IS DISTINCT FROM %s) AND {_FREE} LIMIT 1"
        )
        return bool(self._database.query("look for jobs", query, (self._service, list(kinds), map_id)))

    def get(self, job_id: str) -> Job | None:
        """A job; None if there is none."""
        found = self._database.query("read a job", f"{_READ} WHERE id = %s", (job_id,))
        return _job(found[0]) if found else None

    def all(self) -> list[Job]:
        """All jobs, the oldest first."""
        return [_job(row) for row in self._database.query("read the jobs", f"{_READ} ORDER BY number")]

    def counts(self) -> Counter[JobState]:
        """How many jobs are in each state."""
        query = "SELECT state, count(*) FROM service.jobs GROUP BY state"
        return Counter(dict(self._database.query("count the jobs", query)))

    def is_home(self, job_id: str) -> bool:
        """Whether this service alone could do a job."""
        query = "SELECT 1 FROM service.jobs WHERE id = %s AND home = %s"
        return bool(self._database.query("read a job", query, (job_id, self._service)))

    def cancel(self, job_id: str) -> Job | None:
        """Ask a job to stop; one that waits is cancelled at once if nothing of it is half done.  None: it is not there.

        Raises:
            JobEnded: it has succeeded or failed.
        """
        gone = f"(j.home IS NOT NULL AND j.home NOT IN ({LIVING}))"
        query = f"SELECT state, attempt = 0 OR yielded > 0 OR {gone} FROM service.jobs AS j WHERE id = %s FOR UPDATE"
        end = "state = 'cancelled', ended_at = clock_timestamp(), notes = '{}', change = change + 1"
        ask = "cancelling = true, change = change + 1"
        with self._database.text_transaction("cancel a job", TAKING) as connection:
            for state, clean in connection.execute(query, (job_id,)).fetchall():
                if state in ("succeeded", "failed"):
                    raise JobEnded(f"The job {job_id} has {state} already.")
                if state != "cancelled":
                    change = end if state == "queued" and clean else ask
                    connection.execute(f"UPDATE service.jobs SET {change} WHERE id = %s", (job_id,))
            found = connection.execute(f"{_READ} WHERE id = %s", (job_id,)).fetchall()
        return _job(found[0]) if found else None

    def write(self, job: Job) -> bool | None:
        """Write a running job of this service, ended or not; whether it was cancelled, None if it was lost."""
        query = (
            f"UPDATE service.jobs SET {', '.join(f'{n} = %s' for n in _WRITTEN)} WHERE {_OWNED} RETURNING cancelling"
        )
        values = [_value(job, name) for name in _WRITTEN]
        found = self._database.query("write down a job", query, (*values, *self._owned(job)))
        return bool(found[0][0]) if found else None

    def release(self, job: Job, gives_way: bool) -> bool:
        """Let a running job of this service wait; False if it was lost.

        Args:
            gives_way: behind all jobs that there are now.
        """
        behind = "behind = (SELECT max(number) FROM service.jobs), yielded = nextval('service.yields'),"
        query = (
            f"UPDATE service.jobs SET {behind if gives_way else ''} state = 'queued', owner = NULL, message = %s,"
            f" done = %s, total = %s, change = change + 1 WHERE {_OWNED} RETURNING id"
        )
        values = (job.message, job.done, job.total, *self._owned(job))
        return bool(self._database.query("put a job off", query, values))

    def _owned(self, job: Job) -> tuple[Any, ...]:
        return job.number, self._service, job.attempt

    def held(self, jobs: Sequence[Job]) -> dict[str, bool]:
        """Of some jobs those that this service still owns, each with whether it was cancelled."""
        query = (
            "SELECT id, cancelling FROM service.jobs j JOIN unnest(%s::bigint[], %s::int[]) AS t (number, attempt)"
            " USING (number, attempt) WHERE owner = %s AND state = 'running'"
        )
        numbers, attempts = [job.number for job in jobs], [job.attempt for job in jobs]
        return dict(self._database.query("read the jobs", query, (numbers, attempts, self._service)))

    def let_go(self, held: Sequence[str]) -> list[Job]:
        """Let the jobs wait whose service is gone, or that this service owns but does not do.

        Args:
            held: ids of the jobs that this service does.
        """
        query = (
            "UPDATE service.jobs AS j SET state = 'queued', owner = NULL, change = change + 1,"
            " message = CASE WHEN home IS NULL THEN 'waits to be resumed after a service has ended'"
            " ELSE 'waits for the service that has its files' END"
            " WHERE state = 'running' AND resumable AND ((owner = %s AND id <> ALL(%s)) OR owner NOT IN"
            f" ({LIVING})) RETURNING {_GIVEN}"
        )
        return [_job(row) for row in self._database.query("resume jobs", query, (self._service, list(held)))]

    def fail_lost(self, held: Sequence[str], problem: Mapping[str, Any]) -> list[Job]:
        """Fail the jobs that cannot be resumed, and whose service is gone or does not know them.

        Args:
            held: ids of such jobs that this service knows.
        """
        query = (
            "UPDATE service.jobs AS j SET state = 'failed', ended_at = clock_timestamp(), notes = '{}', problem = %s,"
            " change = change + 1 WHERE state IN ('queued', 'running') AND NOT resumable"
            f" AND ((home = %s AND id <> ALL(%s)) OR home NOT IN ({LIVING})) RETURNING {_GIVEN}"
        )
        values = (json.dumps(dict(problem)), self._service, list(held))
        return [_job(row) for row in self._database.query("end jobs", query, values)]

    def trim(self, history: int) -> None:
        """Forget the oldest ended jobs beyond some."""
        query = (
            "DELETE FROM service.jobs WHERE number IN (SELECT number FROM service.jobs"
            " WHERE state NOT IN ('queued', 'running') ORDER BY number DESC OFFSET %s)"
        )
        self._database.query("forget jobs", query, (history,))


_FREE = (
    "(j.map IS NULL OR NOT EXISTS (SELECT 1 FROM service.jobs e WHERE e.map = j.map AND e.number <> j.number"
    " AND (e.state = 'running' OR (e.state = 'queued' AND e.number < j.number"
    f" AND (e.home IS NULL OR e.home IN ({LIVING}))))))"
)
"""Whether no job of the same map runs, or comes before this one."""


def _value(job: Job, name: str) -> Any:
    found = getattr(job, "map_id" if name == "map" else name)
    return json.dumps(dict(found)) if name in _JSON and found is not None else found


def _job(row: Sequence[Any]) -> Job:
    columns = dict(zip(_COLUMNS, row, strict=True))
    columns["map_id"] = columns.pop("map")
    for name in _JSON:
        columns[name] = None if columns[name] is None else json.loads(columns[name])
    for name in ("created_at", "started_at", "ended_at"):
        columns[name] = None if columns[name] is None else columns[name].astimezone(UTC)
    return Job(**columns)


class SharedJobs(Jobs):
    """All jobs of all services.  Thread-safe; methods that ask PostgreSQL block.

    Args:
        replica: this service among the others.
        shared_maps: whether all services have the same maps; else each does the jobs that were submitted to it.
        Others: as of :class:`service.jobs.jobs.Jobs`; ``longest_queue`` and ``history`` hold over all services.
    """

    def __init__(
        self,
        replica: ServiceReplica,
        database: SharedDatabase,
        shared_maps: bool,
        workers: int = 1,
        longest_queue: int = 32,
        history: int = 200,
        most_watchers: int = 64,
        events: Events | None = None,
    ) -> None:
        self._replica, self._shared_maps = replica, shared_maps
        self._table = JobTable(database, replica.id)
        self._counts: Counter[JobState] = Counter()
        self._lost: set[str] = set()
        self._taking = threading.Lock()  # held while a job is taken, and while it is looked what is to be let go
        self._news = 0
        super().__init__(Path(), workers, longest_queue, history, most_watchers, events)
        replica.every(self.keep_up)
        replica.hear(TOPIC, self._hear)

    def _open(self, directory: Path) -> None:
        """Hold nothing yet: jobs are read when they are requested."""

    def _close(self) -> None:
        """Do nothing: the connections are not of the jobs."""

    def _resume(self) -> None:
        with suppress(StorageFailure):  # it is done as soon as PostgreSQL can be reached
            self.keep_up()

    # Keeping up with the others

    def keep_up(self) -> None:
        """Take over what is left of services that are gone, and learn which jobs were lost or cancelled."""
        with self._taking:
            held = self._jobs.copy()
            owned = self._table.held(list(held.values()))
            resumed = self._table.let_go(list(held))
            why = "The service ended while the job was running or waiting, and this kind of job cannot be resumed."
            failed = self._table.fail_lost(list(self._works), problem_of_job(JobLost(why)))
        for job_id in held:
            self._mirror(job_id, owned.get(job_id))
        for job in (*resumed, *failed):
            if job.ended:
                note_event(job, job.state)
            self._announce(job)
        self._counts = self._table.counts()

    def _mirror(self, job_id: str, cancelling: bool | None) -> None:
        """Note whether a job of this service was cancelled; None: it was lost."""
        with self._changed:
            job = self._jobs.get(job_id)
            if job is not None and cancelling is None:
                self._lost.add(job_id)
            elif job is not None and cancelling and not job.cancelling:
                self._jobs[job_id] = replace(job, cancelling=True, change=job.change + 1)

    def _hear(self, job_id: str | None) -> None:
        """Learn that a job has changed; None: any may have."""
        if job_id is None or job_id in self._jobs:
            held = [job for job in self._jobs.copy().values() if job_id in (None, job.id)]
            owned = self._table.held(held)
            for job in held:
                self._mirror(job.id, owned.get(job.id))
        with self._changed:
            self._news += 1
            self._changed.notify_all()
        self._wake(job_id)
        if job_id is not None and self._discards and job_id not in self._jobs and self._table.is_home(job_id):
            ended = self._table.get(job_id)
            if ended is not None and ended.ended:
                self._discard(ended)

    def _announce(self, job: Job) -> None:
        """Tell everybody who follows a job how it is."""
        self._tell(job)
        self._wake(job.id)
        with suppress(PlacerecError):  # who follows it elsewhere asks again after a while
            self._replica.say(TOPIC, job.id)

    # Submitting, reading and cancelling

    def _add(self, job: Job, work: Work) -> Job:
        alone = not job.resumable or not self._shared_maps or job.kind in self._discards
        if not job.resumable:
            self._works[job.id] = work
        try:
            added = self._table.add(job, self._replica.id if alone else None, self._longest_queue)
        except JobQueueFull:
            self._works.pop(job.id, None)
            raise self._queue_full() from None
        except BaseException:
            self._works.pop(job.id, None)
            raise
        self._announce(added)
        return added

    def check_room(self) -> None:
        if self._counts["queued"] >= self._longest_queue:
            raise self._queue_full()

    def counts(self) -> Counter[JobState]:
        return self._counts

    def get(self, job_id: str) -> Job:
        if (job := self._jobs.get(job_id)) is not None and job_id not in self._lost:
            return job
        found = self._table.get(job_id)
        if found is None:
            raise UnknownJob(f"There is no job {job_id[:80]!r}.")
        return found

    def all(self) -> list[Job]:
        held = self._jobs.copy()
        return [held.get(job.id, job) if job.state == "running" else job for job in self._table.all()]

    def cancel(self, job_id: str) -> Job:
        job = self._table.cancel(job_id)
        if job is None:
            raise UnknownJob(f"There is no job {job_id[:80]!r}.")
        if job.ended:
            self._works.pop(job_id, None)
            if self._table.is_home(job_id):
                self._discard(job)
        elif job.cancelling:
            self._mirror(job_id, True)
        self._announce(job)
        return job

    # The workers

    def _take(self) -> Job | None:
        while not self.stopping:
            news = self._news
            try:
                if self._replica.living and (job := self._take_one()) is not None:
                    return job
            except (StorageFull, StorageFailure) as error:
                log.warning("no job can be taken: %s", error)
            with self._changed:
                if self._news == news and not self.stopping:
                    self._changed.wait(BEAT_SECONDS)
        return None

    def _take_one(self) -> Job | None:
        with self._taking:
            taken = self._table.take(list(self._kinds), list(self._works))
            if taken is None:
                return None
            job, had_given_way = taken
            with self._changed:
                if had_given_way:
                    self._gave_way[job.id] = (0, 0)
                if job.resumable:
                    self._works[job.id] = self._kinds[job.kind]
                self._jobs[job.id] = job
        self._announce(job)
        return job

    def others_wait(self, job_id: str) -> bool:
        with suppress(PlacerecError):
            return self._table.others_wait(self._jobs[job_id].map_id, list(self._kinds))
        return False

    def interrupts(self, job_id: str) -> bool:
        return self.stopping or job_id in self._lost or not self._replica.living

    def _give_way(self, job: Job) -> Job:
        return self._release(job, "waits for the jobs of other maps", gives_way=True)

    def _put_off(self, job: Job) -> Job:
        if job.resumable:
            return self._release(job, "waits to be resumed", gives_way=False)
        return super()._put_off(job)

    def _release(self, job: Job, message: str, gives_way: bool) -> Job:
        released = replace(self._jobs[job.id], state="queued", message=message)
        if not self._persist(job.id, lambda: self._table.release(released, gives_way)):
            released = replace(released, message="was lost to another service")
        self._drop(job.id)
        self._announce(released)
        return released

    def _end(self, job_id: str, state: str, **outcome: Any) -> Job:
        with self._changed:
            job = self._jobs[job_id]
            now = datetime.now(UTC)
            ended = replace(job, state=state, ended_at=now, notes={}, change=job.change + 1, **outcome)  # type: ignore[arg-type]
        owned = self._persist(job_id, lambda: self._table.write(ended) is not None)
        self._drop(job_id)
        if not owned:
            log.warning("job %s was lost to another service, which does it again", job_id)
            return replace(job, state="queued")
        note_event(ended, state)
        self._announce(ended)
        with suppress(PlacerecError):  # another one does it
            self._table.trim(self._history)
        return ended

    def _drop(self, job_id: str) -> None:
        with self._changed:
            self._jobs.pop(job_id, None)
            self._works.pop(job_id, None)
            self._gave_way.pop(job_id, None)
            self._lost.discard(job_id)

    def _persist(self, job_id: str, write: Callable[[], bool]) -> bool:
        """Write, again and again while PostgreSQL is away; False if the job is lost."""
        while True:
            try:
                return write()
            except (StorageFull, StorageFailure) as error:
                log.warning("job %s cannot be written down: %s", job_id, error)
                if not self._replica.living:
                    return False
                time.sleep(RETRY_SECONDS)

    # Changes

    def note(self, job_id: str, notes: Mapping[str, Any]) -> None:
        """Store the notes of a job for its next attempt.

        Raises:
            JobInterrupted: the job was lost to another service, or PostgreSQL is away for too long.
        """
        with self._changed:
            noted = self._jobs[job_id] = replace(self._jobs[job_id], notes=dict(notes))
        if not self._persist(job_id, lambda: self._table.write(noted) is not None):
            self._lost.add(job_id)
            raise JobInterrupted

    def _change(self, job_id: str, **changes: Any) -> Job:
        with self._changed:
            before = self._jobs[job_id]
            job = self._jobs[job_id] = replace(before, change=before.change + 1, **changes)
        try:
            self._mirror(job_id, self._table.write(job))
        except (StorageFull, StorageFailure) as error:
            log.error("job %s cannot be written down: %s", job_id, error)
        self._announce(job)
        return job

    def _wake(self, job_id: str | None) -> None:
        """Wake those who follow a job here; all for None."""
        for watched, loop, event in self._watchers.copy():
            if job_id in (None, watched):
                with suppress(RuntimeError):  # its loop has ended
                    loop.call_soon_threadsafe(event.set)

    def _notify(self, job_id: str | None) -> None:
        if job_id is not None and (job := self._jobs.get(job_id)) is not None:
            self._tell(job)
        self._wake(job_id)

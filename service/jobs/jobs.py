"""Jobs: long work in the background, which can be followed and cancelled, and survives a restart.

A job is a function that runs in a worker's thread.  A job of a registered kind (:meth:`Jobs.register`) is resumed from
its arguments and notes after a restart; any other is then marked as failed.  A cancelled job stops only at
the points where it calls :meth:`JobContext.check_cancelled`.
"""

from __future__ import annotations

import asyncio
import itertools
import json
import logging
import secrets
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from core.errors import PlacerecError
from service.access.audit import ASKER, asker_of_fields, note_job, now_asking
from service.errors.faults import JobEnded, JobLost, JobQueueFull, TooManyWatchers, UnknownJob
from service.errors.problems import problem_of
from service.events.events import Events
from service.events.schemas import JobEvent
from service.jobs.context import NOTICE_SECONDS, JobCancelled, JobContext, JobGivesWay, JobInterrupted, Work
from service.jobs.records import DAMAGED, Job, JobRecords, JobState

__all__ = ["NOTICE_SECONDS", "JobCancelled", "JobContext", "JobInterrupted", "Jobs", "Work"]

MOST_RESULT_BYTES = 4 << 20
"""The longest result, as JSON, that a job may have."""

TELLING_SECONDS = 1.0
"""The shortest time between two events of a job's progress."""

Discard = Callable[[Job], None]
"""Removes the files of a job once the job has ended."""

log = logging.getLogger("placerec.jobs")


class Jobs:
    """All jobs of a data directory.  Thread-safe; reading never waits for a disk.

    Args:
        directory: the data directory, which this process holds.
        workers: how many jobs run at one time; of one map at most one job runs.
        longest_queue: how many jobs may wait.
        history: how many ended jobs are remembered.
        most_watchers: how many clients may follow jobs at one time.
        events: receives the progress of jobs; None: it is not published.

    Raises:
        DataDirectoryTooNew: a later version of placerec wrote the jobs' file.
        StorageFull, StorageFailure: the jobs' file cannot be opened.
    """

    def __init__(
        self,
        directory: Path,
        workers: int = 1,
        longest_queue: int = 32,
        history: int = 200,
        most_watchers: int = 64,
        events: Events | None = None,
    ) -> None:
        self._workers, self._longest_queue, self._history = workers, longest_queue, history
        self._most_watchers, self._events = most_watchers, events
        self._published: dict[str, tuple[str, float]] = {}  # of running jobs: the state published last, and when
        self.stopping = False
        self._changed = threading.Condition()  # held while a job is changed
        self._kinds: dict[str, Work] = {}
        self._discards: dict[str, Discard] = {}
        self._numbers = itertools.count(1)
        self._gave_way: dict[str, tuple[int, int]] = {}  # the position in the queue of jobs that gave way
        self._works: dict[str, Work] = {}
        self._jobs: dict[str, Job] = {}
        self._last_number = 0
        self._watchers: list[tuple[str, asyncio.AbstractEventLoop, asyncio.Event]] = []
        self._threads: list[threading.Thread] = []
        self._open(directory)

    def _open(self, directory: Path) -> None:
        """Read the jobs of earlier runs."""
        self._records = JobRecords(directory)
        self._jobs |= {job.id: job for job in self._records.read()}
        self._last_number = self._records.last_number()

    # Kinds, start and end

    def register(self, kind: str, work: Work, discard: Discard | None = None) -> None:
        """Register a kind of resumable jobs.

        Args:
            work: does what ``context.arguments`` say, and goes on from any state that an earlier attempt left.
            discard: removes the files of a job that has ended.
        """
        self._kinds[kind] = work
        if discard is not None:
            self._discards[kind] = discard

    def start(self) -> None:
        """Resume the jobs of the last run of the service and start the workers; all kinds must be registered before."""
        self._resume()
        for number in range(self._workers):
            thread = threading.Thread(target=self._work, name=f"job-{number}", daemon=True)
            thread.start()
            self._threads.append(thread)

    def _resume(self) -> None:
        """Let the jobs of the last run go on, and end those that cannot."""
        for job in [job for job in self.all() if not job.ended]:
            if job.resumable and job.kind in self._kinds:
                self._works[job.id] = self._kinds[job.kind]
                if job.state == "running":
                    self._change(job.id, state="queued", message="waits to be resumed after a restart of the service")
                continue
            state = "running" if job.state == "running" else "waiting"
            why = "this kind of job cannot be resumed"
            if job.message == DAMAGED:
                why = DAMAGED
            elif job.resumable:
                why = f"this version of placerec knows no jobs of the kind {job.kind}"
            lost = JobLost(f"The service ended while the job was {state}, and {why}.")
            self._end(job.id, "failed", problem=problem_of_job(lost))
            self._discard(job)

    def stop_soon(self) -> None:
        """Ask the running jobs to stop, and end the streams of watchers; returns at once."""
        with self._changed:
            self.stopping = True
            self._changed.notify_all()
        self._notify(None)

    def close(self, timeout: float = 10.0) -> None:
        """Stop, and wait at most ``timeout`` seconds for running jobs; those that go on count as killed."""
        self.stop_soon()
        until = time.monotonic() + timeout
        for thread in self._threads:
            thread.join(max(0.0, until - time.monotonic()))
            if thread.is_alive():
                log.warning("a job does not stop; the service stops without waiting for it")
        self._close()

    def _close(self) -> None:
        self._records.close()

    # Submitting, reading and cancelling

    def submit(
        self,
        kind: str,
        map_id: str | None,
        work: Work | None = None,
        arguments: Mapping[str, Any] | None = None,
        maps: Mapping[str, str] | None = None,
    ) -> Job:
        """Add a job to the queue; it is on disk when this returns.

        Args:
            work: the function of the job; None: that of the registered kind, which survives a restart.
            arguments: the arguments of the work; JSON values.
            maps: the ids of the maps that the job uses, with their ``creation_time``: the job fails if one of them
                was replaced by another map of the same id.

        Raises:
            JobQueueFull: too many jobs are waiting.
            StorageFull, StorageFailure: the job was not accepted.
        """
        job = Job(
            number=0,
            id=secrets.token_hex(8),
            kind=kind,
            map_id=map_id,
            arguments=dict(arguments or {}),
            resumable=work is None,
            created_at=datetime.now(UTC),
            maps=dict(maps or {}),
            asker=now_asking(),
        )
        job = self._add(job, self._kinds[kind] if work is None else work)
        self._tell(job)
        log.info("job queued", extra={"job": job.id, "kind": kind, "map": map_id})
        return job

    def _add(self, job: Job, work: Work) -> Job:
        """Add a job to the queue; the job with its number."""
        with self._changed:
            self.check_room()
            job = replace(job, number=self._last_number + 1)
            self._records.put(job)
            self._last_number = job.number
            self._works[job.id], self._jobs[job.id] = work, job
            self._changed.notify_all()
        return job

    def check_room(self) -> None:
        """Raise JobQueueFull if no further job may wait; a route calls it before it reads a long body."""
        if sum(job.state == "queued" for job in self._jobs.copy().values()) >= self._longest_queue:
            raise self._queue_full()

    def _queue_full(self) -> JobQueueFull:
        return JobQueueFull(f"{self._longest_queue} jobs are waiting already; send this one again later.")

    def counts(self) -> Counter[JobState]:
        """How many of the jobs that are remembered are in each state; never waits."""
        return Counter(job.state for job in self._jobs.copy().values())

    @property
    def watchers(self) -> int:
        """The number of clients that follow jobs now."""
        return len(self._watchers)

    def get(self, job_id: str) -> Job:
        """The present state of a job.

        Raises:
            UnknownJob: there is no such job, or it ended so long ago that it is forgotten.
        """
        found = self._jobs.get(job_id)
        if found is None:
            aside = self._records.put_aside
            more = "" if aside is None else f" The records of earlier jobs were damaged; they are put aside as {aside}."
            raise UnknownJob(f"There is no job {job_id[:80]!r}.{more}")
        return found

    def all(self) -> list[Job]:
        """All jobs that are remembered, the oldest first."""
        return sorted(self._jobs.copy().values(), key=lambda job: job.number)

    def cancel(self, job_id: str) -> Job:
        """Ask a job to stop.  A waiting job is cancelled at once, a running one at the next point where it can stop.

        Raises:
            UnknownJob: there is no such job.
            JobEnded: the job has succeeded or failed.
            StorageFull, StorageFailure: the request could not be stored; the job goes on.
        """
        with self._changed:
            job = self.get(job_id)
            if job.state in ("succeeded", "failed"):
                raise JobEnded(f"The job {job_id} has {job.state} already.")
            if ended := job.state == "queued" and (not job.attempt or job_id in self._gave_way):
                job = self._end(job_id, "cancelled")
            elif job.state != "cancelled" and not job.cancelling:
                changed = replace(job, cancelling=True, change=job.change + 1)
                self._records.update(changed)
                self._jobs[job_id] = changed
        if ended:
            self._discard(job)
            return job
        self._notify(job_id)
        return self.get(job_id)

    @contextmanager
    def watching(self, job_id: str) -> Iterator[asyncio.Event]:
        """An event of the running loop that is set whenever the job changes, or when the service stops.

        Raises:
            TooManyWatchers: too many clients follow jobs already.
        """
        if len(self._watchers) >= self._most_watchers:
            raise TooManyWatchers("Too many clients follow jobs already; read the job instead, or try again later.")
        watcher = (job_id, asyncio.get_running_loop(), asyncio.Event())
        self._watchers.append(watcher)
        try:
            yield watcher[2]
        finally:
            self._watchers.remove(watcher)

    # The workers

    def _work(self) -> None:
        while (job := self._take()) is not None:
            if job.id not in self._gave_way:  # a job that gave way was noted when it began
                note_event(job, "running")
            try:
                self._do(job)
            except Exception:  # this code has a defect: the job has failed, and the worker goes on
                log.exception("job %s failed", job.id)
                self._end(job.id, "failed", problem=problem_of_job(RuntimeError()))

    def _do(self, job: Job) -> None:
        began = time.perf_counter()
        context = JobContext(self, job)
        ASKER.set(asker_of_fields(job.asker))  # it works on behalf of its caller
        try:
            result = dict(self._works[job.id](context))
            if len(json.dumps(result, allow_nan=False)) > MOST_RESULT_BYTES:
                raise ValueError("the result is too long to be stored")
        except JobCancelled:
            ended = self._end(job.id, "cancelled")
        except JobInterrupted:
            ended = self._put_off(job)
        except JobGivesWay:
            ended = self._give_way(job)
        except Exception as error:
            problem = problem_of_job(error)
            if problem["status"] == 500:
                log.exception("job %s failed", job.id)
            ended = self._end(job.id, "failed", problem=problem)
        else:
            ended = self._end(job.id, "succeeded", result=result)
        if ended.ended:
            self._discard(ended)
        seconds = round(time.perf_counter() - began, 2)
        log.info("job %s", ended.state, extra={"job": job.id, "kind": job.kind, "map": job.map_id, "seconds": seconds})

    def _take(self) -> Job | None:
        """Wait for the next job and mark it as running; None when the service stops."""
        with self._changed:
            while not self.stopping:
                for job in self._ready():
                    now = datetime.now(UTC)
                    return self._change(job.id, state="running", attempt=job.attempt + 1, started_at=now)
                self._changed.wait()
        return None

    def _ready(self, but_for: str | None = None) -> list[Job]:
        """The jobs that may run now, in order; jobs of one map run one after another, in the order of submission."""
        first: dict[str | None, int] = {}
        for job in (open_ := [job for job in self.all() if not job.ended and job.id != but_for]):
            first.setdefault(job.map_id, job.number)
        ready = [
            job
            for job in open_
            if job.state == "queued"
            and job.id in self._works
            and (job.map_id is None or first[job.map_id] == job.number)
        ]
        return sorted(ready, key=lambda job: self._gave_way.get(job.id, (job.number, 0)))

    def others_wait(self, job_id: str) -> bool:
        """Whether jobs of other maps wait that could run if this one gave way."""
        with self._changed:
            own = self._jobs[job_id].map_id
            return any(job.map_id is None or job.map_id != own for job in self._ready(job_id))

    def _give_way(self, job: Job) -> Job:
        """Let a job wait behind those that were submitted until now."""
        self._gave_way[job.id] = (self._last_number, next(self._numbers))
        changed = self._change(job.id, state="queued", message="waits for the jobs of other maps")
        with self._changed:
            self._changed.notify_all()
        return changed

    def interrupts(self, job_id: str) -> bool:
        """Whether a running job has to stop so that it can go on later."""
        return self.stopping

    def _put_off(self, job: Job) -> Job:
        """Let a job wait that was interrupted."""
        if job.resumable:
            return self._change(job.id, state="queued", message="is resumed when the service starts again")
        why = "The service was stopped while the job was running, and this kind of job cannot be resumed."
        return self._end(job.id, "failed", problem=problem_of_job(JobLost(why)))

    def _discard(self, job: Job) -> None:
        if (discard := self._discards.get(job.kind)) is not None:
            try:
                discard(job)
            except Exception as error:  # the files are removed at the next start
                log.warning("the files of the job %s cannot be removed: %s", job.id, error)

    # Changes

    def report(self, job_id: str, writing: bool, noticing: bool, **progress: Any) -> None:
        """Note the progress of a job: on disk if ``writing``, and for its watchers if ``noticing``."""
        if writing:
            self._change(job_id, **progress)
            return
        with self._changed:
            job = self._jobs[job_id]
            if {name: getattr(job, name) for name in progress} != progress:
                self._jobs[job_id] = replace(job, change=job.change + 1, **progress)
        if noticing:
            self._notify(job_id)

    def note(self, job_id: str, notes: Mapping[str, Any]) -> None:
        """Store the notes of a job for its next attempt.

        Raises:
            StorageFull, StorageFailure: the disk is full or refuses.
        """
        with self._changed:
            job = replace(self._jobs[job_id], notes=dict(notes))
            self._records.put(job)
            self._jobs[job_id] = job

    def _end(self, job_id: str, state: str, **outcome: Any) -> Job:
        """End a job, and forget the oldest ended jobs beyond ``history``."""
        with self._changed:
            past = [job for job in self.all() if job.ended]
            past = past[: max(0, len(past) + 1 - self._history)]
            for job in past:
                del self._jobs[job.id]
            ended = self._change(job_id, state=state, ended_at=datetime.now(UTC), notes={}, **outcome)
            note_event(ended, state)
            self._works.pop(job_id, None)
            self._gave_way.pop(job_id, None)
            self._changed.notify_all()  # another one of the same map may run
            if past:
                with suppress(PlacerecError):  # they are removed from disk another time
                    self._records.forget([job.number for job in past])
        return ended

    def _change(self, job_id: str, **changes: Any) -> Job:
        """Change a job in memory and on disk; if the disk refuses, the job goes on all the same."""
        with self._changed:
            before = self._jobs[job_id]
            change = 0 if "attempt" in changes else before.change + 1
            job = self._jobs[job_id] = replace(before, change=change, **changes)
            try:
                (self._records.put if "notes" in changes else self._records.update)(job)
            except Exception as error:
                log.error("job %s cannot be written down: %s", job_id, error)
        self._notify(job_id)
        return job

    def _notify(self, job_id: str | None) -> None:
        """Wake the watchers of a job; all watchers for None."""
        if job_id is not None and (job := self._jobs.get(job_id)) is not None:
            self._tell(job)
        for watched, loop, event in self._watchers.copy():
            if job_id in (None, watched):
                with suppress(RuntimeError):  # its loop has ended
                    loop.call_soon_threadsafe(event.set)

    def _tell(self, job: Job) -> None:
        """Publish the state of a job to the listeners of its maps; mere progress at most once in a while."""
        used, events = job.used_maps(), self._events
        if events is None or not any(events.heard(name) for name in used if name is not None):
            self._published.pop(job.id, None)
            return
        state, now = f"{job.state} {job.cancelling}", time.monotonic()
        published, moment = self._published.get(job.id, ("", 0.0))
        if published == state and now - moment < TELLING_SECONDS:
            return
        self._published[job.id] = (state, now)
        if job.ended:
            self._published.pop(job.id, None)
        for name in used - {None}:
            events.publish(_event(str(name), job), maps=frozenset(used))


def _event(map_id: str, job: Job) -> JobEvent:
    return JobEvent.now(
        map_id,
        asker_of_fields(job.asker),
        job=job.id,
        job_kind=job.kind,
        state=job.state,
        progress={"done": job.done, "total": job.total, "message": job.message},
        cancelling=job.cancelling,
        problem=job.problem,
    )


def problem_of_job(error: Exception) -> dict[str, Any]:
    """The problem object of a job that failed with an error."""
    return problem_of(error).model_dump(exclude_none=True)


def note_event(job: Job, event: str) -> None:
    """Write a line of the audit trail about a job."""
    line = {"job": job.id, "kind": job.kind, "map": job.map_id, "attempt": job.attempt}
    note_job(event, line, job.arguments, job.problem, job.asker)

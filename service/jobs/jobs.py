"""Jobs: long work in the background, which can be followed and cancelled, and survives a restart.

A job is a function that runs in a worker's thread.  A job of a registered kind (:meth:`Jobs.register`) is resumed from
its arguments and notes after a restart; any other is then marked as failed.  A cancelled job stops only at
the points where it calls :meth:`JobContext.check_cancelled`.
"""

from __future__ import annotations

import json
import logging
import secrets
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterable, Mapping
from contextlib import suppress
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from core.disk.files import Damage
from core.errors import PlacerecError, StorageFailure, StorageFull, StoreUnavailable
from core.ledger import Ledger
from service.access.audit import ASKER, asker_of_fields, note_job, now_asking
from service.errors.faults import JobLost, UnknownJob
from service.errors.problems import problem_of
from service.events.events import Events
from service.fairness import CALLER
from service.jobs.context import NOTICE_SECONDS, JobCancelled, JobContext, JobGivesWay, JobInterrupted, Work
from service.jobs.file import open_file
from service.jobs.job import Job, JobState
from service.jobs.rows import DAMAGED
from service.jobs.table import JobTable
from service.jobs.watchers import Watchers
from service.peers.alone import Alone
from service.peers.peers import Peers

__all__ = ["NOTICE_SECONDS", "JobCancelled", "JobContext", "JobInterrupted", "Jobs", "Work"]

MOST_RESULT_BYTES = 4 << 20
"""The longest result, as JSON, that a job may have."""

REFUSALS = (StorageFull, StorageFailure, Damage)
"""The errors of a database that refuses, and may do so no longer after a while."""

RETRY_SECONDS = 0.2
"""How soon a write of a running job is tried again while the database refuses."""

TAKING_SECONDS = 2.0
"""How soon it is tried again to take a job while the database refuses."""

TOPIC = "job"
"""The topic of messages between services: the id of a job that has changed, and that of the service that says so."""

Discard = Callable[[Job], None]
"""Removes the files of a job once the job has ended."""

log = logging.getLogger("placerec.jobs")


class Jobs:
    """The jobs of one service, or of all services that share a ledger.  Thread-safe.

    The table of the jobs is what counts; a service also holds in memory the jobs that it does.  Whoever adds or takes a
    job holds one lock, so that each job is taken once, and of each map at most one job runs.  A service that does a job
    writes only as its owner, in the attempt in which it took it: one that was away for too long, and whose job another
    has taken over, finds that out at its next write, or before.

    Args:
        ledger: has the table of the jobs.
        peers: the services that share it.
        shared_maps: whether all services have the same maps; else each does the jobs that were submitted to it.
        workers: how many jobs run at one time here.
        longest_queue: how many jobs may wait, over all services.
        history: how many ended jobs are remembered.
        most_watchers: how many clients may follow jobs at one time.
        events: receives the progress of jobs; None: it is not published.

    Raises:
        StorageFull, StorageFailure: the jobs of a service that is alone cannot be read.
    """

    def __init__(
        self,
        ledger: Ledger,
        peers: Peers,
        shared_maps: bool = False,
        workers: int = 1,
        longest_queue: int = 32,
        history: int = 200,
        most_watchers: int = 64,
        events: Events | None = None,
    ) -> None:
        self._peers, self._shared_maps, self._workers = peers, shared_maps, workers
        self._longest_queue = longest_queue
        self.watchers = Watchers(most_watchers, events)
        self._table = JobTable(ledger, peers, longest_queue, history)
        self.stopping = False
        self._changed = threading.Condition()  # held while a job is changed in memory
        self._kinds: dict[str, Work] = {}
        self._discards: dict[str, Discard] = {}
        self._works: dict[str, Work] = {}  # of the jobs of this service that cannot be resumed
        self._jobs: dict[str, Job] = {}  # those that this service does
        self._lost: set[str] = set()  # those of them that another one has taken over
        self._taking = threading.Lock()  # held while a job is taken, and while it is looked what is to be let go
        self._resumed = False  # whether the jobs of the last run wait again, or have ended
        self._news = 0  # grows whenever there may be a job to take
        self._counts: Counter[JobState] = Counter()  # over all services, some seconds ago
        self._threads: list[threading.Thread] = []
        self._put_aside: str | None = None  # the name of a damaged file
        self._close_ledger: Callable[[], None] = lambda: None
        peers.every(self.keep_up)
        peers.hear(TOPIC, self._hear)

    @classmethod
    def of_directory(cls, directory: Path, **limits: Any) -> Jobs:
        """The jobs of a service that is alone, in a file of its data directory, which this process holds.

        Reading them never waits for a disk.

        Args:
            limits: as of the class.

        Raises:
            DataDirectoryTooNew, DataDirectoryTooOld: the jobs' file is of a version that is not read.
            StorageFull, StorageFailure: it cannot be opened.
        """
        ledger, put_aside = open_file(directory)
        jobs = cls(ledger, Alone(), **limits)
        jobs._put_aside, jobs._close_ledger = put_aside, ledger.close
        return jobs

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
        with suppress(*REFUSALS):  # it is done before the first job is taken
            self.keep_up()
        for number in range(self._workers):
            thread = threading.Thread(target=self._work, name=f"job-{number}", daemon=True)
            thread.start()
            self._threads.append(thread)

    def stop_soon(self) -> None:
        """Ask the running jobs to stop, and end the streams of watchers; returns at once."""
        with self._changed:
            self.stopping = True
            self._changed.notify_all()
        self.watchers.wake(None)

    def close(self, timeout: float = 10.0) -> None:
        """Stop, and wait at most ``timeout`` seconds for running jobs; those that go on count as killed."""
        self.stop_soon()
        until = time.monotonic() + timeout
        for thread in self._threads:
            thread.join(max(0.0, until - time.monotonic()))
            if thread.is_alive():
                log.warning("a job does not stop; the service stops without waiting for it")
        self._close_ledger()

    # Keeping up with other services

    def keep_up(self) -> None:
        """Take over what is left of services that are gone, and learn which jobs were lost or cancelled.

        Raises:
            StorageFull, StorageFailure.
        """
        with self._taking:
            held = self._jobs.copy()
            owned = self._table.held()
            changed = self._table.recover(self._kinds, self._works.copy(), held, _problem_of_lost)
        self._mirror(held.values(), owned)
        for job in changed:
            if job.ended:
                note_event(job, job.state)
                self._discard(job)
            self._announce(job)
        self._counts = self._table.counts()
        self._resumed = True
        self._rouse()

    def _mirror(self, held: Iterable[Job], owned: Mapping[tuple[str, int], bool]) -> None:
        """Note which of the jobs of this service are cancelled, or not its own any more."""
        with self._changed:
            for job_id in {job.id for job in held} & self._jobs.keys():
                job = self._jobs[job_id]
                if (cancelling := owned.get((job_id, job.attempt))) is None:
                    self._lost.add(job_id)
                elif cancelling and not job.cancelling:
                    self._jobs[job_id] = replace(job, cancelling=True, change=job.change + 1)

    def _hear(self, text: str | None) -> None:
        """Learn that another service has changed a job; None: any may have."""
        job_id, _, service = (text or "").partition(" ")
        if service == self._peers.id:
            return
        if held := [job for job in self._jobs.copy().values() if text is None or job.id == job_id]:
            self._mirror(held, self._table.held())
        elif self._discards and (job := self._table.get(job_id)) is not None and job.ended:
            self._discard(job)
        self._rouse()
        self.watchers.wake(job_id or None)

    def _announce(self, job: Job) -> None:
        """Notify everybody who follows a job, and the other services."""
        self.watchers.notify(job)
        if job.state != "running":
            self._rouse()
        with suppress(PlacerecError):  # others look by themselves after a while
            self._peers.say(TOPIC, f"{job.id} {self._peers.id}")

    def _rouse(self) -> None:
        """Let the workers look for a job."""
        with self._changed:
            self._news += 1
            self._changed.notify_all()

    # Submitting, reading and cancelling

    def submit(
        self,
        kind: str,
        map_id: str | None,
        work: Work | None = None,
        arguments: Mapping[str, Any] | None = None,
        maps: Mapping[str, str] | None = None,
    ) -> Job:
        """Add a job to the queue; it is durable when this returns.

        Args:
            work: the function of the job; None: that of the registered kind, which survives a restart.
            arguments: the arguments of the work; JSON values.
            maps: the ids of the maps that the job uses, with their ``creation_time``: the job fails if one of them
                was replaced by another map of the same id.

        Raises:
            JobQueueFull: too many jobs are waiting, and the caller has its share of them.
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
            home=None if work is None and self._shared_maps and kind not in self._discards else self._peers.id,
        )
        if work is not None:
            self._works[job.id] = work
        try:
            job = self._table.add(job)
        except BaseException:
            self._works.pop(job.id, None)
            raise
        self._announce(job)
        log.info("job queued", extra={"job": job.id, "kind": kind, "map": map_id})
        return job

    def check_room(self) -> None:
        """Raise JobQueueFull if no further job of the caller may wait; may block.

        A route calls it before it reads a long body.
        """
        if self.counts()["queued"] >= self._longest_queue:
            self._table.check_room(ASKER.get().caller)

    def counts(self) -> Counter[JobState]:
        """How many of the jobs that are remembered are in each state; never waits."""
        return self._table.counts() if self._peers.alone else self._counts

    def get(self, job_id: str) -> Job:
        """The present state of a job.

        Raises:
            UnknownJob: there is no such job, or it ended so long ago that it is forgotten.
        """
        found = self._jobs.get(job_id)
        if found is None or job_id in self._lost:
            found = self._table.get(job_id)
        if found is None:
            raise self._unknown(job_id)
        return found

    def _unknown(self, job_id: str) -> UnknownJob:
        aside = self._put_aside
        more = "" if aside is None else f" The records of earlier jobs were damaged; they are put aside as {aside}."
        return UnknownJob(f"There is no job {job_id[:80]!r}.{more}")

    def all(self) -> list[Job]:
        """All jobs that are remembered, the oldest first."""
        held = {name: job for name, job in self._jobs.copy().items() if name not in self._lost}
        return [held.get(job.id, job) if job.state == "running" else job for job in self._table.all()]

    def cancel(self, job_id: str) -> Job:
        """Ask a job to stop.  A waiting job is cancelled at once, a running one at the next point where it can stop.

        Raises:
            UnknownJob: there is no such job.
            JobEnded: the job has succeeded or failed.
            StorageFull, StorageFailure: the request could not be stored; the job goes on.
        """
        found = self._table.cancel(job_id)
        if found is None:
            raise self._unknown(job_id)
        job, ended = found
        if ended:
            self._works.pop(job_id, None)
            note_event(job, job.state)
            self._discard(job)
        elif not job.ended:
            self._mirror([job], {(job_id, job.attempt): job.cancelling})
        self._announce(job)
        return job

    # The workers

    def _work(self) -> None:
        while (job := self._take()) is not None:
            try:
                self._do(job)
            except Exception:  # this code has a defect: the job has failed, and the worker goes on
                log.exception("job %s failed", job.id)
                with suppress(Exception):
                    self._end(job.id, "failed", message="", problem=problem_of_job(RuntimeError()))

    def _do(self, job: Job) -> None:
        began = time.perf_counter()
        context = JobContext(self, job)
        asker = asker_of_fields(job.asker)
        ASKER.set(asker)  # it works on behalf of its caller
        CALLER.set(asker.caller)
        try:
            result = dict((self._works[job.id] if job.id in self._works else self._kinds[job.kind])(context))
            if len(json.dumps(result, allow_nan=False)) > MOST_RESULT_BYTES:
                raise ValueError("the result is too long to be stored")
        except JobCancelled:
            ended = self._end(job.id, "cancelled")
        except JobInterrupted:
            ended = self._put_off(job)
        except JobGivesWay:
            ended = self._release(job, "waits for the jobs of other maps", self._table.give_way)
        except Exception as error:
            problem = problem_of_job(error)
            if problem["status"] == 500:
                log.exception("job %s failed", job.id)
            ended = self._end(job.id, "failed", problem=problem)
        else:
            ended = self._end(job.id, "succeeded", result=result)
        seconds = round(time.perf_counter() - began, 2)
        log.info("job %s", ended.state, extra={"job": job.id, "kind": job.kind, "map": job.map_id, "seconds": seconds})

    def _take(self) -> Job | None:
        """Wait for the next job and mark it as running; None when the service stops."""
        while not self.stopping:
            news, patience = self._news, None
            try:
                if self._peers.living and (job := self._take_one()) is not None:
                    return job
            except Exception as error:
                log.warning("no job can be taken: %s", error)
                patience = TAKING_SECONDS
            with self._changed:
                self._changed.wait_for(lambda news=news: self.stopping or self._news != news, patience)  # type: ignore[misc]
        return None

    def _take_one(self) -> Job | None:
        if not self._resumed:
            self.keep_up()
        with self._taking:
            taken = self._table.take(self._kinds, self._works.copy())
            if taken is None:
                return None
            job, had_given_way = taken
            self._jobs[job.id] = job
        if not had_given_way:  # else it was noted when it began
            note_event(job, "running")
        self._announce(job)
        return job

    def others_wait(self, job_id: str) -> bool:
        """Whether jobs of other maps wait that could run if this one gave way."""
        with suppress(PlacerecError):
            return self._table.others_wait(self._jobs[job_id].map_id, self._kinds, self._works.copy())
        return False

    def interrupts(self, job_id: str) -> bool:
        """Whether a running job has to stop so that it can go on later, or was lost to another service."""
        return self.stopping or job_id in self._lost or not self._peers.living

    def _put_off(self, job: Job) -> Job:
        """Let a job wait that was interrupted."""
        if job.resumable:
            again = "waits to be resumed" if job.home is None else "is resumed when the service starts again"
            return self._release(job, again, self._table.put_off)
        why = "The service was stopped while the job was running, and this kind of job cannot be resumed."
        return self._end(job.id, "failed", problem=problem_of_job(JobLost(why)))

    def _release(self, job: Job, message: str, write: Callable[[Job], Job | None]) -> Job:
        before = self._jobs[job.id]
        released = replace(before, state="queued", message=message, change=before.change + 1)
        if self._persist(released, write) is None:
            released = replace(released, message="was lost to another service")
        self._drop(job.id)
        self._announce(released)
        return released

    def _end(self, job_id: str, state: JobState, **outcome: Any) -> Job:
        """End a job that runs here; it waits if it was lost to another service."""
        job = self._jobs[job_id]
        now = datetime.now(UTC)
        ended = replace(job, state=state, ended_at=now, notes={}, change=job.change + 1, **outcome)
        written = self._persist(ended, self._table.end)
        self._drop(job_id)
        if written is None:
            log.warning("the end of job %s could not be written; it is done again", job_id)
            return replace(job, state="queued")
        note_event(ended, state)
        self._discard(ended)
        self._announce(ended)
        return ended

    def _persist(
        self, job: Job, write: Callable[[Job], Job | None], awaited: tuple[type[Exception], ...] = REFUSALS
    ) -> Job | None:
        """Write a running job, again and again while the database refuses; None if the job is lost, or must wait.

        Args:
            awaited: the errors after which it is written again.
        """
        refused = False
        while True:
            try:
                return write(job)
            except awaited as error:
                if not refused:
                    log.warning("job %s cannot be written down: %s", job.id, error)
                if self.stopping or not self._peers.living:
                    return None
                if self._peers.alone and not refused:  # nobody else can do it meanwhile
                    self._jobs[job.id] = job
                    self.watchers.notify(job)
                refused = True
                time.sleep(RETRY_SECONDS)

    def _drop(self, job_id: str) -> None:
        with self._changed:
            self._jobs.pop(job_id, None)
            self._works.pop(job_id, None)
            self._lost.discard(job_id)

    def _discard(self, job: Job) -> None:
        """Remove the files of an ended job, if this service has them."""
        if job.home == self._peers.id and (discard := self._discards.get(job.kind)) is not None:
            try:
                discard(job)
            except Exception as error:  # the files are removed at the next start
                log.warning("the files of the job %s cannot be removed: %s", job.id, error)

    # Changes

    def report(self, job_id: str, writing: bool, noticing: bool, **progress: Any) -> None:
        """Note the progress of a job: durably if ``writing``, and for its watchers if ``noticing``.

        If the database refuses, the job goes on all the same.
        """
        with self._changed:
            job = self._jobs[job_id]
            if writing or {name: getattr(job, name) for name in progress} != progress:
                job = self._jobs[job_id] = replace(job, change=job.change + 1, **progress)
        if writing:
            self._write(job)
            self._announce(job)
        elif noticing:
            self.watchers.notify(job)

    def _write(self, job: Job) -> None:
        try:
            written = self._table.progress(job)
        except Exception as error:
            log.error("job %s cannot be written down: %s", job.id, error)
        else:
            self._mirror([job], {} if written is None else {(job.id, job.attempt): written.cancelling})

    def note(self, job_id: str, notes: Mapping[str, Any]) -> None:
        """Store the notes of a job for its next attempt.

        Raises:
            StorageFull, StorageFailure: the database refuses.
            JobInterrupted: the job was lost to another service, or the database is away for too long.
        """
        with self._changed:
            job = self._jobs[job_id]
            noted = self._jobs[job_id] = replace(job, notes=dict(notes), change=job.change + 1)
        if self._persist(noted, self._table.note, (StoreUnavailable,)) is None:
            self._lost.add(job_id)
            raise JobInterrupted


def problem_of_job(error: Exception) -> dict[str, Any]:
    """The problem object of a job that failed with an error."""
    return problem_of(error).model_dump(exclude_none=True)


def note_event(job: Job, event: str) -> None:
    """Write a line of the audit trail about a job."""
    line = {"job": job.id, "kind": job.kind, "map": job.map_id, "attempt": job.attempt}
    note_job(event, line, job.arguments, job.problem, job.asker)


def _problem_of_lost(job: Job) -> dict[str, Any]:
    """The problem of a job that this service cannot do any more."""
    why = "this kind of job cannot be resumed"
    if job.message == DAMAGED:
        why = DAMAGED
    elif job.resumable:
        why = f"this version of placerec knows no jobs of the kind {job.kind}"
    state = "running" if job.state == "running" else "waiting"
    return problem_of_job(JobLost(f"The service ended while the job was {state}, and {why}."))

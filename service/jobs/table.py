"""The table of the jobs, as one service uses it: in a file of its data directory, or shared with others."""

from __future__ import annotations

import json
import threading
from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import AbstractContextManager, nullcontext
from dataclasses import replace
from datetime import UTC, datetime
from typing import Any

from core.ledger import Ledger, LedgerConnection, Lock, Statement
from service.access.audit import asker_of_fields
from service.errors.faults import JobEnded, JobQueueFull
from service.jobs import statements
from service.jobs.job import Job, JobState
from service.jobs.rows import DAMAGED, job_of, values_of
from service.peers.peers import Peers


class JobTable:
    """The table of the jobs, as one service uses it.  Any thread may use it.

    A service that shares it with no other one reads all of it once, and then knows its rows by what it writes.  Every
    method may raise StorageFull and StorageFailure.

    Args:
        ledger: has the table.
        peers: the services that share it.
        longest_queue: how many jobs may wait.
        history: how many ended jobs stay in it.
    """

    def __init__(self, ledger: Ledger, peers: Peers, longest_queue: int, history: int) -> None:
        self._ledger, self._peers, self._longest_queue, self._history = ledger, peers, longest_queue, history
        self._order: AbstractContextManager[object] = nullcontext()  # of writes, and of what is known by them
        self._known: dict[str, Job] | None = None
        if peers.alone:
            self._order, self._known = threading.RLock(), {}
            for job in self._learn(ledger.execute("read the jobs", statements.ALL)):
                if job.message == DAMAGED and not job.ended:  # its row may say something else
                    repaired = self._learned(replace(job, home=peers.id))
                    ledger.execute("repair a job", statements.PUT, **values_of(repaired))

    # Reading

    def get(self, job_id: str) -> Job | None:
        """A job; None if there is none."""
        if self._known is not None:
            return self._known.get(job_id)
        found = self._ledger.execute("read a job", statements.GET, id=job_id)
        return job_of(found[0]) if found else None

    def all(self) -> list[Job]:
        """All jobs, the oldest first."""
        if self._known is not None:
            return list(self._known.copy().values())
        return [job_of(row) for row in self._ledger.execute("read the jobs", statements.ALL)]

    def counts(self) -> Counter[JobState]:
        """How many jobs are in each state."""
        if self._known is not None:
            return Counter(job.state for job in self._known.copy().values())
        return Counter(dict(self._ledger.execute("count the jobs", statements.COUNTS)))

    def held(self) -> dict[tuple[str, int], bool]:
        """The ids and attempts of the jobs that this service owns, each with whether it was cancelled."""
        rows = self._ledger.execute("read the jobs", statements.HELD, service=self._peers.id)
        return {(job_id, attempt): bool(cancelling) for job_id, attempt, cancelling in rows}

    def others_wait(self, map_id: str | None, kinds: Iterable[str], own: Iterable[str]) -> bool:
        """Whether jobs of other maps wait that this service could do; ``kinds`` and ``own`` as for :meth:`take`."""
        with self._ledger.transaction("look for jobs") as connection:
            given = self._given(connection, kinds=list(kinds), own=list(own))
            return bool(connection.execute(statements.OTHERS_WAIT, of_map=map_id, **given))

    # Writing

    def add(self, job: Job) -> Job:
        """Add a job to the queue; the job with its number.

        A full queue takes further jobs of a caller that has less than an equal share of it.

        Raises:
            JobQueueFull: the largest number of jobs wait.
        """
        with self._order:
            with self._ledger.transaction("add a job", Lock.JOBS) as connection:
                if connection.execute(statements.QUEUED)[0][0] >= self._longest_queue:
                    self._check_share(asker_of_fields(job.asker).caller, connection.execute(statements.WAITING_ASKERS))
                ((number,),) = connection.execute(statements.ADD, **values_of(job))
            return self._learned(replace(job, number=number))

    def check_room(self, caller: str) -> None:
        """Raise JobQueueFull if a caller could not add a job to a full queue."""
        self._check_share(caller, self._ledger.execute("read the jobs", statements.WAITING_ASKERS))

    def _check_share(self, caller: str, rows: Sequence[Sequence[Any]]) -> None:
        waiting = Counter(_caller_of(asker) for (asker,) in rows)
        if waiting[caller] >= self._longest_queue // len({*waiting, caller}):
            raise self.queue_full()

    def queue_full(self) -> JobQueueFull:
        """The error that no further job may wait."""
        return JobQueueFull(f"{self._longest_queue} jobs are waiting already; send this one again later.")

    def take(self, kinds: Iterable[str], own: Iterable[str]) -> tuple[Job, bool] | None:
        """Take the next job that this service can do; None if there is none.

        Jobs of one map run one after another, in the order of submission.  Those that wait for a service that is gone
        do not hold up the others.

        Args:
            kinds: the kinds that it can do.
            own: ids of jobs of other kinds that it alone can do.

        Returns:
            The job, which counts as running, and whether it had given way.
        """
        with self._order:
            with self._ledger.transaction("take a job", Lock.JOBS) as connection:
                given = self._given(connection, kinds=list(kinds), own=list(own))
                found = connection.execute(statements.TAKE, now=_now(), **given)
            return (self._learned(job_of(found[0][:-1])), found[0][-1] > 0) if found else None

    def progress(self, job: Job) -> Job | None:
        """Write the progress of a running job of this service; the job as it is now, None if it was lost.

        The same holds for the methods that follow.
        """
        return self._write("write down a job", statements.PROGRESS, job)

    def note(self, job: Job) -> Job | None:
        """Write its notes."""
        return self._write("write down a job", statements.NOTE, job)

    def put_off(self, job: Job) -> Job | None:
        """Let it wait."""
        return self._write("put a job off", statements.PUT_OFF, job)

    def give_way(self, job: Job) -> Job | None:
        """Let it wait behind all jobs that there are now."""
        return self._write("put a job off", statements.GIVE_WAY, job)

    def end(self, job: Job) -> Job | None:
        """Write its end, and forget the oldest ended jobs."""
        with self._order:
            with self._ledger.transaction("write down a job") as connection:
                rows = connection.execute(statements.END, service=self._peers.id, **values_of(job))
                trimmed = self._trim(connection)
            learned = self._learned(job) if rows else None
            self._forget(trimmed)
        return learned

    def cancel(self, job_id: str) -> tuple[Job, bool] | None:
        """Ask a job to stop; one that waits is cancelled at once if nothing of it is half done.

        Returns:
            The job, and whether it was cancelled at once; None if there is no such job.

        Raises:
            JobEnded: it has succeeded or failed.
        """
        with self._order:
            with self._ledger.transaction("cancel a job", Lock.JOBS) as connection:
                given = self._given(connection, id=job_id, now=_now())
                ended = connection.change(statements.CANCEL_WAITING, **given) > 0
                if not ended:
                    connection.change(statements.CANCEL, id=job_id)
                found = connection.execute(statements.GET, id=job_id)
                trimmed = self._trim(connection) if ended else []
            jobs = self._learn(found)
            self._forget(trimmed)
        if not jobs:
            return None
        (job,) = jobs
        if job.state in ("succeeded", "failed"):
            raise JobEnded(f"The job {job_id} has {job.state} already.")
        return job, ended

    def recover(
        self,
        kinds: Iterable[str],
        own: Iterable[str],
        held: Iterable[str],
        problem_of: Callable[[Job], Mapping[str, Any]],
    ) -> list[Job]:
        """Let the jobs wait whose service is gone, or that this service owns but does not do; fail those that are lost.

        Args:
            kinds, own: as for :meth:`take`; other jobs that only this service could do are lost.
            held: ids of the jobs that this service does.
            problem_of: why a lost job has failed.

        Returns:
            The jobs that wait or have failed now.
        """
        with self._order:
            with self._ledger.transaction("resume jobs") as connection:
                given = self._given(connection, kinds=list(kinds), own=list(own), held=list(held))
                rows = []
                for row in connection.execute(statements.LOST, **given):
                    lost = job_of(row)
                    problem = json.dumps(dict(problem_of(lost)))
                    rows += connection.execute(statements.FAIL, number=lost.number, problem=problem, now=_now())
                rows += connection.execute(statements.LET_GO, **given)
                trimmed = self._trim(connection) if rows else []
            jobs = self._learn(rows)
            self._forget(trimmed)
        return jobs

    def _given(self, connection: LedgerConnection, **values: Any) -> dict[str, Any]:
        return {"service": self._peers.id, "living": self._peers.living_ids(connection), **values}

    def _write(self, action: str, statement: Statement, job: Job) -> Job | None:
        with self._order:
            rows = self._ledger.execute(action, statement, service=self._peers.id, **values_of(job))
            return self._learned(replace(job, cancelling=bool(rows[0][0]))) if rows else None

    def _trim(self, connection: LedgerConnection) -> list[str]:
        return [job_id for (job_id,) in connection.execute(statements.TRIM, history=self._history)]

    # What is known without reading

    def _learn(self, rows: Iterable[Sequence[Any]]) -> list[Job]:
        return [self._learned(job_of(row)) for row in rows]

    def _learned(self, job: Job) -> Job:
        if self._known is not None:
            self._known[job.id] = job
        return job

    def _forget(self, ids: Sequence[str]) -> None:
        if self._known is not None:
            for job_id in ids:
                self._known.pop(job_id, None)


def _caller_of(asker: str) -> str:
    """The caller of a job by its column ``asker``, which may be damaged."""
    try:
        return asker_of_fields(json.loads(asker)).caller
    except (ValueError, TypeError, AttributeError):
        return ""


def _now() -> float:
    return datetime.now(UTC).timestamp()

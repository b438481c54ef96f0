"""The parts of a running application: the engine, the jobs, the sessions, exports and imports, and counted answers."""

from __future__ import annotations

import logging
import time
from collections.abc import Mapping
from contextlib import ExitStack, suppress
from dataclasses import dataclass
from datetime import UTC, datetime
from functools import partial
from typing import TYPE_CHECKING

from anyio import CapacityLimiter, to_thread
from starlette.datastructures import State

from core.disk.files import check_writable
from core.errors import PlacerecError, StoreUnavailable
from service.access.keyring import Keyring
from service.administration.audit_trail import AuditTrail
from service.app.probe import Finding, Probe
from service.backups.backups import Backups
from service.engine.engine import Engine
from service.errors.faults import KeysUnreadable, NotReady
from service.jobs.job import Job
from service.jobs.jobs import Jobs
from service.learning import lessons, new_ground
from service.learning.run_notes import RunNotes
from service.maps import calibration, self_calibration, storage_jobs
from service.maps.exports import Exports
from service.maps.imports import Imports
from service.peers.alone import Alone
from service.places import bulk_enrolment
from service.places.batch_order import BatchOrder
from service.places.plans import Plans
from service.places.staging import Staging
from service.queries.pictures import ExplanationPictures
from service.queries.statistics import QueryStatistics
from service.recordings import enrolling
from service.recordings.readers import Readers
from service.recordings.uploads import Recordings
from service.sessions.session import Session
from service.sessions.sessions import Sessions
from service.sessions.table import session_file
from service.settings import Settings, unknown_variables
from service.telemetry.history import LoadHistory
from service.telemetry.metrics import Metrics
from service.upkeep import alignment, erasure, keypoints, merging, pruning, reencoding
from service.upkeep.alarms import Alarms
from service.upkeep.retention import Retention
from service.upkeep.similarity import Matrices

if TYPE_CHECKING:
    from service.shared.database import SharedDatabase
    from service.shared.state import SharedState

CHECK_SECONDS = 1.0
"""The disk and the database are checked at most this often."""

log = logging.getLogger("placerec.runtime")


DISPENSABLE = frozenset({"others"})
"""Checks that a service answers queries without."""


@dataclass(frozen=True)
class Condition:
    """The findings of the checks of a service.

    checks: the finding of each, by its name.
    """

    checks: Mapping[str, Finding]

    @property
    def lacking(self) -> Mapping[str, Finding]:
        """The checks without which it cannot answer queries; room to write is none of them."""
        bad = {name: one for name, one in self.checks.items() if one != Finding() and not one.is_full}
        return {name: one for name, one in bad.items() if name not in DISPENSABLE}

    @property
    def degraded(self) -> Finding | None:
        """The reason for which it takes no writes, though it answers; None: it takes them."""
        return next((one for one in self.checks.values() if one.is_full), None)

    def told(self, confided: bool) -> str:
        """The things that it lacks to answer queries, in a sentence; empty: nothing."""
        return "; ".join(f"{name}: {one.told(confided)}" for name, one in self.lacking.items())

    def told_checks(self, confided: bool) -> dict[str, str]:
        """Each check, "ok" or what is wrong."""
        return {name: one.told(confided) for name, one in self.checks.items()}

    def require(self, confided: bool) -> None:
        """Raise NotReady if it cannot answer queries, with what its reader may know."""
        if lacking := self.told(confided):
            raise NotReady(f"The service is not ready: {lacking.removesuffix('.')}.", self.told_checks(confided))


class Runtime:
    """Everything that the routes work with; made when the application starts.

    Raises:
        DataDirectoryLocked, DataDirectoryTooNew, StorageFailure: the data directory cannot be opened.

    Args:
        database: the one that services share; None: this one keeps its state in its data directory.
        keyring: of the service; None: no request needs a key.
    """

    def __init__(
        self,
        settings: Settings,
        metrics: Metrics,
        database: SharedDatabase | None = None,
        keyring: Keyring | None = None,
    ) -> None:
        self.settings, self._keyring = settings, keyring
        self.started_at, self.started = datetime.now(UTC), time.monotonic()
        with ExitStack() as opened:
            self.shared = None if database is None else _shared_state(settings, database)
            events = None if self.shared is None else self.shared.events
            self.engine = Engine(settings, metrics, events)
            opened.callback(self.engine.close)
            self.jobs = _jobs(settings, self.engine) if self.shared is None else self.shared.jobs(self.engine.events)
            opened.callback(self.jobs.close, 0.0)
            if self.shared is None:
                ledger = session_file(settings.data_dir)
                self.sessions = Sessions(settings, self.engine.events, ledger, Alone())
            else:
                self.sessions = self.shared.sessions(self.engine.events)
            opened.pop_all()
        self.staging = Staging(settings.data_dir, settings.max_staged_bytes)
        self.recordings, self.bag_readers = Recordings(settings, self.jobs), Readers()
        self.batch_order, self.plans = BatchOrder(), Plans()
        statistics = QueryStatistics.of_engine if self.shared is None else self.shared.statistics
        self.statistics = statistics(self.engine)
        self.statistics.on_written = Alarms(self.engine, self.statistics).check
        self.history = metrics.history = LoadHistory(settings.data_dir)
        self._shared_ledger = database
        self.explanation_pictures = ExplanationPictures()
        self.exports, self.imports = Exports(settings), Imports(self.engine, self.jobs)
        self.backups = Backups(settings, self.engine, self.jobs)
        self.health_examinations = CapacityLimiter(1)  # each is a long search
        self.similarity_matrices = Matrices()
        self.stopping = False
        """Whether the service is about to stop, so that it is no longer ready for new requests."""
        self.degraded = False
        """Whether it has no room to write, as of the latest look."""
        self._noted = "the service is ready"
        maps, folder = self.engine.maps, partial(check_writable, settings.data_dir)
        own = settings.database is None
        self._disk = Probe(maps.check_writable if own else folder, CHECK_SECONDS, "The disk does not answer.")
        self._database = None if own else Probe(maps.check_writable, CHECK_SECONDS, "PostgreSQL does not answer.")
        rooms = erasure.Rooms(self.engine, self.statistics, self.sessions, self.explanation_pictures, self.recordings)
        self._register_jobs(rooms)
        self.sessions.on_run = self._learn
        self.audit: AuditTrail | None = None
        """The trail of this service, once there is one."""
        self.retention = Retention(settings, rooms, lambda: self.audit)

    def _learn(self, session: Session, notes: RunNotes) -> None:
        """Have a map learn from a run that is over."""
        camera = session.options.camera
        map_id, made = session.map_id, session.map_created_at
        erased = partial(erasure.concerns, self.jobs, map_id, made)
        calibrate = partial(self_calibration.calibrate_by_run, self.engine, self.statistics)
        lessons.submit(self.engine, self.jobs, map_id, made, camera, notes, erased, calibrate)

    def _register_jobs(self, rooms: erasure.Rooms) -> None:
        """Register the kinds of jobs that continue after a restart; ``Imports`` registers its own."""
        engine, staging, register = self.engine, self.staging, self.jobs.register
        align_enrolled = partial(alignment.align_enrolled, self.statistics)
        register(reencoding.KIND, partial(reencoding.reencode, engine))
        register(erasure.KIND, partial(erasure.erase, rooms))
        register(pruning.KIND, partial(pruning.prune, engine))
        register(alignment.KIND, partial(alignment.align, engine, self.statistics))
        register(merging.KIND, partial(merging.merge, engine))
        register(new_ground.KIND, partial(new_ground.accept, engine))
        register(keypoints.KIND, partial(keypoints.fill_keypoints, engine))
        register(storage_jobs.REBUILD, partial(storage_jobs.rebuild, engine))
        register(storage_jobs.VERIFY, partial(storage_jobs.verify, engine))
        register(calibration.KIND, partial(calibration.run_job, engine, self.statistics))
        register(
            bulk_enrolment.KIND,
            partial(bulk_enrolment.enrol_staged, engine, staging, align_enrolled),
            partial(bulk_enrolment.discard, staging),
        )

        register(
            enrolling.KIND,
            partial(enrolling.enrol_recording, engine, self.recordings, self.bag_readers, align_enrolled),
            self._bag_job_ended,
        )

    def _bag_job_ended(self, job: Job) -> None:
        self.bag_readers.end(job.id)
        self.recordings.job_ended(job)

    def publish(self, state: State) -> None:
        """Make the parts available to the routes, which find them by name (``service.http.routing.FromState``)."""
        state.runtime = self
        state.engine, state.jobs, state.sessions = self.engine, self.jobs, self.sessions
        state.recordings = self.recordings
        state.staging, state.batch_order, state.plans = self.staging, self.batch_order, self.plans
        state.statistics, state.explanation_pictures = self.statistics, self.explanation_pictures
        state.health_examinations = self.health_examinations
        state.similarity_matrices = self.similarity_matrices
        state.exports, state.imports, state.backups = self.exports, self.imports, self.backups
        if self.shared is not None:
            state.audit_trail = self.shared.audit
        self.audit = getattr(state, "audit_trail", None)

    def start(self) -> None:
        """Begin to load the default encoder, and start the jobs; call it from the event loop, which is not blocked."""
        for name in unknown_variables():
            log.warning("the environment sets %s, which is not a setting", name)
        self.engine.start()
        try:
            self._remove_leftovers()
            self.imports.clean()
            self.recordings.clean()
        except StoreUnavailable as error:
            log.warning("what the last run has left stays until the next start: %s", error)
        self.statistics.start()
        if self.shared is None:
            self.history.start()
        else:
            self.history.start(self._shared_ledger, self.shared.replica.id)
        self.exports.clean()
        if self.shared is not None:
            self.shared.start()
        self.jobs.start()
        self.retention.start()
        self.backups.start()

    def _remove_leftovers(self) -> None:
        """Remove the forms and unlisted maps that belong to no unfinished job."""
        unended = [job.arguments for job in self.jobs.all() if not job.ended]
        unfinished = {arguments.get("to") for arguments in unended}
        self.staging.clean({arguments["form"] for arguments in unended if "form" in arguments})
        for map_id in self.engine.maps.abandoned():
            if map_id not in unfinished:
                with suppress(PlacerecError):  # the next start tries again
                    self.engine.maps.abandon(map_id)

    async def close(self) -> None:
        """Stop the jobs, save what is in memory, and release the data directory."""
        self.engine.stop_loading()
        await self.exports.close()
        # Jobs stop first, since they need the encoder and the maps.
        await to_thread.run_sync(self.retention.close)
        await to_thread.run_sync(self.backups.close)
        await to_thread.run_sync(self.jobs.close, self.settings.shutdown_timeout)
        await to_thread.run_sync(self.bag_readers.close)
        await to_thread.run_sync(self.statistics.close)
        await to_thread.run_sync(self.history.close)
        await to_thread.run_sync(self.sessions.close)
        if self.shared is not None:
            await to_thread.run_sync(self.shared.close)
        await to_thread.run_sync(self.engine.close)

    async def check_readiness(self) -> Condition:
        """Check whether the service can answer queries, and take writes."""
        checks = {"encoder": Finding.of(self.engine.encoder_state, self.engine.public_encoder_state)}
        checks["maps"] = Finding() if self._database is None else await self._database.finding()
        checks["disk"] = await self._disk.finding()
        if self.shared is not None:
            checks["replica"] = Finding.of(self.shared.replica.state, "It is cut off from the other services.")
            checks["keys"] = Finding.of("ok" if self._keyring is None else self._keyring.state, KeysUnreadable.public)
        if self.stopping:
            checks["service"] = Finding("it is stopping", "it is stopping")
        if self.shared is not None:
            others = self.shared.differences
            checks["others"] = Finding.of(others.state, others.public_state)
        found = Condition(checks)
        self._note_readiness(found)
        self.degraded = found.degraded is not None
        return found

    def _note_readiness(self, found: Condition) -> None:
        """Log when it becomes another one; that the encoder is being loaded is no news."""
        bad, full = found.told(confided=True), found.degraded
        if bad == "encoder: loading":
            return
        now = f"the service is not ready: {bad}" if bad else "the service is ready"
        if not bad and full is not None:
            now += f", but takes no writes: {full.text}"
        before, self._noted = self._noted, now
        if now != before:
            log.log(logging.WARNING if bad or full else logging.INFO, "%s", now)


def _jobs(settings: Settings, engine: Engine) -> Jobs:
    return Jobs.of_directory(
        settings.data_dir,
        workers=settings.job_workers,
        longest_queue=settings.job_queue,
        history=settings.job_history,
        most_watchers=settings.job_watchers,
        events=engine.events,
    )


def _shared_state(settings: Settings, database: SharedDatabase) -> SharedState:
    from service.shared.state import SharedState  # with it comes what speaks to PostgreSQL

    return SharedState(settings, database, shared_maps=True)

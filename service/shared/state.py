"""The parts of a service that share their state with other services, in place of the embedded ones."""

from __future__ import annotations

from service.administration.audit_trail import AuditTable, detach
from service.engine.engine import Engine
from service.events.events import Events
from service.events.relay import EventRelay
from service.jobs.jobs import Jobs
from service.peers.differences import ReplicaDifferences
from service.peers.replica import ServiceReplica
from service.queries.statistics import QueryStatistics
from service.sessions.sessions import Sessions
from service.settings import Settings
from service.shared.database import SharedDatabase


class SharedState:
    """Makes the parts, and runs what keeps them up to date.

    Args:
        database: shared by the services.  It is not closed with the state.
        shared_maps: whether all services have the same maps, so that each can do the jobs of all.
    """

    def __init__(self, settings: Settings, database: SharedDatabase, shared_maps: bool) -> None:
        self._settings, self._database, self._shared_maps = settings, database, shared_maps
        self.replica = ServiceReplica(database, settings.data_dir)
        self.differences = ReplicaDifferences(settings, database, self.replica.id)
        self.replica.every(self.differences.compare)
        self.audit = AuditTable(database, self.replica.id)
        self._relay = EventRelay(self.replica, database)
        self.events = Events(settings.event_listeners, relay=self._relay)

    def statistics(self, engine: Engine) -> QueryStatistics:
        """The statistics of all services."""
        return QueryStatistics.of_engine(engine, self._database)

    def jobs(self, events: Events) -> Jobs:
        """All jobs of all services."""
        given = self._settings
        return Jobs(
            self._database, self.replica, self._shared_maps, given.job_workers, given.job_queue, given.job_history,
            given.job_watchers, events,
        )  # fmt: skip

    def sessions(self, events: Events) -> Sessions:
        """All sessions of all services."""
        return Sessions(self._settings, events, self._database, self.replica)

    def start(self) -> None:
        """Begin to take part; all parts must be made before."""
        self._relay.start()
        self.replica.start()
        self.audit.start()

    def close(self) -> None:
        """Leave the others; blocks."""
        self._relay.close()
        detach(self.audit)
        self.replica.close()

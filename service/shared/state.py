"""The parts of a service that share their state with other services, in place of the embedded ones."""

from __future__ import annotations

from service.events.events import Events
from service.sessions.sessions import Sessions
from service.settings import Settings
from service.shared.audit import AuditTable
from service.shared.database import SharedDatabase
from service.shared.replica import Replica
from service.shared.sessions import SharedSessions


class SharedState:
    """Makes the parts, and runs what keeps them up to date.

    Args:
        database: what the services share.  It is not closed with the state.
    """

    def __init__(self, settings: Settings, database: SharedDatabase) -> None:
        self._settings = settings
        self.replica = Replica(database, settings.data_dir)
        self.audit = AuditTable(database, self.replica.id)

    def sessions(self, events: Events) -> Sessions:
        """All sessions of all services."""
        return SharedSessions(self._settings, events, self.replica)

    def start(self) -> None:
        """Begin to take part; all parts must be made before."""
        self.replica.start()
        self.audit.start()

    def close(self) -> None:
        """Leave the others; blocks."""
        self.audit.close()
        self.replica.close()

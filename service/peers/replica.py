"""One of the services that share state: it says that it is there, hears of what the others do, and keeps up to date."""

from __future__ import annotations

import logging
import math
import secrets
import threading
import time
from collections.abc import Callable
from pathlib import Path

from sqlalchemy import Column, MetaData, Table, bindparam, select, update

from core.disk.files import disk_errors, make_folder, write_file
from core.errors import StorageFailure
from core.ledger import LedgerConnection, Statement, Tables
from core.ledger.postgres import PostgresLedger
from core.ledger.statements import real, seconds_now, text
from service.peers.peers import Heard

FILE = "replica"

BEAT_SECONDS = 2.0
"""How often a service says that it is there."""

LOSING_SECONDS = 7.0
"""A service that cannot write its beat for this time stops its jobs, by its own clock: before it counts as gone by the
database's, and others take them over."""

GONE_SECONDS = 10.0
"""A service that has not said for this time that it is there counts as gone."""

CHANNEL = "placerec"
RECONNECT_SECONDS = 1.0

log = logging.getLogger("placerec.shared")

# One row for each data directory that ever served.
_METADATA = MetaData()
REPLICAS = Table(
    "replicas",
    _METADATA,
    Column("id", text(), primary_key=True),  # of the data directory
    Column("process", text(), nullable=False),  # made anew at each start
    Column("seen", real(), nullable=False),  # when it last said that it is there, in seconds since 1970; 0: it left
    Column("settings", text()),  # what all should have in common, as JSON
)
TABLES = Tables("replicas", 1, _METADATA)

IS_LIVING = REPLICAS.c.seen > seconds_now() - bindparam("gone")
"""Whether the service of a row is there; ``gone`` is ``GONE_SECONDS``."""

_THIS = (REPLICAS.c.id == bindparam("service")) & (REPLICAS.c.process == bindparam("of_process"))
_ENTER = Statement(
    lambda insert: (
        insert(REPLICAS)
        .values(id=bindparam("service"), process=bindparam("of_process"), seen=seconds_now())
        .on_conflict_do_update(index_elements=["id"], set_={"process": bindparam("of_process"), "seen": seconds_now()})
    )
)
_BEAT = Statement(update(REPLICAS).where(_THIS).values(seen=seconds_now()))
_LEAVE = Statement(update(REPLICAS).where(_THIS).values(seen=0.0))
_LIVING = Statement(select(REPLICAS.c.id).where(IS_LIVING).order_by(REPLICAS.c.id))


class ServiceReplica:
    """This service among those that share state in PostgreSQL (:class:`service.peers.peers.Peers`).

    id: of the data directory, the same after a restart.
    alone: whether nobody else writes to the database.

    Args:
        database: shared by the services; it is closed by its owner.
        directory: the data directory.

    Raises:
        StorageFull, StorageFailure: the directory cannot be written to.
    """

    alone = False

    def __init__(self, database: PostgresLedger, directory: Path) -> None:
        self.database = database
        self.id, self.process = _id_of(directory), secrets.token_hex(8)
        self._this = {"service": self.id, "of_process": self.process}
        self.displaced = False
        """Whether another service runs under this id, because its data directory is a copy."""
        self._entered, self._beaten = False, -math.inf
        self._trouble: dict[str, str] = {}  # what was logged last of each thing that does not work
        self._tasks: list[Callable[[], None]] = []
        self._heard: dict[str, Heard] = {}
        self._stopping = threading.Event()
        self._threads: list[threading.Thread] = []

    def every(self, task: Callable[[], None]) -> None:
        """Do something at every beat, in a thread; call it before :meth:`start`."""
        self._tasks.append(task)

    def hear(self, topic: str, heard: Heard) -> None:
        """Call a function, in a thread, with the messages of services on a topic; before :meth:`start`."""
        self._heard[topic] = heard

    def start(self) -> None:
        """Enter, and begin to beat and to listen; the process must hold its data directory.

        If PostgreSQL cannot be reached, this service enters as soon as it can.
        """
        try:
            self.beat()
        except StorageFailure as error:
            self._note("the service does not take part yet", error)
        for name, work in (("replica-beat", self._beat_on), ("replica-listen", self._listen_on)):
            thread = threading.Thread(target=work, name=name, daemon=True)
            thread.start()
            self._threads.append(thread)

    def close(self) -> None:
        """Leave; the leases of this service can be taken over at once."""
        self._stopping.set()
        for thread in self._threads:
            thread.join(5)
        try:
            self.database.execute("leave", _LEAVE, **self._this)
        except Exception as error:
            log.warning("the service cannot take its leave: %s", error)

    @property
    def living(self) -> bool:
        """Whether the others still count this service as there."""
        return not self.displaced and time.monotonic() - self._beaten < LOSING_SECONDS

    @property
    def state(self) -> str:
        """Why this service is not one of those that share state, in a sentence; "ok" if it is."""
        if self.displaced:
            return "Another service runs under the same id: one data directory is a copy of the other."
        return "ok" if self.living else next(iter(self._trouble.values()), "PostgreSQL cannot be reached.")

    def say(self, topic: str, text: str = "") -> None:
        """Send a message to all services, this one included; it is not stored for those that are not connected."""
        self.database.notify("notify other services", CHANNEL, f"{topic} {text}")

    def living_ids(self, connection: LedgerConnection) -> list[str]:
        """The ids of the services that are there, within a transaction of the database."""
        return [name for (name,) in connection.execute(_LIVING, gone=GONE_SECONDS)]

    # The threads

    def _note(self, what: str, error: Exception | None) -> None:
        """Log that something does not work, once for each reason, or that it works again."""
        before = self._trouble.pop(what, None)
        if error is not None:
            self._trouble[what] = str(error)
            if before != str(error):
                log.warning("%s: %s", what, error)
        elif before is not None:
            log.info("no more: %s", what)

    def _beat_on(self) -> None:
        while not self._stopping.wait(BEAT_SECONDS):
            failed: Exception | None = None
            for work in (self.beat, *self._tasks):
                try:
                    work()
                except Exception as error:
                    failed = error
                    break  # the others would wait as long for the same server
            self._note("the service is not up to date with the others", failed)

    def beat(self) -> None:
        """Say that this service is there.

        Raises:
            StorageFailure: PostgreSQL cannot be reached, or refuses.
        """
        began = time.monotonic()
        if not self._entered:
            self.database.execute("enter", _ENTER, **self._this)
            self._entered, self._beaten = True, began
            return
        if self.displaced:
            return
        if self.database.change("say that it is there", _BEAT, **self._this):
            self._beaten = began
        else:
            self.displaced = True
            log.error("another service runs under the id %s of this one: one data directory is a copy", self.id)

    def _listen_on(self) -> None:
        while not self._stopping.is_set():
            try:
                self._listen()
            except Exception as error:
                self._note("the service does not hear the others", error)
                self._stopping.wait(RECONNECT_SECONDS)

    def _listen(self) -> None:
        with self.database.listening(CHANNEL) as messages:
            for heard in self._heard.values():
                heard(None)
            self._note("the service does not hear the others", None)
            while not self._stopping.is_set():
                for message in messages(0.5):
                    topic, _, text = message.partition(" ")
                    if topic in self._heard:
                        self._heard[topic](text)


def _id_of(directory: Path) -> str:
    """The id of a data directory, which it gets if it has none."""
    path = directory / FILE
    with disk_errors(f"read {path}"):
        if path.exists() and (found := path.read_text().strip()):
            return found
        made = f"r-{secrets.token_hex(8)}"
        make_folder(directory)
        write_file(path, f"{made}\n".encode())
        return made

"""The audit trail of all services, in one table."""

from __future__ import annotations

import json
import logging
import threading
from collections import deque
from collections.abc import Iterator

from core.errors import StorageFailure, StorageFull
from service.access.audit import LOGGER
from service.administration.audit_lines import AuditLine, Position
from service.shared.database import SharedDatabase
from service.telemetry.requests import JsonLines

MOST_WAITING = 10_000
"""Lines that wait for PostgreSQL; while it is away, the oldest ones beyond that are in the log alone."""

RETRY_SECONDS = 1.0
LINES_AT_ONCE = 500

log = logging.getLogger("placerec.shared")


class AuditTable(logging.Handler):
    """Adds the lines of this service to the trail of all; a thread writes them, so that no request waits.

    Args:
        replica: the id of this service, which its lines carry.
    """

    def __init__(self, database: SharedDatabase, replica: str) -> None:
        super().__init__()
        self.setFormatter(JsonLines())
        self._database, self._replica = database, replica
        self._waiting: deque[str] = deque()
        self._new, self._stopping = threading.Event(), False
        self.lost = 0
        self._thread = threading.Thread(target=self._write_on, name="audit", daemon=True)

    def start(self) -> None:
        """Begin to take lines."""
        self._thread.start()
        audit = logging.getLogger(LOGGER)
        audit.addHandler(self)
        audit.setLevel(logging.INFO)

    def close(self) -> None:
        """Write the lines that wait, if PostgreSQL takes them."""
        logging.getLogger(LOGGER).removeHandler(self)
        self._stopping = True
        self._new.set()
        if self._thread.is_alive():
            self._thread.join(10)
        super().close()

    def emit(self, record: logging.LogRecord) -> None:
        self._waiting.append(self.format(record))
        while len(self._waiting) > MOST_WAITING:
            self._waiting.popleft()
            self.lost += 1
        self._new.set()

    def _write_on(self) -> None:
        while not self._stopping:
            self._new.wait()
            self._new.clear()
            while self._waiting:
                try:
                    self._write()
                except (StorageFull, StorageFailure) as error:
                    log.warning("the audit trail cannot be written: %s", error, extra={"lost": self.lost})
                    if self._stopping:
                        return
                    threading.Event().wait(RETRY_SECONDS)

    def _write(self) -> None:
        taken = [self._waiting.popleft() for _ in range(min(len(self._waiting), LINES_AT_ONCE))]
        query = "INSERT INTO service.audit (replica, line) SELECT %s, unnest(%s::text[])"
        try:
            self._database.query("write the audit trail", query, (self._replica, taken))
        except BaseException:
            self._waiting.extendleft(reversed(taken))
            raise

    def lines(self, before: Position | None) -> Iterator[AuditLine]:
        """The lines of all services from the latest to the oldest.

        Args:
            before: only lines before this one; None: all.

        Raises:
            StorageFailure: PostgreSQL cannot be reached, or refuses.
        """
        query = "SELECT number, replica, line FROM service.audit WHERE number < %s ORDER BY number DESC LIMIT %s"
        reached = (1 << 63) - 1 if before is None else before.offset
        while found := self._database.query("read the audit trail", query, (reached, LINES_AT_ONCE)):
            for number, replica, line in found:
                yield AuditLine(Position(0, number), len(line), {**json.loads(line), "replica": replica})
            reached = found[-1][0]

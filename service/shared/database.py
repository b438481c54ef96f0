"""The PostgreSQL that has what services share."""

from __future__ import annotations

from core.ledger.postgres import PostgresLedger
from service.access import key_table, rates
from service.administration import audit_trail
from service.events import relay
from service.jobs import rows
from service.peers import replica
from service.queries import count_tables, recent_answers
from service.queries.histories import lost_robots
from service.sessions import table as sessions
from service.telemetry import history

TABLES = (
    replica.TABLES, rows.TABLES, sessions.TABLES, key_table.TABLES, rates.TABLES, audit_trail.TABLES,
    count_tables.TABLES, recent_answers.TABLES, lost_robots.TABLES, relay.TABLES, history.TABLES,
)  # fmt: skip
"""The tables of all parts that services share."""


class SharedDatabase(PostgresLedger):
    """The PostgreSQL that has what services share; its tables are made if they are missing."""

    def __init__(self, address: str) -> None:
        super().__init__(address, TABLES)

    def __enter__(self) -> SharedDatabase:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

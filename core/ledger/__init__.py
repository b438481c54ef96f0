"""The ledger: tables and statements, written once for SQLite and for PostgreSQL.

Tables and statements are SQLAlchemy's; each statement is compiled once for each dialect, and its text is then executed
by the driver alone, so that a hot statement costs what it cost when it was text (:mod:`core.ledger.statements`).
Transactions are explicit: ``BEGIN IMMEDIATE`` and ``synchronous=FULL`` in SQLite (:mod:`core.ledger.sqlite`),
``synchronous_commit`` in PostgreSQL (:mod:`core.ledger.postgres`).
"""

from core.ledger.database import Connection, Ledger, Lock
from core.ledger.statements import Statement
from core.ledger.tables import Tables

__all__ = ["Connection", "Ledger", "Lock", "Statement", "Tables"]

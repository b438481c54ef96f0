"""The ledger: tables and statements, written once for SQLite and for PostgreSQL.

Tables and statements are SQLAlchemy's; each statement is compiled once for each dialect, and its text is then executed
by the driver alone, so that a hot statement costs what it cost when it was text (:mod:`core.ledger.statements`).
Transactions are explicit: ``BEGIN IMMEDIATE`` and ``synchronous=FULL`` in SQLite (:mod:`core.ledger.sqlite`),
``synchronous_commit`` in PostgreSQL (:mod:`core.ledger.postgres`).  Many rows are put by one statement
(:mod:`core.ledger.rows`); a file that may be lost is made anew when it is damaged (:mod:`core.ledger.disposable`).
"""

from core.ledger.database import Ledger, LedgerConnection, Lock
from core.ledger.statements import Statement
from core.ledger.tables import Tables

__all__ = ["Ledger", "LedgerConnection", "Lock", "Statement", "Tables"]

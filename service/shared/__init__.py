"""State that any number of services share in PostgreSQL.

Each part is one class for both databases, in its own room; this puts those together that share their state.  Nothing
here is imported unless a PostgreSQL is set.  docs/explanation/replicas.md says what holds over all services, and at
what cost.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from core.errors import MissingExtra
from service.settings import Settings

if TYPE_CHECKING:
    from service.shared.database import SharedDatabase

__all__ = ["open_database"]


def open_database(settings: Settings) -> SharedDatabase | None:
    """The PostgreSQL that has what services share; None if this service keeps its state in its data directory.

    Raises:
        MissingExtra: the client of PostgreSQL is not installed.
    """
    if settings.database is None:
        return None
    try:
        from service.shared.database import SharedDatabase
    except ModuleNotFoundError as error:
        if error.name not in ("psycopg", "psycopg_pool"):
            raise
        raise MissingExtra(
            f"State in PostgreSQL needs {error.name}, which others do not: pip install 'placerec[cluster]', or in a"
            " checkout .venv/bin/pip install --editable '.[cluster]'."
        ) from error
    return SharedDatabase(settings.database.get_secret_value())

"""State that any number of services share in PostgreSQL: sessions, keys, jobs and rates.

Each part has its embedded twin, which keeps the same in the data directory and is the default; nothing here is imported
unless PLACEREC_POSTGRES is set.  docs/explanation/replicas.md says what holds over all services, and at what cost.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from core.errors import MissingExtra
from service.access.gate import Rates
from service.access.keys import KeyRecords, KeyStore
from service.settings import Settings

if TYPE_CHECKING:
    from service.shared.database import SharedDatabase

__all__ = ["keys_of", "open_database", "rates_of"]


def open_database(settings: Settings) -> SharedDatabase | None:
    """The PostgreSQL that has what services share; None if this service keeps its state in its data directory.

    Raises:
        MissingExtra: the client of PostgreSQL is not installed.
    """
    if settings.postgres is None:
        return None
    try:
        from service.shared.database import SharedDatabase
    except ModuleNotFoundError as error:
        if error.name not in ("psycopg", "psycopg_pool"):
            raise
        raise MissingExtra(
            f"State in PostgreSQL needs {error.name}, which others do not: pip install 'placerec[milvus]', or in a"
            " checkout .venv/bin/pip install --editable '.[milvus]'."
        ) from error
    return SharedDatabase(settings.postgres.get_secret_value())


def keys_of(settings: Settings, database: SharedDatabase | None) -> KeyRecords:
    """The keys of all services, or of a data directory."""
    if database is None:
        return KeyStore(settings.data_dir)
    from service.shared.keys import SharedKeys  # with it comes what speaks to PostgreSQL

    return SharedKeys(database)


def rates_of(settings: Settings, database: SharedDatabase | None) -> Rates:
    """The limits of all services together, or of this one; a context in which they hold."""
    if database is None:
        return Rates(settings.rate_per_key, settings.rate_burst)
    from service.shared.rates import SharedRates  # with it comes what speaks to PostgreSQL

    return SharedRates(database, settings.rate_per_key, settings.rate_burst)

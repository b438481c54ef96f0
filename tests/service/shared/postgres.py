"""A real PostgreSQL of its own for the tests of what services share."""

from __future__ import annotations

import shutil
import signal
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import psycopg

from service.shared.database import SharedDatabase
from tests.core.postgres.servers import fixed_ports, postgres_server


class Postgres:
    """PostgreSQL in a folder of its own."""

    def __init__(self, folder: Path) -> None:
        (port,) = fixed_ports(1)
        self.address = f"postgresql://placerec@127.0.0.1:{port}/postgres"
        folder.chmod(0o755)
        self.server = postgres_server(folder, port, self._ask)

    def _ask(self) -> None:
        psycopg.connect(self.address, connect_timeout=5).close()

    def empty(self) -> None:
        """Forget everything."""
        with psycopg.connect(self.address) as connection:
            connection.execute("DROP SCHEMA public CASCADE")
            connection.execute("CREATE SCHEMA public")
        database = SharedDatabase(self.address)
        with database.connection("make its tables"):
            pass
        database.close()


@contextmanager
def running_postgres() -> Iterator[Postgres]:
    """PostgreSQL, as long as the block runs."""
    folder = Path(tempfile.mkdtemp(prefix="placerec-postgres-"))
    postgres = None
    try:
        postgres = Postgres(folder)
        postgres.server.start()
        yield postgres
    finally:
        if postgres is not None:
            postgres.server.end(signal.SIGINT)
        shutil.rmtree(folder, ignore_errors=True)

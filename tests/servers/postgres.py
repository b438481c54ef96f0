"""A real PostgreSQL on this machine: that of the system (Debian: ``apt-get install postgresql``)."""

from __future__ import annotations

import os
import shutil
import signal
import subprocess
import tempfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import psycopg

from tests.servers.process import Missing, Server, fixed_ports


def postgres_programs() -> Path:
    """The folder of PostgreSQL's programs.

    Raises:
        Missing: there is none.
    """
    found = shutil.which("initdb")
    folders = [Path(found).parent] if found else sorted(Path("/usr/lib/postgresql").glob("*/bin"))
    if not folders:
        raise Missing("PostgreSQL is not installed (Debian: apt-get install postgresql).")
    return folders[-1]


def postgres_server(folder: Path, port: int, answers: Callable[[], None]) -> Server:
    """A PostgreSQL with the superuser ``placerec``, who needs no password, and its data in a folder.

    Raises:
        Missing: it is not installed.
    """
    programs, files = postgres_programs(), folder / "data"
    user = "nobody" if os.getuid() == 0 else None  # PostgreSQL refuses to run as root
    if user is not None:
        shutil.chown(folder, user)
    make = [programs / "initdb", "-D", files, "-U", "placerec", "-E", "UTF8", "--locale=C", "--auth=trust", "-N"]
    subprocess.run([str(word) for word in make], cwd=folder, user=user, check=True, stdout=subprocess.DEVNULL)
    serve: list[str | Path] = [programs / "postgres", "-D", files, "-p", str(port), "-k", folder]
    return Server(serve, folder, answers, user)


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
        """Forget everything, tables included."""
        with psycopg.connect(self.address) as connection:
            connection.execute("DROP SCHEMA public CASCADE")
            connection.execute("CREATE SCHEMA public")


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

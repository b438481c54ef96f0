"""A PostgreSQL that asks for passwords and speaks TLS alone."""

from __future__ import annotations

import shutil
import signal
import tempfile
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

import psycopg

from tests.certificates import certify
from tests.servers.postgres import Postgres


class Guarded(Postgres):
    """It has a certificate of an authority of its own; its superuser comes in by another way.

    authority, stranger: files of the authority, and of one that it knows nothing of.
    """

    def __init__(self, folder: Path) -> None:
        certificates = folder / "certificates"
        for name in ("own", "other"):
            (certificates / name).mkdir(parents=True)
            certify(certificates / name)
        self.authority = certificates / "own/authority.pem"
        self.stranger = certificates / "other/authority.pem"
        pair = [certificates / "own" / f"server.{kind}" for kind in ("pem", "key")]
        super().__init__(folder)
        port = self.address.rpartition(":")[2].partition("/")[0]
        home = folder
        self.postgres_server = f"localhost:{port}/postgres"
        self._superuser = f"postgresql://placerec@/postgres?host={home}&port={port}"
        (home / "data/pg_hba.conf").write_text("local all all trust\nhostssl all all all scram-sha-256\n")
        settings = ["ssl = on\n"]
        for name, path in zip(("ssl_cert_file", "ssl_key_file"), pair, strict=True):
            copy = Path(shutil.copy(path, home))
            shutil.chown(copy, home.owner())
            copy.chmod(0o600)
            settings.append(f"{name} = '{copy}'\n")
        with (home / "data/postgresql.conf").open("a") as file:
            file.writelines(settings)

    def execute(self, *statements: str) -> Sequence[tuple[object, ...]]:
        """Execute statements as the superuser of PostgreSQL; the rows of the last one."""
        with psycopg.connect(self._superuser, autocommit=True) as connection:
            for statement in statements:
                cursor = connection.execute(statement.encode())
            return [] if cursor.description is None else cursor.fetchall()

    def _ask(self) -> None:
        self.execute("SELECT 1")


@contextmanager
def guarded_postgres() -> Iterator[Guarded]:
    """One, as long as the block runs."""
    folder = Path(tempfile.mkdtemp(prefix="placerec-guarded-"))
    postgres = None
    try:
        postgres = Guarded(folder)
        postgres.server.start()
        yield postgres
    finally:
        if postgres is not None:
            postgres.server.end(signal.SIGINT)
        shutil.rmtree(folder, ignore_errors=True)

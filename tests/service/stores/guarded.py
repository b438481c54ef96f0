"""A PostgreSQL and a Milvus that ask for passwords and speak TLS alone."""

from __future__ import annotations

import shutil
import signal
import tempfile
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

import psycopg
from pymilvus import MilvusClient

from core.milvus.collection import milvus_errors
from tests.certificates import certify
from tests.servers.milvus import MILVUS_SETTINGS, Servers

ROOT_TOKEN = "root:Milvus"  # Milvus's own at its first start


class Guarded(Servers):
    """Both servers with certificates of an authority of their own; their superusers come in by other ways.

    authority, stranger: files of the authority, and of one that they know nothing of.
    """

    def __init__(self, folder: Path) -> None:
        certificates = folder / "certificates"
        for name in ("own", "other"):
            (certificates / name).mkdir(parents=True)
            certify(certificates / name)
        self.authority = certificates / "own/authority.pem"
        self.stranger = certificates / "other/authority.pem"
        pair = [certificates / "own" / f"server.{kind}" for kind in ("pem", "key")]
        security = {
            "common.security.authorizationEnabled": "true",
            "common.security.tlsMode": "1",
            "tls.serverPemPath": str(pair[0]),
            "tls.serverKeyPath": str(pair[1]),
        }
        super().__init__(folder, {**MILVUS_SETTINGS, **security})
        port = self.postgres_address.rpartition(":")[2].partition("/")[0]
        home = folder / "postgres"
        self.postgres_server = f"localhost:{port}/postgres"
        self._superuser = f"postgresql://placerec@/postgres?host={home}&port={port}"
        self.milvus_address = self.milvus_address.replace("http://127.0.0.1", "https://localhost")
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

    def administrator(self) -> MilvusClient:
        """A client with all rights in Milvus."""
        given = {"token": ROOT_TOKEN, "server_pem_path": str(self.authority), "dedicated": True}
        return MilvusClient(self.milvus_address, timeout=2, **given)

    def _ask_postgres(self) -> None:
        self.execute("SELECT 1")

    def _ask_milvus(self) -> None:
        with milvus_errors("answer"):
            self.administrator().close()


@contextmanager
def guarded_servers() -> Iterator[Guarded]:
    """Both, as long as the block runs."""
    folder = Path(tempfile.mkdtemp(prefix="placerec-guarded-"))
    servers = None
    try:
        servers = Guarded(folder)
        servers.postgres.start()
        servers.milvus.start()
        yield servers
    finally:
        if servers is not None:
            servers.milvus.end()
            servers.postgres.end(signal.SIGINT)
        shutil.rmtree(folder, ignore_errors=True)

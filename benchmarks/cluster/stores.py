"""The stores that benchmarks compare: one in a data directory, one in PostgreSQL and Milvus."""

from __future__ import annotations

import tempfile
from collections.abc import Iterator
from contextlib import contextmanager, nullcontext
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import typer

from core.milvus import open_store
from core.milvus.store import MilvusStore
from core.storage import Atlas
from tests.core.milvus.servers import running_servers

MilvusAddress = Annotated[str, typer.Option("--milvus", help="Of a Milvus; empty: one of this machine's own.")]
PostgresAddress = Annotated[str, typer.Option("--postgres", help="Of its PostgreSQL.")]


@dataclass(frozen=True)
class Addresses:
    """Of a Milvus and a PostgreSQL."""

    milvus_address: str
    postgres_address: str


@dataclass(frozen=True)
class Stores:
    """Both, and the folder of the first."""

    embedded: Atlas
    milvus: MilvusStore
    folder: Path


@contextmanager
def both_stores(milvus: str, postgres: str) -> Iterator[Stores]:
    """An empty data directory and the store of two servers, which are started here if no addresses are given."""
    servers = nullcontext(Addresses(milvus, postgres)) if milvus else running_servers()
    with tempfile.TemporaryDirectory() as folder, servers as at:
        embedded, there = Atlas(Path(folder)), open_store(at.milvus_address, at.postgres_address)
        try:
            yield Stores(embedded, there, Path(folder))
        finally:
            there.close()
            embedded.close()

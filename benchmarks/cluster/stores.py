"""The stores that benchmarks compare: one in a data directory, one in PostgreSQL and Milvus."""

from __future__ import annotations

import os
import tempfile
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import typer

from core.milvus import open_store
from core.milvus.store import MilvusStore
from core.store import Directory
from tests.servers.milvus import running_servers

MilvusAddress = Annotated[str, typer.Option("--milvus", help="Of a Milvus; empty: one of this machine's own.")]
PostgresAddress = Annotated[str, typer.Option("--postgres", help="Of its PostgreSQL.")]


@dataclass(frozen=True)
class Stores:
    """Both.  processes: the numbers of Milvus's and PostgreSQL's first processes, if they were started here."""

    embedded: Directory
    milvus: MilvusStore
    processes: dict[str, int]


def processor_seconds(process: int) -> float:
    """That a process and its children have taken since they were started; Linux."""
    found = 0
    for folder in Path("/proc").glob("[0-9]*"):
        with suppress(OSError):
            words = (folder / "stat").read_text().rpartition(")")[2].split()
            if process in (int(folder.name), int(words[1])):
                found += int(words[11]) + int(words[12])
    return found / os.sysconf("SC_CLK_TCK")


@contextmanager
def both_stores(milvus: str, postgres: str) -> Iterator[Stores]:
    """An empty data directory and the store of two servers, which are started here if no addresses are given."""
    with ExitStack() as stack:
        processes: dict[str, int] = {}
        if not milvus:
            servers = stack.enter_context(running_servers())
            milvus, postgres = servers.milvus_address, servers.postgres_address
            processes = {"milvus": servers.milvus.process_id, "postgres": servers.postgres.process_id}
        embedded = Directory(Path(stack.enter_context(tempfile.TemporaryDirectory())))
        stack.callback(embedded.close)
        there = open_store(milvus, postgres)
        stack.callback(there.close)
        yield Stores(embedded, there, processes)

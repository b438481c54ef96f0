"""Maps: each one SQLite file of a data directory, or rows of a PostgreSQL; what is searched follows it, in memory.

store, directory, cluster   all maps, of a data directory or of a PostgreSQL
map                         one map
database, file              what keeps one map; an SQLite file
following, snapshot, segment, rows, tiers, scopes, recall
                            what is searched, brought up to date with each revision
importing, verification     parts of them
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from core.errors import MissingExtra
from core.store.directory import Directory
from core.store.map import Map
from core.store.snapshot import Ranking, Scope, Snapshot
from core.store.store import Store

if TYPE_CHECKING:
    from core.index.milvus import Milvus
    from core.store.cluster import Cluster

__all__ = ["Directory", "Map", "Ranking", "Scope", "Snapshot", "Store", "open_cluster"]


def open_cluster(address: str, cache_bytes: int = 256 << 20, milvus: Milvus | None = None) -> Cluster:
    """All maps of a PostgreSQL database, which is connected to when it is first used, and again after an outage.

    Args:
        address: such as ``postgresql://placerec@localhost/placerec``.
        cache_bytes: most bytes of rows that are kept in memory.
        milvus: has the codes of large maps; None: memory has those of all.

    Raises:
        MissingExtra: its client is not installed.
    """
    try:
        from core.store.cluster import Cluster

        return Cluster(address, cache_bytes, milvus=milvus)
    except ModuleNotFoundError as error:
        if error.name not in ("psycopg", "psycopg_pool"):
            raise
        raise MissingExtra(
            f"Maps in PostgreSQL need {error.name}, which others do not: pip install 'placerec[cluster]', or in a"
            " checkout .venv/bin/pip install --editable '.[cluster]'."
        ) from error

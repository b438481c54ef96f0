"""Maps in PostgreSQL, which any number of processes may use at the same time.

PostgreSQL has all that a map is: its record, its places, their descriptors, local descriptors, keypoints and pictures.
Each write is one of its transactions, so that it happens whole or not at all, and two processes cannot overwrite each
other.  What searches the descriptors is an engine beside it (:mod:`core.milvus`).

tables          the tables beside those of any map
rows            descriptors by row, and rows that no place has any more
writing, map, store
                a write, a map and all maps, less what an engine adds
review, exporter, verification
                parts of them
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from core.errors import MissingExtra

if TYPE_CHECKING:
    from core.postgres.search.store import CodedStore

__all__ = ["open_database"]


def open_database(address: str, cache_bytes: int = 256 << 20) -> CodedStore:
    """All maps of a PostgreSQL database, searched in the memory of each service.

    It is connected to when it is first used, and again after an outage.

    Args:
        address: such as ``postgresql://placerec@localhost/placerec``.
        cache_bytes: most bytes of rows that are kept in memory.

    Raises:
        MissingExtra: its clients are not installed.
    """
    try:
        from core.postgres.search.store import CodedStore

        return CodedStore(address, cache_bytes)
    except ModuleNotFoundError as error:
        if error.name not in ("psycopg", "psycopg_pool"):
            raise
        raise MissingExtra(
            f"Maps in PostgreSQL need {error.name}, which others do not: pip install 'placerec[cluster]', or in a"
            " checkout .venv/bin/pip install --editable '.[cluster]'."
        ) from error

"""Maps in PostgreSQL, searched by Milvus: a store that any number of processes may use at the same time.

PostgreSQL has all that a map is: its record, its places, their descriptors, local descriptors, keypoints and pictures.
Each write is one of its transactions, so that it happens whole or not at all, and two processes cannot overwrite each
other.  Milvus has a copy of what a search needs: descriptors beside the fields by which places are filtered.  An entity
of Milvus is never changed; it counts as long as PostgreSQL names its key.  docs/explanation/stores.md says why.
"""

from __future__ import annotations

import os
from typing import TYPE_CHECKING

from core.errors import MissingExtra

if TYPE_CHECKING:
    from core.milvus.store import MilvusStore

__all__ = ["open_store"]


def open_store(
    milvus: str, postgres: str, token: str = "", database: str = "", certificate: str | None = None
) -> MilvusStore:
    """All maps of a PostgreSQL database and a Milvus (:class:`core.milvus.store.MilvusStore`).

    They are connected to when they are first used, and again after an outage.

    Raises:
        MissingExtra: their clients are not installed.
    """
    os.environ.setdefault("GRPC_VERBOSITY", "NONE")  # what it would write beside the log is in the errors
    try:
        from core.milvus.store import MilvusStore

        return MilvusStore(milvus, postgres, token, database, certificate)
    except ModuleNotFoundError as error:
        if error.name not in ("psycopg", "psycopg_pool", "pymilvus"):
            raise
        raise MissingExtra(
            f"Maps in PostgreSQL and Milvus need {error.name}, which others do not: pip install"
            " 'placerec[cluster,milvus]', or in a checkout .venv/bin/pip install --editable '.[cluster,milvus]'."
        ) from error

"""The collection of Milvus that has the descriptors of one encoder, those of all its maps.

This uses pymilvus's older interface, because the newer one does not say from when on an insertion is seen.
"""

from __future__ import annotations

import hashlib
import logging
import re
import uuid
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from math import isnan

import grpc
import numpy as np
from numpy.typing import NDArray
from pymilvus import Collection as Connected
from pymilvus import CollectionSchema, DataType, FieldSchema, connections, utility
from pymilvus.exceptions import MilvusException

from core.errors import StorageFailure
from core.milvus.expressions import NO_HEADING
from core.milvus.indexes import indexing_for, search_settings
from core.places import Whereabouts

logging.getLogger("pymilvus").setLevel(logging.CRITICAL)  # what it refuses is raised; it would log it as well

MOST_FOUND = 16_384
"""The most places of one search: Milvus's limit."""

PARTITIONS = 64
"""Partitions of a collection, over which its maps are spread."""

_AT_ONCE = 256  # entities of one insertion: 16 MB with the default encoder; Milvus takes 64
_PATIENCE_SECONDS = 10.0
# A Milvus that was gone is asked again within two seconds; by default gRPC would wait for up to two minutes.
_AGAIN_SOON = {"grpc.initial_reconnect_backoff_ms": 200, "grpc.max_reconnect_backoff_ms": 2000}


@dataclass(frozen=True)
class Entity:
    """What Milvus has of a place.

    descriptor: float32 [D].
    where: of this place alone.
    """

    key: int
    row: int
    descriptor: NDArray[np.float32]
    where: Whereabouts
    camera: str | None
    tokens: Sequence[str]


def collection_name(encoder: str, dimension: int) -> str:
    """The name of the collection of an encoder: Milvus takes letters, digits and underscores."""
    name = re.sub(r"[^A-Za-z0-9]", "_", encoder.split("@")[0])[:80]
    return f"placerec_{name}_{dimension}_{hashlib.sha256(encoder.encode()).hexdigest()[:16]}"


@contextmanager
def milvus_errors(action: str) -> Iterator[None]:
    """Turn what Milvus refuses into a StorageFailure."""
    try:
        yield
    except (MilvusException, grpc.RpcError) as error:  # pymilvus lets some of gRPC's errors through
        raise StorageFailure(f"Milvus refuses to {action}: {str(error)[:300]}") from error


class Connection:
    """A connection to Milvus.  Any thread may use it.

    Raises:
        StorageFailure: Milvus cannot be reached, or refuses.
    """

    def __init__(self, address: str, token: str, database: str, certificate: str | None) -> None:
        self.name = f"placerec-{uuid.uuid4().hex}"
        tls = {} if certificate is None else {"server_pem_path": certificate, "secure": True}
        with milvus_errors("connect"):
            connections.connect(
                self.name, uri=address, token=token, db_name=database, timeout=_PATIENCE_SECONDS,
                grpc_options=_AGAIN_SOON, **tls,
            )  # fmt: skip

    def close(self) -> None:
        """Close it."""
        connections.disconnect(self.name)


class Collection:
    """The descriptors of one encoder.  Any thread may use it.

    Args:
        encoder, dimension: its identity, and the values of a descriptor.

    Raises:
        StorageFailure: Milvus refuses, or its collection of this name was made otherwise.
    """

    def __init__(self, connection: Connection, encoder: str, dimension: int) -> None:
        name = collection_name(encoder, dimension)
        with milvus_errors("make a collection"):
            chosen = indexing_for(utility.get_server_version(using=connection.name, timeout=_PATIENCE_SECONDS))
            schema = _schema(encoder, dimension, chosen.half)
            if utility.has_collection(name, using=connection.name, timeout=_PATIENCE_SECONDS):
                self._collection = Connected(name, using=connection.name)
                found = self._collection.schema.description
                if found != schema.description:
                    raise StorageFailure(f"Milvus's collection {name} is of another version: {found[:200]!r}.")
            else:
                self._collection = Connected(
                    name, schema, connection.name, num_partitions=PARTITIONS, shards_num=1, consistency_level="Bounded"
                )
            if not self._collection.has_index():
                self._collection.create_index("descriptor", dict(chosen.index))
            # A collection stays as it was made when its server becomes a newer one.
            types = {field.name: field.dtype for field in self._collection.schema.fields}
            self._value = np.float16 if types["descriptor"] == DataType.FLOAT16_VECTOR else np.float32
            self.index_type = str(self._collection.index().params["index_type"])
            self._collection.load()

    def insert(self, map_number: int, entities: Sequence[Entity]) -> int:
        """Insert entities of a map; they are durable when this returns.

        Returns:
            From which timestamp on a search sees them.
        """
        seen_from = 0
        with milvus_errors("store descriptors"):
            for start in range(0, len(entities), _AT_ONCE):
                some = [self._record(map_number, one) for one in entities[start : start + _AT_ONCE]]
                seen_from = int(self._collection.insert(some, timeout=_PATIENCE_SECONDS).timestamp)
        return seen_from

    def delete(self, keys: Sequence[int]) -> None:
        """Delete entities."""
        with milvus_errors("delete descriptors"):
            self._collection.delete(f"key in {list(keys)}", timeout=_PATIENCE_SECONDS)

    def search(
        self, descriptors: NDArray[np.float32], expression: str, limit: int, seen_from: int
    ) -> list[tuple[NDArray[np.int64], NDArray[np.float32]]]:
        """The keys with the largest inner products, int64 [n], and these, float32 [n], for each of the queries.

        Args:
            descriptors: float32 [B, D].
            limit: how many at most; at most ``MOST_FOUND``.
            seen_from: a timestamp of Milvus; what was inserted until then is searched.
        """
        queries, settings = list(descriptors.astype(self._value, copy=False)), search_settings(self.index_type, limit)
        with milvus_errors("search"):
            found = self._collection.search(
                queries, "descriptor", settings, limit, expression, timeout=_PATIENCE_SECONDS,
                consistency_level="Customized", guarantee_timestamp=max(1, seen_from),
            )  # fmt: skip
        return [
            (
                np.array(hits.ids, np.int64),
                np.array(hits.distances, np.float32),
            )
            for hits in found
        ]

    def _record(self, map_number: int, entity: Entity) -> dict[str, object]:
        where = entity.where
        heading = float(where.heading[0])
        return {
            "key": entity.key,
            "map": map_number,
            "row": entity.row,
            "kind": int(where.kind[0]),
            **dict(zip("xyz", where.position[0].tolist(), strict=True)),
            "heading": NO_HEADING if isnan(heading) else heading,
            "timestamp": int(where.timestamp[0]),
            "sequence": int(where.sequence[0]),
            "ordinal": int(where.ordinal[0]),
            "camera": entity.camera or "",
            "metadata": {"tokens": list(entity.tokens)},
            "descriptor": entity.descriptor.astype(self._value, copy=False),
        }


def _schema(encoder: str, dimension: int, half: bool) -> CollectionSchema:
    return CollectionSchema(
        [
            FieldSchema("key", DataType.INT64, is_primary=True),
            FieldSchema("map", DataType.INT64, is_partition_key=True),
            FieldSchema("row", DataType.INT64),
            FieldSchema("kind", DataType.INT8),
            *(FieldSchema(axis, DataType.DOUBLE) for axis in "xyz"),
            FieldSchema("heading", DataType.FLOAT),
            FieldSchema("timestamp", DataType.INT64),
            FieldSchema("sequence", DataType.INT64),
            FieldSchema("ordinal", DataType.INT64),
            FieldSchema("camera", DataType.VARCHAR, max_length=64),
            FieldSchema("metadata", DataType.JSON),
            FieldSchema("descriptor", DataType.FLOAT16_VECTOR if half else DataType.FLOAT_VECTOR, dim=dimension),
        ],
        description=f"placerec collection 1 of {encoder}",
    )

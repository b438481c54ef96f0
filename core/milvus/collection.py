"""The collection of Milvus that has the descriptors of one encoder, those of all its maps.

This uses pymilvus's older interface, because the newer one does not say from when on an insertion is seen.
"""

from __future__ import annotations

import hashlib
import logging
import re
import threading
import uuid
import warnings
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from math import isnan
from typing import Any

import grpc
import numpy as np
from numpy.typing import NDArray
from pymilvus import Collection as Connected
from pymilvus import CollectionSchema, DataType, FieldSchema, connections, utility
from pymilvus.exceptions import MilvusException

from core.errors import StoreOfAnotherVersion, StoreUnavailable
from core.ledger.outage import Outage, Unreachable
from core.milvus.expressions import NO_HEADING
from core.milvus.indexes import indexing_for, search_settings
from core.places import Whereabouts

warnings.filterwarnings("ignore", message=".*ORM-style PyMilvus API")
logging.getLogger("pymilvus").setLevel(logging.CRITICAL)  # what it refuses is raised; it would log it as well

MOST_FOUND = 16_384
"""The most places of one search: Milvus's limit."""

PARTITIONS = 64
"""Partitions of a collection, over which its maps are spread."""

_AT_ONCE = 256  # entities of one insertion: 16 MB with the default encoder; Milvus takes 64
_PATIENCE_SECONDS = 10.0
_CONNECTING_SECONDS = 3.0
_PROBING_SECONDS = 1.0
_SEARCH = "Milvus's search"
# A Milvus that was gone is called again within two seconds; by default gRPC would wait for up to two minutes.
_AGAIN_SOON = {"grpc.initial_reconnect_backoff_ms": 200, "grpc.max_reconnect_backoff_ms": 2000}


@dataclass(frozen=True)
class Entity:
    """The entity of a place in Milvus.

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
    """Turn an error of Milvus into an Unreachable that says why in plain words."""
    try:
        yield
    except (MilvusException, grpc.RpcError) as error:  # pymilvus lets some of gRPC's errors through
        raise Unreachable("Milvus", _reason(error, action)) from error
    except OSError as error:  # it reads the certificate's file at every connection
        raise Unreachable("Milvus", f"cannot be reached: {error}") from error


def _reason(error: MilvusException | grpc.RpcError, action: str) -> str:
    """The text that follows the name of Milvus in an error."""
    said = error if isinstance(error, grpc.RpcError) else error.__cause__
    if not isinstance(said, grpc.RpcError):
        return f"refuses to {action}: {_in_one_line(str(getattr(error, 'message', error)))}"
    code, details = said.code(), _in_one_line((said.details() or "").rpartition("last error: ")[2])
    if code == grpc.StatusCode.UNAUTHENTICATED:
        return f"refuses the token: {details}"
    if code == grpc.StatusCode.PERMISSION_DENIED:
        return f"refuses to {action}, for the token's user has no right to: {details}"
    if code == grpc.StatusCode.DEADLINE_EXCEEDED:
        return f"takes too long to {action}"
    if "CERTIFICATE_VERIFY_FAILED" in details or "Verification Check failed" in details:
        return f"has a certificate that cannot be trusted: {details}"
    if "handshake" in details:
        return f"cannot be spoken to by TLS: {details}"
    if "Socket closed" in details:
        return f"closes the connection, as one does that wants TLS (https) or is ending: {details}"
    verdict = "cannot be reached" if code == grpc.StatusCode.UNAVAILABLE else f"refuses to {action}"
    return f"{verdict}: {details or code}"


def _in_one_line(text: str) -> str:
    return " ".join(text.split())[:300]


class MilvusConnection:
    """A connection to Milvus, which is made when it is first used.  Any thread may use it."""

    def __init__(self, address: str, token: str, database: str, certificate: str | None) -> None:
        self._given: dict[str, Any] = {"uri": address, "token": token, "db_name": database}
        if certificate is not None:
            self._given |= {"server_pem_path": certificate, "secure": True}
        self._name = f"placerec-{uuid.uuid4().hex}"
        self._making = threading.Lock()
        self._made = False
        # After a kill it takes writes before it searches.
        self._outages = {False: Outage("Milvus", probe=self._probe), True: Outage("Milvus", _SEARCH, self._probe)}

    @contextmanager
    def using(self, action: str, searching: bool = False) -> Iterator[str]:
        """The name of the connection, by which pymilvus knows it.

        Args:
            searching: whether the call needs a loaded collection.

        Raises:
            StoreUnavailable: Milvus cannot be reached, or refuses.
        """
        with self._outages[searching].noticed(), milvus_errors(action):
            if not self._made:
                self._connect()
            yield self._name

    def _probe(self) -> None:
        """Raise Unreachable unless Milvus answers soon; pymilvus repeats every other call for long."""
        with milvus_errors("answer"):
            if self._made:
                utility.get_server_version(using=self._name, timeout=_PROBING_SECONDS)

    def _connect(self) -> None:
        with self._making:
            if not self._made:
                connections.connect(self._name, timeout=_CONNECTING_SECONDS, grpc_options=_AGAIN_SOON, **self._given)
                self._made = True

    def check(self) -> None:
        """Ask Milvus for its version.

        Raises:
            StoreUnavailable: it does not answer, or refuses.
        """
        with self.using("answer") as name:
            utility.get_server_version(using=name, timeout=_CONNECTING_SECONDS)

    def close(self) -> None:
        """Close it."""
        if self._made:
            connections.disconnect(self._name)


class Collection:
    """The descriptors of one encoder; it is made when it is first used.  Any thread may use it.

    Every method may raise StoreUnavailable (Milvus cannot be reached, or refuses) and StoreOfAnotherVersion (its
    collection of this name was made otherwise).

    Args:
        encoder, dimension: its identity, and the values of a descriptor.
    """

    def __init__(self, connection: MilvusConnection, encoder: str, dimension: int) -> None:
        self._connection = connection
        self._encoder, self._dimension = encoder, dimension
        self.name = collection_name(encoder, dimension)
        self._value: type[np.float16 | np.float32] = np.float32
        self.index_type = "FLAT"
        """How Milvus searches it, as far as it was used."""
        self._making = threading.Lock()
        self._collection: Connected | None = None
        self._id = 0

    @contextmanager
    def _using(self, action: str, searching: bool = True) -> Iterator[Connected]:
        try:
            with self._connection.using(action, searching) as name:
                yield self._collection or self._make(name)
        except Unreachable as error:
            if "not found" in str(error):
                self._collection = None
            raise

    def _make(self, connection: str) -> Connected:
        with self._making:
            if self._collection is not None:
                return self._collection
            chosen = indexing_for(utility.get_server_version(using=connection, timeout=_PATIENCE_SECONDS))
            schema = _schema(self._encoder, self._dimension, chosen.half)
            if utility.has_collection(self.name, using=connection, timeout=_PATIENCE_SECONDS):
                made = Connected(self.name, using=connection)
                if (found := made.schema.description) != schema.description:
                    raise StoreOfAnotherVersion(
                        f"Milvus's collection {self.name} was made by another version: {found[:200]!r}."
                    )
            else:
                made = Connected(
                    self.name, schema, connection, num_partitions=PARTITIONS, shards_num=1,
                    consistency_level="Bounded",
                )  # fmt: skip
            if not made.has_index():
                made.create_index("descriptor", dict(chosen.index), timeout=_PATIENCE_SECONDS)
            # A collection stays as it was made when its server becomes a newer one.
            types = {field.name: field.dtype for field in made.schema.fields}
            self._value = np.float16 if types["descriptor"] == DataType.FLOAT16_VECTOR else np.float32
            self.index_type = str(made.index().params["index_type"])
            made.load(timeout=_PATIENCE_SECONDS)
            self._id = _id_of(made)
            self._collection = made
            return made

    @property
    def id(self) -> int:
        """By which Milvus knows it; another one if it is dropped and made again, or in another Milvus or database."""
        if self._collection is None:
            with self._using("answer"):
                pass
        return self._id

    def expect(self, collection: int) -> None:
        """Raise StoreUnavailable unless this is the collection that a map's descriptors are in; 0: no one has any."""
        if collection not in (0, self.id):
            raise StoreUnavailable(
                f"Milvus's collection {self.name} is not the one that has the map's descriptors. Connect to the Milvus"
                " and the database of it that have, or rebuild the map's index if they have lost them."
            )

    def insert(self, map_number: int, entities: Sequence[Entity]) -> int:
        """Insert entities of a map; they are durable when this returns.

        Returns:
            From which timestamp on a search sees them.
        """
        seen_from = 0
        with self._using("store descriptors", searching=False) as collection:
            for start in range(0, len(entities), _AT_ONCE):
                some = [self._record(map_number, one) for one in entities[start : start + _AT_ONCE]]
                seen_from = int(collection.insert(some, timeout=_PATIENCE_SECONDS).timestamp)
        return seen_from

    def check(self) -> None:
        """Raise unless the collection can be searched."""
        with self._using("answer") as collection:
            self._id = _id_of(collection)
            collection.query("key == 0", ["key"], timeout=_CONNECTING_SECONDS, consistency_level="Eventually")

    def delete(self, keys: Sequence[int]) -> None:
        """Delete entities."""
        with self._using("delete descriptors", searching=False) as collection:
            collection.delete(f"key in {list(keys)}", timeout=_PATIENCE_SECONDS)

    def keys_between(self, first: int, end: int) -> list[int]:
        """The keys of all entities from ``first`` on and below ``end``; at most ``MOST_FOUND`` apart."""
        with self._using("list descriptors") as collection:
            found = collection.query(
                f"key >= {first} and key < {end}", ["key"], timeout=_PATIENCE_SECONDS, consistency_level="Strong"
            )
        return [int(one["key"]) for one in found]

    def descriptors_of(self, keys: Sequence[int]) -> dict[int, NDArray[np.float32]]:
        """The descriptors of entities by key, float32 [D]; keys that Milvus does not have now are left out."""
        with self._using("read descriptors") as collection:
            found = collection.query(
                f"key in {list(keys)}", ["key", "descriptor"], timeout=_PATIENCE_SECONDS, consistency_level="Strong"
            )
        return {int(one["key"]): self._vector(one["descriptor"]) for one in found}

    def _vector(self, value: Any) -> NDArray[np.float32]:
        """A descriptor as Milvus returns it: a list, or the bytes of halves."""
        halves = value[0] if isinstance(value, list) and value and isinstance(value[0], bytes) else value
        stored = np.frombuffer(halves, np.float16) if isinstance(halves, bytes) else np.asarray(halves)
        return stored.astype(np.float32)

    def search(
        self, descriptors: NDArray[np.float32], expression: str, limit: int, seen_from: int
    ) -> list[tuple[NDArray[np.int64], NDArray[np.float32]]]:
        """The keys with the largest inner products, int64 [n], and these, float32 [n], for each of the queries.

        Args:
            descriptors: float32 [B, D].
            limit: how many at most; at most ``MOST_FOUND``.
            seen_from: a timestamp of Milvus; rows that were inserted until then are searched.
        """
        with self._using("search") as collection:
            queries, settings = (
                list(descriptors.astype(self._value, copy=False)),
                search_settings(self.index_type, limit),
            )
            found = collection.search(
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


def _id_of(collection: Connected) -> int:
    return int(collection.describe(timeout=_CONNECTING_SECONDS)["collection_id"])


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

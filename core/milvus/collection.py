"""The collection of Milvus that has the descriptors of one encoder, those of all its maps."""

from __future__ import annotations

import hashlib
import logging
import re
import threading
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from math import isnan
from typing import Any

import grpc
import numpy as np
from numpy.typing import NDArray
from pymilvus import DataType, MilvusClient
from pymilvus.exceptions import MilvusException

from core.errors import StoreOfAnotherVersion, StoreUnavailable
from core.outage import Outage, Unreachable
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
    said = _call_of(error)
    if said is None:
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


def _call_of(error: BaseException) -> grpc.RpcError | None:
    """The error of gRPC in one of pymilvus, which also names errors as their own causes; None if it has none."""
    before: BaseException | None = error
    while isinstance(before, MilvusException):
        before = before.__cause__ if before.__cause__ is not before and before.__cause__ else before.__context__
    return before if isinstance(before, grpc.RpcError) else None


def _in_one_line(text: str) -> str:
    return " ".join(text.split())[:300]


class MilvusConnection:
    """A connection to Milvus, which is made when it is first used.  Any thread may use it."""

    def __init__(self, address: str, token: str, database: str, certificate: str | None) -> None:
        # Dedicated: pymilvus would share connections of one address, whatever their certificates.
        self._given: dict[str, Any] = {"uri": address, "token": token, "db_name": database, "dedicated": True}
        if certificate is not None:
            self._given |= {"server_pem_path": certificate, "secure": True}
        self._making = threading.Lock()
        self._client: MilvusClient | None = None
        # After a kill it takes writes before it searches.
        self._outages = {False: Outage("Milvus", probe=self._probe), True: Outage("Milvus", _SEARCH, self._probe)}

    @contextmanager
    def using(self, action: str, searching: bool = False) -> Iterator[MilvusClient]:
        """The client, once it is connected.

        Args:
            searching: whether the call needs a loaded collection.

        Raises:
            StoreUnavailable: Milvus cannot be reached, or refuses.
        """
        with self._outages[searching].noticed(), milvus_errors(action):
            yield self._client or self._connect()

    def _probe(self) -> None:
        """Raise Unreachable unless Milvus answers soon; pymilvus repeats every other call for long."""
        with milvus_errors("answer"):
            if (client := self._client) is not None:
                client.get_server_version(timeout=_PROBING_SECONDS)

    def _connect(self) -> MilvusClient:
        with self._making:
            if self._client is None:
                self._client = MilvusClient(timeout=_CONNECTING_SECONDS, grpc_options=_AGAIN_SOON, **self._given)
            return self._client

    def check(self) -> None:
        """Ask Milvus for its version.

        Raises:
            StoreUnavailable: it does not answer, or refuses.
        """
        with self.using("answer") as client:
            client.get_server_version(timeout=_CONNECTING_SECONDS)

    def close(self) -> None:
        """Close it."""
        if (client := self._client) is not None:
            client.close()


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
        self._id: int | None = None  # None: it is to be made, or looked at, first

    @contextmanager
    def _using(self, action: str, searching: bool = True) -> Iterator[MilvusClient]:
        try:
            with self._connection.using(action, searching) as client:
                if self._id is None:
                    self._make(client)
                yield client
        except Unreachable as error:
            if "not found" in str(error):
                self._id = None
            raise

    def _make(self, client: MilvusClient) -> None:
        with self._making:
            if self._id is not None:
                return
            chosen = indexing_for(client.get_server_version(timeout=_PATIENCE_SECONDS))
            description = f"placerec collection 1 of {self._encoder}"
            if not client.has_collection(self.name, timeout=_PATIENCE_SECONDS):
                schema = _schema(description, self._dimension, chosen.half)
                client.create_collection(
                    self.name, schema=schema, timeout=_PATIENCE_SECONDS, consistency_level="Bounded", num_shards=1,
                    num_partitions=PARTITIONS,
                )  # fmt: skip
            made = client.describe_collection(self.name, timeout=_PATIENCE_SECONDS)
            if (found := made["description"]) != description:
                raise StoreOfAnotherVersion(
                    f"Milvus's collection {self.name} was made by another version: {found[:200]!r}."
                )
            if not client.list_indexes(self.name, timeout=_PATIENCE_SECONDS):
                index = client.prepare_index_params("descriptor", **chosen.index)
                client.create_index(self.name, index, timeout=_PATIENCE_SECONDS)
            # A collection stays as it was made when its server becomes a newer one.
            types = {field["name"]: field["type"] for field in made["fields"]}
            self._value = np.float16 if types["descriptor"] == DataType.FLOAT16_VECTOR else np.float32
            (index_name,) = client.list_indexes(self.name, "descriptor", timeout=_PATIENCE_SECONDS)
            index = client.describe_index(self.name, index_name, timeout=_PATIENCE_SECONDS)
            self.index_type = str(index["index_type"])
            client.load_collection(self.name, timeout=_PATIENCE_SECONDS)
            self._id = int(made["collection_id"])

    @property
    def id(self) -> int:
        """By which Milvus knows it; another one if it is dropped and made again, or in another Milvus or database."""
        if self._id is None:
            with self._using("answer"):
                pass
        return self._id or 0

    def expect(self, collection: int) -> None:
        """Raise StoreUnavailable unless this is the collection that a map's descriptors are in; 0: no one has any."""
        if collection not in (0, self.id):
            raise StoreUnavailable(
                f"Milvus's collection {self.name} is not the one that has the map's descriptors. Connect to the Milvus"
                " and the database of it that have, or rebuild the map's index if they have lost them."
            )

    def insert(self, map_number: int, entities: Sequence[Entity]) -> None:
        """Insert entities of a map; they are durable when this returns."""
        with self._using("store descriptors", searching=False) as client:
            for start in range(0, len(entities), _AT_ONCE):
                some = [self._record(map_number, one) for one in entities[start : start + _AT_ONCE]]
                client.insert(self.name, some, timeout=_PATIENCE_SECONDS)

    def check(self) -> None:
        """Raise unless the collection can be searched."""
        with self._using("answer") as client:
            self._id = int(client.describe_collection(self.name, timeout=_CONNECTING_SECONDS)["collection_id"])
            self._query(client, "key == 0", ["key"], _CONNECTING_SECONDS, "Eventually")

    def delete(self, keys: Sequence[int]) -> None:
        """Delete entities."""
        with self._using("delete descriptors", searching=False) as client:
            client.delete(self.name, filter=f"key in {list(keys)}", timeout=_PATIENCE_SECONDS)

    def keys_between(self, first: int, end: int) -> list[int]:
        """The keys of all entities from ``first`` on and below ``end``; at most ``MOST_FOUND`` apart."""
        with self._using("list descriptors") as client:
            found = self._query(client, f"key >= {first} and key < {end}", ["key"])
        return [int(one["key"]) for one in found]

    def descriptors_of(self, keys: Sequence[int]) -> dict[int, NDArray[np.float32]]:
        """The descriptors of entities by key, float32 [D]; keys that Milvus does not have now are left out."""
        with self._using("read descriptors") as client:
            found = self._query(client, f"key in {list(keys)}", ["key", "descriptor"])
        return {int(one["key"]): self._vector(one["descriptor"]) for one in found}

    def _query(
        self, client: MilvusClient, expression: str, fields: list[str], seconds: float = _PATIENCE_SECONDS,
        level: str = "Strong",
    ) -> list[dict[str, Any]]:  # fmt: skip
        found: list[dict[str, Any]] = client.query(
            self.name, expression, fields, timeout=seconds, consistency_level=level
        )
        return found

    def _vector(self, value: Any) -> NDArray[np.float32]:
        """A descriptor as Milvus returns it: a list, or the bytes of halves."""
        halves = value[0] if isinstance(value, list) and value and isinstance(value[0], bytes) else value
        stored = np.frombuffer(halves, np.float16) if isinstance(halves, bytes) else np.asarray(halves)
        return stored.astype(np.float32)

    def search(
        self, descriptors: NDArray[np.float32], expression: str, limit: int, recent: bool
    ) -> list[tuple[NDArray[np.int64], NDArray[np.float32]]]:
        """The keys with the largest inner products, int64 [n], and these, float32 [n], for each of the queries.

        Every insertion is seen that ended before its map's state was read, whichever service made it.  Of a map that
        was written to lately, a search waits until Milvus has taken up everything up to now (``Strong``), by Milvus's
        own clock alone.  Of others it waits for what is older than five seconds by that clock (``Bounded``,
        ``common.gracefulTime``), which is seldom anything.  The age of a write is measured by PostgreSQL's clock
        alone, from a moment after the insertion: clocks of services do not count, nor does a constant difference
        between PostgreSQL's and Milvus's.  ``RECENT_SECONDS`` are three times the five, so either clock may be set by
        ten seconds between write and search.

        Args:
            descriptors: float32 [B, D].
            limit: how many at most; at most ``MOST_FOUND``.
            recent: whether the map was written to lately (:attr:`core.ledger.maps.record.MapState.recent`).
        """
        with self._using("search") as client:
            found = client.search(
                self.name, list(descriptors.astype(self._value, copy=False)), expression, limit,
                search_params=search_settings(self.index_type, limit), timeout=_PATIENCE_SECONDS,
                anns_field="descriptor", consistency_level="Strong" if recent else "Bounded",
            )  # fmt: skip
        return [(np.array(hits.ids, np.int64), np.array(hits.distances, np.float32)) for hits in found]

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


def _schema(description: str, dimension: int, half: bool) -> Any:
    """The fields of an entity, as pymilvus's ``CollectionSchema``."""
    schema = MilvusClient.create_schema(description=description)
    schema.add_field("key", DataType.INT64, is_primary=True)
    schema.add_field("map", DataType.INT64, is_partition_key=True)
    for name in ("row", "timestamp", "sequence", "ordinal"):
        schema.add_field(name, DataType.INT64)
    schema.add_field("kind", DataType.INT8)
    for axis in "xyz":
        schema.add_field(axis, DataType.DOUBLE)
    schema.add_field("heading", DataType.FLOAT)
    schema.add_field("camera", DataType.VARCHAR, max_length=64)
    schema.add_field("metadata", DataType.JSON)
    schema.add_field("descriptor", DataType.FLOAT16_VECTOR if half else DataType.FLOAT_VECTOR, dim=dimension)
    return schema

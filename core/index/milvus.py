"""The first stage of a search in a Milvus, for maps whose codes do not fit in the memory of a service.

A map has a collection of its rows: their numbers and descriptors.  All of it is derived and may be lost; the store
gives it again.  A row is of one frame for ever, so services that fill a collection at the same time give it the same:
each gives it all rows that were made since it opened the map, and when it opens one, those that Milvus lacks.  Rows
that no place has any more are left out of searches by their caller, and deleted when there is time.

A collection has a random name and is found by an alias, whose making succeeds once.  Searches name the collection, so
that nobody takes one that was lost and is being filled anew for the one that was there before.
"""

from __future__ import annotations

import logging
import os
import re
import secrets
import threading
import time
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Executor
from contextlib import contextmanager
from dataclasses import dataclass, replace
from itertools import islice
from typing import Any, ClassVar, NamedTuple

import numpy as np
from numpy.typing import NDArray

from core.errors import MissingExtra, StoreUnavailable
from core.index.codes import Coder, Codes
from core.index.flat import Array, Flags, ranked
from core.index.table import Shortlist
from core.outage import Outage, Unreachable

os.environ.setdefault("GRPC_VERBOSITY", "NONE")  # what it would write beside the log is in the errors
try:
    import grpc
    from pymilvus import DataType, MilvusClient
    from pymilvus.exceptions import MilvusException
except ModuleNotFoundError as absent:
    how = "pip install 'placerec[milvus]', or in a checkout .venv/bin/pip install --editable '.[milvus]'"
    raise MissingExtra(f"An index in Milvus needs {absent.name}, which others do not: {how}.") from absent
logging.getLogger("pymilvus").setLevel(logging.CRITICAL)  # what it refuses is raised; it would log it as well

MOST_FOUND, MOST_LISTED = 16_384, 4096  # the most rows that a search finds, which is Milvus's limit, and that it names
RECENT_SECONDS = 15.0
"""For this time after Milvus was given rows, a search waits until it has taken up everything; later, for what is older
than five seconds (``Bounded``, ``common.gracefulTime``), which is seldom anything."""

_AT_ONCE = 256  # descriptors of one message: 32 MB with the default encoder; Milvus takes 64
_PATIENCE: dict[str, Any] = {"timeout": 10.0}
# A Milvus that was gone is called again within two seconds; by default gRPC would wait for up to two minutes.
_AGAIN_SOON = {"grpc.initial_reconnect_backoff_ms": 200, "grpc.max_reconnect_backoff_ms": 2000}
_NOT_FOUND, _NOT_LOADED, _ALIAS_THERE = 100, 101, 1602  # Milvus's numbers of errors
_NAME = re.compile(r"placerec_(\w+)_[0-9a-f]{16}", re.ASCII)  # of a collection; the uid of its map is in it
_REASONS = {  # of a failed connection, by what gRPC says of it
    "CERTIFICATE_VERIFY_FAILED|Verification Check failed": "has a certificate that cannot be trusted",
    "handshake": "cannot be spoken to by TLS",
    "Socket closed": "closes the connection, as one does that wants TLS (https) or is ending",
}


def indexing_for(version: str) -> tuple[bool, str, dict[str, Any]]:
    """How a server of a version, such as ``v2.6.4``, has descriptors: whether as halves; its index and parameters.

    From 2.6 on binary codes and a second look at halves (IVF_RABITQ), from 2.4 on a graph over halves (HNSW), before
    it, and where the version says nothing, exact search over float32.  Tried on a real server: 2.3 alone.
    """
    found = re.match(r"v?(\d+)\.(\d+)", version)
    since = (int(found[1]), int(found[2])) if found else (0, 0)
    if since >= (2, 6):
        return True, "IVF_RABITQ", {"nlist": 128, "refine": True, "refine_type": "FP16"}
    return (True, "HNSW", {"M": 32, "efConstruction": 256}) if since >= (2, 4) else (False, "FLAT", {})


def search_settings(kind: str, limit: int) -> dict[str, Any]:
    """The parameters of a search of an index of this type for ``limit`` rows."""
    params: dict[str, dict[str, Any]] = {
        "IVF_RABITQ": {"nprobe": 32 if limit <= 1000 else 128, "rbq_query_bits": 8, "refine_k": 2},
        "HNSW": {"ef": max(256, 2 * limit)},
    }
    return {"metric_type": "IP", "params": params.get(kind, {})}


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
    said: BaseException | None = error
    while isinstance(said, MilvusException):  # pymilvus also names errors as their own causes
        said = said.__cause__ if said.__cause__ is not said and said.__cause__ else said.__context__
    if not isinstance(said, grpc.RpcError):
        return f"refuses to {action}: {' '.join(str(getattr(error, 'message', error)).split())[:300]}"
    details = " ".join((said.details() or "").rpartition("last error: ")[2].split())[:300]
    reasons = [reason for words, reason in _REASONS.items() if re.search(words, details)]
    by_code = {
        grpc.StatusCode.UNAUTHENTICATED: "refuses the token",
        grpc.StatusCode.PERMISSION_DENIED: f"refuses to {action}, for the token's user has no right to",
        grpc.StatusCode.DEADLINE_EXCEEDED: f"takes too long to {action}",
        grpc.StatusCode.UNAVAILABLE: "cannot be reached",
    }
    reasons.append(by_code.get(said.code(), f"refuses to {action}"))
    return f"{reasons[0]}: {details or said.code()}"


def _batched(items: Iterable[Any], size: int) -> Iterator[list[Any]]:
    rest = iter(items)
    while some := list(islice(rest, size)):
        yield some


class Milvus:
    """A Milvus, connected to when it is first used.  Any thread may use it; methods may raise StoreUnavailable.

    Args:
        address: such as ``http://localhost:19530``; ``https`` for TLS.
        token, database: ``user:password``, and the name of the database there; empty: none, its default.
        certificate: path of the file of the authority that Milvus's certificate is checked by.
    """

    def __init__(self, address: str, token: str = "", database: str = "", certificate: str | None = None) -> None:
        # Dedicated: pymilvus would share connections of one address, whatever their certificates.
        self._given: dict[str, Any] = {"uri": address, "token": token, "db_name": database, "dedicated": True}
        if certificate is not None:
            self._given |= {"server_pem_path": certificate, "secure": True}
        self._making = threading.Lock()
        self._client: MilvusClient | None = None
        self.lost = set[str]()  # collections that were found to be gone
        # After a kill it takes writes before it searches.
        self._outages = Outage("Milvus", probe=self._probe), Outage("Milvus", "Milvus's search", self._probe)

    @contextmanager
    def using(self, action: str, searching: bool = False, name: str = "") -> Iterator[MilvusClient]:
        """The client; ``searching``: for a loaded collection; ``name``: of one that is lost if it is not there."""
        with self._outages[searching].noticed(), milvus_errors(action):
            try:
                yield self._client or self._connect()
            except MilvusException as error:
                if not name or error.code not in (_NOT_FOUND, _NOT_LOADED):
                    raise
                self.lost.add(name)
                raise StoreUnavailable("Milvus has lost a map's descriptors; it is given them again.") from error

    def _probe(self) -> None:
        """Raise Unreachable unless Milvus answers soon; pymilvus repeats every other call for long."""
        with milvus_errors("answer"):
            if (client := self._client) is not None:
                client.get_server_version(timeout=1)

    def _connect(self) -> MilvusClient:
        with self._making:
            self._client = self._client or MilvusClient(timeout=3, grpc_options=_AGAIN_SOON, **self._given)
            return self._client

    def check(self) -> None:
        """Raise unless Milvus answers, and lets this service see its collections."""
        with self.using("list collections") as client:
            client.list_collections(timeout=3)

    def codes(self, uid: str, dimension: int, rows: int, last: tuple[int, Array] | None = None) -> MilvusCodes:
        """The first stage of as many of the first ``rows`` rows of a map as Milvus has; it is asked for them.

        Args:
            uid: names the map, and no map that was lost: at most 200 ASCII letters, digits and underscores.
            dimension: D, the values of a descriptor.
            last: the last of the rows that a place has, and its descriptor, float32 [D].  If Milvus has another one, as
                behind a store that was restored and went on, the collection is dropped.
        """
        with self.using("read rows", searching=True) as client:
            made, low, high, step = self._loaded(client, uid), 0, rows, 1
            while made is not None and low < high:  # there are rows below low, and none from high on; mostly the last
                at = max((low + high) // 2, high - step)
                expression = f"row >= {at} and row < {high}"
                found = client.query(made.name, expression, ["row"], limit=1, consistency_level="Strong", **_PATIENCE)
                low, high, step = (int(found[0]["row"]) + 1, high, step) if found else (low, at, 2 * step)
        there = MilvusCodes(self, uid, Coder.of(dimension), made, low, time.monotonic())
        if last is not None and last[0] < low and not there.has(*last):
            self.drop(lambda other: other == uid)
            return replace(there, made=None, rows=0)
        return there

    def _loaded(self, client: MilvusClient, uid: str) -> Made | None:
        """The collection of a map, None if it has none."""
        if not client.has_collection(f"placerec_{uid}", **_PATIENCE):
            return None
        there = client.describe_collection(f"placerec_{uid}", **_PATIENCE)
        client.load_collection(name := there["collection_name"], **_PATIENCE)
        self.lost.discard(name)
        return Made(name, *indexing_for(there["description"])[:2])

    def make(self, uid: str, dimension: int) -> Made:
        """The collection of a map, which is made if there is none."""
        with self.using("make a collection") as client:
            while (made := self._loaded(client, uid)) is None:
                version, name = client.get_server_version(**_PATIENCE), f"placerec_{uid}_{secrets.token_hex(8)}"
                half, kind, params = indexing_for(version)
                schema = MilvusClient.create_schema(description=version)
                schema.add_field("row", DataType.INT64, is_primary=True)
                vector = DataType.FLOAT16_VECTOR if half else DataType.FLOAT_VECTOR
                schema.add_field("descriptor", vector, dim=dimension)
                client.create_collection(name, schema=schema, consistency_level="Bounded", num_shards=1, **_PATIENCE)
                settings = {"index_type": kind, "metric_type": "IP", "params": params}
                client.create_index(name, client.prepare_index_params("descriptor", **settings), **_PATIENCE)
                try:
                    client.create_alias(name, f"placerec_{uid}", **_PATIENCE)
                except MilvusException as error:
                    client.drop_collection(name, **_PATIENCE)
                    if error.code != _ALIAS_THERE:  # else another service was faster
                        raise
        return made

    def delete(self, uid: str, rows: Iterable[int]) -> None:
        """Delete rows of a map that no place has any more."""
        with self.using("delete descriptors") as client:
            if client.has_collection(f"placerec_{uid}", **_PATIENCE):
                for some in _batched(rows, MOST_LISTED):
                    client.delete(f"placerec_{uid}", ids=some, **_PATIENCE)

    def drop(self, gone: Callable[[str], bool]) -> int:
        """Drop the collections of all maps whose uids are ``gone``, as of deleted maps; returns how many."""
        with self.using("drop collections") as client:
            names = client.list_collections(**_PATIENCE)
            found = [name for name in names if (of := _NAME.fullmatch(name)) is not None and gone(of[1])]
            for name in found:
                for alias in client.list_aliases(name, **_PATIENCE)["aliases"]:
                    client.drop_alias(alias, **_PATIENCE)
                client.drop_collection(name, **_PATIENCE)
        return len(found)

    def close(self) -> None:
        """Close the connection."""
        if (client := self._client) is not None:
            client.close()


class Made(NamedTuple):
    """A collection: its name, and how it has descriptors, which stays when its server becomes a newer one."""

    name: str
    half: bool
    kind: str

    def vectors(self, descriptors: Array) -> list[NDArray[Any]]:
        """Descriptors, float32 [n, D], as Milvus takes them."""
        return list(descriptors.astype(np.float16 if self.half else np.float32, copy=False))


@dataclass(frozen=True, eq=False)
class MilvusCodes:
    """Rows 0 … ``rows`` of a map in Milvus (:class:`core.index.table.FirstStage`), an immutable value.

    coder: makes the codes that the store keeps beside descriptors.
    made: the collection that has them; None if there is none.
    since: when it was known to have them, by this machine's monotonic clock, in seconds.
    """

    milvus: Milvus
    uid: str
    coder: Coder
    made: Made | None
    rows: int
    since: float
    memory: ClassVar[int] = 0

    def __len__(self) -> int:
        return self.rows

    @property
    def is_lost(self) -> bool:
        """Whether Milvus has no such collection any more: :meth:`Milvus.codes` says what it has."""
        return self.made is not None and self.made.name in self.milvus.lost

    def appended(self, codes: Codes) -> MilvusCodes:
        """This: Milvus has no further rows before :meth:`brought_up` gives it them."""
        return self

    def brought_up(self, rows: Iterable[tuple[int, Array]], total: int) -> MilvusCodes:
        """With the first ``total`` rows.  Any number of services may do so at the same time.

        Args:
            rows: those from ``len(self)`` on and below ``total`` that places have, ascending, and their descriptors,
                float32 [D]; an error leaves in Milvus those that it was given.
        """
        made = self.made or self.milvus.make(self.uid, self.coder.dimension)
        for some in _batched(rows, _AT_ONCE):
            vectors = made.vectors(np.stack([descriptor for _, descriptor in some]))
            entities = [{"row": row, "descriptor": one} for (row, _), one in zip(some, vectors, strict=True)]
            with self.milvus.using("store descriptors", name=made.name) as client:
                client.upsert(made.name, entities, **_PATIENCE)
        return replace(self, made=made, rows=total, since=time.monotonic())

    def shortlists(
        self, queries: Array, count: int, allowed: Flags | None = None, executor: Executor | None = None
    ) -> list[Shortlist]:
        """For each query the ``count`` rows with the largest inner products (:class:`core.index.table.FirstStage`).

        Few allowed rows are named.  Of many, more are asked for than are wanted, and the others are left out; only if
        some thousands have too few of them, all are named, some at a time.
        """
        allowed = np.ones(len(self), np.bool_) if allowed is None else allowed
        if allowed.shape != (len(self),) or queries.ndim != 2 or queries.shape[1] != self.coder.dimension:
            raise ValueError(f"allowed is said of all {len(self)} rows, and a query has {self.coder.dimension} values")
        rows = np.flatnonzero(allowed)
        limit = -(-count * len(allowed) // max(1, len(rows)))
        while len(rows) > MOST_LISTED and limit <= MOST_FOUND:
            every = self._found(queries, f"row < {len(self)}", limit)
            kept = [(hits.rows[fit := allowed[hits.rows]], hits.estimates[fit]) for hits in every]
            found = [Shortlist(chosen[:count], estimates[:count]) for chosen, estimates in kept]
            if all(len(one.rows) == count or len(hits.rows) < limit for one, hits in zip(found, every, strict=True)):
                return found
            limit *= 4
        best = [Shortlist(np.empty(0, np.int64), np.empty(0, np.float32)) for _ in queries]
        for some in _batched(rows.tolist(), MOST_LISTED):
            for at, hits in enumerate(self._found(queries, f"row in {some}", count)):
                joined = ranked(np.append(best[at].rows, hits.rows), np.append(best[at].estimates, hits.estimates))
                best[at] = Shortlist(joined[0][:count], joined[1][:count])
        return best

    def has(self, row: int, descriptor: Array) -> bool:
        """Whether Milvus has this descriptor, float32 [D], in a row."""
        products = self._found(descriptor[np.newaxis], f"row == {row}", 1)[0].estimates
        return len(products) == 1 and bool(np.isclose(products[0], descriptor @ descriptor, rtol=0.01))

    def _found(self, queries: Array, expression: str, limit: int) -> list[Shortlist]:
        """The best rows for each query of those for which an expression holds."""
        assert self.made is not None
        made, found = self.made, list[Shortlist]()
        level = "Strong" if time.monotonic() - self.since < RECENT_SECONDS else "Bounded"
        given = {"anns_field": "descriptor", "search_params": search_settings(made.kind, limit), **_PATIENCE}
        for some in _batched(made.vectors(queries), _AT_ONCE):
            with self.milvus.using("search", True, made.name) as client:
                every = client.search(made.name, some, expression, limit, consistency_level=level, **given)
            hits = [(np.array(one.ids, np.int64), np.array(one.distances, np.float32)) for one in every]
            found += [Shortlist(*ranked(*one)) for one in hits]
        return found

"""Forks processes that do operations on the storage layer until they are killed; run it by ``python -m``.

The first process imports everything and starts no thread.  Each line on its standard input, ``directory socket
workers``, is answered with the number of a new process, which opens the data directory, connects to the socket once
for each worker, and does the operations that it receives there, a line of JSON each.
"""

from __future__ import annotations

import json
import os
import signal
import socket
import sqlite3
import sys
import threading
import traceback
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from core.errors import PlacerecError
from core.frames.masks import Mask
from core.maps import Correspondence, Enrolment, History, MapSettings
from core.places import PlaceFields
from core.store import Directory, opening
from core.storage.database import connections as database
from core.maps.forms import inner_products, pack_descriptors
from core.storage.search import index_files, recall
from tests.core.store.frames import DIMENSION, ENCODER, LOCAL_SHAPE, keypoints_of
from tests.durability.contents import contents, map_contents
from tests.durability.storage.operations import Operation, enrolment, look_enrolment, pictures

ROWS_PER_SEGMENT = 4
GROUP_ROWS = 8
"""Small, so that a handful of places makes files of codes."""

QUERIES = 8
"""By which the recall of an index is measured; few, since that is done again and again here."""

Answer = dict[str, Any]


class Gate:
    """A lock that many may share, or one may have alone."""

    def __init__(self) -> None:
        self._condition, self._within = threading.Condition(), 0

    @contextmanager
    def shared(self) -> Iterator[None]:
        """Hold the lock together with others."""
        with self._condition:
            self._within += 1
        try:
            yield
        finally:
            with self._condition:
                self._within -= 1
                self._condition.notify_all()

    @contextmanager
    def alone(self) -> Iterator[None]:
        """Hold the lock alone."""
        with self._condition:
            self._condition.wait_for(lambda: self._within == 0)
            yield


class Storage:
    """The data directory and what can be done with it."""

    def __init__(self, directory: Path) -> None:
        index_files.GROUP_ROWS, recall.QUERIES = GROUP_ROWS, QUERIES
        self._directory, self._gate = directory, Gate()
        self._open()

    def _open(self) -> None:
        self._atlas = Directory(self._directory, rows_per_segment=ROWS_PER_SEGMENT)

    def do(self, operation: Operation) -> Answer:
        """The answer to an operation, or the name of the error that it met."""
        if operation["do"] == "reopen":
            with self._gate.alone():
                self._atlas.close()
                self._open()
            return {"answer": None}
        with self._gate.shared():
            try:
                return getattr(self, "_" + operation["do"].replace("-", "_"))(operation) or {"answer": None}
            except PlacerecError as error:
                return {"answer": {"error": type(error).__name__}}
            except AssertionError as error:
                return {"failure": str(error)[:2000]}

    def _contents(self, operation: Operation) -> Answer:
        return {"answer": contents(self._atlas)}

    def _look(self, operation: Operation) -> Answer:
        return {"answer": None, "found": map_contents(self._atlas.get(operation["map"]), True)}

    def _create(self, operation: Operation) -> None:
        settings = MapSettings(**operation["settings"])
        precision, unlisted = operation["precision"], operation["unlisted"]
        self._atlas.create(operation["map"], ENCODER, DIMENSION, settings, LOCAL_SHAPE, unlisted, precision)

    def _enrol(self, operation: Operation) -> Answer:
        items = [enrolment(**item) for item in operation["items"]]
        done = self._atlas.get(operation["map"]).enrol(items)
        told = {place.id: place.model_dump(mode="json") for place, _ in done}  # the last of each id
        return {"answer": [change for _, change in done], "places": list(told.values())}

    def _set(self, operation: Operation) -> Answer:
        fields = PlaceFields.model_validate(operation["fields"])
        place, change = self._atlas.get(operation["map"]).set_fields(operation["id"], fields)
        return {"answer": change, "places": [place.model_dump(mode="json")]}

    def _patch(self, operation: Operation) -> Answer:
        place = self._atlas.get(operation["map"]).patch(operation["id"], operation["changes"])
        return {"answer": None, "places": [place.model_dump(mode="json")]}

    def _forget(self, operation: Operation) -> None:
        self._atlas.get(operation["map"]).forget(operation["id"])

    def _forget_sequence(self, operation: Operation) -> Answer:
        return {"answer": self._atlas.get(operation["map"]).forget_sequence(operation["name"])}

    def _forget_many(self, operation: Operation) -> Answer:
        map_ = self._atlas.get(operation["map"])
        digests = {place_id: map_.digest(place_id) or b"" for place_id in operation["ids"]}
        return {"answer": map_.transfer.forget(digests)}

    def _looks(self, operation: Operation) -> Answer:
        items = [look_enrolment(**item) for item in operation["items"]]
        done = self._atlas.get(operation["map"]).enrol(items)
        return {"answer": [change for _, change in done]}

    def _forget_look(self, operation: Operation) -> None:
        self._atlas.get(operation["map"]).forget_look(operation["id"], operation["look"])

    def _forget_learnt(self, operation: Operation) -> Answer:
        return {"answer": self._atlas.get(operation["map"]).forget_learnt(operation["run"])}

    def _edit(self, operation: Operation) -> Answer:
        return {"answer": self._atlas.get(operation["map"]).edit(operation["changes"]).revision}

    def _keypoints(self, operation: Operation) -> Answer:
        map_ = self._atlas.get(operation["map"])
        found = [(one, keypoints_of(pictures()[one.digest])) for one in map_.without_keypoints(0, operation["limit"])]
        return {"answer": map_.add_keypoints(found)}

    def _counterparts(self, operation: Operation) -> None:
        map_ = self._atlas.get(operation["map"])
        rows = {place.id: place.row for place in map_.transfer.outline()}
        where = map_.snapshot().whereabouts
        stations = {
            rows[place_id]: (int(where.track[rows[other]]), int(where.station[rows[other]]))
            for place_id, other in operation["stations"]
        }
        poses: dict[int, int | None] = {rows[place_id]: rows[other] for place_id, other in operation["poses"]}
        map_.counterparts.store(Correspondence(stations, poses))

    def _camera(self, operation: Operation) -> Answer:
        mask = None if operation["mask"] is None else Mask.model_validate(operation["mask"])
        return {"answer": self._atlas.get(operation["map"]).cameras.put(operation["name"], mask)[1]}

    def _forget_camera(self, operation: Operation) -> None:
        self._atlas.get(operation["map"]).cameras.forget(operation["name"])

    def _adopt(self, operation: Operation) -> None:
        source = self._atlas.get(operation["from"])
        unlisted = self._atlas.unlisted()
        target = unlisted.get(operation["map"]) or self._atlas.get(operation["map"])
        digests = {place.id: place.digest for place in source.transfer.outline()}
        snapshot, items = source.snapshot(), []
        for place_id, ordinal in operation["places"]:
            place, row = source.transfer.find([place_id])[place_id]
            picture = source.picture(place_id)
            item = Enrolment(
                place_id,
                PlaceFields(**{name: getattr(place, name) for name in PlaceFields.model_fields}),
                snapshot.descriptors_at(np.array([row]))[0],
                place.regions,
                digests[place_id],
                snapshot.locals_at(np.array([row]))[0],
                picture if place.picture == "thumbnail" else None,
                picture if place.picture == "image" else None,
                source.keypoints_at([row])[0],
            )
            items.append((item, History(place.picture, ordinal, place.created_at, place.updated_at)))
        target.transfer.adopt(items)

    def _delete(self, operation: Operation) -> None:
        self._atlas.delete(operation["map"])

    def _publish(self, operation: Operation) -> None:
        self._atlas.publish(operation["map"])

    def _abandon(self, operation: Operation) -> None:
        self._atlas.abandon(operation["map"])


def _serve(storage: Callable[[], Storage], connection: socket.socket) -> None:
    """Answer each line with ``ack`` and a line of JSON, until the other end closes."""
    with connection, connection.makefile("rb") as lines:
        for line in lines:
            answer = storage().do(json.loads(line))
            connection.sendall(b"ack " + json.dumps(answer).encode() + b"\n")


def _run_until_killed(directory: Path, address: str, workers: int) -> None:
    """Run one process: it reads lines while the directory is being opened, and does them afterwards."""
    connections = []
    for number in range(workers):
        connection = socket.socket(socket.AF_UNIX)
        connection.connect(address)
        connection.sendall(b"%d\n" % number)
        connections.append(connection)
    first = connections[0].recv(1)  # a tracer may want to come before anything is done
    assert first == b"\n"
    storage = Storage(directory)
    threads = [threading.Thread(target=_serve, args=(lambda: storage, one)) for one in connections]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()


def _warm_up() -> None:
    """Load compiled code before the forks, by work that starts no thread."""
    vectors = np.random.default_rng(0).standard_normal((32, DIMENSION), dtype=np.float32)
    kept = pack_descriptors(vectors, "compressed")
    inner_products(vectors[:1], kept, "compressed")


UNSYNCED = ("log", "descriptors", "names")


def _leave_unsynced(what: str) -> None:
    """Break the storage layer: leave SQLite's log, segment files or folders unsynced, for a test of the harness."""
    sync, connect = os.fsync, database.connect

    def sync_others(file: int) -> None:
        path = Path(os.readlink(f"/proc/self/fd/{file}"))
        if path.suffix == ".seg" if what == "descriptors" else path.is_dir():
            return
        sync(file)

    def connect_weakly(path: Path, create: bool = False) -> sqlite3.Connection:
        connection = connect(path, create)
        connection.execute("PRAGMA synchronous = OFF")
        return connection

    if what == "log":
        database.connect = connect_weakly
        vars(opening)["connect"] = connect_weakly
    else:
        vars(os)["fsync"] = sync_others


def main(unsynced: str | None = None) -> None:
    """Fork one process a line, until the input ends."""
    _warm_up()
    if unsynced is not None:
        _leave_unsynced(unsynced)
    signal.signal(signal.SIGCHLD, signal.SIG_IGN)  # nobody waits for them
    for line in sys.stdin:
        directory, address, workers = line.split()
        process = os.fork()
        if process == 0:
            try:
                _run_until_killed(Path(directory), address, int(workers))
            except BaseException:
                traceback.print_exc()
            os._exit(0)
        print(process, flush=True)


if __name__ == "__main__":
    main(*sys.argv[1:])

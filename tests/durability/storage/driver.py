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
from core.ledger.maps import rows
from core.maps import Correspondence, Enrolment, History, MapSettings, ReviewSetting
from core.maps.archives.reading import Archive
from core.maps.forms import inner_products, pack_descriptors
from core.places import PlaceFields
from core.store import Directory, file, recall, tiers
from tests.core.store.frames import DIMENSION, ENCODER, LOCAL_SHAPE, keypoints_of
from tests.durability.contents import contents, map_contents
from tests.durability.storage.operations import Operation, enrolment, image_of, look_enrolment, pictures

ROWS_PER_SEGMENT = 4
COMPACT_FROM, ON_DISK_FROM = 8, 16
"""Small, so that a handful of places is searched by codes, and some more are not held in memory."""

MOST_OPEN = 2
"""Fewer than there are maps, so that their files are closed and opened again all the time."""

LEFT_SECONDS = 0
"""What no place shows any more is deleted right behind each write."""

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
        vars(tiers).update(COMPACT_FROM=COMPACT_FROM, ON_DISK_FROM=ON_DISK_FROM)
        recall.QUERIES, rows.LEFT_SECONDS = QUERIES, LEFT_SECONDS
        self._directory, self._gate = directory, Gate()
        self._open()

    def _open(self) -> None:
        self._store = Directory(self._directory, MOST_OPEN, rows_per_segment=ROWS_PER_SEGMENT)

    def do(self, operation: Operation) -> Answer:
        """The answer to an operation, or the name of the error that it met."""
        if operation["do"] == "reopen":
            with self._gate.alone():
                self._store.close()
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
        return {"answer": contents(self._store)}

    def _look(self, operation: Operation) -> Answer:
        return {"answer": None, "found": map_contents(self._store.get(operation["map"]), True)}

    def _create(self, operation: Operation) -> None:
        settings = MapSettings(**operation["settings"])
        precision, unlisted = operation["precision"], operation["unlisted"]
        self._store.create(operation["map"], ENCODER, DIMENSION, settings, LOCAL_SHAPE, unlisted, precision)

    def _enrol(self, operation: Operation) -> Answer:
        items = [enrolment(**item) for item in operation["items"]]
        done = self._store.get(operation["map"]).enrol(items)
        told = {place.id: place.model_dump(mode="json") for place, _ in done}  # the last of each id
        return {"answer": [change for _, change in done], "places": list(told.values())}

    def _set(self, operation: Operation) -> Answer:
        fields = PlaceFields.model_validate(operation["fields"])
        place, change = self._store.get(operation["map"]).set_fields(operation["id"], fields)
        return {"answer": change, "places": [place.model_dump(mode="json")]}

    def _patch(self, operation: Operation) -> Answer:
        place = self._store.get(operation["map"]).patch(operation["id"], operation["changes"])
        return {"answer": None, "places": [place.model_dump(mode="json")]}

    def _forget(self, operation: Operation) -> None:
        self._store.get(operation["map"]).forget(operation["id"])

    def _forget_sequence(self, operation: Operation) -> Answer:
        return {"answer": self._store.get(operation["map"]).forget_sequence(operation["name"])}

    def _forget_many(self, operation: Operation) -> Answer:
        map_ = self._store.get(operation["map"])
        digests = {place_id: map_.digest(place_id) or b"" for place_id in operation["ids"]}
        return {"answer": map_.transfer.forget(digests)}

    def _looks(self, operation: Operation) -> Answer:
        items = [look_enrolment(**item) for item in operation["items"]]
        done = self._store.get(operation["map"]).enrol(items)
        return {"answer": [change for _, change in done]}

    def _forget_look(self, operation: Operation) -> None:
        self._store.get(operation["map"]).forget_look(operation["id"], operation["look"])

    def _forget_learnt(self, operation: Operation) -> Answer:
        return {"answer": self._store.get(operation["map"]).forget_learnt(operation["run"])}

    def _edit(self, operation: Operation) -> Answer:
        return {"answer": self._store.get(operation["map"]).edit(operation["changes"]).revision}

    def _keypoints(self, operation: Operation) -> Answer:
        map_ = self._store.get(operation["map"])
        found = [(one, keypoints_of(pictures()[one.digest])) for one in map_.without_keypoints(0, operation["limit"])]
        return {"answer": map_.add_keypoints(found)}

    def _counterparts(self, operation: Operation) -> None:
        map_ = self._store.get(operation["map"])
        row_of = {place.id: place.row for place in map_.transfer.outline()}
        where = map_.snapshot().whereabouts
        stations = {
            row_of[place_id]: (int(where.track[row_of[other]]), int(where.station[row_of[other]]))
            for place_id, other in operation["stations"]
        }
        poses: dict[int, int | None] = {row_of[place_id]: row_of[other] for place_id, other in operation["poses"]}
        map_.counterparts.store(Correspondence(stations, poses))

    def _camera(self, operation: Operation) -> Answer:
        mask = None if operation["mask"] is None else Mask.model_validate(operation["mask"])
        return {"answer": self._store.get(operation["map"]).cameras.put(operation["name"], mask)[1]}

    def _forget_camera(self, operation: Operation) -> None:
        self._store.get(operation["map"]).cameras.forget(operation["name"])

    def _adopt(self, operation: Operation) -> None:
        source = self._store.get(operation["from"])
        unlisted = self._store.unlisted()
        target = unlisted.get(operation["map"]) or self._store.get(operation["map"])
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

    def _erase(self, operation: Operation) -> None:
        self._store.get(operation["map"]).erase()

    def _rebuild(self, operation: Operation) -> None:
        self._store.get(operation["map"]).rebuild_index()

    def _import(self, operation: Operation) -> None:
        exported = self._directory.with_name(f"{self._directory.name}-{operation['to']}.tar")
        exported.unlink(missing_ok=True)  # a killed process may have left it
        self._store.get(operation["map"]).exporter.write(exported)
        with Archive(exported) as archive:
            self._store.import_map(archive, operation["to"], lambda *_: None, lambda _: None, 1 << 20, lambda _: None)
        exported.unlink()

    def _review(self, operation: Operation) -> Answer:
        setting = ReviewSetting(most_frames=operation["most"])
        review = self._store.get(operation["map"]).review
        return {"answer": review.keep(image_of(operation["picture"]), operation["answer"], setting)}

    def _label(self, operation: Operation) -> None:
        review = self._store.get(operation["map"]).review
        review.label(review.page(None, 50).frames[operation["at"]].number, operation["label"])

    def _discard(self, operation: Operation) -> None:
        review = self._store.get(operation["map"]).review
        review.discard(review.page(None, 50).frames[operation["at"]].number)

    def _delete(self, operation: Operation) -> None:
        self._store.delete(operation["map"])

    def _publish(self, operation: Operation) -> None:
        self._store.publish(operation["map"])

    def _abandon(self, operation: Operation) -> None:
        self._store.abandon(operation["map"])


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


UNSYNCED = ("log", "names")


def _leave_unsynced(what: str) -> None:
    """Break the storage layer: leave SQLite's log, or folders, unsynced, for a test of the harness."""
    sync = os.fsync

    def sync_files(descriptor: int) -> None:
        if not Path(os.readlink(f"/proc/self/fd/{descriptor}")).is_dir():
            sync(descriptor)

    if what == "log":
        vars(file)["_SETTINGS"] |= {"synchronous": "OFF"}
    else:
        vars(os)["fsync"] = sync_files


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

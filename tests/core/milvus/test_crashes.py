"""Servers that are killed under a load: nothing acknowledged is lost, nothing is half-written, no answer is wrong."""

from __future__ import annotations

import random
import signal
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress

import numpy as np
import pytest

from core.errors import StorageFailure, UnknownMap, UnknownPlace
from core.milvus import open_store
from core.milvus.map import MilvusMap
from core.milvus.store import MilvusStore
from tests.core.milvus.servers import Server, Servers
from tests.core.storage.frames import DIMENSION, ENCODER, LOCAL_SHAPE, descriptor_of, digest_of, frame

pytestmark = [pytest.mark.cluster, pytest.mark.timeout(900)]

ROUNDS = 3
IDS = 12


class Load(threading.Thread):
    """Writes pairs of places, each pair in one batch, forgets places, and queries; notes what each place may show.

    may: by id, the pictures that the place may show, None for no place: one, unless a write got no answer.
    """

    def __init__(self, store: MilvusStore, seed: int, may: dict[str, set[str | None]]) -> None:
        super().__init__(daemon=True)
        self._store, self._random, self.may = store, random.Random(seed), may
        self._over = threading.Event()
        self.answered = self.queries = self.refused = 0
        self.wrong: list[str] = []

    def stop(self) -> None:
        self._over.set()
        self.join()

    def run(self) -> None:
        before: dict[str, set[str | None]] = {}
        while not self._over.is_set():
            ids = [f"p{number}" for number in self._random.sample(range(IDS), 2)]
            picture: str | None = f"picture {self._random.randrange(10**9)}"
            try:
                lab = self._store.get("lab")
                if self._random.random() < 0.3:
                    self._query(lab)
                    continue
                if self._random.random() < 0.2:
                    ids, picture = ids[:1], None
                before = {name: self.may[name] for name in ids}
                if picture is None and before[ids[0]] == {None}:
                    continue
                for name in ids:  # until the answer comes, both may be found
                    self.may[name] = before[name] | {picture}
                if picture is None:
                    lab.forget(ids[0])
                else:
                    lab.enrol([frame(name, picture) for name in ids])
                for name in ids:
                    self.may[name] = {picture}
                self.answered += 1
            except UnknownPlace:  # it was forgotten by a write that got no answer
                if None not in before[ids[0]]:
                    self.wrong.append(f"{ids[0]}, which shows one of {before[ids[0]]}, is lost")
                self.may[ids[0]] = {None}
            except StorageFailure:
                self.refused += 1
                time.sleep(0.05)

    def _query(self, lab: MilvusMap) -> None:
        """A place whose picture is known is found first by it."""
        known = [name for name, shows in self.may.items() if len(shows) == 1 and None not in shows]
        if known:
            name = self._random.choice(known)
            (picture,) = self.may[name]
            ((rows, _),) = lab.scope().search(descriptor_of(str(picture))[np.newaxis])
            # Both places of a batch show the same picture; another place cannot be as near.
            first = {place.id for place in lab.places_at(rows[:2].tolist()) if place is not None}
            if name not in first:
                self.wrong.append(f"{name} with {picture} is not among {first}")
            self.queries += 1


@contextmanager
def loaded(store: MilvusStore, seed: int, may: dict[str, set[str | None]]) -> Iterator[Load]:
    load = Load(store, seed, may)
    load.start()
    try:
        yield load
    finally:
        load.stop()


def check(lab: MilvusMap, may: dict[str, set[str | None]]) -> None:
    """Every place shows what it may show, is stored whole and is found."""
    outline, snapshot = lab.transfer.outline(), lab.snapshot()
    found = {place.id: place for place in outline}
    assert len(snapshot) == len(found)
    for name, shows in may.items():
        pictures = {digest_of(picture): picture for picture in shows if picture is not None}
        assert name in found or None in shows, f"{name}, which shows one of {shows}, is lost"
        if name not in found:
            may[name] = {None}
            continue
        place = found[name]
        assert place.digest in pictures, f"{name} shows none of {shows}"
        picture = pictures[place.digest]
        row = np.array([place.row])
        assert np.allclose(snapshot.descriptors_at(row)[0], descriptor_of(picture), atol=1e-3)
        assert snapshot.locals_at(row).any() and lab.picture(name) == f"thumbnail of {picture}".encode()
        ((rows, _),) = lab.scope().search(descriptor_of(picture)[np.newaxis])
        assert place.row in rows[:2].tolist()
        may[name] = {picture}


@pytest.mark.parametrize("which", ["milvus", "postgres"])
def test_kills(servers: Servers, which: str) -> None:
    server: Server = getattr(servers, which)
    store = open_store(servers.milvus_address, servers.postgres_address)
    with suppress(UnknownMap):
        store.delete("lab")
    lab = store.create("lab", ENCODER, DIMENSION, local_shape=LOCAL_SHAPE)
    may: dict[str, set[str | None]] = {f"p{number}": {None} for number in range(IDS)}
    answered = refused = 0
    for seed in range(ROUNDS):
        with loaded(store, seed, may) as load:
            time.sleep(random.Random(seed).uniform(0.5, 2.0))
            server.end(signal.SIGKILL)
            time.sleep(1.0)
            server.start()
            began, before = time.monotonic(), (load.answered, load.queries)
            while load.answered < before[0] + 10 or load.queries < before[1] + 10:
                assert time.monotonic() < began + 60 and load.is_alive(), "it does not serve again"
                time.sleep(0.05)
            print(f"{which} serves again {time.monotonic() - began:.1f} s after its return")
        assert not load.wrong, load.wrong
        answered, refused = answered + load.answered + load.queries, refused + load.refused
        check(lab, may)
    print(f"{which}: {ROUNDS} kills, {answered} answered, {refused} refused")
    store.delete("lab")
    store.close()

"""A load of writes, deletions and queries, and a model in plain values of what each place may show."""

from __future__ import annotations

import random
import threading
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager

import numpy as np

from core.errors import StorageFailure, UnknownPlace
from core.store import Map
from tests.core.cluster.clients import ProcessClient, StoreClient
from tests.core.store.frames import descriptor_of, digest_of

May = dict[str, set[str | None]]
"""By id, the pictures that the place may show, None for no place: one, unless a write got no answer."""


class PlaceLoad(threading.Thread):
    """Writes, forgets and queries, and notes in ``may`` what each of its places may show.

    answered, queries, looks, refused: writes and queries that were answered, batches without an answer that were seen
        to be there whole or not at all, and what was refused.
    """

    def __init__(self, client: StoreClient | ProcessClient, seed: str, may: May) -> None:
        super().__init__(daemon=True)
        self._client, self._random, self.may = client, random.Random(seed), may
        self._over = threading.Event()
        self._unanswered: tuple[list[str], str] | None = None
        self.answered = self.queries = self.looks = self.refused = 0
        self.wrong: list[str] = []

    def stop(self) -> None:
        self._over.set()
        self.join()

    def served(self, since: tuple[int, int], times: int) -> bool:
        """Whether it had so many writes and so many queries answered since ``done`` was so."""
        return all(now >= then + times for now, then in zip(self.done, since, strict=True))

    @property
    def done(self) -> tuple[int, int]:
        """Writes and queries that were answered."""
        return self.answered, self.queries

    def run(self) -> None:
        while not self._over.is_set():
            try:
                match self._random.random():
                    case chance if chance < 0.3:
                        self._query()
                    case chance if chance < 0.5 and self._unanswered is not None:
                        self._look(*self._unanswered)
                    case _:
                        self._write()
            except StorageFailure:
                self.refused += 1
                time.sleep(0.05)

    def _write(self) -> None:
        """Enrol two places in one batch, or forget one; until the answer comes, what was and what will be may be."""
        ids = self._random.sample(sorted(self.may), 2)
        picture: str | None = f"picture {self._random.randrange(10**9)}"
        if self._random.random() < 0.2:
            ids, picture = ids[:1], None
        before = {name: self.may[name] for name in ids}
        if picture is None and before[ids[0]] == {None}:
            return
        for name in ids:
            self.may[name] = before[name] | {picture}
        if self._unanswered is not None and not set(ids).isdisjoint(self._unanswered[0]):
            self._unanswered = None
        if picture is None:
            try:
                self._client.forget(ids[0])
            except UnknownPlace:  # it was forgotten by a write that got no answer
                if None not in before[ids[0]]:
                    self.wrong.append(f"{ids[0]}, which shows one of {before[ids[0]]}, is lost")
        else:
            try:
                self._client.enrol(ids, picture)
            except StorageFailure:
                self._unanswered = ids, picture
                raise
        for name in ids:
            self.may[name] = {picture}
        self.answered += 1

    def _look(self, ids: list[str], picture: str) -> None:
        """A batch that got no answer is there whole or not at all, if nothing was written to its places since."""
        shown = self._client.digests()
        if len({shown.get(name) == digest_of(picture).hex() for name in ids}) > 1:
            self.wrong.append(f"half of {ids} with {picture} was written")
        self.looks += 1
        self._unanswered = None

    def _query(self) -> None:
        """A place whose picture is known is found first by it, and what is kept of it shows it."""
        known = [name for name, shows in self.may.items() if len(shows) == 1 and None not in shows]
        if known:
            name = self._random.choice(known)
            (picture,) = self.may[name]
            # Both places of a batch show the same picture; another place cannot be as near.
            first = self._client.first(str(picture))
            if name not in first:
                self.wrong.append(f"{name} with {picture} is not among {first}")
            self.queries += 1
            if self._random.random() < 0.3:
                try:
                    kept = self._client.picture(name)
                except UnknownPlace:
                    kept = "nothing, for it is lost"
                if kept != f"thumbnail of {picture}":
                    self.wrong.append(f"{name} with {picture} keeps {kept!r}")


@contextmanager
def running(loads: Sequence[PlaceLoad]) -> Iterator[None]:
    for load in loads:
        load.start()
    try:
        yield
    finally:
        for load in loads:
            load.stop()


def check(lab: Map, may: May) -> None:
    """Every place shows what it may show, is stored whole and is found."""
    outline, snapshot = lab.transfer.outline(), lab.snapshot()
    found = {place.id: place for place in outline}
    assert len(snapshot) == len(found)
    assert found.keys() <= may.keys(), f"{found.keys() - may.keys()} are there, and should not"
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

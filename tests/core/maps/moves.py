"""What every store does with an export file: a map that moves stays what it is."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from core.maps import MapSettings
from core.maps.archives.reading import Archive
from core.maps.forms import COMPRESSED
from core.store import Directory, Map, Store
from tests.core.store.archives.conftest import filled
from tests.core.store.frames import DIMENSION, ENCODER, LOCAL_SHAPE, descriptor_of, frame

ID = "moved"


def imported(store: Store, file: Path) -> Map:
    """The map ``moved``, made of an export file."""
    with Archive(file) as archive:
        store.import_map(archive, ID, lambda *_: None, lambda _: None, 10**6, lambda _: None)
    return store.get(ID)


def answers(map_: Map) -> list[list[tuple[str, float]]]:
    """All places by their inner products with some queries."""
    queries = np.stack([descriptor_of(name) for name in ("p0", "p3 from elsewhere", "nowhere")])
    found = []
    for rows, products in map_.scope().search(queries):
        places = map_.places_at(rows.tolist())
        found.append(
            [(place.id, round(float(score), 4)) for place, score in zip(places, products, strict=True) if place]
        )
    return found


def check_moves(there: Store, folder: Path, precision: str) -> None:
    """A map of a data directory moves to another store and back: three equal files, and the same answers."""
    here, back = Directory(folder / "here"), Directory(folder / "back")
    files = [folder / f"{number}.tar" for number in range(3)]
    if precision == "half":
        first = filled(here.create(ID, ENCODER, DIMENSION, MapSettings(), LOCAL_SHAPE))
    else:
        first = here.create(ID, ENCODER, DIMENSION, MapSettings(), LOCAL_SHAPE, precision=COMPRESSED)
        first.enrol([frame(f"p{number}", sequence="monday") for number in range(5)])
    try:
        first.exporter.write(files[0])
        second = imported(there, files[0])
        second.exporter.write(files[1])
        third = imported(back, files[1])
        third.exporter.write(files[2])
        assert files[0].read_bytes() == files[1].read_bytes() == files[2].read_bytes()
        assert answers(second) == answers(first) == answers(third)
        for place in second.places(None, 100)[0]:
            assert second.picture(place.id) == first.picture(place.id)
        assert there.verify(ID).ok and back.verify(ID).ok
        second.enrol([frame("new", sequence="monday")])
        assert second.count_places() == first.count_places() + 1
    finally:
        there.delete(ID)
        for store in (here, back):
            store.close()


def check_a_refused_import_leaves_nothing(store: Store, folder: Path) -> None:
    """An import that is refused at its very end leaves no map, and can be done again."""
    here, file = Directory(folder), folder / "lab.tar"
    filled(here.create(ID, ENCODER, DIMENSION, MapSettings(), LOCAL_SHAPE)).exporter.write(file)

    def refuse(_places: int) -> None:
        raise InterruptedError

    with Archive(file) as archive, pytest.raises(InterruptedError):
        store.import_map(archive, ID, lambda *_: None, lambda _: None, 10**6, refuse)
    assert ID not in [record.id for record in store.records(None, 1000)[0]]
    assert store.unlisted() == {}
    imported(store, file)
    store.delete(ID)
    here.close()

"""A map that moves between the stores stays what it is: the same file, byte for byte, and the same answers."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from core.maps import Map, MapSettings, Store
from core.maps.archives.reading import Archive
from core.milvus import open_store
from core.storage import Atlas
from core.storage.files.row_formats import COMPRESSED
from tests.core.milvus.servers import Servers
from tests.core.storage.archives.conftest import filled
from tests.core.storage.frames import DIMENSION, ENCODER, LOCAL_SHAPE, descriptor_of, frame

pytestmark = [pytest.mark.cluster, pytest.mark.timeout(600)]

ID = "moved"


def imported(store: Store, file: Path) -> Map:
    with Archive(file) as archive:
        store.import_map(archive, ID, lambda *_: None, lambda _: None, 10**6, lambda: None)
    return store.get(ID)


def answers(map_: Map) -> list[list[tuple[str, float]]]:
    """All places by their inner products with some queries."""
    asked = np.stack([descriptor_of(name) for name in ("p0", "p3 from elsewhere", "nowhere")])
    found = []
    for rows, products in map_.scope().search(asked):
        places = map_.places_at(rows.tolist())
        found.append(
            [(place.id, round(float(score), 4)) for place, score in zip(places, products, strict=True) if place]
        )
    return found


@pytest.mark.parametrize("precision", ["half", COMPRESSED])
def test_a_map_moves_there_and_back(servers: Servers, tmp_path: Path, precision: str) -> None:
    here, back = Atlas(tmp_path / "here"), Atlas(tmp_path / "back")
    there = open_store(servers.milvus_address, servers.postgres_address)
    files = [tmp_path / f"{number}.tar" for number in range(3)]
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
        assert there.verify(ID).ok and back.verify(ID).ok
        second.enrol([frame("new", sequence="monday")])
        assert second.count_places() == first.count_places() + 1
    finally:
        there.delete(ID)
        for store in (here, there, back):
            store.close()


def test_a_refused_import_leaves_nothing(servers: Servers, tmp_path: Path) -> None:
    here, store = Atlas(tmp_path), open_store(servers.milvus_address, servers.postgres_address)
    file = tmp_path / "lab.tar"
    filled(here.create(ID, ENCODER, DIMENSION, MapSettings(), LOCAL_SHAPE)).exporter.write(file)

    def refuse() -> None:
        raise InterruptedError

    with Archive(file) as archive, pytest.raises(InterruptedError):
        store.import_map(archive, ID, lambda *_: None, lambda _: None, 10**6, refuse)
    assert ID not in [record.id for record in store.records(None, 1000)[0]]
    assert store.unlisted() == {}
    imported(store, file)
    store.delete(ID)
    here.close()
    store.close()

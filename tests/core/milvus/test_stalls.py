"""A Milvus that stands still for a while, as one whose machine is paused or starved, goes on by itself."""

from __future__ import annotations

import time

import numpy as np
import pytest
from core.milvus import open_store
from core.milvus.map import MilvusMap

from core.errors import StorageFailure
from tests.core.store.frames import DIMENSION, ENCODER, LOCAL_SHAPE, descriptor_of, frame
from tests.servers.milvus import Servers

pytestmark = [pytest.mark.cluster, pytest.mark.timeout(300)]

STALL_SECONDS = 20.0
AGAIN_SECONDS = 60.0
ENDED_BY_SECONDS = 10.0
"""A Milvus whose sessions have expired meanwhile ends within a second of its going on."""


def found_first(lab: MilvusMap, name: str) -> str:
    """The place that a search with the picture of one finds first, when Milvus searches again."""
    until = time.monotonic() + AGAIN_SECONDS
    while True:
        try:
            ((rows, _),) = lab.scope().search(descriptor_of(name)[np.newaxis])
            (place,) = lab.places_at(rows[:1].tolist())
            return place.id if place is not None else ""
        except StorageFailure:
            if time.monotonic() > until:
                raise
            time.sleep(0.1)


def test_a_stall(servers: Servers) -> None:
    store = open_store(servers.milvus_address, servers.postgres_address)
    lab = store.create("stalled", ENCODER, DIMENSION, local_shape=LOCAL_SHAPE)
    lab.enrol([frame("a"), frame("b")])
    assert found_first(lab, "a") == "a"
    servers.milvus.stall(STALL_SECONDS)
    assert found_first(lab, "b") == "b"
    assert not servers.milvus.has_ended(within=ENDED_BY_SECONDS)
    lab.enrol([frame("c")])
    assert found_first(lab, "c") == "c"
    store.delete("stalled")
    store.close()

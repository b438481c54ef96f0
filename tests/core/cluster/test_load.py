"""The load and the comparison with the model see a loss, half a batch and a wrong picture."""

from __future__ import annotations

import time
from collections.abc import Iterator

import pytest

from core.errors import StorageFailure
from core.store import open_cluster
from core.store.cluster import Cluster
from tests.core.cluster.clients import StoreClient
from tests.core.cluster.load import May, PlaceLoad, check, running
from tests.core.store.frames import DIMENSION, ENCODER, LOCAL_SHAPE, frame
from tests.servers.postgres import Postgres

pytestmark = pytest.mark.postgres


@pytest.fixture
def store(postgres: Postgres) -> Iterator[Cluster]:
    """With two places."""
    postgres.empty()
    store = open_cluster(postgres.address)
    lab = store.create("lab", ENCODER, DIMENSION, local_shape=LOCAL_SHAPE)
    lab.enrol([frame("a", "picture 1"), frame("b", "picture 2")])
    yield store
    store.close()


def test_places_as_they_may_be(store: Cluster) -> None:
    may: May = {"a": {"picture 1", None}, "b": {"picture 3", "picture 2"}, "c": {None, "picture 4"}}
    check(store.get("lab"), may)
    assert may == {"a": {"picture 1"}, "b": {"picture 2"}, "c": {None}}  # known from now on


@pytest.mark.parametrize(
    ("may", "said"),
    [
        ({"a": {"picture 1"}, "b": {"picture 2"}, "c": {"picture 3"}}, "c, which shows one of .* is lost"),
        ({"a": {"picture 1"}, "b": {"picture 3", None}}, "b shows none of"),
        ({"a": {"picture 1"}}, "'b'.* are there, and should not"),
    ],
)
def test_places_as_they_may_not_be(store: Cluster, may: May, said: str) -> None:
    with pytest.raises(AssertionError, match=said):
        check(store.get("lab"), may)


class HalfWriter(StoreClient):
    """Writes half of each batch, and answers nothing."""

    def enrol(self, names: list[str], picture: str) -> None:
        super().enrol(names[:1], picture)
        raise StorageFailure("no answer")


class Loser(StoreClient):
    """Answers, and writes nothing."""

    def enrol(self, names: list[str], picture: str) -> None: ...


@pytest.mark.parametrize(("kind", "said"), [(HalfWriter, "half of "), (Loser, "is not among")])
def test_a_defect_is_seen_under_the_load(store: Cluster, kind: type[StoreClient], said: str) -> None:
    load = PlaceLoad(kind(store), "1", {name: {None} for name in "pqrs"})
    with running([load]):
        while not load.wrong:
            assert load.is_alive()
            time.sleep(0.01)
    assert said in load.wrong[0]

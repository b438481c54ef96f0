"""A map's descriptors in a real Milvus, which is asked for the first stage alone."""

from __future__ import annotations

import shutil
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from threading import Barrier
from typing import Any, cast

import numpy as np
import pytest
from numpy.typing import NDArray

from core.errors import StoreUnavailable
from core.index import FirstStage, milvus
from core.index.milvus import MOST_FOUND, MOST_LISTED, Milvus, MilvusCodes, indexing_for, search_settings
from core.places import NO_POSE, NO_SEQUENCE
from core.store.segment import Location
from core.store.snapshot import SHORTLIST, Snapshot
from tests.certificates import certify
from tests.core.index.made_up import Array
from tests.servers.milvus import MILVUS_SETTINGS, MilvusServer, running_milvus
from tests.service.stores.door import Door
from tests.service.wire import eventually

D = 64


def whole_numbers(count: int, seed: int = 0) -> Array:
    """Descriptors whose products are exact in float32, so that every way of adding them up gives the same order."""
    return np.random.default_rng(seed).integers(-300, 301, (count, D)).astype(np.float32)


ROWS = whole_numbers(12_000)
QUERIES = np.clip(ROWS[:9] + whole_numbers(9, seed=1) // 4, -300, 300)


@pytest.mark.parametrize(
    ("version", "half", "index"),
    [
        ("2.3.5-lite", False, "FLAT"),
        ("v2.4.0", True, "HNSW"),
        ("v2.5.12", True, "HNSW"),
        ("2.6.4", True, "IVF_RABITQ"),
        ("v2.10.1-dev", True, "IVF_RABITQ"),
        ("v3.0", True, "IVF_RABITQ"),
        ("milvus_lite-3.2.2", False, "FLAT"),
        ("", False, "FLAT"),
    ],
)
def test_the_index_is_chosen_by_the_version_of_the_server(version: str, half: bool, index: str) -> None:
    assert indexing_for(version)[:2] == (half, index)


@pytest.mark.parametrize("limit", [1, 135, MOST_FOUND])
def test_no_index_looks_at_fewer_than_are_wanted(limit: int) -> None:
    assert search_settings("HNSW", limit)["params"]["ef"] >= limit
    assert search_settings("IVF_RABITQ", limit)["params"]["refine_k"] >= 1
    assert search_settings("FLAT", limit) == {"metric_type": "IP", "params": {}}


def test_all_lists_are_searched_for_many_rows() -> None:
    lists = indexing_for("2.6.0")[2]["nlist"]
    assert search_settings("IVF_RABITQ", MOST_FOUND)["params"]["nprobe"] == lists


def test_without_a_server_it_is_said_at_once_and_again() -> None:
    away = Milvus("http://127.0.0.1:9")
    for _ in range(3):
        with pytest.raises(StoreUnavailable, match="Milvus cannot be reached"):
            away.codes("lab_1", D, 100)
    away.close()


@pytest.fixture(scope="module")
def server() -> Iterator[MilvusServer]:
    with running_milvus() as server:
        yield server


@pytest.fixture
def connected(server: MilvusServer) -> Iterator[Milvus]:
    """A Milvus without collections."""
    made = Milvus(server.address)
    made.drop(lambda uid: True)
    yield made
    made.close()


@pytest.fixture(scope="module")
def whole(server: MilvusServer) -> Iterator[MilvusCodes]:
    """All rows, in a database of Milvus of their own, which other tests do not empty."""
    apart = Milvus(server.address)
    with apart.using("make a database") as client:
        client.create_database("apart")
    apart.close()
    apart = Milvus(server.address, database="apart")
    yield filled(apart, ROWS)
    apart.close()


def filled(at: Milvus, rows: Array, uid: str = "lab_1", leave_out: frozenset[int] = frozenset()) -> MilvusCodes:
    """A map with these rows in Milvus, but for those that no place has any more."""
    codes = at.codes(uid, D, len(rows))
    missing = range(len(codes), len(rows))
    return codes.brought_up(((row, rows[row]) for row in missing if row not in leave_out), len(rows))


def best(of: Array, query: Array, count: int, allowed: NDArray[np.bool_] | None = None) -> list[int]:
    """The rows with the largest inner products."""
    products = of @ query
    chosen = np.arange(len(of)) if allowed is None else np.flatnonzero(allowed)
    return chosen[np.argsort(-products[chosen], kind="stable")][:count].tolist()


def found(stage: FirstStage, count: int = 20, allowed: NDArray[np.bool_] | None = None) -> list[list[int]]:
    return [one.rows.tolist() for one in stage.shortlists(QUERIES, count, allowed)]


def reserved(share: float) -> NDArray[np.bool_]:
    """Rows of which some share may be returned."""
    return np.random.default_rng(3).random(len(ROWS)) < share


@pytest.mark.cluster
@pytest.mark.parametrize("count", [1, 100, 1000])
def test_the_best_rows_are_found(whole: MilvusCodes, count: int) -> None:
    assert len(whole) == len(ROWS) and whole.memory == 0 and not whole.is_lost
    assert found(whole, count) == [best(ROWS, query, count) for query in QUERIES]
    for one, query in zip(whole.shortlists(QUERIES, count), QUERIES, strict=True):
        np.testing.assert_allclose(one.estimates, (ROWS @ query)[one.rows], rtol=0)


@pytest.mark.cluster
@pytest.mark.parametrize("share", [0.0, 0.001, 0.3, 0.4, 0.99, 1.0])
def test_only_allowed_rows_are_found(whole: MilvusCodes, share: float) -> None:
    allowed = reserved(share)
    assert found(whole, 20, allowed) == [best(ROWS, query, 20, allowed) for query in QUERIES]


@pytest.mark.cluster
@pytest.mark.parametrize("forbidden", [50, 2000, 7000])
def test_the_best_rows_may_be_forbidden(whole: MilvusCodes, forbidden: int) -> None:
    """As those of the sequence that a query belongs to: more are asked for than most queries need."""
    allowed = np.ones(len(ROWS), np.bool_)
    allowed[best(ROWS, QUERIES[0], forbidden)] = False
    assert np.count_nonzero(allowed) > MOST_LISTED
    assert found(whole, 20, allowed) == [best(ROWS, query, 20, allowed) for query in QUERIES]


@pytest.mark.cluster
def test_many_allowed_rows_that_are_all_far_away_are_named(whole: MilvusCodes, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(milvus, "MOST_FOUND", 4000)
    allowed = np.ones(len(ROWS), np.bool_)
    allowed[best(ROWS, QUERIES[0], 7000)] = False
    assert np.count_nonzero(allowed) > MOST_LISTED
    assert found(whole, 20, allowed) == [best(ROWS, query, 20, allowed) for query in QUERIES]


@pytest.mark.cluster
def test_more_queries_than_a_message_takes(whole: MilvusCodes, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(milvus, "_AT_ONCE", 4)
    assert found(whole) == [best(ROWS, query, 20) for query in QUERIES]
    assert whole.shortlists(QUERIES[:0], 20) == []


@pytest.mark.cluster
@pytest.mark.parametrize(
    ("queries", "allowed"), [(QUERIES[:, 1:], None), (QUERIES[0], None), (QUERIES, np.ones(11_999, np.bool_))]
)
def test_what_does_not_fit_is_refused(whole: MilvusCodes, queries: Array, allowed: NDArray[np.bool_] | None) -> None:
    with pytest.raises(ValueError, match="of all 12000 rows, and a query has 64 values"):
        whole.shortlists(queries, 20, allowed)


@pytest.mark.cluster
def test_a_snapshot_is_searched_as_one_with_codes_in_memory(whole: MilvusCodes) -> None:
    """Rows that Milvus does not have yet are compared exactly."""
    where = [Location(NO_POSE, (0.0, 0.0, 0.0), NO_SEQUENCE, 0)] * 300
    extra = whole_numbers(300, seed=5)
    base = Snapshot(D, 4096)
    for part in np.split(ROWS, 40):
        base = base.appended(part, where)
    ours = Snapshot(D, 4096, base.segments, table=cast(Any, whole))
    ours = ours.appended(extra, where).without([7, 12_007])
    assert ours.coded == len(ROWS) and ours.rows == 12_300
    every, alive = np.concatenate([ROWS, extra]), np.ones(12_300, np.bool_)
    alive[[7, 12_007]] = False
    for query, (rows, products) in zip(QUERIES, ours.search_batch(QUERIES), strict=True):
        assert rows[:SHORTLIST].tolist() == best(every, query, SHORTLIST, alive)
        np.testing.assert_allclose(products, every[rows] @ query, rtol=0)


@pytest.mark.cluster
@pytest.mark.parametrize("count", [0, 1, 2, 255, 256, 257, 1000])
def test_how_many_rows_there_are_is_asked(connected: Milvus, count: int) -> None:
    filled(connected, ROWS[:count])
    other = Milvus(connected._given["uri"])  # another service
    for rows in {count, count + 1, 3 * count, max(0, count - 1)}:
        assert len(other.codes("lab_1", D, rows)) == min(count, rows)
    other.close()


@pytest.mark.cluster
def test_rows_are_added_and_an_older_value_does_not_find_them(connected: Milvus) -> None:
    first = filled(connected, ROWS[:300])
    second = filled(connected, ROWS[:700], leave_out=frozenset(range(400, 500)))
    assert (len(first), len(second)) == (300, 700)
    assert found(first, 300) == [best(ROWS[:300], query, 300) for query in QUERIES]
    there = np.ones(700, np.bool_)
    there[400:500] = False
    assert found(second, 700) == [best(ROWS[:700], query, 700, there) for query in QUERIES]
    assert second.appended(second.coder.encode(ROWS[700:710])) is second


@pytest.mark.cluster
def test_the_last_rows_without_a_place_are_given_again_to_nobody(connected: Milvus) -> None:
    filled(connected, ROWS[:300], leave_out=frozenset(range(290, 300)))
    assert len(connected.codes("lab_1", D, 300)) == 290
    assert len(filled(connected, ROWS[:300], leave_out=frozenset(range(290, 300)))) == 300


@pytest.mark.cluster
def test_maps_do_not_find_each_others_rows(connected: Milvus) -> None:
    one, other = filled(connected, ROWS[:200], "lab_1"), filled(connected, ROWS[200:400], "lab_1_2")
    assert found(one, 200) == [best(ROWS[:200], query, 200) for query in QUERIES]
    assert found(other, 200) == [best(ROWS[200:400], query, 200) for query in QUERIES]


@pytest.mark.cluster
def test_services_that_fill_a_map_at_the_same_time_make_one_collection(connected: Milvus, server: MilvusServer) -> None:
    services, begin = [Milvus(server.address) for _ in range(4)], Barrier(4)

    def fill(service: Milvus) -> MilvusCodes:
        begin.wait()
        return filled(service, ROWS[:1500])

    with ThreadPoolExecutor(4) as threads:
        tables = list(threads.map(fill, services))
    assert len({table.made for table in tables}) == 1
    for table in tables:
        assert found(table, 1500) == [best(ROWS[:1500], query, 1500) for query in QUERIES]
    with connected.using("list collections") as client:
        assert client.list_collections() == [tables[0].made.name if tables[0].made else ""]
    for service in services:
        service.close()


@pytest.mark.cluster
def test_rows_that_are_deleted_are_gone(connected: Milvus) -> None:
    codes = filled(connected, ROWS[:1000])
    connected.delete("lab_1", range(0, 1000, 2))
    connected.delete("lab_2", [1])  # it has no collection
    left = np.arange(1000) % 2 == 1
    assert found(codes, 1000) == [best(ROWS[:1000], query, 1000, left) for query in QUERIES]


def drop_all(at: Milvus, server: MilvusServer) -> None:
    other = Milvus(server.address)
    assert other.drop(lambda uid: uid == "lab_1") == 1
    other.close()


def release(at: Milvus, server: MilvusServer) -> None:
    with at.using("release") as client:
        client.release_collection("placerec_lab_1")


def make_again(at: Milvus, server: MilvusServer) -> None:
    drop_all(at, server)
    other = Milvus(server.address)
    filled(other, ROWS[:200])
    other.close()


@pytest.mark.cluster
@pytest.mark.parametrize("lose", [drop_all, release, make_again])
def test_what_was_lost_is_noticed_and_given_again(
    connected: Milvus, server: MilvusServer, lose: Callable[[Milvus, MilvusServer], None]
) -> None:
    codes = filled(connected, ROWS[:300])
    lose(connected, server)
    for _ in range(2):
        with pytest.raises(StoreUnavailable, match="has lost a map's descriptors"):
            found(codes)
    assert codes.is_lost
    again = filled(connected, ROWS[:300])
    assert not again.is_lost and len(again) == 300
    assert found(again) == [best(ROWS[:300], query, 20) for query in QUERIES]


@pytest.mark.cluster
def test_rows_of_a_history_that_was_lost_are_found_by_nobody(connected: Milvus) -> None:
    """A store was restored with 200 of 300 rows, and others came after them, the last of which Milvus was not given."""
    lost = filled(connected, ROWS[:300])
    now = np.concatenate([ROWS[:200], ROWS[1000:1050]])
    codes = connected.codes("lab_1", D, 200, (199, now[199]))
    assert len(codes) == 200 and not lost.is_lost
    after = codes.brought_up(enumerate(now[200:240], 200), 240)
    assert found(after, 240) == [best(now[:240], query, 240) for query in QUERIES]
    assert len(connected.codes("lab_1", D, 240, (239, now[239]))) == 240
    opened = connected.codes("lab_1", D, 250, (249, now[249]))
    assert len(opened) == 0
    assert found(opened.brought_up(enumerate(now), 250), 250) == [best(now, query, 250) for query in QUERIES]
    with pytest.raises(StoreUnavailable, match="has lost a map's descriptors"):
        found(lost)


@pytest.mark.cluster
def test_collections_of_maps_that_are_gone_are_dropped(connected: Milvus) -> None:
    for uid in ("store_1", "store_2", "other_1"):
        filled(connected, ROWS[:10], uid)
    with connected.using("make a collection") as client:
        client.create_collection("placerec_of_another_kind", dimension=8)
    assert connected.drop(lambda uid: uid.startswith("store_") and uid != "store_2") == 1
    sizes = [len(connected.codes(uid, D, 10)) for uid in ("store_1", "store_2", "other_1")]
    assert sizes == [0, 10, 10]
    with connected.using("drop a collection") as client:
        assert client.has_collection("placerec_of_another_kind")
        client.drop_collection("placerec_of_another_kind")


@pytest.mark.cluster
def test_a_search_sees_every_row_when_the_last_ones_are_old(connected: Milvus, monkeypatch: pytest.MonkeyPatch) -> None:
    codes = filled(connected, ROWS[:300])
    assert found(codes) == [best(ROWS[:300], query, 20) for query in QUERIES]  # Milvus has taken everything up
    monkeypatch.setattr(milvus, "RECENT_SECONDS", 0.0)
    assert found(codes) == [best(ROWS[:300], query, 20) for query in QUERIES]


@pytest.mark.cluster
def test_a_milvus_that_goes_away_and_comes_back(connected: Milvus, server: MilvusServer) -> None:
    filled(connected, ROWS[:300])
    door = Door(server.address)
    door.open()
    behind = Milvus(door.address)
    codes = behind.codes("lab_1", D, 300)
    expected = [best(ROWS[:300], query, 20) for query in QUERIES]
    assert found(codes) == expected
    door.shut()
    for _ in range(2):
        with pytest.raises(StoreUnavailable, match="Milvus cannot be reached"):
            found(codes)
        with pytest.raises(StoreUnavailable, match="Milvus cannot be reached"):
            behind.check()
    assert not codes.is_lost
    door.open()

    def finds() -> bool:
        try:
            return found(codes) == expected
        except StoreUnavailable:
            return False

    assert eventually(finds, 60)
    behind.check()
    behind.close()


@pytest.mark.cluster
@pytest.mark.timeout(600)
def test_a_milvus_that_is_killed_has_what_it_was_given(connected: Milvus, server: MilvusServer) -> None:
    codes = filled(connected, ROWS[:300])
    server.process.kill()
    with pytest.raises(StoreUnavailable):
        filled(connected, ROWS[:600])
    server.process.start()

    def has_all() -> bool:
        try:
            return found(codes) == [best(ROWS[:300], query, 20) for query in QUERIES]
        except StoreUnavailable:
            return False

    assert eventually(has_all, 300)
    assert len(filled(connected, ROWS[:600])) == 600


@pytest.mark.cluster
@pytest.mark.skipif(shutil.which("openssl") is None, reason="openssl is not installed")
def test_each_refusal_is_said_and_ends_when_it_is_put_right(tmp_path: Path) -> None:
    for name in ("own", "other"):
        (tmp_path / name).mkdir()
        certify(tmp_path / name)
    (folder := tmp_path / "milvus").mkdir()
    settings = {
        "common.security.authorizationEnabled": "true",
        "common.security.tlsMode": "1",
        "tls.serverPemPath": str(tmp_path / "own/server.pem"),
        "tls.serverKeyPath": str(tmp_path / "own/server.key"),
    }
    server = MilvusServer(folder, {**MILVUS_SETTINGS, **settings})
    authority, plain = tmp_path / "own/authority.pem", server.address
    server.address = plain.replace("http://127.0.0.1", "https://localhost")
    server.token, server.certificate = "root:Milvus", str(authority)  # Milvus's own at its first start
    trusted = Path(shutil.copy(tmp_path / "other/authority.pem", tmp_path / "trusted.pem"))
    robot = Milvus(server.address, "robot:its-own-token", certificate=str(trusted))

    def says(text: str) -> None:
        assert eventually(lambda: text in _refusal(robot), 60), _refusal(robot)

    server.process.start()
    try:
        says("Milvus has a certificate that cannot be trusted")
        trusted.unlink()
        says("Milvus cannot be reached")
        shutil.copy(authority, trusted)
        says("Milvus refuses the token")
        with Milvus(server.address, server.token, certificate=server.certificate).using("administer") as administrator:
            administrator.create_user("robot", "its-own-token")
            says("the token's user has no right to")
            administrator.grant_role("robot", "admin")
        says("nothing")
        assert len(filled(robot, ROWS[:10])) == 10
        without = Milvus(plain, "robot:its-own-token")
        assert "closes the connection, as one does that wants TLS" in _refusal(without)
    finally:
        server.process.end()


def _refusal(of: Milvus) -> str:
    """What a Milvus says that is to make a map's collection, without what is secret."""
    try:
        of.make("tried", D)
    except StoreUnavailable as error:
        assert "its-own-token" not in str(error)
        return str(error)
    return "nothing"

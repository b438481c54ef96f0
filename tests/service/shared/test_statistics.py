"""Statistics, latest answers and live events of services that share them."""

from __future__ import annotations

import inspect
import json
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import Any

import pytest

from service.queries.given_answers import MOST_OF_MAP, GivenAnswer, QueriedFrame
from service.shared.database import SharedDatabase
from service.shared.statistics import SharedAnswers, SharedStatistics
from tests.service.queries import test_statistics as embedded
from tests.service.queries.test_given_answers import ANSWER
from tests.service.queries.test_statistics import Maps
from tests.service.scenes import blank, encoded, jpeg
from tests.service.server import Server
from tests.service.shared.postgres import Postgres
from tests.service.shared.services import MAP, two_services

pytestmark = [pytest.mark.cluster]

CONTRACT: list[Callable[..., None]] = [
    embedded.test_counts_survive_a_restart,
    embedded.test_the_moments_of_writing_do_not_matter,
    embedded.test_counts_of_deleted_maps_are_dropped_and_of_quarantined_maps_kept,
    embedded.test_counts_of_deleted_places_are_dropped,
    embedded.test_old_weeks_are_dropped,
    embedded.test_counts_of_one_place,
]

ASKED = f"/v1/maps/{MAP}/answers"


@pytest.mark.parametrize("test", CONTRACT, ids=lambda test: test.__name__)
def test_counted_as_in_a_data_directory(
    test: Callable[..., None],
    database: SharedDatabase,
    tmp_path: Path,
    tmp_path_factory: pytest.TempPathFactory,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    begun: set[Path] = set()

    def counting(folder: Path, maps: Maps) -> SharedStatistics:
        if folder not in begun:
            database.query("empty the table", "TRUNCATE service.counted_maps CASCADE")
            begun.add(folder)
        counted = SharedStatistics(folder, 3600, lambda: maps.sizes, lambda _: maps.present)
        counted.share(database)
        return counted

    monkeypatch.setattr(embedded, "counting", counting)
    given = {"tmp_path": tmp_path, "tmp_path_factory": tmp_path_factory, "maps": Maps()}
    test(**{name: given[name] for name in inspect.signature(test).parameters})


def soon(check: Callable[[], Any]) -> Any:
    """What a check gives as soon as it is true."""
    until = time.monotonic() + 20
    while not (found := check()):
        assert time.monotonic() < until
        time.sleep(0.05)
    return found


@contextmanager
def listening(server: Server) -> Iterator[list[tuple[str, dict[str, Any]]]]:
    """The events of the map, as they come."""
    heard: list[tuple[str, dict[str, Any]]] = []
    begun, name = threading.Event(), ""

    def read() -> None:
        nonlocal name
        with server.client.stream("GET", f"/v1/maps/{MAP}/events", timeout=60) as response:
            try:
                for line in response.iter_lines():
                    if line.startswith("event: "):
                        name = line.removeprefix("event: ")
                    elif line.startswith("data: "):
                        heard.append((name, json.loads(line.removeprefix("data: "))))
                        begun.set()
            except Exception as error:  # the server was ended
                heard.append(("ended", {"error": str(error)}))

    thread = threading.Thread(target=read, daemon=True)
    thread.start()
    assert begun.wait(20)
    yield heard


def test_what_one_answers_the_other_shows(
    prepared: Path, tmp_path: Path, postgres: Postgres, database: SharedDatabase
) -> None:
    with two_services(prepared, tmp_path, postgres.address, {}) as (one, other), listening(other) as heard:
        soon(lambda: database.query("look", "SELECT 1 FROM service.listening"))
        time.sleep(0.2)  # until the other one knows
        asked = [one.query(MAP, jpeg(number)) for number in range(3)]
        blank_one = other.query(MAP, encoded(blank()))
        verdicts = [answer["verdict"] for answer in (*asked, blank_one)]

        told = soon(lambda: len(queries := [event for kind, event in heard if kind == "query"]) == 4 and queries)
        assert sorted(event["verdict"] for event in told) == sorted(verdicts)
        assert {event["best"] for event in told} == {"p0", "p1", "p2", None}
        made = one.client.post(f"/v1/maps/{MAP}/sessions", json={}).json()["id"]
        soon(lambda: [event for kind, event in heard if kind == "session" and event["session"] == made])

        for server in (one, other):
            page = soon(partial(_kept, server, 4))
            assert sorted(item["verdict"] for item in page["items"]) == sorted(verdicts)
            soon(partial(_counted, server, len(verdicts)))
            counted = server.client.get(f"/v1/maps/{MAP}/places/p1/matches").json()
            assert counted["best"] == 1
        one.kill()
        assert _counted(other, len(verdicts)) and _kept(other, 4)


def _kept(server: Server, count: int) -> dict[str, Any] | None:
    page: dict[str, Any] = server.client.get(ASKED).json()
    return page if page["kept"] == count else None


def _counted(server: Server, count: int) -> bool:
    hours = server.client.get(ASKED).json()["hours"]
    return count == sum(hour[verdict] for hour in hours for verdict in ("recognized", "ambiguous", "unknown"))


def test_the_latest_answers_are_bounded(database: SharedDatabase) -> None:
    one, other = SharedAnswers(database), SharedAnswers(database)
    for number in range(MOST_OF_MAP + 20):
        (one, other)[number % 2].add(("lab", "2026"), GivenAnswer.of(ANSWER, QueriedFrame(number=number)))
    other.add(("hall", "2026"), GivenAnswer.of(ANSWER, QueriedFrame("front", "s-1", 7)))
    other.flush()
    kept = one.of_map(("lab", "2026"))
    assert len(kept) == MOST_OF_MAP and {answer.reason for answer in kept} == {ANSWER.reason}
    assert [answer.frame for answer in one.of_map(("hall", "2026"))] == [QueriedFrame("front", "s-1", 7)]
    rows = database.query("count", "SELECT count(*) FROM service.answers")
    assert rows == [(MOST_OF_MAP + 1,)]

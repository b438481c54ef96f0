"""More than it can do: those that are taken are answered, the others are told so at once."""

from __future__ import annotations

import json
import re
from concurrent.futures import ThreadPoolExecutor

from tests.service.scenes import jpeg
from tests.service.server import Server, assert_problem
from tests.service.wire import answer, get, opened, post


def test_of_64_callers_on_a_queue_of_8_each_is_answered_or_told_to_come_again(strict: Server) -> None:
    if strict.client.get("/v1/maps/overload").status_code == 404:
        strict.create_map("overload")
        assert strict.enrol("overload", "p", jpeg(1)).status_code == 201
    request = post("/v1/maps/overload/query?k=1", jpeg(1))

    def call(number: int) -> tuple[int, bytes]:
        caller = opened(strict, f"127.0.0.{2 + number % 5}")
        caller.sendall(request)
        found = answer(caller)
        caller.sendall(get("/livez"))  # a refusal costs nobody the connection
        assert answer(caller)[0] == 200
        caller.close()
        return found

    with ThreadPoolExecutor(64) as callers:
        answers = list(callers.map(call, range(64)))
    statuses = [status for status, _ in answers]
    assert set(statuses) == {200, 503} and statuses.count(200) >= 8
    for status, head in answers:
        if status == 503:
            found = re.search(rb"(?i)\r\nretry-after: (\d+)", head)
            assert found is not None and 1 <= int(found[1]) <= 3
    shed = re.search(r'placerec_problems_total\{type="queue-full"\} (\S+)', strict.client.get("/metrics").text)
    assert shed is not None and float(shed[1]) >= statuses.count(503)


def test_there_are_no_more_maps_and_places_than_may_be(strict: Server) -> None:
    server = strict
    server.create_map("one")
    made: list[str] = []
    while (full := server.client.post("/v1/maps", json={"id": f"more-{len(made)}"})).status_code == 201:
        made.append(f"more-{len(made)}")
    assert full.status_code == 409 and full.json()["type"].endswith(":too-many-maps")
    for name in made:
        assert server.client.delete(f"/v1/maps/{name}").status_code == 204
    for number in range(3):
        assert server.enrol("one", f"p{number}", jpeg(number)).status_code == 201
    more = server.enrol("one", "p3", jpeg(3))
    assert more.status_code == 409 and more.json()["type"].endswith(":too-many-places")
    assert server.enrol("one", "p1", jpeg(4)).status_code == 200, "one that it has may be given another frame"
    places = json.dumps([{"id": "p1", "file": "a"}, {"id": "p9", "file": "b"}])
    files = {"a": ("a.jpg", jpeg(5), "image/jpeg"), "b": ("b.jpg", jpeg(6), "image/jpeg")}
    batch = server.client.post("/v1/maps/one/places", data={"places": places}, files=files)
    assert batch.status_code == 409, batch.text
    assert len(server.client.get("/v1/maps/one/places").json()["items"]) == 3


def test_a_full_map_with_looks_can_be_imported_and_a_fuller_one_cannot(server: Server, strict: Server) -> None:
    """A file counts looks as well, which are no places."""
    map_id, tar = server.create_map("full-of-places")["id"], {"Content-Type": "application/x-tar"}
    for number in range(3):
        server.enrol(map_id, f"p{number}", jpeg(number))
    looks = f"/v1/maps/{map_id}/places/p1/looks"
    server.client.post(looks, content=jpeg(7), headers={"Content-Type": "image/jpeg"}).raise_for_status()
    three = server.client.get(f"/v1/maps/{map_id}/export").content
    server.enrol(map_id, "p3", jpeg(3))
    four = server.client.get(f"/v1/maps/{map_id}/export").content
    made = strict.client.post("/v1/maps/import", params={"id": "three"}, content=three, headers=tar)
    assert made.status_code == 201 and made.json()["places"] == 3
    refused = strict.client.post("/v1/maps/import", params={"id": "four"}, content=four, headers=tar)
    assert "has 4 places" in assert_problem(refused, 409, "too-many-places")["detail"]
    assert strict.client.get("/v1/maps/four").status_code == 404
    strict.client.delete("/v1/maps/three")
    server.client.delete(f"/v1/maps/{map_id}")

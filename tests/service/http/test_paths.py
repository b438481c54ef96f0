"""Raw paths, as no client should write them: none reaches another operation than the one that it spells."""

from __future__ import annotations

import asyncio
import re
from contextlib import nullcontext
from typing import Any

import httpx
import pytest
from starlette.exceptions import HTTPException
from starlette.types import Receive, Scope, Send

from service.app.application import WholeSegments
from tests.clients.python.models import operations
from tests.service.scenes import jpeg
from tests.service.server import Server, assert_problem
from tests.service.wire import answer, opened

SPELLINGS = (
    ".",
    "..",
    "%2e",
    "%2E%2e",
    ".%2e",
    "p%2F..",
    "..%2Fp",
    "p%2fthumbnail",
    "%2F",
    "",
    "/p",
    "p/",
    "%00",
    "..;",
)
"""Of a segment that a name stands in."""

DEEPER = ("lab%2Fplaces%2Fp", "lab%2fsequences%2Fmonday", "lab%2Fcameras%2Ffront", "lab/places%2Fp", "lab%2F")
"""Of the path of something within a map, as if it were the map's."""


@pytest.fixture
def lab(server: Server, map_id: str) -> str:
    """A map with a place of a traverse, a camera and a session."""
    assert server.enrol(map_id, "p", jpeg(1), sequence="monday").status_code == 201
    front: dict[str, Any] = {"mask": {"polygons": [[[0, 0.9], [1, 0.9], [1, 1]]]}}
    server.client.put(f"/v1/maps/{map_id}/cameras/front", json=front).raise_for_status()
    server.client.post(f"/v1/maps/{map_id}/sessions", json={}).raise_for_status()
    return map_id


def there(server: Server, lab: str) -> list[Any]:
    """All that could be deleted."""
    held = [server.client.get(f"/v1/maps/{lab}/{kind}").json()["items"] for kind in ("places", "cameras", "sessions")]
    return [server.client.get(f"/v1/maps/{lab}").json()["revision"], *held]


def statuses(server: Server, method: str, paths: list[str]) -> list[tuple[str, int]]:
    """How raw paths are answered."""
    connection = opened(server)
    found = []
    for path in paths:
        connection.sendall(f"{method} {path} HTTP/1.1\r\nHost: localhost\r\nContent-Length: 0\r\n\r\n".encode())
        found.append((path, answer(connection)[0]))
    connection.close()
    return found


@pytest.mark.parametrize("method", ["DELETE", "GET"])
def test_no_spelling_of_a_name_reaches_another_operation(server: Server, lab: str, method: str) -> None:
    before = there(server, lab)
    templates = [path.replace("{map}", lab) for of, path, _ in operations() if of == method and "{" in path]
    paths = []
    for template in templates:
        if (hole := re.search(r"\{\w+\}", template)) is not None:
            rest = re.sub(r"\{\w+\}", "p", template[hole.end() :])
            paths += [template[: hole.start()] + one + rest for one in SPELLINGS]
        elif lab in template:
            paths += [template.replace(lab, one) for one in (f"{lab}%2F..%2F{lab}", f"..%2f{lab}", f"{lab}/../{lab}")]
    paths += ["/v1/maps/" + one.replace("lab", lab) for one in DEEPER]
    assert len(paths) > 50
    wrong = [(path, status) for path, status in statuses(server, method, paths) if status not in (404, 405, 422)]
    assert wrong == []
    assert there(server, lab) == before


def assert_told(response: httpx.Response) -> None:
    """A name is refused in words."""
    detail = assert_problem(response, 422, "invalid-request")["detail"]
    assert re.search(r"cannot name a \w+: a name has 1 to \d+ characters[^\[]+\.$", detail), detail


def test_a_name_is_refused_where_it_is_given(server: Server, lab: str) -> None:
    for name in (".", "..", "\n", "\x85", "\u202e", "a/b", "\u2066x"):
        assert_told(server.enrol(lab, "q", jpeg(2), sequence=name))
        assert_told(server.enrol(lab, "q", jpeg(2), camera=name))
        assert_told(server.client.patch(f"/v1/maps/{lab}/places/p", json={"sequence": name}))
        form = {"q": ("q", jpeg(2), "image/jpeg")}
        assert_told(server.client.post(f"/v1/maps/{lab}/places", params={"batch": name}, files=form))
        for path, body in (
            ("align", {"sequence": name}),
            ("prune", {"sequence": name}),
            ("merge", {"from": "other", "prefix": name}),
            ("sessions", {"sequences": [name]}),
            ("sessions", {"camera": name}),
        ):
            assert_told(server.client.post(f"/v1/maps/{lab}/{path}", json=body))
    assert list(server.places(lab)) == ["p"]


def test_a_filter_finds_nothing_by_what_is_no_name(server: Server, lab: str) -> None:
    for name in (".", "..", "\x85", "\u202e", "a/b"):
        assert server.client.get(f"/v1/maps/{lab}/places", params={"sequence": name}).json()["items"] == []
        order = {"filter": {"sequence": name}, "dry_run": False}
        assert server.client.post(f"/v1/maps/{lab}/places:delete", json=order).json()["places"] == 0
        path, parameters = f"/v1/maps/{lab}/query", {"sequences": name}
        asked = server.client.post(path, params=parameters, content=jpeg(1), headers={"Content-Type": "image/jpeg"})
        assert asked.status_code == 422


def test_a_deletion_that_says_more_than_its_path_deletes_nothing(server: Server, lab: str) -> None:
    before = there(server, lab)
    paths = [re.sub(r"\{\w+\}", "p", path.replace("{map}", lab)) for of, path, _ in operations() if of == "DELETE"]
    assert f"/v1/maps/{lab}" in paths and len(paths) > 4
    for path in paths:
        for parameters in ({"place": "p"}, {"dry_run": "true"}):
            refused = server.client.delete(path, params=parameters)
            assert refused.status_code == 422 and "nothing was deleted" in refused.json()["detail"], path
        assert server.client.request("DELETE", path, json={"ids": ["p"]}).status_code == 422, path
    assert there(server, lab) == before


@pytest.mark.parametrize("raw", [{}, {"raw_path": None}, {"raw_path": b"/v1/maps"}, {"raw_path": b"/v1%2Fmaps"}])
def test_a_server_need_not_tell_the_path_as_it_came(raw: dict[str, Any]) -> None:
    passed: list[Scope] = []

    async def inner(scope: Scope, receive: Receive, send: Send) -> None:
        passed.append(scope)

    async def unused(*_: Any) -> Any:
        raise AssertionError

    scope = {"type": "http", "method": "GET", "path": "/v1/maps", "headers": [], **raw}
    whole = raw.get("raw_path") != b"/v1%2Fmaps"
    with nullcontext() if whole else pytest.raises(HTTPException):
        asyncio.run(WholeSegments(inner)(scope, unused, unused))
    assert passed == ([scope] if whole else [])

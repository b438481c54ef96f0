"""What is read straight means the same as what the framework reads: its answers, and its refusals."""

from __future__ import annotations

from typing import Any

import pytest

from service.http.routing import KEPT, LONGEST_KEPT, _Reader
from service.queries.parameters import QueryParameters
from tests.service.scenes import jpeg
from tests.service.server import Server, assert_problem, typed

CAREFUL = {"X-Request-Timeout": "30"}
"""A caller's own deadline sends the request the framework's way."""


def ask(server: Server, map_id: str, query: str, **headers: str) -> Any:
    data = jpeg(3)
    return server.client.post(f"/v1/maps/{map_id}/query{query}", content=data, headers={**typed(data), **headers})


@pytest.mark.parametrize("query", ["", "?k=3", "?k=2&x=4&y=0&radius=30", "?encoder=m-region-vlad", "?sequence=monday"])
def test_both_ways_answer_alike(server: Server, traverse: str, query: str) -> None:
    quick, careful = ask(server, traverse, query), ask(server, traverse, query, **CAREFUL)
    assert quick.status_code == careful.status_code
    assert quick.headers["content-type"] == careful.headers["content-type"]
    one, other = quick.json(), careful.json()
    assert list(one) == list(other)
    for name in ("milliseconds", "request_id"):
        one.pop(name, None), other.pop(name, None)
    assert one == other


@pytest.mark.parametrize(
    "query", ["?k=0", "?k=many", "?k=1&k=2", "?unknown=1", "?explain=perhaps", "?" + "x" * 300, "?k=%ff"]
)
def test_both_ways_refuse_alike(server: Server, traverse: str, query: str) -> None:
    quick = assert_problem(ask(server, traverse, query), 422, "invalid-request")
    careful = assert_problem(ask(server, traverse, query, **CAREFUL), 422, "invalid-request")
    assert quick["detail"] == careful["detail"]


def test_a_name_that_is_no_map_is_refused(server: Server) -> None:
    statuses = {ask(server, "No%20Map", "", **headers).status_code for headers in ({}, CAREFUL)}
    assert len(statuses) == 1 and statuses <= {404, 422}
    assert_problem(ask(server, "absent", ""), 404, "unknown-map")


def test_what_is_kept_is_bounded() -> None:
    read = _Reader(QueryParameters)
    assert read(b"k=3") is read(b"k=3")
    for index in range(3 * KEPT):
        assert read(f"k={1 + index % 100}&encoder=e{index}".encode()) is not None
    assert len(read._kept) <= KEPT
    long = b"encoder=" + b"e" * LONGEST_KEPT
    before = len(read._kept)
    read(long)
    assert len(read._kept) == before
    assert read(b"k=1&k=2") is None and read(b"k=0") is None and read(b"nothing=1") is None

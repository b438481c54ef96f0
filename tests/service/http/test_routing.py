"""Query strings that are refused."""

from __future__ import annotations

from typing import Any

import pytest

from tests.service.scenes import jpeg
from tests.service.server import Server, assert_problem, typed


def ask(server: Server, map_id: str, query: str) -> Any:
    data = jpeg(3)
    return server.client.post(f"/v1/maps/{map_id}/query{query}", content=data, headers=typed(data))


@pytest.mark.parametrize(
    "query", ["?k=0", "?k=many", "?k=1&k=2", "?unknown=1", "?explain=perhaps", "?" + "x" * 300, "?k=%ff"]
)
def test_a_parameter_that_is_none_is_refused(server: Server, traverse: str, query: str) -> None:
    assert_problem(ask(server, traverse, query), 422, "invalid-request")


def test_a_name_that_is_no_map_is_refused(server: Server) -> None:
    assert ask(server, "No%20Map", "").status_code in (404, 422)
    assert_problem(ask(server, "absent", ""), 404, "unknown-map")

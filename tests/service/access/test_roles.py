"""The rules of the operations: every endpoint of the application has a rule, and every rule an endpoint."""

from __future__ import annotations

import re
from typing import Any

import pytest

from service.access.gate import Endpoint, endpoints_of
from service.access.roles import OPERATIONS, Role, Rule, covers
from service.app.application import create_app
from service.settings import Settings

OPEN = {
    *("check_liveness", "check_readiness", "read_version", "read_openapi"),
    *("read_documentation", "read_documentation_file", "read_console", "find_console", "read_console_file"),
}
READING = {"GET", "HEAD"}


@pytest.fixture(scope="module")
def endpoints() -> list[Endpoint]:
    return endpoints_of(create_app(Settings(host="127.0.0.1")).routes)


@pytest.fixture(scope="module")
def described() -> dict[str, Any]:
    return create_app(Settings(host="127.0.0.1")).openapi()


def test_every_route_has_a_row_and_every_row_a_route(endpoints: list[Endpoint]) -> None:
    there = {endpoint.operation for endpoint in endpoints}
    assert there - set(OPERATIONS) == set(), "a route without a role: say in service/access/roles.py who may use it"
    assert set(OPERATIONS) - there == set(), "a role without a route"
    assert {"WEBSOCKET", "GET", "POST", "PUT", "PATCH", "DELETE"} <= {endpoint.method for endpoint in endpoints}


def test_no_two_operations_have_one_name(endpoints: list[Endpoint]) -> None:
    assert len({(endpoint.method, endpoint.path) for endpoint in endpoints}) == len(endpoints)
    paths = {endpoint.operation: endpoint.path for endpoint in endpoints}
    assert all(paths[endpoint.operation] == endpoint.path for endpoint in endpoints), (
        "the second would have the first one's role"
    )


def test_what_is_open_to_all_is_named_here_too() -> None:
    assert {operation for operation, rule in OPERATIONS.items() if rule.role == "open"} == OPEN


def test_a_route_below_a_map_is_held_to_it(endpoints: list[Endpoint]) -> None:
    for endpoint in endpoints:
        below = "{map}" in endpoint.path
        assert (endpoint.rule.maps in ("path", "named")) >= below, (
            f"{endpoint.operation}: the map in its path is not looked at"
        )
        assert below or endpoint.rule.maps != "path", f"{endpoint.operation}: there is no map in its path"
    stray = {endpoint.path for endpoint in endpoints if re.search(r"/maps/[^{]", endpoint.path)}
    assert stray <= {"/v1/maps/import"}, "a path that looks like a map's"


def test_whoever_only_queries_changes_nothing(endpoints: list[Endpoint]) -> None:
    for endpoint in endpoints:
        if endpoint.rule.changes:
            assert endpoint.method not in READING and covers(endpoint.rule.role, "enrol"), endpoint.operation


def test_whoever_shows_pictures_is_audited(endpoints: list[Endpoint]) -> None:
    """A route of pictures or exports that is new is to be named here, and marked in its rule."""
    showing = {endpoint.operation for endpoint in endpoints if endpoint.rule.shows}
    named = re.compile("see_|export_")
    assert showing == {one.operation for one in endpoints if named.match(one.operation)} | {"follow_map"}


def test_roles_are_ordered() -> None:
    order: tuple[Role, ...] = ("query", "enrol", "admin")
    for index, role in enumerate(order):
        assert [covers(role, needed) for needed in order] == [place <= index for place in range(3)]
        assert covers(role, "open") and not covers("open", role)


def test_a_route_that_was_forgotten_needs_the_highest_role() -> None:
    app = create_app(Settings(host="127.0.0.1"))

    @app.get("/v1/new")
    def forgotten() -> None:
        """Nobody wrote down who may use it."""

    (endpoint,) = (endpoint for endpoint in endpoints_of(app.routes) if endpoint.operation == "forgotten")
    assert endpoint.rule == Rule("admin", "all", changes=True)


def test_a_route_of_an_unknown_kind_does_not_slip_through() -> None:
    app = create_app(Settings(host="127.0.0.1"))
    app.mount("/files", create_app(Settings(host="127.0.0.1")))
    with pytest.raises(TypeError, match="not guarded"):
        endpoints_of(app.routes)


def test_the_interface_says_what_each_operation_needs(described: dict[str, Any]) -> None:
    assert described["components"]["securitySchemes"]["key"]["scheme"] == "bearer"
    for item in described["paths"].values():
        for operation in item.values():
            name, role = operation["operationId"], OPERATIONS[operation["operationId"]].role
            assert operation["x-role"] == role
            answers = set(operation["responses"])
            if role == "open":
                assert operation["security"] == [] and not answers & {"401", "403", "429"}, name
            else:
                assert {"key": []} in operation["security"] and {"401", "403", "429"} <= answers, name
                assert "a key of" in operation["description"], name
            if role in ("enrol", "admin"):
                assert f"`{role}`" in operation["description"], name

"""Every error has its problem, on every path."""

from __future__ import annotations

import inspect
import json
import re
from typing import Any

import httpx
import pytest
from fastapi import FastAPI
from starlette.exceptions import HTTPException

from core import errors
from service.app.application import create_app
from service.errors import faults
from service.errors.problems import BY_STATUS, KINDS, TYPE_PREFIX, kind_of, problem_of
from service.settings import Settings
from tests.service.server import ROOT, assert_problem

INTERFACE: dict[str, Any] = json.loads((ROOT / "openapi.json").read_text())["paths"]
METHODS = {"get", "put", "post", "patch", "delete"}
CONTRACT = {400, 401, 403, 404, 405, 406, 408, 409, 410, 412, 413, 414, 415, 416, 422, 429, 431, 500, 501, 503, 507}
OURS = [
    cls
    for module in (errors, faults)
    for _, cls in inspect.getmembers(module, inspect.isclass)
    if issubclass(cls, Exception) and cls not in (errors.PlacerecError, faults.Fault)
]


@pytest.mark.parametrize("cls", OURS, ids=lambda cls: cls.__name__)
def test_every_error_class_is_mapped(cls: type[Exception]) -> None:
    assert cls in KINDS, "an error of its own needs a status, a type and a title"
    kind = KINDS[cls]
    # 499 is only seen in the log: the client is gone.
    assert kind.status in CONTRACT or cls is faults.ClientGone
    assert kind.title and kind.slug == kind.slug.lower().replace(" ", "-")


def test_problem_types_are_distinguished() -> None:
    slugs = [kind.slug for kind in [*KINDS.values(), *BY_STATUS.values()]]
    assert len(set(slugs)) == len(slugs)


def test_a_subclass_without_a_row_is_its_base() -> None:
    class OddPicture(errors.NotAnImage):
        pass

    assert kind_of(OddPicture("odd")) is KINDS[errors.NotAnImage]


def test_the_text_of_an_unexpected_error_is_not_sent() -> None:
    problem = problem_of(RuntimeError("password 1234 in /etc/secret"))
    assert problem.status == 500 and "1234" not in problem.model_dump_json()


def test_a_status_of_the_framework_has_a_type() -> None:
    problem = problem_of(HTTPException(409, "no"))
    assert (problem.type, problem.status, problem.detail) == (TYPE_PREFIX + "conflict", 409, "no")


@pytest.mark.parametrize("path", ["/nothing", "/v1/nothing", "/v1/maps/", "/v1/maps/a/b/c/d", "/v1/maps/a%2Fb/places"])
def test_unknown_paths(client: httpx.Client, path: str) -> None:
    response = client.get(path)
    assert response.status_code == 404
    assert response.json()["type"] == TYPE_PREFIX + "unknown-path"
    assert response.headers["content-type"] == "application/problem+json"


@pytest.mark.parametrize(
    ("method", "path", "allowed"),
    [
        ("POST", "/livez", "GET, HEAD"),
        ("DELETE", "/v1/maps", "GET, HEAD, POST"),
        ("POST", "/v1/maps/lab/places/p", "DELETE, GET, HEAD, PATCH, PUT"),
        ("GET", "/v1/maps/lab/query", "POST"),
        ("PUT", "/v1/encode", "POST"),
        ("TRACE", "/openapi.json", "GET, HEAD"),
    ],
)
def test_wrong_methods(client: httpx.Client, method: str, path: str, allowed: str) -> None:
    response = client.request(method, path)
    assert_problem(response, 405, "method-not-allowed")
    assert response.headers["allow"] == allowed


@pytest.mark.parametrize("path", INTERFACE)
def test_the_methods_of_a_path_are_those_that_it_documents(client: httpx.Client, path: str) -> None:
    """A path with a name in the place of an id, such as ``review/labels``, is not taken for the one with the id."""
    methods = {method.upper() for method in INTERFACE[path] if method in METHODS}
    methods |= {"HEAD"} if "GET" in methods else set()
    concrete = re.sub(r"\{\w+\}", "1", path)
    response = client.options(concrete)
    assert_problem(response, 405, "method-not-allowed")
    assert response.headers["allow"] == ", ".join(sorted(methods))
    if path == "/v1/maps/import":
        return  # other methods take it for the id of a map, which none can have
    for method in METHODS - {one.lower() for one in methods}:
        assert client.request(method, concrete).status_code == 405, method


def test_head_is_answered_like_get(client: httpx.Client) -> None:
    response = client.head("/livez")
    assert response.status_code == 200 and response.content == b""


@pytest.fixture
def breaking_app() -> FastAPI:
    app = create_app(Settings(host="127.0.0.1"))

    @app.get("/break")
    async def broken() -> None:
        raise RuntimeError("the secret of the house")

    return app


@pytest.mark.anyio
async def test_an_unexpected_error_is_logged_and_not_sent(
    breaking_app: FastAPI, caplog: pytest.LogCaptureFixture
) -> None:
    transport = httpx.ASGITransport(breaking_app)
    async with httpx.AsyncClient(transport=transport, base_url="http://127.0.0.1") as client:
        response = await client.get("/break", headers={"X-Request-Id": "seven"})
    problem = assert_problem(response, 500, "internal-error")
    assert "secret" not in response.text and problem["request_id"] == "seven"
    logged = [record for record in caplog.records if record.exc_info and getattr(record, "request_id", "") == "seven"]
    assert len(logged) == 1


@pytest.mark.anyio
async def test_behind_a_proxy_that_adds_a_path() -> None:
    app = create_app(Settings(host="127.0.0.1", root_path="/placerec"))
    async with httpx.AsyncClient(transport=httpx.ASGITransport(app), base_url="http://127.0.0.1") as client:
        for prefix in ("", "/placerec"):
            assert (await client.get(f"{prefix}/livez")).status_code == 200
            response = await client.delete(f"{prefix}/v1/maps")
            assert response.status_code == 405 and response.headers["allow"] == "GET, HEAD, POST"
            assert response.json()["instance"] == "/placerec/v1/maps"


def test_a_broken_host_header_breaks_nothing(client: httpx.Client) -> None:
    for path in ("/nothing", "/livez"):
        response = client.get(path, headers={"Host": "[broken"})
        assert response.status_code == 400 and response.json()["type"].endswith(":malformed-head")
    assert client.get("/livez").status_code == 200

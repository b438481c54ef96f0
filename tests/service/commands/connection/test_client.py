"""The requests of the commands: retries, refusals, pages."""

from __future__ import annotations

import asyncio
import json
from collections.abc import Callable
from typing import Any

import httpx
import pytest

from service.commands.connection.client import Refused, Service, media_type, path_of
from service.commands.console import Failure

PROBLEM = {"content-type": "application/problem+json"}
Handler = Callable[[httpx.Request], httpx.Response]


def problem(status: int, slug: str, **headers: str) -> httpx.Response:
    content = json.dumps({"type": f"urn:placerec:problem:{slug}", "detail": f"It is {slug}.", "status": status})
    return httpx.Response(status, headers={**PROBLEM, **headers}, content=content)


def ask(handler: Handler, patience: float = 0.0) -> httpx.Response:
    async def work() -> httpx.Response:
        transport = httpx.MockTransport(handler)
        async with httpx.AsyncClient(transport=transport, base_url="http://robot") as client:
            return await Service(client, "The service").request("PUT", "/v1/x", patience=patience, content=b"frame")

    return asyncio.run(work())


def in_turn(*answers: httpx.Response | Exception) -> tuple[Handler, list[httpx.Request]]:
    """A service that gives these answers one after the other, and what it was asked."""
    asked: list[httpx.Request] = []

    def handle(request: httpx.Request) -> httpx.Response:
        asked.append(request)
        answer = answers[len(asked) - 1]
        if isinstance(answer, Exception):
            raise answer
        return answer

    return handle, asked


def test_a_request_is_sent_again_under_the_same_id() -> None:
    handle, asked = in_turn(
        problem(503, "queue-full", **{"Retry-After": "0"}),
        httpx.ConnectError("refused"),
        httpx.Response(502, content=b"a proxy"),
        httpx.Response(201, json={"change": "created"}),
    )
    assert ask(handle, patience=10).json() == {"change": "created"}
    assert len(asked) == 4
    assert len({request.headers["X-Request-Id"] for request in asked}) == 1
    assert all(request.content == b"frame" for request in asked)


def test_patience_ends() -> None:
    handle, asked = in_turn(*[problem(503, "queue-full", **{"Retry-After": "60"})] * 2)
    with pytest.raises(Refused, match=r"It is queue-full\.") as refused:
        ask(handle, patience=5)
    assert refused.value.status == 503
    assert len(asked) == 1  # it asks to wait longer than there is patience


@pytest.mark.parametrize(("status", "slug"), [(503, "map-quarantined"), (404, "unknown-map"), (507, "storage-full")])
def test_what_a_moment_does_not_change_is_not_sent_again(status: int, slug: str) -> None:
    handle, asked = in_turn(problem(status, slug))
    with pytest.raises(Refused) as refused:
        ask(handle, patience=60)
    assert (refused.value.status, refused.value.slug, len(asked)) == (status, slug, 1)


@pytest.mark.parametrize(
    ("error", "message"),
    [(httpx.ConnectError("refused"), "cannot be reached: refused"), (httpx.ReadTimeout(""), "did not answer in time")],
)
def test_a_service_that_is_not_there(error: Exception, message: str) -> None:
    handle, _ = in_turn(error)
    with pytest.raises(Failure, match=message):
        ask(handle)


def test_another_service_is_told_apart() -> None:
    handle, _ = in_turn(httpx.Response(404, content=b"<html>"))
    with pytest.raises(Failure, match=r"answered 404\. Is it a placerec service"):
        ask(handle)


def test_pages_are_followed_to_the_last() -> None:
    pages: dict[str | None, Any] = {
        None: {"items": [1, 2], "next_cursor": "a"},
        "a": {"items": [3], "next_cursor": "b"},
        "b": {"items": [], "next_cursor": None},
    }

    def handle(request: httpx.Request) -> httpx.Response:
        assert request.url.params["sequence"] == "monday"
        return httpx.Response(200, json=pages[request.url.params.get("cursor")])

    async def work() -> list[Any]:
        transport = httpx.MockTransport(handle)
        async with httpx.AsyncClient(transport=transport, base_url="http://robot") as client:
            found = Service(client, "The service").pages("/v1/x", {"sequence": "monday"})
            return [item async for page in found for item in page["items"]]

    assert asyncio.run(work()) == [1, 2, 3]


def test_names_are_quoted_in_paths() -> None:
    assert path_of("maps", "lab", "sequences", "a b/ü?") == "/v1/maps/lab/sequences/a%20b%2F%C3%BC%3F"


def test_the_content_type_is_that_of_the_bytes() -> None:
    assert media_type(b"\x89PNG\r\n") == "image/png"
    assert media_type(b"RIFF\0\0\0\0WEBPVP8 ") == "image/webp"
    assert media_type(b"RIFF\0\0\0\0WAVE") == "image/jpeg"
    assert media_type(b"") == "image/jpeg"

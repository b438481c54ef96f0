"""Values of a type that a call does not take: the error is one of the client's and names them, and nothing is sent."""

from __future__ import annotations

import asyncio
import inspect
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
import pytest

from placerec_client import (
    AsyncClient,
    Client,
    ConnectionFailed,
    InvalidFrame,
    InvalidName,
    InvalidParameter,
    NewPlace,
    PlacerecError,
    Retry,
    TransferFailed,
)
from tests.clients.python.test_names import finished
from tests.service.refusing import Seen, refusing_server
from tests.service.scenes import jpeg

FRAME = jpeg(1, 32, 24)


@pytest.fixture(scope="module")
def refusing() -> Iterator[tuple[str, Seen]]:
    with refusing_server() as server:
        yield server


@pytest.mark.parametrize(
    ("call", "kind", "text"),
    [
        (lambda one: one.maps[None], InvalidName, "None is no name: it has to be a text"),
        (lambda one: one.maps["m"].places.put(None, FRAME), InvalidName, "None is no name"),
        (lambda one: one.maps["m"].places.put(b"p", FRAME), InvalidName, "b'p' is no name: it has to be a text"),
        (lambda one: one.maps["m"].places.put("\ud800", FRAME), InvalidName, "half a character"),
        (lambda one: one.maps["m"].query_or_enrol(b"p", FRAME), InvalidName, "b'p' is no name"),
        (lambda one: one.maps["m"].query_or_enrol("..", FRAME), InvalidName, r"'\.\.' is no name"),
        (lambda one: one.maps["m"].places.put("p", FRAME, sequence=b"monday"), InvalidParameter, "sequence .* bytes"),
        (lambda one: one.maps["m"].places.put("p", FRAME, sequence="\ud800"), InvalidParameter, "sequence has half"),
        (lambda one: one.maps["m"].query(FRAME, sequences=b"monday"), InvalidParameter, "sequences .* bytes"),
        (lambda one: one.maps["m"].query(FRAME, sequences=bytearray(b"m")), InvalidParameter, "sequences .* bytearray"),
        (lambda one: one.maps["m"].query(FRAME, sequences=[b"1"]), InvalidParameter, "sequences .* bytes"),
        (lambda one: one.maps["m"].query(FRAME, bbox=[[1, 2], [3, 4]]), InvalidParameter, "bbox cannot be a list"),
        (lambda one: one.maps["m"].query(FRAME, bbox=np.eye(2)), InvalidParameter, "bbox cannot be a ndarray"),
        (lambda one: one.maps["m"].query(FRAME, x=object()), InvalidParameter, "x cannot be a object"),
        (
            lambda one: one.maps["m"].places.put("p", FRAME, metadata={"a": object()}),
            InvalidParameter,
            "JSON cannot have metadata: a object",
        ),
        (lambda one: one.maps["m"].places.put("p", FRAME, metadata={(1,): 2}), InvalidParameter, "metadata: keys must"),
        (lambda one: one.maps.create("m", description=b"x"), InvalidParameter, "JSON cannot have .* bytes"),
        (lambda one: one.maps["m"].edit({"description": "x"}, if_match=b"1"), InvalidParameter, "if_match .* bytes"),
        (lambda one: one.maps["m"].query(FRAME, deadline="2"), InvalidParameter, "deadline has to be .* not '2'"),
        (
            lambda one: one.maps["m"].query(FRAME, deadline=float("nan")),
            InvalidParameter,
            "deadline has to be a number",
        ),
        (lambda one: one.maps["m"].sessions["s"].send(FRAME, deadline="2"), InvalidParameter, "deadline has to be"),
        (
            lambda one: one.maps["m"].sessions["s"].send(FRAME, frame="7"),
            InvalidParameter,
            "frame has to be .* not '7'",
        ),
        (lambda one: one.maps["m"].sessions["s"].stream().send(FRAME, deadline="2"), InvalidParameter, "deadline has"),
        (lambda one: one.jobs["j"].wait(deadline="2"), InvalidParameter, "deadline has to be a number"),
        (lambda one: one.maps["m"].query(FRAME, request_id=b"x"), InvalidParameter, "request_id .* bytes"),
        (lambda one: one.maps["m"].explanation(None), InvalidParameter, "explanation .* NoneType"),
        (lambda one: one.query({None: FRAME}), InvalidParameter, "name of a frame .* NoneType"),
        (lambda one: one.maps["m"].calibrate("frames", frames=[FRAME]), InvalidParameter, "map the files .* list"),
        (lambda one: one.maps["m"].query("a\0b"), InvalidFrame, "cannot be read"),
        (lambda one: one.maps["m"].enrol([FRAME], known=()), InvalidParameter, "has to be a NewPlace, not a bytes"),
        (lambda one: one.maps["m"].enrol_by_job([NewPlace("..", FRAME)]), InvalidName, r"'\.\.' is no name"),
        (lambda one: one.maps["m"].export(None), TransferFailed, "NoneType is no path"),
        (lambda one: one.maps.import_(None), TransferFailed, "NoneType is no path"),
    ],
)
@pytest.mark.parametrize("half", [Client, AsyncClient])
def test_a_value_of_a_wrong_type_is_named(
    half: Any, call: Callable[[Any], Any], kind: type[PlacerecError], text: str, refusing: tuple[str, Seen]
) -> None:
    url, seen = refusing
    seen.clear()

    async def work() -> None:
        client = half(url, retry=Retry(0))
        try:
            with pytest.raises(kind, match=text):
                await finished(call(client))
        finally:
            if inspect.isawaitable(closed := client.close()):
                await closed

    asyncio.run(work())
    assert seen == []


@pytest.mark.parametrize("half", [Client, AsyncClient])
def test_a_client_of_what_is_no_service(half: Any) -> None:
    for url in (None, b"http://robot", 5):
        with pytest.raises(ConnectionFailed, match="is not a URL of a service: it has to be a text"):
            half(url)
    with pytest.raises(InvalidParameter, match=r"^The key has to be a text, not bytes\.$"):
        half("robot", key=b"secret")
    with pytest.raises(InvalidParameter, match="timeout has to be a number of seconds, not '5'"):
        half("robot", timeout="5")
    for timeout in (0, -1.5):
        with pytest.raises(InvalidParameter, match="timeout has to be more than 0 seconds, not"):
            half("robot", timeout=timeout)
    with pytest.raises(InvalidParameter, match=r"retry has to be a Retry, .* not a int"):
        half("robot", retry=0)
    with pytest.raises(InvalidParameter, match="retry has to be a Retry"):
        half("robot").patient(5)
    with pytest.raises(InvalidParameter, match="The key has characters that no key has") as told:
        half("robot", key="secret\n")
    assert "secret" not in str(told.value)
    with pytest.raises(ConnectionFailed, match="no password of a user") as refused:
        half("http://me:secret@robot")
    assert "secret" not in str(refused.value)


@pytest.mark.parametrize("options", [{"patience": -1}, {"first_pause": -0.1}, {"longest_pause": -1}, {"patience": "5"}])
def test_a_rule_that_cannot_be_followed_is_refused_when_it_is_made(options: Any) -> None:
    with pytest.raises(InvalidParameter, match=r"^(patience|first_pause|longest_pause) has to be"):
        Retry(**options)


def test_an_endless_timeout(url: str) -> None:
    with Client(url, timeout=float("inf")) as client:
        assert client.liveness().status == "ok"


@pytest.mark.parametrize("half", [Client, AsyncClient])
def test_a_client_shows_its_service_and_not_its_key(half: Any) -> None:
    client = half("robot:8000", key="secret")
    assert repr(client) == f"<{half.__name__} of http://robot:8000, with a key>"
    assert repr(half("robot")) == f"<{half.__name__} of http://robot>"
    if inspect.isawaitable(closed := client.close()):
        asyncio.run(finished(closed))
    assert repr(client) == f"<{half.__name__} of http://robot:8000, with a key, closed>"
    assert "secret" not in repr(client.connection)

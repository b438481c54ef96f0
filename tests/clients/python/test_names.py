"""Whatever a name is, a call reaches the operation that it is for, or nothing is sent.

The calls are found in the classes of the client, both halves, so that a new one is held to this as well.  A server
writes down the path of each request as it arrives, after all that client, httpx and websockets do to it.
"""

from __future__ import annotations

import asyncio
import inspect
import re
from collections.abc import Callable, Iterator
from copy import copy
from pathlib import Path
from typing import Any
from urllib.parse import quote, unquote

import pytest

from placerec_client import AsyncClient, Client, InvalidName, Map, NewPlace, PlacerecError, Renamed, Retry, problems
from tests.clients.python.models import operations
from tests.service.refusing import Seen, refusing_server
from tests.service.scenes import jpeg
from tests.service.server import Server

HOSTILE = ("", ".", "..", "a/b", "..\\..", "%2e%2e", "%2E", "a%2fb", "?x#y;z", "\n", "\u202e", "ü b", "...")
REFUSED = ("", ".", "..", "a/b")
ONCE = Retry(0)
EVERY = [(method, re.compile(re.sub(r"\{\w+\}", "[^/]+", path))) for method, path, _ in operations()]
EVERY.append(("GET", re.compile("/v1/maps/[^/]+/sessions/[^/]+/stream")))  # a WebSocket


@pytest.fixture(scope="module")
def refusing() -> Iterator[tuple[str, Seen]]:
    with refusing_server() as server:
        yield server


Step = Callable[[Any, Iterator[Any]], Any]
"""From one object to the next, which takes a name if one is needed for that."""

Way = tuple[Step, ...]
Call = Callable[[Any, list[Any], Path], Any]


def objects(thing: Any, steps: Way = (), trail: str = "client") -> Iterator[tuple[Any, Way, str]]:
    """All objects that a client has, how to come to each, given the names on the way, and that in words."""
    yield thing, steps, trail
    for name, found in vars(thing).items():
        home = type(found).__module__
        if not name.startswith("_") and home.startswith("placerec_client.") and not home.endswith(".connection"):
            yield from objects(found, (*steps, held(name)), f"{trail}.{name}")
    if hasattr(thing, "__getitem__"):
        yield from objects(thing["x"], (*steps, lambda one, names: one[next(names)]), f"{trail}[…]")


def held(name: str) -> Step:
    return lambda one, _: getattr(one, name)


def calls(client: Any) -> Iterator[tuple[str, int, Call]]:
    """Every call that takes a name, on its own or on its way: in words, how many names, and how to make it."""
    for thing, steps, trail in objects(client):
        for name, method in inspect.getmembers(type(thing), inspect.isfunction):
            if name.startswith("_"):
                continue
            wanted = [one for one in list(inspect.signature(method).parameters.values())[1:] if needed(one)]
            count = trail.count("[") + sum(is_name(one) for one in wanted)
            if count:
                yield f"{trail}.{name}", count, made(steps, name, wanted)


def needed(parameter: inspect.Parameter) -> bool:
    return parameter.default is parameter.empty and parameter.kind is not parameter.VAR_KEYWORD


def is_name(parameter: inspect.Parameter) -> bool:
    return parameter.annotation in ("str", "int")


def made(steps: Way, method: str, wanted: list[inspect.Parameter]) -> Callable[[Any, list[Any], Path], Any]:
    def call(client: Any, names: list[Any], folder: Path) -> Any:
        left = iter(names)
        thing = client
        for step in steps:
            thing = step(thing, left)
        return getattr(thing, method)(*(next(left) if is_name(one) else argument(one, folder) for one in wanted))

    return call


def argument(parameter: inspect.Parameter, folder: Path) -> Any:
    """What can be given for a parameter that is no name; a test fails here if a call has one of another kind."""
    frame = jpeg(1, 32, 24)
    kinds: dict[str, Any] = {
        r"Frame": frame,
        r"(Iterable|Sequence)\[Frame\]": [frame],
        r"(Iterable|Sequence)\[NewPlace\]": [NewPlace("p", frame)],
        r"str \| os\.PathLike\[str\]": folder / "map.tar",
        r"parameters\.\w+": {},
        r"Sequence\[parameters\.FrameToCompare\]": [{"id": "p"}],
        r"Literal\['(\w+)'.*": "map",
    }
    return next(value for kind, value in kinds.items() if re.fullmatch(kind, str(parameter.annotation)))


async def finished(result: Any) -> None:
    """See a call through: what it gives is awaited, entered and read to its end."""
    if inspect.isawaitable(result):
        await finished(await result)
    elif hasattr(result, "__aiter__"):
        async for _ in result:
            pass
    elif hasattr(result, "__iter__") and not isinstance(result, str | bytes | tuple | list):
        for _ in result:
            pass
    elif hasattr(result, "__enter__") or hasattr(result, "__aenter__"):
        sent = result.send(jpeg(1, 32, 24))  # of a stream, which connects then
        await finished(sent)


async def outcome(seen: Seen, call: Call, client: Any, names: list[Any], folder: Path) -> tuple[Seen, type | None]:
    """What a call sends, and the kind of its error."""
    seen.clear()
    error = None
    try:
        await finished(call(client, names, folder))
    except PlacerecError as found:
        error = type(found)
    return list(seen), error


def operation_of(method: str, path: str) -> list[str]:
    return [one.pattern for of, one in EVERY if of == method and one.fullmatch(path)]


def assert_hits(words: str, plain: tuple[str, str], marker: str, name: str, sent: Seen, error: type | None) -> None:
    """A name is where the harmless ``marker`` was, quoted, and all else is as it was; or nothing was sent."""
    method, path = plain
    if name == "a/b" and path.endswith(f"/explanations/{marker}"):
        name = "b"  # the address of a picture, whose last part is its name
    if name in REFUSED and (marker in path or not sent):
        assert (sent, error) == ([], InvalidName), f"{words} with {name!r}"
        return
    wanted = path.replace(marker, quote(name, safe=""))
    assert sent == [(method, wanted)], f"{words} with {name!r}"
    assert operation_of(method, wanted) == operation_of(method, path), f"{words} with {name!r}"
    if marker in path:
        assert unquote(wanted.split("/")[path.split("/").index(marker)]) == name


@pytest.mark.thorough
@pytest.mark.parametrize("half", [Client, AsyncClient])
def test_no_name_leads_a_call_astray(half: Any, refusing: tuple[str, Seen], tmp_path: Path) -> None:
    url, seen = refusing
    tried: set[str] = set()
    archive = tmp_path / "map.tar"

    async def work() -> None:
        client = half(url, retry=ONCE)
        for words, count, call in list(calls(client)):
            markers = [f"name-{number}" for number in range(count)]
            archive.unlink(missing_ok=True)
            if words.endswith(".upload"):
                archive.write_bytes(b"a bag")
            plain, _ = await outcome(seen, call, client, markers, tmp_path)
            assert len(plain) == 1 and operation_of(*plain[0]), f"{words}: {plain}"
            for hole, marker in enumerate(markers):
                for name in HOSTILE:
                    given = [*markers[:hole], name, *markers[hole + 1 :]]
                    sent, error = await outcome(seen, call, client, given, tmp_path)
                    assert_hits(words, plain[0], marker, name, sent, error)
            tried.add(words)
        if inspect.isawaitable(closed := client.close()):
            await closed

    asyncio.run(work())
    assert {
        *("client.maps[…].delete", "client.maps[…].places.delete", "client.maps[…].sequences.delete"),
        *("client.maps[…].cameras.delete", "client.maps[…].sessions[…].delete", "client.maps[…].sessions[…].stream"),
        *("client.keys.delete", "client.jobs[…].cancel", "client.maps[…].review.label", "client.maps[…].events"),
    } <= tried


@pytest.mark.parametrize("half", [Client, AsyncClient])
def test_what_is_no_text_is_no_name(half: Any, refusing: tuple[str, Seen], tmp_path: Path) -> None:
    url, seen = refusing

    async def work() -> None:
        client = half(url, retry=ONCE)
        for words, count, call in list(calls(client)):
            for name in (None, b"x", 2.5, ["x"]):
                sent, error = await outcome(seen, call, client, [name] * count, tmp_path)
                assert error is not None, f"{words} with {name!r}"
                assert not any(str(name) in unquote(path) for _, path in sent), f"{words} with {name!r}"
        if inspect.isawaitable(closed := client.close()):
            await closed

    asyncio.run(work())


@pytest.mark.parametrize("name", REFUSED)
def test_a_map_outlives_whatever_is_deleted_from_it(client: Client, lab: Map, server: Server, name: str) -> None:
    server.enrol(lab.id, "p", jpeg(1), sequence="monday")
    for delete in (lab.places.delete, lab.sequences.delete, lab.cameras.delete, client.keys.delete):
        with pytest.raises(InvalidName, match=r"is no name: it is empty, '\.' or '\.\.', or has a slash"):
            delete(name)
    with pytest.raises(InvalidName):
        lab.sessions[name].delete()
    with pytest.raises(InvalidName):
        client.maps[f"{lab.id}/places/p"].delete()
    assert lab.read().places == 1


def test_what_the_service_refuses_as_a_name_is_a_problem(client: Client, lab: Map) -> None:
    for name in (".", "..", "a/b", "\n", "\x85", "\u202e", "\u061c"):
        with pytest.raises(problems.InvalidRequest):
            lab.places.put("p", jpeg(1), sequence=name)
        with pytest.raises((InvalidName, problems.InvalidIdentifier)):
            client.maps.create(name)
    assert list(lab.places) == []


def test_the_old_words_name_the_new_one(client: Client, lab: Map) -> None:
    session = lab.sessions["s"]
    for old, thing, new in (
        ("forget", lab.places, "delete"),
        ("forget_many", lab.places, "delete_many"),
        ("forget", lab.sequences, "delete"),
        ("forget", lab.cameras, "delete"),
        ("revoke", client.keys, "delete"),
        ("end", session, "delete"),
    ):
        with pytest.raises(Renamed, match=rf"^{type(thing).__name__}\.{old} .*: use {new}\.$"):
            getattr(thing, old)("p")
        assert not hasattr(thing, old) and callable(getattr(thing, new))
    for other, word in ((lab.places, "revoked"), (session, "forget_many"), (lab.places, "revoke"), (lab, "forget")):
        with pytest.raises(AttributeError, match=f"has no attribute '{word}'$"):
            getattr(other, word)


@pytest.mark.parametrize("half", [Client, AsyncClient])
def test_what_one_of_a_collection_does_is_looked_for_at_it(half: Any, url: str) -> None:
    client = half(url)
    sessions = client.maps["lab"].sessions
    for thing, word, where in (
        (client.maps, "delete", r"maps[id].delete"),
        (client.maps, "forget", r"maps[id].delete"),
        (client.maps, "query", r"maps[id].query"),
        (client.jobs, "cancel", r"jobs[id].cancel"),
        (sessions, "send", r"sessions[id].send"),
        (sessions, "end", r"sessions[id].delete"),
    ):
        with pytest.raises(
            AttributeError, match=rf"has no attribute '{word}'; one of them has it: {re.escape(where)}$"
        ):
            getattr(thing, word)
        assert not hasattr(thing, word)
    for thing, word in ((client.maps, "nothing"), (client.jobs, "delete"), (client.maps, "_path")):
        with pytest.raises(AttributeError, match=f"has no attribute '{word}'$"):
            getattr(thing, word)
    assert copy(client.maps)["lab"].id == "lab"

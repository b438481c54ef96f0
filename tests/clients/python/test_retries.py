"""When a request is sent again, and when it is not; what the caller is told."""

from __future__ import annotations

import asyncio
import inspect
import itertools
import json
import random
import re
import socket
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from typing import Any

import httpx
import pytest

from placerec_client import (
    AsyncClient,
    Client,
    ClientClosed,
    ConnectionFailed,
    DeadlineExceeded,
    InvalidParameter,
    JobCancelled,
    Map,
    NotReadyInTime,
    PlacerecError,
    Problem,
    Retry,
    UnexpectedAnswer,
    problems,
    retry,
)
from placerec_client.answers import problem_of
from placerec_client.requests import path_of
from tests.clients.python.fault_proxy import Fault, FaultProxy
from tests.clients.python.moments import Moments
from tests.service.scenes import jpeg
from tests.service.server import Server, no_service

PROBLEM = {"content-type": "application/problem+json"}
Handler = Callable[[httpx.Request], httpx.Response]


def problem(status: int, slug: str, **headers: str) -> httpx.Response:
    content = json.dumps({"type": f"urn:placerec:problem:{slug}", "detail": f"It is {slug}.", "status": status})
    return httpx.Response(status, headers={**PROBLEM, **headers}, content=content)


def ask(handler: Handler, patience: float = 0.0, **options: Any) -> httpx.Response:
    transport = httpx.MockTransport(handler)
    with Client("http://robot", retry=Retry(patience, first_pause=0.01), transport=transport) as client:
        return client.connection.request("PUT", "/v1/x", content=b"frame", **options)


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
        httpx.ReadError("lost"),
        httpx.Response(502, content=b"a proxy"),
        httpx.Response(201, json={"change": "created"}),
    )
    assert ask(handle, patience=10).json() == {"change": "created"}
    assert len(asked) == 5
    assert len({request.headers["X-Request-Id"] for request in asked}) == 1
    assert all(request.content == b"frame" for request in asked)


def test_the_service_says_when() -> None:
    handle, asked = in_turn(problem(429, "rate-exceeded", **{"Retry-After": "1"}), httpx.Response(200))
    began = time.monotonic()
    assert ask(handle, patience=10).is_success and len(asked) == 2
    assert time.monotonic() - began >= 1


def test_patience_ends() -> None:
    handle, asked = in_turn(*[problem(503, "queue-full", **{"Retry-After": "60"})] * 2)
    with pytest.raises(problems.QueueFull, match=r"It is queue-full\.") as refused:
        ask(handle, patience=5)
    assert (refused.value.status, refused.value.retry_after) == (503, 60)
    assert len(asked) == 1  # it asks to wait longer than there is patience


@pytest.mark.parametrize(
    ("status", "slug"),
    [
        (503, "map-quarantined"),
        (404, "unknown-map"),
        (507, "storage-full"),
        (500, "internal-error"),
        (422, "no-regions"),
    ],
)
def test_what_a_moment_does_not_change_is_not_sent_again(status: int, slug: str) -> None:
    handle, asked = in_turn(problem(status, slug))
    with pytest.raises(problems.BY_SLUG[slug]) as refused:
        ask(handle, patience=60)
    assert (refused.value.status, refused.value.slug, len(asked)) == (status, slug, 1)


def test_a_kind_of_problem_that_is_not_known_here_is_a_problem() -> None:
    found = problem_of({"type": "urn:placerec:problem:of-tomorrow", "status": 418, "detail": "New."})
    assert type(found) is Problem and (found.slug, found.status, str(found)) == ("of-tomorrow", 418, "New.")


@pytest.mark.parametrize(
    ("error", "message"),
    [(httpx.ConnectError("refused"), "cannot be reached: refused"), (httpx.ReadTimeout(""), "did not answer in time")],
)
def test_a_service_that_is_not_there(error: Exception, message: str) -> None:
    handle, _ = in_turn(error)
    with pytest.raises(ConnectionFailed, match=message):
        ask(handle)


def test_another_service_is_recognized() -> None:
    handle, _ = in_turn(httpx.Response(404, content=b"<html>"))
    with pytest.raises(UnexpectedAnswer, match=r"answered 404\. Is it a placerec service") as answered:
        ask(handle)
    assert answered.value.status == 404


def test_a_url_with_a_path_too_many_is_explained(url: str, lab: Map) -> None:
    hint = rf"{re.escape(url)}/v1 may not be the URL of a service: give {re.escape(url)}, without /v1\.$"
    with Client(f"{url}/v1/") as client:
        there = client.maps[lab.id]
        calls: list[Callable[[], object]] = [
            client.liveness,
            there.read,
            lambda: list(client.maps),
            lambda: list(there.events()),
        ]
        for call in calls:
            with pytest.raises(UnexpectedAnswer, match=hint) as answered:
                call()
            assert answered.value.status == 404
        with pytest.raises(UnexpectedAnswer, match=hint):
            there.query(b"frame")
    with Client(f"{url}/console") as client, pytest.raises(UnexpectedAnswer, match="is given without the path of an"):
        client.liveness()


@pytest.mark.parametrize("path", ["/robots/placerec", "/robots/v1"])
def test_a_service_behind_a_prefix_is_itself(path: str) -> None:
    handle, asked = in_turn(httpx.Response(200, json={"status": "ok"}), problem(404, "unknown-map"))
    with Client(f"http://robot{path}", transport=httpx.MockTransport(handle), retry=Retry(0)) as client:
        client.liveness()
        with pytest.raises(problems.UnknownMap):
            client.maps["lab"].read()
    assert [one.url.path for one in asked] == [f"{path}/livez", f"{path}/v1/maps/lab"]


@pytest.mark.parametrize(
    ("url", "host"),
    [
        ("127.0.0.1:8211", "127.0.0.1:8211"),
        ("robot", "robot"),
        ("robot.local:80/behind/a/proxy/", "robot.local"),
        ("[::1]:8000", "[::1]:8000"),
        ("https://robot/", "robot"),
        ("my_robot-2.local.:65535", "my_robot-2.local.:65535"),
        ("bücher.example", "xn--bcher-kva.example"),
    ],
)
def test_a_host_is_a_url(url: str, host: str) -> None:
    handle, asked = in_turn(httpx.Response(200, json={"status": "ok"}))
    with Client(url, transport=httpx.MockTransport(handle)) as client:
        client.liveness()
    assert asked[0].headers["Host"] == host
    assert asked[0].url.scheme == ("https" if "https" in url else "http") and asked[0].url.path.endswith("/livez")


@pytest.mark.parametrize(
    "url",
    [
        *("ftp://robot", "unix:/run/placerec.sock", "robot:", "robot:x", "http://robot:x", "http://", "robot?key=1"),
        *("", "robot:0", "robot:65536", "http://127.0.0.1:73747", "https://[::1]:65616"),
        *("a\\b", "http://a\\b", "robot;x", "*", "a%41", "http://ro bot", "robot..local", ".", "r" * 64),
    ],
)
def test_what_is_no_url_is_refused_at_once(url: str) -> None:
    with pytest.raises(ConnectionFailed, match="is not a URL"):
        Client(url)


def test_a_closed_client_says_so(url: str, lab: Map) -> None:
    client = Client(url)
    there, patient = client.maps[lab.id], client.patient(Retry(60))
    session = there.sessions.begin()
    session.begin()
    there.read()
    stream, events = session.stream(), there.events()
    client.close()
    client.close()
    calls: list[Callable[[], object]] = [
        there.read,
        patient.liveness,
        lambda: list(client.maps),
        lambda: next(iter(events)),
        lambda: stream.send(jpeg(0, 64, 48)),
        client.__enter__,
    ]
    for call in calls:
        with pytest.raises(ClientClosed, match="was closed"):
            call()


def test_an_answer_that_is_no_answer() -> None:
    transport = httpx.MockTransport(lambda _: httpx.Response(200, json={"hello": "world"}))
    with Client("http://robot", transport=transport) as client, pytest.raises(UnexpectedAnswer, match="no QueryAnswer"):
        client.maps["lab"].query(b"frame")


def test_pages_are_followed_to_the_last() -> None:
    pages: dict[str | None, Any] = {
        None: {"items": [{"name": "a", "places": 1}, {"name": "b", "places": 1}], "next_cursor": "a"},
        "a": {"items": [{"name": "c", "places": 1}], "next_cursor": "b"},
        "b": {"items": [], "next_cursor": None},
    }
    transport = httpx.MockTransport(lambda request: httpx.Response(200, json=pages[request.url.params.get("cursor")]))
    with Client("http://robot", transport=transport) as client:
        assert [one.name for one in client.maps["lab"].sequences] == ["a", "b", "c"]


def test_names_are_quoted_in_paths() -> None:
    assert path_of("maps", "lab", "sequences", "a b\\ü?%2e") == "/v1/maps/lab/sequences/a%20b%5C%C3%BC%3F%252e"


def test_the_key_is_sent() -> None:
    handle, asked = in_turn(httpx.Response(200, json={"status": "ok"}))
    with Client("http://robot", key="placerec_k", transport=httpx.MockTransport(handle)) as client:
        client.liveness()
    assert asked[0].headers["Authorization"] == "Bearer placerec_k"


# Deadlines


def test_the_service_gets_the_deadline(server: Server) -> None:
    with Client(str(server.client.base_url)) as client:
        with pytest.raises(DeadlineExceeded):
            client.maps["no-map"].query(jpeg(0), deadline=1e-4)
        with pytest.raises(problems.UnknownMap):
            client.maps["no-map"].query(jpeg(0), deadline=20)
    handle, asked = in_turn(httpx.ReadError("lost"), httpx.Response(200))
    ask(handle, deadline=5, patience=1)
    left = [float(request.headers["X-Request-Timeout"]) for request in asked]
    assert 0 < left[1] < left[0] <= 5


def test_no_answer_before_the_deadline() -> None:
    began = time.monotonic()
    with (
        no_service() as gone,
        Client(gone) as client,
        pytest.raises(DeadlineExceeded, match=r"within 0\.3 s"),
    ):
        client.maps["lab"].query(b"frame", deadline=0.3)
    assert time.monotonic() - began < 15, "its patience alone is half a minute"


def test_the_deadline_counts_more_than_the_wish_of_the_service() -> None:
    handle, asked = in_turn(*[problem(503, "queue-full", **{"Retry-After": "30"})] * 2)
    with pytest.raises(DeadlineExceeded, match="It is queue-full") as exceeded:
        ask(handle, deadline=20, patience=60)
    assert len(asked) == 1 and isinstance(exceeded.value.__cause__, problems.QueueFull)


def test_the_problem_of_the_service_is_a_deadline_too() -> None:
    handle, _ = in_turn(problem(503, "deadline-exceeded", **{"Retry-After": "1"}))
    with pytest.raises(DeadlineExceeded) as exceeded:
        ask(handle)
    assert isinstance(exceeded.value, problems.DeadlineExceededByService)


def test_an_answer_in_many_pieces_keeps_to_the_deadline_too() -> None:
    with socket.create_server(("127.0.0.1", 0)) as listening, ThreadPoolExecutor(1) as pool:
        given = pool.submit(trickle, listening, 100, 0.1)
        with Client(f"http://127.0.0.1:{listening.getsockname()[1]}") as client, pytest.raises(DeadlineExceeded):
            client.maps["lab"].query(b"frame", deadline=0.5)
        assert given.result() < 100, "the client has waited for the whole answer"


def trickle(listening: socket.socket, pieces: int, pause: float) -> int:
    """Answer one request by so many pieces; how many could be sent before the client hung up."""
    connection, _ = listening.accept()
    with connection:
        connection.recv(65536)
        connection.sendall(b"HTTP/1.1 200 OK\r\nContent-Length: %d\r\n\r\n" % pieces)
        for sent in range(pieces):
            try:
                connection.sendall(b" ")
            except OSError:
                return sent
            time.sleep(pause)
    return pieces


@pytest.mark.parametrize("seed", range(5))
@pytest.mark.parametrize(("seconds", "deadline"), [(0.7, True), (20.0, True), (30.0, False)])
def test_attempts_go_on_to_the_end(seconds: float, deadline: bool, seed: int, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(retry, "random", random.Random(seed))
    moments, asked = Moments(monkeypatch), list[float]()

    def refuse(_: httpx.Request) -> httpx.Response:
        asked.append(moments.now)
        raise httpx.ConnectError("refused")

    rule, transport = Retry(60 if deadline else seconds), httpx.MockTransport(refuse)
    error = DeadlineExceeded if deadline else ConnectionFailed
    with Client("robot", retry=rule, transport=transport) as client, pytest.raises(error, match="cannot be reached"):
        client.connection.request("GET", "/v1/x", deadline=seconds if deadline else None)
    assert seconds - 0.1 <= asked[-1] < seconds and len(asked) < 20
    pauses = [after - before for before, after in itertools.pairwise(asked)]
    assert min(pauses) > 0.999 * retry.SHORTEST_PAUSE


@pytest.mark.parametrize(("first", "longest"), [(0.1, 0.02), (1.0, 0.01)])
def test_attempts_go_on_after_the_longest_pause(first: float, longest: float, monkeypatch: pytest.MonkeyPatch) -> None:
    moments, asked = Moments(monkeypatch), list[float]()

    def refuse(_: httpx.Request) -> httpx.Response:
        asked.append(moments.now)
        raise httpx.ConnectError("refused")

    transport = httpx.MockTransport(refuse)
    with (
        Client("robot", retry=Retry(1, first, longest), transport=transport) as client,
        pytest.raises(ConnectionFailed),
    ):
        client.liveness()
    pauses = [after - before for before, after in itertools.pairwise(asked)]
    assert asked[-1] > 0.9 and max(pauses) < 1.501 * longest


@pytest.mark.parametrize("back", [1.0, 5.0, 8.0, 9.0])
def test_a_service_that_is_back_before_the_deadline_answers(back: float, monkeypatch: pytest.MonkeyPatch) -> None:
    moments = Moments(monkeypatch)

    def handle(_: httpx.Request) -> httpx.Response:
        if moments.now < back:
            raise httpx.ConnectError("refused")
        return httpx.Response(200)

    with Client("http://robot", transport=httpx.MockTransport(handle)) as client:
        assert client.connection.request("GET", "/v1/x", deadline=10).is_success
    assert moments.now <= (back + 10) / 2, "half of the time that was left is there for the answer"


# Keys and proxies


@pytest.mark.parametrize("key", ["placerec_secret\n", "placerec_sécret", ""])
def test_a_key_that_no_header_can_hold_is_refused_and_not_shown(key: str) -> None:
    with pytest.raises(PlacerecError, match="characters that no key has") as refused:
        Client("http://robot", key=key)
    assert "placerec_s" not in str(refused.value)


@pytest.mark.parametrize("variable", ["http_proxy", "ALL_PROXY"])
@pytest.mark.parametrize("scheme", ["", "http://"])
def test_the_proxy_of_the_environment_is_used(variable: str, scheme: str, monkeypatch: pytest.MonkeyPatch) -> None:
    with socket.create_server(("127.0.0.1", 0)) as listening, ThreadPoolExecutor(1) as pool:
        monkeypatch.setenv(variable, f"{scheme}127.0.0.1:{listening.getsockname()[1]}")
        asked = pool.submit(refuse, listening)
        with Client("http://robot.invalid", retry=Retry(0)) as client, pytest.raises(UnexpectedAnswer, match="418"):
            client.liveness()
        assert asked.result().startswith(b"GET http://robot.invalid/livez ")
    monkeypatch.setenv("no_proxy", "robot.invalid")
    with Client("http://robot.invalid", retry=Retry(0)) as client, pytest.raises(ConnectionFailed):
        client.liveness()


def refuse(listening: socket.socket) -> bytes:
    """Refuse one request; its head."""
    connection, _ = listening.accept()
    with connection:
        head = connection.recv(65536)
        connection.sendall(b"HTTP/1.1 418 I'm a teapot\r\nContent-Length: 0\r\nConnection: close\r\n\r\n")
        return head


@pytest.mark.parametrize("proxy", ["gopher://127.0.0.1:70", "127.0.0.1:65536"])
def test_a_proxy_that_is_none_is_explained(proxy: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("http_proxy", proxy)
    with pytest.raises(ConnectionFailed, match="a proxy that is none"):
        Client("http://robot.invalid")


# Streams of events


def test_a_stream_is_taken_up_again_behind_a_proxy_whose_service_restarts() -> None:
    handle, asked = in_turn(
        httpx.Response(502, content=b"a proxy"),
        problem(429, "rate-exceeded", **{"Retry-After": "0"}),
        httpx.Response(200, content=b"id: 1\nevent: map\ndata: {}\n\n"),
        problem(404, "unknown-map"),
    )
    transport = httpx.MockTransport(handle)
    with Client("http://robot", retry=Retry(10, first_pause=0.01), transport=transport) as client:
        events = client.maps["lab"].events()
        assert next(events).kind == "map"
        with pytest.raises(problems.UnknownMap):
            next(events)
    assert len(asked) == 4


# Answers that are lost


class Script:
    """Faults for the requests to one path, in turn; nothing happens to others."""

    def __init__(self, method: str, *faults: Fault) -> None:
        self._method, self._faults = method.encode(), list(faults)

    def __call__(self, head: bytes) -> Fault:
        return self._faults.pop(0) if head.startswith(self._method) and self._faults else "none"


def through(server: Server, method: str, *faults: Fault) -> FaultProxy:
    return FaultProxy(server.port, choose=Script(method, *faults))


def test_what_was_done_before_the_answer_was_lost_counts(server: Server) -> None:
    with through(server, "POST /v1/maps ", "lose-answer", "none", "lose-answer") as way, Client(way.url) as client:
        lab = client.maps.create("lost-answer", description="made once")
        assert lab.read().description == "made once"
        with pytest.raises(problems.MapExists):
            client.maps.create("lost-answer", description="another")
    with through(server, "PATCH", "lose-answer") as way, Client(way.url) as client:
        lab, revision = client.maps["lost-answer"], client.maps["lost-answer"].read().revision
        assert lab.edit({"description": "edited"}, if_match=revision).description == "edited"
        with pytest.raises(problems.RevisionMismatch):
            lab.edit({"description": "edited"}, if_match=revision)
    server.enrol("lost-answer", "p", jpeg(1), sequence="walk")
    with through(server, "DELETE", "lose-answer", "none", "lose-answer") as way, Client(way.url) as client:
        lab = client.maps["lost-answer"]
        lab.places.delete("p")
        lab.delete()
        with pytest.raises(problems.UnknownMap):
            lab.delete()


def test_a_job_whose_answer_was_lost_is_not_done_twice(server: Server) -> None:
    server.create_map("job-once")
    with FaultProxy(server.port, choose=Script("POST", "lose-answer")) as way, Client(way.url) as client:
        job = client.maps["job-once"].rebuild()
        assert job.wait().state == "succeeded"
        for one in client.jobs.list(map="job-once", kind="rebuild"):  # the cancelled one ends later
            with suppress(JobCancelled):
                client.jobs[one.id].wait()
        found = list(client.jobs.list(map="job-once", kind="rebuild"))
        assert sorted(one.state for one in found) in (["cancelled", "succeeded"], ["succeeded", "succeeded"])
        assert job.id == found[-1].id


def test_a_session_whose_answer_was_lost_is_not_begun_twice(server: Server) -> None:
    server.create_map("session-once")
    with through(server, "POST /v1/maps/session-once/sessions ", "lose-answer") as way, Client(way.url) as client:
        lab = client.maps["session-once"]
        with lab.sessions.begin(lag=1) as session:
            assert [one.id for one in lab.sessions] == [session.id]
            with lab.sessions.begin(lag=1) as other:
                assert other.id != session.id, "it is another request"
        assert way.happened["lose-answer"] == 1


@pytest.mark.parametrize("half", [Client, AsyncClient])
def test_a_service_that_is_not_there_yet_is_waited_for(server: Server, half: Any) -> None:
    fates: list[Fault] = ["cut-before", "lose-answer"]

    async def work(url: str) -> Any:
        client = half(url, retry=Retry(0))
        try:
            ready = client.wait_ready(60)
            return await ready if inspect.isawaitable(ready) else ready
        finally:
            if inspect.isawaitable(closed := client.close()):
                await closed

    with FaultProxy(server.port, choose=lambda _: fates.pop(0) if fates else "none") as way:
        assert set(asyncio.run(work(way.url)).checks.values()) == {"ok"}
        assert way.happened["requests"] == 3


def test_a_service_that_says_it_is_not_ready_is_asked_until_the_time_is_over(monkeypatch: pytest.MonkeyPatch) -> None:
    moments = Moments(monkeypatch)
    answers = itertools.chain([httpx.Response(502, content=b"a proxy")], itertools.repeat(problem(503, "not-ready")))
    with (
        Client("http://robot", transport=httpx.MockTransport(lambda _: next(answers))) as client,
        pytest.raises(NotReadyInTime, match=r"^http://robot was not ready within 20 s: It is not-ready\.$") as told,
    ):
        client.wait_ready(20)
    assert isinstance(told.value.__cause__, problems.NotReady)
    assert 18 < moments.now <= 20


def test_a_service_that_will_not_become_ready_is_not_waited_for(monkeypatch: pytest.MonkeyPatch) -> None:
    moments = Moments(monkeypatch)
    handle, asked = in_turn(problem(401, "key-refused"), httpx.Response(404, content=b"a page"))
    with Client("http://robot", transport=httpx.MockTransport(handle)) as client:
        for kind in (problems.KeyRefused, UnexpectedAnswer):
            with pytest.raises(kind):
                client.wait_ready(20)
        for seconds in (0, -1, "20", float("nan")):
            with pytest.raises(InvalidParameter, match="seconds has to be"):
                client.wait_ready(seconds)  # type: ignore[arg-type]
    with pytest.raises(ClientClosed):
        client.wait_ready(20)
    assert (len(asked), moments.now) == (2, 0)

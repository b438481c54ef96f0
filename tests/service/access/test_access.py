"""Access control: every route with every kind of key, in this process and over the network."""

from __future__ import annotations

import json
import re
import socket
import time
from collections.abc import AsyncIterator, Iterator
from contextlib import asynccontextmanager
from pathlib import Path
from typing import Any

import httpx
import pytest
from fastapi import FastAPI
from websockets.exceptions import ConnectionClosed, InvalidStatus
from websockets.sync.client import ClientConnection, connect
from websockets.typing import Origin

from service.access.gate import WEBSOCKET, Endpoint, endpoints_of, is_loopback_host
from service.access.key_file import FILE
from service.access.keys import Keys
from service.access.roles import OPERATIONS, covers
from service.app.application import create_app
from service.commands.connection.client import CommandTarget, open_service
from service.settings import Settings
from tests.service.encoders import COARSE, install_coarse_encoder
from tests.service.scenes import jpeg
from tests.service.server import Server, assert_problem
from tests.service.wire import eventually

PARTS = {
    "map": "lab", "place": "p", "sequence": "s", "camera": "c", "session": "s-0", "job": "j", "explanation": "e",
    "frame": "1",
}  # fmt: skip


def bearer(token: str) -> dict[str, str]:
    return {"Authorization": f"Bearer {token}"}


def address(endpoint: Endpoint, **parts: str) -> str:
    """A path of this endpoint; unknown parameters become x."""
    return re.sub(r"\{(\w+)(:\w+)?\}", lambda found: {**PARTS, **parts}.get(found[1], "x"), endpoint.path)


# Every endpoint, in this process: a refused request never reaches its operation, so nothing needs to run


@pytest.fixture
def guarded(tmp_path: Path) -> Iterator[tuple[FastAPI, dict[str, str]]]:
    """An application that has keys: one of each role for all maps, and for the map lab alone."""
    store = Keys.of(tmp_path / "data")
    tokens = {role: store.create(role, role)[1] for role in ("query", "enrol", "admin")}
    tokens |= {f"lab-{role}": store.create(f"lab-{role}", role, ["lab"])[1] for role in ("query", "enrol", "admin")}
    app = create_app(Settings(host="127.0.0.1", data_dir=tmp_path / "data"))
    with app.state.gate.keyring:
        yield app, tokens


@asynccontextmanager
async def asking(app: FastAPI) -> AsyncIterator[httpx.AsyncClient]:
    """A client whose requests end with a 500 where they are let in: the engine is not there."""
    transport = httpx.ASGITransport(app, raise_app_exceptions=False)
    async with httpx.AsyncClient(transport=transport, base_url="http://127.0.0.1") as client:
        yield client


class NeverRead(httpx.AsyncByteStream):
    """A body that must not be asked for."""

    async def __aiter__(self) -> AsyncIterator[bytes]:
        raise AssertionError("the body was read")
        yield b""


@pytest.mark.anyio
async def test_every_endpoint_asks_for_the_key_that_its_row_says(guarded: tuple[FastAPI, dict[str, str]]) -> None:
    app, tokens = guarded
    async with asking(app) as client:
        for endpoint in endpoints_of(app.routes):
            if endpoint.method == WEBSOCKET:
                continue  # below, over the wire
            if endpoint.method == "HEAD":
                assert (await client.head(address(endpoint))).status_code == 401
                continue
            rule = endpoint.rule
            unread: dict[str, Any] = {} if endpoint.method == "GET" else {"content": NeverRead()}

            async def ask(
                token: str | None, endpoint: Endpoint = endpoint, body: dict[str, Any] = unread
            ) -> httpx.Response:
                headers = {} if token is None else bearer(token)
                return await client.request(endpoint.method, address(endpoint), headers=headers, **body)

            if rule.role == "open":
                assert (await ask(None)).status_code != 401, endpoint.operation
                continue
            refused = assert_problem(await ask(None), 401, "key-needed")
            assert "lab" not in refused["detail"]
            assert (await ask(None)).headers["www-authenticate"].startswith("Bearer")
            unknown = await ask("placerec_000000000000_" + "A" * 43)
            app.state.gate.rates._failures._full_at.clear()  # another address, as it were
            assert_problem(unknown, 401, "key-refused")
            assert 'error="invalid_token"' in unknown.headers["www-authenticate"]
            for role in ("query", "enrol"):
                if not covers(role, rule.role):
                    assert_problem(await ask(tokens[role]), 403, "role-too-low")
            if rule.maps == "all":
                assert_problem(await ask(tokens["lab-admin"]), 403, "map-forbidden")
            elif "{map}" in endpoint.path:
                there = await client.request(
                    endpoint.method, address(endpoint, map="yard"), headers=bearer(tokens["lab-admin"]), **unread
                )
                assert_problem(there, 403, "map-forbidden")


@pytest.mark.anyio
async def test_without_a_key_no_answer_shows_the_content(guarded: tuple[FastAPI, dict[str, str]]) -> None:
    app, tokens = guarded
    async with asking(app) as client:
        for method, path in (
            ("GET", "/nowhere"),
            ("PUT", "/v1/maps"),
            ("OPTIONS", "/v1/maps"),
            ("GET", "/v1/maps/lab/"),
        ):
            assert_problem(await client.request(method, path), 401, "key-needed")
        assert (await client.head("/v1/maps")).status_code == 401
        assert (await client.head("/livez")).status_code == 200
        right = bearer(tokens["query"])
        assert_problem(await client.get("/nowhere", headers=right), 404, "unknown-path")
        assert_problem(await client.put("/v1/maps", headers=right), 405, "method-not-allowed")
        for headers in ([("Authorization", right["Authorization"])] * 2, [("Cookie", f"key={tokens['admin']}")]):
            assert_problem(await client.get("/v1/maps", headers=headers), 401, "key-needed")
        assert_problem(await client.get(f"/v1/maps?key={tokens['admin']}"), 401, "key-needed")


@pytest.mark.anyio
async def test_under_a_path_of_a_proxy_the_same_key_is_needed(tmp_path: Path) -> None:
    Keys.of(tmp_path).create("ann", "admin")
    app = create_app(Settings(host="127.0.0.1", data_dir=tmp_path, root_path="/placerec"))
    with app.state.gate.keyring:
        async with asking(app) as client:
            for path in ("/placerec/v1/maps", "/v1/maps", "/placerec", "/placerec/placerec/v1/maps"):
                assert (await client.get(path)).status_code == 401, path
            assert (await client.get("/placerec/livez")).status_code == 200


@pytest.mark.anyio
async def test_a_damaged_file_of_keys_stops_the_start(tmp_path: Path) -> None:
    store = Keys.of(tmp_path)
    store.create("ann", "admin")
    (tmp_path / FILE).write_bytes(b"")
    app = create_app(Settings(host="0.0.0.0", data_dir=tmp_path))
    with pytest.raises(Exception, match="is not a file of keys"):
        async with app.router.lifespan_context(app):
            raise AssertionError("it started")


@pytest.mark.anyio
async def test_whoever_opens_the_data_directory_needs_no_key(tmp_path: Path) -> None:
    Keys.of(tmp_path).create("ann", "query")
    async with open_service(CommandTarget(None, tmp_path)) as service:
        assert (await service.get("/v1/maps"))["items"] == []
        await service.request("POST", "/v1/maps", json={"id": "lab"})


# Web pages, while there are no keys


@pytest.mark.parametrize(
    ("headers", "status"),
    [
        ({}, 200),
        ({"Host": "localhost:8000"}, 200),
        ({"Host": "[::1]:8000"}, 200),
        ({"Host": "evil.example"}, 403),
        ({"Host": "127.0.0.1.evil.example"}, 403),
        ({"Sec-Fetch-Site": "cross-site"}, 403),
        ({"Sec-Fetch-Site": "same-site"}, 403),
        ({"Sec-Fetch-Site": "same-origin"}, 200),
        ({"Sec-Fetch-Site": "none"}, 200),
        ({"Origin": "http://evil.example"}, 403),
        ({"Origin": "null"}, 403),
        ({"Origin": "http://["}, 403),
        ({"Host": "localhost:8000", "Origin": "http://localhost:8000"}, 200),
        ({"Host": "localhost:8000", "Origin": "http://localhost:3000"}, 403),
    ],
)
def test_pages_of_other_sites_are_refused_without_keys(
    client: httpx.Client, headers: dict[str, str], status: int
) -> None:
    response = client.get("/v1/maps?limit=1", headers=headers)
    assert response.status_code == status, response.text
    if status == 403:
        assert_problem(response, 403, "foreign-page")
        assert client.post("/v1/maps", headers=headers, json={"id": "pwned"}).status_code == 403
        assert client.get("/livez", headers=headers).status_code == 200


def test_a_page_of_another_site_gets_no_stream(server: Server, traverse: str) -> None:
    there = f"ws://127.0.0.1:{server.port}/v1/maps/{traverse}/sessions/s-0/stream"
    with pytest.raises(InvalidStatus) as refused, connect(there, origin=Origin("http://evil.example")):
        pass
    assert refused.value.response.status_code == 403


def test_names_of_this_machine() -> None:
    for host in (b"localhost", b"LOCALHOST:80", b"a.localhost", b"127.0.0.1", b"127.9.9.9:1", b"[::1]"):
        assert is_loopback_host(host), host
    for host in (b"", b"localhost.evil.example", b"10.0.0.1", b"0.0.0.0", b"[::", b"evil@127.0.0.1.x", b"\xff"):
        assert not is_loopback_host(host), host


HOSTS = {
    b"10.0.0.1:8000": 200, b"[fd00::1]:8000": 200, b"placerec:8000": 200, b"localhost": 200, b"LAB.example:80": 200,
    b"evil.example": 403, b"lab.example.evil.example": 403, b"placerec.": 403, b"127.0.0.1.evil.example": 403,
    b"": 403, b"0x7f.1": 403, b"\xff": 403,
}  # fmt: skip


@pytest.mark.anyio
@pytest.mark.parametrize("host", HOSTS)
async def test_a_container_without_keys_is_not_reached_under_a_name_that_leads_to_it(
    tmp_path: Path, host: bytes
) -> None:
    """On all addresses: a page may have its own name lead to the published port, and send to it as if to itself."""
    settings = Settings(host="0.0.0.0", allow_anonymous=True, allowed_hosts="lab.example,yard", data_dir=tmp_path)
    app = create_app(settings)
    with app.state.gate.keyring:
        async with asking(app) as client:
            page = [(b"Host", host), (b"Sec-Fetch-Site", b"same-origin")]
            response = await client.get("/v1/nowhere", headers=page)
            if HOSTS[host] == 403:
                assert_problem(response, 403, "foreign-page")
            else:
                assert_problem(response, 404, "unknown-path")


@pytest.mark.parametrize("given", ["lab.example,", "a b", "lab.example:80", "*", "http://lab"])
def test_names_of_hosts_are_checked(given: str) -> None:
    with pytest.raises(ValueError, match="allowed_hosts"):
        Settings(allowed_hosts=given)


# Over the wire


class Keyed:
    """A server with keys."""

    def __init__(self, folder: Path) -> None:
        install_coarse_encoder(folder / "models")
        self.store = Keys.of(folder / "data")
        _, self.admin = self.store.create("ann", "admin")
        _, self.query = self.store.create("robot", "query", ["lab"])
        _, self.enrol = self.store.create("eve", "enrol", ["lab"])
        settings = {"encoder": COARSE, "log_level": "error", "audit_file": folder / "audit.jsonl"}
        self.server = Server(folder, settings, key=self.admin).wait()

    def as_(self, token: str) -> httpx.Client:
        return httpx.Client(base_url=self.server.client.base_url, headers=bearer(token), timeout=60)


@pytest.fixture(scope="module")
def keyed(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Keyed]:
    made = Keyed(tmp_path_factory.mktemp("keyed"))
    for name in ("lab", "yard"):
        made.server.create_map(name)
        assert made.server.enrol(name, "p1", jpeg(1), sequence="monday").status_code == 201
    yield made
    assert made.server.stop() == 0
    log = made.server.log_file.read_text()
    for token in (made.admin, made.query, made.enrol):
        assert token not in log and token[-43:] not in log
    assert not made.server.lines(level="error")


@pytest.mark.thorough
def test_a_key_of_some_maps_sees_no_other(keyed: Keyed) -> None:
    with keyed.as_(keyed.query) as robot:
        assert [item["id"] for item in robot.get("/v1/maps").json()["items"]] == ["lab"]
        page = robot.get("/v1/maps?limit=1").json()
        assert [item["id"] for item in page["items"]] == ["lab"] and page["next_cursor"] is None
        assert_problem(robot.get("/v1/maps/yard"), 403, "map-forbidden")
        assert_problem(robot.get("/v1/maps/not-there"), 403, "map-forbidden")
        frame: dict[str, Any] = {"content": jpeg(1), "headers": {"Content-Type": "image/jpeg"}}
        assert robot.post("/v1/maps/lab/query", **frame).status_code == 200
        assert robot.post("/v1/maps/lab/query?k=1&explain=true", **frame).status_code == 200
        assert_problem(robot.post("/v1/maps/yard/query", **frame), 403, "map-forbidden")
        assert_problem(robot.post("/v1/query?maps=lab,yard", **frame), 403, "map-forbidden")
        several = robot.post("/v1/query", **frame)
        assert [one["map"] for one in several.json()["maps"]] == ["lab"]
        assert_problem(robot.get("/metrics"), 403, "map-forbidden")
        assert_problem(robot.put("/v1/maps/lab/places/p2", **frame), 403, "role-too-low")
    with keyed.as_(keyed.enrol) as operator:
        assert operator.put("/v1/maps/lab/places/p2", **frame).status_code == 201
        assert_problem(operator.put("/v1/maps/yard/places/p2", **frame), 403, "map-forbidden")
        assert_problem(operator.delete("/v1/maps/lab"), 403, "role-too-low")


def known(client: httpx.Client) -> bool:
    """Whether its key, which was made beside the service, comes to be known; until then it is one of the wrong keys, of
    which an address may send one a second."""
    return eventually(lambda: client.get("/v1/maps").status_code == 200, every=1)


@pytest.mark.thorough
def test_a_map_is_made_only_under_an_id_of_the_key(keyed: Keyed) -> None:
    _, token = keyed.store.create("founder", "admin", ["hall", "lab"])
    with keyed.as_(token) as founder:
        assert known(founder)
        assert_problem(founder.post("/v1/maps", json={"id": "cellar"}), 403, "map-forbidden")
        assert founder.post("/v1/maps", json={"id": "hall"}).status_code == 201
        assert_problem(founder.post("/v1/maps/lab/merge", json={"from": "yard"}), 403, "map-forbidden")
        assert_problem(founder.post("/v1/maps/lab/re-encode", json={"to": "cellar"}), 403, "map-forbidden")


def test_jobs_are_those_of_the_keys_maps(keyed: Keyed) -> None:
    post, get = keyed.server.client.post, keyed.server.client.get
    own = post("/v1/maps/lab/prune", json={"dry_run": True}).json()["id"]
    both = post("/v1/maps/lab/merge", json={"from": "yard"}).json()["id"]
    for job in (own, both):
        get(f"/v1/jobs/{job}?wait=30")
    with keyed.as_(keyed.enrol) as operator:
        assert [job["id"] for job in operator.get("/v1/jobs").json()["items"]] == [own]
        assert operator.get(f"/v1/jobs/{own}").status_code == 200
        for path in (f"/v1/jobs/{both}", f"/v1/jobs/{both}/events"):
            assert_problem(operator.get(path), 404, "unknown-job")
        assert_problem(operator.post(f"/v1/jobs/{both}/cancel"), 404, "unknown-job")
        refused = operator.post(f"/v1/jobs/{own}/cancel")
        assert_problem(refused, 403, "role-too-low")


def test_a_body_is_not_waited_for(keyed: Keyed) -> None:
    with socket.create_connection(("127.0.0.1", keyed.server.port), timeout=20) as raw:
        raw.sendall(
            b"PUT /v1/maps/lab/places/p9 HTTP/1.1\r\nHost: x\r\nContent-Type: image/jpeg\r\n"
            b"Content-Length: 10000000\r\n\r\nonly this"
        )
        assert raw.recv(4096).startswith(b"HTTP/1.1 401 ")


def stream(keyed: Keyed, token: str | None, map_id: str, session: str) -> ClientConnection:
    there = f"ws://127.0.0.1:{keyed.server.port}/v1/maps/{map_id}/sessions/{session}/stream"
    return connect(there, compression=None, additional_headers={} if token is None else bearer(token))


@pytest.mark.thorough
def test_a_stream_needs_a_key_and_ends_with_it(keyed: Keyed) -> None:
    key, token = keyed.store.create("streamer", "query", ["lab"])
    alike = keyed.as_(token)
    assert known(alike)
    session = alike.post("/v1/maps/lab/sessions", json={}).json()["id"]
    for wrong, map_id, status in ((None, "lab", 401), (token[:-1] + "~", "lab", 401), (keyed.query, "yard", 403)):
        with pytest.raises(InvalidStatus) as refused, stream(keyed, wrong, map_id, session):
            pass
        assert refused.value.response.status_code == status
        assert json.loads(refused.value.response.body)["status"] == status
    with stream(keyed, token, "lab", session) as connection:
        connection.send(jpeg(1))
        assert json.loads(connection.recv(timeout=60))["frames"] == 1
        keyed.store.revoke(key.id)
        assert eventually(lambda: alike.get("/v1/maps").status_code == 401)
        alike.close()
        connection.send(jpeg(1))
        assert json.loads(connection.recv(timeout=60))["problem"]["type"].endswith("key-refused")
        with pytest.raises(ConnectionClosed) as closed:
            connection.recv(timeout=60)
        assert closed.value.rcvd is not None and closed.value.rcvd.code == 1008


@pytest.mark.thorough
def test_idle_streams_end_with_their_key(keyed: Keyed) -> None:
    """Nothing is sent and nothing happens: the service looks at the key of who waits."""
    key, token = keyed.store.create("idler", "query", ["lab"])
    with keyed.as_(token) as idler:
        assert known(idler)
        session = idler.post("/v1/maps/lab/sessions", json={}).json()["id"]
        with stream(keyed, token, "lab", session) as robot, idler.stream("GET", "/v1/maps/lab/events") as events:
            lines = events.iter_lines()
            assert next(lines)
            keyed.store.revoke(key.id)
            assert json.loads(robot.recv(timeout=60))["problem"]["type"].endswith("key-refused")
            with pytest.raises(ConnectionClosed) as closed:
                robot.recv(timeout=60)
            assert closed.value.rcvd is not None and closed.value.rcvd.code == 1008
            assert list(lines) is not None, "it ends"


@pytest.mark.thorough
def test_a_key_counts_and_ends_beside_a_running_service(keyed: Keyed) -> None:
    key, token = keyed.store.create("passing", "query")
    with keyed.as_(token) as passing:
        assert known(passing)
        assert passing.get("/metrics").status_code == 200
        keyed.store.revoke(key.id)
        answers: list[httpx.Response] = []

        def is_refused() -> bool:
            answers.append(passing.get("/v1/maps"))
            return answers[-1].status_code == 401

        assert eventually(is_refused)
        assert_problem(answers[-1], 401, "key-refused")


def test_every_change_is_logged_with_its_caller(keyed: Keyed) -> None:
    with keyed.as_(keyed.enrol) as operator:
        asked = {"X-Request-Id": "an-edit", "traceparent": "00-" + "ab" * 16 + "-" + "cd" * 8 + "-01"}
        edited = operator.patch("/v1/maps/lab/places/p1", json={"metadata": {"secret": "door"}}, headers=asked)
        assert edited.status_code == 200
        operator.delete("/v1/maps/lab/places/absent", headers={"X-Request-Id": "a-miss"})
        operator.patch("/v1/maps/lab", json={}, headers={"X-Request-Id": "a-refusal"})
    keyed.server.enrol("lab", "beside", jpeg(1, width=300), sequence="monday")  # else there is nothing to prune
    job = keyed.server.client.post("/v1/maps/lab/prune", json={"dry_run": True}, headers={"X-Request-Id": "a-job"})
    keyed.server.client.post("/v1/maps/lab/verify?background=true", headers={"X-Request-Id": "a-look"})

    def told(request_id: str) -> list[dict[str, Any]]:
        return keyed.server.lines(logger="placerec.audit", request_id=request_id)

    (change,) = told("an-edit")
    eve = {"principal": "eve", "key": keyed.store.all()[2].id, "client": "127.0.0.1"}
    expected = {"message": "change", "operation": "edit_place", "map": "lab", "place": "p1", "status": 200, **eve}
    assert expected.items() <= change.items() and change["trace_id"] == "ab" * 16
    assert "door" not in json.dumps(change)
    (miss,) = told("a-miss")
    assert (miss["status"], miss["place"]) == (404, "absent")
    (refusal,) = told("a-refusal")
    assert (refusal["message"], refusal["problem"], refusal["operation"]) == ("refused", "role-too-low", "edit_map")
    until = time.monotonic() + 60
    while len(lines := told("a-job")) < 3 and time.monotonic() < until:
        time.sleep(0.02)
    assert sorted(line["message"] for line in lines) == ["change", "job running", "job succeeded"]
    assert all(line["principal"] == "ann" and line["job"] == job.json()["id"] for line in lines)
    while len(looks := told("a-look")) < 2 and time.monotonic() < until:
        time.sleep(0.02)
    assert [(line["message"], line["principal"]) for line in looks] == [
        ("job running", "ann"),
        ("job succeeded", "ann"),
    ]
    kept = [json.loads(line) for line in (keyed.server.folder / "audit.jsonl").read_text().splitlines()]
    assert lines == [line for line in kept if line.get("request_id") == "a-job"]
    counted = keyed.server.client.get("/metrics").text
    assert 'placerec_problems_total{type="role-too-low"}' in counted


def test_damaged_maps_are_listed_for_those_who_may_know(keyed: Keyed) -> None:
    assert httpx.get(f"http://127.0.0.1:{keyed.server.port}/readyz").json()["quarantined"] == []
    assert OPERATIONS["check_readiness"].maps == "shown"


def test_a_bind_to_the_network_is_served_once_there_are_keys(tmp_path: Path) -> None:
    settings = Settings(host="0.0.0.0", data_dir=tmp_path, allow_anonymous=False)
    Keys.of(tmp_path).create("ann", "admin")
    assert create_app(settings).state.gate.keyring is not None


# Sessions


@pytest.mark.thorough
def test_a_session_belongs_to_the_key_that_began_it(keyed: Keyed) -> None:
    """Others neither send frames into it nor end it, but for keys of the role admin, which may end it."""
    tokens = {name: keyed.store.create(name, "query", ["lab"])[1] for name in ("walker", "other")}
    with keyed.as_(tokens["walker"]) as walker, keyed.as_(tokens["other"]) as other, keyed.as_(keyed.enrol) as eve:
        assert known(walker) and known(other)
        begun = walker.post("/v1/maps/lab/sessions", json={}).json()["id"]
        path, kind = f"/v1/maps/lab/sessions/{begun}", {"Content-Type": "image/jpeg"}
        for client in (other, eve, keyed.server.client):
            sent = client.post(f"{path}/frames", content=jpeg(1), headers=kind)
            assert_problem(sent, 403, "session-of-another")
        for token in (tokens["other"], keyed.enrol, keyed.admin):
            with pytest.raises(InvalidStatus) as refused, stream(keyed, token, "lab", begun):
                pass
            assert refused.value.response.status_code == 403
        assert walker.post(f"{path}/frames", content=jpeg(1), headers=kind).status_code == 200
        for client in (other, eve):
            assert_problem(client.delete(path), 403, "session-of-another")
            assert client.get(path).status_code == 200
        keyed.store.revoke("walker")
    _, again = keyed.store.create("walker", "query", ["lab"])  # the robot's key is replaced by another
    with keyed.as_(again) as walker:
        assert known(walker)
        assert walker.post(f"{path}/frames", content=jpeg(2), headers=kind).status_code == 200
        assert keyed.server.client.delete(path).status_code == 204
        assert walker.get(path).status_code in (404, 410)

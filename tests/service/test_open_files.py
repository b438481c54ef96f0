"""Descriptors: how many maps and connections get, and a service that has few."""

from __future__ import annotations

import socket
from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path

import pytest

from service.open_files import FILES_OF_A_MAP, MOST_MAPS, RESERVE, memory, shares
from tests.service.encoders import COARSE, install_coarse_encoder
from tests.service.scenes import jpeg
from tests.service.server import Server, typed
from tests.service.wire import answer, get, open_files, opened

FILES, MAPS = 300, 60
"""The descriptors of the service, and its maps, which would take as many together."""

GIB = 1 << 30


@pytest.mark.parametrize(
    ("files", "gigabytes", "wanted", "found"),
    [
        (1 << 20, 64, None, (1000, MOST_MAPS)),
        (1 << 20, 64, 1000, (1000, 1000)),
        (1 << 20, 2, None, (1000, 47)),
        (1024, 64, None, (384, 76)),
        (1024, 64, 10, (384, 10)),
        (300, 64, None, (70, 14)),
        (100, 64, None, (1, 1)),
    ],
)
def test_connections_and_maps_share_what_there_is(
    files: int, gigabytes: int, wanted: int | None, found: tuple[int, int]
) -> None:
    assert shares(files, gigabytes * GIB, 1000, wanted) == found


@pytest.mark.parametrize("files", [256, 300, 1024, 2024, 4096, 20_000])
@pytest.mark.parametrize("connections", [1, 100, 1000, 1_000_000])
def test_a_reserve_is_left(files: int, connections: int) -> None:
    most = shares(files, 64 * GIB, connections, 100_000)
    assert most.connections + FILES_OF_A_MAP * most.maps <= files - RESERVE


def test_the_memory_is_that_of_the_container(tmp_path: Path) -> None:
    whole = memory(tmp_path / "missing")
    for content, found in (("max\n", whole), ("104857600\n", 100 << 20), (f"{whole * 2}\n", whole)):
        (tmp_path / "memory.max").write_text(content)
        assert memory(tmp_path / "memory.max") == found


@pytest.fixture(scope="module")
def small(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Server]:
    """A service with few descriptors, some of which it has to request."""
    folder = tmp_path_factory.mktemp("small")
    install_coarse_encoder(folder / "models")
    server = Server(folder, {"encoder": COARSE}, files=(FILES - 50, FILES)).wait()
    yield server
    assert server.stop() == 0


def opened_maps(server: Server) -> dict[str, int]:
    found: dict[str, int] = server.client.get("/readyz").json()["open"]
    return found


def test_the_soft_limit_is_raised_and_readiness_shows_what_is_open(small: Server) -> None:
    (warning,) = small.lines(logger="placerec.open_files")
    assert f"allows {FILES} open files: at most 70 connections and 14 maps" in warning["message"]
    found = opened_maps(small)
    assert found["most_files"] == FILES and found["most_maps"] == 14
    assert abs(found["files"] - open_files(small)) <= 8
    small.create_map("shown")
    assert small.enrol("shown", "p", jpeg(1)).status_code == 201
    assert opened_maps(small)["maps"] == found["maps"] + 1
    metrics = small.client.get("/metrics").text
    assert f"placerec_maps_open {found['maps'] + 1:.1f}" in metrics and "placerec_maps_open_limit 14.0" in metrics
    assert f"process_max_fds {FILES:.1f}" in metrics
    assert small.client.delete("/v1/maps/shown").status_code == 204


def test_more_maps_than_may_be_open_are_queried_at_once_and_newcomers_are_answered(small: Server) -> None:
    names = [f"m{number}" for number in range(MAPS)]
    for number, name in enumerate(names):
        small.create_map(name)
        assert small.enrol(name, "p", jpeg(number % 4)).status_code == 201
    for _ in range(2):
        response = small.client.post(
            "/v1/query", params={"maps": ",".join(names)}, content=jpeg(0), headers=typed(jpeg(0))
        )
        assert response.status_code == 200, response.text
        assert not [one for one in response.json()["maps"] if one["problem"] is not None]
    found = opened_maps(small)
    assert found["maps"] <= found["most_maps"] and found["files"] <= FILES - RESERVE + 64
    with ExitStack() as held:
        connections: list[socket.socket] = []
        for number in range(FILES):  # each of which leaves, at last, a place to the next one
            connections.append(held.enter_context(opened(small, f"127.0.2.{number % 100 + 1}")))
            connections[-1].sendall(get("/livez"))
            assert answer(connections[-1])[0] == 200
        assert small.query("m0", jpeg(0))["matches"]

"""A service, a node and a peer of it, in a network of their own."""

from __future__ import annotations

from collections.abc import Iterator

import pytest

from service.access.keys import Keys
from tests.clients.ros2.network import NoNetwork, own_network
from tests.clients.ros2.robot import VENV, Robot, Site, walk, walked_again
from tests.service.scenes import encoded
from tests.service.server import Server


@pytest.fixture(scope="module")
def network() -> Iterator[None]:
    """The module's own network; without ROS or the right to make one the tests are skipped."""
    if not (VENV / "installed").exists():
        pytest.skip("there is no .venv-ros: ROS's wheels cannot be had for this Python and machine (environment ros)")
    opened = own_network()
    try:
        opened.__enter__()
    except NoNetwork as error:
        pytest.skip(f"this machine allows no network namespace: {error}")
    yield
    opened.__exit__(None, None, None)


@pytest.fixture(scope="module")
def site(network: None, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Site]:
    """A service with keys, and the map ``walk`` of drawn walls."""
    folder = tmp_path_factory.mktemp("site")
    store = Keys.of(folder / "service" / "data")
    keys = {role: store.create(role, role)[1] for role in ("query", "enrol", "admin")}
    server = Server(folder / "service", key=keys["admin"], forked=False)
    frames = walk()
    made = Site(folder, server, keys, frames, walked_again(frames))
    for number, data in enumerate(made.again):
        (folder / f"again-{number:02d}.jpg").write_bytes(data)
    for role, key in keys.items():
        (folder / f"{role}.key").write_text(key)
    made.start_peers()
    server.wait()
    made.enrol("walk")
    made.server.query("walk", encoded(frames[0]), verify="always")  # the first one is slow
    yield made
    made.stop()


@pytest.fixture
def robot(site: Site) -> Iterator[Robot]:
    """The node and its peer; the node is not configured before and after each test."""
    made = Robot(site)
    yield made
    made.end()

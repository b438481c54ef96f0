"""The whole interface by schemathesis: its examples, and a few drawn requests of each operation, the same each time."""

from __future__ import annotations

import re
from collections.abc import Iterator

import pytest

from service.access.keys import Keys
from service.access.roles import OPERATIONS
from service.http.openapi import LINKS
from tests.fuzz import api
from tests.fuzz.encoder import SMALL, install_small_encoder
from tests.service.server import Server


@pytest.fixture(scope="module")
def keyed(tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[Server, str]]:
    """A running service and its administrator's key: drawn requests create keys, with which it asks for one."""
    folder = tmp_path_factory.mktemp("keyed")
    install_small_encoder(folder / "models")
    _, key = Keys.of(folder / "data").create("fuzzer", "admin")
    server = Server(folder, {**api.TIGHT, "encoder": SMALL}, key=key).wait()
    yield server, key
    server.check_running()
    assert server.stop() == 0
    log = server.log_file.read_text()
    assert "Traceback" not in log, log[-4000:]


FEW = ("--max-examples", "2", "--generation-deterministic", "--no-shrink")


@pytest.mark.thorough
@pytest.mark.parametrize(
    ("phase", "operations"), [("examples", 35), pytest.param("fuzzing", 45, marks=pytest.mark.thorough)]
)
def test_every_operation_keeps_to_its_description(keyed: tuple[Server, str], phase: str, operations: int) -> None:
    server, key = keyed
    done = api.run(str(server.client.base_url), seed=1, phases=phase, more=FEW, key=key)
    assert done.returncode == 0, done.stdout[-6000:] + done.stderr[-2000:]
    found = re.search(r"Tested: (\d+)", done.stdout)
    assert found is not None and int(found[1]) >= operations, done.stdout[-3000:]


def test_links_lead_to_operations() -> None:
    targets = {target for statuses in LINKS.values() for links in statuses.values() for target in links}
    assert targets | set(LINKS) <= set(OPERATIONS)

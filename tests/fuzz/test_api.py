"""The whole interface by schemathesis: its examples, and a few drawn requests of each operation, the same each time."""

from __future__ import annotations

import re

import pytest

from service.access.roles import OPERATIONS
from service.http.openapi import LINKS
from tests.fuzz import api
from tests.service.server import Server

FEW = ("--max-examples", "2", "--generation-deterministic", "--no-shrink")


@pytest.mark.parametrize(("phase", "operations"), [("examples", 35), ("fuzzing", 45)])
def test_every_operation_keeps_to_its_description(fuzzed: Server, phase: str, operations: int) -> None:
    done = api.run(str(fuzzed.client.base_url), seed=1, phases=phase, more=FEW)
    assert done.returncode == 0, done.stdout[-6000:] + done.stderr[-2000:]
    found = re.search(r"Tested: (\d+)", done.stdout)
    assert found is not None and int(found[1]) >= operations, done.stdout[-3000:]


def test_links_lead_to_operations() -> None:
    targets = {target for statuses in LINKS.values() for links in statuses.values() for target in links}
    assert targets | set(LINKS) <= set(OPERATIONS)

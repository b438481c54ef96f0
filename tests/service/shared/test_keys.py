"""Keys and the audit trail that services share."""

from __future__ import annotations

import time
from collections.abc import Callable
from datetime import UTC, datetime, timedelta
from pathlib import Path

import httpx
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from service.access.keys import Key, KeyRecords, Keys
from service.errors.faults import Fault
from service.shared.database import SharedDatabase
from service.shared.keys import SharedKeys
from tests.service.server import Server, assert_problem
from tests.service.shared.postgres import Postgres
from tests.service.shared.services import MAP, two_services

pytestmark = [pytest.mark.cluster]

UNTIL = datetime.now(UTC) + timedelta(days=30)
NAMES = ("ann", "bob", "eve")
STEPS = st.lists(
    st.tuples(
        st.sampled_from(["create", "narrow", "revoke", "use"]),
        st.sampled_from(NAMES),
        st.sampled_from(["query", "enrol", "admin"]),
        st.sampled_from([None, frozenset({"lab"}), frozenset({"lab", "yard"})]),
        st.booleans(),
    ),
    max_size=15,
)


def outcome(records: KeyRecords, step: tuple[str, str, str, frozenset[str] | None, bool]) -> object:
    """What comes of a step: what the key is then, or the error."""
    what, name, role, maps, keep_admin = step
    found = [key.id for key in records.all() if key.name == name]
    try:
        if what == "create":
            key: Key | None = records.create(name, role, maps, UNTIL, keep_admin)[0]  # type: ignore[arg-type]
        elif what == "narrow":
            key = records.narrow(found[-1] if found else name, {"role": role, "maps": maps}, keep_admin)
        elif what == "revoke":
            key = records.revoke(name, keep_admin)
        else:
            key = None
            if found:
                records.note_uses(dict.fromkeys(found, UNTIL))
    except Fault as error:
        return type(error)
    return None if key is None else traits(key)


def traits(key: Key) -> tuple[object, ...]:
    """A key without what is made at random."""
    return key.name, key.role, key.maps, key.expires_at, key.revoked_at is None, key.last_used_at


@settings(max_examples=25, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(STEPS)
def test_they_are_stored_as_in_a_file(
    database: SharedDatabase,
    tmp_path_factory: pytest.TempPathFactory,
    steps: list[tuple[str, str, str, frozenset[str] | None, bool]],
) -> None:
    database.query("empty the table", "TRUNCATE service.keys")
    shared, file = SharedKeys(database), Keys.of(tmp_path_factory.mktemp("keys"))
    for step in steps:
        assert outcome(shared, step) == outcome(file, step), step
        assert [traits(key) for key in shared.all()] == [traits(key) for key in file.all()]
        assert shared.exists() == file.exists()


def within_a_second(check: Callable[[], bool]) -> None:
    until = time.monotonic() + 10  # a second on a machine that has nothing else to do
    while not check():
        assert time.monotonic() < until
        time.sleep(0.05)


def test_keys_work_at_all_services(
    prepared: Path, tmp_path: Path, postgres: Postgres, database: SharedDatabase
) -> None:
    admin = SharedKeys(database).create("ops", "admin")[1]
    with two_services(prepared, tmp_path, postgres.address, {}, admin) as (one, other):
        assert_problem(httpx.get(f"{one.client.base_url}/v1/maps"), 401, "key-needed")
        made = one.client.post("/v1/keys", json={"name": "robot", "role": "query"}).json()

        def status(server: Server) -> int:
            headers = {"Authorization": f"Bearer {made['key']}"}
            return httpx.get(f"{server.client.base_url}/v1/maps/{MAP}", headers=headers).status_code

        assert status(one) == 200, "at once where it was made"
        within_a_second(lambda: status(other) == 200)
        assert other.client.delete(f"/v1/keys/{made['id']}").status_code == 200
        assert status(other) == 401, "at once where it was revoked"
        within_a_second(lambda: status(one) == 401)

        def trail(server: Server) -> list[tuple[str | None, str]]:
            page = server.client.get("/v1/audit", params={"key": "ops"}).json()
            assert page["source"] == "database"
            return [(line["operation"], line["replica"]) for line in page["items"]]

        within_a_second(lambda: len(trail(one)) == 2)
        assert trail(one) == trail(other)
        (revoked, at_other), (created, at_one) = trail(one)
        assert (revoked, created) == ("delete_key", "create_key") and at_one != at_other

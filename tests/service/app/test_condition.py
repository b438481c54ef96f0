"""What a service says of itself: whether it answers, whether it takes writes, and to whom it names addresses."""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from pathlib import Path

import pytest

from core.disk.files import disk_errors
from core.errors import InvalidModel, PlacerecError, StorageFailure, StorageFull
from core.outage import Unreachable
from service.access.roles import ANONYMOUS, NOBODY, OWNER, Principal
from service.app.probe import Finding, Probe
from service.app.runtime import Condition
from service.errors.faults import KeysUnreadable, NotReady
from service.errors.problems import problem_of

PG = Unreachable("PostgreSQL", 'cannot be reached: connection to server at "10.0.0.3", port 5432 failed')


def finding_of(error: PlacerecError | None) -> Finding:
    """What a probe says whose check raises an error."""

    def check() -> None:
        if error is not None:
            raise error

    return asyncio.run(Probe(check, 1, "silent").finding())


def condition(**findings: Finding) -> Condition:
    """The condition of a service with these checks."""
    return Condition(findings)


def test_a_full_disk_degrades_and_another_fault_of_it_is_unready() -> None:
    full = condition(encoder=Finding(), disk=finding_of(StorageFull("The disk is full.")))
    full.require(confided=False)
    assert full.degraded is not None and full.degraded.text == "The disk is full."
    failing = condition(encoder=Finding(), disk=finding_of(StorageFailure("The disk refused to write.")))
    assert failing.degraded is None
    with pytest.raises(NotReady, match="disk: The disk refused to write"):
        failing.require(confided=False)
    sound = condition(disk=finding_of(None))
    sound.require(confided=False)
    assert sound.degraded is None


def test_a_service_that_is_not_ready_names_addresses_to_those_who_may_know_them() -> None:
    found = condition(maps=finding_of(PG))
    with pytest.raises(NotReady) as told:
        found.require(confided=True)
    assert "10.0.0.3" in str(told.value) and "5432" in told.value.checks["maps"]
    with pytest.raises(NotReady) as told:
        found.require(confided=False)
    assert told.value.checks == {"maps": "PostgreSQL cannot be reached."}
    assert "10.0.0.3" not in str(told.value)


@pytest.mark.parametrize(
    "error",
    [
        PG,
        Unreachable("PostgreSQL", 'refuses the service: FATAL: no pg_hba.conf entry for host "10.0.0.3"'),
        Unreachable("Milvus", "cannot be reached: ipv4:10.0.0.3:19530: Failed to connect"),
        KeysUnreadable("/srv/10.0.0.3/keys.sqlite is damaged: a page is torn."),
        InvalidModel("m.safetensors cannot be read: No such file or directory: /srv/10.0.0.3/m.safetensors"),
    ],
    ids=lambda error: f"{type(error).__name__} {str(error)[:24]}",
)
def test_a_problem_names_no_address_to_those_who_may_not_know_them(error: Exception) -> None:
    assert "10.0.0.3" in problem_of(error, confided=True).model_dump_json()
    public = problem_of(error, confided=False)
    assert "10.0.0.3" not in public.model_dump_json() and "/srv" not in public.detail
    assert public.detail.endswith(".") and public.status == 503


@pytest.mark.parametrize(
    ("principal", "confided"),
    [
        (NOBODY, False),
        (ANONYMOUS, False),
        (Principal("robot", "k1", "query", None), False),
        (Principal("mapper", "k2", "enrol", None), False),
        (Principal("tenant", "k3", "admin", frozenset({"lab"})), False),
        (Principal("ops", "k4", "admin", None), True),
        (OWNER, True),
    ],
)
def test_addresses_are_for_admins_of_all_maps_and_for_who_opened_the_data_himself(
    principal: Principal, confided: bool
) -> None:
    assert principal.confided is confided


@pytest.mark.parametrize("act", [Path("/nowhere/a").read_bytes, Path("/nowhere/a").touch])
def test_an_error_of_the_disk_names_no_path(act: Callable[[], object]) -> None:
    with pytest.raises(StorageFailure) as told, disk_errors("write to the data directory"):
        act()
    assert "nowhere" not in str(told.value)

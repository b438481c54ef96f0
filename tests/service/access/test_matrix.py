"""Every operation of the OpenAPI document with every kind of key: who is let in is what its description says.

The expectation is read from the text that users read, and not from the table that the service decides by.
"""

from __future__ import annotations

import json
import re
from collections.abc import Iterator
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

import httpx
import pytest
from fastapi import FastAPI

from service.access.keys import Keys
from service.access.roles import Role
from service.app.application import create_app
from service.settings import Settings
from tests.service.access.test_access import PARTS, asking

DOCUMENT: dict[str, Any] = json.loads((Path(__file__).parents[3] / "openapi.json").read_text())
ROLES: tuple[Role, ...] = ("query", "enrol", "admin")
PROBLEMS = {"none": "key-needed", "basic": "key-needed", "twice": "key-needed"}
PROBLEMS |= dict.fromkeys(("cut", "unknown", "wrong", "revoked", "expired"), "key-refused")
"""Kinds of keys that let nobody in, and the problem of each."""

KINDS = (*PROBLEMS, *ROLES, *(f"{where}-{role}" for where in ("lab", "yard") for role in ROLES))


@dataclass(frozen=True)
class Operation:
    """One operation of the document, and the end of its description: the key that it needs; None: it needs none."""

    name: str
    method: str
    path: str
    needs: str | None

    @property
    def role(self) -> str:
        assert self.needs is not None
        found = re.search(r"role `(\w+)`", self.needs)
        return "query" if found is None else found[1]

    def expected(self, kind: str) -> str | None:
        """The slug of the problem with which it refuses a kind of key; None: it lets it in."""
        if self.needs is None:
            return None
        if kind in PROBLEMS:
            return PROBLEMS[kind]
        limit, _, role = kind.rpartition("-")
        if ROLES.index(role) < ROLES.index(self.role):
            return "role-too-low"
        if limit and "not limited to certain maps" in self.needs:
            return "map-forbidden"
        elsewhere = limit == "yard" and "{map}" in self.path and "must include" in self.needs
        return "map-forbidden" if elsewhere else None


def operations() -> Iterator[Operation]:
    for path, methods in DOCUMENT["paths"].items():
        for method, described in methods.items():
            if "operationId" not in described:
                continue
            found = re.search(r"If the service has keys, this needs (a key of .*?)\.", described.get("description", ""))
            needs = None if found is None else found[1]
            yield Operation(described["operationId"], method.upper(), path, needs)


OPERATIONS = list(operations())


def test_the_document_says_of_each_operation_whether_it_needs_a_key() -> None:
    assert len(OPERATIONS) > 60
    open_ones = {one.name for one in OPERATIONS if one.needs is None}
    assert open_ones == {
        operation["operationId"]
        for methods in DOCUMENT["paths"].values()
        for operation in methods.values()
        if "operationId" in operation and {"key": []} not in operation.get("security", [])
    }
    assert all(one.path.startswith(("/livez", "/readyz", "/version")) for one in OPERATIONS if one.needs is None)


@pytest.fixture(scope="module")
def guarded(tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[FastAPI, dict[str, list[str]]]]:
    """An application, and the Authorization headers of each kind of key."""
    folder = tmp_path_factory.mktemp("matrix")
    expiry = datetime.now(UTC) + timedelta(hours=1)
    store = Keys.of(folder)
    tokens: dict[str, str] = {role: store.create(role, role)[1] for role in ROLES}
    for where in ("lab", "yard"):
        tokens |= {f"{where}-{role}": store.create(f"{where}-{role}", role, [where])[1] for role in ROLES}
    revoked, tokens["revoked"] = store.create("revoked", "admin")
    store.revoke(revoked.id)
    _, tokens["expired"] = store.create("expired", "admin", None, expiry)
    whole = tokens["admin"]
    tokens |= {"unknown": "placerec_000000000000_" + "A" * 43, "wrong": whole[:-1] + ("A" if whole[-1] != "A" else "B")}
    headers: dict[str, list[str]] = {kind: [f"Bearer {token}"] for kind, token in tokens.items()}
    headers |= {"none": [], "basic": [f"Basic {whole}"], "cut": [f"Bearer {whole[:-1]}"]}
    headers["twice"] = [f"Bearer {whole}"] * 2
    app = create_app(Settings(host="127.0.0.1", data_dir=folder))
    app.state.gate.keyring._wall = lambda: expiry.timestamp() + 1  # the hour has passed
    with app.state.gate.keyring:
        yield app, headers


@pytest.mark.anyio
@pytest.mark.thorough
@pytest.mark.parametrize("kind", KINDS)
async def test_every_operation_with_a_kind_of_key(guarded: tuple[FastAPI, dict[str, list[str]]], kind: str) -> None:
    app, headers = guarded
    differing = {}
    async with asking(app) as client:
        for one in OPERATIONS:
            path = re.sub(r"\{(\w+)\}", lambda found: PARTS.get(found[1], "x"), one.path)
            app.state.gate.rates._failures._full_at.clear()  # another address, as it were
            given = [("Authorization", text) for text in headers[kind]]
            found = refusal(await client.request(one.method, path, headers=given))
            if found != one.expected(kind):
                differing[one.name] = (found, one.expected(kind))
    assert differing == {}


def refusal(response: httpx.Response) -> str | None:
    """The slug of the problem with which the gate refuses; None where it lets in, whatever comes then."""
    if response.status_code not in (401, 403):
        return None
    slug = str(response.json()["type"]).rpartition(":")[2]
    assert response.status_code == (401 if slug.startswith("key-") else 403)
    return slug

"""The interface's description: complete, stable, and the one in the repository."""

from __future__ import annotations

import json
import re
from typing import Any

import httpx
import pytest

from service.app.application import create_app
from service.settings import Settings

FRAME_OPERATIONS = ("enrol_place", "query", "encode", "regions")


@pytest.fixture(scope="module")
def described() -> dict[str, Any]:
    return create_app(Settings(host="127.0.0.1")).openapi()


@pytest.fixture(scope="module")
def operations(described: dict[str, Any]) -> dict[str, dict[str, Any]]:
    return {operation["operationId"]: operation for item in described["paths"].values() for operation in item.values()}


def test_the_server_gives_the_same(client: httpx.Client, described: dict[str, Any]) -> None:
    assert client.get("/openapi.json").json() == described


def test_every_operation_is_described(described: dict[str, Any], operations: dict[str, dict[str, Any]]) -> None:
    assert "application/problem+json" in described["components"]["responses"]["problem"]["content"]
    for name, operation in operations.items():
        assert operation["description"] and operation["tags"], name
        assert operation["responses"]["default"] == {"$ref": "#/components/responses/problem"}, name
        for parameter in operation.get("parameters", []):
            assert parameter.get("description") or parameter["schema"].get("description"), (name, parameter["name"])


def test_the_frameworks_own_errors_are_not_promised(described: dict[str, Any]) -> None:
    assert "HTTPValidationError" not in json.dumps(described)


def test_frames_may_be_raw_or_in_a_form(operations: dict[str, dict[str, Any]]) -> None:
    for name in FRAME_OPERATIONS:
        content = operations[name]["requestBody"]["content"]
        assert set(content) == {"image/jpeg", "image/png", "image/webp", "multipart/form-data"}
        assert content["image/jpeg"]["schema"] == {"type": "string", "format": "binary"}
        query = {p["name"] for p in operations[name]["parameters"] if p["in"] == "query"}
        assert query < set(content["multipart/form-data"]["schema"]["properties"]), "fields are the parameters"


def test_problems_are_declared_by_status(operations: dict[str, dict[str, Any]]) -> None:
    declared = {name: set(operation["responses"]) for name, operation in operations.items()}
    assert {"200", "201", "400", "404", "409", "413", "415", "422", "503", "507"} <= declared["enrol_place"]
    assert {"200", "400", "404", "409", "413", "415", "422", "503"} <= declared["query"]
    assert "412" in declared["edit_map"] and "409" in declared["create_map"]


def test_each_answer_that_is_a_problem_is_written_once(
    described: dict[str, Any], operations: dict[str, dict[str, Any]]
) -> None:
    shared = described["components"]["responses"]
    seen = set()
    for name, operation in operations.items():
        for status, response in operation["responses"].items():
            if "$ref" not in response:
                assert set(response.get("content", {})) != {"application/problem+json"}, (name, status)
                continue
            component = response["$ref"].rpartition("/")[2]
            seen.add(component)
            for example in shared[component]["content"]["application/problem+json"].get("examples", {}):
                assert described["components"]["examples"][example]["value"]["status"] == int(status), (name, example)
    assert seen == set(shared)


def test_every_reference_leads_somewhere(described: dict[str, Any]) -> None:
    for kind, name in re.findall(r'"#/components/([^/]+)/([^"]+)"', json.dumps(described)):
        assert name in described["components"][kind]

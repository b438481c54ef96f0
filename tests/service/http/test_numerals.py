"""Numbers in query strings, headers and forms are plain numerals, in every operation."""

from __future__ import annotations

import json
import re
from typing import Any

import pytest
from pydantic import TypeAdapter, ValidationError

from core.numerals import Decimal, Whole, check_numeral
from core.places import Timestamp
from tests.clients.python.models import DOCUMENT
from tests.service.scenes import jpeg
from tests.service.server import Server, assert_problem

ODD = ("1_0", "+5", " 5", "5 ", "٥", "nan", "inf", "1_0.5", "0x1", "1e", ".", "")
GOOD = ("5", "05", "-5", "5.0", ".5", "5.", "1e3", "-2.5E-1")


def numbers() -> list[tuple[str, str, str]]:
    """Method, path and name of each parameter of a query string that is a number."""
    found = []
    for path, item in DOCUMENT["paths"].items():
        for method, operation in item.items():
            for one in operation.get("parameters", ()):
                schema = one.get("schema", {})
                kinds = {part.get("type") for part in (schema, *schema.get("anyOf", ()))}
                if one.get("in") == "query" and kinds & {"integer", "number"}:
                    found.append((method, path, one["name"]))
    return found


def test_plain_numerals() -> None:
    for text in GOOD:
        assert check_numeral(text) == text
    for text in ODD:
        with pytest.raises(ValueError, match="is not a number"):
            check_numeral(text)
    assert check_numeral(5) == 5 and check_numeral(None) is None


@pytest.mark.parametrize(
    ("kind", "value", "told", "untold"),
    [
        (Whole, "1_0", "such as 5 or -1", "2e3"),
        (Decimal, "1_0", "-1.5 or 2e3", "%2B"),
        (Decimal, "1e 5", "written %2B", None),
        (Timestamp, "2026-11-20T10:00:00 02:00", "written %2B", None),
        (Timestamp, "2026-11-20T10:00:00.5 0200", "written %2B", None),
        (Timestamp, "2026-11-20x 02:00", "", "%2B"),
    ],
)
def test_what_is_said_leads_to_what_is_taken(kind: Any, value: str, told: str, untold: str | None) -> None:
    with pytest.raises(ValidationError) as refused:
        TypeAdapter(kind).validate_python(value)
    assert told in str(refused.value) and (untold is None or untold not in str(refused.value))


def test_a_time_with_a_space_before_the_hour_is_taken() -> None:
    assert TypeAdapter(Timestamp).validate_python("2026-11-20 10:00").hour == 10


def test_every_operation_refuses_other_numbers(server: Server, map_id: str) -> None:
    found = numbers()
    assert len(found) > 50
    for method, path, name in found:
        where = re.sub(r"\{\w+\}", "1a", path.replace("{map}", map_id)).replace("recordings/1a", "recordings/a.mcap")
        for value in ("1_0", "+5"):
            answer = server.client.request(
                method, where, params={name: value}, content=b"{}", headers={"Content-Type": "application/json"}
            )
            problem: dict[str, Any] = assert_problem(answer, 422, "invalid-request")
            assert f"{value!r} is not a number" in json.dumps(problem), (method, path, name, problem)


@pytest.mark.parametrize("value", ODD[:2])
def test_so_do_forms_and_headers(server: Server, map_id: str, value: str) -> None:
    path, frame = f"/v1/maps/{map_id}/query", {"image": ("a.jpg", jpeg(1), "image/jpeg")}
    assert_problem(server.client.post(path, data={"k": value}, files=frame), 422, "invalid-request")
    sent = server.client.post(path, files=frame, headers={"X-Request-Timeout": value})
    assert_problem(sent, 422, "invalid-request")
    assert (
        server.client.post(path, data={"k": "5"}, files=frame, headers={"X-Request-Timeout": "5.5"}).status_code == 200
    )

from __future__ import annotations

import base64
import json

import pytest

from core.errors import InvalidCursor
from core.maps.pagination import Listing, decode_name, decode_number, encode_cursor


@pytest.mark.parametrize("number", [0, 1, 2**63 - 1])
def test_a_number_comes_back(number: int) -> None:
    assert decode_number(["places", "lab", None], encode_cursor(["places", "lab", None], number)) == number


@pytest.mark.parametrize("name", ["a", "nördlich", "a\u200bb", "x" * 128, "💡"])
def test_a_name_comes_back(name: str) -> None:
    assert decode_name(["sequences", "lab"], encode_cursor(["sequences", "lab"], name)) == name


def test_without_a_cursor_a_listing_begins_before_all() -> None:
    assert decode_number(["places"], None) == -1
    assert decode_name(["maps"], None) == ""


def test_a_cursor_of_another_listing_is_refused() -> None:
    cursor = encode_cursor(["places", "lab", "monday"], 3)
    others: list[Listing] = [["places", "lab", None], ["places", "hall", "monday"], ["sequences", "lab"]]
    for listing in others:
        with pytest.raises(InvalidCursor):
            decode_number(listing, cursor)


def made(content: object) -> str:
    return base64.urlsafe_b64encode(json.dumps(content).encode()).decode().rstrip("=")


@pytest.mark.parametrize(
    "cursor",
    [
        "",
        "x",
        "%%%",
        "ünsinn",
        "AAAA",
        "\ud800",
        made(None),
        made([1]),
        made({"after": 1}),
        made({"listing": ["places"], "after": "1"}),
        made({"listing": ["places"], "after": True}),
        made({"listing": ["places"], "after": 1.5}),
        made({"listing": ["places"], "after": -2}),
        made({"listing": ["places"], "after": 2**63}),
        made({"listing": ["places"], "after": 1, "more": 1}),
        base64.urlsafe_b64encode(b"[" * 100_000).decode(),
    ],
)
def test_garbage_is_no_cursor(cursor: str) -> None:
    with pytest.raises(InvalidCursor):
        decode_number(["places"], cursor)


def test_a_name_that_no_database_takes_is_no_cursor() -> None:
    for after in (1, None, "\ud800"):
        with pytest.raises(InvalidCursor):
            decode_name(["maps"], made({"listing": ["maps"], "after": after}))

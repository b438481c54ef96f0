"""Pages of listings, and the opaque cursors by which the next page is asked for.

A cursor names its listing and the last entry of the page, so that entries that come or go between two requests shift
nothing.
"""

from __future__ import annotations

import base64
import binascii
import json
import sqlite3
from collections.abc import Callable
from typing import TypeVar

from core.errors import InvalidCursor
from core.maps.place_filter import PlaceFilter
from core.maps.records import SequenceSummary
from core.places import Place
from core.storage.database import ledger
from core.storage.database.conditions import text_of

Entry = TypeVar("Entry")

Listing = list[str | None]
"""Names a listing, such as ``["places", "lab", "monday"]``; a cursor of another listing is refused."""


def encode_cursor(listing: Listing, after: str | int) -> str:
    """A cursor that continues ``listing`` after the entry whose key is ``after``."""
    text = json.dumps({"listing": listing, "after": after}, separators=(",", ":"))
    return base64.urlsafe_b64encode(text.encode()).decode().rstrip("=")


def _decode(listing: Listing, cursor: str) -> object:
    try:
        padded = cursor.encode("ascii") + b"=" * (-len(cursor) % 4)
        content = json.loads(base64.b64decode(padded, altchars=b"-_", validate=True))
    except (ValueError, binascii.Error, RecursionError) as error:
        raise InvalidCursor("The cursor was not made by this service.") from error
    if not isinstance(content, dict) or set(content) != {"listing", "after"} or content["listing"] != listing:
        raise InvalidCursor("The cursor belongs to another listing.")
    return content["after"]


def decode_number(listing: Listing, cursor: str | None) -> int:
    """The number after which the listing continues; -1, which is before all numbers, without a cursor.

    Raises:
        InvalidCursor: the text is not a cursor of this listing.
    """
    after = -1 if cursor is None else _decode(listing, cursor)
    if not isinstance(after, int) or isinstance(after, bool) or not -1 <= after < 2**63:
        raise InvalidCursor("The cursor was not made by this listing.")
    return after


def decode_name(listing: Listing, cursor: str | None) -> str:
    """The name after which the listing continues; empty, which is before all names, without a cursor.

    Raises:
        InvalidCursor: the text is not a cursor of this listing.
    """
    after = "" if cursor is None else _decode(listing, cursor)
    if not isinstance(after, str) or any("\ud800" <= letter <= "\udfff" for letter in after):
        raise InvalidCursor("The cursor was not made by this listing.")
    return after


def page_of(
    listing: Listing, found: list[Entry], limit: int, key: Callable[[Entry], str | int]
) -> tuple[list[Entry], str | None]:
    """The first ``limit`` of the entries found and, if there are more, the cursor of the next page."""
    more = encode_cursor(listing, key(found[limit - 1])) if len(found) > limit else None
    return found[:limit], more


def listing_of_places(map_id: str, wanted: PlaceFilter) -> Listing:
    """Names the places of a map that fulfil some conditions."""
    others = text_of(wanted)
    return ["places", map_id, wanted.sequence] + ([] if others is None else [others])


def page_of_places(
    connection: sqlite3.Connection, map_id: str, cursor: str | None, limit: int, wanted: PlaceFilter
) -> tuple[list[Place], str | None]:
    """Places that fulfil some conditions, in the order of their enrolment, and the cursor of the next page.

    Raises:
        InvalidCursor.
    """
    listing = listing_of_places(map_id, wanted)
    after = decode_number(listing, cursor)
    found = ledger.places_after(connection, after, one_more(limit), wanted)
    page, more = page_of(listing, found, limit, lambda stored: stored.number)
    return [stored.place for stored in page], more


def page_of_sequences(
    connection: sqlite3.Connection, map_id: str, cursor: str | None, limit: int
) -> tuple[list[SequenceSummary], str | None]:
    """Sequences by name, and the cursor of the next page.

    Raises:
        InvalidCursor.
    """
    listing: Listing = ["sequences", map_id]
    after = decode_name(listing, cursor)
    found = ledger.sequences_after(connection, after, one_more(limit))
    return page_of(listing, found, limit, lambda sequence: sequence.name)


def one_more(limit: int) -> int:
    """An entry more than the page has tells whether there is a next page."""
    if limit < 1:
        raise ValueError("a page has at least one entry")
    return limit + 1

"""Listings of a map, a page at a time."""

from __future__ import annotations

import sqlite3

from core.places import Place
from core.storage.database import ledger
from core.storage.database.cursors import Listing, decode_name, decode_number, encode_cursor
from core.storage.records import SequenceSummary


def places(
    connection: sqlite3.Connection, map_id: str, cursor: str | None, limit: int, sequence: str | None
) -> tuple[list[Place], str | None]:
    """Places in the order of their enrolment, and the cursor of the next page.

    Raises:
        InvalidCursor.
    """
    listing: Listing = ["places", map_id, sequence]
    after = decode_number(listing, cursor)
    found = ledger.places_after(connection, after, _one_more(limit), sequence)
    more = encode_cursor(listing, found[limit - 1].number) if len(found) > limit else None
    return [stored.place for stored in found[:limit]], more


def sequences(
    connection: sqlite3.Connection, map_id: str, cursor: str | None, limit: int
) -> tuple[list[SequenceSummary], str | None]:
    """Sequences by name, and the cursor of the next page.

    Raises:
        InvalidCursor.
    """
    listing: Listing = ["sequences", map_id]
    after = decode_name(listing, cursor)
    found = ledger.sequences_after(connection, after, _one_more(limit))
    more = encode_cursor(listing, found[limit - 1].name) if len(found) > limit else None
    return found[:limit], more


def _one_more(limit: int) -> int:
    """To ask for one more than a page tells whether there is a next one."""
    if limit < 1:
        raise ValueError("a page has at least one entry")
    return limit + 1

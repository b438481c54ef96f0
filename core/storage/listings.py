"""Listings of the places and sequences of a map, page by page."""

from __future__ import annotations

import sqlite3

from core.maps.pagination import Listing, decode_name, decode_number, listing_of_places, one_more, page_of
from core.maps.place_filter import PlaceFilter
from core.maps.records import SequenceSummary
from core.places import Place
from core.storage.database import ledger


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

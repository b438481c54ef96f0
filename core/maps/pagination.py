"""Pages of listings, and the opaque cursors by which the next page is requested.

A cursor names its listing and the last entry of the page, so that entries that come or go between two requests shift
nothing.
"""

from __future__ import annotations

import base64
import binascii
import json
from collections.abc import Callable
from typing import TypeVar

from core.errors import InvalidCursor
from core.maps.place_filter import PlaceFilter
from core.maps.stored_fields import moment_text

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
    others = _text_of(wanted)
    return ["places", map_id, wanted.sequence] + ([] if others is None else [others])


def _text_of(wanted: PlaceFilter) -> str | None:
    """Text that is the same for the same conditions; None without any but ``sequence``."""
    ids = None if wanted.ids is None else json.dumps(wanted.ids)
    metadata = json.dumps(dict(wanted.metadata)) if wanted.metadata else None
    after, before = (moment and moment_text(moment) for moment in (wanted.after, wanted.before))
    given = [ids, wanted.camera, wanted.level, after, before, metadata]
    return None if given == [None] * len(given) else json.dumps(given)


def one_more(limit: int) -> int:
    """One entry more than a page has, to see whether there is a next page."""
    if limit < 1:
        raise ValueError("a page has at least one entry")
    return limit + 1
